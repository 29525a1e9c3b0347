"""Measured counts become runs of a scanner, whatever file, order and orientation they come in; a run gives its model."""

from __future__ import annotations

import functools

import h5py
import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.addon.cli import main
from mphdrr.core.runs.comparing import difference
from mphdrr.core.runs.mosaic import counts_caption, module_labels
from mphdrr.core.runs.recipe import recorded_recipe

from . import dicom_files
from .conftest import refused, refused_command

SPHERE = "[[shape]]\nkind = 'sphere'\nradius = 30\nactivity = 5\nmu = 0.015\n"
SMALL = {
    "phantom.text": SPHERE, "phantom.voxels": 12, "model.kind": "emission", "model.time": 30.0, "model.pixel_points": 2,
    "model.tolerance": 9.0, "detector.rows": 5, "detector.columns": 6, "detector.plane": "real",
}  # fmt: skip


@pytest.mark.parametrize("entries", [
    {}, {"attenuation.of_phantom": True, "model.aperture_points": 3}, {"model.kind": "transmission", "model.time": None},
])  # fmt: skip
def test_the_projector_of_a_run_makes_its_images(system, entries):
    (run,) = mph.run_recipe(mph.Recipe(SMALL).updated(entries), system[:3])
    A = mph.projector_of_run(run, run.volume.grid)
    np.testing.assert_array_equal(A(run.volume), run.projections)
    bare = mph.project_run(system, run.volume, (4, 4), "real")
    refused(lambda: mph.projector_of_run(bare, run.volume.grid), "holds no recipe")
    if "model.kind" not in entries:
        twice = mph.projector_of_run(run, run.volume.grid, recipe=run.recipe.updated({"model.time": 60}))
        np.testing.assert_allclose(twice(run.volume), 2 * run.projections, rtol=1e-5)


@pytest.fixture
def measured(system) -> mph.ProjectionRun:
    """Return what a scanner would measure: whole counts on its crystals, all different."""
    counts = np.random.default_rng(1).permutation(12 * 5 * 6).reshape(12, 5, 6)
    recipe = recorded_recipe(mph.Recipe(SMALL | {"model.time": 600.0}))
    settings = {"detector": "real", "recipe": recipe.tables()}
    return mph.ProjectionRun(counts, system, system.views((5, 6), "real"), unit="counts", settings=settings)


def as_file(image: np.ndarray, word: str) -> np.ndarray:
    """Return the picture, row 0 at the top, that one sees of a crystal's image (n_v, n_u), looked up point by point."""
    side, up_name = word[:-2], word[-2:]
    up = {"u": np.array([1, 0, 0]), "v": np.array([0, 1, 0])}[up_name[1]] * (1 if up_name[0] == "+" else -1)
    sight = np.array([0, 0, -1 if side == "front" else 1])  # the crystal lies behind the pinhole, against k
    right = np.cross(sight, up)
    n_v, n_u = image.shape
    rows, columns = (n_v, n_u) if up[1] else (n_u, n_v)
    picture = np.empty((rows, columns), image.dtype)
    for i in range(rows):
        for j in range(columns):
            point = right * (j - (columns - 1) / 2) - up * (i - (rows - 1) / 2)
            picture[i, j] = image[round(point[1] + (n_v - 1) / 2), round(point[0] + (n_u - 1) / 2)]
    return picture


def foreign(run: mph.ProjectionRun, numbers: list[int], word: str) -> np.ndarray:
    """Return a run's counts as another program keeps them: a frame for each of `numbers`, turned as `word` says."""
    images = dict(zip(run.system.numbers.tolist(), run.projections, strict=True))
    return np.stack([as_file(images[number], word) for number in numbers]).astype(np.uint16)


def write_npy(frames, path):
    np.save(path, frames)
    return {}


def write_npz(frames, path):
    np.savez(path, peak=frames, scatter=frames + 1, time=3.0)
    return {"counts.dataset": "peak"}


def write_h5(frames, path):
    with h5py.File(path, "w") as file:
        file["scan/detector"], file["scan/angles"] = frames.astype(float), np.arange(3)
    return {}


def write_raw(frames, path):
    frames.astype(">u4").tofile(path)
    shape = list(frames.shape)
    return {"counts.raw_shape": shape, "counts.raw_type": "uint32", "counts.raw_big_endian": True}


