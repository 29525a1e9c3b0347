"""The coordinates (u, v, k) of views and the lattices in them."""

import itertools

import numpy as np
import pytest

import mphdrr.core as mph

from .conftest import distance_to_line, refused
from .odd_views import odd_views

CASES = pytest.mark.parametrize(("parallel", "uniform"), [(p, u) for p in (False, True) for u in ("k", "depth")])


def grids(parallel=False, uniform="k", n_k=7):
    return mph.perspective_grids(odd_views(parallel), n_k, 120.0, 330.0, uniform)


def test_round_trips_keep_world_points_pixels_and_k(scanner, rng):
    points = rng.uniform(-60, 60, (500, 3))
    for views in (scanner.views((256, 240)), scanner.views((256, 240), "real"), odd_views()):
        for matrix in views.perspective_matrices():
            there = mph.transform_points(matrix, points)
            back = mph.transform_points(np.linalg.inv(matrix), there)
            assert np.abs(back - points).max() < 1e-11
    for parallel in (False, True):
        for grid in grids(parallel):
            assert np.abs(grid.to_world(grid.from_world(points)) - points).max() < 1e-11


@pytest.mark.parametrize("kind", ["odd", "odd and parallel", "scanner"])
def test_from_camera_to_camera_pixels_stay(scanner, rng, kind):
    points = rng.uniform(-40, 40, (500, 3))
    views = scanner[::7].views((256, 240)) if kind == "scanner" else odd_views(kind != "odd")
    pixels, lattices = mph.project_points(views, points), mph.perspective_grids(views, 7, 120.0, 330.0)
    for a, b in itertools.product(lattices, repeat=2):
        moved = mph.transform_points(b.matrix @ np.linalg.inv(a.matrix), a.from_world(points))
        assert np.abs(moved[:, :2] - pixels[b.m]).max() < 1e-10
        np.testing.assert_allclose(moved, b.from_world(a.to_world(a.from_world(points))), atol=1e-10)


@pytest.mark.parametrize("parallel", [False, True])
def test_straight_lines_stay_straight(rng, parallel):
    """To 1e-12 of the length that is looked at, in units in which a pixel and the whole range of k are of one size."""
    for grid in grids(parallel):
        first, second = rng.uniform(-40, 40, (2, 3))
        points = first + np.linspace(-1, 2, 301)[:, None] * (second - first)
        scale = np.diag([1.0, 1.0, 100 / abs(grid.edges[-1] - grid.edges[0]), 1.0])
        images = mph.transform_points(scale @ grid.matrix, points)
        moved = mph.transform_lines(scale @ grid.matrix, mph.line_through(first, second))
        for line in (mph.line_through(images[0], images[-1]), moved):
            assert distance_to_line(images, line).max() < 1e-12 * max(np.linalg.norm(images[-1] - images[0]), 100)
        back = mph.transform_lines(np.linalg.inv(scale @ grid.matrix), moved)
        assert distance_to_line(points, back).max() < 1e-12 * np.linalg.norm(points[-1] - points[0])


def test_lines_at_infinity_and_points_on_no_plane_are_known():
    line = mph.line_through([1, 2, 3], [1, 2, 5])
    np.testing.assert_allclose(distance_to_line([[4, 6, -8], [1, 2, 0]], line), [5, 0])
    from_the_origin = np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1], [0, 0, 1, 0]])  # (x / z, y / z, 1 / z)
    assert not np.isfinite(mph.transform_points(from_the_origin, [0, 0, 0])).any()
    refused(lambda: mph.transform_points(np.eye(3), [0, 0, 0]), "transform", "4 x 4")


def test_k_is_the_magnification():
    views = odd_views()
    for m, matrix in enumerate(views.perspective_matrices()):
        middle, source, n = views.detector_centers[m], views.sources[m], mph.view_frames(views)[m, 2]
        np.testing.assert_allclose(mph.transform_points(matrix, middle), [49.5, 44.5, 1], atol=1e-12)
        near = source + 0.25 * (middle - source)
        np.testing.assert_allclose(mph.transform_points(matrix, near), [49.5, 44.5, 4], atol=1e-11)
        # A step across, parallel to the detector, is k steps on the detector.
        aside = mph.transform_points(matrix, near + views.u_steps[m] + 2 * views.v_steps[m])
        np.testing.assert_allclose(aside, [53.5, 52.5, 4], atol=1e-11)
        deeper = mph.transform_points(matrix, source + 60 * n)
        np.testing.assert_allclose(deeper[2], n @ (middle - source) / 60, rtol=1e-12)
    assert (mph.transform_points(odd_views(True).perspective_matrices()[4], np.eye(3))[:, 2] == 1).all()


