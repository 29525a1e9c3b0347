"""Projections from the scene: the operator's images and file equal core's."""

from __future__ import annotations

import re
import warnings

import bpy
import numpy as np
import pytest

from mphdrr.addon.blender import ids, jobs, storage
from mphdrr.addon.pictures import images
from mphdrr.addon.runs import runs
from mphdrr.addon.runs.projection_properties import PROPERTIES, ProjectionSettings
from mphdrr.addon.scanner import scanner
from mphdrr.addon.volumes import volumes
from mphdrr.core import memory
from mphdrr.core.errors import InputError
from mphdrr.core.geometry.grid import Grid
from mphdrr.core.geometry.system import PinholeSystem
from mphdrr.core.physics.ct_numbers import hu_to_mu
from mphdrr.core.physics.noise import sample_counts
from mphdrr.core.progress import Cancelled
from mphdrr.core.projector import Emission, InverseSquareSum, Projector, intensity
from mphdrr.core.runs.files import read_run
from mphdrr.core.runs.mosaic import as_seen
from mphdrr.core.runs.recipe import write_recipe
from mphdrr.core.runs.run import ProjectionRun
from mphdrr.core.runs.settings import SAMPLING, SETTINGS
from mphdrr.core.volumes.volume import Volume
from mphdrr.panels.projections import MPHDRR_PT_physics

from .conftest import Drawn, pixels, refused, reopened, update


@pytest.fixture
def scanned(derenzo, ring_system) -> PinholeSystem:
    return ring_system


def render(**settings) -> ProjectionRun:
    """Render the projections of the panel with these settings, and return their run."""
    assert bpy.ops.mphdrr.render_projections(**settings) == {"FINISHED"}
    return read_run(storage.absolute(bpy.context.scene.mphdrr_projections.run_file))


def _ours() -> list[str]:
    """Return the names of the exact images and the mosaic, without the modules' pictures."""
    names = [image.name for image in bpy.data.images if image.name.startswith("mphDRR")]
    return sorted(name for name in names if not name.endswith(" picture"))


def first_image() -> np.ndarray:
    return images.projection_array(bpy.data.images["mphDRR 01"])


@pytest.mark.parametrize("detector", ["VIRTUAL", "REAL"])
def test_images_hold_exactly_what_core_projects(scanned, detector):
    render(width=24, height=20, detector=detector)
    volume = volumes.volume_from_object(bpy.data.objects["Derenzo"])
    expected = Projector(volume.grid, scanned.views((20, 24), detector.lower()))(volume)
    assert expected.max() > 0
    for m, number in enumerate(scanned.numbers):
        image = bpy.data.images[ids.projection_name(number, 8)]
        assert image.colorspace_settings.name == "Non-Color" and tuple(image.size) == (24, 20) and image.is_float
        assert np.array_equal(images.projection_array(image), expected[m])
        shown = pixels(image)[::-1]  # as the pinhole sees them; Blender's rows start at the bottom
        assert np.all(shown[..., 3] == 1)
        assert all(np.array_equal(shown[..., channel], as_seen(expected[m])) for channel in range(3))


@pytest.fixture
def body(scanned) -> Volume:
    """Add an attenuation volume to the scene, on its own grid, moved and rotated."""
    volume = Volume(np.full((4, 5, 6), 0.0154), Grid.centered((4, 5, 6), 20.0), "mu")
    item = volumes.add_volume(volume, "Body")
    item.location.x, item.rotation_euler.z = 6.0, 0.3
    update()
    return volumes.volume_from_object(item)


# Settings of the panel, and the same in Python.
PHYSICS = {
    "isotope": "Tc-99m", "aperture_points": 3, "aperture_mu": 3.6, "opening_angle": np.float32(1.4), "edge": "PATH",
    "crystal_mu": 0.404, "depth_layers": 2, "intrinsic_fwhm": 3.0, "within_cone": True, "within_walls": True,
    "within_crystal": True, "time": 600.0, "pixel_points": 2, "hole": "RAYS",
}  # fmt: skip
IN_PYTHON = PHYSICS | {"edge": "path", "opening_angle": 1.4, "hole": "rays"}


