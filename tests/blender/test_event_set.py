"""The Event Set panel: recipes written and tried on the phantom, sets made as jobs, events opened in the scene."""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np
import pytest

from mphdrr.addon.blender import jobs, storage
from mphdrr.addon.events import event_notes, event_sets
from mphdrr.addon.phantoms import phantoms
from mphdrr.addon.runs import runs
from mphdrr.addon.scanner import scanner
from mphdrr.addon.volumes import volumes
from mphdrr.core import events
from mphdrr.core.events.templates import TEMPLATES
from mphdrr.core.runs.files import read_run
from mphdrr.core.workbook import read_system

from .conftest import cancelled, refused, reopened

WORKBOOK = Path(__file__).parents[1] / "core" / "data" / "first-24-modules.xlsx"

TEXT = f"""
version = 1
seed = 3
[system]
file = '{WORKBOOK}'
modules = "1-4"
[detector]
rows = 8
columns = 8
[truth]
voxels = 16
spacing = 6.0
[[phantoms]]
kind = "derenzo"
radius = {{ from = 30, to = 36 }}
rod_diameters = [10, {{ from = 8, to = 9 }}, 0, 0, 0, 0]
altered = -2
activity = {{ from = 50, to = 100 }}
[phantoms.pose]
position = [{{ from = -8, to = 8 }}, 0, 5]
turn = "uniform"
[[phantoms]]
kind = "defrise"
odds = 0.5
disks = {{ from = 2, to = 4 }}
disk_radius = 30
spacing_of_disks = 14
margin = 0
[models.lines]
kind = "transmission"
[models.counts]
kind = "emission"
time = 100
hole = "point"
pixel_points = 1
tolerance = 1e6
[augmentation]
mirror = 0.5
size = {{ from = 0.9, to = 1.1 }}
activity = {{ from = 0.5, to = 2 }}
[splits]
train = 0.5
test = 0.5
"""


@pytest.fixture
def recipe(scene, tmp_path) -> events.EventRecipe:
    """Return the recipe `TEXT`, chosen in the panel with a folder for its set."""
    path = tmp_path / "small.toml"
    path.write_text(TEXT)
    settings = scene.mphdrr_events
    settings.recipe, settings.folder, settings.count = str(path), str(tmp_path / "set"), 2
    return events.read_recipe(path)


def first_of(recipe: events.EventRecipe, name: str, mirrored: bool | None = None) -> events.PlannedEvent:
    """Return the first event of a phantom."""
    planned = (events.plan(recipe, number) for number in range(99))
    return next(event for event in planned if event.name == name and mirrored in (None, event.mirror))


def only_phantom() -> bpy.types.Object:
    (item,) = (item for item in volumes.volume_objects(bpy.context.scene) if phantoms.settings_of(item) is not None)
    return item


def files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.mark.parametrize("mirrored", [False, True])
def test_the_phantom_in_the_scene_becomes_that_of_the_event(recipe, scene, mirrored):
    planned = first_of(recipe, "derenzo", mirrored)
    assert bpy.ops.mphdrr.try_event(number=planned.number) == {"FINISHED"}
    item = only_phantom()
    made = phantoms.copy_settings(phantoms.settings_of(item)).phantom
    assert made.altered == planned.phantom.altered == -2
    assert made.radius == pytest.approx(planned.phantom.radius, rel=1e-6)
    np.testing.assert_allclose(made.rod_diameters, planned.phantom.rod_diameters, rtol=1e-6)
    assert made.activity == pytest.approx(planned.activity_factor * planned.phantom.activity, rel=1e-6)
    np.testing.assert_allclose(volumes.pose_of_object(item), planned.placement, atol=1e-12)
    np.testing.assert_allclose(np.array(item.matrix_world), planned.placement, atol=1e-4)
    assert not item.mphdrr_volume.outdated and bpy.context.object == item
    volume = volumes.volume_from_object(item)
    total = float(volume.array.sum(dtype=float)) * volume.grid.voxel_volume
    truth = events.EventMaker(recipe).truth(planned)
    assert total == pytest.approx(float(truth.array.sum(dtype=float)) * truth.grid.voxel_volume, rel=0.02)
    settings = scene.mphdrr_events
    assert settings.number == planned.number + 1 and settings.tried.startswith(f"event {planned.number}: derenzo, ")


