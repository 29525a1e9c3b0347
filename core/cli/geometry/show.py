"""Action ``mphdrr geometry show FILE``: the modules' numbers, or a draft of a column map."""

import argparse
from typing import Any

import numpy as np

from .... import core as mph
from ...arrays import table_rows
from ...geometry.scanner import Scanner
from ..options import output_path, print_answer
from ..scanners import chosen_kind, chosen_modules, read_any_scanner
from .arguments import add_action


def add_parser(actions) -> None:  # type: ignore[no-untyped-def]
    """Add the action ``geometry show``."""
    add = add_action(actions, "show", _run).add_argument
    add("--modules", metavar="RANGE", help="modules to show, such as 1-40 or 1-20,41; default: all")
    add("--write-columns", metavar="MAP", help="instead, write a draft of a column map (.toml), for you to check")


def _run(arguments: argparse.Namespace) -> None:
    """Print the numbers of every module.

    mphdrr geometry show scanner.xlsx --modules 1-20
    """
    if arguments.write_columns is not None:
        _write_columns(arguments)
        return
    system = read_any_scanner(arguments)
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
    optional_texts = _optional_texts(system)
    widths = {name: max(map(len, (name, *texts))) for name, texts in optional_texts.items()}
    heading += "".join(f" {name:>{widths[name]}}" for name in optional_texts)
    ends = {
        number: "".join(f" {texts[i]:>{widths[name]}}" for name, texts in optional_texts.items())
        for i, number in enumerate(system.numbers.tolist())
    }
    units = [f", {name} in {system.columns[name].unit}" for name in optional_texts if system.columns[name].unit]
    footer = "lengths in mm, angles in radians" + "".join(units)
    lines = [heading, *(line.format(**row) + ends[row["number"]] for row in rows), footer]
    print_answer(arguments, {"modules": rows, "units": "mm, radians"}, lines)


def _show_columns(arguments: argparse.Namespace, system: Scanner) -> None:
    """Print the columns of modules of any kind, as their table of columns defines them."""
    chosen = chosen_modules(system, arguments.modules)
    rings = system.rings()[np.isin(system.numbers, chosen.numbers)] + 1  # those of the whole scanner
    used = {name: column for name, column in chosen.columns.items() if not column.is_unused(chosen)}
    columns = {"number": chosen.numbers, "ring": rings, **{name: c.values(chosen) for name, c in used.items()}}
    texts = {name: list(map(used[name].number_of if name in used else str, columns[name].tolist())) for name in columns}
    widths = {name: max(map(len, (name, *values))) for name, values in texts.items()}
    rows = [tuple(texts), *zip(*texts.values(), strict=True)]
    lines = [" ".join(f"{text:>{widths[name]}}" for name, text in zip(texts, row, strict=True)) for row in rows]
    answer = {"modules": table_rows(columns), "units": "mm, radians"}
    print_answer(arguments, answer, [*lines, "lengths in mm"])


def _write_columns(arguments: argparse.Namespace) -> None:
    """Write the draft of a column map and print its open questions."""
    path = output_path(arguments.write_columns, (".toml",))
    if arguments.columns is not None:
        raise mph.InputError("--write-columns writes what the headings say, expected it without --columns")
    draft = mph.draft_column_map(arguments.workbook, chosen_kind(arguments))
    draft.write(path)
    next_step = f"check it, then: geometry show {arguments.workbook} --columns {path}"
    lines = [f"{path}: {len(draft.questions)} to be settled; {next_step}"]
    notes = [f"to be settled: {question}" for question in draft.questions]
    print_answer(arguments, {"path": str(path), "open": draft.questions}, lines, notes)


def _rows(system: mph.PinholeSystem) -> list[dict[str, Any]]:
    """Return a row of numbers for each module: name -> value, lengths in mm, angles in rad."""
    positions = dict(zip("xyz", system.centers.T, strict=True))
    columns = {"number": system.numbers, "ring": system.rings() + 1, **positions}
    definitions = system.columns
    names = dict.fromkeys(("b", "l", "azimuth", "elevation", *definitions.dimensions, *definitions.optional))
    return table_rows({**columns, **{name: definitions[name].values(system) for name in names}})


def _optional_texts(system: mph.PinholeSystem) -> dict[str, list[str]]:
    """Return name -> texts (M,) of the optional columns, without l, in which a module's value is not a blank cell's."""
    table = system.columns
    used = [table[name] for name in table.optional if name != "l" and not table[name].is_unused(system)]
    return {c.name: [c.number_of(value) for value in c.values(system).tolist()] for c in used}