def test_physics_of_the_panel_is_that_of_core(scanned, scene, body):
    """Images equal core's, and the run records every setting, the volume of mu and the seed."""
    settings, views = scene.mphdrr_projections, scanned.views((20, 24))
    shape = scene.mphdrr_geometry.scanner.mphdrr_scanner  # whose collimators are drawn so, too
    settings.width, settings.height = 24, 20
    volume = volumes.volume_from_object(bpy.data.objects["Derenzo"])
    run = render(model="EMISSION", time=60)
    expected = Projector(volume.grid, views, Emission(scanned, time=60))(volume)
    assert expected.max() > 0
    np.testing.assert_array_equal(run.projections, expected)
    assert (run.unit, run.settings["model"], run.settings["time"]) == ("counts", "emission", 60)
    run = render(photons=1000)  # of the only volume of mu
    expected = intensity(Projector(body.grid, views)(body), 1000)
    np.testing.assert_array_equal(run.projections, expected)
    assert (run.unit, run.seed) == ("photons", None) and expected.min() < 900
    run = render(volume="Body", model="INVERSE_SQUARE")
    np.testing.assert_array_equal(run.projections, Projector(body.grid, views, InverseSquareSum(scanned))(body))
    settings.model, settings.noise, settings.seed, settings.mu = "EMISSION", True, 5, bpy.data.objects["Body"]
    for name, value in PHYSICS.items():
        setattr(shape if name == "opening_angle" else settings, name, value)
    run = render()
    expected = Projector(volume.grid, views, Emission(scanned, body, **IN_PYTHON))(volume)
    assert expected.max() > 0
    np.testing.assert_array_equal(run.projections, sample_counts(expected, 5))
    np.testing.assert_array_equal(first_image(), run.projections[0])
    assert (run.seed, run.settings["volume"]) == (5, "Derenzo")
    assert {name: run.settings[name] for name in IN_PYTHON} == IN_PYTHON
    assert (run.recipe["attenuation.object"], run.recipe["noise.seed"]) == ("Body", 5)


def test_numbers_of_modules_are_texts_of_the_panel(scanned, scene, tmp_path):
    """Times, starts, efficiencies: of the panel as of a recipe, and back from one; in files, too."""
    settings, count = scene.mphdrr_projections, len(scanned)
    efficiency = np.ones((count, 4, 6))
    efficiency[0, 1, 2] = 0
    np.save(tmp_path / "e.npy", efficiency)
    settings.width, settings.height = 6, 4
    times = [10.0 + 5 * m for m in range(count)]
    settings.model, settings.isotope, settings.start, settings.dead_time = "EMISSION", "Tc-99m", 60.0, 2.0
    settings.time_of_modules, settings.efficiency_of_modules = ", ".join(map(str, times)), str(tmp_path / "e.npy")
    run = render()
    assert run.recipe["model.time"] == tuple(times) and run.recipe["model.start"] == 60.0
    assert run.recipe["model.dead_time"] == 2.0 and run.recipe["model.dead_time_kind"] == "non-paralysable"
    np.testing.assert_array_equal(run.efficiency, efficiency)
    assert run.projections[0, 1, 2] == 0
    assert runs.changes(scene) == []
    settings.time_of_modules = settings.efficiency_of_modules = ""
    settings.start = settings.dead_time = 0.0
    assert runs.changes(scene) != []
    assert bpy.ops.mphdrr.load_recipe(filepath=storage.absolute(settings.run_file).as_posix()) == {"FINISHED"}
    assert settings.time_of_modules.startswith("10.0, 15.0") and runs.changes(scene) == []
    for text, words in (("10, 20", "time: expected one number, or"), ("10, soon", "Time: expected a number above 0")):
        settings.time_of_modules = text
        refused(bpy.ops.mphdrr.render_projections, words)


