"""Read DICOM series, by pydicom: slices are sorted by their position in the patient; inconsistent files are refused.

Classic images (one file per slice), enhanced multi-frame images and reconstructed nuclear medicine tomograms, whose frames
are the slices, are read. Index axes run along a row of pixels, down the rows, and from slice to slice: towards right, front
or head, whichever is closest to the slices' normal. A tomogram states the position of its first slice and the distance
between slices (DICOM part 3, C.8.4.11 and C.8.4.15).
"""

import gzip
import textwrap
import warnings
from collections import defaultdict
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from ...arrays import Array, Floats
from ...errors import InputError, first_line, naming, reading, warn
from ...files import note_input, require_file
from ...geometry.frames import affine_matrix
from ...progress import Progress, tell
from ...validation import whole_in_file
from .contents import RAS_FROM_LPS, VolumeFileContents, require_voxels
from .dicom_units import DicomUnit, RealWorldValues, agree, real_world_values, unit_of

_SAME_ORIENTATION = 1e-4  # difference of direction cosines; they are written with 6 digits
_SAME_POSITION = 1e-3  # mm
_SAME_SPACING = 0.02  # relative difference of spacings; scanners round positions
_MOST_FILES = 5000  # files among which folders of images are looked for, to name them in a message
_HOUNSFIELD = ("", "HU", "US")  # types of rescaled values of CT images: not stated, CT numbers, and unspecified
_RESCALE = ("RescaleSlope", "RescaleIntercept", "RescaleType")
TOMOGRAMS = ("RECON TOMO", "RECON GATED TOMO")
"""Reconstructed tomograms, by value 3 of ImageType (C.8.4.9.1.1.3)."""
_OTHER_IMAGES = {
    "TOMO": "projections",
    "GATED TOMO": "gated projections",
    "STATIC": "planar images",
    "WHOLE BODY": "planar images",
    "DYNAMIC": "planar images of several times",
    "GATED": "gated planar images",
}
_NUCLEAR_MEDICINE = "1.2.840.10008.5.1.4.1.1.20"  # SOP class UID


@dataclass(frozen=True, eq=False)
class _Slice:
    """Geometry and rescaling of one image of a series, without its pixels."""

    path: Path
    frame: int  # number of the frame in its file, from 0
    shape: tuple[int, int]  # numbers of rows and columns
    spacing: tuple[float, float]  # distances between rows and between columns, mm
    orientation: Floats  # unit vectors (2, 3) along a row and down the rows, LPS
    position: Floats  # centre (3,) of the first pixel, mm, LPS
    values: RealWorldValues  # slope, intercept and unit of the values, from the stored ones
    thickness: float  # slice thickness, mm, or 0 if not stated
    is_rescaled: bool  # whether the file states the rescaling

    @property
    def name(self) -> str:
        """Name of the file, with the frame's number from 1 after the first frame."""
        return self.path.name + (f" frame {self.frame + 1}" if self.frame else "")


def is_dicom(path: Path) -> bool:
    """Return whether the file at `path` is DICOM: whether the letters "DICM" follow its first 128 bytes."""
    with open(path, "rb") as file:
        return file.read(132)[128:] == b"DICM"


def image_kind(header: Any) -> str:
    """Return value 3 of a nuclear medicine image's ImageType, such as "TOMO", or "" if it has none."""
    values: Any = header.get("ImageType") or ()
    return str(values[2]) if not isinstance(values, str) and len(values) > 2 else ""


def stated_count(tags: Any, name: str, default: int = 1) -> int:
    """Return the whole number of a tag, such as NumberOfFrames, at least 1; `default` where it is missing, empty or 0.

    It cannot be more than the bytes of the file of which the `tags` are; those of a sequence's item have none.
    """
    value, file = tags.get(name), getattr(tags, "filename", None)
    return whole_in_file(value, name, 1, Path(file).stat().st_size if file else None) if value else default


