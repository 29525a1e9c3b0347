"""Read nuclear medicine images in DICOM (part 3, C.8.4): frames of planar, gated, dynamic and tomographic acquisitions."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from ..volumes.formats.dicom import TOMOGRAMS, decode_pixels, image_kind, require_grey, stated_count, stated_rescaling
from ..volumes.formats.dicom_units import RealWorldValues, real_world_values, unit_of
from .frame_facts import FileFrames, require_memory, rescaled
from .stated_times import moment, stated_duration

_VECTORS = ("Energy Window", "Detector", "Phase", "Rotation", "RR Interval", "Time Slot")
"""Properties of frames of which a nuclear medicine image may have several values."""


def read(path: Path) -> FileFrames:
    """Read the frames of a nuclear medicine image: planar images or projections."""
    import pydicom

    dataset = pydicom.dcmread(path)
    if (modality := dataset.get("Modality")) != "NM":
        raise InputError(f"modality {modality or 'missing'}: expected nuclear medicine (NM) with a frame a module")
    if image_kind(dataset) in TOMOGRAMS or "SliceVector" in dataset:
        raise InputError("it holds a reconstructed tomogram; expected a frame a module")
    require_grey(dataset)
    shape = stated_count(dataset, "NumberOfFrames"), int(dataset.Rows), int(dataset.Columns)
    require_memory(shape, 4)
    slope, intercept, *_ = _values(dataset)
    frames = rescaled(decode_pixels(dataset).reshape(shape), slope, intercept)
    vector_sizes = {name: stated_count(dataset, f"NumberOf{name.replace(' ', '')}s") for name in _VECTORS}
    content = ", ".join(f"{n} {name.lower()}s" for name, n in vector_sizes.items() if n > 1)
    pixel = [float(size) for size in dataset.get("PixelSpacing") or (math.nan, math.nan)][::-1]
    windows = _numbers_of_frames(dataset, "Energy Window", vector_sizes["Energy Window"])
    low, high = ([_window_limit(dataset, number, word) for number in windows] for word in ("Lower", "Upper"))
    times, starts = _durations(dataset, shape[0]), _starts(dataset, shape[0])
    facts: Any = {"time": times, "pixel": pixel, "window": windows, "start": starts, "low": low, "high": high}
    return FileFrames(frames, content, facts)


def _values(dataset: Any) -> RealWorldValues:
    """Return the rescaling from stored values to counts; `InputError` where the file states two that differ."""
    rescaling = stated_rescaling(dataset, "{counts}")
    mapped = real_world_values(dataset) or rescaling
    if (unit := unit_of(mapped.code)) is None or unit.quantity != "counts":
        raise InputError(f"RealWorldValueMapping: values in {mapped.code or 'no unit'}; expected counts ({{counts}})")
    if rescaling[:2] not in ((1.0, 0.0), mapped[:2]):
        raise InputError(f"its rescaling is {rescaling}, RealWorldValueMapping {mapped}: expected one of them")
    return mapped


def _durations(data: Any, n_frames: int) -> list[float]:
    """Return the exposures of frames, s: those of each frame's time slot, rotation or phase, or one for all frames."""
    if image_kind(data) in ("GATED", "GATED TOMO") or "TimeSlotVector" in data:
        return _slot_durations(data, n_frames)
    for name in ("Rotation", "Phase"):
        durations = [_frame_duration(part) for part in data.get(f"{name}InformationSequence") or ()]
        if any(map(math.isfinite, durations)):
            return [durations[number - 1] for number in _numbers_of_frames(data, name, len(durations))]
    return [_frame_duration(data)]


def _slot_durations(data: Any, n_frames: int) -> list[float]:
    """Return the exposures of a gated image's frames, s: TimeSlotTime (C.8.4.12), summed over its R-R intervals.

    NaN where it is not stated: the durations of frames and rotations are not those of gates.
    """
    numbers = {name: data.get(f"{name.replace(' ', '')}Vector") for name in ("Detector", "RR Interval", "Time Slot")}
    detectors, intervals, slots = (np.ones(n_frames, int) if v is None else np.atleast_1d(v) for v in numbers.values())
    gated = data.get("GatedInformationSequence") or ()
    times = []
    for detector, interval, slot in zip(detectors, intervals, slots, strict=False):
        part = gated[0 if len(gated) == 1 else int(detector) - 1] if len(gated) in (1, int(max(detectors))) else {}
        for name, number in (("DataInformationSequence", interval), ("TimeSlotInformationSequence", slot)):
            items = part.get(name) or ()
            part = items[int(number) - 1] if 0 < number <= len(items) else {}
        times.append(stated_duration(part.get("TimeSlotTime"), "TimeSlotTime") / 1000)
    return times


def _frame_duration(part: Any) -> float:
    """Return the exposure, s, that a DICOM dataset states; NaN if it states none."""
    return stated_duration(part.get("ActualFrameDuration"), "ActualFrameDuration") / 1000


def _window_limit(data: Any, number: int, word: str) -> float:
    """Return the "Lower" or "Upper" limit of the energy window `number`, keV; NaN if the window is not a single range."""
    windows = data.get("EnergyWindowInformationSequence") or ()
    ranges: Any = windows[number - 1].get("EnergyWindowRangeSequence") or () if 0 < number <= len(windows) else ()
    limit = ranges[0].get(f"EnergyWindow{word}Limit") if len(ranges) == 1 else None
    return math.nan if limit is None else float(limit)


def _starts(data: Any, n_frames: int) -> list[float]:
    """Return the starts of frames, s of an era, from those of the acquisition, its phases and frames (C.8.4.8, C.8.4.14).

    The list is empty if the file states neither a time nor phases, and for rotations, whose views have no stated starts.
    """
    day, clock = (str(data.get(f"Acquisition{name}") or "") for name in ("Date", "Time"))
    if stamp := str(data.get("AcquisitionDateTime") or ""):
        day, clock = stamp[:8], stamp[8:].partition("+")[0].partition("-")[0]
    start = moment(day, clock, "AcquisitionTime")
    phases = data.get("PhaseInformationSequence") or ()
    if (math.isnan(start) and not phases) or data.get("RotationInformationSequence"):
        return []
    start = 0.0 if math.isnan(start) else start
    if not phases:
        return [start]
    phase_end, phase_starts, frame_steps = start, [], []
    for phase in phases:
        duration, pause = _frame_duration(phase), float(phase.get("PauseBetweenFrames") or 0) / 1000
        phase_starts.append(phase_end + float(phase.get("PhaseDelay") or 0) / 1000)
        frame_steps.append(duration + pause)
        phase_end = phase_starts[-1] + stated_count(phase, "NumberOfFramesInPhase") * frame_steps[-1] - pause
    slices = data.get("TimeSliceVector")
    numbers = [1] * n_frames if slices is None else list(slices)  # of the frames in their phases
    frames = zip(_numbers_of_frames(data, "Phase", len(phases)), numbers, strict=False)
    return [phase_starts[phase - 1] + (number - 1) * frame_steps[phase - 1] for phase, number in frames]


def _numbers_of_frames(data: Any, name: str, count: int) -> list[int]:
    """Return the number, 1 to `count`, of each frame's window, rotation or phase; without a vector, one for each block."""
    vector = data.get(f"{name.replace(' ', '')}Vector") or np.arange(1, count + 1)
    return [int(number) for number in np.atleast_1d(vector)]
