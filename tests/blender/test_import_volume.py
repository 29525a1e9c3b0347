"""Imported volumes equal their files, singly or state by state, and slices show their voxels."""

from __future__ import annotations

import time
from pathlib import Path

import bpy
import numpy as np
import pytest

from mphdrr.addon.blender import storage
from mphdrr.addon.phantoms import phantoms
from mphdrr.addon.phantoms.phantom_properties import plain_settings
from mphdrr.addon.volumes import slices, stored_volumes, volumes
from mphdrr.addon.volumes.stored_volumes import store_volume
from mphdrr.addon.volumes.vdb import openvdb, write_vdb
from mphdrr.core.errors import InputError
from mphdrr.core.geometry.frames import euler_pose
from mphdrr.core.geometry.grid import Grid
from mphdrr.core.phantoms.torso import CardiacTorso
from mphdrr.core.physics.ct_numbers import hu_to_mu
from mphdrr.core.projector import Projector
from mphdrr.core.runs.files import read_run
from mphdrr.core.volumes.volume import Volume
from mphdrr.core.volumes.volume_files import write_volume

from .conftest import datablocks, refused, reopened, slice_pixels, update, volume_picture

AFFINE = euler_pose(0.3, 0.1, -0.2, (40.0, 50.0, 60.0)) @ np.diag([0.7, -0.8, 2.5, 1.0])


@pytest.fixture
def ct() -> Volume:
    array = np.random.default_rng(3).integers(-1000, 1500, (13, 11, 7)).astype(np.float32)
    return Volume(array, Grid(array.shape, AFFINE), "hu")


@pytest.mark.parametrize("ending", [".nii.gz", ".npz", ".h5", ".vdb"])
def test_imported_volume_is_the_files(tmp_path, ct, ending):
    path = tmp_path / f"chest{ending}"
    (write_vdb if ending == ".vdb" else write_volume)(ct, path)
    assert bpy.ops.mphdrr.import_volume(filepath=str(path), center=False) == {"FINISHED"}
    item = bpy.context.object
    back = volumes.volume_from_object(item)
    assert item.name == "chest" and back.quantity == "hu" and np.array_equal(back.array, ct.array)
    np.testing.assert_allclose(back.grid.affine, AFFINE, rtol=0, atol=1e-5)
    settings = item.mphdrr_volume
    assert (settings.minimum, settings.maximum) == (ct.array.min(), ct.array.max())


def test_import_centres_and_converts(tmp_path, ct):
    write_volume(ct, tmp_path / "chest.npz")
    bpy.ops.mphdrr.import_volume(filepath=str(tmp_path / "chest.npz"), attenuation=True, energy=511.0, name="Body")
    back = volumes.volume_from_object(bpy.context.object)
    assert bpy.context.object.name == "Body" and back.quantity == "mu"
    assert np.array_equal(back.array, hu_to_mu(ct, 511.0).array)
    np.testing.assert_allclose(back.grid.center, 0.0, atol=1e-9)


@pytest.mark.parametrize(
    ("name", "settings", "message"),
    [
        ("none.nii", {}, "no such file"),
        ("text.nii", {}, "text.nii"),
        ("text.vdb", {}, "cannot be read"),
        ("mu.npz", {"attenuation": True}, "expected a volume of hu"),
        ("picture.png", {}, "expected"),
    ],
)
def test_bad_files_are_refused_in_one_line_and_add_nothing(tmp_path, name, settings, message):
    for text in ("text.nii", "text.vdb", "picture.png"):
        (tmp_path / text).write_text("hello")
    write_volume(Volume(np.ones((2, 2, 2)), Grid.centered(2, 1.0), "mu"), tmp_path / "mu.npz")
    before = datablocks("objects", "volumes")
    refused(bpy.ops.mphdrr.import_volume, message, filepath=str(tmp_path / name), **settings)
    assert datablocks("objects", "volumes") == before


def test_ct_begins_with_a_window_of_its_own_and_keeps_the_users(ct):
    item = volumes.add_volume(ct, "CT")
    settings = item.mphdrr_volume
    assert (settings.display_low, settings.display_high) == (-160, 240)
    settings.display_low = 50.0
    _replace(item, Volume(ct.array[:5].copy(), Grid((5, 11, 7), AFFINE), "hu"))
    node = item.data.materials[0].node_tree.nodes["Look"]
    assert node.inputs["Low"].default_value == 50.0 and node.inputs["High"].default_value == 240.0