def test_frames_are_texts_of_the_panel_and_a_run_each(scanned, scene, tmp_path):
    settings = scene.mphdrr_projections
    (tmp_path / "r.toml").write_text(
        "[model]\nkind = 'emission'\nisotope = 'F-18'\nhole = 'point'\n[detector]\nrows = 4\ncolumns = 6\n"
        "[frames]\ntimes = [10.0, 20.0, 2.5]\nstarts = [0.0, 10.0, 5000.0]\n"
    )
    assert bpy.ops.mphdrr.load_recipe(filepath=str(tmp_path / "r.toml")) == {"FINISHED"}
    assert (settings.frame_times, settings.frame_starts) == ("10, 20, 2.5", "0, 10, 5000")
    render()
    assert [run.is_kept for run in settings.runs] == [True, True, False] and runs.changes(scene) == []
    frames = [read_run(storage.absolute(run.file)) for run in settings.runs]
    assert [run.recipe["model.time"] for run in frames] == [10.0, 20.0, 2.5]
    total = np.array([run.projections.sum() for run in frames])
    decay = np.log(2) / (109.77 * 60)
    law = np.exp(-decay * np.array([0, 10, 5000])) * -np.expm1(-decay * np.array([10, 20, 2.5]))
    np.testing.assert_allclose(total / total[0], law / law[0], rtol=1e-5)
    settings.frame_times = "10, soon"
    refused(bpy.ops.mphdrr.render_projections, "Frame Times")


def test_materials_of_the_panel_are_those_of_core(scanned, scene):
    """Chosen materials attenuate the isotope's photons; a coefficient given by a script takes precedence."""
    settings = scene.mphdrr_projections
    settings.model, settings.isotope = "EMISSION", "Tl-201"
    settings.aperture_material, settings.crystal_material = "tungsten", "NaI"
    for given, aperture in (({}, "tungsten"), ({"aperture_mu": 5.0}, 5.0)):
        model = Emission(scanned, isotope="Tl-201", aperture_mu=aperture, crystal_mu="NaI")
        record = render(width=4, height=4, **given).settings
        # With the scene's modules, whose numbers are float32.
        expected = model.aperture_mu, model.crystal_mu
        assert (record["aperture_mu"], record["crystal_mu"]) == pytest.approx(expected, rel=1e-6)
        recorded = record["recipe"]["model"]  # materials by name
        assert (recorded["aperture_mu"], recorded["crystal_mu"]) == (aperture, "NaI")


RAYS = {"pixel_points", "tolerance"}


@pytest.mark.parametrize(
    ("model", "hole", "numbers"),
    [
        ("EMISSION", "AUTO", set()),
        ("EMISSION", "DEPTH", set()),
        ("EMISSION", "RAYS", {"aperture_points", "aperture_tolerance", *RAYS}),
        ("EMISSION", "POINT", RAYS),
        ("TRANSMISSION", "AUTO", RAYS),
        ("INVERSE_SQUARE", "AUTO", set()),
    ],
)
def test_physics_and_numbers_of_rays_are_shown_where_they_are_used(scanned, scene, model, hole, numbers):
    settings = scene.mphdrr_projections
    settings.model, settings.hole, settings.photons = model, hole, 100
    assert MPHDRR_PT_physics.poll(bpy.context) == (model != "INVERSE_SQUARE")
    names = ("MPHDRR_PT_projections", "MPHDRR_PT_physics", "MPHDRR_PT_advanced")
    first, *others = (Drawn(name, is_polled=False).properties for name in names)
    shown = {name: owner for properties in others for name, owner in properties.items()}
    assert all(name in owner.bl_rna.properties for name, owner in (first | shown).items())
    assert {"noise", "seed"} <= shown.keys()
    of_counts = {"mu", *PHYSICS} - {"time", "hole", "aperture_points", "pixel_points"}  # above, or not shown
    assert (of_counts <= shown.keys()) == (model == "EMISSION")
    assert {key.partition(".")[2] for key in SAMPLING} & (first | shown).keys() == numbers
    assert ("hole" in first) == (model == "EMISSION"), "the choice itself is easily found"


