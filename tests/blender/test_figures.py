"""Figures, pictures and animations of a scene, rendered in a studio that leaves no trace; the light of scenes."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import bpy
import numpy as np
import pytest
from mathutils import Vector
from PIL import Image

import mphdrr.core as mph
from mphdrr.addon.blender import ids, jobs, storage
from mphdrr.addon.cli import main
from mphdrr.addon.cli.scene import save_scene
from mphdrr.addon.figures import engine, figures, studio, surfaces
from mphdrr.addon.runs import rendering
from mphdrr.addon.scanner import scanner, selection
from mphdrr.addon.volumes import slices, volumes
from mphdrr.core.figures.kinds import KINDS
from mphdrr.core.figures.page import Page
from mphdrr.core.figures.parts import heading_height
from mphdrr.core.recording import recorded_warnings
from mphdrr.operators import figure

from .conftest import datablocks, pixels, refused, update


def state() -> tuple:
    """Return what the user has: datablocks, what is hidden, selected and active, and the scene's settings."""
    scene, render = bpy.context.scene, bpy.context.scene.render
    objects = [(o.name, o.hide_viewport, o.hide_render, o.select_get(), o.data and o.data.users) for o in scene.objects]
    look = render.engine, render.resolution_x, render.filepath, scene.camera, scene.world, scene.frame_current
    return datablocks(), objects, look, bpy.context.view_layer.objects.active, bpy.context.scene.name


@pytest.fixture
def example(scene, dc_spect, tmp_path):
    """Return a scene of a scanner with some modules hidden, a phantom that was moved, and projections."""
    system = dc_spect[::4]
    collection = scanner.build_scanner(scene, system)
    pose = mph.euler_pose(0.3, 0.2, 0.1, (4.0, 0.0, -6.0))
    volume = mph.DerenzoPhantom(40, (8, 6, 5, 4, 3, 2), 40, 100).voxelize(mph.Grid.centered(24, 4.0), pose)
    item = volumes.add_volume(volume, "Derenzo", pose)
    views = system.views(shape=(16, 16))
    run = mph.ProjectionRun(mph.Projector(volume.grid, views)(volume), system, views, volume)
    mph.write_run(run, tmp_path / "run.h5")
    rendering.show_run(scene, run, tmp_path / "run.h5", item)
    scanner.show_modules(collection, "5-41")
    update()
    return scene


def draw(kind: str, path: Path, size: tuple[int, int], **options) -> list[str]:
    """Draw a figure into a file, and return what is warned of."""
    with recorded_warnings() as texts:
        jobs.run(figures.figure_job(bpy.context, kind, [path], size, **options))
    return texts


def picture(path) -> np.ndarray:
    return np.asarray(Image.open(path).convert("RGB")).astype(int)


@pytest.mark.long
def test_a_rendered_figure_leaves_the_scene_as_it_was(example, tmp_path):
    before = state()
    path = tmp_path / "figure.png"
    bpy.ops.mphdrr.export_figure(filepath=str(path), figure="CUT_AWAY", width=320, height=240, samples=1)
    assert state() == before
    shown = picture(path)
    assert shown.shape == (240, 320, 3) and shown.std() > 15
    drawn = (np.abs(shown - shown[-1, 0]) > 24).any(axis=2)  # beside the paper, which title and colour bar keep free
    assert 0.1 < drawn.mean() < 0.8 and 60 < shown[drawn].mean() < 200, "neither empty, black nor burnt out"


@pytest.mark.long
def test_a_scanner_fits_its_figure_with_even_margins(example, tmp_path):
    for size in ((480, 240), (240, 420)):
        path = tmp_path / f"{size[0]}.png"
        draw("scanner", path, size, labels=False, samples=2)
        shown = picture(path)
        inside = np.argwhere((np.abs(shown - shown[2, 2]) > 24).any(axis=2))
        free = [*inside.min(axis=0), *(np.array(shown.shape[:2]) - 1 - inside.max(axis=0))]
        margin = 0.04 * min(size)
        assert min(free) > margin - 4, "nothing is cut off"
        assert abs(free[1] - free[3]) < 8 and abs(free[0] - free[2]) < 8, "the margins are even"
        assert min(free) < margin + 6, "it is as large as fits"


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
    arguments, export = {"filepath": str(tmp_path / "a.png"), "figure": "C_ARM"}, bpy.ops.mphdrr.export_figure
    refused(export, "Nothing to show: import a workbook or add a phantom first", filepath=arguments["filepath"])
    scanner.build_scanner(scene, dc_spect[:4])
    for changes, message in (
        ({"figure": "SUMS"}, "no volume in the scene"),
        ({"figure": "MOSAIC"}, "no projections"),
        ({"figure": "CUT_AWAY"}, "no volume"),
        ({"width": 900}, "give both width and height, or neither"),
        ({"modules": "90"}, "no module 90; there are 1 to 4"),
        ({"filepath": str(tmp_path / "a.bmp")}, r"expected a name ending in .png, .svg"),
    ):
        refused(export, message, **(arguments | changes))
    assert not list(tmp_path.iterdir())


