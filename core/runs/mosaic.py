"""Pictures of projections: upright, as seen from the pinhole, alone or side by side."""

import os
import struct
import zlib

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import InputError
from ..files import replacing


def as_seen(images: ArrayLike) -> NDArray:
    """Images (..., n_v, n_u) as pictures: row 0 at the top, +v up, and +u to the left as seen from the pinhole.

    (u, v, k) is right-handed and k points away from the pinhole into the scene, so whoever looks along k with +v up
    has +u to the left: a picture in this order is what a camera in the pinhole sees, not its mirror image.
    """
    return np.asarray(images)[..., ::-1, ::-1]


COLUMNS = 20
"""Images in a row, unless told otherwise."""


def mosaic(images: ArrayLike, columns: int = COLUMNS) -> NDArray:
    """Pictures of all images (M, n_v, n_u) in one (rows * n_v, columns * n_u), row 0 at the top; empty places are 0.

    They follow each other row by row from the top left: 80 modules in 4 rings and 20 `columns` show a ring a row.
    """
    images = as_seen(images)
    if images.ndim != 3:
        raise InputError(f"mosaic: expected images of shape (M, n_v, n_u), got {images.shape}")
    if columns < 1:
        raise InputError(f"mosaic: expected 1 column or more, got {columns}")
    count, n_v, n_u = images.shape
    rows = -(-count // columns)
    sheet = np.zeros((rows * columns, n_v, n_u), images.dtype)
    sheet[:count] = images
    return sheet.reshape(rows, columns, n_v, n_u).swapaxes(1, 2).reshape(rows * n_v, columns * n_u)


def write_png(picture: ArrayLike, path: str | os.PathLike[str]) -> None:
    """Write a picture (row 0 at the top) as an 8-bit grey PNG: 0 is black, or the smallest value if that is negative.

    The largest value is white. `InputError` where the file cannot be written.
    """
    picture = np.asarray(picture, np.float32)
    low, high = float(picture.min(initial=0.0)), float(picture.max(initial=0.0))
    grey = np.rint((picture - low) / ((high - low) or 1.0) * 255).astype(np.uint8)
    header = struct.pack(">2I5B", grey.shape[1], grey.shape[0], 8, 0, 0, 0, 0)  # 8 bits, grey
    rows = zlib.compress(np.pad(grey, ((0, 0), (1, 0))).tobytes())  # a 0 before each: it is stored as it is
    png = b"\x89PNG\r\n\x1a\n"
    for name, data in ((b"IHDR", header), (b"IDAT", rows), (b"IEND", b"")):
        png += struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
    with replacing(path) as temporary:
        temporary.write_bytes(png)