@pytest.mark.parametrize(
    ("hole", "numbers", "expected"),
    [
        ("AUTO", {}, ("auto", None, None)),
        ("AUTO", {"aperture_points": 3, "pixel_points": 1}, ("rays", 3, 1)),  # as in recipes and in Python
        ("RAYS", {"pixel_points": 1}, ("rays", None, 1)),
        ("POINT", {"pixel_points": 1}, ("point", None, 1)),
    ],
)
def test_numbers_of_rays_that_a_script_gives_mean_rays(scanned, scene, hole, numbers, expected):
    scene.mphdrr_projections.hole = hole
    recipe = render(width=4, height=4, last=2, model="EMISSION", **numbers).recipe
    assert tuple(recipe[f"model.{name}"] for name in ("hole", "aperture_points", "pixel_points")) == expected


def test_numbers_that_the_panel_does_not_show_are_not_used(scanned, scene):
    settings = scene.mphdrr_projections
    settings.model, settings.aperture_points, settings.pixel_points, settings.tolerance = "EMISSION", 7, 3, 0.5
    recipe = render(width=4, height=4, last=2).recipe
    assert recipe["model.hole"] == "auto" and not recipe.given.keys() & set(SAMPLING)


HOW = r"hu_to_mu\(volume, energy\), .*CT to Attenuation in Blender's Phantom panel"
COUNTS = {"model": "EMISSION"}
REFUSALS = [
    ({"first": 900, "last": 910}, "no module 900-910; there are 1 to 8"),
    ({"volume": "Nope"}, "no volume is named 'Nope'; there are: Body, CT, Derenzo"),
    ({"width": 300, "height": 300}, "8 images of 300 x 300 pixels needs? .* of memory"),
    ({"aperture_points": 2, **COUNTS}, "3 or more"),
    ({"edge": "PATH", **COUNTS}, "Knife Edge needs Aperture"),
    ({"aperture_material": "lead", **COUNTS}, "aperture_mu 'lead': at which energy"),
    ({"depth_layers": 2, **COUNTS}, "Depth Layers needs Crystal"),
    ({"mu": "Nope", **COUNTS}, "no volume is named 'Nope'"),
    ({"mu": "Derenzo", **COUNTS}, "volume of mu"),
    ({"mu": "CT", **COUNTS}, f"'CT' for attenuation: expected a volume of mu, got hu; .*{HOW}"),
    ({"volume": "CT", **COUNTS}, "'CT' for emission: expected a volume of activity"),
    ({"volume": "Body", **COUNTS}, "'Body' for emission: expected a volume of activity"),
    ({"volume": "sensitivity"}, "'sensitivity' for transmission: expected a volume of activity or mu, got sensitivity"),
    ({"volume": "resolution"}, "'resolution' for transmission: expected a volume of activity or mu, got resolution"),
]


def test_what_cannot_be_projected_is_one_clear_line_and_changes_nothing(scanned, scene, ct, body, monkeypatch):
    for quantity in ("sensitivity", "resolution"):
        volumes.add_volume(Volume(np.ones((4, 4, 4)), Grid.centered(4, 9.0), quantity), quantity)
    volumes.make_active(bpy.context, bpy.data.objects["Derenzo"])
    assert render(width=8, height=8, model="EMISSION").volume is not None  # the phantom's, the only activity
    before = _ours(), [run.file for run in scene.mphdrr_projections.runs]
    with monkeypatch.context() as patch:
        patch.setattr(memory, "available", lambda: 2**20)
        for settings, words in REFUSALS:
            refused(bpy.ops.mphdrr.render_projections, words, **{"width": 8, "height": 8} | settings)
    for name, property_ in (("Derenzo", "volume"), ("Body", "mu")):  # Blender keeps a deleted one in the panel
        item = bpy.data.objects[name]
        setattr(scene.mphdrr_projections, property_, item)
        home = item.users_collection[0].objects
        home.unlink(item)
        refused(bpy.ops.mphdrr.render_projections, f"'{name}' is not in this scene any more", **COUNTS)
        home.link(item)
    volumes.file_of(bpy.data.objects["Derenzo"]).unlink()
    refused(bpy.ops.mphdrr.render_projections, "gone", **COUNTS)
    assert (_ours(), [run.file for run in scene.mphdrr_projections.runs]) == before
    assert storage.absolute(scene.mphdrr_projections.run_file).is_file()
    refused(bpy.ops.mphdrr.ct_to_attenuation, "No CT is active")