def test_pixels_of_a_rendered_picture_are_read_exactly(scene, tmp_path):
    page = Page(250, 240, "#1380ff")
    page.write(tmp_path / "page.png")
    assert np.array_equal(engine.read_pixels(tmp_path / "page.png"), page.picture)
    assert "page.png" not in bpy.data.images


@pytest.mark.long
@pytest.mark.parametrize("look", ["DENSITY", "SHELL"])
def test_a_volume_is_seen_or_its_absence_is_said(example, tmp_path, look):
    """As smoke, and as a surface that is an object of its own."""
    (item,) = volumes.volume_objects(example)
    item.mphdrr_volume.look, path = look, tmp_path / "a.png"
    before = state()
    for kind in ("cut-away", "inside"):
        assert draw(kind, path, (320, 240), labels=False, samples=1) == []
    assert state() == before
    shown = picture(path)
    assert np.count_nonzero(shown[..., 0] - shown[..., 1:].min(axis=-1) > 40) > 200, "the phantom's colours"
    item.mphdrr_volume.display_high = item.mphdrr_volume.surface = 1e7
    item.mphdrr_volume.display_low = 9e6
    (text,) = draw("inside", path, (240, 150), samples=1)
    assert "Low and High draw none of its values" in text


def rendered(scene, capfd) -> str:
    """Return what is said beside Blender's own Render, which writes its picture all the same."""
    path = storage.folder() / "render.png"
    path.unlink(missing_ok=True)
    scene.render.filepath = str(path)
    capfd.readouterr()
    bpy.ops.render.render(write_still=True)
    assert path.is_file() and not any(s.name.startswith("mphDRR studio") for s in bpy.data.scenes)
    return "\n".join(line for line in capfd.readouterr().err.splitlines() if line.startswith("mphDRR"))


@pytest.fixture
def small_render(example):
    render, example.camera = example.render, scanner.modules(scanner.active_scanner(example))[0]
    render.engine, example.cycles.samples = "CYCLES", 1
    render.resolution_x = render.resolution_y = 16
    update()
    return example


def test_render_says_which_volumes_of_the_view_it_lacks(small_render, capfd, monkeypatch):
    (item,) = volumes.volume_objects(small_render)
    monkeypatch.setattr(figures, "draw_figure", lambda *_: iter(()))  # whose own tests are above
    assert rendered(small_render, capfd) == ""
    item.hide_render = True
    nothing = f"mphDRR: the picture shows nothing of {item.name!r}: "
    assert rendered(small_render, capfd) == f"{nothing}it is hidden in renders"
    item.hide_set(True)
    assert rendered(small_render, capfd) == "", "it is seen nowhere, as is meant"
    item.hide_set(False)
    item.hide_render = False
    home = bpy.data.collections.new("Home")
    small_render.collection.children.link(home)
    home.objects.link(item)
    small_render.collection.objects.unlink(item)
    home.hide_render = True
    assert "is hidden in renders" in rendered(small_render, capfd)
    home.hide_render = False
    update()
    assert rendered(small_render, capfd) == ""
    volumes.file_of(item).unlink()
    storage._cached_size.cache_clear()
    assert rendered(small_render, capfd).endswith(f"nothing of {item.name!r}: its files are missing")


@pytest.mark.long
@pytest.mark.parametrize("has_scanner", [True, False])
def test_render_says_what_cycles_does_not_draw(small_render, capfd, has_scanner):
    """Also of a volume far off, and in a scene without a scanner."""
    (item,) = volumes.volume_objects(small_render)
    if not has_scanner:
        small_render.camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
        small_render.collection.objects.link(small_render.camera)
        small_render.collection.children.unlink(scanner.active_scanner(small_render))
        item.location = (250.0, -300.0, 120.0)
        update()
    figures._known_visible.clear()
    assert rendered(small_render, capfd) == ""
    assert figures._known_visible, "it was tried"
    item.mphdrr_volume.display_high = 9e9
    item.mphdrr_volume.display_low = 8e9
    assert "Low and High draw none of its values" in rendered(small_render, capfd)


