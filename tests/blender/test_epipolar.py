"""A picked pixel: its ray, its epipolar lines and the marker, by operator; what each of them does to a known point."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from mathutils import Matrix

from mphdrr.addon.blender import ids
from mphdrr.addon.perspective import epipolar, epipolar_drawing
from mphdrr.addon.pictures import images, planes, tiles
from mphdrr.addon.volumes import volumes
from mphdrr.core.errors import InputError
from mphdrr.core.geometry.grid import Grid
from mphdrr.core.perspective.perspective_grid import PerspectiveGrid
from mphdrr.core.volumes.volume import Volume

from .conftest import refused, reopened, update

POINT = np.array([9.0, -6.0, 12.0])


@pytest.fixture
def projected(scene, ring):
    """Return a function that renders a small source, off every axis, in a scanner of eight modules; it returns the views."""
    volumes.add_volume(Volume(np.ones((2, 2, 2), np.float32), Grid.centered(2, 3.0, POINT)), "Point")

    def project(**settings):
        assert bpy.ops.mphdrr.render_projections(**{"width": 90, "height": 60} | settings) == {"FINISHED"}
        update()
        return epipolar.run_views(scene)

    return project


def seen_from(run: epipolar.RunViews, number: int, point: np.ndarray) -> np.ndarray:
    """Return column, row and k of a world point in a module, from the core's perspective grid."""
    return PerspectiveGrid(run.views, run.numbers.index(number), 1, 1.0, 2.0).from_world(point)


@pytest.mark.parametrize("detector", ["VIRTUAL", "REAL"])
def test_the_marker_at_a_points_k_is_where_the_modules_see_the_point(projected, scene, detector):
    run = projected(detector=detector, magnification=7.0, width=360, height=240)
    column, row, k = seen_from(run, 3, POINT).tolist()
    assert bpy.ops.mphdrr.pick_pixel(module=3, column=column, row=row, k=k) == {"FINISHED"}
    found = epipolar.picked_pixel(scene)
    np.testing.assert_allclose(found.marker, POINT, atol=1e-4)
    assert found.seen_by == 8 and found.depth == pytest.approx(np.linalg.norm(POINT - found.ray[0]), rel=0.1)
    for number, place in zip(run.numbers, found.marker_pixels, strict=True):
        exact = images.projection_array(bpy.data.images[ids.projection_name(number, 8)]).astype(float)
        rows, columns = np.indices(exact.shape)
        centre = np.array([(exact * columns).sum(), (exact * rows).sum()]) / exact.sum()
        assert np.abs(place - centre).max() < 0.1


def test_lines_lead_through_all_that_the_ray_shows_and_the_slider_along_it(projected, scene):
    run = projected()
    bpy.ops.mphdrr.pick_pixel(module=6, column=40.25, row=31.5)
    settings, last = scene.mphdrr_epipolar, None
    at_isocentre = epipolar.picked_pixel(scene)
    axis = at_isocentre.marker - at_isocentre.run.views.sources[5]
    middle = run.views.sources[5] / np.linalg.norm(run.views.sources[5])
    assert axis @ -middle == pytest.approx(np.linalg.norm(run.views.sources[5]), rel=1e-6), "at the isocentre's depth"
    lines, radius = at_isocentre.lines_in_roi, at_isocentre.run.roi_radius[5]
    for along, depth in ((0.0, -radius), (0.3, None), (1.0, radius)):
        settings.along = along
        assert settings.along == pytest.approx(along, abs=1e-5)
        found = epipolar.picked_pixel(scene)
        if depth is not None:
            assert found.marker @ middle == pytest.approx(-depth, abs=1e-2)
        assert found.marker_pixels[5].tolist() == [40.25, 31.5]
        others = np.isfinite(found.marker_pixels).all(axis=1)
        others[5] = False
        assert others.sum() > 4 and found.seen_by == others.sum() + 1
        first, end = found.lines[others].swapaxes(0, 1)
        place, way = found.marker_pixels[others], end - first
        off = np.cross(np.pad(place - first, ((0, 0), (0, 1))), np.pad(way, ((0, 0), (0, 1))))[:, 2]
        assert np.abs(off / np.linalg.norm(way, axis=1)).max() < 1e-9, "every epipolar line holds the marker's image"
        ends = lines[others][:, int(along)]
        if along in (0.0, 1.0):
            whole = (np.abs(ends - place) < 1e-2).all(axis=1)
            assert whole.any(), "the bright part of the line is that of the ROI's depths"
        if last is not None:
            assert (np.linalg.norm(found.marker_pixels[others] - last[others], axis=1) > 0.1).all(), "all images move"
        last = found.marker_pixels
    np.testing.assert_array_equal(epipolar.picked_pixel(scene).lines, at_isocentre.lines)


