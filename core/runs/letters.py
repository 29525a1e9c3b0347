"""Text in pictures, in any size: a smoothed proportional typeface, so that pictures need no drawing library."""

import base64
import functools
import re
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np

from ..arrays import Floats32
from .display import SUPERSCRIPTS, resize_picture

_CHARACTERS = "".join(map(chr, range(32, 127))) + "µ²³·×°±−–αβθφψΣ∫"
_EM, _ROWS, _BASELINE = 48, 51, 39
"""Pixels per em of the stored letters, their height, and the row of their baseline."""
_RAISED = 0.68
"""Size of a superscript relative to the letters."""
# DejaVu Sans, whose licence allows any use: a byte for the width of each character, then one bit per pixel, column by
# column, which is 1 where ink begins or ends along a row.
_BITS = Path(__file__).with_name("letters.txt")


def text_ink(text: str, size: float) -> tuple[Floats32, float]:
    """Return the ink of a line of text (rows, columns), 0 to 1, `size` pixels per em, and the row of the baseline.

    An unknown character is drawn as "?".
    """
    letters = _letters()
    ink = np.concatenate([letters.get(character, letters["?"]) for character in text or " "], axis=1)
    share = size / _EM
    shape = max(1, round(ink.shape[0] * share)), max(1, round(ink.shape[1] * share))
    return resize_picture(ink[..., None], *shape)[..., 0], _BASELINE * shape[0] / _ROWS


def width(text: str, size: float) -> float:
    """Return the width, pixels, of a line of text."""
    letters = _letters()
    return sum(letters.get(character, letters["?"]).shape[1] for character in text) * size / _EM


def wrap_text(text: str, fits: Callable[[str], bool]) -> list[str]:
    """Return a text as lines for which `fits` returns True, broken at spaces, but not before a unit of length."""
    lines = [""]
    for word in re.split(r"\s+(?!mm\b)", text.strip()):
        longer = f"{lines[-1]} {word}".strip()
        if lines[-1] and not fits(longer):
            lines.append(word)
        else:
            lines[-1] = longer
    return lines


@functools.cache
def _letters() -> dict[str, Floats32]:
    """Return the ink (rows, width) of each character."""
    stored = np.frombuffer(zlib.decompress(base64.b85decode(_BITS.read_bytes().strip())), np.uint8)
    widths, bits = stored[: len(_CHARACTERS)].astype(int), np.unpackbits(stored[len(_CHARACTERS) :])
    flips = bits[: widths.sum() * _ROWS].reshape(-1, _ROWS)
    ink = np.bitwise_xor.accumulate(flips, axis=0).T.astype(np.float32)
    letters = dict(zip(_CHARACTERS, np.split(ink, np.cumsum(widths)[:-1], axis=1), strict=True))
    for plain, raised in SUPERSCRIPTS.items():
        small = resize_picture(letters[chr(plain)][..., None], *(round(_RAISED * n) for n in letters[chr(plain)].shape))
        letters[chr(raised)] = np.pad(small[..., 0], ((0, _ROWS - len(small)), (0, 0)))
    return letters
