"""``mphdrr reconstruct``: options, recipes and Python do the same; what is logged, drawn, kept and refused."""

from __future__ import annotations

import inspect
import re
import runpy
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import mphdrr.core as mph
from mphdrr.addon.cli import main
from mphdrr.core.cli.reconstruct import settings_line
from mphdrr.core.figures.page import DARK, Page
from mphdrr.core.figures.reconstructions import LIGHTS, draw
from mphdrr.core.reconstruction.method_files import METHOD_FILES
from mphdrr.core.reconstruction.methods import METHODS, Method
from mphdrr.core.reconstruction.priors import PRIORS
from mphdrr.core.runs.recipe import recipe_from_tables
from mphdrr.core.runs.reconstructing import reconstruction_grid, reconstruction_model
from mphdrr.core.runs.settings import SETTINGS

from .conftest import refused

COUNTS = {"model.kind": "emission", "model.time": 600.0, "model.aperture_points": 9, "model.intrinsic_fwhm": 1.0,
          "model.pixel_points": 2, "model.tolerance": 9.0, "detector.rows": 16, "detector.columns": 16,
          "detector.plane": "real", "phantom.kind": "derenzo", "phantom.voxels": 36, "phantom.spacing": 2.5}  # fmt: skip
SMALL = ["--voxels", "12", "--spacing", "8", "--iterations", "3"]


@pytest.fixture(scope="module")
def run(scanner) -> mph.ProjectionRun:
    (run,) = mph.run_recipe(mph.Recipe(COUNTS), scanner[::16])
    return run


@pytest.fixture
def file(run, tmp_path) -> str:
    mph.write_run(run, tmp_path / "run.npz")
    return str(tmp_path / "run.npz")


def command(*words: object) -> None:
    assert main(["reconstruct", *map(str, words)]) == 0


def refusal(capsys, *words: object) -> str:
    assert main(["reconstruct", *map(str, words)]) == 1
    text = capsys.readouterr().err
    (line,) = [line for line in text.splitlines() if not line.startswith(("mphdrr: warning", "iteration"))]
    return line


OLD = Path(__file__).parent / "data"
MODEL = {
    "model.kind": "emission", "model.time": 600.0, "model.isotope": "Tc-99m", "model.aperture_mu": "tungsten",
    "model.hole": "point",
}  # fmt: skip
TRANSMISSION = {**dict.fromkeys(MODEL), "model.kind": "transmission", "reconstruction.method": "sirt"}


@pytest.mark.parametrize("suffix", [".h5", ".npz"])
def test_runs_of_version_0_1_0_reconstruct_when_the_model_is_given(suffix, tmp_path, capsys):
    file, recipe = str(OLD / f"run-0.1.0{suffix}"), tmp_path / "model.toml"
    small = ["--voxels", "5", "--spacing", "18", "--iterations", "3", "--method", "mlem", "--quiet"]
    said = refusal(capsys, file, *small, "-o", tmp_path / "a.npz")
    assert "holds no recipe" in said and "--set model.kind=emission" in said
    entries = [word for key, value in MODEL.items() for word in ("--set", f"{key}={value}")]
    command(file, *small, *entries, "-o", tmp_path / "a.npz")
    assert "warning" not in capsys.readouterr().err
    mph.write_recipe(mph.Recipe(MODEL), recipe)
    command(file, *small, "--recipe", recipe, "-o", tmp_path / "b.npz")
    by_options, by_recipe = (mph.read_volume(tmp_path / f"{name}.npz") for name in "ab")
    np.testing.assert_array_equal(by_options.array, by_recipe.array)

    run = mph.read_run(file)
    model = mph.Emission(
        run.system, isotope="Tc-99m", aperture_mu="tungsten", time=600, hole="point", pixel_points=1, tolerance=1e9
    )
    A = mph.Projector(by_recipe.grid, run.views, model)
    found = mph.mlem(A, run.projections, iterations=3)
    # The same activity; the recipe's hole is modelled as reconstructions do.
    assert A(by_recipe.array).sum() == pytest.approx(A(found.volume.array).sum(), rel=0.02) != 0


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"model.time": 60.0}, "time 600.0, not 60.0"),
        ({"model.isotope": None, "model.aperture_mu": 3.597170699883768}, "photons_per_decay 0.891, not 1.0"),
        ({"model.hole": None}, "hole point, not auto"),
        (TRANSMISSION, "model emission, not transmission"),
    ],
)
def test_a_model_that_the_record_contradicts_is_warned_of(changes, said):
    run = mph.read_run(OLD / "run-0.1.0.npz")
    given = {key: value for key, value in (MODEL | changes).items() if value is not None}
    recipe = mph.Recipe({**given, "reconstruction.voxels": 5, "reconstruction.iterations": 1})
    with pytest.warns(mph.InputWarning, match=said):
        mph.reconstruct_run(run, recipe)


