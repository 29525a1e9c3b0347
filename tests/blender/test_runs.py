"""The scene's runs: what has changed since each was made, their list, their files, and the difference of two."""

from __future__ import annotations

import shutil
from types import SimpleNamespace
from unittest.mock import MagicMock

import bpy
import numpy as np
import pytest

from mphdrr.addon import registration
from mphdrr.addon.blender import ids, storage
from mphdrr.addon.pictures import images, planes, tiles
from mphdrr.addon.runs import rendering, runs
from mphdrr.addon.scanner import scanner
from mphdrr.addon.volumes import volumes
from mphdrr.core.geometry.grid import Grid
from mphdrr.core.runs.comparing import difference
from mphdrr.core.runs.files import read_run, write_run
from mphdrr.core.runs.recipe import Recipe
from mphdrr.core.runs.run_recipe import run_recipe
from mphdrr.core.volumes.volume import Volume

from .conftest import Drawn, module, move, refused, turn, update


@pytest.fixture
def render(scene, derenzo):
    """Return a function that renders a phantom in a scanner of eight modules as the panel says."""
    settings = scene.mphdrr_projections
    settings.width, settings.height, settings.model = 12, 10, "EMISSION"

    def now(name: str = "") -> bpy.types.PropertyGroup:
        assert bpy.ops.mphdrr.render_projections() == {"FINISHED"}
        if name:
            settings.runs[-1].name = name
        return settings.runs[-1]

    return now


def shown_array(number: int = 3) -> np.ndarray:
    return images.projection_array(bpy.data.images[ids.projection_name(number, 8)])


def array_of(item) -> np.ndarray:
    return read_run(storage.absolute(item.file)).projections


def set_(**values):
    for name, value in values.items():
        setattr(bpy.context.scene.mphdrr_projections, name, value)


def phantom() -> bpy.types.Object:
    return bpy.data.objects["Derenzo"]


EDITS = {
    "Module 03 moved": (lambda: move(module(3), z=1.0), lambda: move(module(3), z=-1.0)),
    "Module 04 turned": (lambda: turn(module(4), y=0.01), lambda: turn(module(4), y=-0.01)),
    "modules 3, 5 moved": (lambda: (move(module(3), z=1.0), move(module(5), z=2.0)), None),
    "Module 02: d 2.3 mm, now 2.3000002 mm": (
        lambda: setattr(module(2).mphdrr_module, "pinhole_diameter", 2.3000002),
        lambda: setattr(module(2).mphdrr_module, "pinhole_diameter", 2.3),
    ),
    "all modules: Ld 48 mm, now 47 mm": (
        lambda: setattr(scanner.active_scanner(bpy.context.scene).mphdrr_scanner, "detector_side", 47.0), None,
    ),
    "phantom Derenzo moved": (lambda: move(phantom(), z=0.001), lambda: move(phantom(), z=-0.001)),
    "phantom Derenzo turned": (lambda: setattr(phantom().rotation_euler, "x", 0.5), None),
    "phantom Derenzo changed": (
        lambda: setattr(phantom().mphdrr_volume.derenzo, "activity", 50.0),
        lambda: setattr(phantom().mphdrr_volume.derenzo, "activity", 100.0),
    ),
    "volume Derenzo is gone": (lambda: bpy.data.objects.remove(phantom()), None),
    "time 60 s, now 30 s": (lambda: set_(time=30.0), lambda: set_(time=60.0)),
    "isotope none, now Tc-99m": (lambda: set_(isotope="Tc-99m"), lambda: set_(isotope="NONE")),
    "model SPECT Counts, now Radiograph": (lambda: set_(model="TRANSMISSION"), lambda: set_(model="EMISSION")),
    "pixels X 12, now 14": (lambda: set_(width=14), lambda: set_(width=12)),
    "modules all, now 2-": (lambda: set_(first=2), lambda: set_(first=0)),
    "seed none, now 4": (lambda: set_(noise=True, seed=4), lambda: set_(noise=False)),
}  # fmt: skip

USUAL = "SPECT Counts, 1 s, 12 × 10, Derenzo"
PANEL = ("time", "isotope", "model ", "pixels", "modules all, now", "seed")