def test_figures_of_volumes_are_not_made_of_runs_that_have_none(dc_spect, tmp_path, capsys):
    system = dc_spect[:3]
    counts = np.random.default_rng(1).poisson(4.0, (3, 4, 4))
    mph.write_run(mph.counts_run(counts, system, "1-3", "back-v", 9.0), tmp_path / "run.h5")
    for kind in ("cut-away", "inside", "sums"):
        assert main(["figure", kind, str(tmp_path / "run.h5"), "-o", str(tmp_path / "a.png")]) == 1
        assert "needs a volume" in capsys.readouterr().err
    assert not (tmp_path / "a.png").exists()


SIZE = (192, 120)
PAPERS = {"dark": (20, 22, 26), "light": (255, 255, 255)}


@pytest.fixture
def pictured(scene, dc_spect):
    scanner.build_scanner(scene, dc_spect[::8])
    volume = mph.DerenzoPhantom(40, (12, 10, 8, 8, 6, 6), 40, 100).voxelize(mph.Grid.centered(24, 4.0))
    return volumes.add_volume(volume, "Derenzo")


def share_of_phantom(shown: np.ndarray) -> float:
    """Return the share of pixels that are violet, red or yellow, as activity is and nothing else."""
    red, green, blue = np.moveaxis(shown, -1, 0)
    return float(np.mean((red - green > 40) | (red - blue > 60)))


def share_of_paper(shown: np.ndarray, style: str) -> float:
    return float(np.mean((np.abs(shown - PAPERS[style]) <= 2).all(axis=-1)))


def share_of_lit(shown: np.ndarray) -> float:
    """Return the share of pixels in the blue of rays and lit modules."""
    return float(np.mean(shown[..., 2] - shown[..., 0] > 40))


def test_a_picture_shows_the_phantom_on_its_paper(pictured, tmp_path):
    """On light paper; animations are on dark."""
    path, size = tmp_path / "picture.png", {"width": SIZE[0], "height": SIZE[1]}
    bpy.ops.mphdrr.render_picture(filepath=str(path), style="light", samples=2, labels=False, **size)
    shown = picture(path)
    assert share_of_phantom(shown) > 0.02
    assert share_of_paper(shown, "light") > 0.1 and share_of_paper(shown, "dark") < 0.02


def test_an_animation_has_the_phantom_on_its_first_and_last_picture(pictured, tmp_path):
    left, right = scanner.modules(scanner.active_scanner(bpy.context.scene))[3:5]
    selection.select(bpy.context, (left, right))
    for kind in ("TURNTABLE", "LIGHT_UP"):
        path, folder = tmp_path / f"{kind}.mp4", tmp_path / f"{kind}-frames"
        folder.mkdir()
        (folder / f"{kind}-0099.png").touch()  # of a longer one before
        bpy.ops.mphdrr.render_animation(
            filepath=str(path), figure=kind, width=SIZE[0], height=SIZE[1], samples=1, seconds=0.2, fps=10, labels=False
        )
        frames = sorted(folder.iterdir())
        assert [frame.name for frame in frames] == [f"{kind}-{k:04d}.png" for k in (1, 2)]
        first, last = picture(frames[0]), picture(frames[-1])
        assert min(share_of_phantom(first), share_of_phantom(last)) > 0.008
        assert min(share_of_paper(first, "dark"), share_of_paper(last, "dark")) > 0.1
        assert np.abs(first - last).max() > 60, "something happens"
        clip = bpy.data.movieclips.load(str(path))
        assert (tuple(clip.size), clip.frame_duration, clip.fps) == (SIZE, 2, 10)
    assert share_of_lit(last) > share_of_lit(first), "the second module is lit beside the first"
    assert not [scene for scene in bpy.data.scenes if scene.name.startswith("mphDRR")]