def write_dcm(frames, path):
    pytest.importorskip("pydicom")
    dicom_files.write_frames(frames, path, 600_000)
    return {}


def write_mhd(frames, path):
    """Write frames as GATE 10's projections: 32-bit floats."""
    size = " ".join(map(str, frames.shape[::-1]))
    path.write_text(
        f"ObjectType = Image\nNDims = 3\nBinaryData = True\nBinaryDataByteOrderMSB = False\nDimSize = {size}\n"
        f"ElementSpacing = 4 4 1\nOffset = 0 0 0\nElementType = MET_FLOAT\nElementDataFile = {path.stem}.raw\n"
    )
    frames.astype("<f4").tofile(path.with_suffix(".raw"))
    return {"detector.pitch": 4.0}


def write_hdr(frames, path):
    """Write frames as GATE 9's projections; the files were moved since."""
    count, rows, columns = frames.shape
    lines = ["!INTERFILE :=", "!imaging modality := nucmed", "!data starting block := 0", ";", "!GENERAL DATA :="]
    lines += [f"!name of data file := ./out/{path.stem}.sin", f"!total number of images := {count}"]
    lines += ["imagedata byte order := LITTLEENDIAN", "number of energy windows := 1"]
    lines += [f"number of detector heads := {count}"]
    for _ in range(count):
        lines += [f"!matrix size [1] := {columns}", f"!matrix size [2] := {rows}", "!number format := unsigned integer"]
        lines += ["!number of bytes per pixel := 2", "!time per projection (sec) := 600", ";"]
    path.write_text("\n".join([*lines, "!END OF INTERFILE :="]))
    frames.astype("<u2").tofile(path.with_suffix(".sin"))
    return {}


WRITERS = {"npy": write_npy, "npz": write_npz, "h5": write_h5, "raw": write_raw, "dcm": write_dcm, "mhd": write_mhd,
           "hdr": write_hdr}  # fmt: skip


@pytest.mark.parametrize(("ending", "seed"), [(ending, seed) for seed, ending in enumerate(WRITERS)])
def test_what_another_program_wrote_becomes_the_run_that_it_was(system, measured, ending, seed, tmp_path):
    rng = np.random.default_rng(seed)
    numbers = rng.permutation(system.numbers).tolist()
    word = list(mph.ORIENTATIONS)[seed]
    path = tmp_path / f"counts.{ending}"
    said = WRITERS[ending](foreign(measured, numbers, word), path)
    recipe = mph.Recipe({
        "counts.files": [str(path)], "counts.frames": ",".join(map(str, numbers)), "counts.orientation": word,
        "model.kind": "emission", "model.time": 600.0, "model.isotope": "Tc-99m", **said,
    })  # fmt: skip
    (run,) = mph.run_recipe(recipe, system)
    np.testing.assert_array_equal(run.projections, measured.projections)
    np.testing.assert_array_equal(run.system.numbers, system.numbers)
    assert (run.volume, run.unit, run.seed, run.is_measured) == (None, "counts", None, True)
    views = system.views((5, 6), "real", pitch=said.get("detector.pitch"))
    np.testing.assert_array_equal(run.views.projection_matrices(), views.projection_matrices())
    assert (run.recipe["model.time"], run.recipe["model.isotope"]) == (600.0, "Tc-99m")
    for other in ("run.h5", "run.npz"):
        mph.write_run(run, tmp_path / other)
        again = mph.read_run(tmp_path / other)
        np.testing.assert_array_equal(again.projections, run.projections)
        assert again.volume is None and again.recipe == run.recipe


@pytest.mark.parametrize("word", mph.ORIENTATIONS)
def test_every_orientation_is_what_it_says(system, measured, word):
    numbers = system.numbers.tolist()[::-1]
    run = mph.counts_run(foreign(measured, numbers, word), system, numbers, word, 30)
    np.testing.assert_array_equal(run.projections, measured.projections)
    label, text = mph.ORIENTATIONS[word]
    assert word[-2:] in label and text.startswith("Columns run along ")


