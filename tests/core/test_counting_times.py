"""Frames that do not last equally long, nor begin together: in models, recipes, runs and measured files."""

from __future__ import annotations

import functools

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.recording import recorded_warnings
from mphdrr.core.runs.mosaic import counts_caption

from . import dicom_files
from .conftest import BACKENDS, emission, refused, warned
from .test_counts_said import counted
from .test_measured_counts import write_hdr

TIMES = np.array([10.0, 20, 30, 45, 60, 600, 3600, 5, 7, 9, 11, 1200])
STARTS = np.array([0.0, 600, 1200, 5000, 21600, 40, 50, -300, 70, 80, 90, 100])
BOTH = {"time": TIMES, "start": STARTS}


def decays(isotope: mph.Isotope) -> np.ndarray:
    """Return the integral of the activity over each frame, by that at the reference time."""
    rate = np.log(2) / isotope.half_life
    return np.exp(-rate * STARTS) * (1 - np.exp(-rate * TIMES)) / rate


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("hole", ["auto", "rays", "point"])
def test_a_points_counts_are_the_integral_of_its_activity(system, backend, hole):
    if backend != "cpu" and hole == "auto":
        pytest.skip("numpy is slow, and torch takes the same kernels")
    grid, views = mph.Grid.centered(3, 4.0 if hole == "auto" else 40.0), system.views((6, 6), "real")
    x = np.zeros(grid.shape)
    x[1, 1, 1] = 1e6
    rays, pixels = 3 if hole == "rays" else None, None if hole == "auto" else 3
    options = {"hole": hole, "aperture_points": rays, "pixel_points": pixels}
    for name in ("Tc-99m", "Lu-177"):
        tc = mph.isotope(name)
        one = mph.Projector(grid, views, emission(system, isotope=tc, **options), backend)
        all_of = mph.Projector(grid, views, emission(system, isotope=tc, **BOTH, **options), backend)
        share = all_of(x).sum((1, 2)) / one(x).sum((1, 2))
        np.testing.assert_allclose(share, decays(tc) / tc.mean_decay_time(1.0), rtol=1e-6)
        y = np.random.default_rng(1).uniform(0, 1, one.shape_out)
        assert np.vdot(all_of(x), y) == pytest.approx(np.vdot(x, all_of.T(y)), rel=1e-6)
    still = mph.Projector(grid, views, emission(system, **BOTH, **options), backend)
    plain = mph.Projector(grid, views, emission(system, **options), backend)
    np.testing.assert_allclose(still(x), TIMES[:, None, None] * plain(x), rtol=1e-6)
    which = np.array([7, 2, 6])
    part = mph.Projector(grid, views[which], still.model.of_views(which), backend)
    np.testing.assert_allclose(part(x), still(x)[which], rtol=1e-6)
    for subset in still.subsets(3):
        np.testing.assert_allclose(subset(x), still(x)[subset.which], rtol=1e-6, atol=1e-9)


SMALL = {
    "phantom.text": "[[shape]]\nkind = 'sphere'\nradius = 30\nactivity = 5\n", "phantom.voxels": 8, "model.kind": "emission",
    "model.isotope": "Tc-99m", "detector.plane": "real", "detector.rows": 4, "detector.columns": 6,
}  # fmt: skip


