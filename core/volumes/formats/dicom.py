"""DICOM series, by pydicom: slices are sorted by their place in the patient, and whatever does not fit is named.

Classic images (a file for each slice), enhanced, multi-frame images and reconstructed nuclear medicine tomograms, whose
frames are the slices. Index axes run along a row of pixels, down the rows, and from slice to slice: towards right,
front or head, whichever is closest to the slices' normal.
"""

from __future__ import annotations

import warnings
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError, InputWarning
from ...progress import Progress
from .contents import RAS_FROM_LPS, Contents, first_line, require_voxels
from .dicom_header import directions, numbers
from .dicom_tomogram import is_nuclear, tomogram_frames

_SAME_ORIENTATION = 1e-4  # direction cosines are written with 6 digits
_SAME_PLACE = 1e-3  # mm
_SAME_SPACING = 0.02  # relative; scanners round positions
_UPRIGHT = 0.01  # tangent of the tilt; 0.6 degrees
_UNITS = {"BQML": ("activity", 1e-3), "HU": ("hu", 1.0)}


@dataclass(frozen=True, eq=False)
class _Slice:
    """One image of a series."""

    path: Path
    frame: int
    shape: tuple[int, int]  # rows, columns
    spacing: tuple[float, float]  # between rows, between columns, mm
    orientation: NDArray[np.float64]  # (2, 3): along a row, down the rows
    position: NDArray[np.float64]  # (3,), mm
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
        slices = [one for file, header in headers for one in _slices_of(file, header)]
        slices, step = _ordered(slices)
        quantity, factor = _quantity(headers[0][1], slices[0].unit)
        rows, columns = slices[0].shape
        require_voxels((columns, rows, len(slices)), np.dtype(np.float32))
        array = np.empty((columns, rows, len(slices)), np.float32)
        for k, (one, pixels) in enumerate(_pixels(slices)):
            array[:, :, k] = (pixels.astype(np.float64) * one.slope + one.intercept).T * factor
            if progress is not None:
                progress(k + 1, len(slices))
    first = slices[0]
    affine = np.eye(4)
    affine[:3, 0] = first.orientation[0] * first.spacing[1]
    affine[:3, 1] = first.orientation[1] * first.spacing[0]
    affine[:3, 2] = step
    affine[:3, 3] = first.position
    return Contents(array, RAS_FROM_LPS @ affine, quantity)


def _headers(path: Path) -> list[tuple[Path, Any]]:
    """The images in the folder, or those of a file's series, without pixels."""
    import pydicom
    from pydicom.errors import InvalidDicomError

    files = sorted(path.iterdir()) if path.is_dir() else [path, *sorted(path.parent.iterdir())]
    wanted = None
    headers: dict[Path, Any] = {}
    others: dict[Path, Any] = {}
    for file in files:
        if file in headers or not file.is_file():
            continue
        try:
            if not (is_dicom(file) or file.suffix.lower() in (".dcm", ".ima")):
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


def _is_whole(header: Any) -> bool:
    """Whether a file alone is a volume: a nuclear medicine image of several frames."""
    return is_nuclear(header) and int(header.get("NumberOfFrames") or 1) > 1


def _kind(header: Any) -> str:
    """The UID of the kind of file, such as CT image, or ""."""
    return str(header.file_meta.get("MediaStorageSOPClassUID") or header.get("SOPClassUID", ""))


def _chosen(headers: list[tuple[Path, Any]], path: Path, series: str | None) -> list[tuple[Path, Any]]:
    """The headers of one series."""
    found: dict[str, list[tuple[Path, Any]]] = defaultdict(list)
    for file, header in headers:
        found[str(header.get("SeriesInstanceUID", ""))].append((file, header))
    if series is not None:
        names = ("SeriesNumber", "SeriesDescription", "SeriesInstanceUID")
        matching = [uid for uid, of in found.items() if str(series) in (str(of[0][1].get(name, "")) for name in names)]
        if len(matching) == 1:
            return found[matching[0]]
        raise InputError(f"{len(matching) or 'no'} series {series!r} in it; there are {_listed(found)}")
    if len(found) > 1:
        raise InputError(f"it holds {len(found)} series, choose one: {_listed(found)}")
    return next(iter(found.values()))


def _listed(found: dict[str, list[tuple[Path, Any]]]) -> str:
    """The series by number, description and count, such as ``3 "Thorax 1.0" (133 images)``."""
    parts = []
    for uid, of in found.items():
        header = of[0][1]
        number, description = header.get("SeriesNumber"), header.get("SeriesDescription")
        name = " ".join(str(x) for x in (number, description and f'"{description}"') if x is not None) or uid
        parts.append(f"{name} ({len(of)} images)")
    return "; ".join(parts)


def _slices_of(path: Path, header: Any) -> list[_Slice]:
    """The images of a file; `InputError` names it."""
    try:
        return list(_slices(path, header))
    except InputError as error:
        raise InputError(f"{path.name}: {error}") from None
    except Exception as error:  # whatever pydicom raises on a damaged tag; it parses tags on access
        raise InputError(f"{path.name}: cannot be read as DICOM ({first_line(error)})") from None


