"""``mphdrr geometry set FILE -o OUT.xlsx``."""

import argparse
import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .... import core as mph
from ...errors import expecting
from ...geometry.columns import ANGLE_UNITS, Column
from ...geometry.frames import affine_matrix
from ...geometry.scanner import Scanner
from ...recording import recorded_warnings
from ...scanner_kinds import SCANNERS
from ..options import output_path, print_answer
from ..scanners import chosen_modules, read_any
from .arguments import add_action

_SHORT = {
    "pinhole_diameter": "diameter",
    "detector_side": "side",
    "detector_thickness": "thickness",
    "roi_radius": "roi",
}
_TYPES: dict[str, type] = {"whole": int, "text": str}
_METAVARS = {"length": "MM", "angle": "DEG", "text": "TEXT"}


def _options() -> dict[str, tuple[Column, ...]]:
    """Field -> its columns, of all kinds of scanners, that an option sets; l and the modules' places are another matter."""
    found: dict[str, tuple[Column, ...]] = {}
    for kind in SCANNERS.values():
        others = {kind.columns[name].field for name in kind.columns.position} | {"collimator_length"}
        found = {name: its for name, its in kind.columns.fields.items() if name not in others} | found
    return found


def add_parser(actions) -> None:  # type: ignore[no-untyped-def]
    """Add the action."""
    parser = add_action(actions, "set", _run)
    add = parser.add_argument
    add("-o", "--output", required=True, metavar="OUT", help="workbook to write; FILE itself is replaced")
    add("--modules", metavar="RANGE", help="those to change, such as 1-40 or 1-20,41; default: all")
    for name, its in _options().items():
        column, many = its[0], its[0].axis is not None
        letters = tuple(c.name.rpartition("_")[2].upper() for c in its)
        more: dict[str, Any] = {"type": _TYPES.get(column.kind, float)} | ({"nargs": len(its)} if many else {})
        if column.kind == "choice":
            more |= {"choices": column.choices, "type": lambda text, column=column: column.parse(text) or text}
        else:
            more["metavar"] = letters if many else _METAVARS.get(column.kind, "N")
        what = ", ".join(dict.fromkeys(c.help for c in its)) + "; degrees" * (column.kind == "angle")
        add(f"--{_option(name)}", dest=name, help=what, **more)
    length = (
        "l, collimator length, or 'design' for the design formula's; default: those that follow the formula go on "
        "following it, the others stay"
    )
    add("--length", metavar="MM", help=length)
    add("--move", type=float, nargs=3, metavar=("X", "Y", "Z"), help="shift of the modules, mm")
    add("--remove", metavar="RANGE", help="modules to take out")
    add("--order", metavar="N,N,...", help="the modules' numbers in the order they are to have")
    columns = "with --columns, also write the column map (.toml) of the new workbook"
    add("--write-columns", metavar="MAP", help=columns)


def _option(name: str) -> str:
    """The option of a field."""
    return _SHORT.get(name, name.replace("_", "-"))


def _run(arguments: argparse.Namespace) -> None:
    """Change a workbook's numbers and keep all the rest of it.

    mphdrr geometry set scanner.xlsx --modules 1-20 --diameter 2 -o thinner.xlsx
    """
    target = output_path(arguments.output, (".xlsx", ".xlsm"))
    if arguments.write_columns is not None and arguments.columns is None:
        raise mph.InputError("--write-columns: the workbook is read by its headings, expected it with --columns")
    map_path = None if arguments.write_columns is None else output_path(arguments.write_columns, (".toml",))
    with recorded_warnings() as messages:
        system = _changed(read_any(arguments), arguments)
        written = mph.write_system(system, target, template=arguments.workbook)
    if map_path is not None and written.columns is not None:
        written.columns.write(map_path)
    answer = {**dataclasses.asdict(written), "path": str(written.path), "warnings": messages}
    cleared = f", {len(written.cleared)} without a value" if written.cleared else ""
    text = f"{written.path}: {len(written.changed)} cells changed, {len(written.recalculated)} recalculated{cleared}"
    print_answer(arguments, answer, [text], [f"warning: {message}" for message in messages])


def _changed(system: Scanner, arguments: argparse.Namespace) -> Scanner:
    chosen = np.isin(system.numbers, chosen_modules(system, arguments.modules).numbers)
    changes: dict[str, Any] = {}
    for name, columns in _options().items():
        given = getattr(arguments, name)
        if given is not None:
            if name not in system.columns.fields:
                raise mph.InputError(f"--{_option(name)}: is no column of a {system.kind} scanner")
            value = np.multiply(given, ANGLE_UNITS["deg"]) if columns[0].kind == "angle" else given
            mask = chosen if columns[0].axis is None else chosen[:, None]
            changes[name] = np.where(mask, value, getattr(system, name))
    if isinstance(system, mph.PinholeSystem):
        system = _with_lengths(system, arguments, chosen, changes)
    else:
        system = _moved(system, arguments, chosen, changes)
    if arguments.remove is not None:
        removed = np.isin(system.numbers, chosen_modules(system, arguments.remove, "--remove").numbers)
        if removed.all():
            raise mph.InputError(f"--remove {arguments.remove!r}: are all modules, expected at least one to be left")
        system = system[~removed]
    if arguments.order is None:
        return system
    index = {str(number): i for i, number in enumerate(system.numbers)}
    wanted = [part.strip() for part in arguments.order.split(",")]
    if sorted(wanted) != sorted(index):
        raise mph.InputError(f"--order: expected each of the modules' {len(index)} numbers once, got {len(wanted)}")
    return system[np.array([index[number] for number in wanted])]


def _moved(
    system: Scanner, arguments: argparse.Namespace, chosen: NDArray[np.bool_], changes: dict[str, Any]
) -> Scanner:
    """Modules of any kind with these changes, the chosen ones shifted."""
    if arguments.length is not None:
        raise mph.InputError("--length: only pinhole modules have a collimator")
    if arguments.move is not None:
        shifted = affine_matrix(np.eye(3), arguments.move) @ system.poses()
        for name, values in system.attributes_at(shifted).items():
            changes[name] = np.where(chosen[:, None], values, getattr(system, name))
    return system.replace(**changes)


def _with_lengths(
    system: mph.PinholeSystem, arguments: argparse.Namespace, chosen: NDArray[np.bool_], changes: dict[str, Any]
) -> mph.PinholeSystem:
    """Pinhole modules with these changes, and collimator lengths that follow or are given."""
    if arguments.move is not None:
        changes["centers"] = np.where(chosen[:, None], system.centers + arguments.move, system.centers)
    length = mph.PinholeSystem.columns["l"]
    follows = length.is_default(system)
    if arguments.length is not None:
        follows = np.where(chosen, arguments.length == "design", follows)
    if arguments.length not in (None, "design"):
        with expecting(f"--length {arguments.length!r}: expected millimetres or 'design'"):
            changes["collimator_length"] = np.where(chosen, float(arguments.length), system.collimator_length)
    system = system.replace(**changes)
    # Lengths that are the formula's to 1e-9 stay as they are, to the last digit.
    others = follows & ~length.is_default(system)
    lengths = np.where(others, length.default(system.columns.needed_values(system)), system.collimator_length)
    return system.replace(collimator_length=lengths)
