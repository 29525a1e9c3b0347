"""Sequences: states that follow each other frame by frame, shown and projected."""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np
import pytest

from mphdrr.addon.blender import storage
from mphdrr.addon.phantoms import phantoms
from mphdrr.addon.phantoms.phantom_properties import plain_settings
from mphdrr.addon.scanner import scanner
from mphdrr.addon.volumes import volumes
from mphdrr.addon.volumes.stored_volumes import store_volume
from mphdrr.core.geometry.grid import Grid
from mphdrr.core.phantoms.torso import CardiacTorso
from mphdrr.core.projector import Projector
from mphdrr.core.runs.files import read_run
from mphdrr.core.volumes.volume import Volume
from mphdrr.core.volumes.volume_files import write_volume


@pytest.fixture
def beats() -> list[Volume]:
    """Two states of random voxels."""
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


def test_a_volume_begins_to_beat_and_stands_still_again(beats):
    item = volumes.add_volume(beats[0], "Heart")
    still = volumes.file_of(item)
    volumes.replace_stored(item, store_volume(beats, storage.folder()))
    item.data.frame_start, item.data.sequence_mode = 2, "EXTEND"
    assert item.data.is_sequence and item.data.frame_duration == 2
    volumes.replace_stored(item, store_volume(beats[::-1], storage.folder()))
    assert (item.data.frame_start, item.data.sequence_mode) == (2, "EXTEND"), "what was set on it stays"
    assert np.array_equal(volumes.volume_from_object(item).array, beats[1].array)
    volumes.replace_stored(item, store_volume(beats[0], storage.folder()))
    assert not item.data.is_sequence and volumes.file_of(item) == still, "files are named by content"


def test_the_current_frame_is_projected(scene, ring_system, beats):
    scanner.build_scanner(scene, ring_system)
    volumes.add_volume(beats, "Heart")
    views = ring_system.views(shape=(12, 10))
    for frame, expected in enumerate(beats, 1):
        scene.frame_set(frame)
        assert bpy.ops.mphdrr.render_projections(width=10, height=12) == {"FINISHED"}
        run = read_run(storage.absolute(scene.mphdrr_projections.run_file))
        np.testing.assert_allclose(run.projections, Projector(expected.grid, views)(expected), rtol=1e-5, atol=1e-3)
        assert run.recipe["volume.state"] == f"{frame} of 2"


@pytest.fixture
def halves(tmp_path) -> list[dict[str, str]]:
    """Files whose voxels are bright at low, then at high x, both beside the isocentre; named as numbers sort."""
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
    """Brightness of the left and right half of Cycles' picture from the front, with the first file's cube in the middle."""
    for other in [o for o in scene.objects if o.type != "VOLUME"]:
        bpy.data.objects.remove(other)
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    scene.collection.objects.link(camera)
    camera.location, camera.rotation_euler = (0, -100, 0), (np.pi / 2, 0, 0)
    camera.data.type, camera.data.ortho_scale = "ORTHO", 40.0
    scene.camera, scene.world, scene.render.engine, scene.cycles.samples = camera, None, "CYCLES", 4
    if hasattr(scene.cycles, "volume_biased"):
        scene.cycles.volume_biased = True  # 5.2's other method takes a hundred times as long
    scene.render.resolution_x = scene.render.resolution_y = 16
    scene.render.resolution_percentage = 100
    scene.render.filepath = str(Path(bpy.app.tempdir) / "frame.png")
    bpy.ops.render.render(write_still=True)
    image = bpy.data.images.load(scene.render.filepath)
    picture = np.array(image.pixels).reshape(16, 16, 4)[..., :3].sum(axis=(0, 2))
    bpy.data.images.remove(image)
    return float(picture[:8].sum()), float(picture[8:].sum())


def test_files_that_are_no_sequence_are_refused(tmp_path, halves):
    def refused(message: str, *names: str) -> None:
        before = len(bpy.data.objects)
        with pytest.raises(RuntimeError, match=message):
            bpy.ops.mphdrr.import_volume_sequence(directory=str(tmp_path), files=[{"name": n} for n in names])
        assert len(bpy.data.objects) == before

    refused("two files or more")
    refused("two files or more", "beat_9.npz", "beat_9.npz")
    refused(r"slice\.dcm: expected a name ending in .*a DICOM series is one volume", "beat_9.npz", "slice.dcm")
    refused(r"beat_11\.npz: no such file", "beat_9.npz", "beat_11.npz")
    write_volume(Volume(np.ones((2, 2, 2), np.float32), Grid((2, 2, 2), np.eye(4)), "mu"), tmp_path / "beat_11.npz")
    refused("volumes of one quantity, got activity, mu", "beat_9.npz", "beat_11.npz")