def _slices(path: Path, header: Any) -> Iterator[_Slice]:
    """The images of a file."""
    if header.get("SamplesPerPixel", 1) != 1:
        raise InputError(f"expected one value per pixel, found {header.SamplesPerPixel} (a colour image)")
    tilt = float(header.get("GantryDetectorTilt") or 0.0)
    if abs(tilt) > 0.01:
        raise InputError(
            f"the gantry is tilted by {tilt:g} degrees; expected upright slices: resample the series first"
        )
    if "ModalityLUTSequence" in header:
        raise InputError("values by a table (ModalityLUTSequence) are not read; expected RescaleSlope")
    count = int(header.get("NumberOfFrames") or 1)
    frames = _frames(header)
    if len(frames) != count:
        raise InputError(f"{count} frames without a place for each; expected an enhanced image, or one frame")
    for number, frame in enumerate(frames):
        spacing = numbers(frame, "PixelSpacing", 2)
        if spacing.min() <= 0:
            raise InputError(f"PixelSpacing: expected more than 0 mm, got {spacing.min():g}")
        yield _Slice(
            path=path,
            frame=number,
            shape=(int(header.Rows), int(header.Columns)),
            spacing=(float(spacing[0]), float(spacing[1])),
            orientation=directions(frame),
            position=numbers(frame, "ImagePositionPatient", 3),
            slope=float(numbers(frame, "RescaleSlope", 1, 1.0)[0]),
            intercept=float(numbers(frame, "RescaleIntercept", 1, 0.0)[0]),
            thickness=float(numbers(frame, "SliceThickness", 1, 0.0)[0]),
            unit=str(header.get("Units") or frame.get("RescaleType") or ""),
        )


def _frames(header: Any) -> list[Any]:
    """The description of each image of a file: the header; in an enhanced image the shared groups and the frame's own."""
    from pydicom.dataset import Dataset

    if "PerFrameFunctionalGroupsSequence" not in header:
        return tomogram_frames(header) if is_nuclear(header) else [header]
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


def _ordered(slices: list[_Slice]) -> tuple[list[_Slice], NDArray[np.float64]]:
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
        raise InputError(
            f"{slices[k].name} and {slices[k + 1].name} lie at the same place ({places[k]:g} mm): "
            "expected one slice at each, of one point in time"
        )
    usual = float(np.sort(gaps)[(len(gaps) - 1) // 2])
    wrong = np.flatnonzero(np.abs(gaps - usual) > _SAME_SPACING * usual + 0.01)
    if len(wrong):
        k = int(wrong[0])
        missing = round(float(gaps[k]) / usual) - 1
        what = f"{missing} slice{'s' * (missing > 1)} missing" if missing > 0 else "uneven slices"
        raise InputError(
            f"{what} between {slices[k].name} and {slices[k + 1].name}: {gaps[k]:g} mm apart at "
            f"{places[k]:g} mm, the others {usual:g} mm"
        )
    if usual > 1.5 * first.thickness > 0:
        text = f"the slices are {first.thickness:g} mm thick and lie {usual:g} mm apart: there are gaps between them, "
        warnings.warn(f"{text}or some are missing", InputWarning, stacklevel=2)
    step = (last.position - first.position) / (len(slices) - 1)
    moved = positions - first.position
    sideways = moved - np.outer(moved @ normal, normal)
    tilt = float(np.linalg.norm(sideways[-1]) / (places[-1] - places[0]))
    if tilt > _UPRIGHT:
        raise InputError(
            f"the gantry is tilted by {np.degrees(np.arctan(tilt)):.1f} degrees (slices move sideways from "
            f"{first.name} to {last.name}); expected upright slices: resample the series first"
        )
    off = np.linalg.norm(sideways - np.outer((places - places[0]) / (places[-1] - places[0]), sideways[-1]), axis=1)
    if off.max() > 0.1 * min(first.spacing):
        worst = slices[int(off.argmax())]
        raise InputError(f"{worst.name} lies {off.max():.3g} mm beside the other slices")
    return slices, step


def _quantity(header: Any, unit: str) -> tuple[str, float]:
    """The quantity of the values, and the factor to its unit."""
    modality = header.get("Modality")
    if modality == "CT":
        return "hu", 1.0
    return _UNITS.get(unit, (f"{modality} in {unit}" if unit else f"{modality}", 1.0))


def _pixels(slices: list[_Slice]) -> Iterator[tuple[_Slice, NDArray[Any]]]:
    """Each slice with its stored values (rows, columns). A multi-frame file is decoded once."""
    import pydicom

    path, frames = None, np.empty(0)
    for one in slices:
        if one.path != path:
            path = one.path
            data = pydicom.dcmread(path)
            try:
                frames = data.pixel_array
            except Exception as error:  # truncated, or compressed by a method that is not installed
                syntax = data.file_meta.TransferSyntaxUID
                if syntax.is_compressed:
                    raise InputError(
                        f"{one.name}: its pixels are compressed ({syntax.name}), which cannot be decoded here; "
                        "install pylibjpeg with its plugins, or save the series without compression"
                    ) from error
                raise InputError(f"{one.name}: its pixels cannot be read ({first_line(error)})") from error
            frames = frames.reshape(-1, *one.shape)
        yield one, frames[one.frame]