def test_an_animation_that_is_ended_keeps_its_pictures(pictured, tmp_path, monkeypatch):
    grey = np.full((SIZE[1], SIZE[0], 3), 200, np.uint8)
    monkeypatch.setattr(figures, "_render_pixels", lambda scene: (yield 0.0) or grey)
    path = tmp_path / "film.mp4"
    path.write_bytes(b"older")

    def started(**more):
        job = figures.figure_job(bpy.context, "turntable", [path], SIZE, seconds=1.0, fps=9, **more)
        steps = job.finish(job.work(lambda done, total: None))
        while next(steps) != ("rendering", 3, 9):
            pass
        return job, steps

    job, steps = started()
    with pytest.raises(mph.Cancelled):
        steps.throw(mph.Cancelled())
    assert job.leftovers() == f"3 pictures are in {tmp_path / 'film-frames'}"
    assert len(list((tmp_path / "film-frames").iterdir())) == 3 and path.read_bytes() == b"older"
    job, steps = started()
    job.finish_now.set()
    list(steps)
    assert bpy.data.movieclips.load(str(path)).frame_duration == 3
    assert sorted(found.name for found in tmp_path.iterdir()) == ["film-frames", "film.mp4"]


def test_a_surface_lies_at_its_value_and_has_the_colours_of_what_it_encloses(scene):
    """Two balls with values that fall linearly from their centres: 100 and 40 kBq/mL."""
    grid = mph.Grid.centered(40, 2.0)
    centers = np.array([[-20.0, 0, 0], [20.0, 0, 0]])
    points = (grid.affine[:3, :3] @ np.indices(grid.shape).reshape(3, -1)).T + grid.affine[:3, 3]
    distances = np.linalg.norm(points[:, None] - centers, axis=2)
    values = (np.array([100.0, 40.0]) * np.clip(1 - distances / 8.0, 0, 1)).max(axis=1)
    volume = mph.Volume(values.reshape(grid.shape).astype(np.float32), grid, "activity")
    shares = []
    surface = surfaces.surface_maker(volumes.add_volume(volume, "Balls"))(volume, lambda *step: shares.append(step))
    assert surface.level == pytest.approx(0.25 * volume.array.max()) and shares[-1][0] == shares[-1][1]
    left = surface.mesh.vertices[:, 0] < 0
    for half, center, peak in ((left, centers[0], 100.0), (~left, centers[1], 40.0)):
        radii = np.linalg.norm(surface.mesh.vertices[half] - center, axis=1)
        assert np.abs(radii - 8 * (1 - surface.level / peak)).max() < 0.6, "mm, of a quarter of the voxels' size"
        true_color = surface.display.colored(volume.array[grid_index(grid, center)], surface.window)
        assert np.abs(surface.colors[half].astype(int) - true_color).max() <= 24, "a step of the palette in 16"


def test_bones_are_whole_in_pictures_as_in_the_window(scene):
    """Their look has slices, at which the window cuts the skin around them open."""
    grid = mph.Grid.centered(40, 2.0)
    distances = np.linalg.norm((np.indices(grid.shape).reshape(3, -1).T - 19.5) * 2.0, axis=1).reshape(grid.shape)
    hu = np.where(distances < 30, np.clip(1000 - 40 * distances, 40, None), -1000.0)  # 250 HU at 18.75 mm
    volume = mph.Volume(hu.astype(np.float32), grid, "hu")
    item = volumes.add_volume(volume, "CT")
    assert item.mphdrr_volume.look == "BONE" and slices.planes_of(item)
    vertices = surfaces.surface_maker(item)(volume, lambda *step: None).mesh.vertices
    assert np.abs(np.linalg.norm(vertices, axis=1) - 18.75).max() < 0.2, "all of the bone's surface, and nothing else"
    assert (vertices.min(axis=0) < -18).all() and (vertices.max(axis=0) > 18).all()


def grid_index(grid: mph.Grid, point: np.ndarray) -> tuple[int, ...]:
    return tuple(np.rint(grid.index_from_world[:3, :3] @ point + grid.index_from_world[:3, 3]).astype(int))


def test_nothing_of_a_picture_is_under_its_title_and_its_colour_bar(pictured, dc_spect, tmp_path):
    """The picture fills what they leave, and half of its height is the phantom."""
    scanner.build_scanner(bpy.context.scene, dc_spect, replace=True)
    draw("picture", tmp_path / "a.png", (480, 300), samples=1)
    shown, top = picture(tmp_path / "a.png"), heading_height(Page(480, 300), 1)
    is_paper = (np.abs(shown - PAPERS["dark"]) <= 4).all(axis=2)
    assert is_paper[top - 2 : top].all(), "between the title and the picture"
    assert not is_paper[top : top + 4].all(), "where modules begin"
    right = max(column for column in range(480) if not is_paper[top : top + 20, column].all())
    assert 400 < right < 460 and is_paper[top:, right + 1 : right + 5].all(), "between the picture and the colour bar"
    red, green, blue = np.moveaxis(shown[top:, : right + 1], -1, 0)
    rows = np.flatnonzero(((red - green > 40) | (red - blue > 60)).mean(axis=1) > 0.01)
    assert 0.4 < np.ptp(rows) / (300 - top) < 0.9


