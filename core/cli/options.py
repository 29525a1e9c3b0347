"""Options and parsing that several commands share."""

import argparse
import inspect
import json
import re
import sys
import textwrap
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import InputError
from ..files import ensure_folder, refuse_folder, require_ending, write_bytes
from ..progress import Progress

if TYPE_CHECKING:  # the parser of all commands reads this file, and numpy takes a while
    from ..volumes.volume import Volume

COMMANDS = {
    "geometry": "work on a geometry workbook",
    "phantom": "make a phantom volume",
    "volume": "look at volumes and convert them",
    "project": "project a volume, or a phantom, into every module; or take measured counts for the projections",
    "counts": "find dead and hot pixels in measured counts",
    "reconstruct": "reconstruct the volume that a run's images are of",
    "backproject": "put together what a run's views say of each voxel: sum, geometric mean or minimum",
    "score": "score a reconstructed volume beside the truth: what a run was simulated of, a phantom, or a volume",
    "xray": "motion seen by X rays, kerma of a CT, absorbed dose",
    "events": "make sets of training events from a recipe",
    "learn": "train networks that reconstruct",
    "design": "design a scanner by gradients",
    "export": "write a projection run in another format",
}
"""What the commands do, by their modules here; those modules are imported when their options are wanted."""

_HANGING = 15 * " "  # under the second column of lists in descriptions


class _HelpFormatter(argparse.HelpFormatter):
    """Shows the defaults that say something, lists as they are typed; keeps the lines of descriptions."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        return "\n".join(
            textwrap.fill(
                line, width, initial_indent=indent, subsequent_indent=indent + _HANGING * line.startswith(" ")
            )
            for line in text.splitlines()
        )

    def _get_help_string(self, action: argparse.Action) -> str | None:
        if action.help is None or action.default in (None, [], False, argparse.SUPPRESS):
            return action.help
        default = action.default if isinstance(action.default, list) else [action.default]
        return f"{action.help} (default: {' '.join(map(str, default)).replace('%', '%%')})"


class NotingStore(argparse.Action):
    """Stores an option's value, and notes that it was typed, so that `refuse` can tell it from a default."""

    def __call__(
        self, parser: argparse.ArgumentParser, namespace: argparse.Namespace, values: Any, option_string: Any = None
    ) -> None:
        """Called by argparse."""
        if "" in (values if isinstance(values, list) else [values]):
            parser.error(f"argument {'/'.join(self.option_strings) or self.metavar or self.dest}: got an empty text")
        setattr(namespace, self.dest, values)
        vars(namespace).setdefault("typed", {})[self.dest] = option_string


def refuse(arguments: argparse.Namespace, names: Iterable[str], why: str) -> None:
    """Refuse options that were typed, by the `names` they are stored as: the message names the option and `why` not."""
    noted = getattr(arguments, "typed", {})
    for name in names:
        if name in noted or getattr(arguments, name, None) is True:  # a flag
            raise InputError(f"{noted.get(name, '--' + name.replace('_', '-'))} {why}")


def add_run(subparsers: Any, name: str, run: Callable[[argparse.Namespace], None]) -> argparse.ArgumentParser:
    """The parser of a command that calls `run`, whose docstring is the help: what it does, and below it examples."""
    summary, _, below = inspect.cleandoc(run.__doc__ or "").partition("\n\n")
    words = " ".join(summary.split()).rstrip(".")
    words = words[0].lower() + words[1:] if words[1].islower() else words
    examples = re.split(r"\s+(?=mphdrr )", below)
    return add_command(subparsers, name, words, "\nexample: ".join(" ".join(each.split()) for each in examples), run)


def add_command(subparsers, name: str, summary: str, example: str, run: Any = None) -> argparse.ArgumentParser:  # type: ignore[no-untyped-def]
    """A command's parser, its help ending in an example; `run` is called with the parsed arguments."""
    words = {"description": f"{summary[0].upper()}{summary[1:]}.", "epilog": f"example: {example}"}
    parser = subparsers.add_parser(name, help=summary, **words, formatter_class=_HelpFormatter)
    parser.set_defaults(run=run)
    return parser


