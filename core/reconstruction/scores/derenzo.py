"""What a reconstruction resolves of a Derenzo phantom's rods, sector by sector."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...errors import InputError
from ...geometry.frames import checked_affine
from ...phantoms.derenzo import DerenzoRods
from ...phantoms.phantom import QUANTITIES, Phantom
from ...progress import Progress
from ...validation import freeze, instance
from ...volumes.resampling import values_at
from ...volumes.volume import Volume, require_quantity
from .rows import Rows

Floats = NDArray[np.float64]

RESOLVED_BELOW = 0.735
"""Valley-to-peak of two points that are just resolved, by Rayleigh's criterion."""

_LENGTH = (
    0.5  # of the rods, around their middle, that profiles are means over: their ends blur into what is beside them
)
_WIDTH = 0.5  # of a rod's diameter, that profiles are means over
_ACROSS = 5  # lines over that width
_ALONG = 33  # points of a profile, odd: one is in the middle
_BLOCK = 1 << 20  # samples at once


@dataclass(frozen=True, eq=False)
class RodProfile:
    """The values on the line from one rod's centre to that of its neighbour, as means along the rods and across the line."""

    points: Floats
    """World points (n, 3), mm, halfway along the rods: the first and the last are the rods' centres."""
    values: Floats
    """(n,), in the volume's unit."""
    is_hot: bool
    """Whether the rods hold more than what is between them."""

    @property
    def peak(self) -> float:
        """Mean of both rods' centres; of cold rods, the value halfway between them."""
        return self._rods if self.is_hot else self._between

    @property
    def valley(self) -> float:
        """Value halfway between the rods; of cold rods, the mean of their centres."""
        return self._between if self.is_hot else self._rods

    @property
    def valley_to_peak(self) -> float:
        """Valley by peak; infinite where the peak is not above 0."""
        return self.valley / self.peak if self.peak > 0 else np.inf

    @property
    def _rods(self) -> float:
        return float(self.values[[0, -1]].mean())

    @property
    def _between(self) -> float:
        return float(self.values[len(self.values) // 2])


@dataclass(frozen=True, eq=False)
class DerenzoSector:
    """The score of one sector. What cannot be told is NaN, and `note` says why."""

    rod_diameter: float
    """mm."""
    valley_to_peak: float
    """Mean valley by mean peak of all pairs of neighbours: 0 if nothing is between the rods, 1 if no rods can be seen."""
    resolved: float
    """Share of the pairs of neighbours whose valley-to-peak is below 0.735."""
    contrast_recovery: float
    """Difference of mean peak and mean valley, by that of the phantom."""
    profiles: tuple[RodProfile, ...] = ()
    """One for each pair of neighbours."""
    note: str = ""
    """Why something is NaN."""


class DerenzoScore(Rows[DerenzoSector]):
    """The scores of all sectors, in the phantom's order; its attributes are arrays (S,), as of `DerenzoSector`."""

    @property
    def rod_diameter(self) -> Floats:
        """mm; 0 of a sector without rods."""
        return self.column("rod_diameter")

    @property
    def valley_to_peak(self) -> Floats:
        """Mean valley by mean peak."""
        return self.column("valley_to_peak")

    @property
    def resolved(self) -> Floats:
        """Shares of the pairs of neighbours."""
        return self.column("resolved")

    @property
    def contrast_recovery(self) -> Floats:
        """Of the phantom's contrast."""
        return self.column("contrast_recovery")


def derenzo_score(
    volume: Volume, phantom: Phantom, pose: ArrayLike | None = None, progress: Progress | None = None
) -> DerenzoScore:
    """Score a reconstruction of Derenzo rods: which of them it resolves, and how much of their contrast it shows.

    Neighbours are rods of one sector whose centres are two diameters apart. From one's centre to the other's runs a profile:
    linear interpolation of the voxels, as the mean over the middle half of the rods' length and over half a diameter across
    the line. Its peak is the mean of both centres, its valley lies halfway between them: at these known places, not where
    values are largest and smallest, as these differ by noise alone. (Of cold rods, the peak is halfway and the valley in the
    rods.) A pair is resolved if valley / peak < 0.735, Rayleigh's criterion, as Hallen et al. propose for hot-rod phantoms.
    Of rods that cannot be seen at all, noise resolves some pairs by chance, while the sector's own valley-to-peak, of the
    means of all pairs, stays near 1. Contrast recovery is the mean peak minus the mean valley, by the same of the phantom:
    it is 1 only where the volume's values are right, too.

    Parameters
    ----------
    volume
        Of activity, kBq/mL, or mu, 1/mm, on any grid, turned or not.
    phantom
        A `DerenzoPhantom`, or any other one with `DerenzoRods` among its shapes.
    pose
        World-from-phantom (4, 4), mm, as for ``phantom.voxelize(grid, pose)``.
    progress
        Called as ``progress(done, total)`` after each sector; may raise `Cancelled`.

    Returns
    -------
    DerenzoScore
        A sequence with an item for each sector: rod_diameter (mm), valley_to_peak, resolved, contrast_recovery, profiles.
        They are NaN, and the item's `note` says why, in a sector with fewer than two rods, with rods thinner than a voxel
        or beside the volume, or with rods that hold the same as what is between them.

    Raises
    ------
    InputError
        If the phantom has no Derenzo rods, or the volume holds another quantity.

    References
    ----------
    Hallen, Schug, Schulz 2020, "Comments on the NEMA NU 4-2008 standard on performance measurement of small animal
    positron emission tomographs", EJNMMI Physics 7:12.
    """
    instance(volume, Volume, "derenzo_score")
    instance(phantom, Phantom, "derenzo_score")
    require_quantity(volume.quantity, QUANTITIES, "derenzo_score")
    world_from_phantom = np.eye(4) if pose is None else checked_affine(pose, "phantom pose")
    every = [shape for shape in phantom.shapes if isinstance(shape, DerenzoRods)]
    if not every:
        raise InputError(f"derenzo_score: expected a phantom with Derenzo rods, got a {phantom.title} without")
    numbered = [(rods, sector) for rods in every for sector in range(rods.sectors)]
    sectors = []
    for done, (rods, sector) in enumerate(numbered, 1):
        sectors.append(_Sector(volume, phantom, world_from_phantom, rods, sector).score())
        if progress is not None:
            progress(done, len(numbered))
    return DerenzoScore(tuple(sectors))


@dataclass(frozen=True, eq=False)
class _Sector:
    """One sector of a phantom's rods, in a volume. Places (…, 3) are in the rods' own frame, mm."""

    volume: Volume
    phantom: Phantom
    world_from_phantom: Floats
    rods: DerenzoRods
    sector: int

    def score(self) -> DerenzoSector:
        diameter = float(self.rods.rod_diameters[self.sector])
        if note := self._missing(diameter):
            return DerenzoSector(diameter, np.nan, np.nan, np.nan, note=note)
        rods, between = self._true_values()
        if np.isclose(rods, between, rtol=1e-9, atol=0):
            note = f"the rods hold the same {self.volume.quantity} as what is between them"
            return DerenzoSector(diameter, np.nan, np.nan, np.nan, note=note)
        profiles = self._profiles(diameter, rods > between)
        peak = float(np.mean([profile.peak for profile in profiles]))
        valley = float(np.mean([profile.valley for profile in profiles]))
        ratio, note = (valley / peak, "") if peak > 0 else (np.nan, "the peaks are not above 0")
        resolved = float(np.mean([profile.valley_to_peak < RESOLVED_BELOW for profile in profiles]))
        return DerenzoSector(diameter, ratio, resolved, (peak - valley) / abs(rods - between), tuple(profiles), note)

    def _missing(self, diameter: float) -> str:
        """Why the sector has no score, if that is so."""
        count = len(self._centers)
        if not count:
            return "no rods"
        if not len(self._pairs):
            return "a single rod has no neighbour"
        # The sampling of the rods' cross-section where it is coarsest: 1 mm of cubic voxels of 1 mm, however turned.
        voxel = 1 / np.linalg.svd(self._index_from_rods[:3, :2], compute_uv=False)[-1]
        if voxel > diameter * (1 + 1e-6):
            return f"voxels of {voxel:.3g} mm are larger than the rods"
        ends = self._centers[:, None] + np.array([-0.5, 0.5])[:, None] * [0, 0, _LENGTH * self.rods.height]
        index = ends @ self._index_from_rods[:3, :3].T + self._index_from_rods[:3, 3]
        beside = ((index < -0.5) | (index > np.array(self.volume.grid.shape) - 0.5)).any(axis=(1, 2))
        return f"{beside.sum()} of {count} rods lie outside the volume" if beside.any() else ""

    @cached_property
    def _centers(self) -> Floats:
        """The rods' centres (n, 3)."""
        mine = self.rods.rods[self.rods.rods[:, 0] == self.sector]
        return np.concatenate([mine[:, 1:3], np.zeros((len(mine), 1))], axis=1)

    @cached_property
    def _pairs(self) -> NDArray[np.int64]:
        """Numbers (P, 2) of rods that are neighbours."""
        most = 2 * self.rods.rod_diameters[self.sector] * (1 + 1e-6)
        found = []
        for i, center in enumerate(self._centers):
            near = np.flatnonzero(np.linalg.norm(self._centers[i + 1 :] - center, axis=1) <= most) + i + 1
            found += [(i, int(j)) for j in near]
        return np.array(found, np.int64).reshape(-1, 2)

    @cached_property
    def _world_from_rods(self) -> Floats:
        return self.world_from_phantom @ self.rods.pose

    @cached_property
    def _index_from_rods(self) -> Floats:
        return self.volume.grid.index_from_world @ self._world_from_rods

    def _true_values(self) -> tuple[float, float]:
        """The phantom's values in the rods and halfway between them, means over the part of the length that counts."""
        starts, ends = self._centers[self._pairs].transpose(1, 0, 2)
        along = np.linspace(-0.5, 0.5, 9)[:, None, None] * [0, 0, _LENGTH * self.rods.height]
        places = [points + along for points in (np.concatenate([starts, ends]), (starts + ends) / 2)]
        own = self.rods.pose
        rods, between = (
            self.phantom.values(p.reshape(-1, 3) @ own[:3, :3].T + own[:3, 3], quantity=self.volume.quantity).mean()
            for p in places
        )
        return float(rods), float(between)

    def _profiles(self, diameter: float, is_hot: bool) -> list[RodProfile]:
        length = _LENGTH * self.rods.height
        voxels = length * np.linalg.norm(self._index_from_rods[:3, 2])
        depths = _middles(max(2, int(np.ceil(2 * voxels)))) * length
        aside = _middles(_ACROSS) * _WIDTH * diameter
        starts, ends = self._centers[self._pairs].transpose(1, 0, 2)
        lines = starts[:, None] + np.linspace(0, 1, _ALONG)[:, None] * (ends - starts)[:, None]  # (P, points, 3)
        normals = np.cross([0.0, 0.0, 1.0], ends - starts)
        normals /= np.linalg.norm(normals, axis=1)[:, None]
        offsets = aside[:, None, None] * normals[:, None, None] + depths[:, None] * [
            0.0,
            0.0,
            1.0,
        ]  # (P, across, depths, 3)
        values = np.empty(lines.shape[:2])
        world = self._world_from_rods
        step = max(1, _BLOCK // (_ALONG * _ACROSS * len(depths)))
        for first in range(0, len(lines), step):
            part = slice(first, first + step)
            points = lines[part, :, None, None] + offsets[part, None]
            samples = values_at(self.volume, points.reshape(-1, 3) @ world[:3, :3].T + world[:3, 3])
            values[part] = samples.reshape(points.shape[:-1]).mean(axis=(2, 3), dtype=np.float64)
        lines = lines @ world[:3, :3].T + world[:3, 3]
        return [RodProfile(freeze(p), freeze(v), is_hot) for p, v in zip(lines, values, strict=True)]


def _middles(count: int) -> Floats:
    """The middles of so many equal parts of the length from -1/2 to 1/2."""
    return (np.arange(count) + 0.5) / count - 0.5
