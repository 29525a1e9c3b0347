"""Energy windows: photons that a detector of finite energy resolution counts in them, and scatter estimated from them.

References
----------
K. Ogawa, Y. Harata, T. Ichihara, A. Kubo, S. Hashimoto, "A practical method for position-dependent Compton-scatter
correction in single photon emission CT", IEEE Transactions on Medical Imaging 10 (1991) 408-412: triple energy windows.
R. J. Jaszczak, K. L. Greer, C. E. Floyd, C. C. Harris, R. E. Coleman, "Improved SPECT quantification using compensation for
scattered photons", Journal of Nuclear Medicine 25 (1984) 893-900: double energy windows.
"""

import math
from collections.abc import Sequence

import numpy as np

from ..arrays import ArrayLike, Floats
from ..errors import InputError
from ..validation import positive, real_array, shape_text
from .crystal import gaussian_blur
from .isotopes import Isotope, Line, Window

FWHM_PER_SIGMA = 2 * math.sqrt(2 * math.log(2))

_MIN_SHARE = 1e-4
"""Photons of a line, relative to the line with the most counted photons, up to which the line is left out."""


def acceptance(energy: float, window: Window, fwhm: float) -> float:
    """Return the share of the photons of an `energy` whose measured energy lies within a `window`; all in keV.

    `fwhm` is that of the Gaussian energy resolution.
    """
    scale = math.sqrt(2) * fwhm / FWHM_PER_SIGMA
    low, high = ((edge - energy) / scale for edge in window)
    if low > 0:  # for a window above the energy a difference of two erf close to 1 would lose digits
        return (math.erfc(low) - math.erfc(high)) / 2
    return (math.erf(high) - math.erf(low)) / 2


def counted_lines(isotope: Isotope, window: Window, energy_fwhm: float | None = None) -> tuple[Line, ...]:
    """Return the photon lines that are counted in a `window`, keV: energies, keV, in order, and counted photons per decay.

    `energy_fwhm` is the FWHM of the energy resolution at the strongest line within the window, as a share of its energy; at
    another energy E the FWHM is proportional to sqrt(E). With None, exactly the photons of the lines within the window are
    counted. Lines with less than 1e-4 of the counted photons of the strongest one are left out. Raises `InputError` if the
    resolution cannot refer to a line because none is within the window.
    """
    lines = sorted(isotope.lines_within(*window))
    if energy_fwhm is None:
        return tuple(lines)
    if not lines:
        raise InputError(f"energy_fwhm: it is that of the window's line, but {isotope.name} has none in the window")
    reference, _ = max(lines, key=lambda line: line[1])

    def fwhm(energy: float) -> float:
        """Return the energy resolution at an energy, FWHM in keV."""
        return energy_fwhm * math.sqrt(reference * energy)

    counted = [(energy, n * acceptance(energy, window, fwhm(energy))) for energy, n in sorted(isotope.lines)]
    strongest = max(photons for _, photons in counted)
    return tuple((energy, photons) for energy, photons in counted if photons > _MIN_SHARE * strongest)


def peak_shares(isotope: Isotope, windows: Sequence[Window | None], energy_fwhm: float) -> tuple[float, float, float]:
    """Return the shares of the peak's photons that are counted in the lower, the peak and the upper window.

    The peak's photons are those of the lines within the peak window. The share of a missing window, None, is 0.
    `energy_fwhm` is the FWHM at the strongest of the lines, as a share of its energy.
    """
    peak = windows[1]
    lines = () if peak is None else isotope.lines_within(*peak)
    if not lines:
        raise InputError(f"energy window scatter: {isotope.name} has no line in the peak window, {peak} keV")
    reference, _ = max(lines, key=lambda line: line[1])
    total = sum(photons for _, photons in lines)

    def share(window: Window | None) -> float:
        """Return the share of the lines' photons that a window counts, 0 for no window."""
        blurred = ((e, photons, energy_fwhm * math.sqrt(reference * e)) for e, photons in lines)
        return 0.0 if window is None else sum(n * acceptance(e, window, fwhm) for e, n, fwhm in blurred) / total

    lower, middle, upper = map(share, windows)
    return lower, middle, upper


