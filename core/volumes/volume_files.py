"""Read and write volumes in files, in the format of the name's ending; unreadable files give one clear line."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from numpy.typing import ArrayLike

from ..errors import InputError, naming, reading, refusing
from ..files import AnyPath, find_ending, replacing, require_ending, require_file
from ..progress import Progress
from ..validation import instance, real_array
from .formats import dicom, dicom_writing, hdf5, metaimage, nifti, nrrd, numpy_files
from .formats.contents import VolumeFileContents
from .volume import UNITS, Volume

_READERS = {
    **dict.fromkeys((".nii", ".nii.gz", ".hdr", ".img"), nifti.read),
    **dict.fromkeys((".npz", ".npy"), numpy_files.read),
    **dict.fromkeys((".nrrd", ".nhdr"), nrrd.read),
    **dict.fromkeys((".mha", ".mhd"), metaimage.read),
    **dict.fromkeys((".h5", ".hdf5"), hdf5.read),
}
_WRITERS = {
    **dict.fromkeys((".nii", ".nii.gz"), nifti.write),
    ".npz": numpy_files.write,
    ".nrrd": nrrd.write,
    **dict.fromkeys((".h5", ".hdf5"), hdf5.write),
}
VOLUME_FORMATS = (*_WRITERS, ".dcm")
"""Name endings of the formats that `write_volume` writes."""
READ_FORMATS = (*_READERS, ".dcm")
"""Name endings of the formats that `read_volume` reads, besides folders of DICOM files and DICOM files of any name."""


def read_volume(
    path: AnyPath,
    quantity: str | None = None,
    *,
    affine: ArrayLike | None = None,
    series: str | None = None,
    progress: Progress | None = None,
) -> Volume:
    """Read a volume from NIfTI, a DICOM series or tomogram, MetaImage, NRRD, Analyze, HDF5, .npz or .npy.

    World axes are always NIfTI's, RAS. docs/volumes.md describes the formats and conventions, and what is refused.

    Parameters
    ----------
    path
        Path of the file; for a DICOM series, of its folder or any of its files.
    quantity
        Quantity of the values: one of `UNITS`, such as ``"activity"`` (kBq/mL), ``"mu"`` (1/mm) or ``"hu"``. Default: the
        quantity stated in the file, or ``"hu"`` if it states none.
    affine
        Affine world-from-index (4, 4), mm, that replaces the file's own; .npy files need it.
    series
        Number, description or UID of one of several DICOM series in the folder.
    progress
        Called as ``progress(done, total)`` with the slices of a DICOM series; may raise `Cancelled`.
    """
    path = Path(path)
    contents = _read_contents(path, series, progress)
    with naming(path):
        if affine is not None:
            contents = replace(contents, affine=real_array(affine, "affine", (4, 4)))
        if contents.quantity is not None and contents.quantity not in UNITS and quantity is None:
            raise InputError(f"it holds {contents.quantity!r}: say which quantity that is, one of {', '.join(UNITS)}")
        if contents.is_certain:
            _require_quantity(contents, quantity)
        return contents.to_volume(quantity or contents.quantity or "hu")


def read_volume_of(
    path: AnyPath, quantity: str, advice: str = "", *, series: str | None = None, progress: Progress | None = None
) -> Volume:
    """Read a volume of a required `quantity`; a file that states another one raises `InputError`.

    A file that states no quantity is taken to hold the required one. `advice` ends the error message; `series` and
    `progress` are those of `read_volume`.
    """
    path = Path(path)
    contents = _read_contents(path, series, progress)
    with naming(path):
        _require_quantity(contents, quantity, advice)
        return contents.to_volume(quantity)


def _require_quantity(contents: VolumeFileContents, quantity: str | None, advice: str = "") -> None:
    """Raise `InputError` if a file states another quantity than the user's, or an unknown one instead of CT numbers."""
    stated = contents.quantity
    if None not in (stated, quantity) and stated != quantity and (stated in UNITS or quantity == "hu"):
        raise InputError(f"it holds {stated}, expected {quantity} in {UNITS.get(str(quantity), '?')}{advice}")


def write_volume(
    volume: Volume, path: AnyPath, *, template: AnyPath | None = None, tags: Mapping[str, Any] | None = None
) -> None:
    """Write a volume as NIfTI (.nii, .nii.gz; its affine is rounded to float32), .npz, .nrrd, .h5 (exact) or DICOM (.dcm).

    DICOM holds activity and attenuation in one file, a reconstructed tomogram, in Bq/mL and 1/cm; and CT numbers in a new
    folder with a file for each slice. Values have 16 bits.

    Parameters
    ----------
    volume
        Volume on any grid; in DICOM, with axes at right angles.
    path
        Path of the file or folder to write; its ending chooses the format.
    template
        DICOM file of which tags of patient, study and series are taken over.
    tags
        Values of other such tags of DICOM, by keyword: ``{"PatientName": "Doe^Jo", "SeriesDescription": "OSEM"}``.
    """
    path = Path(path)
    ending = require_ending(path, VOLUME_FORMATS)
    instance(volume, Volume, "write_volume")
    if ending == ".dcm":
        with naming(path):
            dicom_writing.write(volume, path, template, tags)
        return
    if template is not None or tags:
        raise InputError(f"{path}: expected a name ending in .dcm: only DICOM has a template and tags")
    with replacing(path) as temporary:
        _WRITERS[ending](volume, temporary)


def _read_contents(path: Path, series: str | None, progress: Progress | None) -> VolumeFileContents:
    """Read the voxels of the file or DICOM folder at `path`, and what it states about them."""
    with refusing(path, "cannot be read"):
        is_folder = path.is_dir()
    if not is_folder:
        require_file(path)
    ending = find_ending(path, READ_FORMATS)
    is_series = is_folder or ending == ".dcm" or (not ending and dicom.is_dicom(path))
    with naming(path):
        if not (ending or is_series):
            raise InputError(f"expected a folder of DICOM files, or a name ending in {', '.join(READ_FORMATS)}")
        if not is_folder and path.stat().st_size == 0:
            raise InputError("it is empty")
        if series is not None and not is_series:
            raise InputError("only folders of DICOM files hold several series")
    with reading(path, "DICOM" if is_series else ending):
        return dicom.read(path, series, progress) if is_series else _READERS[ending](path)
