"""OpenEXR files of one channel of float32: exact numbers as a picture."""

import struct
import zlib

import numpy as np
from numpy.typing import ArrayLike

_LINES = 16  # in a block that is compressed
_ZIP = 3


def exr_bytes(picture: ArrayLike) -> bytes:
    """The contents of an .exr file of a picture (height, width), float32, row 0 at the top, compressed without loss.

    Its channel is luminance: programs that show colours put the number into red, green and blue.
    """
    pixels = np.ascontiguousarray(picture, "<f4")
    height, width = pixels.shape
    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    attributes = (
        (b"channels", b"chlist", b"Y\0" + struct.pack("<iB3xii", 2, 0, 1, 1) + b"\0"),  # 2: float32, every pixel
        (b"compression", b"compression", bytes([_ZIP])),
        (b"dataWindow", b"box2i", window),
        (b"displayWindow", b"box2i", window),
        (b"lineOrder", b"lineOrder", b"\0"),  # from the top
        (b"pixelAspectRatio", b"float", struct.pack("<f", 1.0)),
        (b"screenWindowCenter", b"v2f", struct.pack("<2f", 0.0, 0.0)),
        (b"screenWindowWidth", b"float", struct.pack("<f", 1.0)),
    )
    parts = [name + b"\0" + kind + b"\0" + struct.pack("<i", len(data)) + data for name, kind, data in attributes]
    header = struct.pack("<2I", 20000630, 2) + b"".join(parts) + b"\0"  # the format's magic number and version
    blocks = []
    for line in range(0, height, _LINES):
        data = _packed(pixels[line : line + _LINES].tobytes())
        blocks.append(struct.pack("<2i", line, len(data)) + data)
    first = len(header) + 8 * len(blocks)
    starts = first + np.cumsum([0, *map(len, blocks[:-1])])
    return b"".join([header, starts.astype("<u8").tobytes(), *blocks])


def _packed(data: bytes) -> bytes:
    """A block as the format's ZIP stores it: differences of its even, then its odd bytes; unchanged if that is shorter."""
    octets = np.frombuffer(data, np.uint8)
    sorted_ = np.concatenate([octets[0::2], octets[1::2]])
    sorted_[1:] = np.diff(sorted_) + np.uint8(128)
    packed = zlib.compress(sorted_.tobytes(), 1)
    return packed if len(packed) < len(data) else data
