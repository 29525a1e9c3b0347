"""Material decomposition: paths from counts, images at one energy, correction of beam hardening."""

from collections.abc import Sequence

import numpy as np

from ..arrays import ArrayLike, Floats
from ..errors import InputError, warn
from ..validation import instance, none_below_0, real_array, whole_number
from .coefficients import attenuations
from .spectral import SpectralTransmission

_RAYS = 8192  # number of rays computed at once
_PRECISION = 1e-9  # precision of paths, mm and relative
_MAX_CHANGE = 1.5  # largest change of a logarithm of counts in one step
_MIN_COUNTS = 1e-200  # lower limit of expected counts
_MAX_WATER = 2000.0  # longest path through water, mm


def decompose(counts: ArrayLike, m: SpectralTransmission, mAs: ArrayLike, iterations: int = 100) -> Floats:
    """Return the maximum-likelihood paths through each material for every ray's counts: (materials, ...), mm.

    Parameters
    ----------
    counts
        Poisson-distributed counts (bins, ...); with the model's views (bins, M, n_v, n_u).
    m, mAs
        The model, and the exposure as for `SpectralTransmission.expected`.
    iterations
        Largest number of steps of Fisher scoring. A ray is finished when its step is below a billionth of its paths.

    Returns
    -------
    array
        Paths may be negative: they are not bounded, since bounds would bias the estimates.

    Raises
    ------
    InputError
        There are fewer bins than materials, negative counts, or wrong shapes.

    Warns
    -----
    InputWarning
        Some rays have not converged, for example where a bin has no counts: their paths are those of the last step.
    """
    instance(m, SpectralTransmission, "decompose")
    n_bins, n = m.weights.shape[0], len(m.materials)
    if n_bins < n:
        raise InputError(f"decompose: {n} materials from {n_bins} bins: expected at least as many bins as materials")
    values = _checked_counts(counts, m)
    scale = m.scale(values.shape[1:], mAs).ravel()
    rays = values.reshape(n_bins, -1)
    paths, n_lost = np.empty((n, rays.shape[1])), 0
    for start in range(0, rays.shape[1], _RAYS):
        batch = slice(start, start + _RAYS)
        paths[:, batch], n_left = _most_likely(rays[:, batch], m, scale[batch], whole_number(iterations, "iterations"))
        n_lost += n_left
    if n_lost:
        warn(f"decompose: {n_lost} of {rays.shape[1]} rays did not converge, as where bins have no counts", 2)
    return paths.reshape(n, *values.shape[1:])


def _most_likely(counts: Floats, m: SpectralTransmission, scale: Floats, iterations: int) -> tuple[Floats, int]:
    """Return the maximum-likelihood paths (materials, N) of N rays, and the number of rays that did not converge."""
    open_beam = m.weights.sum(axis=1)
    mean_mu = m.weights @ m.mu.T / open_beam[:, None]
    depths = np.log(open_beam[:, None] * scale / np.maximum(counts, 0.5))
    paths = np.linalg.pinv(mean_mu) @ depths * 0.5  # half of it, since mean_mu holds for short paths
    active = np.arange(len(scale))
    mean, jacobian = _model(m, paths, scale)
    likelihood = _log_likelihood(counts, mean)
    damping = np.ones(len(scale))
    for _ in range(iterations):
        step = _step(counts[:, active], mean, jacobian) * damping
        trial = paths[:, active] + step
        new_mean, new_jacobian = _model(m, trial, scale[active])
        new_likelihood = _log_likelihood(counts[:, active], new_mean)
        improved = new_likelihood >= likelihood - 1e-12 * np.abs(likelihood)
        paths[:, active[improved]] = trial[:, improved]
        mean = np.where(improved, new_mean, mean)
        jacobian = np.where(improved, new_jacobian, jacobian)
        likelihood = np.where(improved, new_likelihood, likelihood)
        is_small = np.abs(step).max(axis=0) <= _PRECISION * (1 + np.abs(trial).max(axis=0))
        todo = ~(is_small & (improved | (damping < 1e-6)))
        damping = np.where(improved, np.minimum(2 * damping, 1), damping / 4)[todo]
        active, mean, jacobian, likelihood = active[todo], mean[:, todo], jacobian[:, :, todo], likelihood[todo]
        if not len(active):
            break
    return paths, len(active)


