"""Energy windows: the photons that a detector of finite energy resolution counts in them, and scatter found by them.

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

_LEAST_SHARE = 1e-4
"""Lines that count less, as a share of the one that counts most, are left out."""


def acceptance(energy: float, window: Window, fwhm: float) -> float:
    """Share of the photons of an `energy` that are measured within a `window`; energies blur with this FWHM. All in keV."""
    scale = math.sqrt(2) * fwhm / FWHM_PER_SIGMA
    low, high = ((edge - energy) / scale for edge in window)
    if low > 0:  # the difference of two numbers close to 1
        return (math.erfc(low) - math.erfc(high)) / 2
    return (math.erf(high) - math.erf(low)) / 2


def counted_lines(isotope: Isotope, window: Window, energy_fwhm: float | None = None) -> tuple[Line, ...]:
    """The lines that count in a `window`, keV: their energies, keV, in order, and photons per decay that are counted.

    `energy_fwhm` is the FWHM of the energy resolution at the strongest line within the window, as a share of its energy; at
    another energy E the FWHM is in proportion to sqrt(E). None: all photons of the lines within the window count, no
    others. Lines that count less than 1e-4 of the one that counts most are left out. `InputError` where no line that the
    resolution could refer to is within the window.
    """
    lines = sorted(isotope.lines_within(*window))
    if energy_fwhm is None:
        return tuple(lines)
    if not lines:
        raise InputError(f"energy_fwhm: it is that of the window's line, but {isotope.name} has none in the window")
    reference, _ = max(lines, key=lambda line: line[1])

    def fwhm(energy: float) -> float:
        return energy_fwhm * math.sqrt(reference * energy)

    found = [(energy, photons * acceptance(energy, window, fwhm(energy))) for energy, photons in sorted(isotope.lines)]
    most = max(photons for _, photons in found)
    return tuple((energy, photons) for energy, photons in found if photons > _LEAST_SHARE * most)


def peak_shares(isotope: Isotope, windows: Sequence[Window | None], energy_fwhm: float) -> tuple[float, float, float]:
    """Shares of the photons of the peak's lines that are measured in the lower, the peak and the upper window; 0 of None.

    The lines are those within the peak window, and `energy_fwhm` is that of `counted_lines`.
    """
    peak = windows[1]
    lines = () if peak is None else isotope.lines_within(*peak)
    if not lines:
        raise InputError(f"energy window scatter: {isotope.name} has no line in the peak window, {peak} keV")
    reference, _ = max(lines, key=lambda line: line[1])
    total = sum(photons for _, photons in lines)

    def share(window: Window | None) -> float:
        own = ((e, photons, energy_fwhm * math.sqrt(reference * e)) for e, photons in lines)
        return 0.0 if window is None else sum(photons * acceptance(e, window, fwhm) for e, photons, fwhm in own) / total

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
    """Scattered photons in the peak window, from the counts in the windows below and above it.

    With both it is ``(lower / w_l + upper / w_u) * w_p / 2`` (triple energy window, Ogawa 1991). That is exact where the
    continuum under the peak is linear in energy, and the centers of the two windows lie as far from the peak's, to either
    side. Without one of them the continuum falls to 0 there, as a triangle: half of the other's density (double energy
    window, Jaszczak 1984, with k = 1/2 for windows of one width).

    Parameters
    ----------
    lower, peak, upper : array (M, n_v, n_u)
        Counts in the windows, of which `lower` or `upper` may be None. Those of the peak only say the shape: where chance
        makes the estimate larger than them it stays so, since what is cut off there would be missing in the mean.
    widths : sequence of 3 numbers
        Widths of the three windows, keV; that of a missing window may be None.
    fwhm : float, optional
        FWHM, in pixels, of a Gaussian that smooths the estimate: scatter is smoother than noise. Its weights within the
        image sum to 1 for each pixel, so an even estimate stays as it is.
    efficiency : number or array (M, n_v, n_u)
        Of the pixels, as in `Emission`: photons are smoothed, of which each pixel counts its share. Those of dead and hot
        pixels, 0, are no part of it, and the smoothed estimate of them is 0.
    shares : sequence of 3 numbers, optional
        Of the photons that are not scattered, those measured in the three windows (`peak_shares`). What the peak's tails add
        to the outer windows is then no scatter: with T the estimate as above, P the peak's counts and
        ``t = w_p / 2 (a_l / w_l + a_u / w_u) / a_p`` it is ``(T - t P) / (1 - t)``, by chance below 0 here and there. None:
        no tails.

    Returns
    -------
    scatter, variance : array (M, n_v, n_u)
        The estimate, and the variance that it has because the counts are independent Poisson numbers.

    Raises
    ------
    InputError
        Both windows are missing, shapes differ, counts are negative, or a width is not a number above 0; or there are no
        fewer photons per keV beside the peak than in it.
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
        of_peak = real_array(peak, f"{name}: peak", shape)
        scatter = (scatter - tails * of_peak) / (1 - tails)
        variance = (variance + tails**2 * of_peak) / (1 - tails) ** 2
    if fwhm is None:
        return scatter, variance
    sigma = positive(fwhm, f"{name}: fwhm", "pixels") / FWHM_PER_SIGMA
    along_v, along_u = (gaussian_blur(n, sigma) for n in shape[1:])
    counting = np.broadcast_to(real_array(efficiency, f"{name}: efficiency", None), shape)
    around = along_v @ counting @ along_u.T
    factors: Floats = np.divide(counting, around, out=np.zeros(shape), where=counting > 0)
    scatter, variance = (np.where(counting > 0, x, 0.0) for x in (scatter, variance))
    return factors * (along_v @ scatter @ along_u.T), factors**2 * (along_v**2 @ variance @ (along_u**2).T)
