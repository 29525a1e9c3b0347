"""Projections in colours: where they stand in the scene, what edits of the display change, and what they leave."""

import bpy
import numpy as np
import pytest
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Vector

from mphdrr.addon.blender import ids, updates
from mphdrr.addon.pictures import images, planes, recoloring, tiles
from mphdrr.addon.runs import rendering
from mphdrr.addon.scanner import module_edits, scanner, selection
from mphdrr.addon.volumes import volumes
from mphdrr.core.errors import InputError
from mphdrr.core.geometry.grid import Grid
from mphdrr.core.runs.display import Display
from mphdrr.core.runs.mosaic import as_seen
from mphdrr.core.volumes.volume import Volume

from .conftest import pixels, reopened, update

POINT = np.array([9.0, -6.0, 12.0])


@pytest.fixture
def projected(scene, ring):
    """Return a function that renders a small source, off every axis, with a scanner of eight modules for its planes."""
    volumes.add_volume(Volume(np.ones((2, 2, 2), np.float32), Grid.centered(2, 2.0, POINT)), "Point")

    def project(**settings):
        assert bpy.ops.mphdrr.render_projections(**{"width": 50, "height": 40} | settings) == {"FINISHED"}
        update()
        return planes.planes(scene)

    return project


def brightest(picture: bpy.types.Image) -> tuple[float, float]:
    """Return the place of the brightest pixel of a picture, from 0 to 1 to the right and upwards."""
    values = pixels(picture)[..., :3].sum(axis=-1)
    row, column = np.unravel_index(values.argmax(), values.shape)
    return (column + 0.5) / values.shape[1], (row + 0.5) / values.shape[0]


@pytest.mark.parametrize("detector", ["VIRTUAL", "REAL"])
def test_a_point_is_where_plane_camera_and_mosaic_show_it(projected, scene, ring_system, detector):
    made = projected(detector=detector, magnification=7.0)
    assert len(made) == 8
    shown = bpy.data.images[ids.MOSAIC]["mphdrr_tiles"]
    for plane, number in zip(made, ring_system.numbers, strict=True):
        camera, picture = plane.parent, plane.data
        assert camera == scanner.module(scanner.active_scanner(scene), number)
        x, y = brightest(picture)
        # The plane: its brightest pixel lies on the line from the pinhole to the point.
        side = plane.empty_display_size / max(picture.size)
        place = plane.matrix_world @ Vector(((x - 0.5) * picture.size[0] * side, (y - 0.5) * picture.size[1] * side, 0))
        seen, wanted = (world_to_camera_view(scene, camera, Vector(p)) for p in (place, POINT))
        assert abs(seen.x - wanted.x) < 1 / 50 and abs(seen.y - wanted.y) < 1 / 40
        assert 0 < seen.z < wanted.z, "it stands between pinhole and ROI"
        # The camera's view: a picture laid over it.
        (background,) = camera.data.background_images
        flip_x, flip_y = 1 - 2 * background.use_flip_x, 1 - 2 * background.use_flip_y
        in_view = (0.5 + background.offset[i] + flip * (at - 0.5) * background.scale
                   for i, (at, flip) in enumerate(((x, flip_x), (y, flip_y))))  # fmt: skip
        assert next(in_view) == pytest.approx(wanted.x, abs=1 / 50)
        assert next(in_view) == pytest.approx(wanted.y, abs=1 / 40)
        # The mosaic: the exact image's brightest pixel, at the module's tile.
        exact = as_seen(images.projection_array(bpy.data.images[ids.projection_name(number, 8)]))
        row, column = np.unravel_index(exact.argmax(), exact.shape)
        np.testing.assert_allclose((x, 1 - y), ((column + 0.5) / 50, (row + 0.5) / 40))
        assert number == shown["numbers"][planes.planes(scene).index(plane)]


def test_the_display_changes_pictures_and_leaves_numbers(projected, scene):
    projected()
    name = ids.projection_name(1, 8)
    before, picture = images.projection_array(bpy.data.images[name]), ids.picture_name(name)
    settings = scene.mphdrr_display
    everything = []
    settings.low = 0.01 * before.max()
    for edit in ({"colors": "GREY"}, {"scale": "LOG"}, {"high": 0.25 * before.max()}, {"automatic": False}):
        for setting, value in edit.items():
            setattr(settings, setting, value)
        everything.append(pixels(bpy.data.images[picture]))
        assert images.projection_array(bpy.data.images[name]).tobytes() == before.tobytes(), "to the last bit"
    assert len({colors.tobytes() for colors in everything}) == 3, "a window that is automatic does not follow High"
    expected = Display("grey", "log", settings.low, settings.high).colored(as_seen(before))
    np.testing.assert_array_equal(np.rint(everything[-1][::-1, :, :3] * 255), expected)
    settings.low = settings.high + 1
    assert settings.problem and np.array_equal(images.projection_array(bpy.data.images[name]), before)


