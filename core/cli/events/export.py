"""Action ``mphdrr events export SET --to PROGRAM -o FOLDER``: events in the formats of training programs."""

import argparse

from ... import events
from ...events.programs import PROGRAMS
from ..options import add_set_action, print_answer, progress_bar, say


def add_parser(actions) -> None:  # type: ignore[no-untyped-def]
    """Add the action ``events export``."""
    parser = add_set_action(actions, "export", _run)
    add = parser.add_argument
    add("--to", required=True, choices=PROGRAMS, metavar="PROGRAM", help="see the list below")
    folder = "a new folder, or one with an interrupted export of the same kind, which is resumed"
    add("-o", "--output", required=True, metavar="FOLDER", help=folder)
    text = "model in the recipe whose images are written; may be repeated; default: all; some programs take only one"
    add("--model", action="append", metavar="NAME", help=text)
    add("--split", metavar="NAME", help="only the events of this split, such as train")
    add("--noise", type=_parse_noise, metavar="own|SEED", help="with the events' own noise, or another; default: none")
    add("--level", type=float, default=1.0, metavar="SHARE", help="share of the acquisition time, with --noise")
    add("--slots", metavar="CSV", help="legacy, 3dunet: module shown in each slot, as in slots.csv")
    add("--raw", metavar="WHAT", help="3dunet: slots, to Radon images (the default); or backprojection, to truth")
    add("--events-per-shard", type=int, metavar="N", help="webdataset; default: as many as make about a gigabyte")
    add("--uncompressed", action="store_true", default=None, help="webdataset: .npy members instead of .npy.gz")
    programs = "\n".join(f"  {program.name:<13}{program.title}" for program in PROGRAMS.values())
    parser.epilog = f"programs:\n{programs}\n{parser.epilog}"


def _run(arguments: argparse.Namespace) -> None:
    """Write a set's events for another program.

    mphdrr events export set --to 3dunet --model counts --noise own -o unet
    mphdrr events export set --to webdataset --split train -o shards
    """
    from ...events.exports import plan_export

    chosen = events.EventSet(arguments.folder)
    if arguments.split is not None:
        chosen = chosen.split(arguments.split)
    names = ("noise", "level", "slots", "raw", "events_per_shard", "uncompressed")
    options = {name: getattr(arguments, name) for name in names}
    plan = plan_export(chosen, arguments.output, arguments.to, models=arguments.model, **options)
    say(plan.summary())
    plan.write(progress_bar("exporting"))
    record = {"folder": arguments.output, "program": arguments.to, "events": len(plan.rows)}
    print_answer(arguments, record, [f"{arguments.output}: {len(plan.rows)} events, {PROGRAMS[arguments.to].title}"])


def _parse_noise(text: str) -> int | str:
    """Parse the option ``--noise``: "own", or a seed."""
    try:
        return text if text == "own" else int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected own, or a seed: a whole number, got {text}") from None
