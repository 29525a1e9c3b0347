"""Contrast recovery and background variability of a reconstructed NEMA body phantom."""

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

_SLICES = (-20.0, -10.0, 0.0, 10.0, 20.0)  # z of the background regions, mm from the spheres' centres
_PER_SLICE = 12  # number of background regions in each slice
_LARGEST = 37.0  # diameter of the largest background regions, mm; smaller ones are concentric with these
_CLEARANCE = 15.0  # smallest distance of a region from the body's outline, spheres and lung insert, mm
_LUNG = 0.6  # diameter of the lung's regions in units of the lung insert's diameter: 30 mm of 50 mm
_STEP = 2.0  # distance between possible positions of background regions, mm
_POINTS = 8  # number of points of a region per face area of the smallest voxels


@dataclass(frozen=True, eq=False)
class NemaSphere:
    """Score of one sphere of a NEMA body phantom."""

    diameter: float
    """Inner diameter, mm."""
    center: Floats
    """Centre (3,) in the world, mm."""
    contrast_recovery: float
    """Percent contrast: 100 for the truth; for spheres without activity, the percentage of the true cold contrast."""
    background_variability: float
    """Standard deviation of the means of 60 background regions of this diameter, percent of their mean."""


@dataclass(frozen=True, eq=False)
class NemaScore(Rows[NemaSphere]):
    """Scores of all spheres in the phantom's order; the attributes of `NemaSphere` are attributes here as arrays (S,)."""

    lung_residual: float
    """Mean in the lung insert, percent of the background's mean: 0 for the truth; NaN without an insert."""
    background_regions: Floats
    """Centres (60, 3) of the background regions, world mm."""

    diameter = column("diameter", "Inner diameters (S,), mm.")
    contrast_recovery = column("contrast_recovery", "Contrast recovery (S,), percent.")
    background_variability = column("background_variability", "Background variability (S,), percent.")

    @property
    def lines(self) -> list[str]:
        """Scores as lines of a text table, and a line on the lung insert if there is one."""
        percents = ((f"{s.contrast_recovery:.1f} %", f"{s.background_variability:.1f} %") for s in self)
        rows = [(f"{s.diameter:g} mm", *texts) for s, texts in zip(self, percents, strict=True)]
        lung = [] if math.isnan(self.lung_residual) else [self.lung_residual]
        return [
            *aligned_columns(("Spheres", "contrast recovery", "background variability"), rows),
            *(f"Lung insert: {percent:.1f} % of the background remain" for percent in lung),
        ]

    @property
    def record(self) -> dict[str, Any]:
        """Scores in types that JSON can hold, None for an unknown number."""
        columns = ("diameter", "contrast_recovery", "background_variability")
        spheres = [{name: getattr(sphere, name) for name in columns} for sphere in self]
        return {"nema": spheres, "lung_residual": json_number(self.lung_residual)}

    @property
    def cells(self) -> list[tuple[str, str]]:
        """Names and values, as text, for the table of Blender's panel."""
        form = "{0.contrast_recovery:.1f} % contrast, {0.background_variability:.1f} % variability"
        return [(f"{sphere.diameter:g} mm sphere", form.format(sphere)) for sphere in self]


