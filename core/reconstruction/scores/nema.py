"""Contrast and background variability of the NEMA body phantom."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...arrays import ArrayLike, Floats
from ...errors import InputError
from ...geometry.frames import checked_affine, moved
from ...phantoms.nema import NemaBody, outline_distance, sphere_positions
from ...validation import freeze, instance
from ...volumes.resampling import values_at
from ...volumes.volume import Volume, require_quantity
from .rows import Rows, aligned_columns, column, json_number

_SLICES = (-20.0, -10.0, 0.0, 10.0, 20.0)  # of the background regions, mm from the spheres' centres
_IN_SLICE = 12  # background regions
_LARGEST = 37.0  # diameter of the background regions that are placed; smaller ones are concentric
_CLEAR = 15.0  # from such a region to the body's outline, to spheres and to the lung insert
_LUNG = 0.6  # of the lung insert's diameter: 30 mm of 50 mm
_STEP = 2.0  # between the places that a background region may take
_POINTS = 8  # of a region, to each of the smallest voxels' faces


@dataclass(frozen=True, eq=False)
class NemaSphere:
    """The score of one sphere."""

    diameter: float
    """mm, inside."""
    center: Floats
    """World point (3,), mm."""
    contrast_recovery: float
    """Percent contrast: 100 for the truth; of spheres without activity, the percent of their cold contrast."""
    background_variability: float
    """Standard deviation of the means of 60 background regions of this diameter, percent of their mean."""


@dataclass(frozen=True, eq=False)
class NemaScore(Rows[NemaSphere]):
    """The scores of all spheres, in the phantom's order; its attributes are arrays (S,) of those of `NemaSphere`."""

    lung_residual: float
    """Mean in the lung insert, percent of that of the background: 0 for the truth; NaN without an insert."""
    background_regions: Floats
    """Centres (60, 3) of the background regions, world mm."""

    diameter = column("diameter", "mm.")
    contrast_recovery = column("contrast_recovery", "Percent.")
    background_variability = column("background_variability", "Percent.")

    @property
    def lines(self) -> list[str]:
        """The scores as a table of text, and a line on the lung insert."""
        percents = ((f"{s.contrast_recovery:.1f} %", f"{s.background_variability:.1f} %") for s in self)
        rows = [(f"{s.diameter:g} mm", *texts) for s, texts in zip(self, percents, strict=True)]
        lung = [] if math.isnan(self.lung_residual) else [self.lung_residual]
        return [
            *aligned_columns(("Spheres", "contrast recovery", "background variability"), rows),
            *(f"Lung insert: {percent:.1f} % of the background remain" for percent in lung),
        ]

    @property
    def record(self) -> dict[str, Any]:
        """The scores as JSON can hold them, None for an unknown number."""
        columns = ("diameter", "contrast_recovery", "background_variability")
        spheres = [{name: getattr(sphere, name) for name in columns} for sphere in self]
        return {"nema": spheres, "lung_residual": json_number(self.lung_residual)}

    @property
    def cells(self) -> list[tuple[str, str]]:
        """Names and values, as text, for the table of Blender's panel."""
        form = "{0.contrast_recovery:.1f} % contrast, {0.background_variability:.1f} % variability"
        return [(f"{sphere.diameter:g} mm sphere", form.format(sphere)) for sphere in self]