def test_recipes_and_runs_have_them(system, workbook, tmp_path, command):
    given = {"model.time": TIMES.tolist(), "model.start": ", ".join(map(str, STARTS))}
    recipe = mph.Recipe(SMALL | given)
    assert recipe["model.time"] == tuple(TIMES) and recipe["model.start"] == tuple(STARTS)
    mph.write_recipe(recipe, tmp_path / "study.toml")
    assert mph.read_recipe(tmp_path / "study.toml") == recipe
    (plain,), (run,) = (mph.run_recipe(r, system) for r in (mph.Recipe(SMALL), recipe))
    tc = mph.isotope("Tc-99m")
    factors = decays(tc) / tc.mean_decay_time(1.0)
    np.testing.assert_allclose(run.projections, factors[:, None, None] * plain.projections, rtol=1e-5)
    for suffix in (".h5", ".npz"):
        mph.write_run(run, tmp_path / f"a{suffix}")
        again = mph.read_run(tmp_path / f"a{suffix}")
        assert again.recipe["model.time"] == tuple(TIMES) and again.settings["start"] == STARTS.tolist()
        A = mph.projector_of_run(again, again.volume.grid)
        np.testing.assert_array_equal(A(again.volume), again.projections)
    assert mph.Recipe(SMALL | {"model.time": [60.0]})["model.time"] == 60.0
    refused(lambda: next(mph.run_recipe(recipe, system[:3])), "time: expected one number, or 3 numbers")
    refused(lambda: mph.Recipe(SMALL | {"model.time": [-1.0]}), "model.time: expected a number above 0 (s), got -1")
    given = ["--time", "10,20", "--modules", "2,5", "--emission", "--size", "4", "4", "--voxels", "8"]
    command("project", workbook, *given, "--start-time", "0, 3600", "-o", tmp_path / "b.h5")
    recipe = mph.read_run(tmp_path / "b.h5").recipe
    assert recipe["model.time"] == (10.0, 20.0) and recipe["model.start"] == (0.0, 3600.0)


# Measured files


def write_phases(frames, path, times, delays, **changes):
    """Write a dynamic study: a phase a frame, each with its duration and the delay before it, s."""
    from pydicom.dataset import Dataset

    parts = []
    for time, delay in zip(times, delays, strict=True):
        part = Dataset()
        part.ActualFrameDuration, part.PhaseDelay = round(1000 * time), round(1000 * delay)
        part.PauseBetweenFrames, part.NumberOfFramesInPhase = 0, 1
        parts.append(part)
    vector = list(range(1, len(frames) + 1))
    changes = {"PhaseInformationSequence": parts, "PhaseVector": vector, "NumberOfPhases": len(parts), **changes}
    dicom_files.write_frames(frames, path, **changes)


def test_dicoms_phases_say_when_frames_began_and_how_long_they_took(system, rng, tmp_path):
    pytest.importorskip("pydicom")
    path, times, delays = tmp_path / "d.dcm", np.arange(10.0, 22.0), np.arange(12.0) / 4
    write_phases(counted(rng), path, times, delays)
    begun = np.concatenate([[0], np.cumsum(times + np.append(delays[1:], 0))[:-1]])
    run = mph.counts_run(mph.read_counts(path), system, "112-101", "back-v")
    np.testing.assert_allclose(run.recipe["model.time"], times[::-1])
    np.testing.assert_allclose(run.recipe["model.start"], begun[::-1])
    assert "10 to 21 s" in counts_caption(run)
    recipe = mph.Recipe({
        "counts.files": [str(path)], "counts.frames": "112-101", "counts.orientation": "back-v", "model.kind": "emission",
        "model.start": 3600.0, "model.isotope": "Tc-99m",
    })  # fmt: skip
    (run,) = mph.run_recipe(recipe, system)
    np.testing.assert_allclose(run.recipe["model.start"], 3600 + begun[::-1])
    model = mph.projector_of_run(run, mph.Grid.centered(4, 20.0)).model
    np.testing.assert_allclose(model.effective_time, model.isotope.mean_decay_time(times[::-1], 3600 + begun[::-1]))
    (again,) = mph.run_recipe(run.recipe, system)
    assert again.recipe == run.recipe, "what a run's recipe says does not contradict its file"
    part = mph.counts_run(mph.read_counts(path)[[3, 5]], system[:2], "102,101", "back-v")
    assert part.recipe["model.start"] == pytest.approx((begun[5] - begun[3], 0)), "after the first frame that is used"


