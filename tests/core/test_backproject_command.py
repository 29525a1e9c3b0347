"""``mphdrr backproject``: it does what Python does; line integrals of runs; what is written and refused."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.cli import backproject as command_module
from mphdrr.core.cli import main

from .conftest import refused_command

COUNTS = {"model.kind": "emission", "model.time": 60.0, "model.hole": "point", "model.pixel_points": 1,
          "model.tolerance": 1e9, "detector.rows": 24, "detector.columns": 20, "detector.plane": "real",
          "phantom.kind": "derenzo", "phantom.voxels": 30}  # fmt: skip
REAL = {"model.isotope": "Tc-99m", "model.aperture_mu": "tungsten", "model.crystal_mu": "NaI", "model.background": 2.5}
SMALL = ["--voxels", "18", "17", "16", "--spacing", "4", "--center", "3", "2", "1"]
GRID = mph.Grid.centered((18, 17, 16), 4.0, (3, 2, 1))


def made(scanner, **changes) -> mph.ProjectionRun:
    (run,) = mph.run_recipe(mph.Recipe(COUNTS).updated(changes), scanner)
    return run


@pytest.fixture(scope="module")
def run(scanner) -> mph.ProjectionRun:
    return made(scanner[::8])


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
    run = made(scanner[::8], **changes)
    far = run.views if run.recipe["detector.plane"] == "real" else run.system.views((24, 20), magnification=30.0)
    integrals = mph.Projector(run.volume.grid, far)(run.volume)
    found = mph.run_line_integrals(run)
    for background in (np.arange(10.0), np.full(run.projections.shape, 0.5)):
        images = background if background.ndim == 3 else background[:, None, None]
        other = replace(run, projections=run.projections - run.background + images, background=background)
        np.testing.assert_allclose(mph.run_line_integrals(other), found, atol=2e-3 * found.max())
    np.testing.assert_allclose(found, integrals, atol=1e-5 * integrals.max())


def test_radiographs_are_line_integrals_as_they_are(scanner):
    run = made(scanner[::8], **{"model.kind": "transmission"})
    np.testing.assert_array_equal(mph.run_line_integrals(run), run.projections)
    mu = mph.Volume(0.01 * run.volume.array / run.volume.array.max(), run.volume.grid, "mu")
    recipe = mph.Recipe(
        {"model.kind": "transmission", "model.photons": 1e6, "detector.rows": 24, "detector.columns": 20}
    )
    (photons,) = mph.run_recipe(recipe, run.system, mu)
    assert photons.unit == "photons"
    exact = mph.Projector(mu.grid, photons.views)(mu)
    np.testing.assert_allclose(mph.run_line_integrals(photons), exact, atol=1e-5 * exact.max())


@pytest.mark.parametrize("how", ["sum", "product", "minimum"])
def test_the_command_does_what_python_does(run, file, tmp_path, capsys, how):
    output, count = tmp_path / "new" / "b.nii.gz", tmp_path / "n.nrrd"
    assert main(["backproject", file, *SMALL, "--how", how, "-o", str(output), "--views-that-see", str(count)]) == 0
    said = capsys.readouterr().out
    found = mph.read_volume(output)
    expected = mph.backproject(np.maximum(mph.run_line_integrals(run), 0), run.views, GRID, how)
    assert found.quantity == "backprojection" and found.grid.shape == (18, 17, 16)
    np.testing.assert_array_equal(found.array, expected.array)
    np.testing.assert_array_equal(mph.backproject_run(run, how, grid=GRID).array, expected.array)
    seeing = mph.read_volume(count)
    np.testing.assert_array_equal(seeing.array, mph.views_that_see(run.views, GRID).array)
    assert seeing.quantity == "modules"
    assert said == (
        f"{output}: {how}, 18 x 17 x 16 voxels, {expected.array.min():.4g} to {expected.array.max():.4g}, "
        f"each seen by {seeing.array.min():.0f} to {seeing.array.max():.0f} of 10 views\n"
    )


def test_the_usual_voxels_are_those_of_reconstructions(run, file, tmp_path, capsys):
    assert main(["backproject", file, "--json", "-o", str(tmp_path / "b.npz")]) == 0
    answer = json.loads(capsys.readouterr().out)
    volume = mph.read_volume(tmp_path / "b.npz")
    n = volume.grid.shape[0]
    assert answer["voxels"] == [n, n, n] == list(volume.grid.shape) and 64 <= n <= 128
    assert n * volume.grid.spacing[0] == pytest.approx(2 * run.system.roi_radius.max())
    assert (answer["how"], answer["views"], answer["most_views"]) == ("sum", 10, 10)
    assert answer["largest"] == volume.array.max()


def test_noise_below_the_background_is_none(run):
    low = mph.ProjectionRun(
        0 * run.projections, run.system, run.views, run.volume, "counts", run.settings, background=3.0
    )
    assert mph.run_line_integrals(low).max() < 0
    assert not mph.backproject_run(low, "product", grid=GRID).array.any()
    assert mph.backproject_run(low, "sum", grid=GRID).array.min() < 0


@pytest.mark.filterwarnings("ignore::mphdrr.core.errors.InputWarning")
def test_what_is_not_understood_is_refused_before_anything_is_written(scanner, run, file, tmp_path, capsys):
    output = tmp_path / "b.nii.gz"
    for words, said in (
        ([tmp_path / "none.h5", "-o", output], "no such file"),
        ([file, "-o", tmp_path / "b.txt"], ".nii.gz"),
        ([file, "-o", output, "--views-that-see", output], "same file as --output"),
        ([file, "--voxels", "0", "-o", output], "voxels"),
        ([file, *SMALL, "--center", "0", "0", "5000", "-o", output], "no view sees any"),
    ):
        assert said in refused_command(capsys, "backproject", *words)
    assert main(["backproject", file, "--how", "mean", "-o", str(output)]) == 2
    assert main(["backproject", file]) == 2
    capsys.readouterr()
    other = made(scanner[::8], **{"model.kind": "inverse-square"})
    mph.write_run(other, tmp_path / "other.npz")
    said = refused_command(capsys, "backproject", tmp_path / "other.npz", "-o", output)
    assert "inverse-square are no line integrals" in said
    wide = made(scanner[::8], **{"detector.pitch": 4.0, "model.within_crystal": True})
    mph.write_run(wide, tmp_path / "wide.npz")
    for how in ("product", "minimum"):
        said = refused_command(capsys, "backproject", tmp_path / "wide.npz", "--how", how, "-o", output)
        assert "beyond the crystals" in said
    assert mph.backproject_run(wide, grid=GRID).array.max() > 0
    assert not output.exists()


def test_cancelled_it_leaves_no_file(run, file, tmp_path, monkeypatch, capsys):
    def stop(done: int, total: int) -> None:
        raise mph.Cancelled

    monkeypatch.setattr(command_module, "progress_bar", lambda label: stop)
    assert main(["backproject", file, *SMALL, "-o", str(tmp_path / "b.nii.gz")]) == 130
    assert "cancelled" in capsys.readouterr().err
    assert not list(tmp_path.glob("b*"))