def test_epipoles_are_where_pinholes_are_seen(projected, scene):
    run = projected()
    bpy.ops.mphdrr.pick_pixel(module=1, column=40, row=20)
    found = epipolar.picked_pixel(scene)
    is_seen = np.isfinite(found.epipoles).all(axis=1)
    assert not is_seen[0]
    for i, number in enumerate(run.numbers[1:], 1):
        column, row, k = seen_from(run, number, run.views.sources[0])
        assert is_seen[i] == (k > 0 and -0.5 <= column <= 89.5 and -0.5 <= row <= 59.5)
        if is_seen[i]:
            np.testing.assert_allclose(found.epipoles[i], (column, row), atol=1e-8)
            np.testing.assert_allclose(found.lines[i, 0], (column, row), atol=1e-8)


def test_what_is_impossible_is_refused_in_a_line(projected, scene):
    refused(bpy.ops.mphdrr.pick_pixel, "No projections yet", module=1)
    projected()
    for wrong, said in (
        ({"module": 9}, "module 9: the shown run has none of this number"),
        ({"module": 1, "column": 90}, r"column 90, row 0: the images have columns 0 to 89 and rows 0 to 59"),
    ):
        refused(bpy.ops.mphdrr.pick_pixel, said, **wrong)
        assert epipolar.picked_pixel(scene) is None
    bpy.ops.mphdrr.pick_pixel(module=1, column=3, row=4)
    scene.mphdrr_epipolar.row = 61
    problem = "column 3, row 61: the images have columns 0 to 89 and rows 0 to 59"
    assert epipolar.picked_or_problem(scene) == (None, problem)
    scene.mphdrr_epipolar.row, scene.mphdrr_epipolar.module = 5, 2
    assert epipolar.picked_pixel(scene).index == 1
    del bpy.data.images[ids.MOSAIC]["mphdrr_views"]
    epipolar._runs.clear()
    refused(bpy.ops.mphdrr.pick_pixel, "kept by an earlier version", module=1)


def test_a_pixel_stays_picked_while_runs_have_its_views(projected, scene, tmp_path):
    projected()
    bpy.ops.mphdrr.pick_pixel(module=2, column=33.3, row=21)
    scene.mphdrr_epipolar.along = 0.25
    before = epipolar.picked_pixel(scene)
    projected()
    again = epipolar.picked_pixel(scene)
    assert again.pixel.tolist() == [33.3, 21] and again.k == before.k, "other numbers of the same views"
    projected(width=50)
    assert epipolar.picked_pixel(scene) is None and scene.mphdrr_epipolar.along == 0, "pixels of other views"
    bpy.ops.mphdrr.show_run(index=0)
    assert epipolar.picked_pixel(scene).marker.tolist() == before.marker.tolist()
    scene = reopened(tmp_path / "kept.blend")
    assert epipolar.picked_pixel(scene).marker.tolist() == before.marker.tolist(), "saved"
    assert bpy.ops.mphdrr.clear_pixel() == {"FINISHED"} and epipolar.picked_pixel(scene) is None
    bpy.ops.mphdrr.pick_pixel(module=2, column=33.3, row=21)
    while scene.mphdrr_projections.runs:
        bpy.ops.mphdrr.remove_run(index=0)
    assert epipolar.picked_pixel(scene) is None and epipolar.run_views(scene) is None


def test_picking_is_undone_and_done_again(projected, scene):
    bpy.context.preferences.edit.use_global_undo = True
    projected()
    bpy.ops.ed.undo_push(message="Start")
    for number in (4, 5):
        bpy.ops.mphdrr.pick_pixel(module=number, column=10.0 + number, row=20)
        bpy.ops.ed.undo_push(message="Pick")

    def pixel():
        found = epipolar.picked_pixel(bpy.context.scene)
        return None if found is None else (found.run.numbers[found.index], *found.pixel.tolist())

    assert pixel() == (5, 15, 20)
    bpy.ops.ed.undo()
    assert pixel() == (4, 14, 20)
    bpy.ops.ed.undo()
    assert pixel() is None
    bpy.ops.ed.redo()
    assert pixel() == (4, 14, 20)


@pytest.mark.parametrize(
    ("half", "detector", "pixels"),
    [(False, "VIRTUAL", (90, 60)), (True, "REAL", (44, 32)), (True, "VIRTUAL", (350, 250))],
)
def test_pixels_and_places_in_pictures_are_one_to_one(projected, scene, half, detector, pixels):
    scene.mphdrr_display.half = half
    run = projected(detector=detector, width=pixels[0], height=pixels[1])
    shape = run.views.shape
    rng = np.random.default_rng(5)
    for image in (bpy.data.images[name] for name in (ids.MOSAIC, "mphDRR 07", "mphDRR 07 picture")):
        shown = tiles.shown_pictures(image)
        assert [picture.number for picture in shown] == (run.numbers if image.name == ids.MOSAIC else [7])
        for picture in shown:
            left_out = 0.5 - 0.5 * np.array(picture.share)
            within = rng.uniform(left_out + 0.02, 0.98 - left_out, (5, 2)) * [pixels[0], pixels[1]] - 0.5
            places = picture.image_positions(within, shape)
            np.testing.assert_allclose(picture.projection_pixels(places, shape), within, atol=1e-9)
            width, height = image.size
            for (down, right), (column, row) in zip(places, within, strict=True):
                found, place = tiles.picture_at(image, right / width, 1 - down / height)
                assert found == picture and picture.pixel_at(place, shape) == (round(column), round(row))


