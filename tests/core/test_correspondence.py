"""Correspondences along rays: what all views have at a pixel's depths, and where they agree."""

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core import memory

from .conftest import refused
from .odd_views import odd_views

# Two small sources, mm; the second is seen by all of the odd views.
SPOTS = np.array([[12.0, -11, 9], [-14, 8, -6]])


def spot_images(views):
    """Return sums along rays of two Gaussian spots of 5 mm standard deviation, exact: of each ray's distance."""
    images = np.zeros((len(views), *views.shape))
    for m, image in enumerate(images):
        starts, targets = views.rays(m)
        direction = (targets - starts) / np.linalg.norm(targets - starts, axis=1)[:, None]
        for spot in SPOTS:
            distance = np.linalg.norm(np.cross(spot - starts, direction), axis=1)
            image += np.exp(-(distance**2) / 50).reshape(views.shape)
    return images


def linear(m, columns, rows):
    """Return values of image m, whose interpolation is exact."""
    return 3 + 0.5 * columns - (m + 1) * 0.25 * rows


@pytest.mark.parametrize("uniform", ["k", "depth"])
@pytest.mark.parametrize("parallel", [False, True])
def test_samples_are_the_views_values_where_the_point_is(parallel, uniform, monkeypatch):
    views = odd_views(parallel)
    images = np.stack([linear(m, *np.indices(views.shape)[::-1]) for m in range(6)])
    pixels = np.array([[[49.0, 44], [10.3, 71.8]], [[88, 3.25], [-0.4, 89.4]]])
    grid = mph.PerspectiveGrid(views, 5, 9, 90, 400, uniform)
    values = mph.samples_along_rays(images, grid, pixels)
    assert values.shape == (2, 2, 6, 9)
    for i in np.ndindex(2, 2):
        places = mph.project_points(views, mph.points_at_depths(views, 5, pixels[i], grid.depths))
        inside = ((places >= -0.5) & (places <= [99.5, 89.5])).all(axis=-1)
        np.testing.assert_array_equal(np.isfinite(values[i]), inside)
        expected = linear(np.arange(6)[:, None], *np.moveaxis(places.clip(0, [99, 89]), -1, 0))
        np.testing.assert_allclose(values[i][inside], expected[inside], atol=1e-9)
    assert np.isfinite(values).any(axis=(0, 1, 3)).all() and np.isnan(values).any()
    np.testing.assert_array_equal(mph.samples_along_rays(images, grid, [49, 44]), values[0, 0])
    monkeypatch.setattr(memory, "available", lambda: 1000)
    refused(lambda: mph.samples_along_rays(images, grid, pixels), "4 rays at 9 planes", "of memory")


@pytest.mark.parametrize("uniform", ["k", "depth"])
@pytest.mark.parametrize("parallel", [False, True])
def test_the_depth_of_small_sources_is_found(parallel, uniform):
    views = odd_views(parallel)
    images = spot_images(views)
    for m, aside in ((1, 5), (3, 5), (5, 1)):
        near, far = (mph.view_frames(views)[m, 2] @ -views.sources[m] + x for x in (-60, 60))
        grid = mph.PerspectiveGrid(views, m, 40, near, far, uniform)
        pixels = mph.project_points(views, SPOTS)[m]
        match = mph.find_correspondences(images, grid, pixels.round(), half_width=4)
        depths = (SPOTS - views.sources[m]) @ mph.view_frames(views)[m, 2]
        assert np.abs(match.depths - depths).max() < 2, (m, match.depths, depths)  # planes are 3 mm apart
        assert match.scores.min() > 0.65  # some look at the square from its edge
        assert match.curves.shape == (2, 40)
        np.testing.assert_array_equal(match.others, np.delete(np.arange(6), m))
        points = np.stack([mph.points_at_depths(views, m, pixels[i].round(), match.depths[i]) for i in (0, 1)])
        np.testing.assert_allclose(match.pixels, mph.project_points(views, points)[match.others], atol=1e-9)
        # The pixel was rounded: it is within one of the spot.
        assert np.abs(match.pixels - mph.project_points(views, SPOTS)[match.others]).max() < 2
        one = mph.find_correspondences(images, grid, pixels[1], others=aside, half_width=4)
        assert one.depths.shape == () and one.pixels.shape == (1, 2) and one.views_compared.max() == 1
        assert abs(one.depths - depths[1]) < 3


def test_neither_scale_nor_offset_of_an_image_matters():
    views = odd_views()
    images, grid = spot_images(views), mph.PerspectiveGrid(views, 2, 20, 150, 300)
    pixel, steps = mph.project_points(views, SPOTS)[2, 1].round(), []
    match = mph.find_correspondences(images, grid, pixel, progress=lambda *step: steps.append(step))
    assert steps == [(1, 1)]
    scaled = mph.find_correspondences(images * np.arange(1, 7)[:, None, None] + 5, grid, pixel)
    np.testing.assert_allclose(scaled.curves, match.curves, atol=1e-8)
    np.testing.assert_allclose(scaled.depths, match.depths, rtol=1e-7)


def test_where_nothing_can_be_compared_nothing_is_found():
    views = odd_views()
    images, grid = spot_images(views), mph.PerspectiveGrid(views, 2, 5, 150, 300)
    match = mph.find_correspondences(images, grid, [[1, 40], [50, 44]])  # the first square is cut by the edge
    assert np.isnan(match.depths[0]) and np.isnan(match.scores[0]) and np.isnan(match.pixels[:, 0]).all()
    assert np.isfinite(match.depths[1])
    flat = mph.find_correspondences(np.ones_like(images), grid, [50, 44])
    assert np.isnan(flat.depths) and (flat.views_compared == 0).all()
    images[2, 40:49, 46:55] += np.random.default_rng(1).random((9, 9))
    images[[0, 1, 3, 4, 5]] = 7.0
    empty = mph.find_correspondences(images, grid, [50, 44])
    assert empty.scores == 0  # others are of one value: they do not have it
    far = mph.PerspectiveGrid(views, 2, 5, 1e5, 2e5)
    assert np.isnan(mph.find_correspondences(images, far, [50, 44], others=[1]).depths)
    plane = mph.PerspectiveGrid(views, 2, 1, 150, 300)
    np.testing.assert_allclose(mph.find_correspondences(images, plane, [50, 44]).depths, plane.depths[0])


def test_arguments_that_do_not_fit_are_refused():
    views = odd_views()
    images, grid = spot_images(views), mph.PerspectiveGrid(views, 2, 5, 150, 300)
    refused(lambda: mph.samples_along_rays(images[:5], grid, [1, 1]), "images", "6 x 90 x 100")
    refused(lambda: mph.samples_along_rays(images, views, [1, 1]), "PerspectiveGrid")
    refused(lambda: mph.find_correspondences(images, grid, [1, 1], others=[1, 2]), "besides 2")
    refused(lambda: mph.find_correspondences(images, grid, [1, 1], others=[]), "besides 2")
    refused(lambda: mph.find_correspondences(images, grid, [1, 1], others=[9]), "no view 9")
    refused(lambda: mph.find_correspondences(images, grid, [1, 1], half_width=0), "half width")
    refused(lambda: mph.find_correspondences(images, grid, [1, 1, 1]), "pixels")
