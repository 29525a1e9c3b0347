"""Command ``mphdrr counts flood FLOOD -o efficiency.npy``: efficiencies of the pixels from measured counts."""

import argparse

from ..runs import FORMATS
from .options import add_actions, add_run, output_path, print_answer


def add_parser(subparsers) -> None:  # type: ignore[no-untyped-def]
    """Add the command ``mphdrr counts`` with its action ``flood``."""
    actions = add_actions(subparsers, "counts", "mphdrr counts flood flood.h5 -o efficiency.npy")
    flood = add_run(actions, "flood", _run)
    text = f"run of measured counts of a uniform source ({', '.join(FORMATS)}), or images of modules (.npy)"
    flood.add_argument("file", metavar="FLOOD", help=text)
    flood.add_argument("--order", type=int, default=2, metavar="N", help="degree of the trend across a detector")
    flood.add_argument("--json", action="store_true", help="print JSON")
    flood.add_argument("-o", "--output", metavar="FILE", required=True, help=".npy")


def _run(arguments: argparse.Namespace) -> None:
    """Find the pixels' efficiencies, and dead and hot pixels, from the image of a uniform source.

    mphdrr project scanner.xlsx --counts flood.npy --frames 1-80 --orientation front+v --time 600 -o flood.h5
    mphdrr counts flood flood.h5 -o efficiency.npy
    """
    from ..runs.flood_files import write_flood

    path = output_path(arguments.output, (".npy",))
    _, answer, lines = write_flood(arguments.file, path, arguments.order)
    print_answer(arguments, answer, lines)