def require_grey(header: Any) -> None:
    """Raise `InputError` for images with several values per pixel, or with numbers in other than the lowest bits."""
    bits, high = (int(header.get(name, 16)) for name in ("BitsStored", "HighBit"))
    if bits != high + 1 and "HighBit" in header:
        raise InputError(f"HighBit {high}: expected {bits - 1}, one below BitsStored")
    if header.get("SamplesPerPixel", 1) != 1:
        raise InputError(f"expected one value per pixel, found {header.SamplesPerPixel} (a colour image)")


def read(path: Path, series: str | None = None, progress: Progress | None = None) -> VolumeFileContents:
    """Read the series in a folder, or the series of a file.

    `series` is the number, description or UID of one of several series in the folder. `progress` is called with
    (done, total) slices.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", module="pydicom")  # warnings of tags that are not used here
        headers = _choose_series(_read_headers(path), series)
        for file, _ in headers:
            note_input(file)
        if len(headers) > 1 and any(_is_whole_volume(header) for _, header in headers):
            names = ", ".join(file.name for file, _ in headers)
            raise InputError(f"its series has several files of several frames each, choose one: {names}")
        slices: list[_Slice] = []
        for file, header in headers:
            with reading(file.name, "DICOM"):  # pydicom parses tags on access
                slices += _read_slices(file, header)
        slices, step = _sort_slices(slices)
        first = slices[0]
        quantity, factor = _quantity(str(headers[0][1].get("Modality")), first.values.code)
        rows, columns = first.shape
        require_voxels((columns, rows, len(slices)), np.dtype(np.float32))
        array = np.empty((columns, rows, len(slices)), np.float32)
        for k, (image, pixels) in enumerate(_read_pixels(slices)):
            array[:, :, k] = (pixels.astype(np.float64) * image.values.slope + image.values.intercept).T * factor
            tell(progress, k + 1, len(slices))
    axes = np.column_stack([*(first.orientation * np.array(first.spacing[::-1])[:, None]), step])
    return VolumeFileContents(array, RAS_FROM_LPS @ affine_matrix(axes, first.position), quantity, None, True)


def _quantity(modality: str, code: str) -> DicomUnit:
    """Return the quantity and factor of values in the unit `code`; the quantity of others is a text: "PT in GML"."""
    unit = unit_of(code)
    is_known = unit is not None and unit.quantity != "counts"
    return unit if unit and is_known else DicomUnit(f"{modality} in {code}" if code else modality, 1.0)


def _read_headers(path: Path) -> list[tuple[Path, Any]]:
    """Read path and header of all images in the folder, or of a file's series, without pixels."""
    import pydicom

    files = sorted(path.iterdir()) if path.is_dir() else [path, *sorted(path.parent.iterdir())]
    series_uid = None  # of the file at `path`; None for a folder
    headers: dict[Path, Any] = {}
    without_pixels: dict[Path, Any] = {}
    for file in files:
        if file in headers or file.is_dir() or file.name.startswith("._"):  # ._NAME: a folder's data of macOS
            continue
        with naming(file.name):
            is_bare = _is_bare(require_file(file, is_input=False))
        if not (is_bare or is_dicom(file)):
            if file.suffix.lower() in (".dcm", ".ima"):
                raise InputError(f"{file.name} is no DICOM file")
            continue
        with reading(file.name, "DICOM"):
            header = pydicom.dcmread(file, stop_before_pixels=True, force=is_bare)
        if file == path:
            if "Rows" in header and (_is_whole_volume(header) or "PerFrameFunctionalGroupsSequence" in header):
                return [(file, header)]
            series_uid = header.get("SeriesInstanceUID")
        # Directories, reports and plans have no pixels.
        if "Rows" not in header:
            without_pixels[file] = header
        elif series_uid is None or header.get("SeriesInstanceUID") == series_uid:
            headers[file] = header
    if not headers:
        top = path if path.is_dir() else path.parent
        files = [file for file in islice(top.rglob("*"), _MOST_FILES) if file.is_file() and is_dicom(file)]
        folders = ", ".join(sorted({str(file.parent.relative_to(top)) for file in files} - {"."})) or "none"
        raise InputError(f"expected a folder with images of a DICOM series; folders with DICOM files in it: {folders}")
    # pydicom reads a truncated file as one with fewer tags. If it has the SOP class of the images, it is one of them.
    image_classes = set(map(_sop_class, headers.values()))
    for file, header in without_pixels.items():
        is_of_series = series_uid in (None, header.get("SeriesInstanceUID", series_uid))
        if is_of_series and any(uid.startswith(_sop_class(header)) for uid in image_classes):
            raise InputError(f"{file.name}: an image without Rows: the file is cut off or damaged")
    return list(headers.items())


