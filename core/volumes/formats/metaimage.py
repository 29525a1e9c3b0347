"""Read MetaImage, ITK's format: a header of ``Key = Value`` lines, and raw or zlib-compressed voxels behind or beside it.

Only ITK and SimpleITK read it in Python, and they are too large to depend on (50 MB). The format is described at
https://itk.org/Wiki/ITK/MetaIO/Documentation
"""

import os
import zlib
from pathlib import Path
from typing import BinaryIO

import numpy as np

from ...arrays import Floats
from ...errors import InputError, expecting
from ...geometry.frames import affine_matrix
from ...validation import whole_in_file
from .contents import RAS_FROM_LPS, VolumeFileContents, find_data_file, require_voxels, warn_of_assumptions

_TYPES = {
    "MET_CHAR": "i1", "MET_SHORT": "i2", "MET_INT": "i4", "MET_LONG": "i4", "MET_LONG_LONG": "i8",
    "MET_UCHAR": "u1", "MET_USHORT": "u2", "MET_UINT": "u4", "MET_ULONG": "u4", "MET_ULONG_LONG": "u8",
    "MET_FLOAT": "f4", "MET_DOUBLE": "f8",
}  # fmt: skip
_MILLIMETRES = {"mm": 1.0, "cm": 10.0, "um": 0.001, "?": 1.0}
_SPACINGS, _OFFSETS = ("ElementSpacing", "ElementSize"), ("Offset", "Position", "Origin")
_MATRICES = ("TransformMatrix", "Rotation", "Orientation")
_LONGEST_HEADER = 1 << 16
_MOST_VOXELS = 2**31 - 1  # along an axis: ITK keeps them in 32 bits


def read(path: Path) -> VolumeFileContents:
    """Read a .mha file, or a .mhd file and the file with its voxels."""
    with open(path, "rb") as file:
        header = _read_header(file)
        if "DimSize" not in header:
            raise InputError("it has no DimSize")
        shape = tuple(whole_in_file(number, "DimSize", 1, _MOST_VOXELS) for number in header["DimSize"].split())
        whole_in_file(header.get("NDims", len(shape)), "NDims", len(shape), len(shape))
        if len(shape) == 4 and shape[3] == 1:  # one volume
            shape = shape[:3]
        if header.get("ElementNumberOfChannels", "1") != "1":
            raise InputError(f"expected one value per voxel, found {header['ElementNumberOfChannels']}")
        element_type = header.get("ElementType", "nothing")
        if element_type not in _TYPES:
            raise InputError(f"ElementType {element_type}: expected one of {', '.join(_TYPES)}")
        is_big_endian = _is_true(header.get("BinaryDataByteOrderMSB", header.get("ElementByteOrderMSB", "False")))
        dtype = np.dtype((">" if is_big_endian else "<") + _TYPES[element_type])
        require_voxels(shape, dtype)
        for key, neutral in (("ElementToIntensityFunctionSlope", 1.0), ("ElementToIntensityFunctionOffset", 0.0)):
            if _numbers(header, (key,), np.array([neutral]))[0] != neutral:
                raise InputError(f"{key} = {header[key]}: values that are to be scaled are not read")
        n_bytes = dtype.itemsize * int(np.prod(shape, dtype=object))
        values = np.frombuffer(_read_data(header, file, path, n_bytes), dtype)
    return VolumeFileContents(values.reshape(shape, order="F"), _affine(header, path))


def _read_header(file: BinaryIO) -> dict[str, str]:
    """Return the header's keys and values up to its last key, ElementDataFile; the voxels may follow in `file`."""
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


def _read_data(header: dict[str, str], file: BinaryIO, path: Path, size: int) -> bytes:
    """Return the `size` bytes of the voxels, from the open header's `file` or the file that the header names."""
    name = header["ElementDataFile"]
    if not _is_true(header.get("BinaryData", "True")):
        raise InputError("BinaryData = False: voxels written as text are not read")
    if name.upper() == "LOCAL":
        return _decompress(header, file, size, "it")
    with open(find_data_file(path, "ElementDataFile", name), "rb") as voxels_file:
        return _decompress(header, voxels_file, size, name)


def _decompress(header: dict[str, str], file: BinaryIO, size: int, name: str) -> bytes:
    """Return the `size` bytes of voxels that follow in `file`, decompressed if need be; messages begin with `name`."""
    n_held = os.fstat(file.fileno()).st_size
    skip = whole_in_file(header.get("HeaderSize", 0), "HeaderSize", -1, n_held)
    if _is_true(header.get("CompressedData", "False")):
        # One byte more than expected is requested, so that surplus data are noticed.
        decompressor = zlib.decompressobj(zlib.MAX_WBITS | 32)
        data = decompressor.decompress(file.read(), size + 1)
        if len(data) == size and not decompressor.eof:
            raise InputError(f"{name} ends before the checksum of its voxels")
    else:
        if skip == -1:  # the voxels are the last bytes of the file
            file.seek(-min(size, n_held), 2)
        elif skip:
            file.seek(skip, 1)
        data = file.read(min(size, n_held) + 1)
    if len(data) != size:
        actual = "more" if len(data) > size else len(data)
        raise InputError(f"expected {size} bytes of voxels (DimSize x ElementType), {name} holds {actual}")
    return data


def _affine(header: dict[str, str], path: Path) -> Floats:
    """Return the affine world-from-index, mm, in RAS; warn of assumptions about missing fields."""
    letters = header.get("AnatomicalOrientation", "RAI")  # ITK writes it beside the matrix, which takes precedence
    if not header.keys() & set(_MATRICES) and letters.upper() not in ("RAI", "???"):
        raise InputError(f"AnatomicalOrientation = {letters} without a TransformMatrix: expected the matrix, or RAI")
    # Row i of the matrix is the direction of axis i.
    directions = _numbers(header, _MATRICES, np.eye(3).ravel()).reshape(3, 3)
    axes, origin = directions.T * _numbers(header, _SPACINGS, np.ones(3)), _numbers(header, _OFFSETS, np.zeros(3))
    unit = header.get("DistanceUnits", "?")
    if unit not in _MILLIMETRES:
        raise InputError(f"DistanceUnits = {unit}: expected mm, cm or um")
    assumptions = ["voxels of 1 mm"] * (not header.keys() & set(_SPACINGS))
    assumptions += ["the first voxel's centre at (0, 0, 0)"] * (not header.keys() & set(_OFFSETS))
    warn_of_assumptions(path, assumptions)
    return RAS_FROM_LPS @ affine_matrix(axes * _MILLIMETRES[unit], origin * _MILLIMETRES[unit])


def _numbers(header: dict[str, str], keys: tuple[str, ...], default: Floats) -> Floats:
    """Return the numbers of the first of `keys` in the header, as many as `default` has, or `default` if all are missing."""
    text = next((header[key] for key in keys if key in header), None)
    if text is None:
        return default
    with expecting(f"{keys[0]} = {text}: expected numbers"):
        numbers = np.array(text.split(), np.float64)
    if len(header["DimSize"].split()) == 4 and len(numbers) in (4, 16):
        numbers = numbers.reshape(-1, 4)[:3, :3].ravel()  # those of the first three axes
    if len(numbers) != len(default):
        raise InputError(f"{keys[0]} = {text}: expected {len(default)} numbers")
    return numbers


def _is_true(text: str) -> bool:
    """Return whether a header's `text` means yes."""
    return text.strip().lower() in ("true", "t", "1", "yes")