def test_another_one_counts_up_and_keeps_the_object(recipe, scene):
    bpy.ops.mphdrr.add_derenzo(voxels=12, name="Mine")
    item = bpy.context.object
    kinds, radii = [], []
    for number in range(4):
        assert bpy.ops.mphdrr.try_event() == {"FINISHED"}
        assert only_phantom() == item and scene.mphdrr_events.number == number + 1
        settings = phantoms.settings_of(item)
        kinds.append(item.mphdrr_volume.kind.lower())
        radii.append(getattr(settings, "radius", 0.0))
        assert item.name == "Mine" and settings.voxels == 12
    assert kinds == [events.plan(recipe, number).name for number in range(4)] and {"derenzo", "defrise"} == set(kinds)
    scene.mphdrr_events.number = kinds.index("derenzo")
    bpy.ops.mphdrr.try_event()
    assert phantoms.settings_of(item).radius == radii[kinds.index("derenzo")], "the same number is the same phantom"


def test_its_attenuation_and_outline_go_with_it(recipe, scene):
    bpy.ops.mphdrr.add_derenzo(voxels=12, attenuation=True)
    item = bpy.context.object
    bpy.ops.mphdrr.show_phantom_outline()
    planned = first_of(recipe, "defrise")
    bpy.ops.mphdrr.try_event(number=planned.number)
    root, child = phantoms.with_children(item)
    assert (root, volumes.quantity_of(child)) == (item, "mu") and phantoms.outline_of(item) is not None
    np.testing.assert_allclose(volumes.pose_of_object(child), planned.placement, atol=1e-5)
    assert volumes.volume_from_object(child).array.max() > 0.01


def with_phantom(path: Path, entry: str) -> str:
    """Write the recipe with this one phantom into a file, and return its path."""
    head, tail = TEXT.split("[[phantoms]]", 1)[0], TEXT[TEXT.index("[models.lines]") :]
    path.write_text(f"{head}[[phantoms]]\n{entry}\n{tail}")
    return str(path)


def test_the_gates_of_a_beating_heart_are_its_frames(scene, tmp_path):
    path = with_phantom(tmp_path / "torso.toml", 'kind = "torso"\ngates = 2\nwall = { from = 8, to = 12 }')
    assert bpy.ops.mphdrr.try_event(recipe=path, number=5) == {"FINISHED"}
    item = only_phantom()
    assert item.data.frame_duration == 2 and 8 <= phantoms.settings_of(item).wall <= 12


def test_a_file_of_the_recipe_is_tried_too(recipe, scene, tmp_path):
    bpy.ops.mphdrr.try_event()
    item = only_phantom()
    (tmp_path / "ball.toml").write_text('[[shape]]\nkind = "sphere"\nradius = 20\nactivity = 7.0\n')
    path = with_phantom(tmp_path / "file.toml", 'file = "ball.toml"')
    assert bpy.ops.mphdrr.try_event(recipe=path, number=0) == {"FINISHED"}
    assert phantoms.settings_of(item) is None and "file-1" in scene.mphdrr_events.tried
    planned = events.plan(events.read_recipe(path), 0)
    assert item.mphdrr_volume.maximum == pytest.approx(7.0 * planned.activity_factor, rel=1e-3)
    bpy.ops.mphdrr.try_event(number=0)
    assert only_phantom() == item


