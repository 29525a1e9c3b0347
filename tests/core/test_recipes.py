"""Recipes: files, options and runs agree; files of old versions are read."""

from __future__ import annotations

import dataclasses
import importlib.util
from pathlib import Path

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.addon.cli import main
from mphdrr.core.phantoms.kinds import KINDS
from mphdrr.core.runs.recipe import Recipe
from mphdrr.core.runs.run_recipe import euler_degrees, phantom_pose
from mphdrr.core.runs.settings import SETTINGS

from .conftest import refused, refused_command

DATA = Path(__file__).parent / "data"
SMALL = ["--voxels", "12", "--spacing", "8", "--size", "6", "8", "--modules", "3-4"]
COUNTS = ["--emission", "--isotope", "Tc-99m", "--aperture-mu", "tungsten", "--pixel-points", "3", "--tolerance", "9"]


def read(text: str, tmp_path: Path) -> Recipe:
    (tmp_path / "r.toml").write_text(text, encoding="utf-8")
    return mph.read_recipe(tmp_path / "r.toml")


def test_a_recipe_comes_back_from_its_file(tmp_path):
    recipe = Recipe({
        "system.file": str(tmp_path / 'sub' / 'a "scanner".xlsx'), "volume.states": [str(tmp_path / "1.npz"), "/b.npz"],
        "model.kind": "emission", "model.aperture_mu": "lead", "model.crystal_mu": 0.25, "model.window": (60, 80),
        "model.isotope": "Tl-201", "model.within_walls": True, "noise.seed": 3, "model.pixel_points": "auto",
    })  # fmt: skip
    mph.write_recipe(recipe, tmp_path / "r.toml")
    assert mph.read_recipe(tmp_path / "r.toml") == recipe
    assert 'file = "sub/' in (tmp_path / "r.toml").read_text()  # relative to the file
    posed = Recipe({"phantom.kind": "nema", "phantom.matrix": np.eye(4).tolist(), "phantom.voxels": 7})
    mph.write_recipe(posed, tmp_path / "r.toml")
    assert mph.read_recipe(tmp_path / "r.toml") == posed
    assert all(f"{key.partition('.')[2]} =" in (tmp_path / "r.toml").read_text() for key in SETTINGS)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("model = 3", r"model: expected one of the tables \[system\], \[volume\]"),
        ("[modle]\nkind = 1", r"modle: expected one of the tables"),
        ("[model]\ntiem = 1", "model.tiem: no such setting; expected kind, time, "),
        ("[model]\nkind = 'spect'", "expected one of transmission, emission, spectral, inverse-square, got 'spect'"),
        ("[model]\nkind = 'emission'\ntime = 0", r"model.time: expected a number above 0 \(s\), got 0"),
        ("[model]\nkind = 'emission'\naperture_points = true", "aperture_points: expected a whole number of 1 or "),
        ("[model]\nkind = 'emission'\naperture_mu = 'wood'", "expected one of tungsten, .* or a number above 0"),
        ("[model]\ntime = 5", r"model.time \(--time\) needs model.kind = emission \(--emission\)"),
        ("[phantom]\nkind = 'derenzo'\nspheres = 3", "phantom.spheres: no such setting; .*rod_diameters"),
        ("[phantom]\nposition = [1, 2]", "phantom.position: expected 3 values, got 2"),
        ("[detector]\nrows = nan", "detector.rows: expected a whole number"),
        ("[volume]\nfile = 'a'\n[phantom]\nkind = 'nema'", "does not go with"),
        ("[model", "not TOML"),
    ],
)
def test_what_is_wrong_in_a_file_is_named_by_file_and_key(text, said, tmp_path):
    with pytest.raises(mph.InputError, match=said) as error:
        read(text, tmp_path)
    assert "r.toml" in str(error.value) and "\n" not in str(error.value)


