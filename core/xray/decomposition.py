"""From counts back to materials: decomposition ray by ray, images at one energy, correction of beam hardening."""

from collections.abc import Sequence

import numpy as np

from ..arrays import ArrayLike, Floats
from ..errors import InputError, warn
from ..validation import instance, none_below_0, real_array, whole_number
from .coefficients import attenuations
from .spectral import SpectralTransmission

_RAYS = 8192  # computed at once
_PRECISION = 1e-9  # of paths, mm and relative
_BOLDEST = 1.5  # change of a logarithm of counts in one step
_DARKEST = 1e-200  # counts
_DEEPEST = 2000.0  # mm of water


def decompose(counts: ArrayLike, m: SpectralTransmission, mAs: ArrayLike, iterations: int = 100) -> Floats:
    """The paths through each material of every ray that make its counts most likely: (materials, ...), mm.

    Parameters
    ----------
    counts
        (bins, ...), Poisson-distributed; with the model's views (bins, M, n_v, n_u).
    m, mAs
        The model, and the exposure as for `SpectralTransmission.expected`.
    iterations
        At most so many steps of Fisher scoring. Each ray goes on until its step is below a billionth of its paths.

    Returns
    -------
    array
        May be negative: paths are not bounded, so that estimates have no bias by that.

    Raises
    ------
    InputError
        Fewer bins than materials, negative counts, other shapes.

    Warns
    -----
    InputWarning
        Some rays have no such paths, as where a bin counted nothing: they are left as they are after the last step.
    """
    instance(m, SpectralTransmission, "decompose")
    n_bins, n = m.weights.shape[0], len(m.materials)
    if n_bins < n:
        raise InputError(f"decompose: {n} materials from {n_bins} bins: expected at least as many bins as materials")
    values = _checked_counts(counts, m)
    scale = m.scale(values.shape[1:], mAs).ravel()
    rays = values.reshape(n_bins, -1)
    paths, lost = np.empty((n, rays.shape[1])), 0
    for start in range(0, rays.shape[1], _RAYS):
        part = slice(start, start + _RAYS)
        paths[:, part], of_part = _most_likely(rays[:, part], m, scale[part], whole_number(iterations, "iterations"))
        lost += of_part
    if lost:
        warn(f"decompose: {lost} of {rays.shape[1]} rays did not settle, as where bins counted nothing", 2)
    return paths.reshape(n, *values.shape[1:])


def _most_likely(counts: Floats, m: SpectralTransmission, scale: Floats, iterations: int) -> tuple[Floats, int]:
    """Paths (materials, N) of N rays, and how many of them did not settle."""
    open_beam = m.weights.sum(axis=1)
    slopes = m.weights @ m.mu.T / open_beam[:, None]
    depths = np.log(open_beam[:, None] * scale / np.maximum(counts, 0.5))
    paths = np.linalg.pinv(slopes) @ depths * 0.5  # towards thin rays, where the slopes hold
    left = np.arange(len(scale))
    mean, jacobian = _model(m, paths, scale)
    likely = _log_likelihood(counts, mean)
    share = np.ones(len(scale))
    for _ in range(iterations):
        step = _step(counts[:, left], mean, jacobian) * share
        trial = paths[:, left] + step
        new_mean, new_jacobian = _model(m, trial, scale[left])
        new = _log_likelihood(counts[:, left], new_mean)
        better = new >= likely - 1e-12 * np.abs(likely)
        paths[:, left[better]] = trial[:, better]
        mean = np.where(better, new_mean, mean)
        jacobian = np.where(better, new_jacobian, jacobian)
        likely = np.where(better, new, likely)
        small = np.abs(step).max(axis=0) <= _PRECISION * (1 + np.abs(trial).max(axis=0))
        going = ~(small & (better | (share < 1e-6)))
        share = np.where(better, np.minimum(2 * share, 1), share / 4)[going]
        left, mean, jacobian, likely = left[going], mean[:, going], jacobian[:, :, going], likely[going]
        if not len(left):
            break
    return paths, len(left)


