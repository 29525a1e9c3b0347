"""How images move with the geometry: derivatives by the modules' places, frames, collimators, holes and pixels."""

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from ..arrays import Array, Floats, Floats32, checked
from ..errors import InputError
from ..geometry.frames import module_frames, tilt_frames
from ..geometry.system import PinholeSystem
from ..volumes.volume import Volume
from .emission import Emission
from .models import each_pixel
from .operator import Projector

# Steps of central differences of what is smooth and quickly made: relative, or rad.
_STEP = 1e-5


class GeometryGradient(NamedTuple):
    """Derivatives of a sum over the images of M modules; each is at constant other numbers."""

    centers: Floats
    """(M, 3): by the pinholes' places, 1/mm, the modules' frames being held."""
    frames: Floats
    """(M, 3, 3): by the entries of ``system.frames()``, rows u, v, k."""
    collimator_length: Floats
    """(M,), 1/mm, with the pixels of the crystal as they are, as the others."""
    pinhole_diameter: Floats
    """(M,), 1/mm."""
    pitch: Floats
    """(M, 2): by the pixels' sizes along u and v on the crystal, 1/mm, around the image's middle."""
    offset: Floats
    """(M, 2): by the image's middle along u and v on the crystal, 1/mm; that of a virtual detector is point-inverted."""

    def by_columns(self, system: PinholeSystem) -> tuple[Floats, Floats]:
        """Derivatives by ``system.centers``, with which frames turn, and by ``system.tilt``: (M, 3), 1/mm and 1/rad."""
        by_centers, by_tilt = self.centers.copy(), np.empty_like(self.centers)
        for axis, step in enumerate(_STEP * np.eye(3)):
            far = step * system.pinhole_distance[:, None]
            aimed = tilt_frames(module_frames(system.centers + far), system.tilt)
            aimed = aimed - tilt_frames(module_frames(system.centers - far), system.tilt)
            nominal = module_frames(system.centers)
            turned = tilt_frames(nominal, system.tilt + step) - tilt_frames(nominal, system.tilt - step)
            by_centers[:, axis] += np.einsum("mij,mij->m", self.frames, aimed) / (2 * far[:, axis])
            by_tilt[:, axis] = np.einsum("mij,mij->m", self.frames, turned) / (2 * _STEP)
        return by_centers, by_tilt


def geometry_gradient(A: Projector, volume: Volume | Floats | Floats32, images: Floats | Floats32) -> GeometryGradient:
    """Of the sum of `images` times ``A(volume)``, the derivatives by the geometry.

    They are exact derivatives of what `A` computes, but for the few places where the number of a voxel's parts, of cells or
    of planes changes. Attenuated, there are more such places: at each, rays pass from voxel to voxel. With float64 they hold
    to 1e-8 (``Projector(..., double=True)``), else as far as float32 does.

    Parameters
    ----------
    A
        Of `Emission` by its depth-dependent response (hole "auto" or "depth"), in numpy.
    volume, images
        (n_x, n_y, n_z), or a `Volume`; and (M, n_v, n_u). Of a batch of both, with one axis more before, the sum, which
        takes less time than one by one.

    Raises
    ------
    InputError
        Another model or shape; voxels so close to a pinhole that rays project them.
    """
    if A._parts:
        of_parts = [geometry_gradient(part, volume, images) for part in A._parts]
        return GeometryGradient(*(np.sum(own, axis=0) for own in zip(*of_parts, strict=True)))
    holes, model = A._depths, A.model
    if holes is None or not isinstance(model, Emission):
        expected = "a projector of Emission by hole 'depth'; those by rays are in `emission_images`"
        raise InputError(f"geometry gradient: expected {expected}")
    if A._close_parts:
        number = model.system.numbers[A._close_parts[0][0]]
        close = f"voxels before pinhole {number} are too close to it"
        raise InputError(f"geometry gradient: {close}; take a smaller grid")
    array = A._check(volume)
    array = array.reshape(-1, *A.shape_in)
    given = checked(images, "images", A.shape_out, A._float64, batch=True).reshape(-1, *A.shape_out)
    if len(given) != len(array):
        raise InputError(f"geometry gradient: {len(array)} volumes, but images of {len(given)}")
    volumes, functions, threads = A._depth_arguments(array)
    responded = np.stack([np.asarray(A._responded(each.astype(volumes.dtype, copy=False))) for each in given])
    centers, frames, by = holes.gradient(volumes, responded, functions, threads)
    u, v, _ = model.system.frames().transpose(1, 0, 2)
    # Along a real detector, steps go backwards.
    signs = np.sign([np.einsum("mi,mi->m", s, a) for s, a in ((A.views.v_steps, v), (A.views.u_steps, u))]).T
    diameter = by["diameter"] * _effective_rise(model)
    pitch, offset = ((by[name] * signs)[:, ::-1] for name in ("pitch", "first"))
    pitch = pitch + sum(map(partial(_by_blur, A), volumes, given))
    return GeometryGradient(centers, frames, by["length"], diameter, pitch, offset)


def _effective_rise(model: Emission) -> Floats:
    """The derivative of the effective diameter by Paix, which the response is made of, by the diameter (M,)."""
    d = model.system.pinhole_diameter
    optics = replace(model.optics, edge="paix", plate_thickness=None)
    more, less = (optics.effective_diameter(d * scale) for scale in (1 + _STEP, 1 - _STEP))
    return np.asarray((more - less) / (2 * _STEP * d))


def _by_blur(A: Projector, volume: Array, images: Array) -> Array:
    """Derivatives through the detector's blur by the pixels' sizes along u and v, (M, 2)."""
    by, holes, views, model = np.zeros((len(images), 2)), A._depths, A.views, A.model
    images = images * each_pixel(model.efficiency)
    if holes is None or not isinstance(model, Emission) or model.response(views, 0) is None:
        return by
    scales = 1 + _STEP, 1 - _STEP
    wide, narrow = (replace(views, u_steps=a * views.u_steps, v_steps=a * views.v_steps) for a in scales)
    for m, image in enumerate(holes.images(volume, *A._depth_arguments(volume)[1:])):
        (v, u), more, less = (model.response(each, m) for each in (views, wide, narrow))  # type: ignore[misc]
        rise_v, rise_u = ((a - b) / (2 * _STEP) for a, b in zip(more, less, strict=True))  # type: ignore[arg-type]
        pitch = model.crystal_pitch(views, m)
        by[m, 0] = (images[m] * (v @ image @ rise_u.T)).sum() / pitch[0]
        by[m, 1] = (images[m] * (rise_v @ image @ u.T)).sum() / pitch[1]
    return by
