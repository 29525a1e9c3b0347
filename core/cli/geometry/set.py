"""Action ``mphdrr geometry set FILE -o OUT.xlsx``: a workbook with changed numbers."""

import argparse
import dataclasses
from typing import Any

import numpy as np

from .... import core as mph
from ...arrays import Bools
from ...errors import expecting
from ...geometry.columns import ANGLE_UNITS, Column
from ...geometry.frames import affine_matrix
from ...geometry.scanner import Scanner
from ...recording import recorded_warnings
from ...scanner_kinds import SCANNERS
from ..options import output_path, print_answer
from ..scanners import chosen_modules, read_any_scanner
from .arguments import add_action

_SHORT_NAMES = {
    "pinhole_diameter": "diameter",
    "detector_side": "side",
    "detector_thickness": "thickness",
    "roi_radius": "roi",
}
_TYPES: dict[str, type] = {"whole": int, "text": str}
_METAVARS = {"length": "MM", "angle": "DEG", "text": "TEXT"}


def _settable_columns() -> dict[str, tuple[Column, ...]]:
    """Return field -> its columns, over all kinds of scanners, of the fields that have an option of their own.

    Positions, which --move changes, and l have none.
    """
    settable: dict[str, tuple[Column, ...]] = {}
    for kind in SCANNERS.values():
        excluded = {kind.columns[name].field for name in kind.columns.position} | {"collimator_length"}
        settable = {name: columns for name, columns in kind.columns.fields.items() if name not in excluded} | settable
    return settable


def add_parser(actions) -> None:  # type: ignore[no-untyped-def]
    """Add the action ``geometry set``."""
    add = add_action(actions, "set", _run).add_argument
    add("-o", "--output", required=True, metavar="OUT", help="workbook to write; if it is FILE, that is replaced")
    add("--modules", metavar="RANGE", help="modules to change, such as 1-40 or 1-20,41; default: all")
    for name, columns in _settable_columns().items():
        column, is_vector = columns[0], columns[0].axis is not None
        letters = tuple(c.name.rpartition("_")[2].upper() for c in columns)
        extra: Any = {"type": _TYPES.get(column.kind, float)} | ({"nargs": len(columns)} if is_vector else {})
        if column.kind == "choice":
            extra |= {"choices": column.choices, "type": lambda text, column=column: column.parse(text) or text}
        else:
            extra["metavar"] = letters if is_vector else _METAVARS.get(column.kind, "N")
        help_text = ", ".join(dict.fromkeys(c.help for c in columns)) + "; degrees" * (column.kind == "angle")
        add(f"--{_option_name(name)}", dest=name, help=help_text, **extra)
    length = "collimator length, or 'design' for the design formula's; default: as it was, or the formula's if it was"
    add("--length", metavar="MM", help=length)
    add("--move", type=float, nargs=3, metavar=("X", "Y", "Z"), help="shift of the modules, mm")
    add("--remove", metavar="RANGE", help="modules to remove")
    add("--order", metavar="N,N,...", help="the modules' numbers in the new order of their rows")
    add("--write-columns", metavar="MAP", help="with --columns, also write the column map (.toml) of the new workbook")


def _option_name(name: str) -> str:
    """Return the name of a field's option, without the dashes."""
    return _SHORT_NAMES.get(name, name.replace("_", "-"))


def _run(arguments: argparse.Namespace) -> None:
    """Change numbers in a workbook and keep everything else in it.

    mphdrr geometry set scanner.xlsx --modules 1-20 --diameter 2 -o thinner.xlsx
    """
    target = output_path(arguments.output, (".xlsx", ".xlsm"), is_new=False)
    if arguments.write_columns is not None and arguments.columns is None:
        raise mph.InputError("--write-columns: the workbook is read by its headings, expected it with --columns")
    map_path = None if arguments.write_columns is None else output_path(arguments.write_columns, (".toml",))
    with recorded_warnings() as messages:
        system = _change_system(read_any_scanner(arguments), arguments)
        written = mph.write_system(system, target, template=arguments.workbook)
    if map_path is not None and written.columns is not None:
        written.columns.write(map_path)
    answer = {**dataclasses.asdict(written), "path": str(written.path), "warnings": messages}
    cleared = f", {len(written.cleared)} without a value" if written.cleared else ""
    text = f"{written.path}: {len(written.changed)} cells changed, {len(written.recalculated)} recalculated{cleared}"
    print_answer(arguments, answer, [text], [f"warning: {message}" for message in messages])


