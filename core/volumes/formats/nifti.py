"""Read NIfTI-1, NIfTI-2 and Analyze 7.5, and write NIfTI-1, by nibabel."""

import contextlib
import gzip
import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import InputError, first_line, warn
from ...files import require_file
from ...geometry.frames import moved
from ..volume import UNITS, Volume
from .contents import VolumeFileContents, require_voxels

_MILLIMETRES = {"unknown": 1.0, "mm": 1.0, "meter": 1000.0, "micron": 0.001}
_ANALYZE_MILLIMETRES = {"": 1.0, "mm": 1.0, "cm": 10.0, "m": 1000.0, "um": 0.001}
_DEFLATE = 1032  # largest ratio by which gzip compresses
_MAX_GAP = 0.1  # voxels by which sform and qform may lie apart, because quaternions of float32 are rounded


def read(path: Path) -> VolumeFileContents:
    """Read a .nii or .nii.gz file, or a pair of .hdr and .img."""
    suffixes = (".hdr", ".img") if path.suffix.lower() in (".hdr", ".img") else ()
    for file in filter(Path.exists, map(path.with_suffix, suffixes)):
        require_file(file)
    with gzip.open(path) if path.suffix.lower() == ".gz" else contextlib.nullcontext() as stream:
        contents = _contents(_open_image(path, stream), path)
        while stream is not None and stream.read(1 << 20):  # to the end, where the checksum is
            pass
    return contents


def _open_image(path: Path, stream: Any) -> Any:
    """Return nibabel's image of the file; of a .nii.gz it reads the voxels from the open `stream`, else that is None."""
    import nibabel
    from nibabel.filebasedimages import ImageFileError
    from nibabel.imageglobals import logger

    logger.disabled, was_disabled = True, logger.disabled  # nibabel prints what it raises
    try:
        image = nibabel.load(path)
        if stream is not None:
            image = type(image).from_file_map({"image": nibabel.FileHolder(fileobj=stream)})
    except ImageFileError as error:
        raise InputError(f"not a NIfTI file ({first_line(error)})") from None
    finally:
        logger.disabled = was_disabled
    if not isinstance(image, nibabel.AnalyzeImage):  # the base class of NIfTI's
        raise InputError(f"expected NIfTI, found {type(image).__name__}")
    if isinstance(image, nibabel.Nifti1Image) and image.dataobj.offset < image.header.single_vox_offset:
        raise InputError(f"vox_offset {image.dataobj.offset}: expected {image.header.single_vox_offset} or more")
    return nibabel.squeeze_image(image)  # (x, y, z, 1) is common


def _contents(image: Any, path: Path) -> VolumeFileContents:
    """Return values, affine, quantity and unit of nibabel's image; warn where the patient's position is unclear."""
    import nibabel

    n_held = _DEFLATE * path.stat().st_size if path.suffix.lower() == ".gz" else math.inf  # nibabel maps other files
    require_voxels(image.shape, image.get_data_dtype(), n_held)
    affine, header = np.array(image.affine, np.float64), image.header
    if not isinstance(image, nibabel.Nifti1Pair):
        warn(f"{path}: Analyze files do not say where the patient lies: taken as centred, x from right to left")
        length_unit = bytes(header["vox_units"].item()).decode("latin-1").strip("\0 ").lower()
        if length_unit not in _ANALYZE_MILLIMETRES:
            raise InputError(f"vox_units {length_unit!r}: expected mm, cm, m or um")
        affine[:3] *= _ANALYZE_MILLIMETRES[length_unit]
        return VolumeFileContents(image.get_fdata(dtype=np.float32, caching="unchanged"), affine)
    if header["qform_code"] == header["sform_code"] == 0:
        warn(f"{path}: it does not say where the patient lies: taken as centred, x from right to left")
    elif header["qform_code"] > 0 and header["sform_code"] > 0 and not header.get_sform()[:3, :3].any():
        affine = np.array(header.get_qform(), np.float64)  # a sform of zeros is none
    elif header["qform_code"] > 0 and header["sform_code"] > 0:
        corners = np.array(list(np.ndindex(2, 2, 2))) * (np.array(image.shape) - 1)
        gap = np.linalg.norm(moved(affine - header.get_qform(), corners), axis=1).max() / min(header.get_zooms())
        if gap > _MAX_GAP:
            warn(f"{path}: its sform and qform lie up to {gap:.3g} voxels apart: taken by the sform")
    affine[:3] *= _MILLIMETRES[header.get_xyzt_units()[0]]
    intent_name = header.get_intent()[2]
    unit: str | None = None
    with contextlib.suppress(ValueError, AttributeError):  # only `write` stores JSON there
        unit = json.loads(bytes(header["descrip"].item()).decode()).get("unit")
    values = image.get_fdata(dtype=np.float32, caching="unchanged")
    return VolumeFileContents(values, affine, intent_name if intent_name in UNITS else None, unit)


def write(volume: Volume, temporary: Path) -> None:
    """Write a volume as NIfTI-1 to the path `temporary`; its affine is rounded to float32."""
    import nibabel

    image = nibabel.Nifti1Image(volume.array, volume.grid.affine)
    image.header.set_xyzt_units("mm")
    image.header.set_intent("none", name=volume.quantity)
    image.header["descrip"] = json.dumps({"quantity": volume.quantity, "unit": volume.unit}).encode()[:79]
    if volume.note:
        image.header.extensions.append(nibabel.nifti1.Nifti1Extension("comment", volume.note.encode()))
    nibabel.save(image, temporary)
