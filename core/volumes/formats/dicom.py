"""DICOM series, by pydicom: slices are sorted by their place in the patient, and whatever does not fit is named.

Classic images (a file for each slice), enhanced, multi-frame images and reconstructed nuclear medicine tomograms, whose
frames are the slices. Index axes run along a row of pixels, down the rows, and from slice to slice: towards right,
front or head, whichever is closest to the slices' normal. A tomogram gives the place of its first slice and the distance
between slices (DICOM part 3, C.8.4.11 and C.8.4.15).
"""

import textwrap
import warnings
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...arrays import Array, Floats
from ...errors import InputError, first_line, naming, reading, warn
from ...files import require_file
from ...geometry.frames import affine_matrix
from ...progress import Progress, tell
from .contents import RAS_FROM_LPS, Contents, require_voxels

_SAME_ORIENTATION = 1e-4  # direction cosines are written with 6 digits
_SAME_PLACE = 1e-3  # mm
_SAME_SPACING = 0.02  # relative; scanners round positions
_UPRIGHT = 0.01  # tangent of the tilt; 0.6 degrees
_UPRIGHT_ONLY = "expected upright slices: resample the series first"
_UNITS = {"BQML": ("activity", 1e-3), "HU": ("hu", 1.0)}
TOMOGRAMS = ("RECON TOMO", "RECON GATED TOMO")
"""Reconstructed ones, by value 3 of ImageType (C.8.4.9.1.1.3)."""
_OTHERS = {
    "TOMO": "projections",
    "GATED TOMO": "gated projections",
    "STATIC": "planar images",
    "WHOLE BODY": "planar images",
    "DYNAMIC": "planar images of several times",
    "GATED": "gated planar images",
}
_NUCLEAR = "1.2.840.10008.5.1.4.1.1.20"
_BECQUERELS = "bq/ml"  # as UCUM codes it, in lower case


@dataclass(frozen=True, eq=False)
class _Slice:
    """One image of a series."""

    path: Path
    frame: int
    shape: tuple[int, int]  # rows, columns
    spacing: tuple[float, float]  # between rows, between columns, mm
    orientation: Floats  # (2, 3): along a row, down the rows
    position: Floats  # (3,), mm
    slope: float
    intercept: float
    thickness: float
    unit: str  # DICOM's code, or ""

    @property
    def name(self) -> str:
        return self.path.name + (f" frame {self.frame + 1}" if self.frame else "")


def is_dicom(path: Path) -> bool:
    """Whether the file at `path` is DICOM, by the letters "DICM" after its first 128 bytes."""
    with open(path, "rb") as file:
        return file.read(132)[128:] == b"DICM"


def image_kind(header: Any) -> str:
    """Value 3 of a nuclear medicine image's ImageType, such as "TOMO", or "" where it has none."""
    kinds: Any = header.get("ImageType") or ()
    return str(kinds[2]) if not isinstance(kinds, str) and len(kinds) > 2 else ""


def require_grey(header: Any) -> None:
    """Refuse images with several values per pixel."""
    if header.get("SamplesPerPixel", 1) != 1:
        raise InputError(f"expected one value per pixel, found {header.SamplesPerPixel} (a colour image)")


