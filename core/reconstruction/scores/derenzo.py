"""Scores of the rods of a reconstructed Derenzo phantom: which are resolved, sector by sector."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ...arrays import ArrayLike, Floats, Integers
from ...errors import InputError
from ...geometry.frames import checked_affine, moved
from ...phantoms.derenzo import DerenzoRods
from ...phantoms.phantom import QUANTITIES, Phantom
from ...progress import Progress, tell
from ...validation import freeze, instance
from ...volumes.resampling import values_at
from ...volumes.volume import Volume, require_quantity
from .rows import Rows, column, json_number

RESOLVED_BELOW = 0.735
"""Valley-to-peak of two points that are just resolved, by Rayleigh's criterion."""

NOISE_BELOW, SEEN_BELOW = 0.001, 0.02
"""Chance that noise makes a sector's contrast: of one that is resolved, and of one that is seen, it is less."""

LIGHTS = {"green": "resolved", "amber": "seen, not resolved", "red": "not resolved"}
"""Meaning of the colours of a sector's dot. Amber: its rods stand out of the noise, but not enough."""

_LENGTH = 0.5  # of the rods, around their middle, that profiles are means over: ends blur into what is beside them
_WIDTH = 0.5  # of a rod's diameter, that profiles are means over
_ACROSS = 5  # lines over that width
_ALONG = 33  # points of a profile, odd: one is in the middle
_BLOCK = 1 << 20  # samples at once