def test_the_command_does_what_python_does_and_logs_each_iteration(run, file, tmp_path, capsys):
    output = tmp_path / "new" / "v.nii.gz"
    command(file, *SMALL, "--subsets", "4", "-o", output)
    printed = capsys.readouterr()
    lines = [line for line in printed.err.splitlines() if line.startswith("iteration")]
    found = mph.read_volume(output)
    A = mph.projector_of_run(run, found.grid, recipe=run.recipe.updated({"model.hole": "auto"}))
    expected = mph.osem(A, run.projections, 3, subsets=4)
    np.testing.assert_allclose(found.array, expected.volume.array, rtol=1e-5, atol=1e-5)
    assert found.quantity == "activity" and found.grid == mph.Grid.centered(12, 8.0)
    logged = [float(re.search(r"log-likelihood ([\d.e+-]+),", line)[1]) for line in lines]
    assert len(lines) == 3 and lines[2].startswith("iteration 3 of 3: ")
    np.testing.assert_allclose(logged, expected.objective, rtol=1e-6)
    assert printed.out.startswith(f"{output}: OSEM, 3 iterations, 4 subsets, 12 x 12 x 12 voxels of 8 mm, largest ")


def test_a_recipe_says_how_and_options_override_it(run, file, tmp_path, capsys):
    recipe = tmp_path / "how.toml"
    recipe.write_text('[reconstruction]\nmethod = "mlem"\niterations = 2\nvoxels = [12]\nspacing = [8.0]\n'
                      "[detector]\nrows = 3\n")  # fmt: skip
    one, two, three, again = (tmp_path / f"{name}.npz" for name in ("one", "two", "three", "again"))
    command(file, "--recipe", recipe, "--quiet", "-o", one)
    assert "iteration" not in capsys.readouterr().err.replace("reconstruction", "")
    command(file, *SMALL, "--method", "mlem", "--iterations", "2", "-o", two)
    command(file, "--recipe", recipe, "--method", "osem", "--subsets", "4", "--write-recipe", tmp_path / "all.toml")
    command(file, "--recipe", tmp_path / "all.toml", "-o", three)
    command(file, *SMALL, "--iterations", "2", "--subsets", "4", "-o", again)
    volumes = [mph.read_volume(path).array for path in (one, two, three, again)]
    np.testing.assert_array_equal(volumes[0], volumes[1])
    np.testing.assert_array_equal(volumes[2], volumes[3])
    assert not np.allclose(volumes[0], volumes[2])
    result = mph.reconstruct_run(run, mph.read_recipe(recipe))
    np.testing.assert_allclose(result.volume.array, volumes[0], rtol=1e-6)
    assert result.settings["recipe"]["reconstruction"]["method"] == "mlem" and result.iterations == 2