def _is_bare(path: Path) -> bool:
    """Return whether a file is DICOM without the prefix "DICM": it begins with the length of the group 0002, or group 0008.

    Raises `InputError` for a packed DICOM file, which is not read.
    """
    with open(path, "rb") as file:
        begin = file.read(8)
    if begin[:2] == b"\x1f\x8b":
        with suppress(OSError, EOFError), gzip.open(path) as packed:
            if packed.read(132)[128:] == b"DICM":
                raise InputError("it is packed: unpack it first")
    return begin[:4] == b"\x02\0\0\0" or (begin[:2] == b"\x08\0" and begin[2:4] <= b"\x20\0")


def _is_nuclear_medicine(header: Any) -> bool:
    """Return whether a file is a nuclear medicine image."""
    return header.get("Modality") == "NM" or header.get("SOPClassUID") == _NUCLEAR_MEDICINE


def _is_whole_volume(header: Any) -> bool:
    """Return whether a single file is a whole volume: a nuclear medicine image of several frames."""
    return _is_nuclear_medicine(header) and stated_count(header, "NumberOfFrames") > 1


def _sop_class(header: Any) -> str:
    """Return the UID of the file's SOP class, such as CT image, or ""."""
    return str(header.file_meta.get("MediaStorageSOPClassUID") or header.get("SOPClassUID", ""))


def _choose_series(headers: list[tuple[Path, Any]], series: str | None) -> list[tuple[Path, Any]]:
    """Return the headers of the series with this number, description or UID, or of the only series."""
    all_series: dict[str, list[tuple[Path, Any]]] = defaultdict(list)
    for file, header in headers:
        all_series[str(header.get("SeriesInstanceUID", ""))].append((file, header))
    if len(all_series) == 1 and series is None:
        return headers
    names = {}  # such as 3 "Thorax 1.0"
    for uid, images in all_series.items():
        number, description = images[0][1].get("SeriesNumber"), images[0][1].get("SeriesDescription")
        names[uid] = " ".join(str(x) for x in (number, description and f'"{description}"') if x is not None) or uid
    repeated = {name for name in names.values() if list(names.values()).count(name) > 1}
    names = {uid: f"{name} {uid}" if name in repeated else name for uid, name in names.items()}
    texts = [f"{names[uid]} ({len(images)} images)" for uid, images in all_series.items()]
    if series is None:
        raise InputError(f"it holds {len(all_series)} series, choose one: {'; '.join(texts)}")
    tags = ("SeriesNumber", "SeriesDescription", "SeriesInstanceUID")
    matches = [images for images in all_series.values() if str(series) in (str(images[0][1].get(n, "")) for n in tags)]
    if len(matches) != 1:
        raise InputError(f"{len(matches) or 'no'} series {series!r} in it; there are {'; '.join(texts)}")
    return matches[0]


def _read_slices(path: Path, header: Any) -> Iterator[_Slice]:
    """Yield the slices of a file, whose `header` has been read."""
    require_grey(header)
    if "ModalityLUTSequence" in header:
        raise InputError("values by a table (ModalityLUTSequence) are not read; expected RescaleSlope")
    n_frames = stated_count(header, "NumberOfFrames")
    frames = _frame_tags(header)
    if len(frames) != n_frames:
        raise InputError(f"{n_frames} frames without a place for each; expected an enhanced image, or one frame")
    for number, frame in enumerate(frames):
        spacing = _numbers(frame, "PixelSpacing", 2)
        if spacing.min() <= 0:
            raise InputError(f"PixelSpacing: expected more than 0 mm, got {spacing.min():g}")
        yield _Slice(
            path, number, (int(header.Rows), int(header.Columns)), (float(spacing[0]), float(spacing[1])),
            _directions(frame), _numbers(frame, "ImagePositionPatient", 3), _frame_values(header, frame),
            thickness=float(_numbers(frame, "SliceThickness", 1, 0.0)[0]),
            is_rescaled=frame.get("RescaleSlope") is not None,
        )  # fmt: skip