@dataclass(frozen=True, eq=False)
class RodProfile:
    """The values on the line from one rod's centre to that of its neighbour, as means along the rods and across the line."""

    points: Floats
    """World points (n, 3), mm, in the middle of the length that counts: the first and the last are on the rods' axes."""
    values: Floats
    """(n,), in the volume's unit."""
    is_hot: bool
    """Whether the rods hold more than what is between them."""

    @property
    def peak(self) -> float:
        """Mean of both rods' centres; of cold rods, the value halfway between them."""
        return float(np.mean(self.values[[0, -1]] if self.is_hot else self.values[_ALONG // 2]))

    @property
    def valley(self) -> float:
        """Value halfway between the rods; of cold rods, the mean of their centres."""
        return float(np.mean(self.values[_ALONG // 2] if self.is_hot else self.values[[0, -1]]))

    @property
    def valley_to_peak(self) -> float:
        """Valley by peak; infinite where the peak is not above 0."""
        return self.valley / self.peak if self.peak > 0 else np.inf


@dataclass(frozen=True, eq=False)
class DerenzoSector:
    """The score of one sector. What is not known is NaN, and `note` says why."""

    rod_diameter: float
    """mm."""
    valley_to_peak: float
    """Mean valley by mean peak of all pairs of neighbours: 0 if nothing is between the rods, 1 if no rods can be seen."""
    contrast_recovery: float
    """Difference of mean peak and mean valley, by that of the phantom."""
    profiles: tuple[RodProfile, ...] = ()
    """Profiles, one for each pair of neighbours."""
    note: str = ""
    """Why something is NaN."""
    chance: float = np.nan
    """p-value of a difference of mean peak and mean valley as large as this by noise alone, as rods and valleys scatter."""

    @property
    def resolved(self) -> float:
        """1 if `valley_to_peak` is below `RESOLVED_BELOW` and `chance` below `NOISE_BELOW`, else 0; see `derenzo_score`."""
        return float(self.valley_to_peak < RESOLVED_BELOW and self.chance < NOISE_BELOW) if self.profiles else np.nan

    @property
    def pairs_resolved(self) -> float:
        """Share of the pairs of neighbours with a valley-to-peak below 0.735; by itself it says nothing, see `resolved`."""
        return float(np.mean([profile.valley_to_peak < RESOLVED_BELOW for profile in self.profiles] or np.nan))

    @property
    def light(self) -> str:
        """A key of `LIGHTS`: "green" if it is `resolved`, "amber" if it is seen, else "red"; "" if unknown."""
        if self.note or not self.profiles:
            return ""
        return "green" if self.resolved else "amber" if self.chance < SEEN_BELOW else "red"

    @property
    def contrast(self) -> str:
        """The contrast recovery in words."""
        return f"{np.round(100 * self.contrast_recovery) + 0.0:.0f} %"

    @property
    def cells(self) -> tuple[str, str, str, str]:
        """A row of a table: rod diameter, `light`, valley/peak or why there is none, and contrast recovery."""
        score = (self.note, "") if self.note else (f"{self.valley_to_peak:.2f}", self.contrast)
        return f"{self.rod_diameter:g} mm", self.light, *score

    @property
    def words(self) -> str:
        """The score in a line: whether it is resolved, and by what; or why there is none."""
        return self.note or f"{LIGHTS[self.light]}, valley/peak {self.valley_to_peak:.2f}, contrast {self.contrast}"


class DerenzoScore(Rows[DerenzoSector]):
    """The scores of all sectors, in the phantom's order; its attributes are arrays (S,) of those of `DerenzoSector`."""

    rod_diameter = column("rod_diameter", "mm; 0 of a sector without rods.")
    valley_to_peak = column("valley_to_peak", "Mean valley by mean peak.")
    resolved = column("resolved", "1 or 0.")
    contrast_recovery = column("contrast_recovery", "Of the phantom's contrast.")

    @property
    def lines(self) -> list[str]:
        """The scores as lines of text, one for each sector with rods."""
        texts = ((sector.rod_diameter, ": ".join(filter(None, (sector.light, sector.words)))) for sector in self)
        return [f"{diameter:g} mm  {text}" for diameter, text in texts if diameter]

    @property
    def record(self) -> dict[str, Any]:
        """The scores as JSON can hold them, None for an unknown number."""
        names = ("rod_diameter", "valley_to_peak", "contrast_recovery", "chance", "pairs_resolved")
        return {"derenzo": [
            {**{name: json_number(getattr(sector, name)) for name in names}, "pairs": len(sector.profiles),
             "note": sector.note, "light": sector.light or None,
             "resolved": None if np.isnan(sector.resolved) else bool(sector.resolved)}
            for sector in self
        ]}  # fmt: skip


def derenzo_score(
    volume: Volume, phantom: Phantom, pose: ArrayLike | None = None, progress: Progress | None = None
) -> DerenzoScore:
    """Score a reconstruction of Derenzo rods: which of them it resolves, and how much of their contrast it shows.

    Neighbours are rods of one sector whose centres are two diameters apart. From one's centre to the other's runs a profile:
    linear interpolation of the voxels, as the mean over the middle half of the rods' length and over half a diameter across
    the line. Its peak is the mean of both centres, its valley lies halfway between them: at these known places, not where
    values are largest and smallest, as these differ by noise alone. (Of cold rods, the peak is halfway and the valley in the
    rods.) Where the volume covers only a part of the rods' length, the mean is over what it covers of their middle half, but
    over a diameter at least: that which is nearest to the middle.

    A sector is resolved if two things hold. Its mean valley / mean peak is below 0.735, Rayleigh's criterion, which Hallen
    et al. propose for the pairs of hot-rod phantoms. And noise would make so large a difference of both means with a chance
    below 0.1 %: it is compared with how rods scatter around their mean, and valleys around theirs (Student's t test of two
    samples). Pairs by themselves prove nothing: in noise without any rods a third of the sectors may meet the first
    condition, but less than 0.1 % met both. Contrast recovery is the mean peak minus the mean valley, by the same of the
    phantom: it is 1 only where the volume's values are right, too.

    Parameters
    ----------
    volume
        A volume of activity, kBq/mL, or mu, 1/mm, on any grid, turned or not.
    phantom
        A `DerenzoPhantom`, or any other one with `DerenzoRods` among its shapes.
    pose
        World-from-phantom (4, 4), mm, as for ``phantom.voxelize(grid, pose)``.
    progress
        Called as ``progress(done, total)`` after each sector; may raise `Cancelled`.

    Returns
    -------
    DerenzoScore
        A sequence with an item for each sector: rod_diameter (mm), valley_to_peak, resolved, contrast_recovery, chance,
        profiles. They are NaN, and the item's `note` says why, in a sector with fewer than two rods, with rods thinner than
        a voxel or beside the volume, of whose length the volume covers less than a diameter, or that hold the same as what
        is between them.

    Raises
    ------
    InputError
        If the phantom has no Derenzo rods, or the volume holds another quantity.

    References
    ----------
    Hallen, Schug, Schulz 2020, "Comments on the NEMA NU 4-2008 standard on performance measurement of small animal
    positron emission tomographs", EJNMMI Physics 7:12. Student 1908, "The probable error of a mean", Biometrika 6:1-25.
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
        tell(progress, done, len(numbered))
    return DerenzoScore(tuple(sectors))


@dataclass(frozen=True, eq=False)
class _Sector:
    """Sector of a phantom's rods in a volume. Positions (…, 3) are in the rods' own frame, mm."""

    volume: Volume
    phantom: Phantom
    world_from_phantom: Floats
    rods: DerenzoRods
    sector: int

    def score(self) -> DerenzoSector:
        diameter = float(self.rods.rod_diameters[self.sector])
        if note := self._missing(diameter):
            return DerenzoSector(diameter, np.nan, np.nan, note=note)
        rods, between = self._true_values()
        if np.isclose(rods, between, rtol=1e-9, atol=0):
            note = f"the rods hold the same {self.volume.quantity} as what is between them"
            return DerenzoSector(diameter, np.nan, np.nan, note=note)
        profiles = self._profiles(diameter, rods > between)
        peak = float(np.mean([profile.peak for profile in profiles]))
        valley = float(np.mean([profile.valley for profile in profiles]))
        ratio, note = (valley / peak, "") if peak > 0 else (np.nan, "the peaks are not above 0")
        contrast = (peak - valley) / abs(rods - between)
        return DerenzoSector(diameter, ratio, contrast, tuple(profiles), note, self._chance(profiles))

    def _chance(self, profiles: list[RodProfile]) -> float:
        """Return the one-sided p-value of the difference of rods and valleys, by Student's t."""
        values = np.array([profile.values for profile in profiles]) * (1 if profiles[0].is_hot else -1)
        which = np.unique(self._pairs, return_inverse=True)[1].ravel()
        rods = np.bincount(which, values[:, [0, -1]].ravel()) / np.bincount(which)
        between = values[:, _ALONG // 2]
        n, m = len(rods), len(between)
        scatter = (n * rods.var() + m * between.var()) * (1 / n + 1 / m)
        # t = sqrt(n + m - 2) tan(angle), and the density of the angle goes with cos(angle)^(n + m - 3).
        angle, shares = np.arctan2(rods.mean() - between.mean(), np.sqrt(scatter)), _middles(999) + 0.5
        beyond, half = (a * np.mean(np.sin(a * shares) ** (n + m - 3)) for a in (np.pi / 2 - angle, np.pi / 2))
        return float(beyond / (2 * half))

    def _missing(self, diameter: float) -> str:
        """Return the reason why the sector has no score, if it has none."""
        if not len(self._centers):
            return "no rods"
        if not len(self._pairs):
            return "a single rod has no neighbour"
        # The sampling of the rods' cross-section where it is coarsest: 1 mm of cubic voxels of 1 mm, however turned.
        voxel = 1 / np.linalg.svd(self._index_from_rods[:3, :2], compute_uv=False)[-1]
        return f"voxels of {voxel:.3g} mm are larger than the rods" if voxel > diameter * (1 + 1e-6) else self._span[2]

    @cached_property
    def _span(self) -> tuple[float, float, str]:
        """The part of the rods' length, from and to in mm along z, that profiles are means over, or why there is none."""
        index = moved(self._index_from_rods, self._centers)
        along = self._index_from_rods[:3, 2]
        ends = np.stack([-0.5 - index, np.array(self.volume.grid.shape) - 0.5 - index])
        ends /= np.where(np.abs(along) < 1e-9, 1e-9, along)
        enter, leave = ends.min(axis=0).max(axis=1), ends.max(axis=0).min(axis=1)  # where the rods' endless axes do so
        if (beside := enter > leave).any():
            return 0.0, 0.0, f"the volume covers {(~beside).sum()} of {len(beside)} rods"
        height, diameter = self.rods.height, self.rods.rod_diameters[self.sector] * (1 - 1e-6)
        low, high = max(float(enter.max()), -height / 2), min(float(leave.min()), height / 2)
        if high - low < min(diameter, height):
            return 0.0, 0.0, f"the volume covers {max(high - low, 0.0):.3g} of {height:g} mm"
        half, least = _LENGTH * height / 2, min(diameter, _LENGTH * height) / 2
        middle = float(np.clip(0, low + least, high - least))
        return min(max(low, -half), middle - least), max(min(high, half), middle + least), ""

    @cached_property
    def _centers(self) -> Floats:
        """The rods' centres (n, 3)."""
        mine = self.rods.rods[self.rods.rods[:, 0] == self.sector]
        return np.concatenate([mine[:, 1:3], np.zeros((len(mine), 1))], axis=1)

    @cached_property
    def _pairs(self) -> Integers:
        """Numbers (P, 2) of rods that are neighbours."""
        most = 2 * self.rods.rod_diameters[self.sector] * (1 + 1e-6)
        places = self._centers
        apart = (np.linalg.norm(places[i + 1 :] - place, axis=1) for i, place in enumerate(places))
        found = [(i, i + 1 + int(j)) for i, each in enumerate(apart) for j in np.flatnonzero(each <= most)]
        return np.array(found, np.int64).reshape(-1, 2)

    @cached_property
    def _world_from_rods(self) -> Floats:
        return self.world_from_phantom @ self.rods.pose

    @cached_property
    def _index_from_rods(self) -> Floats:
        return self.volume.grid.index_from_world @ self._world_from_rods

    def _true_values(self) -> tuple[float, float]:
        """Return the phantom's mean values in the rods and halfway between them, over the scored part of the length."""
        starts, ends = self._centers[self._pairs].transpose(1, 0, 2)
        low, high, _ = self._span
        along = (_middles(9) * (high - low) + (low + high) / 2)[:, None, None] * [0, 0, 1]
        places = [points + along for points in (np.concatenate([starts, ends]), (starts + ends) / 2)]
        placed = (moved(self.rods.pose, points.reshape(-1, 3)) for points in places)
        rods, between = (self.phantom.values(points, quantity=self.volume.quantity).mean() for points in placed)
        return float(rods), float(between)

    def _profiles(self, diameter: float, is_hot: bool) -> list[RodProfile]:
        low, high, _ = self._span
        voxels = (high - low) * np.linalg.norm(self._index_from_rods[:3, 2])
        depths = _middles(max(2, int(np.ceil(2 * voxels)))) * (high - low)
        aside = _middles(_ACROSS) * _WIDTH * diameter
        starts, ends = (self._centers[self._pairs] + [0, 0, (low + high) / 2]).transpose(1, 0, 2)
        lines = starts[:, None] + np.linspace(0, 1, _ALONG)[:, None] * (ends - starts)[:, None]  # (P, points, 3)
        normals = np.cross([0.0, 0.0, 1.0], ends - starts)
        normals /= np.linalg.norm(normals, axis=1)[:, None]
        offsets = aside[:, None, None] * normals[:, None, None] + depths[:, None] * [0, 0, 1]  # (P, across, depths, 3)
        values = np.empty(lines.shape[:2])
        world = self._world_from_rods
        step = max(1, _BLOCK // (_ALONG * _ACROSS * len(depths)))
        for first in range(0, len(lines), step):
            part = slice(first, first + step)
            points = lines[part, :, None, None] + offsets[part, None]
            samples = values_at(self.volume, moved(world, points.reshape(-1, 3)))
            values[part] = samples.reshape(points.shape[:-1]).mean(axis=(2, 3), dtype=np.float64)
        lines = moved(world, lines)
        return [RodProfile(freeze(p), freeze(v), is_hot) for p, v in zip(lines, values, strict=True)]


def _middles(count: int) -> Floats:
    """Return the middles of so many equal parts of the length from -1/2 to 1/2."""
    return (np.arange(count) + 0.5) / count - 0.5
