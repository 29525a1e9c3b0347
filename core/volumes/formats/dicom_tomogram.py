"""Reconstructed nuclear medicine tomograms (SPECT) in DICOM, whose slices are the frames of one file.

The file gives the place of the first slice and the distance between slices (DICOM part 3, C.8.4.11 and C.8.4.15).
"""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import InputError, InputWarning
from .dicom_header import directions, numbers

# Value 3 of ImageType (C.8.4.9.1.1.3).
_TOMOGRAMS = ("RECON TOMO", "RECON GATED TOMO")
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


def is_nuclear(header: Any) -> bool:
    """Whether a file is a nuclear medicine image."""
    return header.get("Modality") == "NM" or header.get("SOPClassUID") == _NUCLEAR


def tomogram_frames(header: Any) -> list[dict[str, Any]]:
    """The description of each slice of a reconstructed tomogram, by the tags of a classic image.

    Slice s lies (s - s_1) SpacingBetweenSlices from the first frame's slice s_1, along the cross product of the
    directions along the rows and down the columns. `InputError` says what was found if it is not one reconstructed
    tomogram.
    """
    count = int(header.get("NumberOfFrames") or 1)
    _require_tomogram(header, count)
    if "SliceVector" in header:
        slices = numbers(header, "SliceVector", count)
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
    first = numbers(shared, "ImagePositionPatient", 3)
    normal = np.cross(*directions(shared))
    steps = (slices - slices[0]) * (_spacing(header) if count > 1 else 0.0)
    return [{**shared, "ImagePositionPatient": (first + step * normal).tolist()} for step in steps]


def _require_tomogram(header: Any, count: int) -> None:
    """Raise `InputError` unless the frames are those of one reconstructed tomogram."""
    kinds: Any = header.get("ImageType") or ()
    told = not isinstance(kinds, str) and len(kinds) > 2
    kind = str(kinds[2]) if told else _TOMOGRAMS[0] if "SliceVector" in header else ""
    if kind not in _TOMOGRAMS:
        said = f"ImageType {kind or 'without a third value'}, {count} frame{'s' * (count > 1)}"
        what = _OTHERS.get(kind, "something else")
        raise InputError(f"it holds {what} ({said}); expected a reconstructed tomogram (RECON TOMO)")


def _require_one_volume(header: Any, count: int, slices: int) -> None:
    """Raise `InputError` unless there is one frame for each of `slices` (0 if the file does not say how many)."""
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
            raise InputError(
                f"the tomogram is {several.format(number)} ({count} frames); expected one volume: save each, or "
                "their sum, as a file of its own"
            )
    if slices not in (0, count):
        raise InputError(f"{count} frames of {slices} slices; expected one frame of each slice")


def _spacing(header: Any) -> float:
    """Distance from slice to slice along the normal, mm; negative if they run against it."""
    if header.get("SpacingBetweenSlices") not in (None, ""):
        return float(numbers(header, "SpacingBetweenSlices", 1)[0])
    thickness = float(numbers(header, "SliceThickness", 1)[0])
    text = (
        f"{Path(header.filename).name}: it has no SpacingBetweenSlices: its SliceThickness, {thickness:g} mm, was taken, "
        "along the normal; check that head and feet are not exchanged"
    )
    warnings.warn(text, InputWarning, stacklevel=2)
    return thickness


def _in_becquerels(header: Any) -> dict[str, Any]:
    """The rescaling of stored values to Bq/mL, if the file gives one (RealWorldValueMappingSequence)."""
    for item in header.get("RealWorldValueMappingSequence") or ():
        units = item.get("MeasurementUnitsCodeSequence") or ()
        if any(str(unit.get("CodeValue")).lower() == _BECQUERELS for unit in units) and "RealWorldValueSlope" in item:
            slope, intercept = item.RealWorldValueSlope, item.get("RealWorldValueIntercept")
            return {"RescaleSlope": slope, "RescaleIntercept": intercept, "RescaleType": "BQML"}
    return {}
