"""Whether the numbers of a workbook are possible, are like those of scanners, and agree with the formulas."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..geometry.design_formulas import collimator_length
from ..geometry.system import PinholeSystem
from .layout import Column
from .quantities import AGREEING, DIMENSIONS, POSITION, QUANTITIES, tolerance

_SAME_PLACE = 1e-6
"""mm; two pinholes closer than this are one."""
_SHOWN = 5
"""Warnings of one column; the last one counts the rest."""

Numbers = dict[str, NDArray[np.float64]]
"""Quantity -> its numbers (M,)."""


def refuse_impossible(columns: dict[str, Column], values: Numbers) -> None:
    """Raise `InputError` if no scanner can have the typed `values`, mm, naming the cell."""
    for name in DIMENSIONS:
        refuse_not_positive(columns[name], values[name])
    d, side, roi = values["d"], values["Ld"], values["R"]
    columns["d"].refuse(
        d >= side, lambda i: f"has d = {d[i]:g} mm, expected less than Ld = {side[i]:g} mm in {columns['Ld'].place(i)}"
    )
    x1, roi_column = columns["x1"], columns["R"]
    with np.errstate(over="ignore"):
        b = np.sqrt(sum(values[name] ** 2 for name in POSITION))
    puts = [f"and y1, z1 put the pinhole of module {number}" for number in x1.modules.module_numbers]
    x1.refuse(b == 0, lambda i: f"{puts[i]} at the isocentre, expected outside the ROI")
    x1.refuse(np.isinf(b), lambda i: f"{puts[i]} too far away to compute, expected millimetres")
    outside = "mm from the isocentre, expected outside the ROI of"
    x1.refuse(b <= roi, lambda i: f"{puts[i]} {b[i]:g} {outside} {roi[i]:g} mm in {roi_column.place(i)}")
    first: dict[tuple[int, ...], int] = {}
    for i, position in enumerate(zip(*(values[name] for name in POSITION), strict=True)):
        j = first.setdefault(tuple(round(x / _SAME_PLACE) for x in position), i)
        if j != i:
            raise InputError(
                f"{x1.where(i)} {puts[i]} at the place of module {x1.modules.module_numbers[j]} ({x1.place(j)}), expected "
                "another place"
            )


def refuse_not_positive(column: Column, values: NDArray[np.float64]) -> None:
    """Raise `InputError` if a length (M,), mm, is not positive."""
    column.refuse(values <= 0, lambda i: f"has {column.quantity} = {values[i]:g} mm, expected more than 0")


def is_by_design(system: PinholeSystem) -> NDArray[np.bool_]:
    """Which modules (M,) have the design formula's collimator length."""
    length = collimator_length(
        system.pinhole_distance, system.pinhole_diameter, system.detector_side, system.roi_radius
    )
    return np.abs(length - system.collimator_length) <= AGREEING * system.collimator_length


def implausible(system: PinholeSystem, columns: dict[str, Column]) -> Iterator[str]:
    """For each quantity, the first module whose number is unlike that of any scanner."""
    for name, quantity in QUANTITIES.items():
        low, high = quantity.plausible
        values = quantity.of(system)
        column = columns[name if name in columns and quantity.role != "derived" else "x1"]
        odd = np.flatnonzero((values < low) | (values > high))
        if len(odd):
            several = len(set(column.rows)) > 1 and len(odd) > 1
            more = f" (so it is for {len(odd) - 1} more modules)" if several else ""
            yield (
                f"{column.where(int(odd[0]))} makes {name} = {values[odd[0]]:.6g} mm{more}, which is unlikely, expected "
                f"{low:g} to {high:g} mm: are the units right?"
            )


def differences(
    column: Column, given: NDArray[np.float64], expected: NDArray[np.float64], slack: NDArray[np.float64] | float = 0.0
) -> Iterator[str]:
    """The first modules whose number `given` (M,) in the sheet, in its unit, is not as `expected` (M,), mm or rad.

    The tolerance is larger by `slack`, mm, for rounding of the numbers behind `expected`.
    """
    name, unit = column.quantity, column.unit
    expected, slack = expected / column.factor, np.broadcast_to(slack, given.shape) / column.factor
    difference = np.abs(given - expected)
    if QUANTITIES[name].kind == "angle":
        turn = 2 * math.pi / column.factor
        difference = np.abs((given - expected + turn / 2) % turn - turn / 2)
    differing = [
        int(i)
        for i in np.flatnonzero(np.isfinite(given))
        if difference[i] > tolerance(given[i], expected[i], unit) + slack[i]
    ]
    used = "the sheet's is used" if name == "l" else "the formula's is used"
    for n, i in enumerate(differing[:_SHOWN], start=1):
        more = f"; so do {len(differing) - _SHOWN} more cells of this column" if n == _SHOWN < len(differing) else ""
        yield (
            f"{column.where(i)} has {name} = {given[i]:.9g} {unit}, the formula gives {expected[i]:.9g} {unit} "
            f"({used}{more})"
        )
