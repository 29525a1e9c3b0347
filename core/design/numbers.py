"""The numbers that all objectives and penalties depend on: one row for each module, and derivatives by them.

A row holds the pinhole's centre (3), the frame's rows u, v, k (9), d, l and Ld: mm, but the frame. What a scanner is worth
is differentiated by these rows, and the rows by a design's free numbers.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from ..arrays import Floats
from ..geometry.system import PinholeSystem

STEPS = np.array([1e-5] * 3 + [1e-7] * 9 + [1e-5] * 3)
"""Steps of central differences (15,): mm, and shares of a unit vector, which a lever of 100 mm makes as long."""


def rows_of(system: PinholeSystem) -> Floats:
    """The modules' numbers (M, 15)."""
    sizes = system.pinhole_diameter, system.collimator_length, system.detector_side
    return np.column_stack([system.centers, system.frames().reshape(-1, 9), *sizes])


def parts_of(rows: Floats) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Centres (N, 3), frames (N, 3, 3), d, l and Ld (N,) of rows (N, 15)."""
    return rows[:, :3], rows[:, 3:12].reshape(-1, 3, 3), rows[:, 12], rows[:, 13], rows[:, 14]


def differences(function: Callable[[Floats], Floats], rows: Floats) -> Floats:
    """Derivatives (N, K, ...) of a row's results (N, ...) by its own numbers (N, K), K = 15 or a multiple of it.

    By central differences: what the room differentiates is smooth and cheap, and the error is about 1e-9 of the derivative.
    """
    steps = np.tile(STEPS, rows.shape[1] // len(STEPS))
    shifts = np.diag(steps)
    found = [(function(rows + shift) - function(rows - shift)) / (2 * shift.sum()) for shift in shifts]
    return np.stack(found, axis=1)


def row_gradient(gradient: Any, shape: tuple[int, int]) -> Floats:
    """A projector's geometry gradient by rows (M, 15), for images (n_v, n_u) that cover the crystal: pitch = Ld / n."""
    by_side = gradient.pitch @ [1 / shape[1], 1 / shape[0]]
    sizes = gradient.pinhole_diameter, gradient.collimator_length, by_side
    return np.column_stack([gradient.centers, gradient.frames.reshape(-1, 9), *sizes])
