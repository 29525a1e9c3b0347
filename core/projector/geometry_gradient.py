"""Gradients of counts by the geometry: the modules' positions, frames, collimators, holes and pixels."""

from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from ..arrays import Array, Floats, Floats32, checked
from ..errors import InputError
from ..geometry.frames import module_frames, tilt_frames
from ..geometry.system import PinholeSystem
from ..models.model import with_image_axes
from ..pinhole_response.pinhole_operator import PinholeOperator
from ..volumes.volume import Volume
from .operator import Projector

# Step of central differences of smooth and quickly computed quantities: relative, or rad.
_STEP = 1e-5


class GeometryGradient(NamedTuple):
    """Gradient of a sum over the images of M modules; each field is at constant values of the other numbers."""

    centers: Floats
    """(M, 3), by the pinholes' centres at constant frames of the modules, 1/mm."""
    frames: Floats
    """(M, 3, 3), by the entries of ``system.frames()``, rows u, v, k."""
    collimator_length: Floats
    """(M,), by the collimators' lengths at constant pixels on the crystal, 1/mm."""
    pinhole_diameter: Floats
    """(M,), by the holes' diameters, 1/mm."""
    pitch: Floats
    """(M, 2), by the pixels' sizes along u and v on the crystal, 1/mm, around the image's middle."""
    offset: Floats
    """(M, 2), by the position of the image's middle along u and v on the crystal, 1/mm, point-inverted if it is virtual."""

    def by_columns(self, system: PinholeSystem) -> tuple[Floats, Floats]:
        """Return the gradients by ``system.centers`` and by ``system.tilt``, (M, 3) each, 1/mm and 1/rad.

        The modules stay aimed: their frames turn with the centres. How frames turn is a central difference.
        """
        d_centers, d_tilt = self.centers.copy(), np.empty_like(self.centers)
        for axis, step in enumerate(_STEP * np.eye(3)):
            shift = step * system.pinhole_distance[:, None]
            d_frames = tilt_frames(module_frames(system.centers + shift), system.tilt)
            d_frames = d_frames - tilt_frames(module_frames(system.centers - shift), system.tilt)
            d_centers[:, axis] += np.einsum("mij,mij->m", self.frames, d_frames) / (2 * shift[:, axis])
            nominal = module_frames(system.centers)
            d_frames = tilt_frames(nominal, system.tilt + step) - tilt_frames(nominal, system.tilt - step)
            d_tilt[:, axis] = np.einsum("mij,mij->m", self.frames, d_frames) / (2 * _STEP)
        return d_centers, d_tilt


def geometry_gradient(A: Projector, volume: Volume | Floats | Floats32, images: Floats | Floats32) -> GeometryGradient:
    """Return the gradient of the sum of `images` times ``A(volume)`` by the geometry.

    It is the gradient of the images that `A` computes, but for the few geometries at which the number of a voxel's points,
    of cells or of planes changes. With attenuation there are more of these: at each, rays pass from voxel to voxel. In
    float64 it holds to 1e-8 (``Projector(..., double=True)``), else as far as float32 does. The chain rule is analytic, but
    for a few smooth factors, which are central differences (docs/counts.md lists them).

    Parameters
    ----------
    A
        Projector of `Emission` by its depth-dependent response (hole "auto" or "depth"), in numpy.
    volume, images
        Volume (n_x, n_y, n_z) or a `Volume`, and images (M, n_v, n_u). For a batch of both, with one axis more before, the
        result is the sum, which takes less time than one by one.

    Raises
    ------
    InputError
        The projector has another model, the images another shape, or voxels are so close to a pinhole that rays project
        them.
    """
    if A._parts:
        gradients = [geometry_gradient(part, volume, images) for part in A._parts]
        return GeometryGradient(*(np.sum(arrays, axis=0) for arrays in zip(*gradients, strict=True)))
    pinholes = A._pinholes
    model: Any = A.model
    if pinholes is None or not model.has_geometry_gradient:
        expected = "a projector of Emission by hole 'depth'; those by rays are in `emission_images`"
        raise InputError(f"geometry gradient: expected {expected}")
    if A._close_parts:
        number = model.system.numbers[A._close_parts[0][0]]
        close = f"voxels before pinhole {number} are too close to it"
        raise InputError(f"geometry gradient: {close}; take a smaller grid")
    array = A._check(volume)
    array = array.reshape(-1, *A.shape_in)
    batch = checked(images, "images", A.shape_out, A._float64, batch=True).reshape(-1, *A.shape_out)
    if len(batch) != len(array):
        raise InputError(f"geometry gradient: {len(array)} volumes, but images of {len(batch)}")
    volumes, backend, threads = A._pinhole_arguments(array)
    before_response = [np.asarray(A._response_adjoint(data.astype(volumes.dtype, copy=False))) for data in batch]
    centers, frames, numbers = pinholes.gradient(volumes, np.stack(before_response), backend, threads)
    u, v, _ = model.system.frames().transpose(1, 0, 2)
    # Along a real detector, steps go backwards.
    signs = np.sign([np.einsum("mi,mi->m", s, a) for s, a in ((A.views.v_steps, v), (A.views.u_steps, u))]).T
    diameter = numbers["diameter"] * _d_effective_diameter(model)
    pitch, offset = ((numbers[name] * signs)[:, ::-1] for name in ("pitch", "first"))
    pitch = pitch / A._pixel_parts + sum(map(partial(_pitch_gradient_of_blur, A, pinholes), volumes, batch))
    return GeometryGradient(centers, frames, numbers["length"], diameter, pitch, offset)


def _d_effective_diameter(model: Any) -> Floats:
    """Return d(d_e)/dd (M,), the derivative of Paix's effective diameter, of the response, by central differences."""
    d = model.system.pinhole_diameter
    optics = replace(model.optics, edge="paix", plate_thickness=None)
    upper, lower = (optics.effective_diameter(d * scale) for scale in (1 + _STEP, 1 - _STEP))
    return np.asarray((upper - lower) / (2 * _STEP * d))


def _pitch_gradient_of_blur(A: Projector, pinholes: PinholeOperator, volume: Array, images: Array) -> Array:
    """Return the gradient (M, 2) by the pixels' sizes along u and v through the detector's blur, by central differences."""
    gradient, views = np.zeros((len(images), 2)), A.views
    model: Any = A.model
    images = images * with_image_axes(model.efficiency)
    if model.response(views, 0, A._pixel_parts) is None:
        return gradient
    scales = 1 + _STEP, 1 - _STEP
    wide, narrow = (replace(views, u_steps=a * views.u_steps, v_steps=a * views.v_steps) for a in scales)
    for m, image in enumerate(pinholes.images(volume, *A._pinhole_arguments(volume)[1:], None)):
        (v, u), upper, lower = (model.response(scaled, m, A._pixel_parts) for scaled in (views, wide, narrow))
        d_v, d_u = ((a - b) / (2 * _STEP) for a, b in zip(upper, lower, strict=True))
        pitch = model.crystal_pitch(views, m)
        gradient[m, 0] = (images[m] * (v @ image @ d_u.T)).sum() / pitch[0]
        gradient[m, 1] = (images[m] * (d_v @ image @ u.T)).sum() / pitch[1]
    return gradient