def test_on_the_virtual_detector_the_same_rays_count_the_same(system, measured):
    numbers = system.numbers.tolist()
    run = mph.counts_run(foreign(measured, numbers, "back-v"), system, "101-112", "back-v", 30, detector="virtual")
    for m in range(len(system)):  # a point's pixel has the same count on both planes
        points = np.random.default_rng(m).uniform(-20, 20, (9, 3))
        found = []
        for one in (run, measured):
            homogeneous = one.views.projection_matrices()[m] @ np.c_[points, np.ones(9)].T
            columns, rows = np.rint(homogeneous[:2] / homogeneous[2]).astype(int)
            inside = (columns >= 0) & (columns < 6) & (rows >= 0) & (rows < 5)
            found.append(one.projections[m][rows[inside], columns[inside]])
        np.testing.assert_array_equal(*found)
    np.testing.assert_allclose(run.views.u_steps, system.views((5, 6)).u_steps)


def test_frames_may_each_lie_their_own_way_and_come_from_several_files(system, measured, tmp_path):
    numbers = system.numbers.tolist()
    words = ["front+v", "back-v"] * 6
    frames = [foreign(measured, [number], word) for number, word in zip(numbers, words, strict=True)]
    for number, frame in zip(numbers, frames, strict=True):
        np.save(tmp_path / f"{number}.npy", frame[0])
    (tmp_path / "order.txt").write_text("101 102\n103-110\n111, 112\n")
    recipe = mph.Recipe({
        "counts.files": [str(tmp_path / f"{number}.npy") for number in numbers], "model.kind": "emission",
        "counts.frames_file": str(tmp_path / "order.txt"), "counts.orientation": words, "model.time": 2.0,
    })  # fmt: skip
    (run,) = mph.run_recipe(recipe, system)
    np.testing.assert_array_equal(run.projections, measured.projections)
    counts = mph.read_counts([tmp_path / "101.npy", tmp_path / "102.npy"])
    np.testing.assert_array_equal(counts, np.concatenate(frames[:2]))


def test_a_measured_run_is_reconstructed_as_the_simulated_one(system, measured):
    frames = foreign(measured, system.numbers.tolist(), "front-u")
    run = mph.counts_run(frames, system, system.numbers, "front-u", 600.0, recipe=measured.recipe)
    assert run.background == 0
    scattered = measured.recipe.updated({"model.background": 1.5})
    assert mph.counts_run(frames, system, system.numbers, "front-u", 600, recipe=scattered).background == 1.5
    grid = mph.Grid.centered(6, 20.0)
    found, expected = (mph.mlem(mph.projector_of_run(one, grid), one.projections, 2) for one in (run, measured))
    np.testing.assert_allclose(found.volume.array, expected.volume.array, rtol=1e-6)


GOOD = {"frames": "101-112", "orientation": "back-v", "time": 3.0}


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"frames": None}, r"12 frames of 5 x 6 pixels; say which module each frame is of \(--frames"),
        (
            {"orientation": None, "time": None},
            r"how frames lie .*front\+v.*, and the exposure time in sec.* \(--time\)",
        ),
        ({"frames": "101-111"}, "expected the modules of 12 frames, got 11 numbers"),
        ({"frames": "101-111,101"}, "module 101 has several frames"),
        ({"frames": "1,102-112"}, "no module 1; it has 101-112"),
        ({"frames": "101-111,oops"}, "'oops' is no number, no range"),
        ({"frames": "1-99999999"}, "more than a scanner has modules"),
        ({"frames": [101.5] * 12}, "expected the modules' numbers"),
        ({"orientation": "up"}, r"expected one of front\+v, front-v"),
        ({"orientation": ["back-v"] * 5}, "expected 1 or 12 words, got 5"),
        ({"orientation": ["back-v"] * 11 + ["back-u"]}, "not square cannot lie both"),
        ({"time": 0}, r"time \(--time\): expected more than 0 s"),
        ({"time": float("nan")}, "time .*finite"),
        ({"detector": "film"}, "expected 'virtual' or 'real'"),
    ],
)
def test_what_is_not_said_or_said_wrongly_is_one_clear_line(system, changes, said):
    refused(lambda: mph.counts_run(np.ones((12, 5, 6), int), system, **{**GOOD, **changes}), said)


@pytest.mark.parametrize(
    ("value", "said"),
    [
        (2.5, r"2.5 is no whole number of counts \(frame 4, row 2, column 6\); .*--expected"),
        (-1, r"-1 is below 0 \(frame 4, row 2, column 6\)"),
        (np.nan, "not a finite number"),
        (np.inf, "not a finite number"),
        (2.0**24 + 2, "more than a pixel can hold exactly"),
    ],
)
def test_what_is_no_count_is_named_with_its_place(system, value, said):
    counts = np.ones((12, 5, 6))
    counts[3, 1, 5] = value
    refused(lambda: mph.counts_run(counts, system, **GOOD), said)
    if value == 2.5:
        assert mph.counts_run(counts, system, **GOOD, expected=True).projections[3, 1, 5] == 2.5
    for wrong in (counts[0], counts.astype(complex), counts.astype(str), counts[:0]):
        refused(lambda wrong=wrong: mph.counts_run(wrong, system, **GOOD), r"expected (real )?numbers")