@pytest.mark.parametrize(
    "said", [pytest.param(said, marks=() if i % 2 == 0 else pytest.mark.long) for i, said in enumerate(EDITS)]
)
def test_whatever_changes_is_said_until_it_goes_back(render, scene, said):
    set_(time=60.0)
    render()
    assert runs.changes(scene) == []
    edit, back = EDITS[said]
    edit()
    update()
    assert runs.changes(scene) == [said]
    assert runs.has_scene_changed(scene) != said.startswith(PANEL), "a setting of the panel alone marks no tile"
    if back is not None:
        back()
        update()
        assert runs.changes(scene) == []


def test_what_does_not_change_the_images_leaves_the_run_current(render, scene):
    render()
    phantom().name = "Cold rods"
    scene.mphdrr_display.colors = "GREY"
    set_(backend="NUMPY")
    bpy.ops.mphdrr.add_shepp_logan(voxels=12)
    update()
    assert runs.changes(scene) == [] and runs.volume_to_render(scene) == "Cold rods"


def test_a_module_moved_by_a_millimetre_is_said_by_panels_list_and_export(render, scene, tmp_path, capfd):
    item = render()
    before = array_of(item)
    quiet = [Drawn(name).texts for name in ("MPHDRR_PT_next_step", "MPHDRR_PT_runs", "MPHDRR_PT_export")]
    assert not any("moved" in text for texts in quiet for text in texts)
    move(module(3), z=1.0)
    names = "MPHDRR_PT_next_step", "MPHDRR_PT_runs", "MPHDRR_PT_runs_of_images", "MPHDRR_PT_export"
    for name in names:
        assert "Module 03 moved" in " ".join(Drawn(name).texts), name
        assert ("Render Again" in Drawn(name).texts) == (name != "MPHDRR_PT_export")
    row = MagicMock()
    row.row.return_value = row
    registration.bpy.types.MPHDRR_UL_runs.draw_item(None, bpy.context, row, scene.mphdrr_projections, item, 0, None, "")
    assert row.prop.call_args_list[0].kwargs["icon"] == "ERROR"
    capfd.readouterr()
    assert bpy.ops.mphdrr.export_dataset(filepath=str(tmp_path / "old.npz")) == {"FINISHED"}
    assert "not of the scene as it is now (Module 03 moved): old.npz holds what was rendered" in capfd.readouterr().out
    exported = read_run(tmp_path / "old.npz")
    assert np.array_equal(exported.projections, before)
    assert exported.system.centers[2, 2] == pytest.approx(module(3).location.z - 1.0)
    render()
    assert runs.changes(scene) == [] and not np.array_equal(shown_array(), before[2])
    bpy.ops.mphdrr.export_dataset(filepath=str(tmp_path / "new.npz"))
    assert "not of the scene" not in capfd.readouterr().out


def test_the_list_keeps_two_and_what_is_renamed_or_pinned(render, scene):
    listed = scene.mphdrr_projections.runs
    first = storage.absolute(render().file)
    render("the first sight")
    render().keep = True
    second = storage.absolute(listed[0].file)
    assert [item.name for item in listed] == [USUAL, "the first sight", f"{USUAL} 2"]
    for _ in range(3):
        render()
    assert [item.is_kept for item in listed] == [True, True, False, False]
    assert not first.exists() and second == first
    files = [storage.absolute(item.file) for item in listed]
    assert len(set(files)) == 4 and sorted(storage.folder().glob("*.h5")) == sorted(files)
    assert len({item.name for item in listed}) == 4 and runs.shown_run(scene) == listed[3]
    assert "KiB" in runs.file_size_text(listed)
    removing = bpy.types.MPHDRR_OT_remove_run
    assert "KiB" in removing.description(bpy.context, SimpleNamespace(index=1)), "its tooltip"


def test_choosing_a_run_shows_its_images_and_removing_it_removes_its_file(render, scene):
    settings = scene.mphdrr_projections
    old = array_of(render())
    move(phantom(), z=6.0)
    new = array_of(render())
    assert np.array_equal(shown_array(), new[2]) and not np.array_equal(old, new)
    settings.active_run = 0
    assert np.array_equal(shown_array(), old[2]) and settings.run_file == settings.runs[0].file
    assert runs.changes(scene) == ["phantom Derenzo moved"] and runs.stale_modules(scene) is None
    path = storage.absolute(settings.run_file)
    assert bpy.ops.mphdrr.remove_run(index=0) == {"FINISHED"}
    assert not path.exists() and len(settings.runs) == 1
    render(), bpy.ops.mphdrr.remove_run(index=0)
    assert runs.shown_run(scene) == settings.runs[0] and settings.active_run == 0, "another one was removed"
    assert np.array_equal(shown_array(), new[2]) and runs.changes(scene) == []
    assert bpy.ops.mphdrr.remove_run() == {"FINISHED"}
    assert not settings.run_file and not planes.planes(scene) and ids.MOSAIC not in bpy.data.images
    refused(bpy.ops.mphdrr.remove_run, "No runs yet")


