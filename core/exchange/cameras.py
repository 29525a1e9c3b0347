"""Views as pinhole cameras: orientation, focal lengths and principal point in pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..geometry.views import Views

# What a format may move a pixel at the image's edge, in pixels: views rounded to float32 are still good.
_TOLERANCE = 1e-3


@dataclass(frozen=True)
class Cameras:
    """M cameras that look along +z with x along the columns' index and y along the rows' index, right-handed.

    World point X, mm, lies at ``(x, y, z) = rotations[m] @ (X - centers[m])`` and is seen in the array's pixel
    ``principal_points[m] + focal_lengths[m] * (x, y) / z``, column first, 0 at the centre of pixel 0.

    Attributes
    ----------
    rotations : array (M, 3, 3)
        Rows x, y, z in the world: proper rotations.
    centers : array (M, 3)
        Sources, world mm.
    focal_lengths : array (M, 2)
        Pixels; the first is negative where the image is mirrored, which no rotation can do.
    principal_points : array (M, 2)
        Pixels.
    """

    rotations: NDArray[np.float64]
    centers: NDArray[np.float64]
    focal_lengths: NDArray[np.float64]
    principal_points: NDArray[np.float64]

    @property
    def translations(self) -> NDArray[np.float64]:
        """t (M, 3), mm, of ``x = R X + t``."""
        return -np.einsum("mij,mj->mi", self.rotations, self.centers)


def cameras(views: Views, format: str, mirrored: bool = True) -> Cameras:
    """The cameras of `views`, exactly.

    Module frames (u, v, k) are right-handed and k looks along the rays, so they are cameras as they stand, both for the
    virtual detector and (x = -u, y = -v, z = k) for the real one.

    Parameters
    ----------
    views
    format
        Whose limits an error tells of.
    mirrored
        Whether it can hold an image whose columns and rows make it a mirror image.

    Raises
    ------
    InputError
        The pixel steps are not perpendicular, or the image is mirrored and must not be.
    """
    refuse_oblique(views, format)
    pitches, axes = pixel_axes(views)
    x, y = axes
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
    focal = np.abs(distance)[:, None] / pitches
    foot = -np.stack([np.einsum("mi,mi->m", axis, to_detector) for axis in axes], axis=1) / pitches
    return Cameras(
        rotations=np.stack([sign * x, y, sign * z], axis=1),
        centers=views.sources,
        focal_lengths=focal * np.concatenate([sign, np.ones_like(sign)], axis=1),
        principal_points=foot + (np.array([n_u, n_v]) - 1) / 2,
    )


def first_off(pixels: NDArray[np.float64]) -> int | None:
    """The first view that a format would move by more than rounding does, from (M,) distances at the image's edge."""
    off = ~(pixels <= _TOLERANCE)
    return int(np.argmax(off)) if off.any() else None


def pixel_axes(views: Views) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Pixel pitches (M, 2), mm, and unit vectors (2, M, 3) along columns' and rows' index.

    Rows that are perpendicular to columns but for rounding are made so.
    """
    pitches = np.stack([np.linalg.norm(views.u_steps, axis=1), np.linalg.norm(views.v_steps, axis=1)], axis=1)
    x = views.u_steps / pitches[:, :1]
    y = views.v_steps / pitches[:, 1:]
    y = y - np.einsum("mi,mi->m", x, y)[:, None] * x
    return pitches, np.stack([x, y / np.linalg.norm(y, axis=1, keepdims=True)])


def refuse_oblique(views: Views, format: str) -> None:
    """Raise `InputError` naming a view whose columns are not perpendicular to its rows."""
    u, v = views.u_steps, views.v_steps
    pitches = np.stack([np.linalg.norm(u, axis=1), np.linalg.norm(v, axis=1)])
    cosine = np.einsum("mi,mi->m", u, v) / pitches.prod(axis=0)
    n_v, n_u = views.shape
    # How far the last row slides along the columns, and the last column along the rows, in pixels.
    slide = np.abs(cosine) * np.maximum(n_v * pitches[1] / pitches[0], n_u * pitches[0] / pitches[1]) / 2
    m = first_off(slide)
    if m is not None:
        raise InputError(
            f"view {m}: format {format} needs pixel rows perpendicular to columns, and these are "
            f"{np.degrees(np.arccos(cosine[m])):.4g} degrees apart"
        )


def with_common_pitch(views: Views, format: str) -> tuple[Views, tuple[float, float]]:
    """The same rays by detectors of one pixel size, and that size (pitch_u, pitch_v), mm.

    Detectors of smaller pixels are moved away from their sources until all are as large as the largest.

    Raises
    ------
    InputError
        The pixel steps are not perpendicular, or the pixels of two views have different proportions.
    """
    refuse_oblique(views, format)
    pitches, _ = pixel_axes(views)
    n_v, n_u = views.shape
    proportion = pitches[:, 1] / pitches[:, 0]
    off = np.abs(proportion / proportion[0] - 1) * max(n_v, n_u) / 2
    m = first_off(off)
    if m is not None:
        raise InputError(
            f"view {m}: format {format} has one pixel size for all views, and its pixels of {pitches[m, 0]:g} x "
            f"{pitches[m, 1]:g} mm have other proportions than view 0's of {pitches[0, 0]:g} x {pitches[0, 1]:g} mm"
        )
    largest = pitches[np.argmax(pitches[:, 0])]
    away = largest[0] / pitches[:, :1]
    moved = Views(
        views.sources,
        views.sources + away * (views.detector_centers - views.sources),
        away * views.u_steps,
        away * views.v_steps,
        views.shape,
    )
    return moved, (float(largest[0]), float(largest[1]))