def add_set_action(actions: Any, name: str, run: Callable[[argparse.Namespace], None]) -> argparse.ArgumentParser:
    """Return the parser of an action on an event set, with SET and ``--json``; its help is the docstring of `run`."""
    parser = add_run(actions, name, run)
    parser.add_argument("folder", metavar="SET", help="folder of the set")
    parser.add_argument("--json", action="store_true", help="print the answer as JSON")
    return parser


def add_actions(subparsers: Any, name: str, example: str, metavar: str = "ACTION") -> Any:
    """The subparsers of a command of `COMMANDS` that consists of actions."""
    return add_command(subparsers, name, COMMANDS[name], example).add_subparsers(metavar=metavar, required=True)


def described(volume: "Volume") -> str:
    """A volume's voxels and the range of its values, for people: ``64 x 64 x 64 voxels, 0 to 4.2``."""
    voxels, values = " x ".join(map(str, volume.grid.shape)), volume.array
    return f"{voxels} voxels, {float(values.min()):.4g} to {float(values.max()):.4g}"


def print_answer(arguments: argparse.Namespace, record: Any, lines: Iterable[str], notes: Iterable[str] = ()) -> None:
    """Print a record as JSON if ``--json`` was typed, else its lines of text, with notes on standard error."""
    if arguments.json:
        print(json.dumps(record, indent=1))
        return
    for note in notes:
        say(note)
    print("\n".join(lines))


def one_or_three(values: list) -> list:
    """The numbers along x, y and z of an option that takes one for all."""
    return values * 3 if len(values) == 1 else values


def output_path(text: str, suffixes: tuple[str, ...] = ()) -> Path:
    """A file to write, its name ending in one of `suffixes` if any; its folder is made when it is missing.

    Called before the long work, so that what cannot be written fails at once.
    """
    path = Path(text)
    if suffixes:
        require_ending(path, suffixes)
    refuse_folder(path)
    ensure_folder(path.parent)
    return path


def new_recipe_path(text: str) -> Path:
    """`output_path` of a recipe (.toml) to begin with; one that is there was edited by hand, and is not overwritten."""
    path = output_path(text, (".toml",))
    if path.exists():
        raise InputError(f"{path}: it exists; choose another name, or remove it first")
    return path


def give_recipe(text: str, output: str | None, then: str) -> None:
    """Print a recipe to begin with, or write it to a new file and say what comes `then`, a command with {path}."""
    if output is None:
        print(text, end="")
        return
    path = new_recipe_path(output)
    write_bytes(path, text.encode())
    print(f"{path}: edit it, then: {then.format(path=path)}")


def numbered_path(path: Path, number: int, count: int) -> Path:
    """The name of one of `count` files: train-007.nii.gz for train.nii.gz, or `path` itself where it is the only one."""
    if count == 1:
        return path
    suffix = ".nii.gz" if path.name.lower().endswith(".nii.gz") else path.suffix
    end = len(path.name) - len(suffix)
    return path.with_name(f"{path.name[:end]}-{number:0{len(str(count))}}{path.name[end:]}")


def number_or_name(text: str) -> float | str:
    """What an option's text is that takes a number or the name of something."""
    try:
        return float(text)
    except ValueError:
        return text


def counted(number: int, word: str) -> str:
    """A number of things, such as "1 fault" or "2 faults"."""
    return f"{number} {word}{'s' * (number != 1)}"


def say(text: str) -> None:
    """Write a line on standard error; on a terminal in the place of a bar that is not at its end."""
    over = "\r\x1b[K" if sys.stderr.isatty() else ""
    print(f"{over}mphdrr: {text}", file=sys.stderr, flush=True)


def progress_bar(label: str, more: Callable[[], str] | None = None) -> Progress:
    """A progress callback that draws a bar on standard error when that is a terminal, and says nothing otherwise.

    The bar ends in the seconds that went by, or in what `more` says.
    """
    started, width = time.monotonic(), 30

    def show(done: int, total: int) -> None:
        if not sys.stderr.isatty():
            return
        filled = width * done // max(total, 1)
        words = f"{time.monotonic() - started:.1f} s" if more is None else more()
        end = "\n" if done >= total else ""
        bar = f"[{'#' * filled}{'.' * (width - filled)}]"
        print(f"\r{label} {bar} {done}/{total}  {words}\x1b[K", end=end, file=sys.stderr, flush=True)

    return show