@pytest.mark.parametrize(("part", "cut"), [("OBJECT", (15, 18)), ("HALF", (10, 12)), ("WHOLE", (0, 0))])
def test_a_readout_names_the_pixel_whose_colour_is_under_the_pointer(projected, scene, part, cut):
    """Whatever part the tiles show: the number has the colour of the place, and the pixel is within the part."""
    projected()
    settings, mosaic = scene.mphdrr_display, bpy.data.images[ids.MOSAIC]
    settings.region = part
    assert settings.region == part and (settings.half, settings.is_whole) == (part == "HALF", part == "WHOLE")
    shown, picture, rng = images.tiles(mosaic), pixels(mosaic)[::-1, :, :3], np.random.default_rng(2)
    display, rows, columns = settings.display(), set(), set()
    for corner in np.reshape(shown["corners"], (-1, 2)):
        for place in corner + np.array(shown["tile"]) * rng.uniform(
            (0.3, 0.0), (0.7, 1.0), (30, 2)
        ):  # beside the texts
            text, value = tiles.value_at(mosaic, place[1] / mosaic.size[0], 1 - place[0] / mosaic.size[1])
            expected = display.colored([value], shown["window"])[0]
            np.testing.assert_array_equal(np.rint(255 * picture[*place.astype(int)]), expected)
            column, row = (int(word.rstrip(",")) for word in text.split()[3::2])
            rows.add(row), columns.add(column)
    assert cut[0] <= min(rows) and max(rows) < 40 - cut[0] and {cut[1], 49 - cut[1]} <= columns
    assert set(columns) == set(range(cut[1], 50 - cut[1]))


def test_the_part_that_an_earlier_file_or_a_script_sets_is_the_one_in_the_panel(scene):
    settings = scene.mphdrr_display
    assert settings.region == "OBJECT"
    settings.half = True
    assert settings.region == "HALF" and settings.display().region == "half"
    settings.region = "OBJECT"
    assert not settings.half and settings.display().region == "object"


def test_a_number_picked_from_a_picture_is_the_exact_one_and_becomes_an_end_of_the_window(projected, scene):
    projected()
    settings, mosaic = scene.mphdrr_display, bpy.data.images[ids.MOSAIC]
    settings.region = "WHOLE"
    shown = images.tiles(mosaic)
    exact = images.projection_array(bpy.data.images[ids.projection_name(5, 8)])
    row, column = np.unravel_index(exact.argmax(), exact.shape)
    # As seen from the pinhole the first row is at the bottom, and the first column on the right.
    down, right = exact.shape[0] - 1 - row, exact.shape[1] - 1 - column
    place, larger = np.reshape(shown["corners"], (-1, 2))[4], np.array(shown["tile"]) / exact.shape
    for within in (0.01, 0.99):
        y, x = place + (np.array([down, right]) + within) * larger
        found = tiles.value_at(mosaic, x / mosaic.size[0], 1 - y / mosaic.size[1])
        assert found == (f"mphDRR 05, column {column}, row {row}", exact.max())
    for name in ("mphDRR 05", "mphDRR 05 picture"):
        found = tiles.value_at(bpy.data.images[name], (right + 0.5) / 50, 1 - (down + 0.5) / 40)
        assert found == (f"mphDRR 05, column {column}, row {row}", exact.max())
    assert tiles.value_at(mosaic, 0.999, 0.5) is None and tiles.value_at(mosaic, -0.1, 0.5) is None
    assert tiles.value_at(bpy.data.images.new("Other", 8, 8), 0.5, 0.5) is None
    with pytest.raises(InputError, match="expected low to be less than high"):
        tiles.set_window(settings, "low", 2 * shown["window"][1], shown["window"])
    assert settings.automatic
    tiles.set_window(settings, "high", found[1], shown["window"])
    assert (settings.low, settings.high, settings.automatic) == (shown["window"][0], exact.max(), False)
    tiles.set_window(settings, "low", 0.5 * found[1], shown["window"])
    assert settings.high == exact.max() and images.tiles(mosaic)["window"] == [settings.low, settings.high]


def test_the_mosaic_knows_each_images_sum_or_mean_and_its_maximum(projected):
    projected()
    for settings, word in (({}, "mean"), ({"model": "EMISSION"}, "sum")):
        projected(**settings)
        shown = images.tiles(bpy.data.images[ids.MOSAIC])
        exact = [images.projection_array(bpy.data.images[ids.projection_name(n, 8)]) for n in shown["numbers"]]
        assert shown["summed"] == word and shown["maxima"] == [image.max() for image in exact]
        np.testing.assert_allclose(shown["totals"], [getattr(image, word)(dtype=float) for image in exact], rtol=1e-12)


