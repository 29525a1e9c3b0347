"""How a frame of counts lies on the crystal: the eight ways in which a picture can be turned and mirrored.

Each is named by what a person knows who stands at the detector: from which side of the crystal the picture is seen, and
which of the module's axes is at its top, where row 0 is. "front" is the side of the pinhole, "back" that of the electronics.
"""

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

_SIDES = {"front": ("From the Pinhole", -1), "back": ("From Behind", 1)}
"""Label, and the direction of sight along k."""
_AXES = {"+u": (1, 0), "-u": (-1, 0), "+v": (0, 1), "-v": (0, -1)}


def _directions(word: str) -> tuple[tuple[int, int], tuple[int, int]]:
    """Along which (u, v) the columns' index and the rows' index grow."""
    sight = _SIDES[word[:-2]][1]
    u, v = _AXES[word[-2:]]
    # Right is sight x up, and k x u = v, k x v = -u.
    return (-sight * v, sight * u), (-u, -v)


def _named(direction: tuple[int, int]) -> str:
    return next(name for name, axis in _AXES.items() if axis == direction)


def _described(word: str) -> tuple[str, str]:
    columns, rows = map(_named, _directions(word))
    return f"{_SIDES[word[:-2]][0]}, {word[-2:]} at the Top", f"Columns run along {columns}, rows along {rows}"


ORIENTATIONS: Mapping[str, tuple[str, str]] = {
    word: _described(word) for word in (side + axis for side in _SIDES for axis in ("+v", "-v", "+u", "-u"))
}
"""The words, each with its label and along which axes columns and rows run: "front+v" is a picture, row 0 at the top, of the
crystal as seen from the pinhole with +v at the top. "back-v": columns along +u and rows along +v, as in our run files of the
real detector and in what GATE writes of our geometry."""


def on_crystal(frames: ArrayLike, word: str) -> NDArray:
    """Frames (..., rows, columns) of an orientation as images (..., n_v, n_u): columns along +u, rows along +v."""
    columns, rows = _directions(word)
    images = np.asarray(frames)
    if columns[0] == 0:  # a frame's columns are the image's rows
        images, columns, rows = np.swapaxes(images, -1, -2), rows, columns
    return images[..., :: rows[1], :: columns[0]]
