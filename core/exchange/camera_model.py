"""Views as pinhole cameras: rotation, centre, focal lengths and principal point in pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..geometry.views import Views

# How far a format may move a pixel at the image's edge, in pixels. Views rounded to float32 stay within it.
_TOLERANCE = 1e-3


@dataclass(frozen=True)
class CameraModel:
    """M cameras, right-handed: z forward, x along the columns' index, y along the rows' index.

    World point X, mm, has camera coordinates ``(x, y, z) = rotations[m] @ (X - centers[m])`` and is seen at pixel
    ``principal_points[m] + focal_lengths[m] * (x, y) / z`` (column, row); 0 is the centre of pixel 0.
    """

    rotations: NDArray[np.float64]  # (M, 3, 3), rows x, y, z in the world: proper rotations
    centers: NDArray[np.float64]  # (M, 3), sources, world mm
    focal_lengths: NDArray[np.float64]  # (M, 2), pixels; the first is negative for a mirror image
    principal_points: NDArray[np.float64]  # (M, 2), pixels

    @property
    def translations(self) -> NDArray[np.float64]:
        """t (M, 3), mm, of ``x = R X + t``."""
        return -np.einsum("mij,mj->mi", self.rotations, self.centers)

    @property
    def matrices(self) -> NDArray[np.float64]:
        """Camera matrices K (M, 3, 3)."""
        matrices = np.zeros((len(self.centers), 3, 3))
        matrices[:, [0, 1], [0, 1]] = self.focal_lengths
        matrices[:, :2, 2] = self.principal_points
        matrices[:, 2, 2] = 1.0
        return matrices


def camera_model(views: Views, format: str, mirrored: bool = True) -> CameraModel:
    """The cameras of `views`, exactly, for the `format` that errors name.

    The frames (u, v, k) of views are right-handed with k along the rays, so they are cameras as they stand, with the virtual
    detector and, as (-u, -v, k), with the real one.

    Raises
    ------
    InputError
        The pixel steps are not perpendicular, or an image is mirrored and the format is not `mirrored`.
    """
    pitches, (x, y) = pixel_axes(views)
    _refuse_oblique(views, format)
    z = np.cross(x, y)
    to_detector = views.detector_centers - views.sources
    distance = np.einsum("mi,mi->m", z, to_detector)
    mirror = distance < 0
    if mirror.any() and not mirrored:
        raise InputError(
            f"view {int(np.argmax(mirror))}: format {format} cannot hold a mirror image; reverse its columns or its rows"
        )
    sign = np.where(mirror, -1.0, 1.0)[:, None]
    n_v, n_u = views.shape
    foot = -np.stack([np.einsum("mi,mi->m", axis, to_detector) for axis in (x, y)], axis=1) / pitches
    return CameraModel(
        rotations=np.stack([sign * x, y, sign * z], axis=1),
        centers=views.sources,
        focal_lengths=np.abs(distance)[:, None] / pitches * np.concatenate([sign, np.ones_like(sign)], axis=1),
        principal_points=foot + (np.array([n_u, n_v]) - 1) / 2,
    )


def pixel_axes(views: Views) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Pixel pitches (M, 2), mm, and unit vectors (2, M, 3) along columns' and rows' index.

    The second vectors are made exactly perpendicular to the first.
    """
    pitches = np.stack([np.linalg.norm(views.u_steps, axis=1), np.linalg.norm(views.v_steps, axis=1)], axis=1)
    x = views.u_steps / pitches[:, :1]
    y = views.v_steps / pitches[:, 1:]
    y = y - np.einsum("mi,mi->m", x, y)[:, None] * x
    return pitches, np.stack([x, y / np.linalg.norm(y, axis=1, keepdims=True)])


def _refuse_oblique(views: Views, format: str) -> None:
    """Raise `InputError` naming the first view whose pixel rows are not perpendicular to its columns."""
    pitches, _ = pixel_axes(views)
    cosine = np.einsum("mi,mi->m", views.u_steps, views.v_steps) / pitches.prod(axis=1)
    n_v, n_u = views.shape
    proportion = pitches[:, 1] / pitches[:, 0]
    # How far the last row slides along the columns, and the last column along the rows, in pixels.
    slide = np.abs(cosine) * np.maximum(n_v * proportion, n_u / proportion) / 2
    for m in np.flatnonzero(~(slide <= _TOLERANCE))[:1]:
        raise InputError(
            f"view {m}: format {format} needs pixel rows perpendicular to columns, and these are "
            f"{np.degrees(np.arccos(cosine[m])):.4g} degrees apart"
        )


def with_common_pitch(views: Views, format: str) -> tuple[Views, tuple[float, float]]:
    """The same rays with one pixel size for all detectors, and that size (pitch_u, pitch_v), mm.

    Detectors with smaller pixels are moved away from their sources until their pixels are as large as the largest.
    `InputError` where pixel steps are not perpendicular, or two views' pixels have different proportions.
    """
    _refuse_oblique(views, format)
    pitches, _ = pixel_axes(views)
    proportion = pitches[:, 1] / pitches[:, 0]
    stretch = np.abs(proportion / proportion[0] - 1) * max(views.shape) / 2
    for m in np.flatnonzero(~(stretch <= _TOLERANCE))[:1]:
        raise InputError(
            f"view {m}: format {format} has one pixel size for all views, and its pixels of {pitches[m, 0]:g} x "
            f"{pitches[m, 1]:g} mm have other proportions than view 0's of {pitches[0, 0]:g} x {pitches[0, 1]:g} mm"
        )
    pitch_u, pitch_v = pitches[np.argmax(pitches[:, 0])].tolist()
    scale = pitch_u / pitches[:, :1]
    centers = views.sources + scale * (views.detector_centers - views.sources)
    return Views(views.sources, centers, scale * views.u_steps, scale * views.v_steps, views.shape), (pitch_u, pitch_v)