def test_a_set_is_that_of_the_library_and_goes_on_after_cancel(recipe, scene, tmp_path):
    events.make(recipe, tmp_path / "expected", 2)
    folder = scene.mphdrr_events.folder
    job = event_sets.make_set_job(str(tmp_path / "small.toml"), folder, 2)
    cancelled(job, lambda done, total: done == 1)
    assert job.leftovers() == "1 event made now and kept; Make Event Set goes on from there"
    first = Path(folder, "events", "000000.h5")
    assert [path.name for path in first.parent.iterdir()] == [first.name]
    written = first.stat().st_mtime_ns
    assert bpy.ops.mphdrr.make_event_set() == {"FINISHED"}
    assert first.stat().st_mtime_ns == written
    assert files(Path(folder)) == files(tmp_path / "expected")
    assert jobs.run(event_sets.make_set_job("", folder, 2)).startswith("All events asked for are there already: 2 in ")


def test_an_event_is_opened_with_truth_phantom_and_projections(recipe, scene, tmp_path):
    made = events.make(recipe, tmp_path / "set", 3)
    number = next(event.number for event in made if event.name == "derenzo")
    assert bpy.ops.mphdrr.open_event(opened=number) == {"FINISHED"}
    event, settings = events.EventSet(tmp_path / "set")[number], scene.mphdrr_events
    truth = settings.truth
    assert truth == bpy.context.object and truth.name == f"Event {number} derenzo" and truth.visible_get()
    found = volumes.volume_from_object(truth)
    np.testing.assert_array_equal(found.array, event.truth.array)
    np.testing.assert_allclose(found.grid.affine, event.truth.grid.affine, atol=1e-9)
    np.testing.assert_allclose(volumes.pose_of_object(truth), event.placement, atol=1e-12)
    phantom = only_phantom()
    assert phantom == settings.phantom and not phantom.visible_get()
    np.testing.assert_allclose(volumes.pose_of_object(phantom), event.placement, atol=1e-12)
    assert phantoms.settings_of(phantom).radius == pytest.approx(event.settings["radius"], rel=1e-6)
    item = runs.shown_run(scene)
    np.testing.assert_array_equal(read_run(storage.absolute(item.file)).projections, event.images("lines"))
    assert item.name == f"lines, 8 × 8, Event {number} derenzo" and runs.changes(scene) == []
    assert len(scanner.modules(scanner.active_scanner(scene))) == 4, "the set's, since the scene had none"


ODD = """[models.odd]
kind = "emission"
time = 33.333333333333336
isotope = "Tl-201"
window = [63.1234567891, 87.7]
aperture_mu = 1.2345678901234
opening_angle_degrees = 83.7
crystal_mu = "NaI"
intrinsic_fwhm = 2.1234567890123
within_cone = true
pixel_points = 1
tolerance = 1234567.8901234
background = 0.1
[models.path]
kind = "emission"
isotope = "Tc-99m"
aperture_mu = "tungsten"
edge = "path"
crystal_mu = "CZT"
depth_layers = 2
pixel_points = 1
tolerance = 0.7
"""


@pytest.mark.parametrize("has_scanner", [pytest.param(False, marks=pytest.mark.long), True])
def test_an_opened_event_is_current_until_something_is_changed(recipe, scene, tmp_path, has_scanner):
    """Float64 in the recipe, float32 in the scene: the same numbers; 84 degrees are others."""
    pitch = TEXT.replace("columns = 8", "columns = 8\npitch = 12.345678901234567\nmagnification = 9.87654321")
    (tmp_path / "odd.toml").write_text(pitch.replace("[augmentation]", f"{ODD}[augmentation]"), encoding="utf-8")
    events.make(events.read_recipe(tmp_path / "odd.toml"), tmp_path / "set", 1)
    if has_scanner:
        scanner.build_scanner(scene, read_system(WORKBOOK)[:4])
    for model in ("lines", "counts", "odd", "path"):
        bpy.ops.mphdrr.open_event(opened=0, model=model)
        assert runs.changes(scene) == [], model
    scene = reopened(tmp_path / "kept.blend")
    assert runs.changes(scene) == []
    bpy.ops.mphdrr.open_event(opened=0, model="odd")
    settings, own = scene.mphdrr_projections, scanner.active_scanner(scene).mphdrr_scanner
    for owner, name, value, said in (
        (settings, "time", 33.3334, "time"),
        (settings, "window", (63.1235, 87.7), "window"),
        (settings, "intrinsic_fwhm", 2.12346, "blur"),
        (settings, "pitch", 12.3457, "pixel size"),
        (own, "opening_angle", np.radians(83.701), "opening angle"),
    ):
        before = getattr(owner, name)
        before = before[:] if name == "window" else before
        setattr(owner, name, value)
        (line,) = runs.changes(scene)
        assert line.startswith(said) and ", now " in line
        setattr(owner, name, before)
        assert runs.changes(scene) == []


