"""Image quality scores from voxels: errors, structural similarity, contrast-to-noise ratio, bias and deviation."""

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from ...arrays import ArrayLike, Bools, Floats
from ...errors import InputError
from ...geometry.grid import same_grid
from ...memory import require
from ...progress import Progress, in_threads
from ...validation import instance, positive, real_array, shape_text
from ...volumes.volume import Volume
from ..stopping import checked_mask

Values = Volume | ArrayLike

_SIGMA, _RADIUS = 1.5, 5  # standard deviation and half-width, voxels, of the SSIM window of Wang et al.
WINDOW = 2 * _RADIUS + 1
"""Side of the SSIM window, voxels."""
_K1, _K2 = 0.01, 0.03  # SSIM constants of Wang et al.
_SLAB = 1 << 18  # voxels that are computed at once


def nrmse(volume: Values, truth: Values, mask: ArrayLike | None = None) -> float:
    """Return the normalised root mean square error ``rms(volume - truth) / rms(truth)``.

    It is 0 for the truth itself and 1 for a volume of zeros. The normalisation by the truth's Euclidean norm is one of
    several in use (Fienup 1997, "Invariant error metrics for image reconstruction", Appl. Opt. 36(32)).

    Parameters
    ----------
    volume, truth
        Volumes on the same grid, of the same quantity, or arrays of the same shape. Volumes on different grids are refused:
        bring one to the other's grid first, ``mph.resample(truth, volume.grid, "mean")``.
    mask
        Booleans of the volume's shape, True in the voxels to compare; by default all voxels.

    Raises
    ------
    InputError
        Grids, shapes or quantities differ, or the truth is 0 everywhere.
    """
    values, true = _pair(volume, truth, "nrmse", mask)
    if not (norm := float(np.sqrt(np.mean(true**2)))):
        raise InputError("nrmse: the truth is 0 everywhere: there is nothing to normalise by")
    return float(np.sqrt(np.mean((values - true) ** 2))) / norm


def psnr(volume: Values, truth: Values, data_range: float | None = None, mask: ArrayLike | None = None) -> float:
    """Return the peak signal-to-noise ratio ``20 log10(data_range / rms(volume - truth))``, dB.

    It is infinite for the truth itself. (Huynh-Thu, Ghanbari 2008, "Scope of validity of PSNR in image/video quality
    assessment", Electron. Lett. 44(13).)

    Parameters
    ----------
    volume, truth, mask
        See `nrmse`.
    data_range
        Largest minus smallest possible value; by default largest minus smallest value of the truth.
    """
    values, true = _pair(volume, truth, "psnr", mask)
    span = _span(true, data_range, "psnr")
    error = float(np.sqrt(np.mean((values - true) ** 2)))
    return 20 * float(np.log10(span / error)) if error else np.inf