def test_modules_without_a_frame_are_named(system):
    words = "module 107-112 has no frame; leave such modules out with --modules"
    refused(lambda: mph.counts_run(np.ones((6, 5, 6), int), system, "101-106", "back-v", 3), words)
    assert len(mph.counts_run(np.ones((6, 5, 6), int), system[:6], "106-101", "back-v", 3).views) == 6


def test_frames_that_are_not_used_are_left_out(system):
    counts = np.arange(5 * 36).reshape(5, 6, 6)
    for frames in ("none,102,NONE * 2 101", [None, 102, None, None, np.int64(101)]):
        run = mph.counts_run(counts, system[:2], frames, "back-v", 3)
        np.testing.assert_array_equal(run.projections, counts[[4, 1]])
        assert module_labels(run) == ["101 (5)", "102 (2)"]
    refused(lambda: mph.counts_run(counts, system[:2], "101-102", "back-v", 3), "say none for a frame that is not used")


def test_files_that_hold_no_frames_are_refused_in_one_line(tmp_path):
    frames = np.arange(24, dtype=np.uint16).reshape(2, 3, 4)
    arrays = {"flat": frames.ravel(), "words": frames.astype(str), "good": frames, "other": frames[:, :2]}
    for name, array in arrays.items():
        np.save(tmp_path / f"{name}.npy", array)
    np.savez(tmp_path / "two.npz", a=frames, b=frames)
    frames.tofile(tmp_path / "counts.raw")
    (tmp_path / "text.npy").write_text("12 13")
    for name in ("cut", "alone"):
        write_hdr(frames, tmp_path / f"{name}.hdr")
    (tmp_path / "cut.sin").write_bytes(b"12345")
    (tmp_path / "alone.sin").unlink()
    (tmp_path / "analyze.hdr").write_bytes(bytes(348))
    for names, options, said in (
        ("counts.raw", {}, "of raw numbers say the shape"),
        ("counts.raw", {"shape": (2, 3, 4)}, "need their type"),
        ("counts.raw", {"type": "uint16"}, "need their shape"),
        ("counts.raw", {"shape": (2, 3, 4), "type": "u2"}, "expected one of uint8"),
        ("counts.raw", {"shape": (2, 3, 4), "type": "int32"}, "96 bytes (2 x 3 x 4 numbers of 4 bytes), counts.raw has 48"),
        ("none.npy", {}, "no such file"),
        ("", {}, "is a folder"),
        ("text.npy", {}, "not a file of numpy"),
        ("flat.npy", {}, "expected (frames, rows, columns), got shape 24"),
        ("words.npy", {}, "expected whole or real numbers"),
        ("good.npy other.npy", {}, "frames of 2 x 4 pixels, .*good.npy of 3 x 4"),
        ("good.npy", {"dataset": "a"}, "this file has no names"),
        ("two.npz", {}, "2 arrays of three axes in it; say which (--dataset NAME): a (2 x 3 x 4), b"),
        ("two.npz", {"dataset": "c"}, "no dataset 'c' in it; there are: a, b"),
        ("cut.hdr", {}, "expected 48 bytes .*, cut.sin has 5"),
        ("cut.sin", {}, "expected its header cut.hdr, which is beside it"),
        ("alone.hdr", {}, "the header's folder, which lacks them"),
        ("analyze.hdr", {}, "not an Interfile header"),
    ):  # fmt: skip
        paths = [tmp_path / name for name in names.split()] or tmp_path
        call = functools.partial(mph.read_counts, paths[0] if len(names.split()) == 1 else paths, **options)
        refused(call, said, tmp_path.name)