def read(path: Path, series: str | None = None, progress: Progress | None = None) -> Contents:
    """Read the series in a folder, or the series that a file belongs to.

    `series` is the number, description or UID of one of several series in the folder. `progress(done, total)` counts
    slices.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", module="pydicom")  # about tags that are not used here
        headers = _chosen(_headers(path), path, series)
        if len(headers) > 1 and any(_is_whole(header) for _, header in headers):
            names = ", ".join(file.name for file, _ in headers)
            raise InputError(f"its series has several files of several frames each, choose one: {names}")
        slices: list[_Slice] = []
        for file, header in headers:
            with reading(file.name, "DICOM"):  # pydicom parses tags on access
                slices += _slices(file, header)
        slices, step = _ordered(slices)
        first, modality = slices[0], headers[0][1].get("Modality")
        unknown = (f"{modality} in {first.unit}" if first.unit else f"{modality}", 1.0)
        quantity, factor = ("hu", 1.0) if modality == "CT" else _UNITS.get(first.unit, unknown)
        rows, columns = first.shape
        require_voxels((columns, rows, len(slices)), np.dtype(np.float32))
        array = np.empty((columns, rows, len(slices)), np.float32)
        for k, (one, pixels) in enumerate(_pixels(slices)):
            array[:, :, k] = (pixels.astype(np.float64) * one.slope + one.intercept).T * factor
            tell(progress, k + 1, len(slices))
    axes = np.column_stack([*(first.orientation * np.array(first.spacing[::-1])[:, None]), step])
    return Contents(array, RAS_FROM_LPS @ affine_matrix(axes, first.position), quantity)


def _headers(path: Path) -> list[tuple[Path, Any]]:
    """The images in the folder, or those of a file's series, without pixels."""
    import pydicom
    from pydicom.errors import InvalidDicomError

    files = sorted(path.iterdir()) if path.is_dir() else [path, *sorted(path.parent.iterdir())]
    wanted = None
    headers: dict[Path, Any] = {}
    others: dict[Path, Any] = {}
    for file in files:
        if file in headers or file.is_dir():
            continue
        try:
            if not (is_dicom(require_file(file)) or file.suffix.lower() in (".dcm", ".ima")):
                continue
            header = pydicom.dcmread(file, stop_before_pixels=True)
        except InvalidDicomError:
            raise InputError(f"{file.name} is no DICOM file") from None
        except Exception as error:  # whatever pydicom raises on a damaged file
            raise InputError(f"{file.name} cannot be read as DICOM ({first_line(error)})") from None
        if file == path:
            if "Rows" in header and _is_whole(header):
                return [(file, header)]
            wanted = header.get("SeriesInstanceUID")
        # Directories, reports and plans have no pixels.
        if "Rows" not in header:
            others[file] = header
        elif wanted is None or header.get("SeriesInstanceUID") == wanted:
            headers[file] = header
    if not headers:
        raise InputError("expected a folder with the images of a DICOM series; it has none")
    # pydicom reads a truncated file as one with fewer tags. If it is of the same kind as the images, it is one of them.
    kinds = set(map(_kind, headers.values()))
    for file, header in others.items():
        of_series = wanted in (None, header.get("SeriesInstanceUID", wanted))
        if of_series and any(kind.startswith(_kind(header)) for kind in kinds):
            raise InputError(f"{file.name}: an image without Rows: the file is cut off or damaged")
    return list(headers.items())


def _is_nuclear(header: Any) -> bool:
    return header.get("Modality") == "NM" or header.get("SOPClassUID") == _NUCLEAR


def _is_whole(header: Any) -> bool:
    """Whether a file alone is a volume: a nuclear medicine image of several frames."""
    return _is_nuclear(header) and int(header.get("NumberOfFrames") or 1) > 1


def _kind(header: Any) -> str:
    """The UID of the kind of file, such as CT image, or ""."""
    return str(header.file_meta.get("MediaStorageSOPClassUID") or header.get("SOPClassUID", ""))


def _chosen(headers: list[tuple[Path, Any]], path: Path, series: str | None) -> list[tuple[Path, Any]]:
    """The headers of one series."""
    found: dict[str, list[tuple[Path, Any]]] = defaultdict(list)
    for file, header in headers:
        found[str(header.get("SeriesInstanceUID", ""))].append((file, header))
    if len(found) == 1 and series is None:
        return headers
    parts = []  # such as 3 "Thorax 1.0" (133 images)
    for uid, of in found.items():
        number, description = of[0][1].get("SeriesNumber"), of[0][1].get("SeriesDescription")
        name = " ".join(str(x) for x in (number, description and f'"{description}"') if x is not None) or uid
        parts.append(f"{name} ({len(of)} images)")
    if series is None:
        raise InputError(f"it holds {len(found)} series, choose one: {'; '.join(parts)}")
    names = ("SeriesNumber", "SeriesDescription", "SeriesInstanceUID")
    matching = [of for of in found.values() if str(series) in (str(of[0][1].get(name, "")) for name in names)]
    if len(matching) != 1:
        raise InputError(f"{len(matching) or 'no'} series {series!r} in it; there are {'; '.join(parts)}")
    return matching[0]


