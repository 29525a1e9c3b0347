"""Options and reading of the scanner of a workbook."""

import argparse

from ... import core as mph
from ..geometry.scanner import Scanner
from ..geometry.system import chosen_modules as chosen_modules
from ..scanner_kinds import SCANNERS


def add_workbook(parser: argparse.ArgumentParser, name: str = "workbook", default: str | None = None) -> None:
    """The geometry workbook, for `read_workbook`; `name` may be that of an option, with a default."""
    option = {} if name == "workbook" else {"default": default, "dest": "workbook"}
    parser.add_argument(name, metavar="FILE", help="geometry workbook (.xlsx, .xlsm)", **option)  # type: ignore[arg-type]
    text = "which cells hold what, where the headings do not say it; geometry show --write-columns makes a draft"
    parser.add_argument("--columns", metavar="MAP", help=f"column map (.toml): {text}")
    kinds = "kind of the scanner, of a workbook that holds several; default: the first that it holds"
    parser.add_argument("--scanner-kind", choices=SCANNERS, metavar="KIND", help=f"{kinds}, of {', '.join(SCANNERS)}")


def kind_of(arguments: argparse.Namespace) -> str:
    """The kind of scanner that the options of `add_workbook` ask for."""
    found = () if arguments.scanner_kind or arguments.columns else mph.kinds_in(arguments.workbook)
    return arguments.scanner_kind or next(iter(found), mph.PinholeSystem.kind)


def read_any(arguments: argparse.Namespace) -> Scanner:
    """The scanner of the workbook of `add_workbook`, of any kind."""
    return mph.read_scanner(arguments.workbook, kind_of(arguments), arguments.columns)


def read_workbook(arguments: argparse.Namespace) -> mph.PinholeSystem:
    """The pinholes of the workbook of `add_workbook`; `InputError` of another kind of scanner."""
    system = read_any(arguments)
    if not isinstance(system, mph.PinholeSystem):
        found = f"its scanner is of the kind {system.kind}"
        raise mph.InputError(f"{arguments.workbook}: {found}, expected one with pinholes")
    return system
