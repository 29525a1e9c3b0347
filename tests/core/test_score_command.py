"""All scores of a volume: `score_volume`, its lines and picture, and `mphdrr score` as a user types it."""

from __future__ import annotations

import dataclasses
import html
import json
import re

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import gaussian_filter

import mphdrr.core as mph
from mphdrr.core.figures.page import Page
from mphdrr.core.figures.scores import SIZE, draw

from .conftest import refused

RODS = (5.0, 4.0, 0.0, 3.0, 2.5, 1.2)
PHANTOM = mph.DerenzoPhantom(24.0, RODS, 20.0, activity=100.0)
OPTIONS = ["derenzo", "--radius", "24", "--rods", *map(str, RODS), "--height", "20"]
POSE = mph.euler_pose(0.0, np.deg2rad(20), 0.0, (1, 2, 3))


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Write a blurred phantom and its truth on a finer grid as files."""
    folder = tmp_path_factory.mktemp("score")
    truth = PHANTOM.voxelize(mph.Grid.centered((44, 44, 32), 1.2, center=(1, 2, 3)), POSE)
    coarse = PHANTOM.voxelize(mph.Grid.centered((40, 40, 30), 1.35, center=(1, 2, 3)), POSE)
    mph.write_volume(truth, folder / "truth.nii.gz")
    mph.write_volume(mph.Volume(gaussian_filter(coarse.array, 0.8), coarse.grid), folder / "volume.nii.gz")
    mph.write_phantom(PHANTOM, folder / "truth.toml")
    return folder


@pytest.fixture(scope="module")
def expected(files) -> mph.VolumeScore:
    return mph.score_volume(mph.read_volume(files / "volume.nii.gz"), PHANTOM, POSE)


def test_all_scores_are_those_of_their_functions(expected):
    score, volume = expected, expected.volume
    voxels = PHANTOM.voxelize(volume.grid, POSE)
    assert score.nrmse == mph.nrmse(volume, voxels) and score.psnr == mph.psnr(volume, voxels)
    assert score.ssim == mph.ssim(volume, voxels)
    rods = mph.derenzo_score(volume, PHANTOM, POSE)
    assert score.derenzo.valley_to_peak == pytest.approx(rods.valley_to_peak, nan_ok=True)
    assert score.nema is None and score.notes == ()
    lines = score.lines
    assert len(lines) == 6  # the empty sector is no line
    assert re.fullmatch(r"5 mm  green: resolved, valley/peak \d\.\d\d, contrast \d+ %", lines[1])
    assert [line.rpartition(": ")[2] for line in lines[1:5]] == [sector.words for sector in rods if sector.light]
    assert lines[-1] == "1.2 mm  voxels of 1.35 mm are larger than the rods"
    record = json.loads(json.dumps(score.record, allow_nan=False))["derenzo"]
    assert record[2]["note"] == "no rods" and record[2]["resolved"] is None
    for said, sector in zip(record[:2], rods, strict=False):
        assert said["resolved"] is bool(sector.resolved) and said["chance"] == sector.chance < 0.02
        assert said["light"] == sector.light == "green"
        assert said["pairs_resolved"] == sector.pairs_resolved == 1 and said["pairs"] == len(sector.profiles)


def test_a_truth_on_another_grid_is_resampled_and_that_is_said(files):
    volume, truth = (mph.read_volume(files / f"{name}.nii.gz") for name in ("volume", "truth"))
    score = mph.score_volume(volume, truth)
    assert score.notes == ("the truth, on another grid, is resampled onto the volume's voxels, as means",)
    assert score.nrmse == mph.nrmse(volume, mph.resample(truth, volume.grid, "mean"))
    assert score.derenzo is None and mph.score_volume(truth, truth).notes == ()


def test_what_a_volume_cannot_have_is_said():
    grid = mph.Grid.centered((79, 61, 9), (4.0, 4.0, 4.0))
    with pytest.warns(mph.InputWarning, match="outside the grid"):
        score = mph.score_volume(mph.Volume(np.ones(grid.shape), grid), mph.NemaBody())
    assert score.ssim is None and score.nema is None
    assert [note.partition(":")[0] for note in score.notes] == ["without SSIM", "without spheres"]
    assert "24 of 60 background regions lie outside" in score.notes[1]


def test_the_table_of_spheres():
    body = mph.NemaBody()
    grid = mph.Grid.centered((80, 62, 15), (4.0, 4.0, 4.0))
    with pytest.warns(mph.InputWarning, match="outside the grid"):
        volume = body.voxelize(grid)
        score = mph.score_volume(volume, body)
    assert score.lines[0] == "All voxels: NRMSE 0.000, PSNR infinite dB, SSIM 1.000"
    assert score.lines[1].split() == ["Spheres", "contrast", "recovery", "background", "variability"]
    assert len({len(line) for line in score.lines[1:8]}) == 1 and score.lines[8].startswith("Lung insert: 0.0 %")
    assert score.record["psnr_dB"] is None and len(score.record["nema"]) == 6
    page = Page(*SIZE)
    draw(page, score, "body")


@pytest.mark.parametrize(
    ("volume", "truth", "pose", "message"),
    [
        (0, PHANTOM, None, "score_volume: expected a Volume, got int"),
        ("volume", "truth", None, "score_volume: truth: expected a Volume, got str"),
        ("volume", "volume", np.eye(4), "score_volume: a pose is that of a phantom"),
        ("mu", "volume", None, "score_volume: volume of mu, truth of activity"),
        ("hu", PHANTOM, None, "score_volume: expected a volume of activity or mu, got hu"),
    ],
)
def test_what_cannot_be_scored_is_refused(volume, truth, pose, message):
    grid, quantities = mph.Grid.centered(12, 1.0), {"volume": "activity", "mu": "mu", "hu": "hu"}
    volumes = {name: mph.Volume(np.ones(grid.shape), grid, quantity) for name, quantity in quantities.items()}
    truth = volumes.get(truth, truth) if isinstance(truth, str) else truth
    refused(lambda: mph.score_volume(volumes.get(volume, volume), truth, pose), message)


PLACE = ["--position", "1", "2", "3", "--euler", "0", "20", "0"]


@pytest.mark.parametrize("words", [[*PLACE, *OPTIONS], [*OPTIONS, *PLACE], ["--truth", "TOML", *PLACE]])
def test_a_phantom_on_the_command_line(files, expected, command, words):
    words = [files / "truth.toml" if word == "TOML" else word for word in words]
    record = json.loads(command("score", files / "volume.nii.gz", "--json", *words).out)
    assert record["nrmse"] == pytest.approx(expected.nrmse, rel=1e-4)
    assert record["derenzo"][3]["resolved"] == expected.derenzo[3].resolved
    assert record["derenzo"][5]["valley_to_peak"] is None


def test_the_picture_shows_volume_and_truth(files, tmp_path, command):
    pictures = [tmp_path / "new" / name for name in ("score.png", "score.svg")]
    for picture in pictures:
        words = ["score", files / "volume.nii.gz", "--truth", files / "truth.toml", *PLACE, "--picture", picture]
        assert command(*words).out.startswith("All voxels: NRMSE 0.")
    pixels = np.asarray(Image.open(pictures[0]).convert("RGB"))
    assert pixels.shape[:2] == SIZE[::-1] and (pixels != 255).any(axis=-1).mean() > 0.2
    text = pictures[1].read_text(encoding="utf-8")
    assert text.count("<image") == 7  # three slices of each, and the colour bar
    assert ">reconstruction<" in text and ">3 mm: resolved, valley/peak 0." in text


def test_a_run_knows_its_phantom_or_its_volume(files, expected, system, tmp_path, command):
    volume, run = str(files / "volume.nii.gz"), tmp_path / "run.h5"
    phantom = {"kind": "derenzo", "radius": 24.0, "rod_diameters": RODS, "height": 20.0, "activity": 100.0}
    phantom |= {"voxels": 24, "position": (1, 2, 3), "euler_degrees": (0, 20, 0)}
    recipe = mph.Recipe({f"phantom.{name}": value for name, value in phantom.items()} | {"compute.backend": "numpy"})
    (made,) = mph.run_recipe(recipe.updated({"detector.rows": 4, "detector.columns": 4}), system)
    mph.write_run(made, run)
    (first, *_) = json.loads(command("score", volume, "--truth", run, "--json").out)["derenzo"]
    assert first["valley_to_peak"] == pytest.approx(expected.derenzo[0].valley_to_peak, rel=1e-4)
    mph.write_run(dataclasses.replace(made, settings={}), run)
    assert "derenzo" not in json.loads(command("score", volume, "--truth", run, "--json").out)
    mph.write_run(dataclasses.replace(made, volume=None, unit="counts"), run)
    said = command("score", volume, "--truth", run, status=1).err
    assert "run.h5: the run was measured: nobody knows the truth" in said


@pytest.mark.long
def test_that_a_score_flatters_stays_with_it(system, tmp_path, command):
    """As JSON, on standard error, and of a reconstruction in its settings and its file."""
    made = {"model.kind": "emission", "model.aperture_points": 7, "model.time": 60.0, "detector.plane": "real",
            "detector.rows": 12, "detector.columns": 12, "phantom.kind": "derenzo", "phantom.voxels": 24,
            "phantom.spacing": 4.0}  # fmt: skip
    (run,) = mph.run_recipe(mph.Recipe(made), system)
    mph.write_run(run, tmp_path / "run.npz")
    how = mph.Recipe({"reconstruction.voxels": 16, "reconstruction.spacing": 6.0, "reconstruction.iterations": 2,
                      "reconstruction.hole": "rays"})  # fmt: skip
    with pytest.warns(mph.InputWarning) as caught:
        found = mph.reconstruct_run(run, how)
    flatters = found.settings["flatters"]
    assert [str(each.message) for each in caught] == flatters and len(flatters) == 2
    assert re.search(r"voxels \(4 mm\) should be 3 mm or less", flatters[0]) and "7 points of the hole" in flatters[1]
    mph.write_volume(found.volume, tmp_path / "v.npz")
    arguments = ["score", tmp_path / "v.npz", "--truth", tmp_path / "run.npz"]
    assert json.loads(command(*arguments, "--json").out)["notes"] == flatters
    said = command(*arguments, "--picture", tmp_path / "p.svg").err
    drawn = html.unescape((tmp_path / "p.svg").read_text("utf-8"))
    assert all(f"mphdrr: {text}" in said and text in drawn for text in flatters)
    coarse = mph.Volume(np.ones((12, 12, 12)), mph.Grid.centered(12, 8.0))
    mph.write_volume(coarse, tmp_path / "v.npz")
    assert json.loads(command(*arguments, "--json").out)["notes"] == flatters[1:]


def test_a_truth_volume_on_the_command_line(files, tmp_path, command):
    volume, truth = (files / f"{name}.nii.gz" for name in ("volume", "truth"))
    out, err = command("score", volume, "--truth", truth, "--picture", tmp_path / "score.png")
    assert out.startswith("All voxels")
    assert err == "mphdrr: the truth, on another grid, is resampled onto the volume's voxels, as means\n"


@pytest.mark.parametrize(
    ("arguments", "status", "message"),
    [
        ([], 1, "expected --truth FILE or a kind of phantom"),
        (["--truth", "none.nii.gz"], 1, "none.nii.gz: no such file"),
        (["--truth", "TRUTH", "--euler", 0, 1, 2], 1, "--euler is for a kind of phantom or a .toml; a run or a v"),
        (["--truth", "TRUTH", *OPTIONS], 1, "expected either --truth or a kind of phantom, got both"),
        (["--truth", "TRUTH", "--picture", "score.pdf"], 1, "score.pdf: expected a name ending in .png, .svg"),
        (["--quantity", "hu", *OPTIONS], 1, "expected a volume of activity or mu, got hu"),
        (["cube"], 2, "invalid choice: 'cube'"),
        (["derenzo", "--rods", "x"], 2, "invalid float value: 'x'"),
    ],
)
def test_mistakes_are_one_line(files, command, arguments, status, message):
    words = [files / "truth.nii.gz" if word == "TRUTH" else word for word in arguments]
    said = command("score", files / "volume.nii.gz", *words, status=status).err
    assert message in said and said.count("\n") == 1 and said.startswith("mphdrr")
