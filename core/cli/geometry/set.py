"""``mphdrr geometry set FILE -o OUT.xlsx``."""

import argparse
import dataclasses
from typing import Any

import numpy as np

from ...errors import InputError
from ...geometry.system import LENGTHS, PinholeSystem
from ...recording import recorded_warnings
from ...workbook import write_system
from ...workbook.quantities import QUANTITIES, needed_numbers
from ..options import chosen_modules, output_path, print_answer, read_workbook
from .arguments import add_action

_SHORT = {
    "pinhole_diameter": "diameter",
    "detector_side": "side",
    "detector_thickness": "thickness",
    "roi_radius": "roi",
}
_DIMENSIONS = {_SHORT.get(name, name.replace("_", "-")): name for name in LENGTHS if name != "collimator_length"}
"""Option -> field; l is another matter."""


def add_parser(actions) -> None:  # type: ignore[no-untyped-def]
    """Add the action."""
    parser = add_action(actions, "set", _run)
    add = parser.add_argument
    add("-o", "--output", required=True, metavar="OUT", help="workbook to write; FILE itself is replaced")
    add("--modules", metavar="RANGE", help="those to change, such as 1-40 or 1-20,41; default: all")
    for option, name in _DIMENSIONS.items():
        add(f"--{option}", type=float, metavar="MM", help=LENGTHS[name])
    length = (
        "l, collimator length, or 'design' for the design formula's; default: those that follow the formula go on "
        "following it, the others stay"
    )
    add("--length", metavar="MM", help=length)
    add("--move", type=float, nargs=3, metavar=("X", "Y", "Z"), help="shift of the pinholes, mm")
    add("--remove", metavar="RANGE", help="modules to take out")
    add("--order", metavar="N,N,...", help="the modules' numbers in the order they are to have")
    columns = "with --columns, also write the column map (.toml) of the new workbook"
    add("--write-columns", metavar="MAP", help=columns)


def _run(arguments: argparse.Namespace) -> None:
    """Change a workbook's numbers and keep all the rest of it.

    mphdrr geometry set scanner.xlsx --modules 1-20 --diameter 2 -o thinner.xlsx
    """
    target = output_path(arguments.output, (".xlsx", ".xlsm"))
    if arguments.write_columns is not None and arguments.columns is None:
        raise InputError("--write-columns: the workbook is read by its headings, expected it with --columns")
    map_path = None if arguments.write_columns is None else output_path(arguments.write_columns, (".toml",))
    with recorded_warnings() as messages:
        system = _changed(read_workbook(arguments), arguments)
        written = write_system(system, target, template=arguments.workbook)
    if map_path is not None and written.columns is not None:
        written.columns.write(map_path)
    answer = {**dataclasses.asdict(written), "path": str(written.path), "warnings": messages}
    cleared = f", {len(written.cleared)} without a value" if written.cleared else ""
    text = f"{written.path}: {len(written.changed)} cells changed, {len(written.recalculated)} recalculated{cleared}"
    print_answer(arguments, answer, [text], [f"warning: {message}" for message in messages])


def _changed(system: PinholeSystem, arguments: argparse.Namespace) -> PinholeSystem:
    chosen = np.isin(system.numbers, chosen_modules(system, arguments.modules).numbers)
    changes: dict[str, Any] = {}
    for option, name in _DIMENSIONS.items():
        number = getattr(arguments, option.replace("-", "_"))
        if number is not None:
            changes[name] = np.where(chosen, number, getattr(system, name))
    if arguments.move is not None:
        changes["centers"] = np.where(chosen[:, None], system.centers + arguments.move, system.centers)
    length = QUANTITIES["l"]
    follows = length.is_default(system)
    if arguments.length is not None:
        follows = np.where(chosen, arguments.length == "design", follows)
    if arguments.length not in (None, "design"):
        try:
            changes["collimator_length"] = np.where(chosen, float(arguments.length), system.collimator_length)
        except ValueError:
            raise InputError(f"--length {arguments.length!r}: expected millimetres or 'design'") from None
    system = dataclasses.replace(system, **changes)
    # Lengths that are the formula's to 1e-9 stay as they are, to the last digit.
    others = follows & ~length.is_default(system)
    lengths = np.where(others, length.default(needed_numbers(system)), system.collimator_length)
    system = dataclasses.replace(system, collimator_length=lengths)
    if arguments.remove is not None:
        removed = np.isin(system.numbers, chosen_modules(system, arguments.remove, "--remove").numbers)
        if removed.all():
            raise InputError(f"--remove {arguments.remove!r}: are all modules, expected at least one to be left")
        system = system[~removed]
    if arguments.order is None:
        return system
    index = {str(number): i for i, number in enumerate(system.numbers)}
    wanted = [part.strip() for part in arguments.order.split(",")]
    if sorted(wanted) != sorted(index):
        raise InputError(f"--order: expected each of the modules' {len(index)} numbers once, got {len(wanted)}")
    return system[np.array([index[number] for number in wanted])]
