"""The live preview without a window: what is asked for, and that the picture is the projector's."""

import threading

import bpy
import numpy as np
import pytest
from mathutils import Vector

from mphdrr.addon.phantoms import phantoms
from mphdrr.addon.runs import preview
from mphdrr.addon.scanner import scanner, selection
from mphdrr.addon.volumes import volumes
from mphdrr.core.errors import InputError
from mphdrr.core.geometry.grid import Grid
from mphdrr.core.projector import Emission, Projector
from mphdrr.core.volumes.volume import Volume

from .conftest import update


@pytest.fixture
def scanned(ring, derenzo, ring_system):
    """Return a scanner of eight modules, the third one active, beside a small phantom, off centre and rotated."""
    selection.select(bpy.context, [scanner.module(ring, 3)])
    return ring_system


def shown(quick=True, voxels=None):
    return preview.make_preview(preview.read_request(bpy.context), quick, {} if voxels is None else voxels)


@pytest.mark.parametrize("settings", [{}, {"model": "EMISSION", "time": 60.0}, {"detector": "REAL", "pitch": 0.3}])
def test_a_preview_is_what_the_projector_says(scanned, scene, settings):
    for name, value in {"width": 300, "height": 200, **settings}.items():
        setattr(scene.mphdrr_projections, name, value)
    volume, module = volumes.volume_from_object(bpy.data.objects["Derenzo"]), scanned[2]
    model = Emission(module, time=60.0) if settings.get("model") else None
    detector, pitch = settings.get("detector", "VIRTUAL").lower(), settings.get("pitch")
    for quick, shape, coarser in ((True, (85, 128), 300 / 128), (False, (200, 300), 1.0)):
        views = module.views(shape, detector, pitch=pitch and pitch * coarser)
        made = shown(quick)
        expected = Projector(volume.grid, views, model)(volume)
        assert expected.max() > 0 and made.is_quick == quick
        np.testing.assert_allclose(made.run.projections, expected, rtol=0, atol=2e-5 * expected.max())
        assert f"{shape[1]} × {shape[0]} pixels" in made.lines[1]


@pytest.mark.parametrize("background", [0.0, 0.5])
def test_counts_are_shown_per_pixel_of_the_panel_whatever_the_number_of_pixels(scanned, scene, background):
    settings = scene.mphdrr_projections
    settings.model, settings.width, settings.height, settings.background = "EMISSION", 512, 512, background
    quick, full = shown(True), shown(False)
    assert quick.run.projections.sum() == pytest.approx(full.run.projections.sum(), rel=0.02)
    assert quick.window[1] == pytest.approx(full.window[1], rel=0.3)
    assert quick.window[1] == pytest.approx(quick.run.projections.max() / 16)


def test_what_moves_is_asked_for_anew_and_voxels_are_read_once(scanned, scene, monkeypatch):
    camera, phantom = scanner.module(scanner.active_scanner(scene), 3), bpy.data.objects["Derenzo"]
    voxels = {}
    before = preview.read_request(bpy.context)
    preview.make_preview(before, True, voxels)
    monkeypatch.setattr(preview.vdb, "read_vdb", None)  # nothing is read again
    assert preview.read_request(bpy.context).equals(before)
    edits = (
        lambda: setattr(camera.location, "x", camera.location.x + 1),
        lambda: setattr(phantom.location, "x", 12.0),
        lambda: setattr(camera.mphdrr_module, "collimator_length", 61.0),
        lambda: setattr(scene.mphdrr_projections, "magnification", 7.0),
        lambda: setattr(scene.mphdrr_display, "colors", "GREY"),
        lambda: selection.select(bpy.context, [scanner.module(scanner.active_scanner(scene), 5)]),
    )
    for edit in edits:
        edit()
        update()
        now = preview.read_request(bpy.context)
        assert not now.equals(before)
        preview.make_preview(now, True, voxels)
        before = now
    assert [len(voxels), before.system.numbers.tolist()] == [1, [5]]


def test_another_volume_takes_the_place_of_the_one_that_was_kept(scanned, scene):
    voxels = {}
    shown(voxels=voxels)
    volumes.add_volume(Volume(np.ones((4, 4, 4), np.float32), Grid.centered(4, 2.0)), "Box")
    scene.mphdrr_projections.volume = bpy.data.objects["Box"]
    shown(voxels=voxels)
    assert [volume.grid.shape for volume in voxels.values()] == [(4, 4, 4)]