def _slices(path: Path, header: Any) -> Iterator[_Slice]:
    """The images of a file."""
    require_grey(header)
    tilt = float(header.get("GantryDetectorTilt") or 0.0)
    if abs(tilt) > 0.01:
        raise InputError(f"the gantry is tilted by {tilt:g} degrees; {_UPRIGHT_ONLY}")
    if "ModalityLUTSequence" in header:
        raise InputError("values by a table (ModalityLUTSequence) are not read; expected RescaleSlope")
    count = int(header.get("NumberOfFrames") or 1)
    frames = _frames(header)
    if len(frames) != count:
        raise InputError(f"{count} frames without a place for each; expected an enhanced image, or one frame")
    for number, frame in enumerate(frames):
        spacing = _numbers(frame, "PixelSpacing", 2)
        if spacing.min() <= 0:
            raise InputError(f"PixelSpacing: expected more than 0 mm, got {spacing.min():g}")
        yield _Slice(
            path=path,
            frame=number,
            shape=(int(header.Rows), int(header.Columns)),
            spacing=(float(spacing[0]), float(spacing[1])),
            orientation=_directions(frame),
            position=_numbers(frame, "ImagePositionPatient", 3),
            slope=float(_numbers(frame, "RescaleSlope", 1, 1.0)[0]),
            intercept=float(_numbers(frame, "RescaleIntercept", 1, 0.0)[0]),
            thickness=float(_numbers(frame, "SliceThickness", 1, 0.0)[0]),
            unit=str(header.get("Units") or frame.get("RescaleType") or ""),
        )


def _frames(header: Any) -> list[Any]:
    """The description of each image of a file: the header; in an enhanced image the shared groups and the frame's own."""
    from pydicom.dataset import Dataset

    if "PerFrameFunctionalGroupsSequence" not in header:
        return _tomogram_frames(header) if _is_nuclear(header) else [header]
    shared = header.get("SharedFunctionalGroupsSequence") or []
    frames = []
    for own in header.PerFrameFunctionalGroupsSequence:
        frame = Dataset()
        for groups in (*shared, own):
            for group in groups:
                if group.VR == "SQ" and group.value:
                    frame.update(group.value[0])
        frames.append(frame)
    return frames