def test_a_kept_state_goes_on_as_without_a_break(file, tmp_path, capsys):
    pytest.importorskip("h5py")
    small = ["--voxels", "12", "--spacing", "8", "--subsets", "4"]
    command(file, *small, "--iterations", "4", "-o", tmp_path / "whole.npz")
    command(file, *small, "--iterations", "1", "-o", tmp_path / "half.npz", "--save-state", tmp_path / "s.h5")
    capsys.readouterr()
    command(file, *small, "--iterations", "3", "-o", tmp_path / "rest.npz", "--resume", tmp_path / "s.h5")
    assert "iteration 2 of 4: " in capsys.readouterr().err
    other = ["--voxels", "12", "--spacing", "8", "--method", "mlem", "--iterations", "1"]
    command(file, *other, "-o", tmp_path / "other.npz", "--resume", tmp_path / "s.h5")
    said = capsys.readouterr()
    assert "iteration 1 of 1: " in said.err and "MLEM, 1 iteration, 12 x" in said.out
    whole, rest = (mph.read_volume(tmp_path / f"{name}.npz").array for name in ("whole", "rest"))
    np.testing.assert_array_equal(rest, whole)


@pytest.fixture(scope="module")
def radiograph(scanner) -> mph.ProjectionRun:
    (run,) = mph.run_recipe(mph.Recipe({"phantom.voxels": 12, "detector.rows": 6, "detector.columns": 6}), scanner[::8])
    return run


def projector(run: mph.ProjectionRun, recipe: mph.Recipe) -> mph.Projector:
    recipe = run.recipe.updated(recipe.given)
    return mph.projector_of_run(run, reconstruction_grid(run, recipe), None, reconstruction_model(run, recipe))


@pytest.mark.long
@pytest.mark.parametrize("name", METHODS)
def test_each_method_has_its_own_defaults_wherever_it_is_chosen(name, run, radiograph, tmp_path, capsys):
    """Command line, recipe and record say what its function says where nothing is given; what is resumed counts on."""
    pytest.importorskip("h5py")
    method = METHODS[name]
    run = run if method.of_counts else radiograph
    mph.write_run(run, tmp_path / "run.npz")
    needed = {key: 0.1 for key, default in method.own.items() if default is inspect.Parameter.empty}
    how = {"method": name, "voxels": 8, "spacing": 12.0, **needed, **({"hole": "rays"} if method.of_counts else {})}
    recipe = mph.Recipe({f"reconstruction.{key}": value for key, value in how.items()})
    expected = getattr(mph, name)(projector(run, recipe), run.projections, **needed)
    assert expected.iterations == method.own["iterations"]

    typed = [word for key, value in how.items() for word in (f"--{key}", str(value))]
    state, output = tmp_path / "s.h5", ["-o", tmp_path / "v.npz"]
    command(tmp_path / "run.npz", *typed, "--quiet", "--save-state", state, *output)
    by_command, by_recipe = mph.read_reconstruction(state), mph.reconstruct_run(run, recipe)
    again = mph.reconstruct_run(run, recipe_from_tables(by_command.settings["recipe"]))
    for found in (by_command, by_recipe, again):
        np.testing.assert_array_equal(found.volume.array, expected.volume.array)
        assert expected.settings.items() <= found.settings.items()
    assert mph.reconstruct_run(run, recipe.updated({"reconstruction.iterations": 2})).iterations == 2
    capsys.readouterr()
    command(tmp_path / "run.npz", *typed, "--resume", state, "--stop-seconds", "1e-9", *output)
    assert f"iteration {expected.iterations + 1} of {2 * expected.iterations}: " in capsys.readouterr().err
    assert main(["reconstruct", "--help"]) == 0
    assert f"{method.label} {expected.iterations}" in re.sub(r"\s+", " ", capsys.readouterr().out)