def test_no_scanner_and_no_volume_are_clear_errors(scene, ring_system):
    refused(bpy.ops.mphdrr.render_projections, "no scanner in the scene")
    scanner.build_scanner(scene, ring_system, "Ring")
    refused(bpy.ops.mphdrr.render_projections, "no volume of activity or mu in the scene")


def test_rendering_again_replaces_the_images_but_no_foreign_one_of_the_same_name(scanned, scene):
    foreign = bpy.data.images.new("mphDRR 01", 4, 4)
    render(width=24, height=20)
    assert tuple(foreign.size) == (4, 4) and foreign.name != "mphDRR 01"
    bpy.data.images.remove(foreign)
    first = _ours()
    assert len(first) == 9  # eight modules and the mosaic
    render(width=16, height=16)
    assert _ours() == first and tuple(bpy.data.images["mphDRR 01"].size) == (16, 16)
    settings = scene.mphdrr_projections
    settings.width, settings.height, settings.last = 12, 10, 2
    render(height=14)  # what is left out is the panel's
    assert len(_ours()) == 3 and tuple(bpy.data.images["mphDRR 01"].size) == (12, 14)


def test_images_and_arrays_survive_save_and_reopen(scanned, tmp_path):
    render(width=24, height=20)
    before = first_image()
    scene = reopened(tmp_path / "study.blend")
    assert np.array_equal(first_image(), before)
    run_file = scene.mphdrr_projections.run_file
    assert re.fullmatch(r"//study_mphdrr/Scene-projections-[0-9a-f]{8}\.h5", run_file)
    run = read_run(storage.absolute(run_file))
    assert np.array_equal(run.projections[0], before)
    assert run.recipe["phantom.kind"] == "derenzo" and run.recipe["phantom.rod_diameters"] == (10, 8, 0, 0, 0, 0)
    render(width=24, height=20)
    assert np.array_equal(first_image(), before), "the reopened scene can be projected again, to the last bit"
    bpy.data.objects["Derenzo"].location.z += 10
    render(width=24, height=20)
    rows = np.arange(20)[:, None]
    heights = [(image * rows).sum() / image.sum() for image in (before, first_image())]
    assert heights[1] > heights[0] + 0.5, "a moved phantom is projected where it is"
    (tmp_path / "sub").mkdir()
    run_file = reopened(tmp_path / "sub" / "b.blend").mphdrr_projections.run_file
    assert run_file.startswith("//") and storage.absolute(run_file).is_file()


@pytest.mark.parametrize("end", [jobs.stop, lambda: bpy.ops.wm.read_homefile(use_factory_startup=True)])
def test_stopping_or_loading_a_file_ends_the_thread_of_the_running_job(monkeypatch, end):
    def work(progress):
        while True:
            progress(0, 1)

    before = warnings.showwarning, list(warnings.filters)
    run = jobs.Worker("Test", work)
    run.start()
    monkeypatch.setattr(jobs, "_current", run)
    assert jobs.is_running()
    end()
    assert isinstance(run.error, Cancelled) and not run.is_alive() and not jobs.is_running()
    assert (warnings.showwarning, list(warnings.filters)) == before