def stated_rescaling(tags: Any, code: str) -> RealWorldValues:
    """Return the rescaling to the unit `code` by Rescale Slope and Intercept, 1 and 0 where the `tags` have none."""
    slope, intercept = (_numbers(tags, f"Rescale{x}", 1, y)[0] for x, y in (("Slope", 1.0), ("Intercept", 0.0)))
    return RealWorldValues(float(slope), float(intercept), code)


def _frame_values(header: Any, frame: Any) -> RealWorldValues:
    """Return slope, intercept and unit of a frame's values: those of its real world values, or else of its rescaling.

    `InputError` where both are to one quantity and give other values.
    """
    code = str(header.get("Units") or frame.get("RescaleType") or "")
    rescaling = stated_rescaling(frame, "HU" if header.get("Modality") == "CT" and code in _HOUNSFIELD else code)
    mapped = real_world_values(frame) or real_world_values(header) or rescaling
    stated_unit, unit = unit_of(rescaling.code), unit_of(mapped.code)
    if unit is None and stated_unit is not None:
        return rescaling
    if unit and stated_unit and unit.quantity == stated_unit.quantity and not agree([rescaling, mapped]):
        raise InputError(f"its rescaling is {rescaling}, RealWorldValueMapping {mapped}: expected one of them")
    return mapped


def _frame_tags(header: Any) -> list[Any]:
    """Return the tags of each frame of a file: the header, or in an enhanced image the shared and the frame's groups.

    Private sequences are no groups (C.7.6.16), though some repeat the tags of one. A rescaling at the top level holds for
    frames without one.
    """
    from pydicom.dataset import Dataset

    if "PerFrameFunctionalGroupsSequence" not in header:
        return _tomogram_tags(header) if _is_nuclear_medicine(header) else [header]
    shared = header.get("SharedFunctionalGroupsSequence") or []
    frames = []
    for frame_groups in header.PerFrameFunctionalGroupsSequence:
        frame = Dataset()
        for name in filter(header.__contains__, _RESCALE):
            frame.add(header[name])
        for groups in (*shared, frame_groups):
            for group in groups:
                if group.keyword == "RealWorldValueMappingSequence":
                    frame.add(group)
                elif group.VR == "SQ" and group.value and not group.tag.is_private:
                    frame.update(group.value[0])
        frames.append(frame)
    return frames