def nema_score(volume: Volume, phantom: NemaBody, pose: ArrayLike | None = None) -> NemaScore:
    """Score a reconstructed NEMA body phantom: contrast and background variability by NEMA NU 2-2018, section 7.

    Regions are circles in the phantom's transverse planes; parts of voxels count as such. That of a sphere lies in the plane
    of the spheres' centres and has its inner diameter. Of each diameter there are 12 background regions in each of 5 planes,
    0, 10 and 20 mm from that of the spheres. With the means C_H of a sphere, C_B of the background regions of its diameter,
    their standard deviation SD (n - 1), and the phantom's activities a:

    - contrast recovery, ``100 (C_H / C_B - 1) / (a_H / a_B - 1)``, in NEMA's words percent contrast; for spheres without
      activity this is NEMA's ``100 (1 - C_H / C_B)``;
    - background variability, ``100 SD / C_B``;
    - lung residual, 100 times the mean in the lung insert (circles of 0.6 of its diameter, all planes) by C_B of the largest
      regions.

    NEMA places the background regions by hand: 37 mm wide, at least 15 mm from the outline and from any sphere. Here they
    also keep that distance from the insert, and are those 12 which lie farthest apart when chosen one after the other; there
    is too little room for 12 that do not overlap at all. Smaller ones are concentric.

    Parameters
    ----------
    volume
        A volume of activity, kBq/mL, on any grid that contains all regions.
    phantom
    pose
        World-from-phantom (4, 4), mm, as for ``phantom.voxelize(grid, pose)``.

    Returns
    -------
    NemaScore
        A sequence with an item for each sphere: diameter, contrast_recovery (%), background_variability (%); and
        lung_residual (%).

    Raises
    ------
    InputError
        If a region lies outside the volume, the background holds nothing in it, or the phantom has no contrast.
    """
    instance(volume, Volume, "nema_score")
    instance(phantom, NemaBody, "nema_score")
    require_quantity(volume.quantity, ("activity",), "nema_score")
    world = np.eye(4) if pose is None else checked_affine(pose, "phantom pose")
    if not phantom.background or phantom.background == phantom.sphere_activity:
        found = f"{phantom.sphere_activity:g} kBq/mL in the spheres, {phantom.background:g} around them"
        raise InputError(f"nema_score: expected spheres in a background of another activity, got {found}")
    places = _background_places(phantom)
    around = np.array([(x, y, z) for z in _SLICES for x, y in places])
    true_contrast = phantom.sphere_activity / phantom.background - 1
    rows = []
    for diameter, (x, y) in zip(phantom.sphere_diameters, sphere_positions(), strict=True):
        if not diameter:
            continue
        place = (x, y, 0.0)
        background = _means(volume, world, around, diameter, "background regions")
        level = _level(background)
        sphere = float(_means(volume, world, np.array([place]), diameter, f"spheres of {diameter:g} mm")[0])
        contrast = 100 * (sphere / level - 1) / true_contrast
        center = freeze(world[:3, :3] @ place + world[:3, 3])
        rows.append(NemaSphere(diameter, center, contrast, 100 * float(background.std(ddof=1)) / level))
    residual = math.nan
    if phantom.lung_diameter:
        middles = np.array([(0.0, 0.0, z) for z in _SLICES])
        lung = _means(volume, world, middles, _LUNG * phantom.lung_diameter, "regions of the lung insert")
        residual = 100 * float(lung.mean()) / _level(_means(volume, world, around, _LARGEST, "background regions"))
    return NemaScore(tuple(rows), residual, freeze(moved(world, around)))


def _level(background: Floats) -> float:
    level = float(background.mean())
    if level <= 0:
        raise InputError(f"nema_score: expected activity in the background, got a mean of {level:g} kBq/mL")
    return level


def _means(volume: Volume, world: Floats, centers: Floats, diameter: float, name: str) -> Floats:
    """Return the means (n,) over circles in the phantom's planes, around `centers` (n, 3) in its frame."""
    grid = volume.grid
    # Points that stand for equal areas of a circle, along a spiral with turns of the golden angle (Vogel 1979).
    count = math.ceil(_POINTS * math.pi / 4 * max(5.0, diameter / grid.spacing.min()) ** 2)
    number = np.arange(count)
    radius, angle = diameter / 2 * np.sqrt((number + 0.5) / count), number * math.pi * (3 - math.sqrt(5))
    circle = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(count)], axis=1)
    points = moved(world, centers[:, None] + circle)
    index = moved(grid.index_from_world, points)
    outside = ((index < -0.5) | (index > np.array(grid.shape) - 0.5)).any(axis=(1, 2))
    if outside.any():
        raise InputError(f"nema_score: {outside.sum()} of {len(centers)} {name} lie outside the volume")
    return values_at(volume, points.reshape(-1, 3), "nearest").reshape(len(centers), -1).mean(axis=1, dtype=np.float64)


def _background_places(phantom: NemaBody) -> Floats:
    """Return x and y (12, 2), mm, of background regions in the phantom's frame."""
    body = next(shape for shape in phantom.shapes if shape.name == "front")
    low = body.position[2] - phantom.length / 2
    if low > min(_SLICES):
        expected = f"a body that reaches from the spheres {-min(_SLICES):g} mm down"
        raise InputError(f"nema_score: expected {expected}, got {-low:g}")
    margin = _CLEAR + _LARGEST / 2
    keep_off = [(d / 2, place) for d, place in zip(phantom.sphere_diameters, sphere_positions(), strict=True) if d]
    if phantom.lung_diameter:
        keep_off.append((phantom.lung_diameter / 2, (0.0, 0.0)))
    half = max(abs(edge) for corner in phantom.box for edge in corner[:2])
    axis = np.arange(-half, half + _STEP, _STEP)
    places = np.array([(x, y) for x in axis for y in axis if outline_distance(x, y) >= margin])
    for radius, place in keep_off:
        places = places[np.linalg.norm(places - place, axis=1) >= radius + margin]
    if len(places) < _IN_SLICE:
        raise InputError("nema_score: there is no room for background regions beside the spheres and the lung insert")
    chosen = [0]
    apart = np.linalg.norm(places - places[0], axis=1)
    while len(chosen) < _IN_SLICE:
        chosen.append(int(apart.argmax()))
        apart = np.minimum(apart, np.linalg.norm(places - places[chosen[-1]], axis=1))
    return places[chosen]
