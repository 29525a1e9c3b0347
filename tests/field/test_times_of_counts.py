"""Exposures and starts of measured counts are those of each frame: gates, groups, midnight, times that say nothing.

https://github.com/UCL/STIR/issues/646 (time frames of gated data), https://github.com/UCL/STIR/issues/320 (time frames of
Interfile headers), https://github.com/UCL/STIR/pull/796 (durations of SPECT views from the header); DICOM PS3.3 C.8.4.12,
C.8.4.14; Interfile 3.3.
"""

from __future__ import annotations

import numpy as np
import pytest

import mphdrr.core as mph

from ..core.conftest import refused, warned
from .conftest import write_interfile

GROUPS = "!number of images this frame group := {}", "!image duration (sec) := {}"


def groups(*pairs: tuple[int, float]) -> list[str]:
    """Return the lines of frame groups with these numbers of images and durations."""
    return [line.format(value) for pair in pairs for line, value in zip(GROUPS, pair, strict=True)]


def exposures(path) -> list[float]:
    return mph.read_counts(path).about[:, 0].tolist()


def starts(*paths) -> list[float]:
    return mph.read_counts(list(paths)).about[:, 4].tolist()


@pytest.mark.parametrize(
    "slots, intervals", [(2, [(300, 500)]), (4, [(10, 20, 30, 40)]), (3, [(50, 60, 70), (5, 6, 7)])]
)
@pytest.mark.parametrize("kind", ["GATED", "GATED TOMO"])
def test_a_gates_exposure_is_its_time_slots(frames, tmp_path, kind, slots, intervals):
    pytest.importorskip("pydicom")
    from pydicom.dataset import Dataset

    from ..core import dicom_files

    def item(**tags) -> Dataset:
        return dicom_files.set_tags(Dataset(), **tags)

    n = slots * len(intervals)
    vectors = {
        "TimeSlotVector": [1 + k % slots for k in range(n)],
        "RRIntervalVector": [1 + k // slots for k in range(n)],
    }
    data = [
        item(TimeSlotInformationSequence=[item(TimeSlotTime=str(1000 * seconds)) for seconds in times])
        for times in intervals
    ]
    tags = {
        "ImageType": ["ORIGINAL", "PRIMARY", kind, "EMISSION"], "NumberOfTimeSlots": slots, "DetectorVector": [1] * n,
        "GatedInformationSequence": [item(DataInformationSequence=data)], "NumberOfRRIntervals": len(intervals),
        "RotationInformationSequence": [item(ActualFrameDuration=900_000)],
    }  # fmt: skip
    path = tmp_path / "gated.dcm"
    dicom_files.write_frames(frames[:n], path, 900_000, **tags, **vectors)
    assert exposures(path) == [seconds for times in intervals for seconds in times]
    dicom_files.write_frames(frames[:n], path, 900_000, **(tags | {"GatedInformationSequence": []}), **vectors)
    assert np.isnan(exposures(path)).all(), "the rotation's is no gate's: it is asked for"


@pytest.mark.parametrize("n, duration, cycles", [(4, 0.25, 500), (6, 0.08, 900), (8, 0.1, 1200)])
def test_a_gate_of_interfile_lasts_as_long_as_all_its_beats(system, frames, tmp_path, n, duration, cycles):
    lines = [f"!number of images in time window := {n}", f"!image duration (sec) := {duration}"]
    beats = f"number of cardiac cycles (acquired) := {cycles}"
    path = write_interfile(tmp_path / "g.hdr", frames[:n], "!GATED STUDY (general) :=", *lines, beats)
    np.testing.assert_allclose(exposures(path), duration * cycles)
    path = write_interfile(path, frames[:n], "!GATED STUDY (general) :=", *lines)
    used = system[:n]
    module_numbers = used.numbers.tolist()
    refused(lambda: mph.counts_run(mph.read_counts(path), used, module_numbers, "back-v"), "--time")
    assert mph.counts_run(mph.read_counts(path), used, module_numbers, "back-v", 40.0).recipe["model.time"] == 40.0


@pytest.mark.parametrize("pairs", [[(5, 10), (19, 60)], [(1, 3), (2, 5), (21, 7)], [(12, 30), (8, 45), (4, 90)]])
def test_groups_of_unequal_length_have_each_its_duration_and_start(frames, tmp_path, pairs):
    lines = groups(*pairs)
    times = [duration for number, duration in pairs for _ in range(number)]
    path = write_interfile(tmp_path / "d.hdr", frames, *lines)
    assert exposures(path) == times
    assert starts(path) == [0.0, *np.cumsum(times[:-1]).tolist()]
    write_interfile(path, frames, *lines, "pause between images (sec) := 2", "pause between frame groups (sec) := 2")
    assert starts(path) == [start + 2.0 * k for k, start in enumerate([0.0, *np.cumsum(times[:-1]).tolist()])]
    refused(lambda: exposures(write_interfile(path, frames[:-1], *lines)), r"groups of .* 23 images")


@pytest.mark.parametrize("text", ["0", "", "unknown", "0.00", "N/A"])
def test_a_time_that_says_nothing_is_asked_for_and_taken(system, frames, tmp_path, text):
    path = write_interfile(tmp_path / "z.hdr", frames[:12], f"!time per projection (sec) := {text}")
    arguments = system, "101-112", "back-v"
    refused(lambda: mph.counts_run(mph.read_counts(path), *arguments), "--time")
    assert mph.counts_run(mph.read_counts(path), *arguments, 25.0).recipe["model.time"] == 25.0
    beside = write_interfile(path, frames[:12], f"time per projection (sec) := {text}", "image duration (sec) := 40")
    assert exposures(beside) == [40.0] * 12
    for wrong in ("-3", "30,5", "00:00:30", "inf"):
        write_interfile(path, frames[:12], f"!image duration (sec) := {wrong}")
        refused(lambda: exposures(path), f"image duration (sec) = {wrong}: expected a duration above 0")


@pytest.mark.parametrize("durations", [(240, 60), (5, 10, 15), (7, 7, 1, 3)])
def test_numbered_keys_of_stir_are_those_of_its_time_frames(frames, tmp_path, durations):
    begin = np.cumsum([0, *durations[:-1]]).tolist()
    lines = [f"image duration (sec)[{k}] := {seconds}" for k, seconds in enumerate(durations, 1)]
    lines += [f"image relative start time (sec)[{k}] := {seconds}" for k, seconds in enumerate(begin, 1)]
    n = 24 // len(durations)
    path = write_interfile(tmp_path / "s.hs", frames, *lines)
    assert exposures(path) == np.repeat(durations, n).tolist()
    assert starts(path) == np.repeat(begin, n).tolist()


CLOCKS = {
    "midnight": [("2023:12:31", "23:50:00"), ("2024:01:01", "00:20:00"), 1800],
    "without leading zeros": [("2024:3:1", "9:05:00"), ("2024:3:1", "10:5:30"), 3630],
    "ACR-NEMA": [("2024.03.01", "09.05.00"), ("2024.03.02", "09.05.00"), 86400],
    "twelve hours": [("2024/02/28", "11:30 AM"), ("2024/02/28", "1:00 pm"), 5400],
    "without separators": [("20240228", "235900.5"), ("20240229", "000000.5"), 60],
}


@pytest.mark.parametrize("first, second, seconds", CLOCKS.values(), ids=CLOCKS)
def test_the_time_between_two_files_is_that_of_their_dates_and_clocks(frames, tmp_path, first, second, seconds):
    paths = []
    for k, (day, clock) in enumerate((first, second)):
        lines = f"study date := {day}", f"!image start time := {clock}", "image duration (sec) := 9"
        paths.append(write_interfile(tmp_path / f"{k}.hdr", frames[:2], *lines))
    assert warned(lambda: starts(*paths)) == [] and starts(*paths) == [0.0, 0.0, seconds, seconds]


def test_dates_of_dicom_are_used_where_they_stand(frames, tmp_path):
    pytest.importorskip("pydicom")
    from ..core import dicom_files

    def file(name: str, **tags):
        dicom_files.write_frames(frames[:1], tmp_path / name, 60_000, **tags)
        return tmp_path / name

    stamps = [file(f"s{k}", AcquisitionDateTime=text) for k, text in enumerate(("20240131235900", "20240201000100.5"))]
    assert starts(*stamps) == [0.0, 120.5]
    dated = [
        file(f"d{k}", AcquisitionDate=day, AcquisitionTime="1200") for k, day in enumerate(("20240228", "20240301"))
    ]
    assert starts(*dated) == [0.0, 2 * 86400.0]
    undated = [file(f"u{k}", AcquisitionTime=clock) for k, clock in enumerate(("235500", "000500", "001500"))]
    assert starts(*undated) == [0.0, 600.0, 1200.0]
    (text,) = warned(lambda: starts(*undated))
    assert text.startswith("u0 and u1 start at 23:55:00 and 00:05:00, without a date")
    refused(
        lambda: starts(*undated[1::-1]), "u1 and u0 start at 00:05:00 and 23:55:00, without a date: which is earlier?"
    )
    refused(lambda: starts(stamps[0], undated[0]), "u0: its start has no date, that of s0 has")


@pytest.mark.parametrize(
    "field", ["image start time := 25:61:00", "image start time := noon", "study date := 01/03/24"]
)
def test_dates_and_times_of_no_calendar_are_refused_in_one_line(frames, tmp_path, field):
    clock = () if "start" in field else ("image start time := 10:00:00",)
    path = write_interfile(tmp_path / "c.hdr", frames, field, *clock)
    refused(lambda: starts(path), field.split(":= ")[1], "expected")
