"""``mphdrr geometry show FILE``."""

import argparse
from typing import Any

import numpy as np

from .... import core as mph
from ...arrays import table_rows
from ...geometry.scanner import Scanner
from ..options import output_path, print_answer
from ..scanners import chosen_modules, kind_of, read_any
from .arguments import add_action


def add_parser(actions) -> None:  # type: ignore[no-untyped-def]
    """Add the action."""
    parser = add_action(actions, "show", _run)
    add = parser.add_argument
    add("--modules", metavar="RANGE", help="such as 1-40 or 1-20,41; default: all")
    columns = "instead, write a column map (.toml) of what was seen, for you to check"
    add("--write-columns", metavar="MAP", help=columns)


def _run(arguments: argparse.Namespace) -> None:
    """Print every module's numbers.

    mphdrr geometry show scanner.xlsx --modules 1-20
    """
    if arguments.write_columns is not None:
        _write_columns(arguments)
        return
    system = read_any(arguments)
    if not isinstance(system, mph.PinholeSystem):
        _show_columns(arguments, system)
        return
    chosen = set(chosen_modules(system, arguments.modules).numbers.tolist())
    rows = [row for row in _rows(system) if row["number"] in chosen]  # rings are those of the whole scanner
    heading = (
        " module  ring        x        y        z        b        l   azimuth elevation     d     Ld     Td      R"
    )
    line = (
        "{number:7d} {ring:5d} {x:8.2f} {y:8.2f} {z:8.2f} {b:8.2f} {l:8.3f} {azimuth:9.4f} {elevation:9.4f} "
        "{d:5.2f} {Ld:6.2f} {Td:6.2f} {R:6.2f}"
    )
    more = _shown(system)
    width = {name: max(map(len, (name, *texts))) for name, texts in more.items()}
    heading += "".join(f" {name:>{width[name]}}" for name in more)
    ends = {
        number: "".join(f" {texts[i]:>{width[name]}}" for name, texts in more.items())
        for i, number in enumerate(system.numbers.tolist())
    }
    units = [f", {name} in {system.columns[name].unit}" for name in more if system.columns[name].unit]
    footer = "lengths in mm, angles in radians" + "".join(units)
    lines = [heading, *(line.format(**row) + ends[row["number"]] for row in rows), footer]
    print_answer(arguments, {"modules": rows, "units": "mm, radians"}, lines)


def _show_columns(arguments: argparse.Namespace, system: Scanner) -> None:
    """Print the columns of modules of any kind, as its table has them."""
    chosen = chosen_modules(system, arguments.modules)
    rings = system.rings()[np.isin(system.numbers, chosen.numbers)] + 1  # those of the whole scanner
    own = {name: column for name, column in chosen.columns.items() if not column.is_unused(chosen)}
    columns = {"number": chosen.numbers, "ring": rings, **{name: column.values(chosen) for name, column in own.items()}}
    texts = {name: list(map(own[name].number_of if name in own else str, columns[name].tolist())) for name in columns}
    width = {name: max(map(len, (name, *its))) for name, its in texts.items()}
    rows = [tuple(texts), *zip(*texts.values(), strict=True)]
    lines = [" ".join(f"{text:>{width[name]}}" for name, text in zip(texts, row, strict=True)) for row in rows]
    answer = {"modules": table_rows(columns), "units": "mm, radians"}
    print_answer(arguments, answer, [*lines, "lengths in mm"])


def _write_columns(arguments: argparse.Namespace) -> None:
    path = output_path(arguments.write_columns, (".toml",))
    if arguments.columns is not None:
        raise mph.InputError("--write-columns writes what the headings say, expected it without --columns")
    draft = mph.draft_column_map(arguments.workbook, kind_of(arguments))
    draft.write(path)
    then = f"check it, then: geometry show {arguments.workbook} --columns {path}"
    lines = [f"{path}: {len(draft.questions)} to be settled; {then}"]
    notes = [f"to be settled: {question}" for question in draft.questions]
    print_answer(arguments, {"path": str(path), "open": draft.questions}, lines, notes)


def _rows(system: mph.PinholeSystem) -> list[dict[str, Any]]:
    positions = dict(zip("xyz", system.centers.T, strict=True))
    columns = {"number": system.numbers, "ring": system.rings() + 1, **positions}
    declared = system.columns
    names = dict.fromkeys(("b", "l", "azimuth", "elevation", *declared.dimensions, *declared.optional))
    return table_rows({**columns, **{name: declared[name].values(system) for name in names}})


def _shown(system: mph.PinholeSystem) -> dict[str, list[str]]:
    """The texts of the columns that modules may have, and that some have: column -> a text for each module."""
    declared = system.columns
    more = [declared[name] for name in declared.optional if name != "l" and not declared[name].is_unused(system)]
    return {c.name: [c.number_of(value) for value in c.values(system).tolist()] for c in more}
