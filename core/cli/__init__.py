"""The command line without Blender: parsing, exit status and one-line errors.

A command is a module here with ``add_parser(subparsers)``, which sets the default ``run`` to a function of the parsed
arguments. `addon.cli` adds those that need Blender.
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
from ..progress import Cancelled
from ..version import VERSION
from .options import COMMANDS, NotingStore, say

OK, INPUT_ERROR, USAGE, INTERRUPTED = 0, 1, 2, 130


class _Parser(argparse.ArgumentParser):
    """An argument parser whose errors are one line on standard error, with status 2, and that notes what was typed."""

    def __init__(self, *arguments: Any, **details: Any) -> None:
        super().__init__(*arguments, **details)
        for name in (None, "store"):
            self.register("action", name, NotingStore)

    def _print_message(self, message: str, file: Any = None) -> None:
        (file or sys.stderr).write(message)  # argparse would not say that it cannot be written

    def error(self, message: str) -> NoReturn:
        sys.stderr.write(f"{self.prog}: {message} (see {self.prog} --help)\n")
        raise SystemExit(USAGE)


def build_parser(more_commands: Mapping[str, str] = MappingProxyType({}), only: str | None = None) -> _Parser:
    """The parser of ``mphdrr``: commands by their modules, these and others; options of all, or of `only` one."""
    parser = _Parser(
        prog="mphdrr",
        description="Multi-pinhole SPECT: from the geometry workbook to projections to train on.",
        epilog="example: mphdrr demo --output out",
    )
    parser.add_argument("--version", action="version", version=f"mphDRR {VERSION}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True, parser_class=_Parser)
    for module, summary in {**{f"{__name__}.{name}": text for name, text in COMMANDS.items()}, **more_commands}.items():
        name = module.rpartition(".")[2]
        if only in (None, name):
            import_module(module).add_parser(commands)
        else:
            commands.add_parser(name, help=summary)
    return parser


def main(argv: Sequence[str] | None = None, more_commands: Mapping[str, str] = MappingProxyType({})) -> int:
    """Run one command line and return its exit status: 0, 1 (the user's input), 2 (usage) or 130 (interrupted)."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal of ASCII has no µ, ° or …
    try:
        status = _status(argv, more_commands)
        sys.stdout.flush()
        return status
    except (KeyboardInterrupt, Cancelled):
        return _fail("cancelled; no file is left half-written", INTERRUPTED)
    except OSError as error:
        if error.filename is None:
            with contextlib.suppress(OSError):
                sys.stdout.close()  # Python would say it once more when it ends
        if isinstance(error, BrokenPipeError):  # the reader, such as `head`, has had enough
            return OK
        return _fail(f"{error.filename or 'output'}: {error.strerror or error}", INPUT_ERROR)


def _status(argv: Sequence[str] | None, more_commands: Mapping[str, str]) -> int:
    try:
        asked = os.environ.get("COMP_LINE", "").split()[1:] if "_ARGCOMPLETE" in os.environ else None
        words = asked or (sys.argv[1:] if argv is None else argv)
        parser = build_parser(more_commands, next(iter(words), ""))
        if asked is not None:  # by a shell, for what may follow
            import argcomplete

            argcomplete.autocomplete(parser)
        arguments = parser.parse_args(words)
    except SystemExit as stop:  # --help, --version and usage errors
        return stop.code if isinstance(stop.code, int) else USAGE
    with warnings.catch_warnings():
        warnings.simplefilter("always", InputWarning)
        warnings.showwarning = _show_warning
        try:
            arguments.run(arguments)
        except InputError as error:
            return _fail(str(error), INPUT_ERROR)
        except MemoryError:
            return _fail("not enough memory: choose fewer voxels or pixels", INPUT_ERROR)
    return OK


def _fail(message: str, status: int) -> int:
    say(message)
    return status


def _show_warning(message: Warning | str, category: type[Warning], *_: Any, **__: Any) -> None:
    if issubclass(category, InputWarning):
        say(f"warning: {message}")
