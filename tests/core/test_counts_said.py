"""What files say of their counts, and what the counts themselves say, is used or contradicted: never passed over."""

from __future__ import annotations

import pickle
import warnings

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.recording import recorded_warnings

from . import dicom_files
from .conftest import refused, warned
from .test_measured_counts import write_hdr, write_mhd


def counted(rng, shape=(12, 6, 6), mean=9.0) -> np.ndarray:
    return rng.poisson(mean, shape).astype(np.uint16)


def both_ways(system, path, frames, orientation, time, **more) -> list[str]:
    """Return the warnings of `read_counts` and `counts_run`, after a check that those of the recipe are the same."""
    recipe = mph.Recipe(
        {
            "counts.files": list(map(str, path if isinstance(path, list) else [path])), "counts.frames": frames,
            "counts.orientation": orientation, "model.kind": "emission", "model.time": time,
        }
        | ({"detector.pitch": more["pitch"]} if "pitch" in more else {})
    )  # fmt: skip
    of_recipe = warned(lambda: next(mph.run_recipe(recipe, system)))
    own = warned(lambda: mph.counts_run(mph.read_counts(path), system, frames, orientation, time, **more))
    assert own == of_recipe
    return own


def test_the_files_time_and_pixels_reach_the_run_by_either_way(system, rng, tmp_path):
    pytest.importorskip("pydicom")
    path, side = tmp_path / "nm.dcm", system.detector_side
    dicom_files.write_frames(counted(rng), path, 90_000, PixelSpacing=["2.5", "2.5"])
    (pixels,) = both_ways(system, path, "101-112", "back-v", 90.0)
    own = side[np.abs(side / 6 - 2.5) > 2.5e-3][0] / 6
    assert pixels.startswith(f"nm.dcm: the file says pixels of 2.5 x 2.5 mm; taken as {own:.4g} x {own:.4g} mm, so")
    of_side, other = both_ways(system, path, "101-112", "back-v", 90.0, pitch=3.0)
    assert of_side.startswith("6 pixels of 3 mm are 18 mm")
    assert other.endswith("pixels of 2.5 x 2.5 mm; taken as 3 x 3 mm, as given")
    (of_side,) = both_ways(system, path, "101-112", "back-v", 90.0, pitch=2.5)
    assert of_side.startswith("6 pixels of 2.5 mm are 15 mm")
    with recorded_warnings():
        assert mph.counts_run(mph.read_counts(path), system, "101-112", "back-v").recipe["model.time"] == 90.0
    contradicts = "frame 1 (module 101): the file says 90 s, the time (--time) is 30 s, and others of 11 frames more"
    refused(lambda: both_ways(system, path, "101-112", "back-v", 30.0), contradicts)


@pytest.mark.parametrize("word", ["back-v", "front+u", "back-u", "front+v"])
def test_pixels_are_compared_along_rows_and_columns_however_frames_lie(system, rng, word, tmp_path):
    """Frames of 8 x 5 pixels of 3 x 4.8 mm: on a crystal of 24 mm, turned or not."""
    system = mph.PinholeSystem(system.centers, 2.0, 60.0, 24.0, 9.0, 75.0, numbers=system.numbers)
    path = tmp_path / "gate.mhd"
    write_mhd(counted(rng, (12, 5, 8)), path)
    text = path.read_text()
    for along, down, is_right in ((3.0, 4.8, True), (4.8, 3.0, False), (3.0, 3.0, False)):
        path.write_text(text.replace("ElementSpacing = 4 4 1", f"ElementSpacing = {along} {down} 1"))
        found = both_ways(system, path, "101-112", word, 60.0)
        assert (found == []) == is_right, found
        if not is_right:
            assert f"pixels of {along:g} x {down:g} mm; taken as 3 x 4.8 mm" in found[0]
    virtual = {"detector": "virtual", "magnification": 7}
    said = warned(lambda: mph.counts_run(mph.read_counts(path), system, "101-112", word, 60.0, **virtual))
    assert "pixels of 3 x 3 mm; taken as 3 x 4.8 mm" in said[0], "on the crystal, wherever the images are taken"


