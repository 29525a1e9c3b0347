"""The Derenzo phantom: six 60-degree sectors of parallel hot rods."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..checks import freeze, positive, real_array
from ..errors import InputError, InputWarning
from ..frames import checked_affine
from ..grid import Grid
from ..progress import Progress
from ..volume import Volume
from .coverage import voxelize_shape

SECTORS = 6
_HELD = 0.98  # of the rods: with less of them on the grid, the user is told
_MARGIN = 0.1  # of the radius, kept free at the axis and at the rim
_MOST_RODS = 100_000
_ROW_STEP = np.sqrt(3.0)  # distance of two rows of rods, in rod diameters


@dataclass(frozen=True)
class DerenzoPhantom:
    """Hot rods along z, in six sectors of one rod diameter each, centred on the origin.

    A sector of rod diameter w has rows at ``0.1 R + sqrt(3) w n`` from the axis (n = 1, 2, ...); row n holds n rods
    2 w apart, centred; ``n <= floor((R - 0.2 R - w) / (sqrt(3) w))``. Where one row at most would fit, the margins of
    0.1 R are dropped and the rows counted again. Sector 0 runs along -y; sector k is turned by 60 k degrees,
    counter-clockwise as seen from +z.

    Attributes
    ----------
    radius : float
        R, mm.
    rod_diameters : tuple of 6 floats
        w of each sector, mm; 0 leaves a sector empty.
    height : float
        Length of the rods, mm, centred on z = 0.
    activity : float
        Activity concentration in the rods, kBq/mL; 0 around them.

    Raises
    ------
    InputError
        A number is not finite or out of range, or no rod fits.
    """

    radius: float
    rod_diameters: tuple[float, ...]
    height: float
    activity: float = 1.0

    def __post_init__(self) -> None:
        set_ = object.__setattr__
        set_(self, "radius", positive(self.radius, "Derenzo radius", "mm"))
        set_(self, "height", positive(self.height, "Derenzo height", "mm"))
        set_(self, "activity", positive(self.activity, "Derenzo activity", "kBq/mL"))
        diameters = real_array(self.rod_diameters, "Derenzo rod diameters", (SECTORS,))
        if np.any(diameters < 0):
            raise InputError(f"Derenzo rod diameters: expected 0 or more mm, got {diameters.min():g}")
        set_(self, "rod_diameters", tuple(float(w) for w in diameters))
        rows = [rows for _, rows in self._rows()]
        if sum(n * (n + 1) // 2 for n in rows) > _MOST_RODS:
            raise InputError(
                f"Derenzo phantom: more than {_MOST_RODS} rods of {self.rod_diameters} mm in a radius of "
                f"{self.radius:g} mm; choose thicker ones, or 0 for an empty sector"
            )
        if not any(rows):
            raise InputError(
                f"Derenzo phantom: no rod of {self.rod_diameters} mm fits into a radius of {self.radius:g} mm"
            )
        empty = [f"{w:g}" for w, n in zip(self.rod_diameters, rows, strict=True) if w > 0 and n == 0]
        if empty:
            warnings.warn(
                f"no rod of {', '.join(empty)} mm fits into a radius of {self.radius:g} mm: such sectors stay empty",
                InputWarning,
                stacklevel=3,
            )

    def rods(self) -> NDArray[np.float64]:
        """Every rod as (sector, x, y, diameter), array (n_rods, 4), mm."""
        table = []
        for sector, (w, (margin, rows)) in enumerate(zip(self.rod_diameters, self._rows(), strict=True)):
            along, across = _sector_axes(sector)
            for n in range(1, rows + 1):
                for j in range(n):
                    x, y = (margin + _ROW_STEP * w * n) * along + (2 * j - (n - 1)) * w * across
                    table.append((sector, x, y, w))
        return freeze(np.array(table))

    @property
    def total_activity(self) -> float:
        """Activity of the whole phantom, kBq."""
        return self.activity * self._rod_volume * 1e-3  # kBq/mL times mm^3

    @property
    def _reach(self) -> float:
        """Distance, mm, from the axis to the rods' farthest point."""
        return float(np.max(np.linalg.norm(self.rods()[:, 1:3], axis=1) + self.rods()[:, 3] / 2))

    @property
    def _rod_volume(self) -> float:
        """Volume of all rods, mm^3."""
        return float(np.sum(np.pi / 4 * self.rods()[:, 3] ** 2) * self.height)

    @property
    def extent(self) -> float:
        """Diameter, mm, of a ball around the phantom: a grid of that size holds it however it is turned."""
        return 2 * math.hypot(self._reach, self.height / 2)

    def voxelize(self, grid: Grid, pose: ArrayLike | None = None, progress: Progress | None = None) -> Volume:
        """The phantom as an activity volume on `grid`, anti-aliased: a voxel holds its mean concentration.

        Parameters
        ----------
        grid
            Any grid; what lies outside it is cut off.
        pose
            World-from-phantom (4, 4), mm; default: the axis along world z, at the isocentre. See `euler_pose`.
        progress
            Called as ``progress(done, total)``.

        Raises
        ------
        InputError
            No grid, the pose is not an invertible 4x4 affine, or the volume does not fit into memory.
        """
        if not isinstance(grid, Grid):
            raise InputError(f"voxelize: expected a Grid, got {type(grid).__name__}")
        pose = np.eye(4) if pose is None else checked_affine(pose, "phantom pose")
        reach = self._reach
        half_height = self.height / 2
        coverage = voxelize_shape(
            grid,
            pose,
            self._distance,
            low=(-reach, -reach, -half_height),
            high=(reach, reach, half_height),
            finest=min(w for w in self.rod_diameters if w > 0),
            progress=progress,
        )
        held = float(coverage.sum(dtype=np.float64)) * grid.voxel_volume / self._rod_volume
        if held < _HELD:
            warnings.warn(
                f"{1 - held:.0%} of the Derenzo phantom lies outside the grid: take larger or more voxels",
                InputWarning,
                stacklevel=2,
            )
        coverage *= self.activity
        return Volume(freeze(coverage), grid, "activity")

    def _rows(self) -> list[tuple[float, int]]:
        """Margin, mm, and number of rows of each sector."""
        table = []
        for w in self.rod_diameters:
            margin = _MARGIN * self.radius
            rows = _count_rows(self.radius, margin, w)
            if rows <= 1:
                margin = 0.0
                rows = _count_rows(self.radius, margin, w)
            table.append((margin, rows))
        return table

    def _distance(self, points: NDArray[np.float32]) -> NDArray[np.float32]:
        """Signed distance, mm, from `points` (3, N) to the rods' surface; negative inside.

        Exact for points that are nearest to a rod of their own sector. Rods keep a distance of 0.36 w or more from
        their sector's borders, so that the sign is always right, and a point near a border gets a bound from it.
        """
        x, y, z = points
        margins, rows = (np.array(column, np.float32) for column in zip(*self._rows(), strict=True))
        diameters = np.array(self.rod_diameters, np.float32)
        # Sector k spans 60 degrees around -90 + 60 k degrees.
        turns = np.arctan2(y, x) * np.float32(3 / np.pi) + np.float32(2.0)
        sector = np.floor(turns).astype(np.int8) % SECTORS
        axes = np.array([_sector_axes(k) for k in range(SECTORS)], np.float32)  # (6, along/across, xy)
        w, margin, last = diameters[sector], margins[sector], rows[sector]
        t = axes[sector, 0, 0] * x + axes[sector, 0, 1] * y
        s = axes[sector, 1, 0] * x + axes[sector, 1, 1] * y
        safe = np.where(w > 0, w, 1)
        step = np.float32(_ROW_STEP) * safe
        lower = np.clip(np.floor((t - margin) / step), 1, np.maximum(last, 1))
        nearest = np.full(x.shape, np.inf, np.float32)
        for n in (lower, np.minimum(lower + 1, np.maximum(last, 1))):
            j = np.clip(np.rint((s / safe + n - 1) / 2), 0, n - 1)
            np.minimum(nearest, np.hypot(t - margin - step * n, s - (2 * j - n + 1) * safe), out=nearest)
        distance = np.where(last > 0, nearest - w / 2, np.inf).astype(np.float32)
        # A rod of the neighbouring sector is at least this far: outside, the smaller of both bounds holds.
        smallest = min(w for w in self.rod_diameters if w > 0)
        border = t * np.float32(0.5) - np.abs(s) * np.float32(np.sqrt(3) / 2) + np.float32(0.36 * smallest)
        distance = np.where(distance > 0, np.minimum(distance, border), distance)
        return np.maximum(distance, np.abs(z) - np.float32(self.height / 2))


def _count_rows(radius: float, margin: float, w: float) -> int:
    return max(0, int((radius - 2 * margin - w) // (_ROW_STEP * w))) if w > 0 else 0


def _sector_axes(sector: int) -> NDArray[np.float64]:
    """Unit vectors along the sector (away from the axis) and across it, (2, 2)."""
    angle = np.deg2rad(-90.0 + 60.0 * sector)
    return np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