def test_the_next_event_takes_the_place_of_the_one_before(recipe, scene, tmp_path):
    events.make(recipe, tmp_path / "set", 3)
    bpy.ops.mphdrr.open_event(opened=0)
    first, objects = scene.mphdrr_events.truth, set(bpy.data.objects)
    bpy.ops.mphdrr.open_event(opened=2, model="counts")
    assert set(bpy.data.objects) == objects and scene.mphdrr_events.truth == first
    assert first.name.startswith("Event 2 ") and runs.shown_run(scene).name.startswith("counts, ")
    bpy.ops.mphdrr.try_event(number=1)
    assert only_phantom().visible_get() and not first.visible_get()
    bpy.data.objects.remove(first)
    bpy.ops.mphdrr.open_event(opened=1)
    assert scene.mphdrr_events.truth.name.startswith("Event 1 ")


def test_what_is_wrong_is_said_in_a_line(recipe, scene, tmp_path):
    events.make(recipe, tmp_path / "set", 1)
    refused(bpy.ops.mphdrr.open_event, r"event 7: not in .*which holds 1 event, 0 to 0", opened=7)
    refused(bpy.ops.mphdrr.open_event, "'blurred': no such model; there are lines, counts", opened=0, model="blurred")
    Path(scene.mphdrr_events.recipe).write_text(TEXT.replace("radius =", "radios ="))
    refused(bpy.ops.mphdrr.try_event, "derenzo: radios: no such setting")
    scene.mphdrr_events.recipe = scene.mphdrr_events.folder = ""
    for operator in (bpy.ops.mphdrr.try_event, bpy.ops.mphdrr.make_event_set, bpy.ops.mphdrr.open_event):
        refused(operator, "given")


def test_notes_say_what_a_recipe_and_a_set_are(recipe, scene, tmp_path):
    settings = scene.mphdrr_events
    note = event_notes.recipe_note(settings.recipe)
    assert (note.text, note.is_wrong) == ("derenzo, defrise; lines, counts; 16³ voxels of 6 mm", False)
    assert event_notes.recipe_note("") is None and event_notes.set_note(settings.folder) is None
    events.make(recipe, tmp_path / "set", 2)
    (tmp_path / "set/events/000001.h5").unlink()
    note = event_notes.set_note(settings.folder)
    assert note.text.startswith("1 of 2 events, ") and note.models == ("lines", "counts")
    Path(settings.recipe).write_text(TEXT.replace("radius =", "radios ="))
    note = event_notes.recipe_note(settings.recipe)
    assert note.is_wrong and note.text.startswith("phantoms: derenzo: radios: no such setting")
    Path(settings.recipe).write_text(TEXT.replace(str(WORKBOOK), "gone.xlsx"))
    assert "gone.xlsx: no such file" in event_notes.recipe_note(settings.recipe).text


@pytest.mark.parametrize("like", TEMPLATES)
def test_a_new_recipe_is_of_the_scenes_workbook(scene, tmp_path, small_workbook, like):
    path = tmp_path / "new.toml"
    assert bpy.ops.mphdrr.new_event_recipe(filepath=str(path), like=like) == {"FINISHED"}
    assert "dc-spect-80.xlsx" in events.read_recipe(path).system["system.file"]
    assert scene.mphdrr_events.recipe == str(path)
    bpy.ops.mphdrr.import_geometry(filepath=str(small_workbook))
    bpy.ops.mphdrr.new_event_recipe(filepath=str(path), like=like)
    assert events.read_recipe(path).system["system.file"] == str(small_workbook)