def test_options_their_recipe_and_its_run_make_the_same_images(small_workbook, tmp_path, capsys):
    options = [*SMALL, *COUNTS, "--euler", "10", "20", "30", "--position", "1", "2", "3", "--noise", "4"]
    toml, first, second, third = (str(tmp_path / name) for name in ("r.toml", "a.h5", "b.npz", "c.h5"))
    assert main(["project", str(small_workbook), *options, "-o", first]) == 0
    assert main(["project", str(small_workbook), *options, "--write-recipe", toml]) == 0
    assert main(["project", toml, "-o", second]) == 0
    assert main(["project", second, "-o", third]) == 0
    runs = [mph.read_run(path) for path in (first, second, third)]
    for run in runs[1:]:
        np.testing.assert_array_equal(run.projections, runs[0].projections)
        np.testing.assert_array_equal(run.volume.array, runs[0].volume.array)
        assert run.recipe["model.aperture_mu"] == "tungsten" and run.recipe["noise.seed"] == run.seed == 4
    (again,) = mph.run_recipe(runs[0].recipe)  # from the files, not from the run
    np.testing.assert_array_equal(again.projections, runs[0].projections)
    # Options override the recipe, and entries that then have no effect are dropped.
    assert main(["project", first, "--transmission", "--set", "detector.rows=5", "-o", third]) == 0
    changed = mph.read_run(third)
    assert changed.projections.shape == (2, 5, 8) and changed.unit == "kBq/mL mm"
    assert "model.aperture_mu" not in changed.recipe.given and changed.recipe["phantom.position"] == (1, 2, 3)
    np.testing.assert_array_equal(changed.volume.array, runs[0].volume.array)
    # Another position makes another volume.
    assert main(["project", first, "--position", "9", "0", "0", "-o", third]) == 0
    assert mph.read_run(third).volume.grid.center == pytest.approx([9, 0, 0])


def test_a_changed_recipe_keeps_what_still_holds_and_no_more():
    pose = mph.euler_pose(0, 0, np.pi / 2, (1, 2, 3))
    numbers = {"phantom.kind": "nema", "phantom.sphere_activity": 3.0, "phantom.matrix": pose.tolist()}
    made = Recipe({**numbers, "phantom.position": (1, 2, 3), "phantom.euler_degrees": (0, 0, 90)})
    moved = made.updated({"phantom.position": (9, 0, 0)})
    np.testing.assert_allclose(phantom_pose(moved), mph.euler_pose(0, 0, np.pi / 2, (9, 0, 0)), atol=1e-12)
    np.testing.assert_allclose(phantom_pose(made.updated({"phantom.matrix": None})), phantom_pose(made), atol=1e-12)
    assert moved["phantom.sphere_activity"] == 3
    assert "phantom.sphere_activity" not in made.updated({"phantom.kind": "jaszczak"}).given
    only_matrix = Recipe({"phantom.matrix": made["phantom.matrix"]}).updated({"phantom.position": (9, 0, 0)})
    refused(lambda: phantom_pose(only_matrix), "another pose")


@pytest.mark.parametrize("centered", [False, True])
def test_a_run_made_again_is_attenuated_again(centered, small_workbook, tmp_path, capsys):
    """Also where the attenuation is the phantom's, or is moved with the volume."""
    first, second = str(tmp_path / "a.h5"), str(tmp_path / "b.h5")
    options = ["--water", "45", "60", "--phantom-mu"]
    if centered:
        away = mph.Grid.centered(8, 9.0, (150.0, 0, 0))
        for name, value, quantity in (("v", 1.0, "activity"), ("mu", 0.01, "mu")):
            mph.write_volume(mph.Volume(np.full(away.shape, value), away, quantity), tmp_path / f"{name}.npz")
        options = ["--volume", str(tmp_path / "v.npz"), "--mu", str(tmp_path / "mu.npz"), "--center"]
    small = SMALL[4:] if centered else SMALL
    assert main(["project", str(small_workbook), *small, "--emission", *options, "-o", first]) == 0
    assert main(["project", first, "-o", second]) == 0
    runs = [mph.read_run(path) for path in (first, second)]
    assert runs[0].projections.max() > 0
    np.testing.assert_array_equal(runs[1].projections, runs[0].projections)
    if not centered:
        refused(lambda: next(mph.run_recipe(runs[0].recipe, volume=runs[0].volume)), "needs its mu as well")