def nema_score(volume: Volume, phantom: NemaBody, pose: ArrayLike | None = None) -> NemaScore:
    """Compute percent contrast and background variability of a NEMA body phantom, by NEMA NU 2-2018, section 7.

    Regions are circles in the phantom's transverse planes, in which voxels are weighted by the part inside. A sphere's
    region lies in the plane of the spheres' centres and has the sphere's inner diameter. For each diameter there are 12
    background regions in each of 5 planes, 0, 10 and 20 mm from the plane of the spheres. With the mean C_H of a sphere, the
    mean C_B of the background regions of its diameter, their standard deviation SD (n - 1), and the phantom's activities a:

    - contrast recovery is ``100 (C_H / C_B - 1) / (a_H / a_B - 1)``, NEMA's percent contrast; for spheres without activity
      this is NEMA's ``100 (1 - C_H / C_B)``;
    - background variability is ``100 SD / C_B``;
    - lung residual is 100 times the mean in the lung insert (circles of 0.6 of its diameter, all planes), divided by C_B of
      the largest regions.

    NEMA places the background regions by hand: 37 mm wide, at least 15 mm from the outline and from any sphere. Here they
    also keep this distance from the insert, and are chosen one after the other as far as possible from those chosen already;
    there is too little room for 12 regions that do not overlap at all. Smaller regions are concentric with these.

    Parameters
    ----------
    volume
        Volume of activity, kBq/mL, on any grid that contains all regions.
    phantom
        NEMA body phantom of which the volume is an image.
    pose
        World-from-phantom (4, 4), mm, as for ``phantom.voxelize(grid, pose)``.

    Returns
    -------
    NemaScore
        Sequence with an item for each sphere: diameter (mm), contrast_recovery (%), background_variability (%); and the
        attribute lung_residual (%).

    Raises
    ------
    InputError
        A region lies outside the volume, the mean of the volume's background is not above 0, or the phantom has no contrast.
    """
    instance(volume, Volume, "nema_score")
    instance(phantom, NemaBody, "nema_score")
    require_quantity(volume.quantity, ("activity",), "nema_score")
    world = np.eye(4) if pose is None else checked_affine(pose, "phantom pose")
    if not phantom.background or phantom.background == phantom.sphere_activity:
        activities = f"{phantom.sphere_activity:g} kBq/mL in the spheres, {phantom.background:g} around them"
        raise InputError(f"nema_score: expected spheres in a background of another activity, got {activities}")
    positions = _background_positions(phantom)
    background_centers = np.array([(x, y, z) for z in _SLICES for x, y in positions])
    true_contrast = phantom.sphere_activity / phantom.background - 1
    rows = []
    for diameter, (x, y) in zip(phantom.sphere_diameters, sphere_positions(), strict=True):
        if not diameter:
            continue
        position = (x, y, 0.0)
        background = _means(volume, world, background_centers, diameter, "background regions")
        level = _background_level(background)
        sphere = float(_means(volume, world, np.array([position]), diameter, f"spheres of {diameter:g} mm")[0])
        contrast = 100 * (sphere / level - 1) / true_contrast
        center = freeze(world[:3, :3] @ position + world[:3, 3])
        rows.append(NemaSphere(diameter, center, contrast, 100 * float(background.std(ddof=1)) / level))
    residual = math.nan
    if phantom.lung_diameter:
        lung_centers = np.array([(0.0, 0.0, z) for z in _SLICES])
        lung = _means(volume, world, lung_centers, _LUNG * phantom.lung_diameter, "regions of the lung insert")
        background = _means(volume, world, background_centers, _LARGEST, "background regions")
        residual = 100 * float(lung.mean()) / _background_level(background)
    return NemaScore(tuple(rows), residual, freeze(moved(world, background_centers)))


def _background_level(background: Floats) -> float:
    """Return the mean C_B of the background regions' means; raise `InputError` unless it is above 0."""
    if (level := float(background.mean())) <= 0:
        raise InputError(f"nema_score: expected activity in the background, got a mean of {level:g} kBq/mL")
    return level


def _means(volume: Volume, world: Floats, centers: Floats, diameter: float, name: str) -> Floats:
    """Return the volume's means (n,) over circles in the phantom's transverse planes.

    `centers` (n, 3) are in the phantom's frame, mm; `world` is the world-from-phantom matrix. Raise `InputError` if a circle
    is not inside the volume; `name` is the name of the circles in the message.
    """
    grid = volume.grid
    # The points stand for equal areas of the circle, along a spiral with turns of the golden angle (Vogel 1979).
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


def _background_positions(phantom: NemaBody) -> Floats:
    """Return x and y (12, 2), mm, of the background regions in the phantom's frame; `InputError` if there is no room."""
    body = next(shape for shape in phantom.shapes if shape.name == "front")
    if (low := body.position[2] - phantom.length / 2) > min(_SLICES):
        expected = f"a body that reaches from the spheres {-min(_SLICES):g} mm down"
        raise InputError(f"nema_score: expected {expected}, got {-low:g}")
    margin = _CLEARANCE + _LARGEST / 2
    obstacles = [(d / 2, center) for d, center in zip(phantom.sphere_diameters, sphere_positions(), strict=True) if d]
    if phantom.lung_diameter:
        obstacles.append((phantom.lung_diameter / 2, (0.0, 0.0)))
    half = max(abs(edge) for corner in phantom.box for edge in corner[:2])
    axis = np.arange(-half, half + _STEP, _STEP)
    positions = np.array([(x, y) for x in axis for y in axis if outline_distance(x, y) >= margin])
    for radius, center in obstacles:
        positions = positions[np.linalg.norm(positions - center, axis=1) >= radius + margin]
    if len(positions) < _PER_SLICE:
        raise InputError("nema_score: there is no room for background regions beside the spheres and the lung insert")
    chosen = [0]
    distances = np.linalg.norm(positions - positions[0], axis=1)  # to the nearest chosen position
    while len(chosen) < _PER_SLICE:
        chosen.append(int(distances.argmax()))
        distances = np.minimum(distances, np.linalg.norm(positions - positions[chosen[-1]], axis=1))
    return positions[chosen]