def _sort_slices(slices: list[_Slice]) -> tuple[list[_Slice], Floats]:
    """Return the slices sorted along their normal, and the step (3,), mm, LPS, from slice to slice.

    Of a tilted gantry the step is not along the normal. Raises `InputError` unless the slices are one stack of equal and
    evenly spaced ones.
    """
    first = slices[0]
    for image in slices:
        shape, spacing = image.shape, image.spacing
        for feature, is_same in (
            (f"{shape[1]} x {shape[0]} pixels", shape == first.shape),
            (f"pixels of {spacing[0]:g} x {spacing[1]:g} mm", np.allclose(spacing, first.spacing, 1e-4)),
            (f"values in {image.values.code or 'no stated unit'}", image.values.code == first.values.code),
            ("a RescaleSlope" if image.is_rescaled else "no RescaleSlope", image.is_rescaled == first.is_rescaled),
            ("another orientation", np.allclose(image.orientation, first.orientation, atol=_SAME_ORIENTATION)),
        ):
            if not is_same:
                raise InputError(f"{image.name} has {feature}, unlike {first.name}: expected one stack of equal slices")
    normal = np.cross(*first.orientation)
    ras_normal = RAS_FROM_LPS[:3, :3] @ normal
    normal = normal * np.sign(ras_normal[np.abs(ras_normal).argmax()])
    slices = sorted(slices, key=lambda image: float(image.position @ normal))
    first = slices[0]
    if len(slices) == 1:
        if not first.thickness > 0:
            raise InputError(f"{first.name}: a single slice without a SliceThickness")
        return slices, normal * first.thickness
    positions = np.array([image.position for image in slices])
    heights = positions @ normal
    gaps = np.diff(heights)
    if gaps.min() < _SAME_POSITION:
        k = int(gaps.argmin())
        conflict = f"{slices[k].name} and {slices[k + 1].name} lie at the same place ({heights[k]:g} mm)"
        raise InputError(f"{conflict}: expected one slice at each, of one point in time")
    median = float(np.sort(gaps)[(len(gaps) - 1) // 2])
    rounding = min(0.1 ** max(map(_decimals, positions.ravel().tolist())), 0.25 * median)
    uneven = np.flatnonzero(np.abs(gaps - median) > _SAME_SPACING * median + 0.01 + rounding)
    if len(uneven):
        k = int(uneven[0])
        n_missing = round(float(gaps[k]) / median) - 1
        fault = f"{n_missing} slice{'s' * (n_missing > 1)} missing" if n_missing > 0 else "uneven slices"
        if len(uneven) > 1 and np.ptp(gaps[uneven]) < _SAME_SPACING * median + 0.01 + rounding:
            fault = "the distance of the slices changes"
        fault += f" between {slices[k].name} and {slices[k + 1].name}"
        raise InputError(f"{fault}: {gaps[k]:g} mm apart at {heights[k]:g} mm, the others {median:g} mm")
    if median > 1.5 * first.thickness > 0:
        text = f"the slices are {first.thickness:g} mm thick and lie {median:g} mm apart: there are gaps between them, "
        warn(f"{text}or some are missing")
    offsets = positions - first.position
    fractions = (heights - heights[0]) / (heights[-1] - heights[0])
    deviations = np.linalg.norm(offsets - np.outer(fractions, offsets[-1]), axis=1)
    if deviations.max() > 0.1 * min(first.spacing):
        worst = slices[int(deviations.argmax())]
        raise InputError(f"{worst.name} lies {deviations.max():.3g} mm beside the other slices")
    return slices, offsets[-1] / (len(slices) - 1)


def _decimals(number: float) -> int:
    """Return the number of decimals with which a file writes a number."""
    return len(f"{number:.9g}".partition(".")[2])


def _read_pixels(slices: list[_Slice]) -> Iterator[tuple[_Slice, Array]]:
    """Yield each slice with its stored values (rows, columns). A multi-frame file is decoded once."""
    import pydicom

    path: Path | None = None
    frames: Array = np.empty(0)
    for image in slices:
        if image.path != path:
            path = image.path
            with naming(image.name):
                frames = decode_pixels(pydicom.dcmread(path, force=True)).reshape(-1, *image.shape)
        yield image, frames[image.frame]


def decode_pixels(data: Any) -> Array:
    """Return the stored values of a pydicom data set that was read with its pixels.

    `InputError` where its real world value map is of some of the values only.
    """
    try:
        stored = np.asarray(data.pixel_array)
    except Exception as error:  # truncated, or compressed by a method that is not installed
        syntax = data.file_meta.TransferSyntaxUID
        fault = f"cannot be read ({first_line(error)})"
        if syntax.is_compressed:
            advice = "install pylibjpeg with its plugins, or save the series without compression"
            fault = f"are compressed ({syntax.name}), which cannot be decoded here; {advice}"
        raise InputError(f"its pixels {fault}") from error
    mapped = real_world_values(data)
    if mapped and unit_of(mapped.code) and not (mapped.first <= stored.min() and stored.max() <= mapped.last):
        limits = f"{mapped.first:g} to {mapped.last:g}, found {stored.min()} to {stored.max()}"
        raise InputError(f"RealWorldValueMapping is of stored values {limits}: expected one of all")
    return stored


def _tomogram_tags(header: Any) -> list[dict[str, Any]]:
    """Return, for each slice of a reconstructed tomogram, the tags that a classic image has.

    Slice s lies (s - s_1) SpacingBetweenSlices from the first frame's slice s_1, along the cross product of the
    directions along the rows and down the columns.
    """
    n_frames = stated_count(header, "NumberOfFrames")
    has_slices = "SliceVector" in header
    kind = image_kind(header) or (TOMOGRAMS[0] if has_slices else "")
    if kind not in TOMOGRAMS:
        stated = f"ImageType {kind or 'without a third value'}, {n_frames} frame{'s' * (n_frames > 1)}"
        images = _OTHER_IMAGES.get(kind, "something else")
        raise InputError(f"it holds {images} ({stated}); expected a reconstructed tomogram (RECON TOMO)")
    slices = _numbers(header, "SliceVector", n_frames) if has_slices else np.arange(1.0, n_frames + 1)
    n_slices = len(np.unique(slices)) if has_slices else stated_count(header, "NumberOfSlices", 0)
    _require_one_volume(header, n_frames, n_slices)
    shared = {name: header.get(name) for name in ("PixelSpacing", "SliceThickness", *_RESCALE)}
    # In the standard, position and orientation are properties of the detector, even in a tomogram.
    for name in ("ImagePositionPatient", "ImageOrientationPatient"):
        values = [tags.get(name) for tags in (*(header.get("DetectorInformationSequence") or ()), header)]
        shared[name] = next((value for value in values if value), None)
    first = _numbers(shared, "ImagePositionPatient", 3)
    normal = np.cross(*_directions(shared))
    offsets = (slices - slices[0]) * (_slice_spacing(header) if n_frames > 1 else 0.0)
    return [{**shared, "ImagePositionPatient": (first + offset * normal).tolist()} for offset in offsets]


def _require_one_volume(header: Any, n_frames: int, n_slices: int) -> None:
    """Raise `InputError` unless a tomogram has one frame per slice; `n_slices` is 0 if the file does not state it."""
    for name, text in (
        ("TimeSlot", "gated, in {} time slots"),
        ("RRInterval", "gated, in {} R-R intervals"),
        ("EnergyWindow", "of {} energy windows"),
    ):
        # NumberOf... alone does not tell what the frames are: one tomogram may combine several windows.
        number = stated_count(header, f"NumberOf{name}s") if n_slices != n_frames else 1
        if f"{name}Vector" in header:
            number = len(np.unique(header.get(f"{name}Vector")))
        if number > 1:
            fault = f"the tomogram is {text.format(number)} ({n_frames} frames)"
            raise InputError(f"{fault}; expected one volume: save each, or their sum, as a file of its own")
    if n_slices not in (0, n_frames):
        raise InputError(f"{n_frames} frames of {n_slices} slices; expected one frame of each slice")


def _slice_spacing(header: Any) -> float:
    """Return the distance from slice to slice along the normal, mm; negative if they run against it."""
    if header.get("SpacingBetweenSlices") not in (None, ""):
        return float(_numbers(header, "SpacingBetweenSlices", 1)[0])
    thickness = float(_numbers(header, "SliceThickness", 1)[0])
    fault = f"{Path(header.filename).name}: it has no SpacingBetweenSlices"
    remedy = f"its SliceThickness, {thickness:g} mm, was taken, along the normal"
    warn(f"{fault}: {remedy}; check that head and feet are not exchanged")
    return thickness


def _numbers(header: Any, name: str, length: int, default: float | None = None) -> Floats:
    """Return the `length` finite numbers of the tag `name`, or `default` if it is missing or empty."""
    stated = header.get(name)
    value = default if stated is None or stated == "" else stated
    if value is None:
        raise InputError(f"it has no {name}")
    array = np.array(value, np.float64).reshape(-1)
    if len(array) != length or not np.isfinite(array).all():
        raise InputError(f"{name}: expected {length} numbers, got {textwrap.shorten(str(stated), 60)}")
    return array


def _directions(header: Any) -> Floats:
    """Return ImageOrientationPatient as two orthonormal rows (2, 3): along a row of pixels, and down the rows."""
    rows = _numbers(header, "ImageOrientationPatient", 6).reshape(2, 3)
    if not np.allclose(rows @ rows.T, np.eye(2), atol=1e-3):
        raise InputError("ImageOrientationPatient: expected two unit vectors at right angles")
    u, _, vt = np.linalg.svd(rows, full_matrices=False)
    return u @ vt  # the nearest orthonormal rows: the file has few digits
