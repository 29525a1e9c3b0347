"""Command line of mphdrr without Blender: parsing, exit status and one-line errors.

Entry points: `main` runs a command line, `build_parser` returns its parser. A command is a module of this folder with
``add_parser(subparsers)`` and a line of `COMMANDS` in `options`. There, `add_run` adds a command whose help is the docstring
of the function that runs it: what it does, then examples. `addon.cli` adds the commands that need Blender.
"""

import argparse
import contextlib
import io
import os
import sys
import warnings
from collections.abc import Mapping, Sequence
from importlib import import_module
from types import MappingProxyType
from typing import Any, NoReturn

from ..errors import InputError, InputWarning
from ..files import keeping_inputs
from ..progress import Cancelled
from ..version import VERSION
from .options import COMMANDS, NotingStore, reporting, say

OK, INPUT_ERROR, USAGE, INTERRUPTED = 0, 1, 2, 130


class CommandParser(argparse.ArgumentParser):
    """Argument parser that reports an error as one line on standard error, with status 2, and notes the typed options."""

    def __init__(self, *arguments: Any, **details: Any) -> None:
        super().__init__(*arguments, **details)
        for name in (None, "store"):
            self.register("action", name, NotingStore)

    def _print_message(self, message: str, file: Any = None) -> None:
        """Write a help or version text, for argparse, without its silence about output that cannot be written."""
        (file or sys.stderr).write(message)  # argparse itself would ignore that this cannot be written

    def error(self, message: str) -> NoReturn:
        """Print a usage error as one line on standard error and exit with status 2."""
        sys.stderr.write(f"{self.prog}: {message} (see {self.prog} --help)\n")
        raise SystemExit(USAGE)


def build_parser(more_commands: Mapping[str, str] = MappingProxyType({}), only: str | None = None) -> CommandParser:
    """Return the parser of ``mphdrr``: the commands of this folder and `more_commands`, module -> summary.

    With `only`, the other commands have a summary but no options, which saves the import of their modules.
    """
    parser = CommandParser(
        prog="mphdrr",
        description="Multi-pinhole SPECT: from the geometry workbook to projections to train on.",
        epilog="example: mphdrr demo --output out",
    )
    parser.add_argument("--version", action="version", version=f"mphDRR {VERSION}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True, parser_class=CommandParser)
    for module, summary in {**{f"{__name__}.{name}": text for name, text in COMMANDS.items()}, **more_commands}.items():
        name = module.rpartition(".")[2]
        if only in (None, name):
            import_module(module).add_parser(commands)
        else:
            commands.add_parser(name, help=summary)
    return parser


def main(argv: Sequence[str] | None = None, more_commands: Mapping[str, str] = MappingProxyType({})) -> int:
    """Run one command line and return its exit status: 0, 1 (error in the user's input), 2 (usage) or 130 (interrupted)."""
    if sys.stderr is None:  # closed by the shell (2>&-); what is printed there would go to the output
        sys.stderr = io.StringIO()
    if sys.stdout is None:
        return _fail("output: it is closed (>&-); expected an open one, such as > FILE", INPUT_ERROR)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal of ASCII has no µ, ° or …
    try:
        status = _run_command(argv, more_commands)
        sys.stdout.flush()
        return status
    except (KeyboardInterrupt, Cancelled):
        return _fail("cancelled; no file is left half-written", INTERRUPTED)
    except OSError as error:
        if error.filename is None:
            with contextlib.suppress(OSError):
                sys.stdout.close()  # else Python would report the error once more at its end
        if isinstance(error, BrokenPipeError):  # the reading program, such as `head`, has closed the pipe
            return OK
        return _fail(f"{error.filename or 'output'}: {error.strerror or error}", INPUT_ERROR)


def _run_command(argv: Sequence[str] | None, more_commands: Mapping[str, str]) -> int:
    """Run one command line and return its exit status; the shell's completion is answered instead if it asks for words."""
    try:
        completed_words = os.environ.get("COMP_LINE", "").split()[1:] if "_ARGCOMPLETE" in os.environ else None
        words = completed_words or (sys.argv[1:] if argv is None else argv)
        parser = build_parser(more_commands, next(iter(words), ""))
        if completed_words is not None:  # a shell asks which words may follow
            import argcomplete

            argcomplete.autocomplete(parser)
        arguments = parser.parse_args(words)
    except SystemExit as exit_request:  # --help, --version and usage errors
        return exit_request.code if isinstance(exit_request.code, int) else USAGE
    with warnings.catch_warnings():
        warnings.simplefilter("always", InputWarning)
        warnings.showwarning = _show_warning
        try:
            with keeping_inputs(), reporting(getattr(arguments, "quiet", False)):
                arguments.run(arguments)
        except InputError as error:
            return _fail(str(error), INPUT_ERROR)
        except MemoryError:
            return _fail("not enough memory: choose fewer voxels or pixels", INPUT_ERROR)
    return OK


def _fail(message: str, status: int) -> int:
    """Print a message on standard error and return the status."""
    say(message)
    return status


def _show_warning(message: Warning | str, category: type[Warning], *_: Any, **__: Any) -> None:
    """Print an `InputWarning` as a line on standard error; other warnings are dropped."""
    if issubclass(category, InputWarning):
        say(f"warning: {message}")
