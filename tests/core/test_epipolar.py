"""Epipolar geometry: what two views see of one point, of one ray and of each other."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.perspective.view_rays import pixels_of

from .conftest import distance_to_line, refused
from .odd_views import odd_views

BOTH = pytest.mark.parametrize("parallel", [False, True])


def pairs(views):
    return np.array(list(itertools.permutations(range(len(views)), 2))).T


def homogeneous(pixels):
    return np.concatenate([pixels, np.ones((*pixels.shape[:-1], 1))], axis=-1)


def distances_from_lines(matrices, first, second):
    """Return distances, px, of pixels (P, N, 2) of second views from the epipolar lines of those of the first views."""
    lines = np.einsum("pij,pkj->pki", matrices, homogeneous(first))
    return np.einsum("pki,pki->pk", lines, homogeneous(second)) / np.hypot(lines[..., 0], lines[..., 1])


@pytest.mark.parametrize("kind", ["virtual", "real", "odd", "odd and parallel"])
def test_the_epipolar_constraint_holds_for_all_ordered_pairs(scanner, rng, kind):
    odd = kind.startswith("odd")
    views, reach = (odd_views(kind != "odd"), 40) if odd else (scanner.views((256, 240), kind), 60)
    m, n = pairs(views)
    assert len(m) == (30 if odd else 6320)
    matrices = mph.fundamental_matrix(views, m, n)
    pixels = mph.project_points(views, rng.uniform(-reach, reach, (40, 3)))
    assert np.abs(distances_from_lines(matrices, pixels[m], pixels[n])).max() < 1e-9
    lines = mph.epipolar_lines(views, 4, 5, pixels[4])
    np.testing.assert_allclose(np.hypot(*lines[:, :2].T), 1)
    assert np.abs((lines * homogeneous(pixels[5])).sum(axis=1)).max() < 1e-9
    swapped, sizes = mph.fundamental_matrix(views, n, m).swapaxes(1, 2), np.abs(matrices).max(axis=(1, 2))
    np.testing.assert_allclose(matrices, swapped, atol=1e-9 * sizes.max())
    np.testing.assert_allclose(np.linalg.det(matrices / sizes[:, None, None]), 0, atol=1e-12)


@BOTH
def test_a_fundamental_matrix_measures_how_far_rays_miss_each_other(rng, parallel):
    views = odd_views(parallel)
    m, n = pairs(views)
    pixels = rng.uniform(0, 90, (2, len(m), 2))
    values = np.einsum(
        "pi,pij,pj->p", homogeneous(pixels[1]), mph.fundamental_matrix(views, m, n), homogeneous(pixels[0])
    )
    rays = []
    for which, (columns, rows) in zip((m, n), pixels.swapaxes(1, 2)[..., None], strict=True):
        middles = views.detector_centers[which]
        targets = middles + (columns - 49.5) * views.u_steps[which] + (rows - 44.5) * views.v_steps[which]
        rays.append((targets, (middles if parallel else targets) - views.sources[which]))
    (a, first), (b, second) = rays
    across = np.cross(first, second)
    np.testing.assert_allclose(np.abs(values), np.abs(((a - b) * across).sum(axis=1)), rtol=1e-9)
    line = mph.line_through(b[0], b[0] + second[0])
    along = np.linspace(-1000, 1000, 200001)[:, None] / np.linalg.norm(first[0])
    nearest = distance_to_line(a[0] + along * first[0], line).min()
    np.testing.assert_allclose(np.abs(values[0]) / np.linalg.norm(across[0]), nearest, rtol=1e-6)


def test_an_essential_matrix_is_the_pose_between_two_cameras(rng):
    views = odd_views()
    m, n = pairs(views)
    matrices, frames = mph.essential_matrix(views, m, n), mph.view_frames(views)
    points = rng.uniform(-40, 40, (40, 3))
    local = np.einsum("mij,mkj->mki", frames, points - views.sources[:, None])
    assert (local[..., 2] > 0).all()
    np.testing.assert_allclose(np.cross(frames[:, 2], frames[:, 0]), frames[:, 1], atol=1e-15)
    rays = local / local[..., 2:]
    np.testing.assert_allclose(np.einsum("pki,pij,pkj->pk", rays[n], matrices, rays[m]), 0, atol=1e-11)
    rotation = frames[n] @ frames[m].swapaxes(1, 2)
    shift = np.einsum("pij,pj->pi", frames[n], views.sources[m] - views.sources[n])
    np.testing.assert_allclose(local[n], np.einsum("pij,pkj->pki", rotation, local[m]) + shift[:, None], atol=1e-11)
    skew = matrices @ rotation.swapaxes(1, 2)
    np.testing.assert_allclose(skew, -skew.swapaxes(1, 2), atol=1e-11)
    distance = np.linalg.norm(views.sources[m] - views.sources[n], axis=1)
    np.testing.assert_allclose(np.linalg.svd(matrices)[1], distance[:, None] * [1, 1, 0], atol=1e-11)
    intrinsic = mph.intrinsic_matrices(views)
    pixels = np.einsum("mij,mkj->mki", intrinsic, rays)[..., :2]
    np.testing.assert_allclose(pixels, mph.project_points(views, points), atol=1e-10)
    inverse = np.linalg.inv(intrinsic)
    by_pixels = inverse[n].swapaxes(1, 2) @ matrices @ inverse[m]
    fundamental = mph.fundamental_matrix(views, m, n)
    factor = (by_pixels * fundamental).sum(axis=(1, 2)) / (by_pixels**2).sum(axis=(1, 2))
    np.testing.assert_allclose(by_pixels * factor[:, None, None], fundamental, atol=1e-11 * np.abs(fundamental).max())


def test_intrinsic_matrices_say_pitch_principal_point_skew_and_mirror():
    u, v, k = mph.euler_pose(0.3, 0.8, -1.1)[:3, :3]
    views = mph.Views([-200 * k], [300 * k + 14 * u - 6 * v], [2 * u], [-3 * v + 0.5 * u], (31, 41))
    # The foot of the perpendicular is 6 mm = -2 rows along v, and from there (-14 - -2 * 0.5) / 2 columns.
    expected = [[250, 500 / 3 / 4, 20 - 6.5], [0, -500 / 3, 15 - 2], [0, 0, 1]]
    np.testing.assert_allclose(mph.intrinsic_matrices(views), [expected], atol=1e-10)
    np.testing.assert_allclose(mph.view_frames(views), [[u, v, k]], atol=1e-14)


@BOTH
def test_epipoles_are_images_of_sources_and_on_all_lines(parallel):
    views = odd_views(parallel)
    away = views.detector_centers.copy()
    away[3] = 2 * views.sources[3] - away[3]  # one looks away from the others
    views = replace(views, detector_centers=away)
    m, n = pairs(views)
    points = mph.epipole(views, m, n)
    matrices = mph.fundamental_matrix(views, m, n)
    scale = np.abs(matrices).max(axis=(1, 2)) * np.abs(points).max(axis=1)
    assert (np.abs(np.einsum("pji,pj->pi", matrices, points)).max(axis=1) < 1e-11 * scale).all()
    if parallel:
        assert (points[:, 2] == 0).all()
        return
    frames = mph.view_frames(views)
    depth = np.einsum("pi,pi->p", frames[n, 2], views.sources[m] - views.sources[n])
    distance = np.einsum("mi,mi->m", frames[:, 2], views.detector_centers - views.sources)
    np.testing.assert_allclose(points[:, 2], depth / distance[n], atol=1e-12)
    images, ahead = mph.project_points(views, views.sources)[n, m], points[:, 2] > 0
    assert 0 < ahead.sum() < len(m) and np.isnan(images[~ahead]).all()
    np.testing.assert_allclose(points[ahead, :2] / points[ahead, 2:], images[ahead], rtol=1e-10)


def test_parallel_views_are_the_limit_of_ever_farther_sources():
    parallel = odd_views(parallel=True)
    m, n = pairs(parallel)
    toward = parallel.detector_centers - parallel.sources
    limits, errors, points = mph.fundamental_matrix(parallel, m, n), [], np.array([[10.0, -20, 30]])
    sizes = np.array([100.0, 100, 1])  # the weights of columns and rows: pixels of an image of about 100
    for times in (1e2, 1e3, 1e4):
        far = replace(parallel, sources=parallel.detector_centers - times * toward, parallel=False)
        pixels = np.abs(mph.project_points(far, points) - mph.project_points(parallel, points)).max()
        matrices = mph.fundamental_matrix(far, m, n) / times**2
        error = np.abs((matrices - limits) * sizes * sizes[:, None]).max() / np.abs(limits[:, 2, 2]).max()
        k = far.perspective_matrices() @ [10.0, -20, 30, 1]
        errors.append([pixels, error, np.abs(k[:, 2] / k[:, 3] - 1).max()])
    assert (np.array(errors[2]) < [2e-3, 2e-2, 1e-4]).all(), errors
    np.testing.assert_allclose(np.array(errors[1:]) * 10, errors[:-1], rtol=0.1)


@BOTH
def test_segments_are_what_views_see_of_a_ray(rng, parallel):
    views = odd_views(parallel)
    seen = np.zeros(len(views), int)
    for _ in range(40):
        m, pixel = int(rng.integers(6)), rng.uniform(0, 89, 2)
        near, far = np.sort(rng.uniform(20, 900, 2))
        ends = mph.epipolar_segments(views, m, pixel, near, far)
        pixels = mph.project_points(views, mph.points_at_depths(views, m, pixel, np.linspace(near, far, 4001)))
        np.testing.assert_allclose(pixels[m], np.broadcast_to(pixel, (4001, 2)), atol=1e-9)
        inside = ((pixels >= -0.5) & (pixels <= [99.5, 89.5])).all(axis=-1)
        for n in range(len(views)):
            where = np.flatnonzero(inside[n])
            if not len(where):  # it may pass a corner between two depths
                assert np.isnan(ends[n]).all() or np.linalg.norm(ends[n, 1] - ends[n, 0]) < 1
                continue
            seen[n] += 1
            for end, i in zip(ends[n], where[[0, -1]], strict=True):
                if i in (0, 4000):
                    np.testing.assert_allclose(end, pixels[n, i], atol=1e-9)
                else:  # cut off: at an edge, between two depths
                    least = np.abs([end[0] + 0.5, end[0] - 99.5, end[1] + 0.5, end[1] - 89.5]).min()
                    assert least < 1e-9
                    step = np.nanmax(np.linalg.norm(np.diff(pixels[n, i - 1 : i + 2], axis=0), axis=1))
                    assert np.linalg.norm(end - pixels[n, i]) <= step + 1e-9
            if n != m:
                lines = mph.epipolar_lines(views, m, n, pixel)
                assert np.abs(homogeneous(ends[n]) @ lines).max() < 1e-8
    assert (seen > 5).all()


def test_rays_without_end_rays_from_the_source_and_rays_through_another_source():
    views = odd_views()
    pixel, middle = [40.0, 50.0], [(100 - 1) / 2, (90 - 1) / 2]
    endless, long = mph.epipolar_segments(views, 0, pixel, 100), mph.epipolar_segments(views, 0, pixel, 100, 1e9)
    np.testing.assert_allclose(endless, long, atol=1e-4)
    assert np.isfinite(endless).all(axis=(1, 2)).sum() >= 3
    from_source = mph.epipolar_segments(views, 0, pixel, 0, 300)
    assert np.isfinite(from_source).any(axis=(1, 2)).sum() >= 3
    np.testing.assert_array_equal(from_source[0], [pixel, pixel])
    point = mph.epipolar_segments(views, 0, pixel, 230, 230)
    np.testing.assert_allclose(point[:, 0], point[:, 1], atol=1e-12)
    # A camera whose source is on the ray, looking along it, against it and across it.
    source, target = (mph.points_at_depths(views, 0, pixel, depth) for depth in (150.0, 400.0))
    k = (target - source) / np.linalg.norm(target - source)
    u = np.cross(k, [0, 0, 1.0])
    around, across = np.array([k, -k, u / np.linalg.norm(u)]), np.array([u, u, k])
    arrays = (3 * [source], source + 100 * around, across, np.cross(around, across))
    first = (views.sources, views.detector_centers, views.u_steps, views.v_steps)
    more = mph.Views(*(np.concatenate([x[:1], y]) for x, y in zip(first, arrays, strict=True)), views.shape)
    ends = mph.epipolar_segments(more, 0, pixel, 100, 300)
    np.testing.assert_allclose(ends[1:3], np.broadcast_to(middle, (2, 2, 2)), atol=1e-6)
    assert np.isnan(ends[3]).all()  # at the right angle to all that it sees
    np.testing.assert_allclose(mph.epipolar_segments(more, 0, pixel, 160, 300)[1], [middle, middle], atol=1e-6)
    assert np.isnan(mph.epipolar_segments(more, 0, pixel, 160, 300)[2]).all()
    assert np.isnan(mph.epipolar_lines(more, 0, 1, [pixel, [0, 0]])).all(axis=1).tolist() == [True, False]
    assert np.isnan(mph.epipolar_segments(views, 0, [-0.6, 3], 100)[0]).all()


@BOTH
def test_points_project_to_their_pixels_and_not_from_behind(rng, parallel):
    views = odd_views(parallel)
    pixels = rng.uniform(0, 90, (7, 2))
    depths = np.linspace(50, 500, 7)
    for m, (matrix, frame) in enumerate(zip(views.projection_matrices(), mph.view_frames(views), strict=True)):
        points = mph.points_at_depths(views, m, pixels, depths)
        images = mph.project_points(views, points)[m]
        np.testing.assert_allclose(images, pixels, atol=1e-10)
        np.testing.assert_allclose(frame[2] @ (points - views.sources[m]).T, depths, atol=1e-10)
        np.testing.assert_array_equal(pixels_of(matrix, points), images)
        behind = mph.points_at_depths(views, m, pixels, -5.0)
        assert np.isfinite(mph.project_points(views, behind)[m]).all() == parallel


def test_what_has_no_epipolar_geometry_is_refused():
    views = odd_views()
    refused(lambda: mph.fundamental_matrix(views, 2, 2), "fundamental matrix", "view 2 twice")
    refused(lambda: mph.fundamental_matrix(views, 0, -6), "view 0 twice")
    refused(lambda: mph.epipole(views, 0, 6), "epipole", "no view 6 among 6")
    refused(lambda: mph.epipolar_lines(views, 0, 1.0, [0, 0]), "index of a view", "1.0")
    refused(lambda: mph.epipolar_lines(views, [0, 1], 2, [0, 0]), "one index")
    refused(lambda: mph.fundamental_matrix("views", 0, 1), "Views")
    refused(lambda: mph.fundamental_matrix(views, [0, 1], [2, 3, 4]), "as many views m as n", "2 and 3")
    refused(lambda: mph.points_at_depths(views, 0, np.zeros((3, 2)), [100, 200]), "as many depths as pixels", "2 and 3")
    same = replace(views[:2], sources=views.sources[[0, 0]])
    refused(lambda: mph.essential_matrix(same, 0, 1), "views 0 and 1", "the same source")
    opposite = mph.parallel_views([0.4, 0.4 + np.pi], (8, 8), 1.0)
    refused(lambda: mph.fundamental_matrix(opposite, 0, 1), "views 0 and 1", "opposite direction")
    refused(lambda: mph.essential_matrix(odd_views(True), 0, 1), "essential matrix", "parallel")
    refused(lambda: mph.intrinsic_matrices(odd_views(True)), "intrinsic", "parallel")
    refused(lambda: mph.epipolar_segments(views, 0, [0, 0], -1, 5), "0 <= near <= far", "-1 and 5")
    refused(lambda: mph.epipolar_segments(views, 0, [0, 0], 9, 5), "9 and 5")
    refused(lambda: mph.epipolar_segments(views, 0, [0, 0], 9, np.nan), "far")
    refused(lambda: mph.epipolar_segments(views, [0], [0, 0], 9), "one index")