@pytest.mark.parametrize("detector", ["VIRTUAL", "REAL"])
def test_the_central_half_is_a_run_of_half_the_side(projected, scene, detector):
    """Its pictures are those of such a run, and stand in the scene where those stand."""
    settings = scene.mphdrr_display
    settings.automatic, settings.high = False, 20.0

    def pictures():
        update()
        made = planes.planes(scene)
        colors = [pixels(bpy.data.images[f"mphDRR 0{n} picture"]) for n in (2, 7)]
        backgrounds = [background for plane in made for background in plane.parent.data.background_images]
        views = [(background.scale, *background.offset) for background in backgrounds]
        return colors, [np.array(plane.matrix_world) * plane.empty_display_size for plane in made], views

    projected(detector=detector, width=40, pitch=2.0)
    first, places, views = pictures()
    bpy.ops.mphdrr.render_projections(width=80, height=80, detector=detector, pitch=2.0)
    wide = pictures()
    assert wide[2][0][0] == pytest.approx(2 * views[0][0])
    exact = images.projection_array(bpy.data.images["mphDRR 07"])
    settings.half = True
    for now, before, tolerance in zip(pictures(), (first, places, views), (1e-2, 1e-3, 1e-6), strict=True):
        np.testing.assert_allclose(now, before, atol=tolerance)
    assert np.array_equal(images.projection_array(bpy.data.images["mphDRR 07"]), exact) and exact.shape == (80, 80)
    # The eyedropper counts columns and rows in the whole array.
    for name, at in (("mphDRR 07 picture", (0.01, 0.01)), ("mphDRR 07", (0.51 * 0.5 + 0.25, 0.25))):
        found = tiles.value_at(bpy.data.images[name], *at)
        column, row = (int(word.rstrip(",")) for word in found[0].split()[3::2])
        assert found[1] == exact[row, column]
    assert tiles.value_at(bpy.data.images["mphDRR 07 picture"], 0.01, 0.01)[0] == "mphDRR 07, column 59, row 20"
    shown = images.tiles(bpy.data.images[ids.MOSAIC])
    row, column = np.reshape(shown["corners"], (-1, 2))[6]
    mosaic = bpy.data.images[ids.MOSAIC]
    found = tiles.value_at(mosaic, (column + 0.5) / mosaic.size[0], 1 - (row + 0.5) / mosaic.size[1])
    assert found == ("mphDRR 07, column 59, row 59", exact[59, 59])


def test_planes_of_the_active_module_its_ring_or_all_that_are_visible(projected, scene):
    made = projected()
    settings, collection = scene.mphdrr_display, scanner.active_scanner(scene)

    def shown():
        update()
        return [plane.mphdrr_module.number for plane in made if not plane.hide_viewport]

    assert shown() == list(range(1, 9))
    scanner.show_modules(collection, "2-3")
    assert shown() == [2, 3]
    scanner.show_modules(collection, mode="ALL")
    selection.select(bpy.context, [scanner.module(collection, 6)])
    for mode, numbers in (("ACTIVE", [6]), ("RING", [5, 6, 7, 8]), ("NONE", [])):
        settings.planes = mode
        assert shown() == numbers
    settings.planes = "ACTIVE"
    bpy.context.view_layer.objects.active = made[2]
    assert selection.active_module(bpy.context) == made[2].parent and shown() == [3], "a plane is part of its module"


def test_planes_go_with_their_modules(projected, scene):
    projected()
    collection = scanner.active_scanner(scene)
    module_edits.remove_modules(collection, [scanner.module(collection, 1)])
    assert [plane.mphdrr_module.number for plane in planes.planes(scene)] == [2, 3, 4, 5, 6, 7, 8]
    assert ids.picture_name(images.projection_name(1, range(8))) in bpy.data.images, "the run's pictures stay"
    bpy.data.objects.remove(scanner.module(collection, 5))  # as X does
    update()
    assert [plane.mphdrr_module.number for plane in planes.planes(scene) if plane.hide_viewport] == [5]
    scene.mphdrr_display.plane_opacity = 0.3


def test_planes_stand_where_they_are_told(projected, scene, ring_system):
    plane = projected(magnification=7.0)[4]
    settings = scene.mphdrr_display
    settings.plane_distance = 30.0
    assert plane.location.z == pytest.approx(-30.0)
    settings.plane_at_detector = True
    assert plane.location.z == pytest.approx(-7 * ring_system.collimator_length[4])
    settings.plane_opacity, settings.backgrounds = 0.25, False
    (background,) = plane.parent.data.background_images
    assert plane.color[3] == background.alpha == 0.25 and not background.show_background_image


def test_a_picture_of_the_users_on_a_plane_stays(projected, scene):
    projected()
    picture = bpy.data.images.new("Mine", 4, 4)
    planes.planes(scene)[0].data = picture
    planes.remove(scene)
    assert not planes.planes(scene) and bpy.data.images.get("Mine") == picture