def test_two_runs_survive_save_and_reopen(render, scene, tmp_path):
    before = [array_of(render("one"))]
    move(module(3), z=1.0)
    before.append(array_of(render()))
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "study.blend"))
    shutil.move(tmp_path, moved := tmp_path.with_name(tmp_path.name + "-moved"))
    bpy.ops.wm.open_mainfile(filepath=str(moved / "study.blend"))
    scene = bpy.context.scene
    settings = scene.mphdrr_projections
    assert [item.name for item in settings.runs] == ["one", USUAL]
    assert all(item.file.startswith("//study_mphdrr/") and item.is_saved for item in settings.runs)
    for item, expected in zip(settings.runs, before, strict=True):
        assert np.array_equal(array_of(item), expected)
    assert runs.changes(scene) == [] and runs.changes(scene, settings.runs[0]) == ["Module 03 moved"]
    move(module(3), z=-1.0)
    assert runs.changes(scene, settings.runs[0]) == [] and runs.changes(scene) == ["Module 03 moved"]
    settings.active_run = 0
    assert np.array_equal(shown_array(), before[0][2])
    # The .blend as it was saved may need the file of a run that another one replaces.
    settings.runs[0].name = settings.runs[0].usual_name
    replaced = storage.absolute(settings.runs[0].file)
    bpy.ops.mphdrr.render_projections()
    assert len(settings.runs) == 2 and replaced.exists()
    bpy.ops.wm.save_mainfile()
    assert bpy.ops.mphdrr.clean_volume_files() == {"FINISHED"}
    assert not replaced.exists() and all(storage.absolute(item.file).exists() for item in settings.runs)


def test_a_file_of_another_blend_is_never_removed(render, scene, tmp_path, monkeypatch):
    monkeypatch.setattr(storage, "copies", False)
    render()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    (tmp_path / "sub").mkdir()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "sub" / "b.blend"))
    path = storage.absolute(scene.mphdrr_projections.run_file)
    assert path.resolve().parent == tmp_path / "a_mphdrr"
    bpy.ops.mphdrr.remove_run()
    assert path.is_file() and not scene.mphdrr_projections.runs


def test_a_run_whose_file_is_gone_is_said_and_does_not_stop_saving(render, scene, tmp_path):
    settings = scene.mphdrr_projections
    render("one"), render()
    gone = storage.absolute(settings.runs[0].file)
    gone.unlink()
    refused(bpy.ops.mphdrr.show_run, "the run's file is gone", index=0)
    assert runs.shown_run(scene) == settings.runs[1] and "missing" in runs.file_size_text([settings.runs[0]])
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    assert storage.absolute(settings.runs[1].file).parent == tmp_path / "a_mphdrr"
    settings.active_run = 0  # chosen in the list
    assert runs.shown_run(scene) == settings.runs[1]


def test_the_difference_of_two_runs_is_drawn_and_said(render, scene, capfd):
    settings = scene.mphdrr_projections
    render(), move(phantom(), z=3.0), render()
    found = difference(*(read_run(storage.absolute(settings.runs[i].file)) for i in (1, 0)))
    assert bpy.ops.mphdrr.compare_runs(other="0") == {"FINISHED"}
    assert found.maximum > 0 and found.text in capfd.readouterr().out
    image = bpy.data.images[ids.DIFFERENCE]
    assert images.tiles(image)["numbers"] == list(range(1, 9))
    pixels = np.array(image.pixels[:]).reshape(-1, 4)
    assert (pixels[:, 0] - pixels[:, 2]).max() > 0.4 and (pixels[:, 2] - pixels[:, 0]).max() > 0.4
    assert found.text in " ".join(Drawn("MPHDRR_PT_runs").texts)
    scene.mphdrr_display.half = True  # of the mosaic: a difference shows all of each image, here its first corner
    row, column = images.tiles(image)["corners"][:2]
    picked = tiles.value_at(image, (column + 0.5) / image.size[0], 1 - (row + 0.5) / image.size[1])
    assert picked[0] == "mphDRR 01, column 11, row 9"
    set_(width=14)
    render()
    assert ids.DIFFERENCE not in bpy.data.images, "it belonged to the run that was shown"
    refused(bpy.ops.mphdrr.compare_runs, "cannot compare runs of different pixels: 14 x 10, and 12 x 10", other="0")