def test_the_picture_stands_where_the_modules_plane_does(scanned, scene):
    assert bpy.ops.mphdrr.render_projections(width=40, height=30) == {"FINISHED"}
    scene.mphdrr_projections.width, scene.mphdrr_projections.height = 40, 30
    plane = bpy.data.objects["Projection 03"]
    update()
    half = 0.5 * plane.empty_display_size * np.array(plane.data.size) / max(plane.data.size)
    ends = ((-1, 1), (1, 1), (1, -1), (-1, -1))
    corners = [plane.matrix_world @ Vector((x * half[0], y * half[1], 0)) for x, y in ends]
    np.testing.assert_allclose(shown().corners, corners, atol=1e-3)
    scene.mphdrr_display.planes = "NONE"
    assert shown().corners is None


def test_what_cannot_be_previewed_is_said_in_a_line(scanned, scene, monkeypatch):
    camera, phantom = scanner.module(scanner.active_scanner(scene), 3), bpy.data.objects["Derenzo"]
    session = preview.Session()
    seen = []

    def look():
        session.has_changed = True
        session.take_turn(bpy.context)
        if session.worker is not None:
            session.worker.join()
            session.take_turn(bpy.context)
        seen.append(session.problem)
        return session.lines

    assert "pixels" in look()[1] and session.preview.is_quick
    camera.mphdrr_module.pinhole_diameter = 400.0
    assert look()[0] == "No preview" and "pinhole_diameter" in look()[1]
    camera.mphdrr_module.pinhole_diameter = 2.3
    assert "pixels" in look()[1]
    monkeypatch.setattr(preview, "MAX_CACHED_BYTES", 1000)
    assert "128 KiB of voxels; a live preview keeps at most 1 KiB" in look()[1]
    monkeypatch.undo()
    volumes.file_of(phantom).unlink()
    session.voxels.clear()
    assert "no such file" in look()[1]
    bpy.data.objects.remove(phantom)
    assert "no volume" in look()[1]
    assert session.preview is None


def test_a_picture_that_takes_long_says_that_it_is_of_before(scanned, scene, monkeypatch):
    session, go_on, make = preview.Session(), threading.Event(), preview.make_preview
    session.take_turn(bpy.context)
    session.worker.join()
    session.take_turn(bpy.context)
    before = session.lines
    monkeypatch.setattr(preview, "make_preview", lambda *arguments: go_on.wait(60) and make(*arguments))
    monkeypatch.setattr(preview, "_PATIENCE", 0.0)
    bpy.data.objects["Derenzo"].location.x = 7.0
    update()
    session.has_changed, session.full_at = True, None
    session.take_turn(bpy.context)
    session.take_turn(bpy.context)
    assert session.lines == (*before, "Being made again after a change")
    go_on.set()
    session.worker.join()
    session.take_turn(bpy.context)
    assert "Being made" not in " ".join(session.lines) and session.preview.is_quick


def test_a_phantom_that_has_changed_is_previewed_as_it_was_built(scanned, scene):
    phantom = bpy.data.objects["Derenzo"]
    before = shown()
    phantom.mphdrr_volume.outdated = True
    assert phantoms.outdated_phantom(phantom) == phantom
    after = shown()
    np.testing.assert_array_equal(before.run.projections, after.run.projections)
    assert "Derenzo as it was last built" in " ".join(after.lines) and "last built" not in " ".join(before.lines)


def test_switched_off_it_does_nothing(scanned, scene):
    assert preview.session() is None
    preview.after_update(scene, None)
    assert not bpy.app.timers.is_registered(preview._take_turn)
    preview.start()
    assert preview.session() is not None and bpy.app.timers.is_registered(preview._take_turn)
    bpy.ops.wm.read_homefile(use_empty=True)
    assert preview.session() is None and not bpy.app.timers.is_registered(preview._take_turn)


def test_a_noisy_preview_draws_as_the_recipe_says(scanned, scene):
    settings = scene.mphdrr_projections
    settings.model, settings.time, settings.noise, settings.seed = "EMISSION", 600.0, True, 7
    made = shown(quick=False)
    assert made.run.seed == 7
    np.testing.assert_array_equal(made.run.projections, np.rint(made.run.projections))


def test_without_a_scanner_or_an_active_module(scene):
    with pytest.raises(InputError, match="no scanner"):
        preview.read_request(bpy.context)
