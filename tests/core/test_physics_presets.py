"""Physics presets: each counts what a camera of its materials counts; they leave the acquisition alone."""

from __future__ import annotations

import pytest

import mphdrr.core as mph
from mphdrr.addon.cli import main
from mphdrr.core.runs.presets import PRESETS
from mphdrr.core.runs.recipe import Recipe
from mphdrr.core.runs.run_recipe import recipe_model

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
        expected = mph.Emission(system)
    else:
        isotope, aperture, crystal = PRESETS[name].label.split(", ")
        walls = {"within_cone": True, "within_walls": True, "within_crystal": True}
        expected = mph.Emission(
            system, isotope=isotope, aperture_mu=aperture.lower(), crystal_mu=crystal, aperture_points=7, **walls
        )
    assert model.record() == expected.record()


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
        "model.kind", "model.time", "model.pixel_points", "model.tolerance",
    }  # fmt: skip


def test_the_command_takes_a_preset_that_options_override(tmp_path, capsys):
    path = tmp_path / "run.toml"
    given = ["project", WORKBOOK, "--preset", "tl201-tungsten-nai", "--write-recipe", str(path)]
    assert main([*given, "--time", "60", "--set", "model.crystal_mu=CZT"]) == 0
    recipe = mph.read_recipe(path)
    assert (recipe["model.isotope"], recipe["model.crystal_mu"], recipe["model.time"]) == ("Tl-201", "CZT", 60)
    assert main([*given, "--transmission"]) == 1
    assert "model.kind = emission" in capsys.readouterr().err