def _model(m: SpectralTransmission, paths: Floats, scale: Floats) -> tuple[Floats, Floats]:
    """Return the model's expected counts and their derivatives, with counts above 0 even where no photon passes."""
    mean, jacobian = m.model(paths, scale)
    return np.maximum(mean, _MIN_COUNTS), jacobian


def _step(counts: Floats, mean: Floats, jacobian: Floats) -> Floats:
    """Return steps (materials, N) of Fisher scoring, shortened where they change a count by more than `_MAX_CHANGE`."""
    score = np.einsum("bmn,bn->nm", jacobian, counts / mean - 1)
    fisher = np.einsum("bin,bjn->nij", jacobian, jacobian / mean[:, None])
    floor = 1e-13 * np.trace(fisher, axis1=1, axis2=2)[:, None, None] + np.finfo(float).tiny
    step = np.linalg.solve(fisher + floor * np.eye(fisher.shape[1]), score[..., None])[..., 0].T
    change = np.abs(np.einsum("bmn,mn->bn", jacobian, step) / mean).max(axis=0)
    return step * np.minimum(1, _MAX_CHANGE / np.maximum(change, _MAX_CHANGE))


def _log_likelihood(counts: Floats, mean: Floats) -> Floats:
    """Return the Poisson log-likelihood of N rays, without the terms that do not depend on the means."""
    return np.sum(counts * np.log(mean) - mean, axis=0)


def virtual_monoenergetic(values: ArrayLike, materials: Sequence[str], energy: float) -> Floats:
    """Return the attenuation of material paths or volumes at one energy, keV: ``sum of mu values`` over the materials.

    For paths (materials, ...), mm, the result are line integrals; for volumes relative to their materials' densities it is
    the attenuation coefficient, 1/mm.
    """
    array = real_array(values, "values", None)
    if not array.ndim or len(array) != len(materials):
        raise InputError(f"values: expected a first axis of {len(materials)}, {', '.join(materials)}")
    energies = real_array([energy], "energy", (1,))
    return np.tensordot(np.concatenate([attenuations(name, energies) for name in materials]), array, axes=1)


def decompose_images(images: ArrayLike, materials: Sequence[str], energies: ArrayLike) -> Floats:
    """Return material volumes (materials, ...), relative to the materials' densities, from images of mu (images, ...), 1/mm.

    They are the least-squares solution. Each image is treated as one of a single energy (images,), keV, the effective energy
    of its bin; so beam hardening must have been corrected, which `decompose` does not require. Raises `InputError` if there
    are fewer images than materials.
    """
    keV = real_array(energies, "energies", (None,))
    array = real_array(images, "images", None)
    if not array.ndim or len(array) != len(keV) or len(keV) < len(materials):
        expected = f"one for each of {len(keV)} energies, and as many as materials, {len(materials)}"
        raise InputError(f"images: expected {expected}")
    mu = np.stack([attenuations(name, keV) for name in materials], axis=1)
    return np.tensordot(np.linalg.pinv(mu), array, axes=1)


def correct_beam_hardening(counts: ArrayLike, m: SpectralTransmission, mAs: ArrayLike) -> Floats:
    """Return the path through water, mm, with the counts of each ray, all bins together: (...), without the bins' axis.

    Reconstructed, it is the density relative to water's, without the cupping that beam hardening causes in soft tissue. It
    is interpolated in a table of the logarithm of counts, which falls with the path; at most 2 m.
    """
    instance(m, SpectralTransmission, "correct_beam_hardening")
    values = _checked_counts(counts, m).sum(axis=0)
    weights = m.weights.sum(axis=0)
    # Finer steps at short paths; paths below 0 are for noisy counts.
    water_paths = np.sinh(np.linspace(-6.0, np.arcsinh(_MAX_WATER), 8192))
    mu = attenuations("water", m.spectrum.energies)
    log_counts = [np.log(np.exp(-mu * water) @ weights) for water in water_paths]
    with np.errstate(divide="ignore"):
        measured = np.log(values / m.scale(values.shape, mAs))
    return np.interp(-measured, np.negative(log_counts), water_paths)


def _checked_counts(counts: ArrayLike, m: SpectralTransmission) -> Floats:
    """Return counts (bins, ...) as an array; raise `InputError` for negative ones or another number of bins."""
    values = none_below_0(counts, "counts")
    if not values.ndim or len(values) != len(m.weights):
        raise InputError(f"counts: expected a first axis of {len(m.weights)} bins, got shape {values.shape}")
    return values
