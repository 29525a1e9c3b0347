"""``mphdrr backproject``: it does what Python does; line integrals of runs; what is written and refused."""

import json
from dataclasses import replace

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.cli import backproject as command_module
from mphdrr.core.cli import main

from .conftest import refused_command, stop

COUNTS = {"model.kind": "emission", "model.time": 60.0, "model.hole": "point", "model.pixel_points": 1,
          "model.tolerance": 1e9, "detector.rows": 24, "detector.columns": 20, "detector.plane": "real",
          "phantom.kind": "derenzo", "phantom.voxels": 30, "phantom.rod_diameters": [10, 8, 10, 8, 9, 7]}  # fmt: skip
REAL = {"model.isotope": "Tc-99m", "model.aperture_mu": "tungsten", "model.crystal_mu": "NaI", "model.background": 2.5}
SMALL = ["--voxels", "18", "17", "16", "--spacing", "4", "--center", "3", "2", "1"]
GRID = mph.Grid.centered((18, 17, 16), 4.0, (3, 2, 1))


def made(scanner, **changes) -> mph.ProjectionRun:
    return next(mph.run_recipe(mph.Recipe(COUNTS).updated(changes), scanner[::8]))


@pytest.fixture(scope="module")
def run(scanner) -> mph.ProjectionRun:
    return made(scanner)


@pytest.fixture
def file(run, tmp_path) -> str:
    mph.write_run(run, tmp_path / "run.npz")
    return str(tmp_path / "run.npz")


@pytest.mark.parametrize("changes", [
    {}, REAL, {"model.edge": "path", "model.aperture_mu": 3.0, "detector.plane": "virtual"},
    {"model.crystal_mu": 0.25, "model.within_cone": True, "model.within_crystal": True, "model.within_walls": True},
])  # fmt: skip
@pytest.mark.filterwarnings("ignore::mphdrr.core.errors.InputWarning")
def test_counts_of_ideal_pinholes_become_line_integrals(scanner, changes):
    """Whatever hole, crystal, time and background, and of modules of several lengths and diameters."""
    run = made(scanner, **changes)
    far = run.views if run.recipe["detector.plane"] == "real" else run.system.views((24, 20), magnification=30.0)
    integrals = mph.Projector(run.volume.grid, far)(run.volume)
    result = mph.run_line_integrals(run)
    np.testing.assert_allclose(result, integrals, atol=1e-5 * integrals.max())
    for background in (np.arange(10.0), np.full(run.projections.shape, 0.5)):
        images = run.projections - run.background + background.reshape(10, *background.shape[1:] or (1, 1))
        same = mph.run_line_integrals(replace(run, projections=images, background=background))
        np.testing.assert_allclose(same, result, atol=2e-3 * result.max())


def test_radiographs_are_line_integrals_as_they_are(scanner):
    run = made(scanner, **{"model.kind": "transmission"})
    np.testing.assert_array_equal(mph.run_line_integrals(run), run.projections)
    mu = mph.Volume(0.01 * run.volume.array / run.volume.array.max(), run.volume.grid, "mu")
    settings = {"model.kind": "transmission", "model.photons": 1e6, "detector.rows": 24, "detector.columns": 20}
    (photons,) = mph.run_recipe(mph.Recipe(settings), run.system, mu)
    assert photons.unit == "photons"
    exact = mph.Projector(mu.grid, photons.views)(mu)
    np.testing.assert_allclose(mph.run_line_integrals(photons), exact, atol=1e-5 * exact.max())


@pytest.mark.parametrize("how", ["sum", "product", "minimum"])
def test_the_command_does_what_python_does(run, file, tmp_path, capsys, how):
    output, count = tmp_path / "new" / "b.nii.gz", tmp_path / "n.nrrd"
    assert main(["backproject", file, *SMALL, "--how", how, "-o", str(output), "--views-that-see", str(count)]) == 0
    volume, seeing = mph.read_volume(output), mph.read_volume(count)
    expected = mph.backproject(np.maximum(mph.run_line_integrals(run), 0), run.views, GRID, how)
    assert volume.quantity == "backprojection" and volume.grid.shape == (18, 17, 16)
    for array in (volume.array, mph.backproject_run(run, how, grid=GRID).array):
        np.testing.assert_array_equal(array, expected.array)
    np.testing.assert_array_equal(seeing.array, mph.views_that_see(run.views, GRID).array)
    assert seeing.quantity == "modules"
    assert capsys.readouterr().out == (
        f"{output}: {how}, 18 x 17 x 16 voxels, {expected.array.min():.4g} to {expected.array.max():.4g}, "
        f"each seen by {seeing.array.min():.0f} to {seeing.array.max():.0f} of 10 views\n"
    )


def test_the_usual_voxels_are_those_of_reconstructions(run, file, tmp_path, command):
    answer = json.loads(command("backproject", file, "--json", "-o", tmp_path / "b.npz").out)
    volume = mph.read_volume(tmp_path / "b.npz")
    n = volume.grid.shape[0]
    system = run.system  # a pixel is seen at the isocentre as large as on the crystal, by distance over length
    pixel = (system.pinhole_distance / system.collimator_length * system.detector_side).min() / 24
    assert answer["voxels"] == [n, n, n] == list(volume.grid.shape) and n == 4 * system.roi_radius.max() // pixel
    assert n * volume.grid.spacing[0] == pytest.approx(2 * run.system.roi_radius.max())
    assert (answer["how"], answer["views"], answer["most_views"]) == ("sum", 10, 10)
    assert answer["largest"] == volume.array.max()


def test_noise_below_the_background_is_none(run):
    low = replace(run, projections=0 * run.projections, background=3.0)
    assert mph.run_line_integrals(low).max() < 0
    assert not mph.backproject_run(low, "product", grid=GRID).array.any()
    assert mph.backproject_run(low, "sum", grid=GRID).array.min() < 0


@pytest.mark.filterwarnings("ignore::mphdrr.core.errors.InputWarning")
def test_what_is_not_understood_is_refused_before_anything_is_written(scanner, file, tmp_path, capsys):
    output = tmp_path / "b.nii.gz"
    wide = {"detector.pitch": 4.0, "model.within_crystal": True}
    for name, changes in (("other", {"model.kind": "inverse-square"}), ("wide", wide)):
        mph.write_run(made(scanner, **changes), tmp_path / f"{name}.npz")
    for words, message in (
        ([tmp_path / "none.h5"], "no such file"),
        ([file, "--views-that-see", tmp_path / "b.txt"], ".nii.gz"),
        ([file, "--views-that-see", output], "is the name of two outputs"),
        ([file, "--voxels", 0], "voxels"),
        ([file, *SMALL, "--center", 0, 0, 5000], "no view sees any"),
        ([tmp_path / "other.npz"], "inverse-square are no line integrals"),
        ([tmp_path / "wide.npz", "--how", "product"], "beyond the crystals"),
        ([tmp_path / "wide.npz", "--how", "minimum"], "beyond the crystals"),
    ):
        assert message in refused_command(capsys, "backproject", "-o", output, *words)
    assert main(["backproject", file, "--how", "mean", "-o", str(output)]) == main(["backproject", file]) == 2
    assert mph.backproject_run(mph.read_run(tmp_path / "wide.npz"), grid=GRID).array.max() > 0
    assert not output.exists()


def test_cancelled_it_leaves_no_file(run, file, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(command_module, "progress_bar", lambda label: stop)
    assert main(["backproject", file, *SMALL, "-o", str(tmp_path / "b.nii.gz")]) == 130
    assert "cancelled" in capsys.readouterr().err
    assert not list(tmp_path.glob("b*"))