@pytest.mark.long
@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_a_phantom_has_settings_apart_from_those_of_its_grid(kind, small_workbook, tmp_path, capsys):
    """Defrise's disks and the grid of points have a spacing, as the voxels have."""
    first, second = str(tmp_path / "a.h5"), str(tmp_path / "b.h5")
    small = ["--voxels", "14", "--spacing", "30", "31", "32", "--size", "6", "8", "--modules", "3"]
    assert main(["project", str(small_workbook), "--phantom", kind.name, *small, "-o", first]) == 0
    assert main(["project", first, "-o", second]) == 0
    runs = [mph.read_run(path) for path in (first, second)]
    expected = kind.phantom(**kind.usual).voxelize(runs[0].volume.grid)
    np.testing.assert_allclose(runs[0].volume.grid.spacing, (30, 31, 32))
    for run in runs:
        np.testing.assert_array_equal(run.volume.array, expected.array)
        assert run.recipe == runs[0].recipe and run.recipe["phantom.spacing"] == (30, 31, 32)


def test_every_entry_can_be_set_on_the_command_line(small_workbook, tmp_path, capsys, command):
    entries = ["model.kind=emission", "model.edge=path", "model.aperture_mu=2.5", "model.window=[60, 80]",
               "model.isotope=Tl-201", "phantom.kind=points", "phantom.counts=[2, 1, 1]"]  # fmt: skip
    words = [word for entry in entries for word in ("--set", entry)]
    assert main(["project", str(small_workbook), *words, "--write-recipe", str(tmp_path / "r.toml")]) == 0
    recipe = mph.read_recipe(tmp_path / "r.toml")
    assert (recipe["model.aperture_mu"], recipe["model.window"], recipe["phantom.counts"]) == (2.5, (60, 80), (2, 1, 1))
    command("project", tmp_path / "r.toml", "--set", "model.window=", "--write-recipe", tmp_path / "s.toml")
    assert "model.window" not in mph.read_recipe(tmp_path / "s.toml").given
    for wrong, said in (("a=1", "expected TABLE.NAME"), ("model.kind", "expected KEY=VALUE"), ("model.x=1", "no such")):
        words = ["project", small_workbook, "--set", wrong, "--write-recipe", tmp_path / "t.toml"]
        assert said in refused_command(capsys, *words)


def test_runs_of_states_draw_their_own_noise(tmp_path, small_workbook):
    for number in (1, 2):
        volume = mph.Volume(np.full((4, 4, 4), number), mph.Grid.centered(4, 9.0), "activity")
        mph.write_volume(volume, tmp_path / f"{number}.npz")
    recipe = Recipe({
        "system.file": str(small_workbook), "system.modules": "1",
        "volume.states": [str(tmp_path / f"{number}.npz") for number in (1, 2)],
        "model.kind": "emission", "detector.rows": 4, "detector.columns": 4, "noise.seed": 7,
    })  # fmt: skip
    runs = list(mph.run_recipe(recipe))
    drawn = [(run.seed, run.recipe["noise.seed"], run.settings["volume"]) for run in runs]
    assert drawn == [(7, 7, "1.npz"), (8, 8, "2.npz")]


def test_angles_and_matrix_say_the_same_pose(rng):
    for angles in (*rng.uniform(-180, 180, (5, 3)), (0, 0, 40), (20, 180, 0), (30, 90, -10)):
        pose = mph.euler_pose(*np.deg2rad(angles), (1, 2, 3))
        found = euler_degrees(pose)
        np.testing.assert_allclose(mph.euler_pose(*np.deg2rad(found), (1, 2, 3)), pose, atol=1e-12)
    both = Recipe({"phantom.matrix": pose.tolist(), "phantom.position": (1, 2, 3), "phantom.euler_degrees": found})
    np.testing.assert_allclose(phantom_pose(both), pose)
    moved = both.updated({"phantom.position": (0, 0, 0)})
    assert "phantom.matrix" not in moved.given
    refused(lambda: phantom_pose(Recipe({**both.given, "phantom.position": (0, 0, 0)})), "another pose")
    assert euler_degrees(np.diag([2.0, 1, 1, 1])) is None


