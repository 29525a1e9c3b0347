"""The Projections panel's physics in one choice, and by what the chosen volume holds."""

from __future__ import annotations

import itertools
from types import SimpleNamespace
from typing import Any

import bpy
import numpy as np
import pytest

from mphdrr.addon.runs import rendering, runs
from mphdrr.addon.runs.projection_properties import PROPERTIES, USUAL_TIME, _volume_chosen, recipe_values
from mphdrr.addon.scanner import scanner
from mphdrr.addon.volumes import volumes
from mphdrr.core.geometry.grid import Grid
from mphdrr.core.runs.presets import PRESETS
from mphdrr.core.runs.recipe import Recipe, write_recipe
from mphdrr.core.runs.run_recipe import recipe_model
from mphdrr.core.volumes.volume import Volume
from mphdrr.core.xray.arrangements import xray_arc


@pytest.fixture
def settings(scene):
    return scene.mphdrr_projections


@pytest.fixture
def objects(scene) -> dict[str, bpy.types.Object]:
    grid = Grid.centered((3, 3, 3), 10.0)
    return {q: volumes.add_volume(Volume(np.ones((3, 3, 3)), grid, q), q) for q in ("activity", "mu", "hu")}


@pytest.mark.parametrize("name", PRESETS)
def test_the_panel_shows_what_the_preset_says(settings, name):
    settings.isotope, settings.window, settings.depth_layers, settings.crystal_mu = "I-131", (300, 400), 4, 0.3
    settings.crystal_material, settings.intrinsic_fwhm, settings.noise = "NUMBER", 2.5, True
    assert bpy.ops.mphdrr.use_preset(preset=name) == {"FINISHED"}
    values = recipe_values(lambda key: getattr(settings, key))
    given = {f"model.{key}": value for key, value in PRESETS[name].model.items() if value is not None}
    assert {key: values[key] for key in given} == given
    assert values["model.kind"] == "emission" and values["model.time"] == USUAL_TIME
    assert values["model.window"] is None and values["model.depth_layers"] == 1
    assert values["model.intrinsic_fwhm"] == (0 if name == "ideal" else 2.5) and values["noise.seed"] == 1
    if name == "ideal":
        assert values["model.isotope"] is values["model.crystal_mu"] is values["model.aperture_mu"] is None


def test_a_volume_chosen_in_the_panel_sets_the_model_until_the_user_does(settings, objects):
    def choose(name: str) -> tuple[str, float]:
        settings.volume = objects[name]
        _volume_chosen(settings, SimpleNamespace(region=SimpleNamespace(type="UI")))
        return settings.model, settings.time

    assert choose("activity") == ("EMISSION", USUAL_TIME)
    assert choose("mu")[0] == "TRANSMISSION"
    settings.time = 20.0
    assert choose("hu")[0] == "TRANSMISSION"  # to be converted first
    assert choose("activity") == ("EMISSION", 20.0), "a time that was typed stays"
    settings.model = "TRANSMISSION"  # line integrals of activity, as the user wants
    assert choose("mu")[0] == choose("activity")[0] == "TRANSMISSION"


def test_scripts_get_line_integrals_unless_they_say_otherwise(settings, objects):
    settings.volume = objects["activity"]
    assert settings.model == "TRANSMISSION" and settings.time == 1.0


def test_a_radiograph_of_activity_is_said(settings, objects):
    def said(**values: Any) -> bool:
        for name, value in values.items():
            setattr(settings, name, value)
        return rendering.integrates_activity(bpy.context)

    volumes.make_active(bpy.context, objects["activity"])
    assert said()
    assert not said(volume=objects["mu"]) and said(volume=objects["activity"]) and said(volume=None)
    assert not said(model="EMISSION") and not said(model="TRANSMISSION", photons=1e5) and said(photons=0.0)
    volumes.make_active(bpy.context, objects["mu"])
    assert not said()


def test_a_recipe_says_the_model_whatever_its_volume_holds(settings, objects, tmp_path):
    write_recipe(Recipe({"volume.object": "activity"}), tmp_path / "a.toml")
    settings.volume = objects["mu"]
    assert bpy.ops.mphdrr.load_recipe(filepath=str(tmp_path / "a.toml")) == {"FINISHED"}
    assert settings.volume == objects["activity"] and settings.model == "TRANSMISSION"


def test_modules_are_one_text_that_stands_for_an_earlier_versions_range(settings):
    """Files, drivers and scripts of earlier versions have first and last; 0 is the lowest or the highest."""
    assert settings.modules == ""
    settings.first, settings.last = 3, 5
    assert settings.modules == runs.panel_recipe(settings.id_data)["system.modules"] == "3-5"
    settings.first = 0
    assert settings.modules == "-5"
    settings.modules = "1-2, 7"
    assert (settings.first, settings.last) == (0, 0)
    assert settings.modules == runs.panel_recipe(settings.id_data)["system.modules"] == "1-2, 7"
    settings.modules = ""
    assert runs.panel_recipe(settings.id_data)["system.modules"] is None


@pytest.mark.parametrize("name", list(PRESETS)[::5])
def test_a_preset_goes_with_every_choice_of_the_panel(settings, objects, ring_system, name):
    """What is chosen in any menu or by any switch before the preset or after it, the panel's model is made."""
    collection = scanner.build_scanner(settings.id_data, ring_system)
    for key in PROPERTIES:
        kind = settings.bl_rna.properties[key]
        values = [item.identifier for item in kind.enum_items] if kind.type == "ENUM" else []
        values += [True] if kind.type == "BOOLEAN" else []
        for value, is_after in itertools.product(values, (True, False)):
            for other in PROPERTIES:
                settings.property_unset(other)
            if is_after:
                bpy.ops.mphdrr.use_preset(preset=name)
            setattr(settings, key, value)
            if not is_after:
                bpy.ops.mphdrr.use_preset(preset=name)
            if settings.isotope == "NONE":  # at whose energy would materials attenuate? That is refused, and must be
                settings.aperture_material = settings.crystal_material = "NUMBER"
            is_of_pinholes = settings.model != "SPECTRAL"
            system = scanner.read_scanner(collection) if is_of_pinholes else xray_arc(2)
            recipe_model(runs.panel_recipe(settings.id_data), system)