def _ordered(slices: list[_Slice]) -> tuple[list[_Slice], Floats]:
    """The slices sorted by place, and the step (3,), mm, from one to the next."""
    first = slices[0]
    for one in slices:
        for name, same in (
            (f"{one.shape[1]} x {one.shape[0]} pixels", one.shape == first.shape),
            (f"pixels of {one.spacing[0]:g} x {one.spacing[1]:g} mm", np.allclose(one.spacing, first.spacing, 1e-4)),
            ("another orientation", np.allclose(one.orientation, first.orientation, atol=_SAME_ORIENTATION)),
        ):
            if not same:
                raise InputError(f"{one.name} has {name}, unlike {first.name}: expected one stack of equal slices")
    normal = np.cross(*first.orientation)
    towards = RAS_FROM_LPS[:3, :3] @ normal
    normal = normal * np.sign(towards[np.abs(towards).argmax()])
    slices = sorted(slices, key=lambda one: float(one.position @ normal))
    first, last = slices[0], slices[-1]
    if len(slices) == 1:
        if not first.thickness > 0:
            raise InputError(f"{first.name}: a single slice without a SliceThickness")
        return slices, normal * first.thickness
    positions = np.array([one.position for one in slices])
    places = positions @ normal
    gaps = np.diff(places)
    if gaps.min() < _SAME_PLACE:
        k = int(gaps.argmin())
        both = f"{slices[k].name} and {slices[k + 1].name} lie at the same place ({places[k]:g} mm)"
        raise InputError(f"{both}: expected one slice at each, of one point in time")
    usual = float(np.sort(gaps)[(len(gaps) - 1) // 2])
    wrong = np.flatnonzero(np.abs(gaps - usual) > _SAME_SPACING * usual + 0.01)
    if len(wrong):
        k = int(wrong[0])
        missing = round(float(gaps[k]) / usual) - 1
        what = f"{missing} slice{'s' * (missing > 1)} missing" if missing > 0 else "uneven slices"
        what += f" between {slices[k].name} and {slices[k + 1].name}"
        raise InputError(f"{what}: {gaps[k]:g} mm apart at {places[k]:g} mm, the others {usual:g} mm")
    if usual > 1.5 * first.thickness > 0:
        text = f"the slices are {first.thickness:g} mm thick and lie {usual:g} mm apart: there are gaps between them, "
        warn(f"{text}or some are missing")
    step = (last.position - first.position) / (len(slices) - 1)
    moved = positions - first.position
    sideways = moved - np.outer(moved @ normal, normal)
    tilt = float(np.linalg.norm(sideways[-1]) / (places[-1] - places[0]))
    if tilt > _UPRIGHT:
        angle, ends = f"{np.degrees(np.arctan(tilt)):.1f} degrees", f"{first.name} to {last.name}"
        raise InputError(f"the gantry is tilted by {angle} (slices move sideways from {ends}); {_UPRIGHT_ONLY}")
    off = np.linalg.norm(sideways - np.outer((places - places[0]) / (places[-1] - places[0]), sideways[-1]), axis=1)
    if off.max() > 0.1 * min(first.spacing):
        worst = slices[int(off.argmax())]
        raise InputError(f"{worst.name} lies {off.max():.3g} mm beside the other slices")
    return slices, step


def _pixels(slices: list[_Slice]) -> Iterator[tuple[_Slice, Array]]:
    """Each slice with its stored values (rows, columns). A multi-frame file is decoded once."""
    import pydicom

    path: Path | None = None
    frames: Array = np.empty(0)
    for one in slices:
        if one.path != path:
            path = one.path
            with naming(one.name):
                frames = decoded(pydicom.dcmread(path)).reshape(-1, *one.shape)
        yield one, frames[one.frame]


def decoded(data: Any) -> Array:
    """The stored values of a file that is read whole."""
    try:
        return np.asarray(data.pixel_array)
    except Exception as error:  # truncated, or compressed by a method that is not installed
        syntax = data.file_meta.TransferSyntaxUID
        what = f"cannot be read ({first_line(error)})"
        if syntax.is_compressed:
            advice = "install pylibjpeg with its plugins, or save the series without compression"
            what = f"are compressed ({syntax.name}), which cannot be decoded here; {advice}"
        raise InputError(f"its pixels {what}") from error


def _tomogram_frames(header: Any) -> list[dict[str, Any]]:
    """The description of each slice of a reconstructed tomogram, by the tags of a classic image.

    Slice s lies (s - s_1) SpacingBetweenSlices from the first frame's slice s_1, along the cross product of the
    directions along the rows and down the columns.
    """
    count = int(header.get("NumberOfFrames") or 1)
    kind = image_kind(header) or (TOMOGRAMS[0] if "SliceVector" in header else "")
    if kind not in TOMOGRAMS:
        stated = f"ImageType {kind or 'without a third value'}, {count} frame{'s' * (count > 1)}"
        what = _OTHERS.get(kind, "something else")
        raise InputError(f"it holds {what} ({stated}); expected a reconstructed tomogram (RECON TOMO)")
    if "SliceVector" in header:
        slices = _numbers(header, "SliceVector", count)
        _require_one_volume(header, count, len(np.unique(slices)))
    else:
        slices = np.arange(1.0, count + 1)
        _require_one_volume(header, count, int(header.get("NumberOfSlices") or 0))
    names = ("PixelSpacing", "SliceThickness", "RescaleType", "RescaleSlope", "RescaleIntercept")
    shared = {name: header.get(name) for name in names} | _in_becquerels(header)
    # The standard gives the place to the detector, even in a tomogram.
    for name in ("ImagePositionPatient", "ImageOrientationPatient"):
        found = [of.get(name) for of in (*(header.get("DetectorInformationSequence") or ()), header)]
        shared[name] = next((value for value in found if value), None)
    first = _numbers(shared, "ImagePositionPatient", 3)
    normal = np.cross(*_directions(shared))
    steps = (slices - slices[0]) * (_spacing(header) if count > 1 else 0.0)
    return [{**shared, "ImagePositionPatient": (first + step * normal).tolist()} for step in steps]


def _require_one_volume(header: Any, count: int, slices: int) -> None:
    """Refuse a tomogram that has not one frame for each of `slices` (0 if the file does not say how many)."""
    for name, several in (
        ("TimeSlot", "gated, in {} time slots"),
        ("RRInterval", "gated, in {} R-R intervals"),
        ("EnergyWindow", "of {} energy windows"),
    ):
        # NumberOf... alone does not tell what the frames are: one tomogram may combine several windows.
        number = int(header.get(f"NumberOf{name}s") or 1) if slices != count else 1
        if f"{name}Vector" in header:
            number = len(np.unique(header.get(f"{name}Vector")))
        if number > 1:
            what = f"the tomogram is {several.format(number)} ({count} frames)"
            raise InputError(f"{what}; expected one volume: save each, or their sum, as a file of its own")
    if slices not in (0, count):
        raise InputError(f"{count} frames of {slices} slices; expected one frame of each slice")


def _spacing(header: Any) -> float:
    """Distance from slice to slice along the normal, mm; negative if they run against it."""
    if header.get("SpacingBetweenSlices") not in (None, ""):
        return float(_numbers(header, "SpacingBetweenSlices", 1)[0])
    thickness = float(_numbers(header, "SliceThickness", 1)[0])
    taken = f"its SliceThickness, {thickness:g} mm, was taken, along the normal"
    missing = f"{Path(header.filename).name}: it has no SpacingBetweenSlices"
    warn(f"{missing}: {taken}; check that head and feet are not exchanged")
    return thickness


def _in_becquerels(header: Any) -> dict[str, Any]:
    """The rescaling of stored values to Bq/mL, if the file gives one (RealWorldValueMappingSequence)."""
    for item in header.get("RealWorldValueMappingSequence") or ():
        units = item.get("MeasurementUnitsCodeSequence") or ()
        if any(str(unit.get("CodeValue")).lower() == _BECQUERELS for unit in units) and "RealWorldValueSlope" in item:
            slope, intercept = item.RealWorldValueSlope, item.get("RealWorldValueIntercept")
            return {"RescaleSlope": slope, "RescaleIntercept": intercept, "RescaleType": "BQML"}
    return {}


def _numbers(header: Any, name: str, length: int, default: float | None = None) -> Floats:
    """The `length` finite numbers of the tag `name`, or `default` if it is missing or empty."""
    given = header.get(name)
    value = default if given is None or given == "" else given
    if value is None:
        raise InputError(f"it has no {name}")
    array = np.array(value, np.float64).reshape(-1)
    if len(array) != length or not np.isfinite(array).all():
        raise InputError(f"{name}: expected {length} numbers, got {textwrap.shorten(str(given), 60)}")
    return array


def _directions(header: Any) -> Floats:
    """ImageOrientationPatient as two orthonormal rows (2, 3): along a row of pixels, and down the rows."""
    rows = _numbers(header, "ImageOrientationPatient", 6).reshape(2, 3)
    if not np.allclose(rows @ rows.T, np.eye(2), atol=1e-3):
        raise InputError("ImageOrientationPatient: expected two unit vectors at right angles")
    left, _, right = np.linalg.svd(rows, full_matrices=False)
    return left @ right  # the nearest orthonormal rows: the file has few digits
