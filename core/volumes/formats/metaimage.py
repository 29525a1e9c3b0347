"""MetaImage, ITK's format: a header of ``Key = Value`` lines, and raw or zlib-compressed voxels behind or beside it.

Only ITK and SimpleITK read it in Python, and they are too large to depend on (50 MB). The format is described at
https://itk.org/Wiki/ITK/MetaIO/Documentation
"""

import zlib
from pathlib import Path
from typing import BinaryIO

import numpy as np

from ...arrays import Floats
from ...errors import InputError, expecting
from ...files import require_file
from ...geometry.frames import affine_matrix
from .contents import RAS_FROM_LPS, Contents, refuse_several_files, require_voxels, warn_of_assumed

_TYPES = {
    "MET_CHAR": "i1", "MET_SHORT": "i2", "MET_INT": "i4", "MET_LONG": "i4", "MET_LONG_LONG": "i8",
    "MET_UCHAR": "u1", "MET_USHORT": "u2", "MET_UINT": "u4", "MET_ULONG": "u4", "MET_ULONG_LONG": "u8",
    "MET_FLOAT": "f4", "MET_DOUBLE": "f8",
}  # fmt: skip
_MILLIMETRES = {"mm": 1.0, "cm": 10.0, "um": 0.001, "?": 1.0}
_LONGEST_HEADER = 1 << 16


def read(path: Path) -> Contents:
    """Read .mha, or .mhd and the files beside it."""
    with open(path, "rb") as file:
        header = _header(file)
        sizes = _numbers(header, ("DimSize",), None)
        if not (sizes == np.floor(sizes)).all():
            raise InputError(f"DimSize = {header['DimSize']}: expected whole numbers")
        shape = tuple(int(n) for n in sizes)
        if int(header.get("ElementNumberOfChannels", 1)) != 1:
            raise InputError(f"expected one value per voxel, found {header['ElementNumberOfChannels']}")
        kind = header.get("ElementType", "nothing")
        if kind not in _TYPES:
            raise InputError(f"ElementType {kind}: expected one of {', '.join(_TYPES)}")
        big = _true(header.get("BinaryDataByteOrderMSB", header.get("ElementByteOrderMSB", "False")))
        type_ = np.dtype((">" if big else "<") + _TYPES[kind])
        require_voxels(shape, type_)
        for key, plain in (("ElementToIntensityFunctionSlope", 1.0), ("ElementToIntensityFunctionOffset", 0.0)):
            if _numbers(header, (key,), np.array([plain]))[0] != plain:
                raise InputError(f"{key} = {header[key]}: values that are to be scaled are not read")
        values = np.frombuffer(_data(header, file, path, type_.itemsize * int(np.prod(shape, dtype=object))), type_)
    return Contents(values.reshape(shape, order="F"), _affine(header, path))


def _header(file: BinaryIO) -> dict[str, str]:
    """The keys and values up to the last key, ElementDataFile; the voxels may follow in `file`."""
    header: dict[str, str] = {}
    while "ElementDataFile" not in header:
        line = file.readline(_LONGEST_HEADER)
        key, equals, value = line.decode("latin-1").partition("=")
        if not equals:
            raise InputError("not a MetaImage file: expected lines of Key = Value up to ElementDataFile")
        header[key.strip()] = value.strip()
    if header.get("ObjectType", "Image") != "Image":
        raise InputError(f"expected ObjectType = Image, found {header['ObjectType']}")
    return header


def _data(header: dict[str, str], file: BinaryIO, path: Path, size: int) -> bytes:
    """The `size` bytes of voxels."""
    where = header["ElementDataFile"]
    refuse_several_files("ElementDataFile", where)
    if not _true(header.get("BinaryData", "True")):
        raise InputError("BinaryData = False: voxels written as text are not read")
    if where.upper() == "LOCAL":
        return _unpacked(header, file, size, "it")
    beside = path.parent / where
    if not beside.exists():
        raise InputError(f"its voxels are in {where}, which is not beside it")
    with open(require_file(beside), "rb") as raw:
        return _unpacked(header, raw, size, where)


def _unpacked(header: dict[str, str], file: BinaryIO, size: int, name: str) -> bytes:
    skip = int(header.get("HeaderSize", 0))
    if _true(header.get("CompressedData", "False")):
        # One byte more than expected, to notice too much data.
        packed = zlib.decompressobj(zlib.MAX_WBITS | 32)
        data = packed.decompress(file.read(), size + 1)
        if len(data) == size and not packed.eof:
            raise InputError(f"{name} ends before the checksum of its voxels")
    else:
        if skip == -1:  # the voxels end the file
            file.seek(-size, 2)
        elif skip:
            file.seek(skip, 1)
        data = file.read(size + 1)
    if len(data) != size:
        more = "more" if len(data) > size else len(data)
        raise InputError(f"expected {size} bytes of voxels (DimSize x ElementType), {name} holds {more}")
    return data


def _affine(header: dict[str, str], path: Path) -> Floats:
    """Index to world mm, with a warning of what the header does not say."""
    spacing, offset = ("ElementSpacing", "ElementSize"), ("Offset", "Position", "Origin")
    turned = ("TransformMatrix", "Rotation", "Orientation")
    words = header.get("AnatomicalOrientation", "RAI")  # ITK writes it beside the matrix, which takes precedence
    if not header.keys() & set(turned) and words.upper() not in ("RAI", "???"):
        raise InputError(f"AnatomicalOrientation = {words} without a TransformMatrix: expected the matrix, or RAI")
    # Row i of the matrix is the direction of axis i.
    directions = _numbers(header, turned, np.eye(3).ravel()).reshape(3, 3)
    axes, origin = directions.T * _numbers(header, spacing, np.ones(3)), _numbers(header, offset, np.zeros(3))
    unit = header.get("DistanceUnits", "?")
    if unit not in _MILLIMETRES:
        raise InputError(f"DistanceUnits = {unit}: expected mm, cm or um")
    assumed = ["voxels of 1 mm"] * (not header.keys() & set(spacing))
    assumed += ["the first voxel's centre at (0, 0, 0)"] * (not header.keys() & set(offset))
    warn_of_assumed(path, assumed)
    return RAS_FROM_LPS @ affine_matrix(axes * _MILLIMETRES[unit], origin * _MILLIMETRES[unit])


def _numbers(header: dict[str, str], keys: tuple[str, ...], default: Floats | None) -> Floats:
    """The numbers of the first of `keys` in the header, as many as `default` has."""
    text = next((header[key] for key in keys if key in header), None)
    if text is None:
        if default is None:
            raise InputError(f"it has no {keys[0]}")
        return default
    with expecting(f"{keys[0]} = {text}: expected numbers"):
        numbers = np.array(text.split(), np.float64)
    if default is not None and len(numbers) != len(default):
        raise InputError(f"{keys[0]} = {text}: expected {len(default)} numbers")
    return numbers


def _true(text: str) -> bool:
    return text.strip().lower() in ("true", "t", "1", "yes")