def test_a_recipe_that_imports_says_the_same_when_it_reconstructs(system, rng, tmp_path):
    """Its start is that of the first frame; those of the others stay what the file says."""
    pytest.importorskip("pydicom")
    write_phases(counted(rng), tmp_path / "d.dcm", np.full(12, 60.0), np.full(12, 3600.0))
    recipe = mph.Recipe({
        "counts.files": [str(tmp_path / "d.dcm")], "counts.frames": "112-101", "counts.orientation": "back-v",
        "model.kind": "emission", "model.start": 600.0, "model.isotope": "Tc-99m", "reconstruction.method": "mlem",
        "reconstruction.iterations": 1, "reconstruction.voxels": 4, "reconstruction.spacing": 20.0,
    })  # fmt: skip
    (run,) = mph.run_recipe(recipe, system)
    assert max(run.recipe["model.start"]) > 40_000
    own = mph.reconstruct_run(run, run.recipe.updated({key: recipe[key] for key in recipe.given if "recon" in key}))
    np.testing.assert_array_equal(mph.reconstruct_run(run, recipe).volume.array, own.volume.array)
    later = mph.reconstruct_run(run, recipe.updated({"model.start": 600.0 + 21_600}))
    tc = mph.isotope("Tc-99m")
    factor = tc.mean_decay_time(60.0, 600.0) / tc.mean_decay_time(60.0, 22_200.0)
    np.testing.assert_allclose(later.volume.array, factor * own.volume.array, rtol=1e-4)


def test_frames_of_a_phase_follow_each_other(rng, tmp_path):
    pytest.importorskip("pydicom")
    from pydicom.dataset import Dataset

    parts = [Dataset(), Dataset()]
    for part, duration, count in zip(parts, (10_000, 30_000), (2, 1), strict=True):
        part.ActualFrameDuration, part.NumberOfFramesInPhase, part.PauseBetweenFrames = duration, count, 500
    tags = {"PhaseVector": [1, 1, 1, 1, 2, 2], "TimeSliceVector": [1, 2, 1, 2, 1, 1]}
    tags |= {"DetectorVector": [1, 1, 2, 2, 1, 2], "PhaseInformationSequence": parts, "AcquisitionTime": "101500.5"}
    dicom_files.write_frames(counted(rng, (6, 4, 4)), tmp_path / "d.dcm", **tags)
    about = mph.read_counts(tmp_path / "d.dcm").about
    np.testing.assert_allclose(about[:, 0], [10, 10, 10, 10, 30, 30])
    np.testing.assert_allclose(about[:, 4], [0, 10.5, 0, 10.5, 20.5, 20.5])


def test_files_say_when_they_began(rng, tmp_path):
    pytest.importorskip("pydicom")
    days = (("20260101", "235950"), ("20260102", "000010.500"))
    for number, (day, clock) in enumerate(days):
        changes = {"AcquisitionDate": day, "AcquisitionTime": clock}
        dicom_files.write_frames(counted(rng, (2, 4, 4)), tmp_path / f"{number}.dcm", 5000, **changes)
    about = mph.read_counts([tmp_path / "1.dcm", tmp_path / "0.dcm"]).about
    np.testing.assert_allclose(about[:, 4], [20.5, 20.5, 0, 0])


def interfile(rng, path, times, starts, key="image relative start time (sec)"):
    write_hdr(counted(rng), path)
    header = path.read_text()
    for time, start in zip(times, starts, strict=True):
        text = f"!image duration (sec) := {time}\n{key} := {start}"
        header = header.replace("!time per projection (sec) := 600", text, 1)
    path.write_text(header)


def test_interfiles_images_say_when_they_began_and_how_long_they_took(system, rng, tmp_path):
    path, times, begun = tmp_path / "c.hdr", np.arange(10, 22), 100 * np.arange(12)
    interfile(rng, path, times, begun)
    run = mph.counts_run(mph.read_counts(path), system, "101-112", "back-v")
    assert run.recipe["model.time"] == tuple(times) and run.recipe["model.start"] == tuple(begun)
    interfile(rng, path, times, [f"11:{k // 60:02}:{k % 60:02}" for k in begun], "image start time")
    np.testing.assert_array_equal(mph.read_counts(path).about[:, 4], begun)


