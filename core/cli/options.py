"""Options, parsing and output that several commands share."""

import argparse
import inspect
import json
import os
import re
import signal
import sys
import textwrap
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import InputError
from ..files import ensure_folder, note_output, refuse_folder, require_ending, write_bytes

if TYPE_CHECKING:  # the parser of all commands reads this file, and numpy takes a while
    from ..volumes.volume import Volume

COMMANDS = {
    "geometry": "work on a geometry workbook",
    "phantom": "make a phantom volume",
    "volume": "inspect volumes and convert them",
    "project": "project a volume, or a phantom, into every module; or use measured counts as the projections",
    "counts": "find dead and hot pixels in measured counts",
    "reconstruct": "reconstruct the volume from the images of a run",
    "backproject": "combine the values of a run's views at each voxel: sum, geometric mean or minimum",
    "score": "score a reconstructed volume against the truth: the volume of a simulated run, a phantom, or a volume",
    "xray": "find motion by X rays; compute air kerma and absorbed dose",
    "events": "make sets of training events from a recipe",
    "learn": "train and judge networks that reconstruct",
    "design": "design a scanner by gradient-based optimisation",
    "export": "write a projection run in another format",
}
"""Module of a command -> its summary in the help; the module is imported only when its options are needed."""

INTERVAL = 60.0
"""Longest silence, s, of a command whose standard error is no terminal (`reporting`)."""
_stage: "ProgressBar | None" = None  # that the running command is in
_is_quiet = False  # whether the running command has --quiet
_WIDTH = 30  # of progress bars, characters
_LONG = r"""(?<!\w)'[^']{199,}'|(?<!\w)"[^"]{199,}"|\[[^]]{199,}\]|\S{201,}"""
_HANGING = 15 * " "  # indent of further lines in the second column of lists in descriptions


class _HelpFormatter(argparse.HelpFormatter):
    """Help formatter that shows informative defaults, lists as they are typed, and keeps the lines of descriptions."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        """Return a description with its lines kept and wrapped to `width`; list items, which begin with a blank, hang."""
        paragraphs = []
        for line in text.splitlines():
            hanging = indent + _HANGING * line.startswith(" ")
            paragraphs.append(textwrap.fill(line, width, initial_indent=indent, subsequent_indent=hanging))
        return "\n".join(paragraphs)

    def _get_help_string(self, action: argparse.Action) -> str | None:
        """Return an option's help text with its default, unless that is None, False, empty or suppressed."""
        if action.help is None or action.default in (None, [], False, argparse.SUPPRESS):
            return action.help
        default = action.default if isinstance(action.default, list) else [action.default]
        return f"{action.help} (default: {' '.join(map(str, default)).replace('%', '%%')})"


class NotingStore(argparse.Action):
    """Action that stores an option's value and notes that it was typed, so that `refuse` can tell it from a default."""

    def __call__(
        self, parser: argparse.ArgumentParser, namespace: argparse.Namespace, values: Any, option_string: Any = None
    ) -> None:
        """Store the value; argparse calls this for each typed option."""
        if "" in (values if isinstance(values, list) else [values]):
            parser.error(f"argument {'/'.join(self.option_strings) or self.metavar or self.dest}: got an empty text")
        typed = vars(namespace).setdefault("typed", {})
        if self.dest == "output" and "output" in typed:  # of other options the last one holds
            parser.error(f"argument {'/'.join(self.option_strings)}: it is given twice; expected it once")
        setattr(namespace, self.dest, values)
        typed[self.dest] = option_string


def refuse(arguments: argparse.Namespace, names: Iterable[str], reason: str) -> None:
    """Raise `InputError` if one of the options stored under `names` was typed, with the option and the `reason`."""
    typed = getattr(arguments, "typed", {})
    for name in names:
        if name in typed or getattr(arguments, name, None) is True:  # a flag
            raise InputError(f"{typed.get(name, '--' + name.replace('_', '-'))} {reason}")


def add_run(subparsers: Any, name: str, run: Callable[[argparse.Namespace], None]) -> argparse.ArgumentParser:
    """Add a command that calls `run` and return its parser; the help is the docstring of `run`: a sentence, examples."""
    summary, _, example_text = inspect.cleandoc(run.__doc__ or "").partition("\n\n")
    sentence = " ".join(summary.split()).rstrip(".")
    sentence = sentence[0].lower() + sentence[1:] if sentence[1].islower() else sentence
    examples = re.split(r"\s+(?=mphdrr )", example_text)
    return add_command(subparsers, name, sentence, "\nexample: ".join(" ".join(text.split()) for text in examples), run)


