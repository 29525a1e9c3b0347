"""Figures of a scene: rendered in a studio that leaves no trace, and the same by operator, function and command."""

from __future__ import annotations

import subprocess
import sys

import bpy
import numpy as np
import pytest
from PIL import Image

import mphdrr.core as mph
from mphdrr.addon import figures, jobs, rendering, scanner, volumes
from mphdrr.addon.cli.scene import save_scene
from mphdrr.core.figures.page import Page


def state() -> tuple:
    """What the user has: datablocks, what is hidden, selected and active, and the scene's settings."""
    kinds = {kind: getattr(bpy.data, kind) for kind in dir(bpy.data)}
    counts = {kind: len(found) for kind, found in kinds.items() if isinstance(found, bpy.types.bpy_prop_collection)}
    scene = bpy.context.scene
    objects = [(o.name, o.hide_viewport, o.hide_render, o.select_get(), o.data and o.data.users) for o in scene.objects]
    render = scene.render
    look = render.engine, render.resolution_x, render.filepath, scene.camera, scene.world, scene.frame_current
    return counts, objects, look, bpy.context.view_layer.objects.active, bpy.context.scene.name


@pytest.fixture
def example(scene, dc_spect, tmp_path):
    """A scanner with some modules hidden, a phantom that was moved, and projections."""
    system = dc_spect[::4]
    collection = scanner.build_scanner(scene, system)
    pose = mph.euler_pose(0.3, 0.2, 0.1, (4.0, 0.0, -6.0))
    volume = mph.DerenzoPhantom(40, (8, 6, 5, 4, 3, 2), 40, 100).voxelize(mph.Grid.centered(24, 4.0), pose)
    item = volumes.add_volume(volume, "Derenzo", pose)
    views = system.views(shape=(16, 16))
    run = mph.ProjectionRun(mph.Projector(volume.grid, views)(volume), system, views, volume)
    mph.write_run(run, tmp_path / "run.h5")
    rendering.show_run(scene, run, tmp_path / "run.h5", item)
    scanner.show_modules(collection, 5, 41)
    bpy.context.view_layer.update()
    return scene


def picture(path) -> np.ndarray:
    return np.asarray(Image.open(path).convert("RGB")).astype(int)


@pytest.mark.long
def test_a_rendered_figure_leaves_the_scene_as_it_was(example, tmp_path):
    for _ in range(2):  # the parts' materials may be made the first time
        before = state()
        path = tmp_path / "figure.png"
        bpy.ops.mphdrr.export_figure(filepath=str(path), figure="CUT_AWAY", width=320, height=240, samples=1)
        assert state() == before
    shown = picture(path)
    assert shown.shape == (240, 320, 3) and shown.std() > 15
    assert 40 < shown.mean() < 150


@pytest.mark.long
def test_a_volume_is_shown_in_its_look(example, tmp_path):
    (item,) = volumes.volume_objects(example)
    for look in ("DENSITY", "SHELL"):  # smoke, and a surface that is an object of its own
        item.mphdrr_volume.look = look
        before, path = state(), tmp_path / f"{look}.png"
        jobs.run(figures.figure_job(bpy.context, "inside", [path], (320, 240), labels=False, samples=1))
        assert state() == before
        shown = picture(path)
        assert np.count_nonzero(shown[..., 0] - shown[..., 1] > 40) > 200, f"{look}: the phantom's purple"


@pytest.mark.long
def test_a_scanner_fits_its_figure_with_even_margins(example, tmp_path):
    for size in ((480, 240), (240, 420)):
        path = tmp_path / f"{size[0]}.png"
        jobs.run(figures.figure_job(bpy.context, "scanner", [path], size, labels=False, samples=2))
        shown = picture(path)
        inside = np.argwhere((np.abs(shown - shown[2, 2]) > 24).any(axis=2))
        free = [*inside.min(axis=0), *(np.array(shown.shape[:2]) - 1 - inside.max(axis=0))]
        margin = 0.04 * min(size)
        assert min(free) > margin - 4, "nothing is cut off"
        assert abs(free[1] - free[3]) < 8 and abs(free[0] - free[2]) < 8, "the margins are even"
        assert min(free) < margin + 6, "it is as large as fits"


@pytest.mark.long
def test_modules_alone_stand_where_they_stand_in_the_whole(example, tmp_path):
    shown = {}
    for modules in (None, "1-20", "61-80"):
        path = tmp_path / f"{modules}.png"
        job = figures.figure_job(bpy.context, "scanner", [path], (320, 240), modules, labels=False, samples=1)
        jobs.run(job)
        shown[modules] = picture(path)
    some, whole = shown["1-20"], shown[None]
    assert (np.abs(some - whole).max(axis=2) > 40).mean() > 0.02
    assert (np.abs(shown["61-80"] - some).max(axis=2) > 40).mean() > 0.02


@pytest.mark.long
def test_window_and_command_draw_the_same(example, tmp_path):
    save_scene(tmp_path / "scene.blend")
    for kind in ("sums", "mosaic"):
        own, other = tmp_path / f"{kind}.svg", tmp_path / f"{kind}-command.svg"
        bpy.ops.mphdrr.export_figure(filepath=str(own), figure=kind.upper(), width=700, height=400)
        words = ["figure", kind, tmp_path / "scene.blend", "--size", "700x400", "-o", other]
        done = subprocess.run([sys.executable, "-m", "mphdrr", *map(str, words)], capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        assert own.read_text(encoding="utf-8") == other.read_text(encoding="utf-8")
    assert "T = (4, 0, −6) mm" in (tmp_path / "sums.svg").read_text(encoding="utf-8")


def test_the_c_arm_is_the_active_modules(example, tmp_path):
    bpy.context.view_layer.objects.active = scanner.module(scanner.active_scanner(example), 9)
    bpy.ops.mphdrr.export_figure(filepath=str(tmp_path / "arm.svg"), figure="C_ARM")
    assert "Module 9: the true pinhole" in (tmp_path / "arm.svg").read_text(encoding="utf-8")


def test_figures_refuse_what_is_not_there(scene, dc_spect, tmp_path):
    path = str(tmp_path / "a.png")
    with pytest.raises(RuntimeError, match="Nothing to show: import a workbook or add a phantom first"):
        bpy.ops.mphdrr.export_figure(filepath=path)
    scanner.build_scanner(scene, dc_spect[:4])
    for figure, message in (
        ("SUMS", "no volume in the scene"),
        ("MOSAIC", "no projections"),
        ("CUT_AWAY", "no volume"),
    ):
        with pytest.raises(RuntimeError, match=message):
            bpy.ops.mphdrr.export_figure(filepath=path, figure=figure)
    for given, message in (
        ({"width": 900}, "give both width and height, or neither"),
        ({"modules": "90"}, "no module 90; there are 1 to 4"),
        ({"filepath": str(tmp_path / "a.bmp")}, r"expected a name ending in .png, .svg"),
    ):
        with pytest.raises(RuntimeError, match=message):
            bpy.ops.mphdrr.export_figure(**{"filepath": path, "figure": "C_ARM", **given})
    assert not list(tmp_path.iterdir())


def test_pixels_of_a_rendered_picture_are_read_exactly(scene, tmp_path):
    page = Page(250, 240, "#1380ff")
    page.write(tmp_path / "page.png")
    assert np.array_equal(figures._pixels(tmp_path / "page.png"), page.picture)
    assert "page.png" not in bpy.data.images
