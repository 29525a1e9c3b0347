"""Physics presets: each counts what a camera of its materials counts; they leave the acquisition alone."""

from __future__ import annotations

import itertools
import math

import pytest

import mphdrr.core as mph
from mphdrr.addon.cli import main
from mphdrr.core.runs.presets import PRESETS
from mphdrr.core.runs.recipe import Recipe, fitting_recipe, recipe_from_tables, recorded_recipe
from mphdrr.core.runs.run_recipe import recipe_model
from mphdrr.core.runs.settings import SETTINGS

WORKBOOK = "examples/dc-spect-80.xlsx"
RUN = {
    "phantom.kind": "nema", "phantom.voxels": (8,), "detector.rows": 6,
    "detector.columns": 6, "model.pixel_points": 3, "model.tolerance": 9.0,
}  # fmt: skip


@pytest.fixture(scope="module")
def system() -> mph.PinholeSystem:
    return mph.read_system(WORKBOOK)[::20]


def counts(recipe: Recipe, system: mph.PinholeSystem) -> float:
    (run,) = mph.run_recipe(recipe, system)
    return float(run.projections.sum())


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_is_the_model_of_its_materials(system, name):
    model = recipe_model(Recipe().updated(PRESETS[name].changes), system)
    if name == "ideal":
        expected = mph.Emission(system, hole="point")
    else:
        isotope, aperture, crystal = PRESETS[name].label.split(", ")
        walls = {"within_cone": True, "within_walls": True, "within_crystal": True}
        expected = mph.Emission(system, isotope=isotope, aperture_mu=aperture.lower(), crystal_mu=crystal, **walls)
    assert model.record() == expected.record()


@pytest.mark.long
def test_crystals_and_apertures_count_as_their_materials_stop_photons(system):
    """NaI stops fewer of Tc-99m's photons than CZT; the edge of lead lets more pass than that of tungsten."""
    czt, nai, lead = (
        counts(Recipe(RUN).updated(PRESETS[f"tc99m-{name}"].changes), system)
        for name in ("tungsten-czt", "tungsten-nai", "lead-nai")
    )
    assert 0 < nai < czt and nai < lead


def test_a_preset_leaves_the_acquisition_alone_and_takes_other_physics_away(system):
    acquired = {"model.kind": "emission", "model.time": 300.0, "model.intrinsic_fwhm": 3.0, "noise.seed": 4}
    before = Recipe({**RUN, **acquired, "model.isotope": "Tl-201", "model.window": (60, 90), "model.depth_layers": 3,
                     "model.crystal_mu": "NaI"})  # fmt: skip
    after = before.updated(PRESETS["tc99m-lead-nai"].changes)
    assert {key: after[key] for key in acquired} == acquired
    assert (after["model.isotope"], after["model.window"], after["model.depth_layers"]) == ("Tc-99m", None, 1)
    ideal = before.updated(PRESETS["ideal"].changes)
    assert {key for key in ideal.given if key.startswith("model.")} == {
        "model.kind", "model.time", "model.hole", "model.pixel_points", "model.tolerance",
    }  # fmt: skip


def test_the_command_takes_a_preset_that_options_override(tmp_path, capsys):
    path = tmp_path / "run.toml"
    given = ["project", WORKBOOK, "--preset", "tl201-tungsten-nai", "--write-recipe", str(path)]
    assert main([*given, "--time", "60", "--set", "model.crystal_mu=CZT"]) == 0
    recipe = mph.read_recipe(path)
    assert (recipe["model.isotope"], recipe["model.crystal_mu"], recipe["model.time"]) == ("Tl-201", "CZT", 60)
    assert main([*given, "--transmission"]) == 1
    assert "model.kind = emission" in capsys.readouterr().err


def states() -> list[tuple[str, object]]:
    """Return every setting of model, detector and noise with what it may be: its words, and numbers small and large."""
    found: list[tuple[str, object]] = []
    for key, setting in SETTINGS.items():
        if not key.startswith(("model.", "detector.", "noise.")):
            continue
        values: list[object] = list(setting.words)
        if setting.kind is bool:
            values += [False, True]
        elif key == "model.window":
            values += [(10.0, 1000.0)]  # of whatever is counted
        elif setting.kind in (int, float):
            least = setting.above if setting.least is None else setting.least
            numbers = [(least or 0.0) + 2, (least or 0.0) + 7, setting.default]
            most = setting.most or math.inf
            values += [setting.kind(number) for number in numbers if number is not None and number <= most]
        found += [(key, value) for value in values]
    return found


