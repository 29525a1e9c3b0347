"""Rows of module parameters, on which all objectives and penalties depend, and derivatives by them.

A row (15,) contains the pinhole's centre (3), the frame's unit vectors u, v, k (9), and d, l and L_d; all in mm, except the
frame. Objectives and penalties are differentiated by these rows, and the rows by a design's free parameters.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from ..arrays import Floats
from ..geometry.system import PinholeSystem

STEPS = np.array([1e-5] * 3 + [1e-7] * 9 + [1e-5] * 3)
"""Steps of central differences (15,): mm, and fractions of a unit vector, which at 100 mm distance move a point as far."""


def module_rows(system: PinholeSystem) -> Floats:
    """Return the rows of parameters (M, 15) of all modules."""
    sizes = system.pinhole_diameter, system.collimator_length, system.detector_side
    return np.column_stack([system.centers, system.frames().reshape(-1, 9), *sizes])


def split_rows(rows: Floats) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Return centres (N, 3), frames (N, 3, 3), and d, l and L_d (N,) of rows (N, 15)."""
    return rows[:, :3], rows[:, 3:12].reshape(-1, 3, 3), rows[:, 12], rows[:, 13], rows[:, 14]


def central_differences(function: Callable[[Floats], Floats], rows: Floats) -> Floats:
    """Return the derivatives (N, K, ...) of a function's result for each row (N, ...) by that row's K parameters.

    `rows` is (N, K), K = 15 or a multiple of it. The functions differentiated here are smooth and cheap, and the error of
    central differences is about 1e-9 of the derivative.
    """
    shifts = np.diag(np.tile(STEPS, rows.shape[1] // len(STEPS)))
    derivatives = [(function(rows + shift) - function(rows - shift)) / (2 * shift.sum()) for shift in shifts]
    return np.stack(derivatives, axis=1)


def row_gradient(gradient: Any, shape: tuple[int, int]) -> Floats:
    """Return a `GeometryGradient` as the gradient by rows (M, 15).

    The images of `shape` (n_v, n_u) cover the crystal: their pitch is L_d / n.
    """
    d_side = gradient.pitch @ [1 / shape[1], 1 / shape[0]]
    sizes = gradient.pinhole_diameter, gradient.collimator_length, d_side
    return np.column_stack([gradient.centers, gradient.frames.reshape(-1, 9), *sizes])