def test_another_run_replaces_planes_and_backgrounds(projected, scene):
    projected()
    made = projected(last=3)
    assert [plane.mphdrr_module.number for plane in made] == [1, 2, 3]
    assert len(planes.planes(scene)) == 3 and sum(c.name.startswith(ids.PLANES) for c in bpy.data.collections) == 1
    backgrounds = [len(camera.data.background_images) for camera in scanner.modules(scanner.active_scanner(scene))]
    assert backgrounds == [1, 1, 1, 0, 0, 0, 0, 0]


def test_pictures_and_planes_survive_the_file(projected, scene, tmp_path):
    before = [tuple(plane.matrix_world.translation) for plane in projected()]
    name = ids.picture_name(ids.projection_name(2, 8))
    seen = brightest(bpy.data.images[name])
    reopened(tmp_path / "a.blend")
    made = planes.planes(bpy.context.scene)
    np.testing.assert_allclose([tuple(plane.matrix_world.translation) for plane in made], before)
    assert brightest(bpy.data.images[name]) == seen
    bpy.context.scene.mphdrr_display.colors = "VIRIDIS"
    assert brightest(bpy.data.images[name]) == seen


def test_backgrounds_are_as_large_as_their_camera_sees_them(projected, scene):
    plane = projected()[2]
    camera, (background,) = plane.parent, plane.parent.data.background_images
    before, angle = background.scale, camera.data.angle_x
    camera.mphdrr_module.collimator_length *= 1.25  # the camera sees less, and so more of its view is covered
    update()
    assert background.scale == pytest.approx(before * np.tan(angle / 2) / np.tan(camera.data.angle_x / 2), rel=1e-4)
    assert background.scale > 1.2 * before


def test_planes_of_another_scene_never_show_this_ones_run(projected, scene, ring_system):
    projected()
    evaluated = scene.view_layers[0].depsgraph
    assert sum(datablock.name.startswith("Projection") for datablock in evaluated.ids) >= 8
    other = bpy.data.scenes.new("Other")
    bpy.context.window.scene = other
    scanner.build_scanner(other, ring_system, "Other Ring")
    volumes.add_volume(Volume(np.ones((2, 2, 2), np.float32), Grid.centered(2, 2.0)), "Other Point")
    assert bpy.ops.mphdrr.render_projections(width=8, height=8) == {"FINISHED"}
    assert len(planes.planes(other)) == 8 and not planes.planes(scene)
    names = [item.name for item in evaluated.ids if item.id_type == "OBJECT"]
    assert names and not any(name.startswith("Projection") for name in names), "Blender's drawing would crash on them"
    assert images.belong_to(other) and not images.belong_to(scene)
    assert not any(c.data.background_images for c in scanner.modules(scanner.active_scanner(scene)))
    assert rendering.remove_run(scene, 0) and ids.MOSAIC in bpy.data.images, "the images are not of this run"


def shows(display: Display) -> bool:
    """Return whether all pictures show the exact numbers in this way."""
    found = [images.projection_array(bpy.data.images[ids.projection_name(k, 8)]) for k in range(1, 9)]
    window = display.window(np.stack(found))
    for number, exact in enumerate(found, 1):
        colors = pixels(bpy.data.images[ids.picture_name(ids.projection_name(number, 8))])[::-1, :, :3]
        if not np.array_equal(np.rint(255 * colors), display.colored(as_seen(exact), window)):
            return False
    return images.tiles(bpy.data.images[ids.MOSAIC])["display"] == repr(display)


def test_the_newest_display_wins_and_no_earlier_run_is_painted(projected, scene, monkeypatch):
    projected()
    # As in a window.
    monkeypatch.setitem(updates.FUNCTIONS, "display", lambda *_: setattr(recoloring, "_is_requested", True))
    scene.mphdrr_display.colors = "GREY"
    steps = recoloring.recoloring()
    next(steps)  # numbers are being read
    projected(width=20, height=20)
    for _ in steps:
        assert images.projection_array(bpy.data.images[ids.projection_name(8, 8)]).shape == (20, 20)
    assert shows(Display("grey", region="object"))
    scene.mphdrr_display.colors = "MAGMA"
    steps = recoloring.recoloring()
    while images.tiles(bpy.data.images[ids.MOSAIC])["display"] != "None":  # until the mosaic is made
        next(steps)
    scene.mphdrr_display.scale = "LOG"
    for _ in steps:
        pass
    assert shows(Display("magma", "log", region="object"))
    scene.mphdrr_display.colors = "VIRIDIS"
    assert not shows(Display("viridis", "log", region="object"))
    recoloring.check()  # as after an undo
    assert shows(Display("viridis", "log", region="object"))