def test_dicom_says_its_time_and_what_else_it_holds(system, tmp_path):
    pytest.importorskip("pydicom")
    frames, path = np.ones((12, 6, 6), np.uint16), tmp_path / "nm.dcm"
    dicom_files.write_frames(frames, path, 600_000, NumberOfEnergyWindows=2, PixelSpacing=["3", "3"])
    told = {"counts.files": [str(path)], "model.kind": "emission"}
    with pytest.raises(mph.InputError, match=r"12 frames .*2 energy windows, 12 detectors\); say which") as error:
        next(mph.run_recipe(mph.Recipe(told), system))
    assert "--time" not in str(error.value), "the file says it"
    told |= {"counts.frames": "101-112", "counts.orientation": "back-v"}
    with pytest.warns(mph.InputWarning) as caught:
        next(mph.run_recipe(mph.Recipe(told), system))
    texts = [str(one.message) for one in caught]
    assert any("pixels of 3 x 3 mm; taken as" in text for text in texts)
    dicom_files.write_frames(frames, path, ImageType=["ORIGINAL", "PRIMARY", "RECON TOMO", "EMISSION"])
    refused(lambda: mph.read_counts(path), "reconstructed tomogram; expected a frame a module")
    dicom_files.write_frames(frames, path, Modality="CT")
    refused(lambda: mph.read_counts(path), "modality CT: expected nuclear medicine")


def test_the_command_takes_counts_for_projections(small_workbook, tmp_path, capsys):
    counts = np.random.default_rng(3).poisson(4.0, (4, 8, 8))
    np.save(tmp_path / "c.npy", counts)
    run, picture = tmp_path / "run.h5", tmp_path / "m.png"
    command = ["project", str(small_workbook), "--modules", "1-4", "--counts", str(tmp_path / "c.npy")]
    told = ["--frames", "4-1", "--orientation", "back-v", "--time", "60", "--isotope", "Tc-99m"]
    assert main([*command, *told, "-o", str(run), "--mosaic", str(picture)]) == 0
    made = mph.read_run(run)
    np.testing.assert_array_equal(made.projections, counts[::-1])
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert (made.workbook, made.settings["frames"]) == (small_workbook.name, [4, 3, 2, 1])
    assert module_labels(made) == ["1 (4)", "2 (3)", "3 (2)", "4 (1)"]
    assert counts_caption(made).startswith("c.npy, 60 s, frames back-v. Module (frame): crystals seen from behind")
    assert main([*command, *told, "--write-recipe", str(tmp_path / "c.toml")]) == 0
    assert main(["project", str(tmp_path / "c.toml"), "-o", str(tmp_path / "again.npz")]) == 0
    np.testing.assert_array_equal(mph.read_run(tmp_path / "again.npz").projections, made.projections)
    assert main(["export", str(run), "-o", str(tmp_path / "copy.npz")]) == 0
    mph.write_volume(mph.Volume(np.ones((3, 3, 3)), mph.Grid.centered(3, 9.0), "activity"), tmp_path / "v.npz")
    assert main(["project", str(run), "--volume", str(tmp_path / "v.npz"), "-o", str(tmp_path / "p.h5")]) == 0
    simulated = mph.read_run(tmp_path / "p.h5")
    assert simulated.volume is not None and simulated.views.shape == (8, 8) and simulated.unit == "counts"
    for wrong, said in (
        (["-o", str(run)], "4 frames of 8 x 8 pixels; say which module each frame is of (--frames"),
        ([*told, "--noise", "1", "-o", str(run)], "noise.seed (--noise) does not go with counts.files (--counts)"),
        ([*told, "--volume", "v.nii", "-o", str(run)], "does not go with"),
        ([*told, "--size", "9", "9", "-o", str(run)], "detector.rows: 9, but the images of c.npy have 8"),
    ):
        assert said in refused_command(capsys, *command, *wrong)


def test_a_measured_run_goes_where_runs_go(system, measured, tmp_path):
    frames = foreign(measured, system.numbers.tolist(), "back-v")
    run = mph.counts_run(frames, system, system.numbers, "back-v", 600.0)
    assert difference(run, measured).maximum == 0
    mph.write_run(run, tmp_path / "run.h5")
    refused(lambda: mph.ProjectionRun(run.projections, system, run.views), "without a volume")
    assert main(["project", str(tmp_path / "run.h5"), "-o", str(tmp_path / "b.h5")]) == 1  # of an array, not of a file
    assert main(["figure", "mosaic", str(tmp_path / "run.h5"), "-o", str(tmp_path / "m.png")]) == 0
    assert main(["figure", "sums", str(tmp_path / "run.h5"), "-o", str(tmp_path / "s.png")]) == 1
