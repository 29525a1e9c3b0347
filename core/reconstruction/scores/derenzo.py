"""Resolution score of reconstructed Derenzo rods: valley-to-peak ratio and contrast of each sector."""

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
"""Valley-to-peak ratio of two points that are just resolved, by Rayleigh's criterion."""

RESOLVED_CHANCE, VISIBLE_CHANCE = 0.001, 0.02
"""Probability below which noise does not explain the contrast of a sector that is resolved, or that is visible."""

RESOLVED_SLICES = 0.75
"""Share of the pairs' slices in which a resolved sector's valley-to-peak ratio is below 0.735 at least."""

LIGHTS = {"green": "resolved", "amber": "seen, not resolved", "red": "not resolved"}
"""Verdict on a sector by the colour of its dot. Amber: its rods stand out of the noise, but not enough to be resolved."""

# Profiles are means over the central share `_LENGTH` of the rods' length, since the rods' ends blur into their surroundings.
_LENGTH = 0.5
_WIDTH = 0.5  # width that profiles are means over, in rod diameters
_ACROSS = 5  # number of lines across that width
_ALONG = 33  # number of points of a profile; odd, so that one lies halfway
_BLOCK = 1 << 20  # number of samples that are computed at once


@dataclass(frozen=True, eq=False)
class RodProfile:
    """Profile of values from a rod's centre to its neighbour's centre, averaged along the rods and across the line."""

    points: Floats
    """World points (n, 3), mm, in the middle of the averaged length; the first and the last are on the rods' axes."""
    values: Floats
    """Values (n,) at the points, in the volume's unit."""
    is_hot: bool
    """Whether the rods have larger values than the material between them."""
    slices_resolved: float
    """Share of the slices along the rods, half a voxel apart, in which the valley-to-peak ratio is below 0.735."""

    @property
    def peak(self) -> float:
        """Mean of the values at both rods' centres; for cold rods, the value halfway between them."""
        return float(np.mean(self.values[[0, -1]] if self.is_hot else self.values[_ALONG // 2]))

    @property
    def valley(self) -> float:
        """Value halfway between the rods; for cold rods, the mean of the values at their centres."""
        return float(np.mean(self.values[_ALONG // 2] if self.is_hot else self.values[[0, -1]]))

    @property
    def valley_to_peak(self) -> float:
        """Valley divided by peak; infinite if the peak is not above 0."""
        return self.valley / self.peak if self.peak > 0 else np.inf


@dataclass(frozen=True, eq=False)
class DerenzoSector:
    """Score of one sector of a Derenzo phantom. Unknown numbers are NaN, and `note` gives the reason."""

    rod_diameter: float
    """Diameter of the sector's rods, mm."""
    valley_to_peak: float
    """Mean valley divided by mean peak of all pairs of neighbours: 0 with perfect contrast, 1 if no rods are visible."""
    contrast_recovery: float
    """Mean peak minus mean valley, divided by the same difference of the phantom."""
    profiles: tuple[RodProfile, ...] = ()
    """Profiles of all pairs of neighbouring rods."""
    note: str = ""
    """Reason why a number is NaN; "" if all are known."""
    chance: float = np.nan
    """Probability that noise alone makes so large a difference of mean peak and mean valley (Student's t test)."""

    @property
    def resolved(self) -> float:
        """Verdict: 1 if the means, the noise and the slices say so, see `derenzo_score`, else 0; NaN if unknown."""
        is_resolved = self.valley_to_peak < RESOLVED_BELOW and self.chance < RESOLVED_CHANCE
        return float(is_resolved and self.slices_resolved >= RESOLVED_SLICES) if self.profiles else np.nan

    @property
    def slices_resolved(self) -> float:
        """Share of the slices of all pairs with a valley-to-peak ratio below 0.735; lower where rods are speckled."""
        return float(np.mean([profile.slices_resolved for profile in self.profiles] or np.nan))

    @property
    def pairs_resolved(self) -> float:
        """Share of the pairs of neighbours with a valley-to-peak ratio below 0.735; no proof by itself, see `resolved`."""
        return float(np.mean([profile.valley_to_peak < RESOLVED_BELOW for profile in self.profiles] or np.nan))

    @property
    def light(self) -> str:
        """Colour of the sector's dot, a key of `LIGHTS`: "green", "amber" or "red"; "" if unknown."""
        if self.note or not self.profiles:
            return ""
        return "green" if self.resolved else "amber" if self.chance < VISIBLE_CHANCE else "red"

    @property
    def contrast(self) -> str:
        """Contrast recovery as text, in percent."""
        return f"{np.round(100 * self.contrast_recovery) + 0.0:.0f} %"

    @property
    def cells(self) -> tuple[str, str, str, str]:
        """Row of a table: rod diameter, `light`, valley-to-peak ratio or the reason for none, and contrast recovery."""
        score = (self.note, "") if self.note else (f"{self.valley_to_peak:.2f}", self.contrast)
        return f"{self.rod_diameter:g} mm", self.light, *score

    @property
    def words(self) -> str:
        """Score in one line: verdict, valley-to-peak ratio and contrast recovery; or the reason for no score."""
        return self.note or f"{LIGHTS[self.light]}, valley/peak {self.valley_to_peak:.2f}, contrast {self.contrast}"


class DerenzoScore(Rows[DerenzoSector]):
    """Scores of all sectors in the phantom's order; the attributes of `DerenzoSector` are attributes here as arrays (S,)."""

    rod_diameter = column("rod_diameter", "Rod diameters (S,), mm; 0 for a sector without rods.")
    valley_to_peak = column("valley_to_peak", "Mean valley divided by mean peak (S,).")
    resolved = column("resolved", "Verdicts (S,): 1 if the sector is resolved, else 0.")
    contrast_recovery = column("contrast_recovery", "Contrast divided by the phantom's contrast (S,).")

    @property
    def lines(self) -> list[str]:
        """Scores as lines of text, one for each sector with rods."""
        texts = ((sector.rod_diameter, ": ".join(filter(None, (sector.light, sector.words)))) for sector in self)
        return [f"{diameter:g} mm  {text}" for diameter, text in texts if diameter]

    @property
    def record(self) -> dict[str, Any]:
        """Scores in types that JSON can hold, None for an unknown number."""
        names = ("rod_diameter", "valley_to_peak", "contrast_recovery", "chance", "pairs_resolved", "slices_resolved")
        return {"derenzo": [
            {**{name: json_number(getattr(sector, name)) for name in names}, "pairs": len(sector.profiles),
             "note": sector.note, "light": sector.light or None,
             "resolved": None if np.isnan(sector.resolved) else bool(sector.resolved)}
            for sector in self
        ]}  # fmt: skip


def derenzo_score(
    volume: Volume, phantom: Phantom, pose: ArrayLike | None = None, progress: Progress | None = None
) -> DerenzoScore:
    """Score a reconstruction of Derenzo rods: the resolved sectors and their contrast recovery.

    Neighbours are rods of one sector whose centres are two diameters apart. A profile runs from centre to centre: the voxels
    are interpolated linearly and averaged over the middle half of the rods' length and over half a diameter across the line.
    The peak is the mean of the values at both centres, the valley is the value halfway between them; the largest and the
    smallest value of the profile would differ by noise alone. (For cold rods, the peak is halfway and the valley at the
    centres.) If the volume covers only a part of the rods' length, the mean is over the covered part of the middle half,
    extended to at least one diameter as near to the middle as possible.

    A sector is resolved under three conditions. Its mean valley / mean peak is below 0.735, Rayleigh's criterion, which
    Hallen et al. propose for the pairs of hot-rod phantoms. The probability that noise makes so large a difference of both
    means is below 0.1 %, by Student's two-sample t test, which compares it with the scatter of the rods and of the valleys.
    And in three quarters of the pairs' slices along the rods that ratio is below 0.735, too: means over the rods' length
    hide speckle that a reader of the slices sees. Single pairs prove nothing: in noise without any rods a third of the
    sectors may fulfil the first condition, but less than 0.1 % fulfilled the first two. Contrast recovery is the mean peak
    minus the mean valley, divided by the same difference of the phantom: it is 1 only if the values are right, too.

    Parameters
    ----------
    volume
        Volume of activity, kBq/mL, or mu, 1/mm, on any grid, rotated or not.
    phantom
        `DerenzoPhantom`, or any other phantom with `DerenzoRods` among its shapes.
    pose
        World-from-phantom (4, 4), mm, as for ``phantom.voxelize(grid, pose)``.
    progress
        Called as ``progress(done, total)`` after each sector; may raise `Cancelled`.

    Returns
    -------
    DerenzoScore
        Sequence with an item for each sector: rod_diameter (mm), valley_to_peak, resolved, contrast_recovery, chance,
        profiles. The numbers are NaN, and the item's `note` gives the reason, for a sector with fewer than two rods, with
        rods thinner than a voxel, outside the volume or covered over less than a diameter of their length, or with the same
        value as the material between them.

    Raises
    ------
    InputError
        The phantom has no Derenzo rods, or the volume holds another quantity.

    References
    ----------
    Hallen, Schug, Schulz 2020, "Comments on the NEMA NU 4-2008 standard on performance measurement of small animal
    positron emission tomographs", EJNMMI Physics 7:12. Student 1908, "The probable error of a mean", Biometrika 6:1-25.
    """
    instance(volume, Volume, "derenzo_score")
    instance(phantom, Phantom, "derenzo_score")
    require_quantity(volume.quantity, QUANTITIES, "derenzo_score")
    world_from_phantom = np.eye(4) if pose is None else checked_affine(pose, "phantom pose")
    if not (shapes := [shape for shape in phantom.shapes if isinstance(shape, DerenzoRods)]):
        raise InputError(f"derenzo_score: expected a phantom with Derenzo rods, got a {phantom.title} without")
    all_sectors = [(rods, sector) for rods in shapes for sector in range(rods.sectors)]
    scores = []
    for number, (rods, sector) in enumerate(all_sectors, 1):
        scores.append(_SectorScorer(volume, phantom, world_from_phantom, rods, sector).score())
        tell(progress, number, len(all_sectors))
    return DerenzoScore(tuple(scores))


@dataclass(frozen=True, eq=False)
class _SectorScorer:
    """Computation of the score of one sector of a phantom's rods; points (…, 3) are in the frame of the rods, mm."""

    volume: Volume
    phantom: Phantom
    world_from_phantom: Floats
    rods: DerenzoRods
    sector: int

    def score(self) -> DerenzoSector:
        """Return the sector's score, or a score of NaN with the reason as its note."""
        diameter = float(self.rods.rod_diameters[self.sector])
        if note := self._obstacle(diameter):
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
        """Return the probability that noise makes the difference of rods and valleys (one-sided p of Student's t test)."""
        values = np.array([profile.values for profile in profiles]) * (1 if profiles[0].is_hot else -1)
        rod_numbers = np.unique(self._pairs, return_inverse=True)[1].ravel()
        rods = np.bincount(rod_numbers, values[:, [0, -1]].ravel()) / np.bincount(rod_numbers)
        between = values[:, _ALONG // 2]
        n, m = len(rods), len(between)
        scatter = (n * rods.var() + m * between.var()) * (1 / n + 1 / m)
        # t = sqrt(n + m - 2) tan(angle), and the density of the angle is proportional to cos(angle)^(n + m - 3).
        angle, fractions = np.arctan2(rods.mean() - between.mean(), np.sqrt(scatter)), _midpoints(999) + 0.5
        tail, half = (a * np.mean(np.sin(a * fractions) ** (n + m - 3)) for a in (np.pi / 2 - angle, np.pi / 2))
        return float(tail / (2 * half))

    def _obstacle(self, diameter: float) -> str:
        """Return the reason why the sector has no score, or "" if it has one."""
        if not len(self._centers):
            return "no rods"
        if not len(self._pairs):
            return "a single rod has no neighbour"
        # The coarsest sampling distance in the rods' cross-section: 1 mm for cubic voxels of 1 mm in any orientation.
        voxel = 1 / np.linalg.svd(self._index_from_rods[:3, :2], compute_uv=False)[-1]
        return f"voxels of {voxel:.3g} mm are larger than the rods" if voxel > diameter * (1 + 1e-6) else self._span[2]

    @cached_property
    def _span(self) -> tuple[float, float, str]:
        """Range of z, mm, that profiles are means over, as low and high end; and the reason if there is none, else ""."""
        index = moved(self._index_from_rods, self._centers)
        axis = self._index_from_rods[:3, 2]
        ends = np.stack([-0.5 - index, np.array(self.volume.grid.shape) - 0.5 - index])
        ends /= np.where(np.abs(axis) < 1e-9, 1e-9, axis)
        enter, leave = ends.min(axis=0).max(axis=1), ends.max(axis=0).min(axis=1)  # of the rods' infinite axes, mm
        if (outside := enter > leave).any():
            return 0.0, 0.0, f"the volume covers {(~outside).sum()} of {len(outside)} rods"
        height, diameter = self.rods.height, self.rods.rod_diameters[self.sector] * (1 - 1e-6)
        low, high = max(float(enter.max()), -height / 2), min(float(leave.min()), height / 2)
        if high - low < min(diameter, height):
            return 0.0, 0.0, f"the volume covers {max(high - low, 0.0):.3g} of {height:g} mm"
        half, half_least = _LENGTH * height / 2, min(diameter, _LENGTH * height) / 2
        middle = float(np.clip(0, low + half_least, high - half_least))
        return min(max(low, -half), middle - half_least), max(min(high, half), middle + half_least), ""

    @cached_property
    def _centers(self) -> Floats:
        """Centres (n, 3) of the sector's rods."""
        rods = self.rods.rods[self.rods.rods[:, 0] == self.sector]
        return np.concatenate([rods[:, 1:3], np.zeros((len(rods), 1))], axis=1)

    @cached_property
    def _pairs(self) -> Integers:
        """Indices (P, 2) of the pairs of neighbouring rods."""
        limit = 2 * self.rods.rod_diameters[self.sector] * (1 + 1e-6)
        centers = self._centers
        distances = (np.linalg.norm(centers[i + 1 :] - center, axis=1) for i, center in enumerate(centers))
        pairs = [(i, i + 1 + int(j)) for i, row in enumerate(distances) for j in np.flatnonzero(row <= limit)]
        return np.array(pairs, np.int64).reshape(-1, 2)

    @cached_property
    def _world_from_rods(self) -> Floats:
        """World-from-rods matrix (4, 4), mm."""
        return self.world_from_phantom @ self.rods.pose

    @cached_property
    def _index_from_rods(self) -> Floats:
        """Matrix (4, 4) from points in the rods' frame, mm, to voxel indices."""
        return self.volume.grid.index_from_world @ self._world_from_rods

    def _true_values(self) -> tuple[float, float]:
        """Return the phantom's mean values on the rods' axes and halfway between neighbours, over the length of `_span`."""
        starts, ends = self._centers[self._pairs].transpose(1, 0, 2)
        low, high, _ = self._span
        along = (_midpoints(9) * (high - low) + (low + high) / 2)[:, None, None] * [0, 0, 1]
        lines = [points + along for points in (np.concatenate([starts, ends]), (starts + ends) / 2)]
        phantom_points = (moved(self.rods.pose, points.reshape(-1, 3)) for points in lines)
        rods, between = (self.phantom.values(points, quantity=self.volume.quantity).mean() for points in phantom_points)
        return float(rods), float(between)

    def _profiles(self, diameter: float, is_hot: bool) -> list[RodProfile]:
        """Return the profiles of all pairs of neighbouring rods, sampled twice per voxel along the rods."""
        low, high, _ = self._span
        voxels = (high - low) * np.linalg.norm(self._index_from_rods[:3, 2])
        depths = _midpoints(max(2, int(np.ceil(2 * voxels)))) * (high - low)
        aside = _midpoints(_ACROSS) * _WIDTH * diameter
        starts, ends = (self._centers[self._pairs] + [0, 0, (low + high) / 2]).transpose(1, 0, 2)
        lines = starts[:, None] + np.linspace(0, 1, _ALONG)[:, None] * (ends - starts)[:, None]  # (P, points, 3)
        normals = np.cross([0.0, 0.0, 1.0], ends - starts)
        normals /= np.linalg.norm(normals, axis=1)[:, None]
        offsets = aside[:, None, None] * normals[:, None, None] + depths[:, None] * [0, 0, 1]  # (P, across, depths, 3)
        values, shares = np.empty(lines.shape[:2]), np.empty(len(lines))
        world = self._world_from_rods
        step = max(1, _BLOCK // (_ALONG * _ACROSS * len(depths)))
        for first in range(0, len(lines), step):
            block = slice(first, first + step)
            points = lines[block, :, None, None] + offsets[block, None]
            samples = values_at(self.volume, moved(world, points.reshape(-1, 3)))
            slices = samples.reshape(points.shape[:-1]).mean(axis=2, dtype=np.float64)  # (pairs, points, depths)
            values[block] = slices.mean(axis=2)
            rods, between = slices[:, [0, -1]].mean(axis=1), slices[:, _ALONG // 2]
            peaks, valleys = (rods, between) if is_hot else (between, rods)
            shares[block] = ((valleys < RESOLVED_BELOW * peaks) & (peaks > 0)).mean(axis=1)
        lines = moved(world, lines)
        rows = zip(lines, values, shares.tolist(), strict=True)
        return [RodProfile(freeze(p), freeze(v), is_hot, share) for p, v, share in rows]


def _midpoints(n: int) -> Floats:
    """Return the midpoints (n,) of n equal intervals from -1/2 to 1/2."""
    return (np.arange(n) + 0.5) / n - 0.5
