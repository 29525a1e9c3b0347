"""Numbers as colours: window, scale and colour map of a picture, and pictures in another size."""

import math
from dataclasses import dataclass

import numpy as np

from ..arrays import ArrayLike, Bytes, Floats, Floats32
from ..errors import InputError
from ..validation import one_of

# Colours of each map at 17 even steps; interpolated, they are within 2.5 % of matplotlib's maps (CC0).
_COLORS = {
    "inferno": "000004 0b0724 210c4a 3d0965 57106e 71196e 8a226a a32c61 bc3754 d04545 e35933 f1711f f98c0a fcaa0f f9c932 "
    "f2e865 fcffa4",
    "magma": "000004 0a0822 1d1147 36106b 51127c 6a1c81 832681 9c2e7f b73779 cf4070 e55064 f4695c fb8761 fea571 fec287 "
    "fde0a1 fcfdbf",
    "viridis": "440154 48186a 472d7b 424086 3b528b 33638d 2c728e 26828e 21918c 1f9f88 27ad81 3dbc74 5cc863 81d34d aadc32 "
    "d5e21a fde725",
    "grey": "000000 ffffff",
    "diverging": "04306b 2a6fbb 8fbfe6 f4f4f4 f0a58c c8402f 6b0410",
    "dark diverging": "c4e6ff 5aaef0 2a6fbb 173a63 0c0d10 632018 c8402f f0805c ffd9c4",
}
DIVERGING, DARK_DIVERGING = "diverging", "dark diverging"
"""Colour maps of differences: blue below the middle and red above it; the middle is white, or nearly black on dark pages."""
COLORS = tuple(name for name in _COLORS if name not in (DIVERGING, DARK_DIVERGING))
"""Names of the colour maps; all but grey are perceptually uniform."""
_STEPS = (1.0, 2.0, 2.5, 5.0, 10.0)
"""Steps between round numbers."""
SUPERSCRIPTS = str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")
_PLAIN_DIGITS = 5
"""Digits before the decimal point up to which a number is written without a power of ten."""
SCALES = ("linear", "sqrt", "log")
PARTS = ("object", "half", "whole")
"""Parts of images that can be shown, see `Display.region`."""
_FAINT = 0.02
"""Sum of a row or column, relative to the largest of all images, up to which it does not count as the object's."""
_MARGIN = 0.03
"""Margin around the object, in halves of an image's side."""
_DECADES = 3.0
"""Decades that an automatic logarithmic window spans."""