def test_solid_viewport_gets_no_value_below_0(ct):
    item = volumes.add_volume(ct, "CT")
    drawn = item.data.grids[item.data.grids.active_index].name
    path = str(volumes.file_of(item))
    smoke = np.zeros(ct.grid.shape, np.float32)
    openvdb().read(path, drawn).copyToArray(smoke)
    mirrored = openvdb().read(path, "hu").metadata["mphdrr_mirrored"]
    np.testing.assert_allclose(smoke[::-1] if mirrored else smoke, np.maximum(ct.array + 200.0, 0.0))
    assert volumes.volume_from_object(item).quantity == "hu"


def test_volumes_of_older_files_get_a_range(tmp_path, ct):
    item = volumes.add_volume(Volume(np.abs(ct.array), ct.grid, "activity"), "Old")
    for name in ("display_low", "display_high", "extent"):
        item.mphdrr_volume.property_unset(name)
    reopened(tmp_path / "a.blend")
    settings = bpy.data.objects["Old"].mphdrr_volume
    assert settings.display_high == settings.maximum > 1 and settings.extent == pytest.approx(17.5)


def _replace(item, volume: Volume) -> None:
    volumes.replace_stored(item, stored_volumes.store_volume(volume, storage.folder()))


def test_slices_show_the_voxels_where_they_are(ct):
    item = volumes.add_volume(ct, "CT", euler_pose(0.5, 0.1, 0.2, (1.0, 2.0, 3.0)))
    planes = slices.add_slices(item)
    item.mphdrr_volume.display_low, item.mphdrr_volume.display_high = -1000.0, 1500.0
    index = (9, 4, 2)
    item.mphdrr_volume.slices = index
    update()
    shades = slices.color_table("hu")
    for axis, plane in enumerate(planes):
        values = np.take(ct.array, index[axis], axis).T
        expected = shades[((values + 1000.0) * (255 / 2500.0)).astype(int)]
        np.testing.assert_allclose(slice_pixels(plane), expected, atol=1 / 255)
        corner = np.array(index, float)
        corner[[a for a in range(3) if a != axis]] = -0.5
        world = plane.matrix_world @ plane.data.vertices[0].co
        np.testing.assert_allclose(world, (AFFINE @ [*corner, 1.0])[:3], atol=1e-4)
    assert [plane.name for plane in planes] == ["CT Sagittal", "CT Coronal", "CT Axial"]
    item.mphdrr_volume.slices = (1000, 0, 0)  # beyond the edge: the last
    last = shades[int((ct.array[12, 0, 0] + 1000) * 0.102)]
    np.testing.assert_allclose(slice_pixels(planes[0])[0, 0], last, atol=0.01)


def test_slices_follow_new_voxels_and_go(ct):
    item = volumes.add_volume(ct, "CT")
    kinds = "objects", "images", "meshes", "materials"
    slices.remove_slices(item)
    before = datablocks(*kinds)
    slices.add_slices(item)
    _replace(item, Volume(ct.array[:5].copy(), Grid((5, 11, 7), AFFINE), "hu"))
    coronal = slices.planes_of(item)[1]
    assert slice_pixels(coronal).shape[:2] == (7, 5)
    slices.remove_slices(item)
    assert datablocks(*kinds) == before


@pytest.mark.long
def test_slices_of_a_large_volume_are_quick():
    array = np.random.default_rng(0).random((256, 256, 256), np.float32)
    item = volumes.add_volume(Volume(array, Grid.centered(256, 1.0), "activity"), "Large")
    slices.add_slices(item)
    took = []
    for k in range(5):
        start = time.thread_time()  # other work does not count
        item.mphdrr_volume.slices[2] = 100 + k
        took.append(time.thread_time() - start)
    assert min(took) < 0.1, took  # all three planes


def test_unused_files_are_cleaned_up_and_no_others(tmp_path, ct):
    item = volumes.add_volume(ct, "CT")
    _replace(item, Volume(ct.array[:5].copy(), Grid((5, 11, 7), AFFINE), "hu"))
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    _replace(item, Volume(ct.array[:6].copy(), Grid((6, 11, 7), AFFINE), "hu"))
    bpy.ops.wm.save_mainfile()
    folder = tmp_path / "a_mphdrr"
    for name in ("notes.txt", "smoke.vdb", "hu-12.vdb"):
        (folder / name).write_text("mine")
    assert len(list(folder.glob("*.vdb"))) == 4
    assert bpy.ops.mphdrr.clean_volume_files() == {"FINISHED"}
    kept = {path.name for path in folder.iterdir()}
    assert kept == {"notes.txt", "smoke.vdb", "hu-12.vdb", volumes.file_of(item).name}
    assert volumes.volume_from_object(item).grid.shape == (6, 11, 7)