def add_command(subparsers, name: str, summary: str, example: str, run: Any = None) -> argparse.ArgumentParser:  # type: ignore[no-untyped-def]
    """Add a command and return its parser, whose help ends in an example; `run` is called with the parsed arguments."""
    texts = {"description": f"{summary[0].upper()}{summary[1:]}.", "epilog": f"example: {example}"}
    parser = subparsers.add_parser(name, help=summary, **texts, formatter_class=_HelpFormatter)
    parser.set_defaults(run=run)
    return parser


def add_set_action(actions: Any, name: str, run: Callable[[argparse.Namespace], None]) -> argparse.ArgumentParser:
    """Return the parser of an action on an event set, with SET and ``--json``; its help is the docstring of `run`."""
    parser = add_run(actions, name, run)
    parser.add_argument("folder", metavar="SET", help="folder of the set")
    parser.add_argument("--json", action="store_true", help="print the answer as JSON")
    return parser


def add_actions(subparsers: Any, name: str, example: str, metavar: str = "ACTION") -> Any:
    """Add a command of `COMMANDS` that consists of actions, and return the subparsers to which these are added."""
    return add_command(subparsers, name, COMMANDS[name], example).add_subparsers(metavar=metavar, required=True)


def describe_volume(volume: "Volume") -> str:
    """Return a volume's voxels and the range of its values as text: ``64 x 64 x 64 voxels, 0 to 4.2``."""
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


def expand_to_three(values: list) -> list:
    """Return the numbers along x, y and z of an option that takes three numbers, or one for all axes."""
    return values * 3 if len(values) == 1 else values


def add_photons(parser: argparse.ArgumentParser) -> None:
    """Add the option that chooses photons of a run with scatter."""
    parser.add_argument("--photons", choices=("all", "primary", "scatter"), default="all",
                        help="which photons the images hold, of a run with scatter")  # fmt: skip


def output_path(text: str, suffixes: tuple[str, ...] = (), is_new: bool = True) -> Path:
    """Return the path of a file to write, whose name must end in one of `suffixes` if any are given.

    A missing folder is made. A file that `is_new` must be no input and no other output of the command. This is called before
    the long work, so that a file that cannot be written is refused at once.
    """
    path = Path(text)
    if suffixes:
        require_ending(path, suffixes)
    refuse_folder(path)
    ensure_folder(path.parent)
    if is_new:
        note_output(path)
    return path


def new_recipe_path(text: str) -> Path:
    """Return `output_path` of a new recipe (.toml); raise `InputError` for an existing file, which was edited by hand."""
    path = output_path(text, (".toml",))
    if path.exists():
        raise InputError(f"{path}: it exists; choose another name, or remove it first")
    return path


def print_or_write_recipe(text: str, output: str | None, next_command: str) -> None:
    """Print a recipe to start from, or write it to a new file and name the `next_command`, in which {path} is the file."""
    if output is None:
        print(text, end="")
        return
    path = new_recipe_path(output)
    write_bytes(path, text.encode())
    print(f"{path}: edit it, then: {next_command.format(path=path)}")


def numbered_path(path: Path, number: int, count: int) -> Path:
    """Return the name of one of `count` files: train-007.nii.gz for train.nii.gz, or `path` itself if it is the only one."""
    if count == 1:
        return path
    suffix = ".nii.gz" if path.name.lower().endswith(".nii.gz") else path.suffix
    end = len(path.name) - len(suffix)
    return path.with_name(f"{path.name[:end]}-{number:0{len(str(count))}}{path.name[end:]}")


def parse_number_or_name(text: str) -> float | str:
    """Parse an option's text as a number, or return it unchanged as a name."""
    try:
        return float(text)
    except ValueError:
        return text


def count_text(number: int, noun: str) -> str:
    """Return a number with its noun, such as "1 fault" or "2 faults"."""
    return f"{number} {noun}{'s' * (number != 1)}"


def say(text: str) -> None:
    """Print a line on standard error; on a terminal it replaces an unfinished progress bar."""
    over = "\r\x1b[K" if sys.stderr.isatty() else ""
    print(f"{over}mphdrr: {message_line(text)}\n", end="", file=sys.stderr, flush=True)  # whole, beside other threads'


