"""Volumes in files: NIfTI, and npz with the exact affine."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path

import numpy as np

from .checks import freeze
from .errors import InputError
from .files import replacing
from .grid import Grid
from .memory import require
from .volume import UNITS, Volume

VOLUME_FORMATS = (".nii", ".nii.gz", ".npz")
_MILLIMETRES = {"unknown": 1.0, "mm": 1.0, "meter": 1000.0, "micron": 0.001}


def read_volume(path: str | os.PathLike[str], quantity: str | None = None) -> Volume:
    """Read a volume from NIfTI (.nii, .nii.gz) or .npz.

    Parameters
    ----------
    path
        The file.
    quantity
        What the values are: ``"activity"`` (kBq/mL), ``"mu"`` (1/mm), ``"hu"`` … Default: what the file says;
        a NIfTI file that says nothing is taken for CT, ``"hu"``.

    Raises
    ------
    InputError
        No such file, not such a file, damaged, not 3-D, not finite, or too large for the memory.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    kind = _kind(path)
    try:
        return _read_npz(path, quantity) if kind == ".npz" else _read_nifti(path, quantity)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except Exception as error:  # whatever numpy, nibabel, zip or gzip raise on a damaged file
        raise InputError(f"{path}: cannot be read as {kind} ({_first_line(error)})") from error


def write_volume(volume: Volume, path: str | os.PathLike[str]) -> None:
    """Write a volume as NIfTI (.nii, .nii.gz; its affine is rounded to float32) or .npz (exact).

    Raises
    ------
    InputError
        Another suffix, or the file cannot be written.
    """
    path = Path(path)
    kind = _kind(path)
    with replacing(path) as temporary:
        if kind == ".npz":
            with open(temporary, "wb") as file:
                np.savez_compressed(
                    file, array=volume.array, affine=volume.grid.affine, quantity=volume.quantity, unit=volume.unit
                )
        else:
            _write_nifti(volume, temporary)


def _read_npz(path: Path, quantity: str | None) -> Volume:
    file = np.load(path, allow_pickle=False)
    if not isinstance(file, np.lib.npyio.NpzFile):
        raise InputError("expected an npz archive, found a single array")
    with file:
        missing = {"array", "affine", "quantity"} - set(file.files)
        if missing:
            raise InputError(f"expected the arrays array, affine and quantity; {', '.join(sorted(missing))} not found")
        array = file["array"]
        if array.ndim != 3:
            raise InputError(f"expected a 3-D array, got shape {array.shape}")
        n_x, n_y, n_z = array.shape
        return Volume(freeze(array), Grid((n_x, n_y, n_z), file["affine"]), quantity or str(file["quantity"]))


def _read_nifti(path: Path, quantity: str | None) -> Volume:
    import nibabel
    from nibabel.filebasedimages import ImageFileError

    try:
        image = nibabel.load(path)
    except ImageFileError as error:
        raise InputError(f"not a NIfTI file ({_first_line(error)})") from None
    if not isinstance(image, nibabel.Nifti1Image):
        raise InputError(f"expected NIfTI, found {type(image).__name__}")
    image = nibabel.squeeze_image(image)  # (x, y, z, 1) is common, and a volume
    shape = image.shape
    if len(shape) != 3:
        raise InputError(f"expected a 3-D image, got shape {' x '.join(map(str, shape))}")
    if image.get_data_dtype().kind not in "fiu":
        raise InputError(f"expected real numbers, found {image.get_data_dtype()}")
    require(8.5 * math.prod(shape), "a volume of {} x {} x {} voxels".format(*shape))
    unit = image.header.get_xyzt_units()[0]
    affine = np.array(image.affine, np.float64)
    affine[:3] *= _MILLIMETRES[unit]
    array = np.ascontiguousarray(image.get_fdata(dtype=np.float32, caching="unchanged"))
    named = image.header.get_intent()[2]
    return Volume(freeze(array), Grid(shape, affine), quantity or (named if named in UNITS else "hu"))


def _write_nifti(volume: Volume, path: Path) -> None:
    import nibabel

    image = nibabel.Nifti1Image(volume.array, volume.grid.affine)
    image.header.set_xyzt_units("mm")
    image.header.set_intent("none", name=volume.quantity)
    image.header["descrip"] = json.dumps({"quantity": volume.quantity, "unit": volume.unit}).encode()[:79]
    nibabel.save(image, path)


def _kind(path: Path) -> str:
    name = path.name.lower()
    for suffix in VOLUME_FORMATS:
        if name.endswith(suffix):
            return suffix
    raise InputError(f"{path}: expected a name ending in {', '.join(VOLUME_FORMATS)}")


def _first_line(error: Exception) -> str:
    return (str(error) or type(error).__name__).splitlines()[0]