def test_the_progress_of_a_picture_goes_up_to_its_end_in_one_stage(pictured, tmp_path, monkeypatch):
    grey = np.full((SIZE[1], SIZE[0], 3), 200, np.uint8)

    def render(scene):
        yield from (0.0, 0.25, 0.5, 1.0)
        return grey

    monkeypatch.setattr(figures, "_render_pixels", render)
    job, done = figures.figure_job(bpy.context, "picture", [tmp_path / "a.png"], SIZE, labels=False), []
    steps = job.finish(job.work(lambda *step: done.append((job.label, *step))))
    done += list(steps)
    shares = [n / total for _, n, total in done]
    assert {label for label, *_ in done} == {job.label}
    assert shares == sorted(shares) and shares[0] == 0 and shares[-1] == 1 and len(set(shares)) > 6


def test_a_blender_without_denoiser_takes_more_rays_and_says_so_once(scene, monkeypatch):
    monkeypatch.setitem(sys.modules, "_cycles", SimpleNamespace(with_openimagedenoise=False))
    engine.can_denoise.cache_clear()
    with recorded_warnings() as texts:
        for _ in range(2):
            engine.set_up(scene, (160, 120), 5)
            assert not scene.cycles.use_denoising and scene.cycles.samples == 15
    engine.can_denoise.cache_clear()
    assert [text.split(":")[0] for text in texts] == ["this Blender lacks OpenImageDenoise"]


def test_taking_auto_away_begins_with_the_size_that_suits_the_figure():
    chosen = SimpleNamespace(figure="MOSAIC_WIDE", automatic=False)
    figure._change_size(chosen, bpy.context)
    assert (chosen.width, chosen.height) == KINDS["mosaic-wide"].size
    chosen.automatic = True
    figure._change_size(chosen, bpy.context)
    assert (chosen.width, chosen.height) == (0, 0), "which is Auto"


def test_animations_refuse_what_cannot_be(tmp_path, capsys):
    common = ["figure", "light-up", "scene.blend", "-o"]
    for words, said in (
        (["a.png"], "expected a name ending in .mp4"),
        (["a.mp4", "--size", "321x200"], "size 321x200: both must be even for an animation"),
        (["a.mp4", "--seconds", "0"], "0 s of 24 pictures each: expected more than 0 for both"),
    ):
        assert main([*common, str(tmp_path / words[0]), *words[1:]]) == 1
        assert said in capsys.readouterr().err


def studios(scene) -> list[bpy.types.Collection]:
    return [c for c in scene.collection.children if c.name.startswith(ids.STUDIO)]


def test_an_imported_scanner_is_lit_once(scene, small_workbook):
    world = scene.world
    for _ in range(2):
        bpy.ops.mphdrr.import_geometry(filepath=str(small_workbook))
        (home,) = studios(scene)
        assert {item.data.type for item in home.objects} == {"SUN"}
    assert scene.world == world and not scene.objects["Light"].hide_viewport


def test_a_scene_with_light_of_its_own_keeps_it(scene, ring_system):
    scene.objects["Light"].data.type = "AREA"
    studio.light(scene)
    assert not studios(scene)
    scene.world = None
    bpy.data.objects.remove(scene.objects["Light"])
    studio.light(scene)
    assert len(studios(scene)) == 1 and scene.world.name == ids.STUDIO


@pytest.mark.parametrize("world", ["the startup file's", "none"])
def test_a_rendered_scanner_is_neither_black_nor_bleached(scene, dc_spect, tmp_path, world):
    if world == "none":
        scene.world = None
    scanner.build_scanner(scene, dc_spect[::4])
    studio.light(scene)
    camera = studio.new_aimed_object(bpy.data.cameras.new("View"), Vector((0, 60, 0)), Vector((550, -400, 400)))
    camera.data.clip_end = 5000.0
    scene.collection.objects.link(camera)
    scene.camera, scene.render.engine, scene.cycles.samples = camera, "CYCLES", 1
    scene.render.resolution_x = scene.render.resolution_y = 64
    scene.render.filepath = str(tmp_path / "view.png")
    bpy.ops.render.render(write_still=True)
    picture = pixels(bpy.data.images.load(scene.render.filepath))[..., :3]
    assert 0.15 < picture.mean() < 0.6
    assert np.ptp(picture.mean(axis=2)) > 0.3, "lit sides and sides in shadow"
