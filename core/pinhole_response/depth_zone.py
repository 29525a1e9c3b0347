"""Geometry of a depth zone: the view's numbers, and the zone's planes, cells and pieces of voxels.

Whole numbers (of planes, cells, points along a voxel) and the places of the planes are the zone's lattice, which small
changes of the view leave as it is: the response is a smooth function of the view's numbers.
"""

import functools
from dataclasses import dataclass
from typing import NamedTuple, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..physics.crystal import share_inside
from .directional_effects import DirectionalEffects
from .pixel_kernels import KernelShape, Pair


class ViewNumbers(NamedTuple):
    """Numbers of a view that its response depends on, besides the photons' law. A gradient has the same fields."""

    to_camera: Array
    """(3, 4), from a voxel's index (x, y, z, 1) to its position along the module's u, v and k from the pinhole, mm."""
    length: float
    """Distance from the hole's plane to the image's, mm: collimator length plus mean depth of interaction."""
    diameter: float
    """Effective diameter of the hole, mm."""
    first: Array
    """(2,), position of the first pixel on the crystal, mm along v and u, point-inverted."""
    pitch: Array
    """(2,), step from pixel to pixel there, mm along v and u."""

    @classmethod
    def zero(cls) -> Self:
        """Return numbers that are all 0."""
        return cls(np.zeros((3, 4)), 0.0, 0.0, np.zeros(2), np.zeros(2))

    def plus(self, addend: Self) -> Self:
        """Return the sums, number by number."""
        return type(self)(*(a + b for a, b in zip(self, addend, strict=True)))  # type: ignore[operator]


class CrystalWeight(Protocol):
    """Weight as a function of a position on the crystal."""

    def __call__(self, *, u: Array, v: Array) -> Array:
        """Return the weights at positions (u, v), mm from the crystal's centre, point-inverted; arrays that broadcast."""


@dataclass(frozen=True, eq=False)
class DepthZone:
    """A range of depths before a pinhole whose response uses one lattice of planes and cells."""

    numbers: ViewNumbers
    """Numbers of the view."""
    image_shape: Pair
    """Rows and columns of pixels."""
    point_weight: CrystalWeight
    """Weight of a point source, by where its line through the hole's centre meets the crystal, (u, v), mm.

    It is the expected counts per mm^2 of crystal and per decay of a source at depth h, times h^2 / l^2. That is the weight
    of the line in the counting law, per mm^2 (with 1 / l^2 in it), times sec(psi) = sqrt(1 + t^2) with the line's slope t.
    It is proportional to d^2 / l^2 and otherwise depends on the slope alone."""
    crystal_side: float
    """Side of the square on the crystal in which photons are detected, mm."""
    voxel_volume: float
    """Volume of a voxel, mm^3."""
    pieces_per_edge: NDArray[np.intp]
    """(3,), number of pieces along each edge of a voxel."""
    near: float
    """Smallest depth, mm."""
    far: float
    """Largest depth, mm."""
    inverse_depths: Array
    """(planes,), 1 / h of the planes from far to near, 1/mm, evenly spaced."""
    cells_per_pixel: Pair
    """Number of cells along a pixel's side, along v and u."""
    sampling: tuple[float, float, float]
    """`max_point_length`, `max_pair_length` and `samples_per_cell` of `DepthResponse`."""
    pixel_exponent: float
    """Exponent s of the pixel's factor in the separable weight, weight(voxel)^(1 - s) weight(pixel)^s.

    It stands for the weight of the photon's direction, which lies between those of the voxel and of the pixel as seen from
    the hole's centre; s = l / (l + h) at the zone's mean depth h."""
    effects: DirectionalEffects | None = None
    """Knife edge and crystal, where the kernels depend on the photons' direction."""
    node_spacing: int = 1
    """Pixels from node to node of the kernels' lattice, with `effects`."""

    @property
    def cell_size(self) -> Array:
        """(2,), size of a cell, mm along v and u."""
        return self.numbers.pitch / self.cells_per_pixel

    @property
    def piece_edges(self) -> Array:
        """(3, 3), edges of a piece as columns, mm along u, v and k."""
        return self.numbers.to_camera[:, :3] / self.pieces_per_edge

    @functools.cached_property
    def transverse_edges(self) -> Array:
        """(2, 3), edges of a piece as columns, mm along v and u, less what goes along the line that stands for its depth.

        The line is the regression of a piece's points on their depth: it has the direction E e / (e e), where the rows of E
        are the edges' components along u, v and k, and e is the last of them.
        """
        edges = self.piece_edges
        return (edges - np.outer(edges @ edges[2] / (edges[2] @ edges[2]), edges[2]))[1::-1]

    @property
    def curvature(self) -> float:
        """Coefficient c of the factor 1 + c |t_v - t_p|^2 that corrects the separable weight to second order.

        t_v and t_p are the slopes of the lines from the hole's centre to the voxel and to the pixel; c has no unit.
        """
        return 1.5 * self.pixel_exponent * (1 - self.pixel_exponent)

    @property
    def kernel_shape(self) -> KernelShape:
        """Shape of the pixels' kernels: hole, magnification, edges of pieces and curvature, in units of cells."""
        numbers, cell_size = self.numbers, self.cell_size
        curvature = self.curvature * (cell_size / numbers.length) ** 2
        hole_cells = numbers.diameter / np.abs(cell_size)
        edge_cells = self.transverse_edges / cell_size[:, None]
        return KernelShape(hole_cells, numbers.length * self.inverse_depths, edge_cells, curvature)

    def crystal_positions(self, first: list[int], shape: tuple[int, ...], step: Array) -> tuple[Array, Array]:
        """Return the positions on the crystal of rows, v (n, 1), and columns, u (n,), mm, numbered from `first` on."""
        v, u = (self.numbers.first[i] + step[i] * (first[i] + np.arange(float(shape[i]))) for i in range(2))
        return v[:, None], u

    def fractions_on_crystal(self, shift: float = 0.0, pitch_change: float = 0.0) -> list[Array]:
        """Return the fractions of rows and of columns of pixels that lie within `crystal_side`.

        All pixels are moved by `shift` and enlarged by `pitch_change`, mm.
        """
        starts, pitches = self.numbers.first + shift, self.numbers.pitch + pitch_change
        axes = zip(starts, pitches, self.image_shape, strict=True)
        return [share_inside(start + pitch * np.arange(n), abs(pitch), self.crystal_side) for start, pitch, n in axes]