@pytest.mark.parametrize(
    ("kind", "arguments", "message"),
    [
        (InputError, ("the very line",), "the very line"),
        (MemoryError, (), "not enough memory"),
        (KeyError, "x", "KeyError"),
    ],
)
def test_errors_in_the_work_become_readable_reports(scanned, monkeypatch, kind, arguments, message):
    def fail(*_):
        # Made here: an error kept by the parameters would keep its traceback, and with it bpy, until Python has ended.
        raise kind(*arguments)

    monkeypatch.setattr(volumes, "reader", lambda item: fail)
    with pytest.raises(RuntimeError, match=message):
        bpy.ops.mphdrr.render_projections(width=8, height=8)
    assert _ours() == []


@pytest.fixture
def ct(scanned, scene) -> bpy.types.Object:
    """Add a CT beside the phantom, active."""
    array = np.full((9, 10, 11), -1000.0, np.float32)
    array[2:7, 2:7, 2:7] = 55.0
    item = volumes.add_volume(Volume(array, Grid.centered(array.shape, 8.0), "hu"), "CT")
    volumes.make_active(bpy.context, item)
    return item


@pytest.mark.parametrize(
    ("chosen", "settings"), [("named", {}), ("panel", {"photons": 1000.0}), ("active", {"model": "INVERSE_SQUARE"})]
)
def test_a_ct_is_no_radiograph_until_it_is_converted(scene, scanned, ct, chosen, settings):
    given = {"width": 8, "height": 8, **settings, **({"volume": "CT"} if chosen == "named" else {})}
    scene.mphdrr_projections.volume = ct if chosen == "panel" else None
    refused(bpy.ops.mphdrr.render_projections, f"'CT' for .*: expected a volume of .*mu, got hu; .*{HOW}", **given)
    assert _ours() == [] and not scene.mphdrr_projections.run_file
    scene.mphdrr_projections.volume = None
    assert bpy.ops.mphdrr.ct_to_attenuation(energy=60.0) == {"FINISHED"}
    item = bpy.context.object
    assert item.name == "CT mu" and item.mphdrr_volume.quantity == "mu" and ct.mphdrr_volume.quantity == "hu"
    assert np.array_equal(volumes.volume_from_object(item).array, hu_to_mu(volumes.volume_from_object(ct), 60.0).array)
    run = render(width=8, height=8, **settings)
    assert run.settings["volume"] == "CT mu" and run.unit == ("photons" if "photons" in settings else "1/mm mm")


def test_a_moved_ct_is_converted_where_it_is_and_in_every_state(scene, scanned):
    states = [Volume(np.full((4, 5, 6), 10.0 * k), Grid.centered((4, 5, 6), 7.0), "hu") for k in range(3)]
    item = volumes.add_volume(states, "Breath", frame_start=4)
    item.location.x += 12.5
    item.rotation_euler.z = 0.3
    update()
    volumes.make_active(bpy.context, item)
    bpy.ops.mphdrr.ct_to_attenuation()
    converted = bpy.context.object
    assert converted.data.is_sequence and converted.data.frame_start == 4
    for k in range(3):
        scene.frame_set(4 + k)
        expected, mu = hu_to_mu(volumes.volume_from_object(item)), volumes.volume_from_object(converted)
        assert np.array_equal(mu.array, expected.array)
        np.testing.assert_allclose(mu.grid.affine, expected.grid.affine, atol=1e-9)


def test_ct_numbers_attenuate_each_line_of_the_isotope(scene, scanned, ct):
    settings = scene.mphdrr_projections
    settings.model, settings.isotope, settings.window, settings.energy_fwhm = "EMISSION", "In-111", (150, 270), 0.1
    settings.mu = ct
    run = render(width=12, height=10, volume="Derenzo")
    volume, mu = (volumes.volume_from_object(item) for item in (bpy.data.objects["Derenzo"], ct))
    model = Emission(scanned, mu, isotope="In-111", window=(150, 270), energy_fwhm=0.1)
    assert len(model.parts()) == 2
    np.testing.assert_array_equal(run.projections, Projector(volume.grid, scanned.views((10, 12)), model)(volume))
    settings.mu, settings.lines = None, "APART"
    assert render(width=12, height=10, volume="Derenzo").recipe["model.lines"] == "apart"