@pytest.mark.long
def test_the_example_is_current(scene):
    assert bpy.ops.mphdrr.load_example() == {"FINISHED"}
    assert runs.changes(scene) == [] and len(scene.mphdrr_projections.runs) == 1
    run = read_run(rendering.run_file_path(scene.mphdrr_projections.run_file))
    shown = volumes.reader(bpy.data.objects["Derenzo"])()
    np.testing.assert_array_equal(run.volume.array, shown.array)
    np.testing.assert_allclose(run.volume.grid.affine, shown.grid.affine, atol=1e-4)
    (again,) = run_recipe(run.recipe, run.system)
    np.testing.assert_allclose(again.projections, run.projections, rtol=1e-3, atol=1e-3 * run.projections.max())
    move(module(30), z=1.0)
    assert runs.changes(scene) == ["Module 30 moved"] and runs.stale_modules(scene) == {30}


def test_runs_from_outside_set_the_panel_and_say_what_the_scene_lacks(scene, ring, ring_system, tmp_path):
    small = {"phantom.voxels": 12, "detector.rows": 6, "detector.columns": 8, "model.kind": "emission"}
    for number, (given, expected) in enumerate((
        ({}, []), ({"attenuation.of_phantom": True, "phantom.kind": "nema"}, ["attenuation of Nema phantom, now none"]),
    )):  # fmt: skip
        (run,) = run_recipe(Recipe({**small, **given}), ring_system)
        write_run(run, path := tmp_path / f"{number}.h5")
        item = volumes.add_volume(run.volume, "Projected volume", run.recipe["phantom.matrix"])
        rendering.show_run(scene, run, path, item)
        assert scene.mphdrr_projections.width == 8 and runs.changes(scene) == expected
    module(3).location.x += 1
    assert runs.changes(scene)[0] == "Module 03 moved" and ring.mphdrr_scanner.count == 8


def test_a_volume_that_is_not_in_the_panel_is_found_again(render, scene):
    """With two volumes and none chosen, the run's own is what is compared and rendered again."""
    render()
    volumes.add_volume(Volume(np.ones((2, 2, 2), np.float32), Grid.centered(2, 2.0), "activity"), "Other")
    assert runs.changes(scene) == [] and runs.volume_to_render(scene) == "Derenzo"
    set_(volume=bpy.data.objects["Other"])
    assert runs.changes(scene) == ["volume Derenzo, now Other"] and runs.volume_to_render(scene) == ""
    assert not runs.has_scene_changed(scene)
    assert bpy.ops.mphdrr.render_projections() == {"FINISHED"}
    assert runs.changes(scene) == [] and rendering.run_file_path(scene.mphdrr_projections.run_file)


def test_a_run_with_scatter_shows_its_photons_apart(render, scene):
    water = Volume(np.full((10, 10, 10), 0.0153, np.float32), Grid.centered(10, 10.0), "mu")
    body = volumes.add_volume(water, "Body")
    set_(volume=phantom(), mu=body, isotope="Tc-99m", scatter="BODY", scatter_precision=0.1)
    with pytest.raises(RuntimeError, match=r"body needs Energy FWHM"):
        bpy.ops.mphdrr.render_projections()
    set_(energy_fwhm=0.1)
    run = read_run(storage.absolute(render().file))
    third = run.system.numbers.tolist().index(3)
    np.testing.assert_allclose(shown_array(), run.projections[third], rtol=1e-6)
    assert [(part, is_shown) for part, _, is_shown in runs.parts_to_show(scene)] == [
        ("ALL", True), ("PRIMARY", False), ("SCATTER", False),
    ]  # fmt: skip
    for part, expected in (
        ("SCATTER", run.scatter),
        ("PRIMARY", run.projections - run.scatter),
        ("ALL", run.projections),
    ):
        bpy.ops.mphdrr.show_run(index=0, photons=part)
        np.testing.assert_allclose(shown_array(), expected[third], rtol=1e-6)
        assert [name for name, _, is_shown in runs.parts_to_show(scene) if is_shown] == [part]
    set_(scatter="NONE")
    assert [line for line in runs.changes(scene) if "catter" in line]
    render()
    assert runs.parts_to_show(scene) == []