@pytest.mark.parametrize(("half", "detector"), [(False, "VIRTUAL"), (True, "REAL")])
def test_a_line_of_sight_to_a_plane_meets_the_pixel_that_it_shows(projected, scene, half, detector):
    scene.mphdrr_display.half = half
    run = projected(detector=detector)
    scene.mphdrr_display.plane_distance = 60.0
    update()
    for number, column, row in ((2, 41, 33), (7, 50, 20)):
        source, targets = run.views.sources[number - 1], run.views.rays(number - 1)[1].reshape(60, 90, 3)
        way = targets[row, column] - source
        # From the ROI, a little beside the pixel's ray: on the plane that is far less than a pixel.
        on_ray = source + way * 100.0 / np.linalg.norm(way)
        assert epipolar_drawing.plane_pixel(bpy.context, run, on_ray, -way) == (number, column, row)
        found = epipolar_drawing.plane_pixel(bpy.context, run, source + 0.01 * way, way)
        assert found is None or found[0] != number, "from behind, a plane is not seen"
    scene.mphdrr_display.planes = "NONE"
    update()
    assert epipolar_drawing.plane_pixel(bpy.context, run, on_ray, -way) is None


def test_lines_on_planes_are_on_the_lines_of_sight_to_the_ray(projected, scene):
    """Seen from its pinhole, what is drawn on a module's plane covers what it is the image of."""
    run = projected()
    bpy.ops.mphdrr.pick_pixel(module=8, column=37, row=30)
    found = epipolar.picked_pixel(scene)
    view = type("View", (), {"is_perspective": True, "view_matrix": Matrix.Identity(4)})
    context = type("Context", (), {"scene": scene, "region_data": view, "view_layer": bpy.context.view_layer})
    _, (roi, _, _), _, (rings, _, _), (square, _, _) = epipolar_drawing._plane_segments(context, found)
    shown = [plane.mphdrr_module.number for plane in planes.planes(scene)]
    others = [number for number in shown if number != 8]
    assert len(square) == 4
    for number, ends, ring in zip(others, roi.reshape(7, 4, 3), rings.reshape(7, 24, 2, 3), strict=True):
        i = run.numbers.index(number)
        drawn = epipolar.project_points(run.views, ends[np.isfinite(ends).all(axis=1)])[i]
        place, line = found.marker_pixels[i], found.lines_in_roi[i]
        radius = np.linalg.norm(epipolar.project_points(run.views, ring.reshape(-1, 3))[i] - place, axis=1)
        at_end = np.abs(drawn[:, None] - line).max(axis=2).min(axis=1) < 1e-3  # so on the same line of sight
        at_circle = np.isclose(np.linalg.norm(drawn - place, axis=1), 0.05 * 90, rtol=0.01)
        assert (at_end != at_circle).all() and at_end.sum() == at_circle.sum() == len(drawn) / 2
        np.testing.assert_allclose(radius, 0.05 * 90, rtol=0.01, err_msg="a circle around the marker's image")


def test_a_line_is_open_where_the_marker_is(scene):
    ends = np.array([[(0, 0), (10, 0)], [(0, 0), (0, 10)], [(0, 0), (10, 0)], [(np.nan, 0), (3, 3)], [(0, 0), (8, 6)]])
    places = np.array([(4, 0), (0, 9), (np.nan, np.nan), (0, 0), (0, 0)])
    nothing = np.full((2, 2), np.nan)
    expected = [
        ([(0, 0), (2, 0)], [(6, 0), (10, 0)]),
        ([(0, 0), (0, 7)], nothing),
        ([(0, 0), (10, 0)], nothing),
        (nothing, nothing),
        (nothing, [(1.6, 1.2), (8, 6)]),
    ]
    np.testing.assert_allclose(epipolar_drawing._cut_at(ends, places, 2.0), np.array(expected), atol=1e-12)


def test_a_run_of_another_scene_has_no_lines_here(projected, scene):
    projected()
    bpy.ops.mphdrr.pick_pixel(module=2, column=33, row=21)
    other = bpy.data.scenes.new("Other")
    other.mphdrr_epipolar.views = scene.mphdrr_epipolar.views
    assert epipolar.picked_pixel(other) is None and epipolar.picked_pixel(scene) is not None
    with pytest.raises(InputError, match="of another scene"):
        epipolar.pick_pixel(other, 2, 33, 21)