@pytest.mark.parametrize("suffix", [".h5", ".npz", ".pt"])
def test_runs_of_version_0_1_0_open(suffix, tmp_path, capsys):
    if suffix == ".pt" and importlib.util.find_spec("torch") is None:
        pytest.skip("torch is not installed")
    run = mph.read_run(DATA / f"run-0.1.0{suffix}")
    assert run.projections.shape == (2, 6, 8) and run.unit == "counts" and run.seed == 7
    assert list(run.system.numbers) == [1, 41] and run.volume.array.shape == (10, 10, 10)
    assert run.settings["phantom"]["kind"] == "derenzo" and run.settings["euler_degrees"] == [10, 20, 30]
    model = mph.Emission(
        run.system, isotope="Tc-99m", aperture_mu="tungsten", time=600, hole="point", pixel_points=21, tolerance=9
    )
    means = mph.Projector(run.volume.grid, run.views, model)(run.volume)
    np.testing.assert_array_equal(mph.sample_counts(means, 7), run.projections)
    assert main(["project", str(DATA / f"run-0.1.0{suffix}"), "-o", str(tmp_path / "a.npz")]) == 1
    assert "the run holds no recipe" in capsys.readouterr().err


def test_a_recipe_of_version_0_1_0_means_what_it_meant():
    """Beside its run without noise, by that version's numpy backend; its voxels were a little less exact."""
    recipe = mph.read_recipe(DATA / "recipe-0.1.0.toml")
    assert recipe["noise.seed"] == 3 and recipe["model.aperture_points"] == 7
    old, recipe = mph.read_run(DATA / "recipe-0.1.0.npz"), recipe.updated({"noise.seed": None})
    (run,), (same,) = mph.run_recipe(recipe), mph.run_recipe(recipe, volume=old.volume)
    assert run.system.numbers.tolist() == [1, 7] and run.unit == old.unit
    assert run.volume.array.sum() == pytest.approx(old.volume.array.sum(), rel=1e-5)
    np.testing.assert_allclose(same.projections, old.projections, rtol=1e-5, atol=1e-3)
    np.testing.assert_allclose(run.projections, old.projections, atol=0.01 * old.projections.max())


def test_a_workbook_of_version_0_1_0_opens(workbook):
    system, original = mph.read_system(DATA / "workbook-0.1.0.xlsx"), mph.read_system(workbook)[[0, 40]]
    assert list(system.numbers) == [1, 41]
    np.testing.assert_allclose(system.centers, original.centers, rtol=0, atol=1e-9)
    np.testing.assert_allclose(system.collimator_length, original.collimator_length, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("entries", "said"),
    [
        ({"attenuation.object": "Body", "model.kind": "emission"}, "'Body' is in a Blender scene; give --mu FILE"),
        ({"volume.object": "CT mu"}, "'CT mu' is in a Blender scene; give --volume FILE"),
    ],
)
def test_what_only_a_scene_has_is_not_left_out(entries, said, small_workbook):
    with pytest.raises(mph.InputError, match=said):
        next(mph.run_recipe(Recipe({"system.file": str(small_workbook), "system.modules": "1", **entries})))


def test_every_argument_of_a_model_is_a_setting():
    models = mph.Emission, mph.Transmission, mph.SpectralScan
    names = {field.name for cls in models for field in dataclasses.fields(cls)}
    for cls in models:  # radiographs have one point of each pixel unless told otherwise
        for field in dataclasses.fields(cls):
            setting = SETTINGS.get(f"model.{field.name}")
            assert setting is None or setting.default == field.default or (cls, field.default) == (mph.Transmission, 1)
    names -= {
        "system",
        "mu",
        "photons_per_decay",
        "spectrum",
    }  # the recipe has tables of the first two; the rest follows
    declared = {key.removeprefix("model.").removesuffix("_degrees") for key in SETTINGS if key.startswith("model.")}
    assert names == declared - {"kind", "photons", "dead_time", "dead_time_kind"}  # which are no part of a linear model
    of_reconstruct = [key.startswith("reconstruction.") for key in SETTINGS]
    for is_reconstruct in (False, True):  # each command has options of its own
        options = [s.option for s, own in zip(SETTINGS.values(), of_reconstruct, strict=True) if own == is_reconstruct]
        assert len(set(options)) == len(options)


def test_counts_beside_the_crystal_are_said(system):
    volume = mph.Volume(np.ones((4, 4, 4), np.float32), mph.Grid.centered(4, 10.0))
    with pytest.warns(mph.InputWarning, match="wider than the crystal"):
        mph.project_run(system, volume, (4, 4), pitch=500.0, model=mph.Emission(system))