def test_several_exposures_are_those_of_the_frames_that_are_used(system, rng, tmp_path):
    pytest.importorskip("pydicom")
    from pydicom.dataset import Dataset

    parts = [Dataset(), Dataset()]
    parts[0].ActualFrameDuration, parts[1].ActualFrameDuration = 20_000, 35_000
    path, vector = tmp_path / "d.dcm", [1] * 12 + [2] * 12
    rotations = {"RotationInformationSequence": parts, "RotationVector": vector, "NumberOfRotations": 2}
    dicom_files.write_frames(counted(rng, (24, 6, 6)), path, **rotations)
    mixed = "101-106, none*6, none*6, 107-112"
    words = r"frame 19 \(module 107\): the file says 35 s, the time .* is 20 s, .* 5 frames more"
    refused(lambda: both_ways(system, path, mixed, "back-v", 20.0), words)
    assert both_ways(system, path, "101-112, none*12", "back-v", 20.0) == []
    words = "frame 13 (module 101): the file says 35 s"
    refused(lambda: both_ways(system, path, "none*12, 101-112", "back-v", 20.0), words)
    counts = mph.read_counts(path)
    assert mph.counts_run(counts, system, mixed, "back-v").recipe["model.time"] == (20.0,) * 6 + (35.0,) * 6
    assert both_ways(system, path, mixed, "back-v", [20.0] * 6 + [35.0] * 6) == []
    for part, times in ((counts[12:], 35.0), (counts[:12], 20.0), (counts[::2], (20.0,) * 6 + (35.0,) * 6)):
        assert mph.counts_run(part, system, "101-112", "back-v").recipe["model.time"] == times


def test_exposures_of_an_interfile_are_those_of_its_images(system, rng, tmp_path):
    path = tmp_path / "c.hdr"
    write_hdr(counted(rng), path)
    header = path.read_text()
    assert both_ways(system, path, "101-112", "back-v", 600.0) == []
    for number in range(12):
        seconds = 600 if number < 7 else 150
        header = header.replace("!time per projection (sec) := 600", f"!image duration (sec) := {seconds}", 1)
    path.write_text(header)
    words = r"frame 8 \(module 108\): the file says 150 s, .* 4 frames more"
    refused(lambda: both_ways(system, path, "101-112", "back-v", 600.0), words)
    run = mph.counts_run(mph.read_counts(path), system, "101-112", "back-v")
    assert run.recipe["model.time"] == (600.0,) * 7 + (150.0,) * 5
    both_of_150 = "none*7, 101, 102, none*3"
    assert both_ways(system[:2], path, both_of_150, "back-v", 150.0) == []
    path.write_text(header + "\n" + "scaling factor (mm/pixel) [1] := 2\nscaling factor (mm/pixel) [2] := 2.1\n")
    (text,) = both_ways(system[:2], path, both_of_150, "back-v", 150.0)
    assert "pixels of 2 x 2.1 mm" in text


def test_several_files_say_each_its_own(system, rng, tmp_path):
    paths = []
    for number, time in enumerate((40, 40, 55), 1):
        paths.append(tmp_path / f"{number}.hdr")
        write_hdr(counted(rng, (4, 6, 6)), paths[-1])
        paths[-1].write_text(paths[-1].read_text().replace(":= 600", f":= {time}"))
    words = "1.hdr, 2.hdr, 3.hdr: frame 9 (module 109): the file says 55 s"
    refused(lambda: both_ways(system, paths, "101-112", "back-v", 40.0), words)
    assert both_ways(system[:8], paths, "101-108, none*4", "back-v", 40.0) == []


def test_frames_of_several_energy_windows_are_not_taken_together_in_silence(system, rng, tmp_path):
    pytest.importorskip("pydicom")
    path = tmp_path / "w.dcm"
    windows = {"NumberOfEnergyWindows": 2, "EnergyWindowVector": [1, 2] * 12}
    dicom_files.write_frames(counted(rng, (24, 6, 6)), path, 60_000, **windows)
    one = ", ".join(f"{number}, none" for number in range(101, 113))
    assert both_ways(system, path, one, "back-v", 60.0) == []
    (text,) = both_ways(system, path, "101-112, none*12", "back-v", 60.0)
    assert text.startswith("w.dcm: frames of the energy windows 1 and 2 are used")
    assert warned(lambda: mph.counts_run(mph.read_counts(path)[1::2], system, "101-112", "back-v", 60.0)) == []