@CASES
def test_planes_are_evenly_spaced_in_what_they_say(parallel, uniform):
    for grid in grids(parallel, uniform):
        to_detector = grid.views.detector_centers[grid.m] - grid.views.sources[grid.m]
        edges = grid.edges if parallel else to_detector @ mph.view_frames(grid.views)[grid.m, 2] / grid.edges
        np.testing.assert_allclose(edges[[0, -1]], [120, 330])
        assert (np.diff(edges) > 0).all() and (np.diff(grid.depths) > 0).all()
        assert ((grid.depths > edges[:-1]) & (grid.depths < edges[1:])).all()
        even = edges if parallel or uniform == "depth" else grid.edges
        np.testing.assert_allclose(np.diff(even, 2), 0, atol=1e-11)
        places = grid.depths if parallel or uniform == "depth" else grid.planes
        np.testing.assert_allclose(places, (even[1:] + even[:-1]) / 2)


@CASES
def test_rays_have_their_whole_length_from_near_to_far(parallel, uniform):
    for grid in grids(parallel, uniform):
        n_v, n_u = grid.views.shape
        pixels = np.stack(np.meshgrid(np.arange(n_u), np.arange(n_v)), axis=-1)
        ends = [mph.points_at_depths(grid.views, grid.m, pixels, depth) for depth in (120.0, 330.0)]
        whole = np.linalg.norm(ends[1] - ends[0], axis=-1)
        lengths, (i, j) = grid.ray_lengths(), (13, 71)
        assert lengths.shape == grid.shape
        np.testing.assert_allclose(lengths.sum(axis=-1).T, whole, rtol=1e-12)
        borders = grid.to_world(np.column_stack([np.full((8, 1), i), np.full((8, 1), j), grid.edges]))
        np.testing.assert_allclose(lengths[i, j], np.linalg.norm(np.diff(borders, axis=0), axis=1), rtol=1e-10)


@CASES
def test_cell_volumes_are_integrals_of_the_jacobian(parallel, uniform):
    nodes, weights = np.polynomial.legendre.leggauss(12)
    for grid in grids(parallel, uniform):
        volumes = []
        for low, high in zip(grid.edges[:-1], grid.edges[1:], strict=True):
            thirds = (low + high) / 2 + nodes * (high - low) / 2
            places = np.column_stack([np.full((12, 2), [31.0, 60.0]), thirds])  # the same for all pixels and in them
            steps = np.diag([1e-4, 1e-4, 1e-4 * abs(high - low)])
            slopes = [(grid.to_world(places + s) - grid.to_world(places - s)) / (2 * s.max()) for s in steps]
            volumes.append((weights * np.abs(np.linalg.det(np.stack(slopes, axis=-1)))).sum() * abs(high - low) / 2)
        np.testing.assert_allclose(grid.cell_volumes(), volumes, rtol=1e-6)
    whole = np.array([g.cell_volumes().sum() for g in grids(parallel, uniform)])
    area = np.linalg.norm(np.cross(grid.views.u_steps, grid.views.v_steps), axis=1)
    direction = grid.views.detector_centers - grid.views.sources
    distances = np.einsum("mi,mi->m", direction, mph.view_frames(grid.views)[:, 2])
    np.testing.assert_allclose(whole, area * (210 if parallel else (330**3 - 120**3) / (3 * distances**2)), rtol=1e-10)


@CASES
def test_indices_lead_to_the_world_and_back_and_number_the_centers(parallel, uniform, rng):
    points = rng.uniform(-60, 60, (4, 50, 3))
    for grid in grids(parallel, uniform):
        numbers = np.moveaxis(np.indices(grid.shape), 0, -1)
        p = np.concatenate([grid.centers(), np.ones((*grid.shape, 1))], axis=-1) @ grid.index_matrix.T
        assert (p[..., 3:] > 0).all()
        np.testing.assert_allclose(grid.world_from_index(numbers), grid.centers(), atol=1e-10)
        np.testing.assert_allclose(grid.from_world(grid.centers())[..., :2], numbers[..., :2], atol=1e-10)
        depth = mph.view_frames(grid.views)[grid.m, 2] @ (grid.centers() - grid.views.sources[grid.m])[..., None]
        np.testing.assert_allclose(depth[..., 0], np.broadcast_to(grid.depths, grid.shape), rtol=1e-12)
        index = grid.index_from_world(points)
        assert index.shape == points.shape
        np.testing.assert_allclose(index[..., :2], grid.from_world(points)[..., :2], atol=1e-9)
        assert np.abs(grid.world_from_index(index) - points).max() < 1e-9
        between = rng.uniform(-0.5, np.array(grid.shape) - 0.5, (200, 3))
        assert np.abs(grid.index_from_world(grid.world_from_index(between)) - between).max() < 1e-9
        np.testing.assert_allclose(grid.index_from_world(points[0, 0]), index[0, 0], atol=1e-9)


