"""Grid of voxels: shape, and affine matrix from index to world."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..arrays import ArrayLike, Floats
from ..validation import freeze, lengths, real_array, whole_shape
from .frames import affine_matrix, checked_affine, moved


@dataclass(frozen=True, eq=False)
class Grid:
    """Lattice of voxels.

    The affine matrix acts on column vectors, and an integer index is a voxel's CENTRE. Any invertible matrix is allowed: the
    grid may be rotated, sheared, anisotropic or mirrored.
    """

    shape: tuple[int, int, int]
    """Numbers of voxels (n_x, n_y, n_z) along the index axes."""
    affine: Floats
    """Matrix (4, 4) from index to world, mm."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "shape", whole_shape(self.shape, "grid shape", 3))
        object.__setattr__(self, "affine", freeze(checked_affine(self.affine, "grid affine")))

    @classmethod
    def centered(cls, shape: ArrayLike, spacing: ArrayLike, center: ArrayLike = (0.0, 0.0, 0.0)) -> Grid:
        """Return an axis-aligned grid with its middle at `center`, world mm.

        `shape`, in voxels, and `spacing`, in mm, are three numbers along x, y, z or one for all.
        """
        counts = whole_shape(np.broadcast_to(np.asarray(shape), 3) if np.ndim(shape) == 0 else shape, "grid shape", 3)
        spacing = lengths(spacing, "voxel spacing", 3)
        first = real_array(center, "grid centre", (3,)) - spacing * (np.array(counts) - 1) / 2
        return cls(counts, affine_matrix(np.diag(spacing), first))

    def box(self, start: ArrayLike, shape: tuple[int, ...]) -> Grid:
        """Return the grid of a box of `shape` voxels that begins at the index `start`; it may reach beyond this grid."""
        affine = self.affine.copy()
        affine[:3, 3] += affine[:3, :3] @ np.asarray(start)
        return Grid(shape, affine)  # type: ignore[arg-type]

    @property
    def spacing(self) -> Floats:
        """Voxel size (3,), mm, along each index axis."""
        return np.linalg.norm(self.affine[:3, :3], axis=0)

    @property
    def voxel_volume(self) -> float:
        """Volume of one voxel, mm^3."""
        return float(abs(np.linalg.det(self.affine[:3, :3])))

    @property
    def n_voxels(self) -> int:
        """Number of all voxels."""
        return int(np.prod(self.shape, dtype=object))

    @cached_property  # because every part of every image needs it
    def index_from_world(self) -> Floats:
        """Matrix (4, 4) from world, mm, to index, for column vectors."""
        return freeze(np.linalg.inv(self.affine))

    @property
    def center(self) -> Floats:
        """World point (3,), mm, of the grid's middle."""
        return (self.affine @ [*((np.array(self.shape) - 1) / 2), 1.0])[:3]

    def corners(self) -> Floats:
        """Return the world points (8, 3), mm, of the grid's outer corners, which are corners of voxels, not centres."""
        unit = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), axis=-1).reshape(8, 3)
        return moved(self.affine, unit * np.array(self.shape) - 0.5)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Grid):
            return NotImplemented
        return self.shape == other.shape and np.array_equal(self.affine, other.affine)

    def __hash__(self) -> int:
        return hash((self.shape, self.affine.tobytes()))


def same_grid(a: Grid, b: Grid) -> bool:
    """Return whether two grids have the same voxels within a thousandth of a voxel, which files may round away."""
    return a.shape == b.shape and bool(np.abs(a.corners() - b.corners()).max() <= 1e-3 * a.spacing.min())


def grid_around(points: Floats, spacing: float) -> Grid:
    """Return the axis-aligned grid of cubic voxels that holds world `points` (n, 3), mm, and half a voxel around them."""
    low, high = points.min(axis=0), points.max(axis=0)
    return Grid.centered(np.ceil((high - low) / spacing) + 2, spacing, (low + high) / 2)
