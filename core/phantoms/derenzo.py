"""The Derenzo phantom: parallel rods with one diameter per sector, alone or in a cylinder of water."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ..arrays import Array, Floats
from ..errors import InputError, warn
from ..physics.materials import WATER_MU
from ..validation import at_least_0, freeze, none_below_0, positive
from .intervals import Interval
from .phantom import Phantom
from .settings import count, setting
from .shapes import Cylinder, Shape, Vector
from .surfaces import Surface, revolve_profile

SECTORS = 6
_MARGIN = 0.1  # width of the zones without rods at the axis and at the rim, as a fraction of the radius
_MAX_RODS = 100_000
_ROW_STEP = np.sqrt(3.0)  # distance of adjacent rows of rods, in rod diameters


@dataclass(frozen=True, kw_only=True)
class DerenzoRods(Shape):
    """The rods of a Derenzo phantom, parallel to z: one shape of many parts.

    A sector of rod diameter w has rows at ``0.1 R + sqrt(3) w n`` from the axis (n = 1, 2, ...); row n has n rods 2 w apart,
    centred on the sector's centre line; ``n <= floor((R - 0.2 R - w) / (sqrt(3) w))``. Where at most one row would fit, the
    margins of 0.1 R are dropped and the rows are laid out again. Sector 0 points along -y; sector k of S is rotated by
    360 k / S degrees, counter-clockwise as seen from +z. With more than 6 sectors, a row has as many rods as fit into its
    narrower sector.

    `radius` is R, `rod_diameters` is w of each sector (0 leaves it empty), `height` is the length of the rods, centred on
    z = 0, all in mm; `sectors` is S, 2 or more. One rod may be `altered`: n leaves out rod n, numbered from 1 in the order
    of `rods`; -n adds a rod to sector n (numbered from 1, the first along -y) as the only rod of a row 0, which lies on the
    sector's centre line, sqrt(3) w before row 1.
    """

    radius: float
    rod_diameters: Vector
    height: float
    sectors: int = SECTORS
    altered: int = 0

    KIND = "derenzo_rods"

    def _check(self) -> None:
        """Check radius, height, sectors and rod diameters, and set the size of the rods' bounding cylinder."""
        for name in ("radius", "height"):
            self._set(name, positive(getattr(self, name), f"Derenzo {name}", "mm"))
        if isinstance(self.sectors, bool) or not isinstance(self.sectors, int) or self.sectors < 2:
            raise InputError(f"Derenzo sectors: expected a whole number of at least 2, got {self.sectors!r}")
        diameters = none_below_0(self.rod_diameters, "Derenzo rod diameters", (None,), "mm")
        if len(diameters) != self.sectors:
            expected = f"one for each of {self.sectors} sectors (0: empty)"
            raise InputError(f"Derenzo rod diameters: expected {expected}, got {len(diameters)}")
        self._set("rod_diameters", tuple(diameters.tolist()))
        rows, radius = [rows for _, rows in self._rows], f"a radius of {self.radius:g} mm"
        if sum(n * (n + 1) // 2 for n in rows) > _MAX_RODS:
            excess = f"more than {_MAX_RODS} rods of {self.rod_diameters} mm in {radius}"
            raise InputError(f"Derenzo phantom: {excess}; choose thicker ones, or 0 for an empty sector")
        if not any(rows):
            raise InputError(f"Derenzo phantom: no rod of {self.rod_diameters} mm fits into {radius}")
        self._check_altered()
        outer_radii = np.linalg.norm(self.rods[:, 1:3], axis=1) + self.rods[:, 3] / 2
        largest, half = float(outer_radii.max()), self.height / 2
        volume = float(np.sum(np.pi / 4 * self.rods[:, 3] ** 2) * self.height)
        self._set_size((largest, largest, half), math.hypot(largest, half), volume)

    def _check_altered(self) -> None:
        """Raise `InputError` unless `altered` is 0, the number of a rod, or minus that of a sector with room for a rod."""
        if isinstance(self.altered, bool) or not isinstance(self.altered, int | np.integer):
            raise InputError(f"Derenzo altered: expected a whole number, got {self.altered!r}")
        self._set("altered", int(self.altered))
        if self.altered > 0 and (self.altered > len(self._pattern) or len(self._pattern) == 1):
            raise InputError(f"Derenzo altered: there is no rod {self.altered} to leave out of {len(self._pattern)}")
        if self.altered < 0:
            sector = f"sector {-self.altered} of {self.sectors}"
            if -self.altered - 1 not in self._pattern[:, 0]:
                raise InputError(f"Derenzo altered: expected a sector with rods to add one to, got {sector}")
            _, x, y, w = self.altered_site
            gaps = np.hypot(self._pattern[:, 1] - x, self._pattern[:, 2] - y) - (self._pattern[:, 3] + w) / 2
            if gaps.min() <= 0:
                raise InputError(f"Derenzo altered: there is no room for one more rod of {w:g} mm in {sector}")

    @cached_property
    def rods(self) -> Floats:
        """Table (n_rods, 4) of all rods: sector, x, y and diameter, mm; an added rod is the last."""
        if self.altered > 0:
            return freeze(np.delete(self._pattern, self.altered - 1, axis=0))
        return freeze(np.vstack([self._pattern, self.altered_site])) if self.altered else self._pattern

    @cached_property
    def altered_site(self) -> Floats:
        """Rod that is left out or added, as a row (4,) of `rods`; defined only if `altered` is not 0."""
        if self.altered > 0:
            return freeze(self._pattern[self.altered - 1])
        sector = -self.altered - 1
        return freeze(np.array([sector, *self._rows[sector][0] * self._axes[sector, 0], self.rod_diameters[sector]]))

    @cached_property
    def _pattern(self) -> Floats:
        """Table (n_rods, 4) like `rods`, but before a rod is left out or added."""
        table = []
        for sector, (w, (margin, rows)) in enumerate(zip(self.rod_diameters, self._rows, strict=True)):
            along, across = self._axes[sector]
            for n in range(1, rows + 1):
                n_rods = int(self._rods_in_row(np.array(float(n))))
                for j in range(n_rods):
                    x, y = (margin + _ROW_STEP * w * n) * along + (2 * j - (n_rods - 1)) * w * across
                    table.append((sector, x, y, w))
        return freeze(np.array(table))

    @property
    def n_parts(self) -> int:
        """Number of rods: a line may enter each of them once."""
        return len(self.rods)

    @property
    def finest(self) -> float:
        """Diameter, mm, of the thinnest rod, or the rods' length if that is smaller."""
        return min(float(self.rods[:, 3].min()), self.height)

    @cached_property
    def _rows(self) -> list[tuple[float, int]]:
        """Margin at the axis, mm, and number of rows of each sector."""
        table = []
        for w in self.rod_diameters:
            for margin in (_MARGIN * self.radius, 0.0):
                rows = max(0, int((self.radius - 2 * margin - w) // (_ROW_STEP * w))) if w > 0 else 0
                if rows > 1:
                    break
            table.append((margin, rows))
        return table

    @cached_property
    def _axes(self) -> Floats:
        """Unit vectors along the centre line of each sector (away from the axis) and across it, (S, 2, 2)."""
        angle = np.deg2rad(-90.0 + 360.0 / self.sectors * np.arange(self.sectors))
        return np.stack([np.cos(angle), np.sin(angle), -np.sin(angle), np.cos(angle)], axis=1).reshape(-1, 2, 2)

    def _rods_in_row(self, n: Array) -> Array:
        """Return the number of rods in row n, for rows numbered `n` (N,): n in 60 degrees, fewer in a narrower sector."""
        return n if self.sectors <= SECTORS else np.floor(_ROW_STEP * np.tan(np.pi / self.sectors) * n + 1e-6)

    def _distance(self, points: Array) -> Array:
        """Return the distance from the rods of each point's own sector, limited by the distance from its border.

        The result is exact for points whose nearest rod lies in their own sector. Rods stay 0.36 w or more away from their
        sector's borders: the sign is therefore always right, and a point near a border gets its bound from the border. The
        neighbours of a rod that is left out are sqrt(3) w or more away from it.
        """
        scalar = points.dtype.type
        x, y, z = points
        margins, rows = (np.array(column, scalar) for column in zip(*self._rows, strict=True))
        diameters, axes = np.array(self.rod_diameters, scalar), self._axes.astype(scalar)
        angle = np.arctan2(y, x) * scalar(self.sectors / (2 * np.pi)) + scalar(self.sectors / 4 + 0.5)  # in sectors
        sector = np.floor(angle).astype(np.intp) % self.sectors
        w, margin, last_row = diameters[sector], margins[sector], np.maximum(rows, 1)[sector]
        # Coordinates along (t) and across (s) each point's sector.
        t = axes[sector, 0, 0] * x + axes[sector, 0, 1] * y
        s = axes[sector, 1, 0] * x + axes[sector, 1, 1] * y
        safe_w = np.where(w > 0, w, 1)
        step = scalar(_ROW_STEP) * safe_w
        row = np.clip(np.floor((t - margin) / step), 1, last_row)
        center_distance = np.full(x.shape, np.inf, scalar)  # from the centre of the nearest rod
        for n in (row, np.minimum(row + 1, last_row)):
            n_rods = self._rods_in_row(n).astype(scalar)
            j = np.clip(np.rint((s / safe_w + n_rods - 1) / 2), 0, np.maximum(n_rods - 1, 0))
            along, across = margin + step * n, (2 * j - n_rods + 1) * safe_w
            rod_distance = np.hypot(t - along, s - across)
            if self.altered > 0:
                is_missing = (sector == self.altered_site[0]) & self._is_altered_site(along, across)
                rod_distance = np.where(is_missing, np.maximum(rod_distance, step - rod_distance), rod_distance)
            np.minimum(center_distance, np.where(n_rods > 0, rod_distance, np.inf), out=center_distance)
        distance = np.where(rows[sector] > 0, center_distance - w / 2, np.inf).astype(scalar)
        # Rods of the neighbouring sector are at least this far away: outside, the smaller of both bounds holds.
        half = np.pi / self.sectors
        border = t * scalar(np.sin(half)) - np.abs(s) * scalar(np.cos(half)) + scalar(0.36 * self.rods[:, 3].min())
        distance = np.where(distance > 0, np.minimum(distance, border), distance)
        if self.altered < 0:
            _, site_x, site_y, site_w = self.altered_site.astype(scalar)
            distance = np.minimum(distance, np.hypot(x - site_x, y - site_y) - site_w / 2)
        return np.maximum(distance, np.abs(z) - scalar(self.height / 2))

    def _is_altered_site(self, along: Array, across: Array) -> Array:
        """Return whether each rod, at `along` and `across` its sector, mm, is the one that is left out or added."""
        sector, x, y, w = self.altered_site
        t, s = self._axes[int(sector)] @ (x, y)
        return np.maximum(abs(along - t), abs(across - s)) < w / 2

    def _intervals(self, starts: Floats, directions: Floats) -> Interval:
        """Return where the lines, `starts` (3, N) and `directions` (3, N), enter and leave each rod."""
        intervals = [
            Cylinder(radius=w / 2, height=self.height, activity=0.0).intervals(starts - [[x], [y], [0.0]], directions)
            for _, x, y, w in self.rods
        ]
        enter, leave = zip(*intervals, strict=True)
        return np.concatenate(enter), np.concatenate(leave)

    def _surface(self) -> Surface:
        """Return the closed surface of all rods."""
        radii, half = np.array([0.0, 0.5, 0.5, 0.0]), self.height / 2
        rod, faces = revolve_profile(radii, np.array([-half, -half, half, half]), 1.0, 1.0, n_sides=24)
        _, x, y, w = self.rods.T[:, :, None]
        vertices = np.stack([rod[:, 0] * w + x, rod[:, 1] * w + y, np.broadcast_to(rod[:, 2], (len(w), len(rod)))], -1)
        all_faces = faces + np.arange(len(w), dtype=np.int32)[:, None, None] * len(rod)
        return vertices.reshape(-1, 3), all_faces.reshape(-1, 3).astype(np.int32)


@dataclass(frozen=True)
class DerenzoPhantom(Phantom):
    """Rods parallel to z, centred on the origin, with one diameter per sector, at the positions of `DerenzoRods`."""

    radius: float = setting(40.0, "mm", "radius of the phantom")
    rod_diameters: tuple[float, ...] = setting((8.0, 6.0, 5.0, 4.0, 3.0, 2.0), "mm", "of each sector; 0: none", 0.0)
    height: float = setting(40.0, "mm", "length of the rods")
    activity: float = setting(1.0, "kBq/mL", "activity of the rods; 0 for cold rods in active water", 0.0)
    sectors: int = SECTORS
    cylinder_radius: float = setting(0.0, "mm", "radius of the water around the rods; 0 for none", 0.0)
    cylinder_height: float = setting(0.0, "mm", "height of the water; 0 for the rods' length", 0.0)
    background: float = setting(0.0, "kBq/mL", "activity of the water", 0.0)
    mu: float = setting(WATER_MU, "1/mm", "attenuation coefficient of rods and water", 0.0)
    altered: int = count(0, "n leaves out rod n; -n adds a rod to sector n, before its rows", -SECTORS)

    title = "Derenzo phantom"

    def __post_init__(self) -> None:
        for name in ("activity", "cylinder_radius", "cylinder_height", "background", "mu"):
            title = f"Derenzo {name.replace('_', ' ')}"
            object.__setattr__(self, name, at_least_0(getattr(self, name), title))
        for name in ("radius", "rod_diameters", "height", "altered"):  # checked by the shape of the rods
            object.__setattr__(self, name, getattr(self._rods, name))
        if self.activity == 0 and not (self.background and self.cylinder_radius):
            expected = "more than 0 kBq/mL, or 0 in a cylinder with a background"
            raise InputError(f"Derenzo activity: expected {expected}, got {self.activity:g}")
        thick = [f"{w:g}" for w, (_, n) in zip(self.rod_diameters, self._rods._rows, strict=True) if w > 0 and n == 0]
        if thick:
            warn(f"no rod of {', '.join(thick)} mm fits into a radius of {self.radius:g} mm: such sectors stay empty")
        if not self.cylinder_radius:
            if self.background or self.cylinder_height:
                expected = "more than 0 mm around a background or with a height"
                raise InputError(f"Derenzo cylinder radius: expected {expected}")
        elif self.cylinder_radius < self.radius or self._water_height < self.height:
            expected = f"a radius of {self.radius:g} mm and a height of {self.height:g} mm or more"
            actual = f"{self.cylinder_radius:g} and {self._water_height:g}"
            raise InputError(f"Derenzo cylinder: expected {expected}, got {actual}")

    @cached_property
    def shapes(self) -> Sequence[Shape]:
        """Cylinder of water, if its radius is above 0, and the rods over it."""
        if not self.cylinder_radius:
            return (self._rods,)
        water: dict[str, Any] = {"activity": self.background, "mu": self.mu, "name": "water"}
        return (Cylinder(radius=self.cylinder_radius, height=self._water_height, **water), self._rods)

    @property
    def box(self) -> tuple[Floats, Floats]:
        """Lowest and highest corner (3,), mm, of the phantom's box, which includes the rods' whole `radius`."""
        half = max(self.radius, self.cylinder_radius, self._rods.half_box[0])  # very thin rods extend beyond the radius
        corner = np.array([half, half, max(self.height, self.cylinder_height) / 2])
        return -corner, corner

    def rods(self) -> Floats:
        """Return the table (n_rods, 4) of all rods: sector, x, y and diameter, mm."""
        return self._rods.rods

    def altered_site(self) -> Floats | None:
        """Return the rod that is left out or added as (sector, x, y, diameter), mm, or None if `altered` is 0."""
        return self._rods.altered_site if self.altered else None

    @cached_property
    def _rods(self) -> DerenzoRods:
        """Shape of the rods."""
        return DerenzoRods(radius=self.radius, rod_diameters=self.rod_diameters, height=self.height,
                           sectors=self.sectors, altered=self.altered, activity=self.activity, mu=self.mu,
                           name="rods")  # fmt: skip

    @property
    def _water_height(self) -> float:
        """Height of the cylinder of water, mm."""
        return self.cylinder_height or self.height