@CASES
def test_indices_are_those_of_what_is_resampled(parallel, uniform):
    """Tiny voxels get what is linear in a view's indices there; its cells the values of a volume where they lie."""

    def places(voxels):
        return np.moveaxis(np.indices(voxels.shape), 0, -1) @ voxels.affine[:3, :3].T + voxels.affine[:3, 3]

    tiny, large = mph.Grid.centered((4, 3, 2), 1e-3, (5, -4, 3)), mph.Grid.centered((60, 60, 60), 1.0)
    slope = np.array([0.3, -0.5, 0.7])
    volume = mph.Volume((places(large) @ slope).astype(np.float32), large, "activity")
    for grid in grids(parallel, uniform, n_k=40)[:3]:
        values = np.indices(grid.shape).astype(np.float64)
        index = grid.index_from_world(places(tiny))
        for axis in range(3):
            np.testing.assert_allclose(mph.from_perspective(values[axis], grid, tiny), index[..., axis], atol=1e-4)
        points = grid.world_from_index(np.moveaxis(values, 0, -1))
        inside = (np.abs(points) < 20).all(axis=-1)
        errors = np.abs(mph.to_perspective(volume, grid) - points @ slope)
        assert inside.any() and errors[inside].max() < 0.75  # 1 voxel along the slope


@CASES
def test_images_are_sums_of_values_times_lengths(parallel, uniform, rng):
    grid = grids(parallel, uniform)[5]
    array = rng.random((2, *grid.shape))
    image = grid.image(array)
    assert image.shape == (2, 90, 100) and image.dtype == np.float64
    np.testing.assert_allclose(image[1, 7, 63], array[1, 63, 7] @ grid.ray_lengths()[63, 7])
    assert grid.image(array.astype(np.float32)).dtype == np.float32
    ones = np.ones(grid.shape, int)
    for whole in (ones, ones.tolist()):  # lengths are not rounded to whole mm
        np.testing.assert_allclose(grid.image(whole)[7, 63], grid.ray_lengths()[63, 7].sum(), rtol=1e-6)
    torch = pytest.importorskip("torch", reason="torch is not installed")
    tensor = torch.tensor(array, requires_grad=True)
    np.testing.assert_allclose(grid.image(tensor).detach(), image)
    np.testing.assert_allclose(grid.image(torch.ones(grid.shape, dtype=torch.int32)), grid.image(ones), rtol=1e-6)
    (gradient,) = torch.autograd.grad(grid.image(tensor)[0].sum(), tensor)
    np.testing.assert_allclose(gradient[0], grid.ray_lengths())
    assert (gradient[1] == 0).all()


def test_depth_ranges_hold_the_grid(rng):
    views = odd_views()
    grid = mph.Grid((5, 6, 7), mph.euler_pose(0.4, 1, 2) @ mph.Grid.centered((5, 6, 7), (8, 7, 6), (3, 2, 1)).affine)
    near, far = mph.depth_ranges(views, grid)
    for m in range(len(views)):
        depths = (grid.corners() - views.sources[m]) @ mph.view_frames(views)[m, 2]
        np.testing.assert_allclose([near[m], far[m]], [depths.min(), depths.max()])
    per_view = mph.perspective_grids(views, 4, near, far)
    assert [g.m for g in per_view] == list(range(6)) and per_view[3].near == near[3]
    wide = mph.Grid.centered(50, 10)
    refused(lambda: mph.depth_ranges(views, wide), "in front of its source", "behind")
    mph.depth_ranges(odd_views(True), wide)


def test_no_views_have_no_depths_and_no_pixels():
    none = odd_views()[0:0]
    assert all(depths.shape == (0,) for depths in mph.depth_ranges(none, mph.Grid.centered((4, 4, 4), 1.0)))
    assert mph.project_points(none, [[0, 0, 0], [1, 2, 3]]).shape == (0, 2, 2)


def test_grids_that_cannot_be_are_refused():
    views = odd_views()
    for arguments, words in (
        (("x", 0, 4, 1, 2), "Views"),
        ((views, 6, 4, 1, 2), "no view 6 among 6"),
        ((views, 1.0, 4, 1, 2), "index of a view"),
        ((views, 0, 0, 1, 2), "planes"),
        ((views, 0, 4, 0, 2), "0 < near < far"),
        ((views, 0, 4, 5, 5), "near < far"),
        ((views, 0, 4, 1, np.inf), "far"),
        ((views, 0, 4, 1, 2, "z"), "k, depth"),
        ((odd_views(True), 0, 4, 3, 2), "near < far"),
    ):
        refused(lambda arguments=arguments: mph.PerspectiveGrid(*arguments), words)
    refused(lambda: mph.PerspectiveGrid(views, 0, 4, 1, 2).image(np.zeros((3, 3, 3))), "100 x 90 x 4", "3 x 3 x 3")
    refused(lambda: mph.perspective_grids(views, 4, [1, 2], 3), "near")
    refused(lambda: mph.PerspectiveGrid(views, 0, 4, 1, 2).index_from_world([1, 2]), "points", "3")
    refused(lambda: mph.PerspectiveGrid(views, 0, 4, 1, 2).world_from_index([1, 2, np.nan]), "index")
    assert mph.PerspectiveGrid(odd_views(True), -1, 4, -3, 2).m == 5