def _change_system(system: Scanner, arguments: argparse.Namespace) -> Scanner:
    """Return the scanner with the changes that the options ask for."""
    chosen = np.isin(system.numbers, chosen_modules(system, arguments.modules).numbers)
    changes: dict[str, Any] = {}
    for name, columns in _settable_columns().items():
        if (values := getattr(arguments, name)) is not None:
            if name not in system.columns.fields:
                raise mph.InputError(f"--{_option_name(name)}: is no column of a {system.kind} scanner")
            value = np.multiply(values, ANGLE_UNITS["deg"]) if columns[0].kind == "angle" else values
            mask = chosen if columns[0].axis is None else chosen[:, None]
            changes[name] = np.where(mask, value, getattr(system, name))
    if isinstance(system, mph.PinholeSystem):
        system = _change_pinholes(system, arguments, chosen, changes)
    else:
        system = _change_modules(system, arguments, chosen, changes)
    if arguments.remove is not None:
        removed = np.isin(system.numbers, chosen_modules(system, arguments.remove, "--remove").numbers)
        if removed.all():
            raise mph.InputError(f"--remove {arguments.remove!r}: are all modules, expected at least one to be left")
        system = system[~removed]
    if arguments.order is None:
        return system
    index = {str(number): i for i, number in enumerate(system.numbers)}
    numbers = [text.strip() for text in arguments.order.split(",")]
    if sorted(numbers) != sorted(index):
        raise mph.InputError(f"--order: expected each of the modules' {len(index)} numbers once, got {len(numbers)}")
    return system[np.array([index[number] for number in numbers])]


def _change_modules(system: Scanner, arguments: argparse.Namespace, chosen: Bools, changes: dict[str, Any]) -> Scanner:
    """Return modules of any kind with these changes of fields, the chosen ones (M,) shifted."""
    if arguments.length is not None:
        raise mph.InputError("--length: only pinhole modules have a collimator")
    if arguments.move is not None:
        shifted = affine_matrix(np.eye(3), arguments.move) @ system.poses()
        for name, values in system.attributes_at(shifted).items():
            changes[name] = np.where(chosen[:, None], values, getattr(system, name))
    return system.replace(**changes)


def _change_pinholes(
    system: mph.PinholeSystem, arguments: argparse.Namespace, chosen: Bools, changes: dict[str, Any]
) -> mph.PinholeSystem:
    """Return pinhole modules with these changes of fields, the chosen ones (M,) shifted, and with their collimator lengths.

    A module's length is the one typed; else it stays, or is the design formula's if it was that before.
    """
    if arguments.move is not None:
        changes["centers"] = np.where(chosen[:, None], system.centers + arguments.move, system.centers)
    definition = mph.PinholeSystem.columns["l"]
    follows_formula = definition.is_default(system)
    if arguments.length is not None:
        follows_formula = np.where(chosen, arguments.length == "design", follows_formula)
    if arguments.length not in (None, "design"):
        with expecting(f"--length {arguments.length!r}: expected millimetres or 'design'"):
            changes["collimator_length"] = np.where(chosen, float(arguments.length), system.collimator_length)
    system = system.replace(**changes)
    # Lengths that are the formula's to 1e-9 stay as they are, to the last digit.
    changed = follows_formula & ~definition.is_default(system)
    lengths = np.where(changed, definition.default(system.columns.needed_values(system)), system.collimator_length)
    return system.replace(collimator_length=lengths)
