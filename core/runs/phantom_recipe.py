"""The phantom of a recipe: its numbers, its pose and the grid under it."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..geometry.frames import euler_pose
from ..geometry.grid import Grid
from ..phantoms.kinds import KINDS
from ..phantoms.language import parse_phantom, read_phantom
from ..phantoms.phantom import Phantom
from .recipe import Recipe

_SAME_POSE = 1e-5  # mm; Blender's matrices are float32


def recipe_phantom(recipe: Recipe) -> Phantom:
    """The phantom that a recipe describes; `InputError` where it cannot be so, or its file cannot be read."""
    if recipe["phantom.file"] is not None:
        return read_phantom(recipe["phantom.file"])
    if recipe["phantom.text"] is not None:
        return parse_phantom(recipe["phantom.text"])
    (kind,) = (kind for kind in KINDS if kind.name == recipe["phantom.kind"])
    phantom: Phantom = kind.phantom(**{**kind.usual, **recipe.fields("phantom", kind.phantom)})
    return phantom


def phantom_pose(recipe: Recipe) -> NDArray[np.float64]:
    """World-from-phantom pose (4, 4), mm; `InputError` where matrix and position with angles are given and disagree."""
    phi, theta, psi = np.deg2rad(recipe["phantom.euler_degrees"])
    pose = euler_pose(phi, theta, psi, recipe["phantom.position"])
    if recipe["phantom.matrix"] is None:
        return pose
    matrix = np.array(recipe["phantom.matrix"])
    placed = "phantom.position" in recipe.given or "phantom.euler_degrees" in recipe.given
    if placed and not np.allclose(matrix, pose, rtol=0, atol=_SAME_POSE):
        raise InputError("phantom.matrix: it is another pose than that of phantom.position and phantom.euler_degrees")
    return matrix


def phantom_grid(recipe: Recipe, phantom: Phantom, pose: NDArray[np.float64]) -> Grid:
    """The grid on which the phantom becomes a volume; the default spacing holds it however it is turned."""
    n_x, n_y, n_z = np.broadcast_to(recipe["phantom.voxels"], 3).tolist()
    # Where no spacing is given, a voxel is kept free all around.
    spacing = np.broadcast_to(recipe["phantom.spacing"] or phantom.extent / max(1, min(n_x, n_y, n_z) - 2), 3)
    if not recipe["phantom.turn_grid"]:
        return Grid.centered((n_x, n_y, n_z), spacing, pose[:3, 3])
    low, high = phantom.box
    own = Grid.centered((n_x, n_y, n_z), spacing, (low + high) / 2)
    return Grid(own.shape, pose @ own.affine)


def with_phantom(recipe: Recipe, phantom: Phantom, pose: NDArray[np.float64]) -> Recipe:
    """The recipe with all that describes the phantom: the numbers of its kind, and its pose as matrix and angles."""
    values: dict[str, Any] = {"matrix": pose.tolist(), "voxels": recipe["phantom.voxels"]}
    angles = euler_degrees(pose)
    if angles is not None:
        values |= {"position": pose[:3, 3].tolist(), "euler_degrees": angles}
    for kind in KINDS:
        if type(phantom) is kind.phantom:
            cls: Any = kind.phantom
            values |= {"kind": kind.name}
            values |= {f.name: getattr(phantom, f.name) for f in dataclasses.fields(cls) if f.init}
    return recipe.updated({f"phantom.{name}": value for name, value in values.items()})


def euler_degrees(pose: NDArray[np.float64]) -> list[float] | None:
    """Angles phi, theta, psi with which `euler_pose` turns as `pose` does; None where it does more than turn and move."""
    turn = pose[:3, :3]
    if not np.allclose(turn @ turn.T, np.eye(3), rtol=0, atol=1e-6) or np.linalg.det(turn) < 0:
        return None
    theta = math.atan2(math.hypot(turn[0, 2], turn[1, 2]), turn[2, 2])
    if math.sin(theta) < 1e-9:  # both others turn about z: phi takes it all
        phi, psi = math.atan2(turn[1, 0] * turn[2, 2], turn[1, 1]), 0.0
    else:
        phi, psi = math.atan2(turn[1, 2], turn[0, 2]), math.atan2(turn[2, 1], -turn[2, 0])
    return [math.degrees(angle) for angle in (phi, theta, psi)]