def message_line(text: str) -> str:
    """Return a message as one line, with control characters escaped, and with at most 200 characters of a file's content.

    A quoted text, a list, a path or a word of more than 200 characters is shortened, as is a message of more than 1000.
    """
    text = "".join(x if x.isprintable() else x.encode("unicode_escape").decode() for x in text)
    for long in (_LONG, ".{1001,}"):
        text = re.sub(long, lambda match: f"{match[0][:150]}…{match[0][-49:]}", text)
    return text


def duration_text(seconds: float) -> str:
    """Return a duration as text, such as "85 min"."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"


class ProgressBar:
    """Progress callback of a stage: a bar on a terminal, and elsewhere the state that `reporting` prints now and then."""

    def __init__(self, label: str, status_text: Callable[[], str] | None) -> None:
        self._label, self._status_text, self._start_time = label, status_text, time.monotonic()
        self.remark: Callable[[], str] | None = None  # a text on the last step, such as its loss (`tell`)
        self._first = self._last = (self._start_time, 0, 0)  # time, steps done and steps at the first and last report

    def __call__(self, n_done: int, total: int) -> None:
        """Note the steps done; on a terminal draw the bar, whose line ends when it is full."""
        global _stage
        report = time.monotonic(), n_done, total
        if total != self._last[2] or n_done < self._last[1]:  # the first report, or that of another round
            self._first = report
        self._last, _stage = report, self if n_done < total else None
        if sys.stderr.isatty() and not _is_quiet:
            filled = _WIDTH * n_done // max(total, 1)
            text = self._status_text() if self._status_text else f"{report[0] - self._start_time:.1f} s"
            bar = f"[{'#' * filled}{'.' * (_WIDTH - filled)}]"
            end = "" if n_done < total else "\n"
            print(f"\r{self._label} {bar} {n_done}/{total}  {text}\x1b[K", end=end, file=sys.stderr, flush=True)

    def state(self) -> str:
        """Return the last state: "training: step 120 of 4000, loss 0.412, 2.1 steps/s, 31 min left"."""
        (first_time, n_first, _), (time_done, n_done, total) = self._first, self._last
        idle = time.monotonic() - time_done
        step = f"step {n_done} of {total}" if total else "no step done"
        texts = [f"{step} for {duration_text(idle)}" if idle > INTERVAL or not total else step]
        texts += [self.remark()] if self.remark else []
        if n_done > n_first:
            seconds = (time_done - first_time) / (n_done - n_first)  # of a step
            texts.append(f"{1 / max(seconds, 1e-9):.1f} steps/s" if seconds < 1 else f"{seconds:.1f} s per step")
            time_left = duration_text(max(0.0, seconds * (total - n_done) - idle))
            texts.append(self._status_text() if self._status_text else f"{time_left} left")
        return f"{self._label}: {', '.join(texts)}"


def progress_bar(label: str, status_text: Callable[[], str] | None = None) -> ProgressBar:
    """Return a new stage's progress callback, which `reporting` names from now on.

    Behind the bar stand the elapsed seconds, or the text that `status_text` returns.
    """
    global _stage
    _stage = ProgressBar(label, status_text)
    return _stage


@contextmanager
def reporting(is_quiet: bool = False) -> Iterator[None]:
    """Print, within the block of a command, a line on its stage each `INTERVAL`, if standard error is no terminal.

    A thread does it, so that a step of hours is heard, too. A command that `is_quiet` has neither lines nor bars, and of the
    processes of a training on one machine only the first has.
    """
    global _stage, _is_quiet
    _stage, start_time, end = None, time.monotonic(), threading.Event()
    _is_quiet = is_quiet or os.environ.get("LOCAL_RANK", "0") != "0"  # set by Lightning and torchrun

    def report() -> None:
        """Print the lines until the block ends."""
        if hasattr(signal, "pthread_sigmask"):  # signals are for the main thread, which may hold them back
            signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals())
        while not end.wait(INTERVAL):
            stage, elapsed = _stage, duration_text(time.monotonic() - start_time)
            with suppress(OSError, ValueError):  # standard error was closed
                say(f"at work for {elapsed}" if stage is None else stage.state())

    thread = threading.Thread(target=report, name="reporting", daemon=True)
    if not _is_quiet and not sys.stderr.isatty():
        thread.start()
    try:
        yield
    finally:
        end.set()
        _is_quiet = False
        if thread.ident is not None:
            thread.join()