@pytest.mark.parametrize("large", [False, True])
def test_missing_files_are_found_again(tmp_path, ct, monkeypatch, capfd, large):
    if large:
        monkeypatch.setattr(stored_volumes, "MAX_SHOWN_VOXELS", 10)
    volumes.add_volume(ct, "CT")
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    (tmp_path / "archive").mkdir()
    (tmp_path / "a_mphdrr").rename(tmp_path / "archive" / "old")
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "a.blend"))
    assert "CT are missing" in capfd.readouterr().out
    item = bpy.data.objects["CT"]
    (tmp_path / "elsewhere").mkdir()
    bpy.ops.mphdrr.find_volume_files(directory=str(tmp_path / "elsewhere"))
    assert not volumes.file_of(item).is_file()
    assert bpy.ops.mphdrr.find_volume_files(directory=str(tmp_path)) == {"FINISHED"}
    assert np.array_equal(volumes.volume_from_object(item).array, ct.array)
    assert item.data.filepath.startswith("//archive/old/") and item.data.grids.load()
    refused(bpy.ops.mphdrr.find_volume_files, "expected a folder", directory=str(tmp_path / "nowhere"))


@pytest.fixture
def beats(ct) -> list[Volume]:
    return [Volume(np.roll(ct.array, k, axis=0).copy(), ct.grid, "hu") for k in range(4)]


@pytest.mark.parametrize("mode", ["CLIP", "EXTEND", "REPEAT", "PING_PONG"])
def test_sequence_is_read_as_blender_shows_it(beats, mode):
    item = volumes.add_volume(beats, "Heart", frame_start=10)
    item.data.sequence_mode = mode
    known = 0
    for frame in range(3, 25):
        bpy.context.scene.frame_set(frame)
        shown = item.data.grids
        if shown.frame > len(beats):  # Blender's "none"
            with pytest.raises(InputError, match=f"no state at frame {frame}"):
                volumes.volume_from_object(item)
            continue
        assert shown.load() and volumes.file_of(item) == Path(shown.frame_filepath)
        assert np.array_equal(volumes.volume_from_object(item).array, beats[shown.frame - 1].array)
        known += 1
    assert known == (4 if mode == "CLIP" else 22)


@pytest.mark.parametrize("large", [False, True])
def test_sequence_is_saved_and_cleaned_up_whole(tmp_path, beats, monkeypatch, large):
    if large:
        monkeypatch.setattr(stored_volumes, "MAX_SHOWN_VOXELS", 10)
    volumes.add_volume(beats, "Heart")
    reopened(tmp_path / "a.blend")
    bpy.ops.mphdrr.clean_volume_files()
    assert len(list((tmp_path / "a_mphdrr").iterdir())) == (8 if large else 4)
    item = bpy.data.objects["Heart"]
    for k in range(4):
        bpy.context.scene.frame_set(1 + k)
        assert item.data.grids.load() and item.data.grids.frame == k + 1
        assert np.array_equal(volumes.volume_from_object(item).array, beats[k].array)


def test_slices_beat_along(beats):
    item = volumes.add_volume(beats, "Heart")
    plane = slices.add_slices(item)[2]
    first = slice_pixels(plane)
    bpy.context.scene.frame_set(3)
    assert slices.planes_of(item)[2] == plane
    np.testing.assert_array_equal(slice_pixels(plane), np.roll(first, 2, axis=1))


def test_sequence_of_what_cannot_follow_is_refused(ct):
    other = Volume(ct.array, ct.grid, "mu")
    for states in ([], [ct, other]):
        with pytest.raises(InputError, match="volumes of one quantity"):
            volumes.add_volume(states, "Heart")


@pytest.fixture
def two_states() -> list[Volume]:
    """Return two states of random voxels."""
    arrays = np.random.default_rng(5).random((2, 9, 8, 7), np.float32)
    return [Volume(array, Grid.centered(array.shape, 10.0)) for array in arrays]


@pytest.mark.long
def test_every_frame_has_its_state_of_the_torso(scene):
    assert bpy.ops.mphdrr.add_torso(voxels=12, frames=2) == {"FINISHED"}
    item, recipe = bpy.context.object, phantoms.copy_settings(plain_settings("torso", voxels=12, frames=2))
    assert recipe.settings["frames"] == 2 and list(recipe.states) == list(CardiacTorso().beating(2))
    states = [state.voxelize(recipe.grid).array for state in recipe.states]
    for frame in (1, 2, 3):
        scene.frame_set(frame)
        assert np.array_equal(volumes.volume_from_object(item).array, states[(frame - 1) % 2])
        assert item.data.grids.load() and volumes.file_of(item) == Path(item.data.grids.frame_filepath)
        assert volumes.state_text(item) == f"{(frame - 1) % 2 + 1} of 2"


