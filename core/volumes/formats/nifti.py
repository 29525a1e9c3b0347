"""NIfTI-1 and -2, and Analyze 7.5, by nibabel."""

import contextlib
import gzip
import json
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import InputError, first_line, warn
from ...files import require_file
from ...geometry.frames import moved
from ..volume import UNITS, Volume
from .contents import Contents, require_voxels

_MILLIMETRES = {"unknown": 1.0, "mm": 1.0, "meter": 1000.0, "micron": 0.001}
_ANALYZE_MILLIMETRES = {"": 1.0, "mm": 1.0, "cm": 10.0, "m": 1000.0, "um": 0.001}
_APART = 0.1  # voxels by which sform and qform may differ, because quaternions of float32 are rounded


def read(path: Path) -> Contents:
    """Read .nii, .nii.gz, or a pair .hdr and .img."""
    pair = (".hdr", ".img") if path.suffix.lower() in (".hdr", ".img") else ()
    for half in filter(Path.exists, map(path.with_suffix, pair)):
        require_file(half)
    with gzip.open(path) if path.suffix.lower() == ".gz" else contextlib.nullcontext() as packed:
        contents = _contents(_image(path, packed), path)
        while packed is not None and packed.read(1 << 20):  # to its end, where its checksum is
            pass
    return contents


def _image(path: Path, packed: Any) -> Any:
    """Nibabel's image, which reads its voxels from an open .nii.gz, if it is one."""
    import nibabel
    from nibabel.filebasedimages import ImageFileError
    from nibabel.imageglobals import logger

    logger.disabled, before = True, logger.disabled  # nibabel prints what it raises
    try:
        image = nibabel.load(path)
        if packed is not None:
            image = type(image).from_file_map({"image": nibabel.FileHolder(fileobj=packed)})
    except ImageFileError as error:
        raise InputError(f"not a NIfTI file ({first_line(error)})") from None
    finally:
        logger.disabled = before
    if not isinstance(image, nibabel.AnalyzeImage):  # the base class of NIfTI's
        raise InputError(f"expected NIfTI, found {type(image).__name__}")
    return nibabel.squeeze_image(image)  # (x, y, z, 1) is common


def _contents(image: Any, path: Path) -> Contents:
    import nibabel

    require_voxels(image.shape, image.get_data_dtype())
    affine, header = np.array(image.affine, np.float64), image.header
    if not isinstance(image, nibabel.Nifti1Pair):
        warn(f"{path}: Analyze files do not say where the patient lies: taken as centred, x from right to left")
        length = bytes(header["vox_units"].item()).decode("latin-1").strip("\0 ").lower()
        if length not in _ANALYZE_MILLIMETRES:
            raise InputError(f"vox_units {length!r}: expected mm, cm, m or um")
        affine[:3] *= _ANALYZE_MILLIMETRES[length]
        return Contents(image.get_fdata(dtype=np.float32, caching="unchanged"), affine)
    if header["qform_code"] == header["sform_code"] == 0:
        warn(f"{path}: it does not say where the patient lies: taken as centred, x from right to left")
    elif header["qform_code"] > 0 and header["sform_code"] > 0:
        corners = np.array(list(np.ndindex(2, 2, 2))) * (np.array(image.shape) - 1)
        apart = np.linalg.norm(moved(affine - header.get_qform(), corners), axis=1).max() / min(header.get_zooms())
        if apart > _APART:
            warn(f"{path}: its sform and qform lie up to {apart:.3g} voxels apart: taken by the sform")
    affine[:3] *= _MILLIMETRES[header.get_xyzt_units()[0]]
    named = header.get_intent()[2]
    unit: str | None = None
    with contextlib.suppress(ValueError, AttributeError):  # as `write` left it
        unit = json.loads(bytes(header["descrip"].item()).decode()).get("unit")
    values = image.get_fdata(dtype=np.float32, caching="unchanged")
    return Contents(values, affine, named if named in UNITS else None, unit)


def write(volume: Volume, temporary: Path) -> None:
    """Write NIfTI-1; its affine is rounded to float32."""
    import nibabel

    image = nibabel.Nifti1Image(volume.array, volume.grid.affine)
    image.header.set_xyzt_units("mm")
    image.header.set_intent("none", name=volume.quantity)
    image.header["descrip"] = json.dumps({"quantity": volume.quantity, "unit": volume.unit}).encode()[:79]
    if volume.note:
        image.header.extensions.append(nibabel.nifti1.Nifti1Extension("comment", volume.note.encode()))
    nibabel.save(image, temporary)