def energy_window_scatter(
    lower: ArrayLike | None,
    peak: ArrayLike,
    upper: ArrayLike | None,
    widths: Sequence[float | None],
    fwhm: float | None = None,
    efficiency: ArrayLike = 1.0,
    shares: Sequence[float] | None = None,
) -> tuple[Floats, Floats]:
    """Estimate the scattered photons in the peak window from the counts in the windows below and above it.

    From both windows the estimate is ``(lower / w_l + upper / w_u) * w_p / 2`` (triple energy window, Ogawa 1991). That is
    exact if the continuum under the peak is linear in energy, and the two windows' centres are equally far from the peak's,
    on either side. If one window is missing, the continuum is taken to fall to 0 there, as a triangle: half of the other
    window's density (double energy window, Jaszczak 1984, with k = 1/2 for windows of one width).

    Parameters
    ----------
    lower, peak, upper : array (M, n_v, n_u)
        Counts in the windows, of which `lower` or `upper` may be None. Without `shares`, only the shape of `peak` is used:
        an estimate that exceeds the peak's counts by chance is not cut off, because the cut would bias the mean.
    widths : sequence of 3 numbers
        Widths of the three windows, keV; that of a missing window may be None.
    fwhm : float, optional
        FWHM, in pixels, of a Gaussian that smooths the estimate: scatter is smoother than noise. Its weights within the
        image sum to 1 for each pixel, so a constant estimate is unchanged.
    efficiency : float or array (M, n_v, n_u)
        Efficiency of the pixels, as in `Emission`: the photons are smoothed, and each pixel counts its share of them. Pixels
        of efficiency 0, dead or hot, do not contribute, and their smoothed estimate is 0.
    shares : sequence of 3 numbers, optional
        Shares a_l, a_p and a_u of the unscattered photons that are counted in the three windows (`peak_shares`). The photons
        that the peak's tails add to the outer windows are then not taken for scatter: with T the estimate above, P the
        peak's counts and ``t = w_p / 2 (a_l / w_l + a_u / w_u) / a_p`` the estimate is ``(T - t P) / (1 - t)``, which may be
        below 0 by chance. Default: no tails.

    Returns
    -------
    scatter, variance : array (M, n_v, n_u)
        The estimate, and its variance if the counts are independent Poisson numbers.

    Raises
    ------
    InputError
        If both windows are missing, shapes differ, counts are negative, a width is not a number above 0, or the peak has no
        more unscattered photons per keV than its tails.
    """
    name = "energy window scatter"
    shape = np.shape(peak)
    if len(shape) != 3:
        raise InputError(f"{name}: peak: expected counts (M, n_v, n_u), got shape {shape_text(shape)}")
    if len(widths) != 3:
        expected = "those of the lower, the peak and the upper window"
        raise InputError(f"{name}: widths: expected {expected}, got {len(widths)}")
    if lower is None and upper is None:
        raise InputError(f"{name}: expected counts of the lower or the upper window, or both")
    w_peak = positive(widths[1], f"{name}: width of the peak window", "keV")
    scatter, variance, tails = np.zeros(shape), np.zeros(shape), 0.0
    no_tails = (0.0, 1.0, 0.0)
    a_lower, a_peak, a_upper = real_array(no_tails if shares is None else shares, f"{name}: shares", (3,)).tolist()
    for word, counts, width, share in (("lower", lower, widths[0], a_lower), ("upper", upper, widths[2], a_upper)):
        if counts is None:
            continue
        array = real_array(counts, f"{name}: {word}", shape)
        if array.min(initial=0.0) < 0:
            raise InputError(f"{name}: {word}: expected counts of 0 or more, got {array.min():g}")
        factor = w_peak / (2 * positive(width, f"{name}: width of the {word} window", "keV"))
        scatter += factor * array
        variance += factor**2 * array
        tails += factor * share / positive(a_peak, f"{name}: share in the peak window")
    if tails:
        if not 0 < tails < 1:
            raise InputError(f"{name}: shares: expected less of the photons per keV beside the peak than in it")
        peak_counts = real_array(peak, f"{name}: peak", shape)
        scatter = (scatter - tails * peak_counts) / (1 - tails)
        variance = (variance + tails**2 * peak_counts) / (1 - tails) ** 2
    if fwhm is None:
        return scatter, variance
    sigma = positive(fwhm, f"{name}: fwhm", "pixels") / FWHM_PER_SIGMA
    blur_v, blur_u = (gaussian_blur(n, sigma) for n in shape[1:])
    efficiencies = np.broadcast_to(real_array(efficiency, f"{name}: efficiency", None), shape)
    blurred = blur_v @ efficiencies @ blur_u.T
    factors: Floats = np.divide(efficiencies, blurred, out=np.zeros(shape), where=efficiencies > 0)
    scatter, variance = (np.where(efficiencies > 0, x, 0.0) for x in (scatter, variance))
    return factors * (blur_v @ scatter @ blur_u.T), factors**2 * (blur_v**2 @ variance @ (blur_u**2).T)
