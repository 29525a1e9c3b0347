"""Orientations of a frame of counts on the crystal: the eight ways in which a picture can be turned and mirrored.

An orientation is named by facts that can be seen at the detector: the side of the crystal from which the picture is seen,
and the module's axis at the top of the picture, where row 0 is. "front" is the side of the pinhole, "back" the side of the
electronics.
"""

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

_SIDES = {"front": ("From the Pinhole", -1), "back": ("From Behind", 1)}
"""Label, and direction of sight along k, by side."""
_AXES = {"+u": (1, 0), "-u": (-1, 0), "+v": (0, 1), "-v": (0, -1)}
"""Directions (u, v) by the names of the module's axes."""


def _directions(word: str) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return the directions (u, v) in which the column index and the row index grow."""
    sight = _SIDES[word[:-2]][1]
    u, v = _AXES[word[-2:]]
    # The right of the picture is sight x up; k x u = v and k x v = -u.
    return (-sight * v, sight * u), (-u, -v)


def _axis_name(direction: tuple[int, int]) -> str:
    """Return the name, such as "+u", of a direction (u, v)."""
    return next(name for name, axis in _AXES.items() if axis == direction)


def _label_and_text(word: str) -> tuple[str, str]:
    """Return label and description of an orientation, for menus."""
    columns, rows = map(_axis_name, _directions(word))
    return f"{_SIDES[word[:-2]][0]}, {word[-2:]} at the Top", f"Columns run along {columns}, rows along {rows}"


ORIENTATIONS: Mapping[str, tuple[str, str]] = {
    word: _label_and_text(word) for word in (side + axis for side in _SIDES for axis in ("+v", "-v", "+u", "-u"))
}
"""Words for the orientations, each with its label and the axes along which columns and rows run.

"front+v" is a picture, row 0 at the top, of the crystal as seen from the pinhole with +v at the top. "back-v" has columns
along +u and rows along +v, as run files of the real detector and the output of GATE for exported geometries have.
"""


def on_crystal(frames: ArrayLike, word: str) -> NDArray:
    """Return frames (..., rows, columns) of an orientation as images (..., n_v, n_u): columns along +u, rows along +v."""
    columns, rows = _directions(word)
    images = np.asarray(frames)
    if columns[0] == 0:  # the columns of the frame are rows of the image
        images, columns, rows = np.swapaxes(images, -1, -2), rows, columns
    return images[..., :: rows[1], :: columns[0]]
