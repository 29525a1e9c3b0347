"""OpenEXR files of one channel of float32: exact numbers as a picture."""

import struct
import zlib

import numpy as np
from numpy.typing import ArrayLike

_LINES = 16  # rows of a compressed block
_ZIP = 3  # code of the compression


def exr_bytes(picture: ArrayLike) -> bytes:
    """Return the bytes of an .exr file of a picture (height, width), float32, row 0 at the top, compressed without loss.

    The channel is luminance: programs that show colours put the number into red, green and blue.
    """
    pixels = np.ascontiguousarray(picture, "<f4")
    height, width = pixels.shape
    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    attributes = (
        (b"channels", b"chlist", b"Y\0" + struct.pack("<iB3xii", 2, 0, 1, 1) + b"\0"),  # 2: float32, every pixel
        (b"compression", b"compression", bytes([_ZIP])),
        (b"dataWindow", b"box2i", window),
        (b"displayWindow", b"box2i", window),
        (b"lineOrder", b"lineOrder", b"\0"),  # rows from the top
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
    starts = len(header) + 8 * len(blocks) + np.cumsum([0, *map(len, blocks[:-1])])
    return b"".join([header, starts.astype("<u8").tobytes(), *blocks])


def _packed(data: bytes) -> bytes:
    """Return a block compressed by the format's ZIP: differences of the even, then the odd bytes; unchanged if shorter."""
    octets = np.frombuffer(data, np.uint8)
    reordered = np.concatenate([octets[0::2], octets[1::2]])
    reordered[1:] = np.diff(reordered) + np.uint8(128)
    packed = zlib.compress(reordered.tobytes(), 1)
    return packed if len(packed) < len(data) else data