@dataclass(frozen=True)
class Display:
    """Display of numbers as colours.

    An automatic `low` is 0, or the smallest number if that is negative; on the logarithmic scale, a thousandth of `high`.
    """

    colors: str = "inferno"
    """Colour map, a name of `COLORS`."""
    scale: str = "linear"
    """Scale, a name of `SCALES`."""
    low: float | None = None
    """Number with the first colour; None for an automatic one."""
    high: float | None = None
    """Number with the last colour; None for the largest number."""
    region: str = "whole"
    """Part of each image around its middle, a name of `PARTS`: the "whole" image, which users call the wide FOV; its middle
    "half", the FOV; or, in a mosaic, as many eighths of both sides as hold the "object" in all images, with a margin."""

    def __post_init__(self) -> None:
        if self.colors not in _COLORS:
            raise InputError(f"colors {self.colors!r}: expected one of {', '.join(COLORS)}")
        one_of(self.scale, SCALES, "scale")
        one_of(self.region, PARTS, "region")
        for name, value in (("low", self.low), ("high", self.high)):
            if value is not None and not np.isfinite(value):
                raise InputError(f"{name} = {value}: expected a finite number")
        if self.low is not None and self.high is not None and self.low >= self.high:
            raise InputError(f"window {self.low:g} to {self.high:g}: expected low to be less than high")
        if self.scale == "log" and self.low is not None and self.low <= 0:
            raise InputError(f"low = {self.low:g}: expected more than 0 on the logarithmic scale")

    def part(self, images: Floats32, in_mosaic: bool = False) -> Floats32:
        """Return the part of images (..., n_v, n_u) that is shown, the same of all images."""
        fits = in_mosaic and self.region == "object"
        eighths = 4 if self.region == "half" else _eighths_of_object(images) if fits else 8
        rows, columns = (slice(cut, n - cut) for n in images.shape[-2:] for cut in [n * (8 - eighths) // 16])
        return images[..., rows, columns]

    def window(self, values: ArrayLike) -> tuple[float, float]:
        """Return the numbers with the first and the last colour if `values` are shown."""
        values = np.asarray(values)
        low, high = self.low, self.high
        if high is None:
            high = float(np.max(values, initial=-np.inf, where=np.isfinite(values)))
            high = high if np.isfinite(high) else 0.0
        if low is None and self.scale == "log":
            low = min(high, high / 10.0**_DECADES)
        elif low is None:
            low = min(0.0, float(np.min(values, initial=0.0, where=np.isfinite(values))))
        return low, high

    def shares(self, values: ArrayLike, window: tuple[float, float]) -> Floats32:
        """Return the places of `values` between the first colour, 0, and the last, 1; clipped to the window."""
        low, high = window
        numbers = np.asarray(values, np.float32)
        if self.scale == "log":
            low, high = np.array(window, np.float32).tolist()  # as the numbers, of which small ones have few digits
            if not 0 < low < high:
                return (numbers >= high).astype(np.float32) if high > 0 else np.zeros_like(numbers)
            numbers = np.log(np.maximum(numbers, low, dtype=np.float32))
            low, high = float(np.log(low)), float(np.log(high))
        shares = np.clip((numbers - low) / ((high - low) or 1.0), 0.0, 1.0)
        return np.nan_to_num(np.sqrt(shares) if self.scale == "sqrt" else shares, nan=0.0)

    def value_at(self, share: float, window: tuple[float, float]) -> float:
        """Return the number whose place in the window, as `shares` computes it, is `share`."""
        low, high = window
        if self.scale == "log":
            return float(low * (high / low) ** share) if 0 < low < high else high * share
        return low + (high - low) * (share**2 if self.scale == "sqrt" else share)

    def marks(self, window: tuple[float, float], max_steps: int = 5) -> list[float]:
        """Return round numbers in a window for its colour bar: powers of ten on a logarithmic scale that spans several."""
        low, high = window
        if not low < high:
            return [high]
        if self.scale == "log" and low > 0:
            powers = np.arange(np.ceil(np.log10(low) - 1e-9), np.floor(np.log10(high) + 1e-9) + 1)
            if len(powers) > 1:
                return [float(10.0**power) for power in powers[:: -(-(len(powers) - 1) // max_steps)]]
        return ticks(low, high, max_steps)

    def colored(self, values: ArrayLike, window: tuple[float, float] | None = None) -> Bytes:
        """Return colours (..., 3), 8-bit sRGB, of `values` (...), in the given window or in their automatic one."""
        shares = self.shares(values, self.window(values) if window is None else window)
        return _table(self.colors)[np.rint(shares * 255).astype(np.uint8)]


def _eighths_of_object(images: Floats32) -> int:
    """Return how many eighths of both sides, around the middle, hold the object in all images (..., n_v, n_u)."""
    extent = 0.0
    for axis in (-2, -1):
        sums = np.abs(np.nan_to_num(images)).sum(axis=axis)
        lines = np.nonzero(sums > _FAINT * sums.max(initial=0.0))[-1]
        extent = max(extent, float(np.abs(2 * lines + 1 - sums.shape[-1]).max(initial=-1) + 1) / sums.shape[-1])
    return min(8, math.ceil(8 * (extent + _MARGIN))) if extent else 8


def _table(colors: str) -> Bytes:
    """Return the 256 colours (256, 3), 8-bit sRGB, of a map."""
    anchors = np.array([list(bytes.fromhex(text)) for text in _COLORS[colors].split()], float)
    places = np.linspace(0, len(anchors) - 1, 256)
    channels = [np.interp(places, np.arange(len(anchors)), channel) for channel in anchors.T]
    return np.rint(np.stack(channels, axis=1)).astype(np.uint8)


def ticks(low: float, high: float, max_steps: int) -> list[float]:
    """Return round numbers from `low` to `high`, in at most `max_steps` steps."""
    smallest_step = (high - low) / max(1, max_steps)
    power = 10.0 ** np.floor(np.log10(smallest_step))
    step = power * next(s for s in _STEPS if s * power >= smallest_step * (1 - 1e-9))
    first = np.ceil(low / step - 1e-9)
    return [float(step * n) + 0.0 for n in np.arange(first, np.floor(high / step + 1e-9) + 1)]  # -0 is 0


def number_text(value: float, digits: int = 4) -> str:
    """Return a number as people write it, with `digits` digits: "0.25", "−3", "16380", "10⁵", "3.349 × 10¹¹"."""
    text = f"{value + 0.0:.{digits}g}"  # -0 is 0
    mantissa, _, exponent = text.partition("e")
    if exponent and 0 < int(exponent) < _PLAIN_DIGITS:
        text = f"{float(text):.0f}"
    elif exponent:
        power = "10" + str(int(exponent)).translate(SUPERSCRIPTS)
        text = mantissa[:-1] + power if mantissa in ("1", "-1") else f"{mantissa} × {power}"
    return text.replace("-", "−")


def unit_text(unit: str) -> str:
    """Return a unit as people write it; line integrals of mu, 1/mm mm, have none."""
    return unit.replace("1/mm mm", "").replace(" mm", " · mm")


def resize_picture(picture: ArrayLike, rows: int, columns: int) -> Floats32:
    """Return a picture (h, w, channels) as (rows, columns, channels): each new pixel is the mean of the area it covers."""
    tall = _resize_rows(np.asarray(picture, np.float64), rows)
    return _resize_rows(tall.swapaxes(0, 1), columns).swapaxes(0, 1).astype(np.float32)


def _resize_rows(picture: Floats, rows: int) -> Floats:
    """Return a picture (h, ...) as (rows, ...), by differences of its cumulative sum, interpolated at the new edges."""
    height = len(picture)
    sums = np.concatenate([np.zeros_like(picture[:1]), picture.cumsum(axis=0)])
    edges = np.linspace(0.0, height, rows + 1)
    below = np.minimum(edges.astype(int), height - 1)
    at_edges = sums[below] + (edges - below)[:, None, None] * picture[below]
    return np.diff(at_edges, axis=0) * (rows / height)