def ssim(volume: Values, truth: Values, data_range: float | None = None, progress: Progress | None = None) -> float:
    """Return the structural similarity in three dimensions, 1 for the truth itself.

    It is the mean of the SSIM index over all positions at which a window of 11 voxels along each axis fits, with a Gaussian
    of 1.5 voxels, C1 = (0.01 range)^2 and C2 = (0.03 range)^2, as in Wang et al. 2004, "Image quality assessment: from error
    visibility to structural similarity", IEEE Trans. Image Process. 13(4). An axis of one voxel is left out, so that a slice
    has its SSIM in two dimensions. With `data_range` set, the result is symmetric in volume and truth.

    Parameters
    ----------
    volume, truth
        See `nrmse`; each axis must have one voxel or at least 11.
    data_range
        See `psnr`.
    progress
        Called as ``progress(done, total)`` between slabs; may raise `Cancelled`.
    """
    values, true = _pair(volume, truth, "ssim")
    span = _span(true, data_range, "ssim")
    shape = tuple(n for n in values.shape if n > 1)
    if not shape or min(shape) < WINDOW:
        text = f"one or at least {WINDOW} voxels along each axis"
        raise InputError(f"ssim: expected {text}, got {shape_text(values.shape)}")
    values, true = values.reshape(shape), true.reshape(shape)
    c1, c2 = (_K1 * span) ** 2, (_K2 * span) ** 2
    inner = shape[0] - 2 * _RADIUS
    step = max(1, _SLAB // (values.size // shape[0]))
    sums = np.zeros(inner)

    def work(first: int) -> None:
        """Store the mean similarity index of each plane in the slab that starts at plane `first`."""
        slab = slice(first, min(first + step, inner) + 2 * _RADIUS)
        x, y = values[slab], true[slab]
        mean_x, mean_y, xx, yy, xy = (_windowed(moment) for moment in (x, y, x * x, y * y, x * y))
        both, squares = mean_x * mean_y, mean_x**2 + mean_y**2
        index = (2 * both + c1) * (2 * (xy - both) + c2) / ((squares + c1) * (xx + yy - squares + c2))
        sums[first : first + len(index)] = index.reshape(len(index), -1).mean(axis=1)

    in_threads(work, range(0, inner, step), progress)
    return float(sums.mean())


def contrast_to_noise(volume: Values, target: ArrayLike, background: ArrayLike) -> float:
    """Return the contrast-to-noise ratio: target mean minus background mean, by the background's standard deviation.

    It is negative for a target colder than its background, and infinite if the background is uniform and the target has
    another value. (Cherry, Sorenson, Phelps 2012, Physics in Nuclear Medicine, 4th edition, chapter 15.)

    Parameters
    ----------
    volume
        Volume, or array of its values.
    target, background
        Booleans of the volume's shape, True in the voxels of the region; at least two voxels in the background.
    """
    values = _values(volume, "contrast_to_noise")
    target_values, background_values = (
        values[_mask(mask, values.shape, f"contrast_to_noise: {name}", smallest)]
        for mask, name, smallest in ((target, "target", 1), (background, "background", 2))
    )
    contrast = float(target_values.mean() - background_values.mean())
    if not (noise := float(background_values.std(ddof=1))):
        return float(np.copysign(np.inf, contrast)) if contrast else 0.0
    return contrast / noise


class BiasAndDeviation(NamedTuple):
    """Bias and standard deviation of reconstructions in each voxel."""

    bias: Volume
    """Mean of the reconstructions minus the truth."""
    deviation: Volume
    """Sample standard deviation (n - 1) of the reconstructions."""


def bias_and_deviation(volumes: Iterable[Volume], truth: Volume) -> BiasAndDeviation:
    """Compute bias and standard deviation, in each voxel, of reconstructions from several noise draws of the same counts.

    The bias is the mean over the draws minus the truth, the deviation the sample standard deviation (n - 1). The mean square
    error of n draws is the bias squared plus (n - 1) / n times the deviation squared (Barrett, Myers 2004, Foundations of
    Image Science, chapter 14).

    Parameters
    ----------
    volumes
        Two or more volumes of the truth's grid and quantity; an iterator is allowed, as only one is held at a time.
    truth
        True volume, whose counts the noise was drawn for.

    Returns
    -------
    BiasAndDeviation
        Volumes ``bias`` and ``deviation``, in the truth's unit.
    """
    instance(truth, Volume, "bias_and_deviation: truth")
    if isinstance(volumes, Volume):
        raise InputError("bias_and_deviation: expected two volumes or more, got one")
    mean, squares, count = np.zeros(truth.grid.shape), np.zeros(truth.grid.shape), 0
    for count, volume in enumerate(volumes, 1):  # Welford's recurrence, which avoids cancellation
        instance(volume, Volume, f"bias_and_deviation: volume {count}")
        _require_fit(volume, truth, f"bias_and_deviation: volume {count}")
        difference = volume.array - mean
        mean += difference / count
        squares += difference * (volume.array - mean)
    if count < 2:
        raise InputError(f"bias_and_deviation: expected two volumes or more, got {count}")
    results = (mean - truth.array, np.sqrt(squares / (count - 1)))
    return BiasAndDeviation(*(Volume(values.astype(np.float32), truth.grid, truth.quantity) for values in results))


def _pair(volume: Values, truth: Values, name: str, mask: ArrayLike | None = None) -> tuple[Floats, Floats]:
    """Return the values of volume and truth as float64, those inside `mask` as (n,) if there is one.

    Raise `InputError` unless grids, quantities and shapes agree; `name` is the scoring function in messages.
    """
    if isinstance(volume, Volume) and isinstance(truth, Volume):
        _require_fit(volume, truth, name)
    values, true = _values(volume, name), _values(truth, f"{name}: truth")
    if values.shape != true.shape:
        raise InputError(f"{name}: volume of {shape_text(values.shape)}, truth of {shape_text(true.shape)} voxels")
    if not values.size:
        raise InputError(f"{name}: the volume has no voxels")
    if mask is None:
        return values, true
    inside = _mask(mask, values.shape, f"{name}: mask", 1)
    return values[inside], true[inside]


def _values(volume: Values, name: str) -> Floats:
    """Return the values of a volume or array as float64; raise an error if the memory is too small."""
    if isinstance(volume, Volume):
        require(8.0 * volume.grid.n_voxels, f"{name} of {shape_text(volume.grid.shape)} voxels")
        return volume.array.astype(np.float64)
    return real_array(volume, name, None)


def _require_fit(volume: Volume, truth: Volume, name: str) -> None:
    """Raise `InputError` unless volume and truth hold the same quantity on the same grid."""
    if volume.quantity != truth.quantity:
        raise InputError(f"{name}: volume of {volume.quantity}, truth of {truth.quantity}")
    if not same_grid(volume.grid, truth.grid):
        advice = 'mph.resample(truth, volume.grid, "mean") brings the truth to the volume\'s'
        raise InputError(f"{name}: volume and truth are on different grids; {advice}")


def _mask(mask: ArrayLike, shape: tuple[int, ...], name: str, smallest: int) -> Bools:
    """Return `mask` as booleans; raise `InputError` unless it has this shape and at least `smallest` voxels."""
    array = checked_mask(mask, name, shape)
    if np.count_nonzero(array) < smallest:
        raise InputError(f"{name}: expected at least {smallest} voxels, got {np.count_nonzero(array)}")
    return array


def _span(true: Floats, data_range: Any, name: str) -> float:
    """Return `data_range`, or by default largest minus smallest value of the truth; raise `InputError` if that is 0."""
    if data_range is not None:
        return positive(data_range, f"{name}: data_range")
    if not (span := float(true.max() - true.min())):
        raise InputError(f"{name}: the truth is the same everywhere; set data_range to the range of values")
    return span


def _windowed(values: Floats) -> Floats:
    """Return means weighted with the Gaussian window, at the positions where the window fits."""
    weights = np.exp(-0.5 * (np.arange(-_RADIUS, _RADIUS + 1) / _SIGMA) ** 2)
    weights /= weights.sum()
    for axis in range(values.ndim):
        windows = np.lib.stride_tricks.sliding_window_view(values, len(weights), axis)
        values = np.ascontiguousarray(windows @ weights)
    return values