STATES = states()


def accepted(values: dict[str, object], system: mph.PinholeSystem) -> None:
    """Check that recipe and model understand what the panel asks for, and the next version a run's record of it."""
    recipe = fitting_recipe(values)
    if not recipe["model.isotope"]:  # a material attenuates as its photons do: without any it is refused, and must be
        numbers = {"model.aperture_mu": 3.6, "model.crystal_mu": 0.4}
        recipe = recipe.updated({key: numbers[key] for key in numbers if isinstance(recipe[key], str)})
    recipe_model(recipe, mph.xray_arc(2) if recipe["model.kind"] == "spectral" else system)
    kept = recorded_recipe(recipe)
    assert recipe_from_tables(kept.tables()) == kept


BEFORE = {"model.kind": "emission", "model.isotope": "I-123", "model.aperture_mu": "lead", "model.crystal_mu": "NaI"}


@pytest.mark.parametrize("name", list(PRESETS)[::3])
def test_no_preset_and_state_of_the_panel_refuse_each_other(system, name):
    """All pairs, in either order."""
    changes = PRESETS[name].changes
    for key, value in STATES:
        accepted({**BEFORE, key: value, **changes}, system)
        accepted({**BEFORE, **changes, key: value}, system)
    for word in SETTINGS["model.hole"].words:  # as the command has it: an option is meant, and what it leaves goes
        recipe = Recipe().updated(changes).updated({"model.hole": word})
        assert recipe["model.hole"] == word and recipe_model(recipe, system).hole == word


def test_no_two_states_of_the_panel_refuse_each_other_after_a_preset(system):
    changes = PRESETS["i123-tungsten-czt"].changes
    for (key, value), (other, another) in itertools.combinations(
        [s for s in STATES if s[0].startswith("model.")][::2], 2
    ):
        if key != other:
            accepted({**BEFORE, **changes, key: value, other: another}, system)


@pytest.mark.parametrize("hole", list(SETTINGS["model.hole"].words))
def test_the_command_takes_a_preset_beside_every_hole(hole, tmp_path):
    path = tmp_path / "run.toml"
    given = ["project", WORKBOOK, "--preset", "tc99m-lead-nai", "--hole", hole, "--write-recipe", str(path)]
    assert main(given) == 0
    recipe = mph.read_recipe(path)
    assert recipe["model.hole"] == hole and recipe["model.isotope"] == "Tc-99m"
    recipe_model(recipe, mph.read_system(WORKBOOK))


def test_recipes_that_say_defaults_without_an_effect_are_read(system, tmp_path):
    """As runs of earlier versions have recorded them."""
    tables = {"model": {"kind": "emission", "hole": "depth", "aperture_points": 1, "edge": "paix", "depth_layers": 1}}
    for points in (1, 7):
        tables["model"]["aperture_points"] = points
        recipe = recipe_from_tables(tables, recorded=True)
        assert recipe["model.hole"] == "depth" and recipe_model(recipe, system).hole == "depth"
        with pytest.raises(
            mph.InputError, match=r"model.aperture_points \(--aperture-points\) needs model.hole = rays"
        ):
            recipe_from_tables(tables)


def test_recipes_of_before_that_have_numbers_of_rays_mean_rays(system):
    """Nothing was said of the hole: its blur was that of so many points."""
    for name, value in {"aperture_points": 7, "aperture_tolerance": 0.2, "pixel_points": 3, "tolerance": 0.1}.items():
        recipe = Recipe({"model.kind": "emission", f"model.{name}": value})
        assert recipe["model.hole"] == "rays" and recipe_model(recipe, system).hole == "rays"
    assert Recipe({"model.kind": "emission"})["model.hole"] == "auto"
    assert Recipe({"model.pixel_points": 3})["model.kind"] == "transmission"