def test_every_argument_of_a_method_or_prior_is_a_setting():
    """One word, one meaning: methods that take the same argument have it from the same row."""
    assert {name: method.own["iterations"] for name, method in METHODS.items()} == {
        "osem": 10, "mlem": 50, "bsrem": 30, "sirt": 100, "cgls": 10, "tv": 200, "ostr": 30
    }  # fmt: skip
    by_hand = {"neighbors", "similar"}  # Python alone has them
    for choice in (*METHODS.values(), *PRIORS.values()):
        for name, default in choice.own.items():
            assert name in by_hand or f"reconstruction.{name}" in SETTINGS, (choice.label, name)
            setting = SETTINGS.get(f"reconstruction.{name}")
            if setting is not None and setting.default is not None:
                assert setting.default == default, (choice.label, name)


@pytest.mark.parametrize(
    ("name", "typed", "given"),
    [
        ("sirt", ["--relaxation", "0.5", "--no-nonnegative"], {"relaxation": 0.5, "nonnegative": False}),
        ("sirt", ["--set", "reconstruction.nonnegative=false"], {"nonnegative": False}),
        ("tv", ["--weight", "0.1", "--no-nonnegative"], {"weight": 0.1, "nonnegative": False}),
        ("bsrem", ["--step-decay", "0.5", "--hole", "rays"], {"step_decay": 0.5}),
        ("osem", ["--prior", "relative-difference", "--weight", "0.5"], {"prior": mph.RelativeDifference(0.5)}),
    ],
)
def test_a_methods_own_settings_reach_it(name, typed, given, run, radiograph, tmp_path, capsys):
    run = run if METHODS[name].of_counts else radiograph
    mph.write_run(run, tmp_path / "run.npz")
    small = ["--method", name, "--voxels", "8", "--spacing", "12", "--iterations", "3"]
    command(tmp_path / "run.npz", *small, *typed, "--write-recipe", tmp_path / "how.toml")
    command(tmp_path / "run.npz", "--recipe", tmp_path / "how.toml", "-o", tmp_path / "v.npz")
    A = projector(run, mph.read_recipe(tmp_path / "how.toml"))
    expected = getattr(mph, name)(A, run.projections, iterations=3, **given)
    np.testing.assert_array_equal(mph.read_volume(tmp_path / "v.npz").array, expected.volume.array)
    other = refusal(capsys, tmp_path / "run.npz", *small, *typed, "--method", "cgls", "-o", tmp_path / "no.npz")
    assert " needs " in other and f"reconstruction.method = {name}" in other