def test_counts_are_an_array_like_any_other(rng, tmp_path):
    frames = counted(rng, (5, 4, 3))
    np.save(tmp_path / "c.npy", frames)
    counts = mph.read_counts(tmp_path / "c.npy")
    np.testing.assert_array_equal(counts, frames)
    assert counts.dtype == np.uint16 and isinstance(counts, np.ndarray)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for use in (
            lambda array: array + array, np.sum, lambda array: array.mean(axis=0), np.sqrt,
            lambda array: np.concatenate([array, array]), lambda array: array[array > 9],
            lambda array: array[..., ::-1], lambda array: array[None, 0], lambda array: array[()],
            lambda array: array.reshape(5, 12)[2], lambda array: array[2, 1, 1],
            lambda array: pickle.loads(pickle.dumps(array)),
        ):  # fmt: skip
            np.testing.assert_array_equal(use(counts), use(frames))
    assert type(counts + 1) is type(counts.mean(axis=0)) is np.ndarray


FRAMES = {"frames": "101-112", "orientation": "front+v", "time": 60.0}


def test_usual_counts_are_taken_without_a_word(system, rng):
    point = np.zeros((12, 9, 9), int)
    point[np.arange(12), rng.integers(0, 9, 12), rng.integers(0, 9, 12)] = rng.poisson(40_000, 12)
    spread = rng.poisson(0.05, (12, 20, 20))
    for counts in (counted(rng), point, spread, np.zeros((12, 5, 5), int), counted(rng, (12, 3, 3), 900)):
        assert warned(lambda counts=counts: mph.counts_run(counts, system, **FRAMES)) == []


def test_an_empty_frame_among_others_is_named(system, rng):
    counts = counted(rng, (14, 7, 7), 6.0)
    counts[[3, 9]] = 0
    frames = "none, 112-101, none"
    (text,) = warned(lambda: mph.counts_run(counts, system, frames, "front+v", 60.0))
    usual = np.median([counts[k].sum() for k in range(1, 13) if k not in (3, 9)])
    assert text.startswith("counts: no counts in ") and text.endswith(f", {usual:g} in others")
    assert "frame 4 (module 110)" in text and "frame 10 (module 104)" in text
    counts[[3, 9]] = counted(rng, (2, 7, 7))
    counts[[0, 13]] = 0
    assert warned(lambda: mph.counts_run(counts, system, frames, "front+v", 60.0)) == [], "they are not used"


def test_equal_frames_are_named(system, rng):
    counts = counted(rng, (12, 8, 8), 0.7)
    counts[11] = counts[2]
    (text,) = warned(lambda: mph.counts_run(counts, system, **FRAMES))
    assert text == "counts: equal in every pixel: frame 3 (module 103) and frame 12 (module 112)"
    counts[:] = counts[0]
    (text,) = warned(lambda: mph.counts_run(counts, system, **FRAMES))
    assert text.endswith("frame 1 (module 101) and frame 4 (module 104); and 8 more")


@pytest.mark.parametrize("place", [(0, 0), (4, 8), (7, 3), (9, 9)])
@pytest.mark.parametrize("expected", [False, True])
def test_a_single_bright_pixel_is_named(system, rng, place, expected):
    counts = counted(rng, (12, 10, 10), 150.0)
    counts = counts.astype(float) if expected else counts.astype(int)
    counts[(6, *place)] = 10**6
    run = {}
    (text,) = warned(lambda: run.update(made=mph.counts_run(counts, system, **FRAMES, expected=expected)))
    row, column = place
    assert text.startswith(f"counts: frame 7 (module 107), row {row + 1}, column {column + 1}: 1e+06 counts, at most ")
    assert run["made"].projections.max() == 10**6, "it counts all the same"
    alone = warned(lambda: mph.counts_run(counts[6:7], system[6:7], "107", "front+v", 60.0, expected=expected))
    assert len(alone) == 1 and f"column {column + 1}: 1e+06 counts" in alone[0]