def test_a_volume_begins_to_beat_and_stands_still_again(two_states):
    item = volumes.add_volume(two_states[0], "Heart")
    still = volumes.file_of(item)
    volumes.replace_stored(item, store_volume(two_states, storage.folder()))
    item.data.frame_start, item.data.sequence_mode = 2, "EXTEND"
    assert item.data.is_sequence and item.data.frame_duration == 2
    volumes.replace_stored(item, store_volume(two_states[::-1], storage.folder()))
    assert (item.data.frame_start, item.data.sequence_mode) == (2, "EXTEND"), "what was set on it stays"
    assert np.array_equal(volumes.volume_from_object(item).array, two_states[1].array)
    volumes.replace_stored(item, store_volume(two_states[0], storage.folder()))
    assert not item.data.is_sequence and volumes.file_of(item) == still, "files are named by content"


def test_the_current_frame_is_projected(scene, ring, ring_system, two_states):
    volumes.add_volume(two_states, "Heart")
    views = ring_system.views(shape=(12, 10))
    for frame, expected in enumerate(two_states, 1):
        scene.frame_set(frame)
        assert bpy.ops.mphdrr.render_projections(width=10, height=12) == {"FINISHED"}
        run = read_run(storage.absolute(scene.mphdrr_projections.run_file))
        np.testing.assert_allclose(run.projections, Projector(expected.grid, views)(expected), rtol=1e-5, atol=1e-3)
        assert run.recipe["volume.state"] == f"{frame} of 2"


@pytest.fixture
def halves(tmp_path) -> list[dict[str, str]]:
    """Write files with voxels bright at low, then at high x, both beside the isocentre; their names sort as numbers do."""
    names = []
    for number, half in ((9, slice(0, 4)), (10, slice(4, 8))):
        array = np.zeros((8, 8, 8), np.float32)
        array[half] = 1.0
        place = np.diag([2.0, 2.0, 2.0, 1.0])
        place[:3, 3] = 10.0 * number, 5.0, 7.0
        names.append({"name": f"beat_{number}.npz"})
        write_volume(Volume(array, Grid(array.shape, place), "activity"), tmp_path / names[-1]["name"])
    return names[::-1]


def test_files_follow_each_other_as_shown(tmp_path, halves, scene):
    arguments = {"directory": str(tmp_path), "files": halves, "frame_start": 5}
    assert bpy.ops.mphdrr.import_volume_sequence(**arguments) == {"FINISHED"}
    item = bpy.context.object
    assert item.name == "beat" and item.data.frame_duration == 2 and item.data.frame_start == 5
    bright = {}
    for frame in (5, 6, 7):
        scene.frame_set(frame)
        volume = volumes.volume_from_object(item)
        # Moved together: the first file's centre is at the isocentre, the second's still 10 mm beside it.
        np.testing.assert_allclose(volume.grid.center, (10.0 * (frame == 6), 0, 0), atol=1e-9)
        bright[frame] = _brightness(scene)
    left, right = bright[5]
    assert left > 5 * right and bright[7] == bright[5]
    left, right = bright[6]
    assert right > 5 * left


def _brightness(scene) -> tuple[float, float]:
    """Return the brightness of both halves of Cycles' picture from the front, the first file's cube in its middle."""
    if hasattr(scene.cycles, "volume_biased"):
        scene.cycles.volume_biased = True  # 5.2's other method takes a hundred times as long
    columns = volume_picture(scene, (0, 2), np.zeros(3), 40.0, 16, samples=4)[..., :3].sum(axis=(0, 2))
    return float(columns[:8].sum()), float(columns[8:].sum())


def test_files_that_are_no_sequence_are_refused(tmp_path, halves):
    write_volume(Volume(np.ones((2, 2, 2), np.float32), Grid((2, 2, 2), np.eye(4)), "mu"), tmp_path / "mu.npz")
    before = len(bpy.data.objects)
    for words, *names in (
        ("two files or more",),
        ("two files or more", "beat_9.npz", "beat_9.npz"),
        (r"slice\.dcm: expected a name ending in .*a DICOM series is one volume", "beat_9.npz", "slice.dcm"),
        (r"beat_11\.npz: no such file", "beat_9.npz", "beat_11.npz"),
        ("volumes of one quantity, got activity, mu", "beat_9.npz", "mu.npz"),
    ):
        files = [{"name": name} for name in names]
        refused(bpy.ops.mphdrr.import_volume_sequence, words, directory=str(tmp_path), files=files)
    assert len(bpy.data.objects) == before