@pytest.fixture
def toy(monkeypatch, tmp_path) -> Path:
    """Add a method that reads a file, the number that all voxels become, by no iterations and no objective."""

    def read(path: Path) -> Method:
        try:
            value = float(path.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            raise mph.InputError("expected a number") from None

        def even(A: mph.Projector, images, nonnegative: bool = True, progress=None) -> mph.Reconstruction:
            if progress is not None:
                progress(1, 1)
            volume = np.full(A.shape_in, max(value, 0) if nonnegative else value, np.float32)
            return mph.Reconstruction(mph.Volume(volume, A.grid, "mu"), np.zeros(0), {"method": "Even"})

        return Method("Even", "The same everywhere", even, of_counts=False, objective="")

    monkeypatch.setitem(METHOD_FILES, ".toy", read)
    (tmp_path / "model.toy").write_text("-0.5", encoding="utf-8")
    return tmp_path / "model.toy"


def test_a_file_is_a_method_without_iterations_or_an_objective(toy, radiograph, tmp_path, monkeypatch, capsys):
    pytest.importorskip("h5py")
    mph.write_run(radiograph, tmp_path / "run.npz")
    small = [tmp_path / "run.npz", "--voxels", "8", "--spacing", "12"]
    command(*small, "--method", toy, "-o", tmp_path / "a.npz", "--picture", tmp_path / "p.svg", "--save-state",
            tmp_path / "s.h5")  # fmt: skip
    assert "Even, 8 x 8 x 8 voxels of 12 mm, largest 0 " in capsys.readouterr().out
    assert "iteration" not in (tmp_path / "p.svg").read_text(encoding="utf-8")
    kept = mph.read_reconstruction(tmp_path / "s.h5")
    assert kept.objective.shape == (0,) and kept.iterations == 0
    assert kept.settings["recipe"]["reconstruction"]["method"] == str(toy)
    command(*small, "--method", toy, "--no-nonnegative", "--write-recipe", tmp_path / "how" / "r.toml")
    monkeypatch.chdir("/")
    assert '"../model.toy"' in (tmp_path / "how" / "r.toml").read_text(encoding="utf-8").replace("\\", "/")
    result = mph.reconstruct_run(radiograph, mph.read_recipe(tmp_path / "how" / "r.toml"))
    assert (result.volume.array == -0.5).all()
    capsys.readouterr()
    for more, words in (
        (["--iterations", "3"], "reconstruction.iterations (--iterations): Even does not take it"),
        (["--subsets", "3"], "reconstruction.subsets (--subsets): Even does not take it"),
        (["--prior", "quadratic", "--weight", "1"], "reconstruction.prior (--prior): Even does not take it"),
        (["--start", tmp_path / "a.npz"], "start: Even has no start"),
        (["--stop-seconds", "1"], "stop: Even has no stop"),
    ):
        assert words in refusal(capsys, *small, "--method", toy, *more, "-o", tmp_path / "no.npz")
    toy.write_text("much", encoding="utf-8")
    assert refusal(capsys, *small, "--method", toy, "-o", tmp_path / "no.npz").endswith("model.toy: expected a number")
    said = refusal(capsys, *small, "--method", "model.onnx", "-o", tmp_path / "no.npz")
    assert "expected one of osem, mlem, bsrem, sirt, cgls, tv, ostr or a file (.pt, .toy), got 'model.onnx'" in said


def test_a_state_of_other_settings_is_refused_in_a_line(file, tmp_path, capsys):
    pytest.importorskip("h5py")
    small, state = ["--voxels", "12", "--spacing", "8", "--iterations", "1"], tmp_path / "s.h5"
    command(file, *small, "--subsets", "4", "--save-state", state, "-o", tmp_path / "v.npz")
    for more, said in ((["--subsets", "5"], "subsets 4, now 5"), (["--subsets", "4", "--ignore-blur"], "objective"),
                       (["--subsets", "4", "--background", "2"], "background 0.0, now ")):  # fmt: skip
        line = refusal(capsys, file, *small, *more, "--resume", state, "-o", tmp_path / "no.npz")
        assert line.startswith("mphdrr: start: this reconstruction is of other") and said in line and "--start" in line
        command(file, *small, *more, "--start", state, "-o", tmp_path / "yes.npz")
    assert not (tmp_path / "no.npz").exists()


def test_stopping_and_watching(run):
    how = {"reconstruction.voxels": 16, "reconstruction.spacing": 6, "reconstruction.iterations": 6}
    seen = []

    def watch(iteration, values, objective):
        seen.append((iteration, float(values.max()), len(objective)))
        return iteration == 2

    assert mph.reconstruct_run(run, mph.Recipe(how), watch=watch).iterations == 2
    assert [(iteration, count) for iteration, _, count in seen] == [(1, 1), (2, 2)]
    easy = mph.reconstruct_run(run, mph.Recipe(how | {"reconstruction.stop_change": 0.5}))
    assert easy.iterations == 2 and easy.settings["stopped"] == "change"
    noisy = how | {"reconstruction.stop_noise": 1e-6, "reconstruction.stop_region": (0, 0, 0, 20)}
    assert mph.reconstruct_run(run, mph.Recipe(noisy), watch=lambda *_: None).settings["stopped"] == "noise"


def test_voxels_cover_the_roi_and_the_model_is_that_of_the_run(run):
    side = 2 * run.system.roi_radius.max()
    # A pixel is seen at the isocentre as large as it is on the crystal, by distance over length.
    largest = (run.system.pinhole_distance / run.system.collimator_length).min() * run.system.detector_side.min()
    most = int(2 * side * run.views.shape[1] / largest)
    assert reconstruction_grid(run, run.recipe).shape == (most,) * 3, "not finer than half a pixel"
    views = run.system.views((256, 256))
    run = replace(run, views=views, projections=np.zeros((len(views), 256, 256), np.float32))
    for rods, voxels in (((12.0, 0.0), 64), ((12.0, side / 40), 80), ((12.0, 1.0), 128)):
        six = (*rods, 0.0, 0.0, 0.0, 0.0)
        recipe = run.recipe.updated({"phantom.matrix": np.eye(4).tolist(), "phantom.rod_diameters": six})
        of_rods = replace(run, settings={**run.settings, "recipe": recipe.tables()})
        grid = reconstruction_grid(of_rods, of_rods.recipe)
        assert grid.shape == (voxels,) * 3, "half of the smallest rod, 64 to 128 along a side"
        np.testing.assert_allclose(grid.spacing * voxels, side)
        asked = {"reconstruction.voxels": 20}
        assert reconstruction_grid(of_rods, of_rods.recipe.updated(asked)).shape == (20, 20, 20)
        assert reconstruction_grid(of_rods, of_rods.recipe.updated({"reconstruction.spacing": 2.0})).shape == (64,) * 3

    def model(**changes):
        recipe = run.recipe.updated({key.replace("__", "."): value for key, value in changes.items()})
        found = reconstruction_model(run, recipe)
        return found["model.hole"], found["model.aperture_points"], found["model.intrinsic_fwhm"]

    assert model() == ("auto", None, 1.0)  # the whole hole has no points
    assert model(reconstruction__hole="rays") == ("rays", 7, 1.0)
    assert model(reconstruction__pixel_points=3) == ("rays", 7, 1.0)
    assert model(reconstruction__aperture_points=1, reconstruction__ignore_blur=True) == ("rays", 1, 0)
    assert model(model__aperture_points=3) == ("rays", 3, 1.0)
    assert model(model__aperture_points=1) == ("rays", 1, 1.0)  # counts of an ideal hole
    assert model(model__aperture_points=None, model__aperture_tolerance=0.1) == ("auto", None, 1.0)
    assert model(model__hole="depth") == ("auto", None, 1.0)
    assert model(model__hole="point") == ("rays", 1, 1.0)
    assert model(model__crystal_mu="NaI", model__depth_layers=2) == ("auto", None, 1.0)
    with pytest.warns(mph.InputWarning, match="rays through 7 points, .* whole hole by depth: the backend is numpy"):
        assert model(compute__backend="numpy") == ("rays", 7, 1.0)
    centre = reconstruction_grid(run, run.recipe.updated({"reconstruction.center": (1, 2, 3)})).center
    np.testing.assert_allclose(centre, (1, 2, 3))


@pytest.mark.parametrize("method", [["sirt", "--iterations", "100"], ["cgls", "--iterations", "8"],
                                    ["tv", "--weight", "0.02", "--iterations", "80"]])  # fmt: skip
@pytest.mark.parametrize("photons", [None, 1e5])
def test_radiographs_are_reconstructed_by_least_squares(method, photons, scanner, tmp_path, capsys):
    grid = mph.Grid.centered(20, 4.0)
    x, y, z = np.meshgrid(*(np.arange(20) * 4.0 - 38,) * 3, indexing="ij")
    ball = mph.Volume(np.where(x**2 + y**2 + z**2 < 24**2, 0.02, 0).astype(np.float32), grid, "mu")
    made = {"detector.rows": 16, "detector.columns": 16} | ({} if photons is None else {"model.photons": photons})
    (run,) = mph.run_recipe(mph.Recipe(made), scanner[::4], ball)
    mph.write_run(run, tmp_path / "run.npz")
    how = [*method, "--voxels", "10", "--spacing", "8"]
    command(tmp_path / "run.npz", "--method", *how, "-o", tmp_path / "v.npz", "--picture", tmp_path / "p.svg")
    volume = mph.read_volume(tmp_path / "v.npz")
    inside = mph.resample(ball, volume.grid, "mean").array > 0.0199
    assert volume.quantity == "mu" and volume.array[inside].mean() == pytest.approx(0.02, rel=0.1)
    assert "squared error" in capsys.readouterr().err


def test_data_of_the_model_itself_are_warned_of(run, file, tmp_path, capsys):
    command(file, *SMALL, "--spacing", "4", "--aperture-points", "9", "-o", tmp_path / "v.npz")
    said = capsys.readouterr().err
    assert "voxels (2.5 mm) should be 2 mm or less" in said and "9 points of the hole" in said
    command(file, *SMALL, "-o", tmp_path / "v.npz")
    assert "warning" not in capsys.readouterr().err


@pytest.mark.long
def test_the_attenuation_of_the_run_is_modelled_unless_it_is_to_be_ignored(scanner):
    water = {"phantom.cylinder_radius": 45.0, "phantom.cylinder_height": 60.0, "attenuation.of_phantom": True,
             "phantom.voxels": 20, "phantom.spacing": 5.0, "detector.rows": 8, "detector.columns": 8}  # fmt: skip
    (run,) = mph.run_recipe(mph.Recipe(COUNTS | water), scanner[::8])
    how = {"reconstruction.voxels": 12, "reconstruction.spacing": 8, "reconstruction.iterations": 3}
    whole, less = (mph.Recipe(how | more) for more in ({}, {"reconstruction.ignore_attenuation": True}))
    assert mph.reconstruct_run(run, less).volume.array.sum() < 0.8 * mph.reconstruct_run(run, whole).volume.array.sum()


def test_the_picture_shows_slices_beside_the_truth_and_the_objective(run, file, tmp_path, capsys):
    command(file, *SMALL, "--picture", tmp_path / "p.png")
    with Image.open(tmp_path / "p.png") as picture:
        assert picture.size == (1600, 850)
    command(file, *SMALL, "--subsets", "5", "--picture", tmp_path / "p.svg")
    text = (tmp_path / "p.svg").read_text(encoding="utf-8")
    settings = "3 iterations, 5 subsets"
    for words in ("Reconstruction", "Error", "Truth, z = 4 mm", "Log-likelihood", "kBq/mL", "error", settings, "20 mm"):
        assert f">{words}<" in text, words
    assert text.count("<image") == 11  # three slices of each, and two colour bars
    volume = mph.Volume(np.zeros((2, 2, 2)), mph.Grid.centered(2, 1.0))
    assert settings_line(mph.Reconstruction(volume, np.zeros(1))) == "1 iteration"
    assert settings_line(mph.Reconstruction(volume, np.zeros(2), {"subsets": 4})) == "2 iterations, 4 subsets"


@pytest.mark.parametrize("size", [(240, 240), (1600, 500), (500, 900)])
def test_slices_lie_on_the_page_and_have_the_right_colours(size):
    array = np.zeros((12, 10, 8), np.float32)
    array[9:, :, :] = 50.0
    page = Page(*size)
    draw(page, mph.Volume(array, mph.Grid.centered(array.shape, 2.0), "activity"), [], None)
    hot = (np.abs(page.picture.astype(int) - (252, 255, 164)).max(axis=2) < 8).sum()
    cold = (page.picture.max(axis=2) < 6).sum()
    assert hot > cold > 0, "what is shown is where there is something, and a margin"


def test_a_picture_as_low_as_an_editor_has_legible_texts_and_all_that_matters(run, tmp_path):
    """1048 x 223 pixels are what an editor below the 3D view has on a screen of 1280 x 800."""
    page, grid = Page(1048, 223, DARK, 14.0), mph.Grid.centered(16, 6.0)
    rods = [("8 mm", "green", "0.12", "80 %"), ("6 mm", "amber", "0.81", "9 %"), ("4 mm", "red", "1.02", "-1 %"),
            ("2 mm", "", "voxels of 6 mm are larger than the rods", "")]  # fmt: skip
    mean = mph.resample(run.volume, grid, "mean")
    draw(page, mean, [1.0, 2.0], run.volume, "Of it", ["OSEM", "it flatters"], "fit", rods)
    page.write(tmp_path / "p.svg")
    marks = (tmp_path / "p.svg").read_text(encoding="utf-8")
    sizes = re.findall(r'<text x="([0-9.]+)" y="([0-9.]+)" font-size="([0-9.]+)"', marks)
    assert all(0 <= float(x) < 1048 and 0 < float(y) <= 223 and float(size) >= 10.9 for x, y, size in sizes)
    for words in ("Truth, z = ", "Reconstruction", "Error", "8 mm", "0.81", "-1 %", "OSEM"):
        assert words in marks, words
    colors = {tuple(color) for color in page.picture.reshape(-1, 3).tolist()}
    assert {tuple(bytes.fromhex(color[1:])) for color in LIGHTS.values()} < colors, "a dot for each light"
    assert (page.picture.max(axis=2) < 40).mean() > 0.5, "a dark page"


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--hole", "depth", "--aperture-points", "7"], "points) does not go with reconstruction.hole = depth"),
        (["--method", "tv"], "reconstruction.weight (--weight): missing; TV needs it"),
        (["--subsets", "11"], "subsets: expected at most the 5 views, got 11"),
        (["--method", "mlem", "--subsets", "4"], ".subsets (--subsets) needs reconstruction.method = osem"),
        (["--method", "magic"], "reconstruction.method: expected one of osem, mlem"),
        (["--iterations", "0"], "reconstruction.iterations: expected a whole number of 1 or more"),
        (["--prior", "quadratic"], "reconstruction.weight (--weight): missing"),
        (["--weight", "1"], "reconstruction.weight (--weight) needs reconstruction.prior"),
        (["--background", "-1"], "reconstruction.background: expected a number of 0 or more"),
        (["--set", "detector.rows=5"], "--set detector.rows: expected an entry of [reconstruction], [model]"),
        (["--start", "missing.npz"], "missing.npz"),
        (["--stop-noise", "0.1"], "reconstruction.stop_noise (--stop-noise) needs reconstruction.stop_region"),
        (["--voxels", "100000"], "memory"),
        (["--picture", "p.jpg"], "p.jpg: expected a name ending in .png, .svg"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(options, said, file, tmp_path, capsys):
    assert said in refusal(capsys, file, *options, "-o", tmp_path / "v.npz")
    assert not (tmp_path / "v.npz").exists()


def test_wrong_runs_are_refused(radiograph, file, tmp_path, capsys, scanner):
    assert "nothing to write" in refusal(capsys, file)
    mph.write_run(radiograph, tmp_path / "drr.npz")
    said = refusal(capsys, tmp_path / "drr.npz", "-o", tmp_path / "v.npz")
    assert "osem needs a run of counts, not of line integrals; for these images: sirt, cgls, tv" in said
    bare = mph.project_run(scanner[:4], radiograph.volume, (4, 4))
    refused(lambda: mph.reconstruct_run(bare), "holds no recipe")
    assert set(METHODS) >= {"osem", "mlem"}


@pytest.mark.long
def test_the_example_goes_from_workbook_to_score(tmp_path, monkeypatch, capsys):
    small = ["--iterations", "2", "--voxels", "24", "--pixels", "16", "--fine", "48"]
    monkeypatch.setattr(sys, "argv", ["reconstruct.py", "--picture", str(tmp_path / "p.png"), *small])
    runpy.run_path(str(Path(__file__).parents[2] / "examples/reconstruct.py"), run_name="__main__")
    said = capsys.readouterr().out
    assert "iteration 2 of 2" in said and "\n8 mm  " in said and "\n2 mm  " in said
    assert 0 < float(re.search(r"NRMSE ([\d.]+)", said)[1]) < 1.2
    assert (tmp_path / "p.png").stat().st_size > 10_000
