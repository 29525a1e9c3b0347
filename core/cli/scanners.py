"""Options that name the scanner of a workbook, and reading of that scanner."""

import argparse

from ... import core as mph
from ..geometry.scanner import Scanner
from ..geometry.system import chosen_modules as chosen_modules
from ..scanner_kinds import SCANNERS


def add_workbook(parser: argparse.ArgumentParser, name: str = "workbook", default: str | None = None) -> None:
    """Add the options of a geometry workbook, for `read_any_scanner` or `read_pinhole_system`.

    The workbook is a positional argument, or the option `name` with a default.
    """
    option = {} if name == "workbook" else {"default": default, "dest": "workbook"}
    parser.add_argument(name, metavar="FILE", help="geometry workbook (.xlsx, .xlsm)", **option)  # type: ignore[arg-type]
    text = "columns of the workbook, if its headings are not understood; geometry show --write-columns makes a draft"
    parser.add_argument("--columns", metavar="MAP", help=f"column map (.toml): {text}")
    text = f"kind of scanner in a workbook that holds several: {', '.join(SCANNERS)}; default: the first that it holds"
    parser.add_argument("--scanner-kind", choices=SCANNERS, metavar="KIND", help=text)


def chosen_kind(arguments: argparse.Namespace) -> str:
    """Return the kind of scanner that the options of `add_workbook` ask for, by default the first kind in the workbook."""
    kinds = () if arguments.scanner_kind or arguments.columns else mph.kinds_in(arguments.workbook)
    return arguments.scanner_kind or next(iter(kinds), mph.PinholeSystem.kind)


def read_any_scanner(arguments: argparse.Namespace) -> Scanner:
    """Read the scanner of the workbook named by the options of `add_workbook`, whatever its kind."""
    return mph.read_scanner(arguments.workbook, chosen_kind(arguments), arguments.columns)


def read_pinhole_system(arguments: argparse.Namespace) -> mph.PinholeSystem:
    """Read the pinhole scanner of the workbook named by the options of `add_workbook`; refuse another kind."""
    system = read_any_scanner(arguments)
    if not isinstance(system, mph.PinholeSystem):
        problem = f"its scanner is of the kind {system.kind}"
        raise mph.InputError(f"{arguments.workbook}: {problem}, expected one with pinholes")
    return system
