"""The band-limited ramp filter and its windows, as a matrix that acts on rows of pixels."""

import math
from collections.abc import Callable

import numpy as np

from ..arrays import Array
from ..validation import one_of

WINDOWS: dict[str, Callable[[Array], Array]] = {
    "ramp": np.ones_like,
    "shepp-logan": lambda f: np.sinc(f / 2),
    "cosine": lambda f: np.cos(np.pi * f / 2),
    "hamming": lambda f: 0.54 + 0.46 * np.cos(np.pi * f),
    "hann": lambda f: 0.5 + 0.5 * np.cos(np.pi * f),
}
"""Windows by name: functions of the frequency, in units of the Nyquist frequency, that multiply the ramp filter."""


def ramp_matrix(n: int, window: str, margin: int = 0) -> Array:
    """Return the matrix (n, n + 2 margin), float32, that filters rows of n pixels: ``filtered = rows @ matrix``.

    The filtered rows have `margin` <= n further pixels at both ends. The matrix is the linear convolution of pixels of size
    1 with the ramp's band-limited kernel, 1/4 at 0 and ``-1 / (pi k)^2`` at odd k; as a matrix it needs no padding.

    Raises
    ------
    InputError
        `window` is not a name in `WINDOWS`.

    References
    ----------
    A. C. Kak, M. Slaney, "Principles of Computerized Tomographic Imaging", IEEE Press (1988), section 3.3.3.
    """
    one_of(window, WINDOWS, "window")
    length = 8 * 2 ** math.ceil(math.log2(max(n, 16)))  # the kernel's period, long enough that no lag wraps around
    lag = np.fft.fftfreq(length, 1 / length)
    kernel = np.where(lag % 2 == 1, -1 / (np.pi * np.where(lag == 0, 1, lag)) ** 2, 0.0)
    kernel[0] = 0.25
    kernel = np.fft.irfft(np.fft.rfft(kernel) * WINDOWS[window](np.fft.rfftfreq(length, 0.5)), length)
    return kernel[(np.arange(-margin, n + margin) - np.arange(n)[:, None]) % length].astype(np.float32)