@pytest.mark.long
@pytest.mark.parametrize("source", ["phantom", "ct"])
def test_attenuation_at_another_energy_is_said(scanned, scene, source, capfd):
    if source == "phantom":
        bpy.ops.mphdrr.add_nema(voxels=16, attenuation=True, name="Body")
        mu = next(o for o in volumes.volume_objects(scene) if o.mphdrr_volume.quantity == "mu")
    else:
        air = Volume(np.zeros((4, 4, 4)), Grid.centered(4, 30.0), "hu")
        volumes.make_active(bpy.context, volumes.add_volume(air, "CT"))
        bpy.ops.mphdrr.ct_to_attenuation()
        mu = bpy.context.object
    for isotope, is_said in (("Tc-99m", False), ("I-131", True)):
        capfd.readouterr()
        render(width=4, height=4, last=1, isotope=isotope, model="EMISSION", volume="Derenzo", mu=mu.name)
        assert (f"the mu of '{mu.name}' holds at 140.5 keV" in "".join(capfd.readouterr())) == is_said


def _panel(settings) -> dict:
    """Return every property of the panel, except volumes and the last run."""
    values = {name: getattr(settings, name) for name in ProjectionSettings.__annotations__}
    return {k: tuple(v) if isinstance(v, bpy.types.bpy_prop_array) else v for k, v in values.items()}


@pytest.mark.parametrize("saved", [pytest.param("run", marks=pytest.mark.long), "toml"])
def test_the_recipe_of_a_run_sets_the_panel_as_it_was(scanned, scene, body, tmp_path, saved):
    settings = scene.mphdrr_projections
    settings.model, settings.noise, settings.seed, settings.mu = "EMISSION", True, 5, bpy.data.objects["Body"]
    settings.isotope, settings.aperture_material, settings.edge, settings.crystal_mu = "Tl-201", "lead", "PATH", 0.4
    settings.window, settings.width, settings.height, settings.modules = (60, 80), 8, 6, "1,3"
    scene.mphdrr_geometry.scanner.mphdrr_scanner.opening_angle = 1.4
    asked = _panel(settings)
    bpy.ops.mphdrr.render_projections()
    path = storage.absolute(settings.run_file)
    if saved == "toml":
        write_recipe(read_run(path).recipe, tmp_path / "recipe.toml")
        path = tmp_path / "recipe.toml"
    for name in asked:
        settings.property_unset(name)
    settings.time, settings.photons, settings.mu = 99, 7, None
    scene.mphdrr_geometry.scanner.mphdrr_scanner.opening_angle = 1.0
    assert bpy.ops.mphdrr.load_recipe(filepath=str(path)) == {"FINISHED"}
    assert _panel(settings) == asked
    assert settings.mu.name == "Body" and settings.volume.name == "Derenzo"
    assert scene.mphdrr_geometry.scanner.mphdrr_scanner.opening_angle == pytest.approx(1.4)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[model]\nkind = 'spect'", "model.kind: expected one of transmission, emission"),
        ("[model]\npixel_points = 'auto'", "no automatic number for radiographs"),
    ],
)
def test_a_recipe_that_the_panel_cannot_take_is_one_clear_line(scene, tmp_path, text, message):
    before = _panel(scene.mphdrr_projections)
    (tmp_path / "r.toml").write_text(text)
    refused(bpy.ops.mphdrr.load_recipe, message, filepath=str(tmp_path / "r.toml"))
    assert _panel(scene.mphdrr_projections) == before


def test_every_setting_has_a_property_of_its_own():
    shown = [
        key
        for key in SETTINGS
        if key.startswith(("system.modules", "model.", "scatter.", "detector.", "frames.", "compute."))
    ]
    elsewhere = 2  # the opening angle is the scanner's, bins are of files
    assert len({setting.key for setting in PROPERTIES.values()}) == len(shown) - elsewhere