def test_what_contradicts_a_file_is_refused(system, rng, tmp_path):
    path, times, begun = tmp_path / "c.hdr", np.arange(10, 22), 100 * np.arange(12)
    interfile(rng, path, times, begun)
    counts = mph.read_counts(path)
    late, long = (np.where(np.arange(12) == k, seconds, 0.0) for k, seconds in ((0, 50.0), (9, 1.0)))
    for given, place, said in (
        ({"time": times[::-1] + long}, "c.hdr: frame 3 (module 110)", "12 s, the time (--time) is 13 s; leave it out"),
        ({"time": 10.0}, "frame 12 (module 101)", "21 s, the time .* is 10 s, and others of 10 frames more;"),
        (
            {"start": begun[::-1] + late}, "frame 12 (module 101)",
            r"1100 s after frame 1 \(module 112\), the starts .* 1150 s; give that of",
        ),
    ):  # fmt: skip
        call = functools.partial(mph.counts_run, counts, system, "112-101", "back-v", **given)
        refused(call, f"{place}: the file says", said)
    run = mph.counts_run(counts, system, "112-101", "back-v", times[::-1] * 1.0001, start=60.0 + begun[::-1])
    assert run.recipe["model.start"][0] == 1160.0
    plain = mph.counts_run(np.asarray(counts), system, "101-112", "back-v", 30.0, start=60.0)
    assert (plain.recipe["model.time"], plain.recipe["model.start"]) == (30.0, 60.0)


def test_a_time_that_only_some_frames_have_is_asked_for(system, rng, tmp_path):
    for number, frames in enumerate((5, 7)):
        write_hdr(counted(rng, (frames, 6, 6)), tmp_path / f"{number}.hdr")
    text = (tmp_path / "1.hdr").read_text()
    (tmp_path / "1.hdr").write_text("\n".join(line for line in text.splitlines() if "time per projection" not in line))
    counts = mph.read_counts([tmp_path / "0.hdr", tmp_path / "1.hdr"])
    call = functools.partial(mph.counts_run, counts, system, "101-112", "back-v")
    refused(call, "frame 6 (module 106): the file says no time, of others it does; say it")
    assert call(600.0).recipe["model.time"] == 600.0


# Dead and hot


FRAMES = {"frames": "112-101", "orientation": "front+u"}


@pytest.mark.parametrize("detector", ["real", "virtual"])
def test_dead_and_hot_pixels_are_said_unless_declared(system, rng, detector):
    counts = counted(rng, (12, 9, 9), 60.0).astype(int)
    counts[2, 3, 5] = counts[2, 3, 6] = counts[4, 0, 8] = 0
    counts[7, 1, 1], counts[10] = 10**6, 0
    call = {"counts": counts, "system": system, **FRAMES, "time": 60.0, "detector": detector}
    empty, dead, hot = warned(lambda: mph.counts_run(**call))
    assert empty.startswith("counts: no counts in frame 11 (module 102), ")
    dead_ones = [(3, 110, 4, 6), (3, 110, 4, 7), (5, 108, 1, 9)]
    places = "; ".join("frame {} (module {}), row {}, column {}".format(*one) for one in dead_ones)
    assert dead.startswith(f"counts: no counts in {places}, 25 and more around; if they are dead, say so")
    assert hot.startswith("counts: frame 8 (module 105), row 2, column 2: 1e+06 counts")
    marks = counts.copy()
    marks[:] = 1
    marks[2, 3, 5:7] = marks[4, 0, 8] = marks[7, 1, 1] = marks[10] = 0
    with recorded_warnings():
        efficiency = mph.counts_run(**{**call, "counts": marks}).projections
    assert warned(lambda: mph.counts_run(**call, efficiency=efficiency)) == []
    run = mph.counts_run(**call, efficiency=efficiency)
    A = mph.projector_of_run(run, mph.Grid.centered(4, 20.0))
    np.testing.assert_array_equal(A.living, efficiency > 0)


def test_rates_are_what_is_compared(system, rng):
    times = np.where(np.arange(12) % 2, 1.0, 1000.0)
    counts = rng.poisson(0.02 * times[:, None, None], (12, 8, 8))
    counts[1] = 0  # of 1 s: chance
    call = {"counts": counts, "system": system, "frames": "101-112", "orientation": "back-v", "time": times}
    assert warned(lambda: mph.counts_run(**call)) == []
    counts[0] = 0
    (text,) = warned(lambda: mph.counts_run(**call))
    assert text.startswith("counts: no counts in frame 1 (module 101), ")