def _model(m: SpectralTransmission, paths: Floats, scale: Floats) -> tuple[Floats, Floats]:
    """The model's means and derivatives, the means above 0 even where nothing passes."""
    mean, jacobian = m.model(paths, scale)
    return np.maximum(mean, _DARKEST), jacobian


def _step(counts: Floats, mean: Floats, jacobian: Floats) -> Floats:
    """Steps (materials, N) of Fisher scoring, no bolder than `_BOLDEST`."""
    score = np.einsum("bmn,bn->nm", jacobian, counts / mean - 1)
    fisher = np.einsum("bin,bjn->nij", jacobian, jacobian / mean[:, None])
    floor = 1e-13 * np.trace(fisher, axis1=1, axis2=2)[:, None, None] + np.finfo(float).tiny
    step = np.linalg.solve(fisher + floor * np.eye(fisher.shape[1]), score[..., None])[..., 0].T
    change = np.abs(np.einsum("bmn,mn->bn", jacobian, step) / mean).max(axis=0)
    return step * np.minimum(1, _BOLDEST / np.maximum(change, _BOLDEST))


def _log_likelihood(counts: Floats, mean: Floats) -> Floats:
    """Poisson's, of N rays, up to what the means do not change."""
    return np.sum(counts * np.log(mean) - mean, axis=0)


def virtual_monoenergetic(values: ArrayLike, materials: Sequence[str], energy: float) -> Floats:
    """What X rays of one energy, keV, would see: ``sum of mu values``.

    Of paths (materials, ...) these are line integrals without unit, of volumes relative to their materials' densities
    attenuation coefficients, 1/mm.
    """
    given = real_array(values, "values", None)
    if not given.ndim or len(given) != len(materials):
        raise InputError(f"values: expected a first axis of {len(materials)}, {', '.join(materials)}")
    at = real_array([energy], "energy", (1,))
    return np.tensordot(np.concatenate([attenuations(name, at) for name in materials]), given, axes=1)


def decompose_images(images: ArrayLike, materials: Sequence[str], energies: ArrayLike) -> Floats:
    """Volumes (materials, ...), relative to the materials' densities, from images of mu (images, ...), 1/mm.

    They are those of least squares. Each image is taken as one of the energy (images,), keV, that its bin has in effect:
    beam hardening must have been corrected, which `decompose` does not need. `InputError` where there are fewer images
    than materials.
    """
    at = real_array(energies, "energies", (None,))
    given = real_array(images, "images", None)
    if not given.ndim or len(given) != len(at) or len(at) < len(materials):
        expected = f"one for each of {len(at)} energies, and as many as materials, {len(materials)}"
        raise InputError(f"images: expected {expected}")
    mu = np.stack([attenuations(name, at) for name in materials], axis=1)
    return np.tensordot(np.linalg.pinv(mu), given, axes=1)


def correct_beam_hardening(counts: ArrayLike, m: SpectralTransmission, mAs: ArrayLike) -> Floats:
    """The path through water, mm, that would leave each ray's counts of all bins together: (...), without the bins' axis.

    Reconstructed, it is the density relative to water's, without the cupping that beam hardening causes in soft tissue.
    It is found in a table of the logarithm of counts, which falls with the path; at most 2 m.
    """
    instance(m, SpectralTransmission, "correct_beam_hardening")
    values = _checked_counts(counts, m).sum(axis=0)
    weights = m.weights.sum(axis=0)
    known = np.sinh(np.linspace(-6.0, np.arcsinh(_DEEPEST), 8192))  # mm: finer where it is thin; below 0 for noise
    mu = attenuations("water", m.spectrum.energies)
    signal = [np.log(np.exp(-mu * path) @ weights) for path in known]
    with np.errstate(divide="ignore"):
        measured = np.log(values / m.scale(values.shape, mAs))
    return np.interp(-measured, np.negative(signal), known)


def _checked_counts(counts: ArrayLike, m: SpectralTransmission) -> Floats:
    values = none_below_0(counts, "counts")
    if not values.ndim or len(values) != len(m.weights):
        raise InputError(f"counts: expected a first axis of {len(m.weights)} bins, got shape {values.shape}")
    return values
