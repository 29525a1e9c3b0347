"""The place of a marker from its images, its covariance, and the image that does not fit."""

import numpy as np
import pytest

import mphdrr.core as mph

from .conftest import refused
from .odd_views import odd_views

POINT = np.array([12.0, -21, 17])


def noisy_fits(views, modules, covariances, n, seed):
    """Return fits of n draws of a marker's images with noise of these covariances (N, 2, 2), and the exact fit."""
    exact = mph.project_points(views, [POINT])[modules, 0]
    noise = np.random.default_rng(seed).normal(size=(n, len(modules), 2))
    images = exact + np.einsum("nij,knj->kni", np.linalg.cholesky(covariances), noise)
    return [mph.fit_marker(views, modules, pixels, covariances) for pixels in [*images, exact]]


def general_covariances(n):
    parts = np.random.default_rng(3).normal(size=(n, 2, 2)) * 0.3
    return parts @ parts.swapaxes(1, 2) + 0.04 * np.eye(2)


@pytest.mark.parametrize("kind", ["virtual", "real", "odd", "odd and parallel"])
def test_exact_images_give_the_point(scanner, rng, kind):
    odd = kind.startswith("odd")
    views, points = odd_views(kind != "odd") if odd else scanner.views((256, 240), kind), rng.uniform(-40, 40, (60, 3))
    pixels = mph.project_points(views, points)
    for i, point in enumerate(points):
        modules = rng.choice(len(views), rng.integers(2, 7), replace=False)
        sigma = general_covariances(len(modules)) if odd else 1.0
        assert np.abs(mph.triangulate(views, modules, pixels[modules, i], sigma) - point).max() < 1e-9
    fit = mph.fit_marker(views, np.arange(len(views)), pixels[:, 0])
    assert np.abs(fit.point - points[0]).max() < 1e-9 and fit.degrees == 2 * len(views) - 3 and fit.p_value == 1


def test_the_place_is_the_most_likely_one():
    views = odd_views()
    modules, sigma = [0, 2, 4, 5], np.array([0.5, 1.0, 0.7, 2.0])
    pixels = mph.project_points(views, [POINT])[modules, 0] + [[1, -2], [0.5, 3], [-2, 1], [4, 0]]
    fit = mph.fit_marker(views, modules, pixels, sigma)

    def chi2(point):
        return (((pixels - mph.project_points(views, [point])[modules, 0]) / sigma[:, None]) ** 2).sum()

    np.testing.assert_allclose(fit.residuals, pixels - mph.project_points(views, [fit.point])[modules, 0], atol=1e-10)
    np.testing.assert_allclose(fit.chi2, chi2(fit.point), rtol=1e-10)
    for axis in np.eye(3):
        assert abs(chi2(fit.point + 1e-4 * axis) - chi2(fit.point - 1e-4 * axis)) < 1e-7
        assert chi2(fit.point + 0.01 * axis) > fit.chi2
    np.testing.assert_array_equal(mph.triangulate(views, modules, pixels, sigma), fit.point)
    # Only the ratios of sigmas count for the place; the covariance grows by their square.
    wider = mph.fit_marker(views, modules, pixels, 3 * sigma)
    np.testing.assert_allclose(wider.point, fit.point, atol=1e-9)
    np.testing.assert_allclose(wider.covariance, 9 * fit.covariance, rtol=1e-8)
    by_matrix = mph.fit_marker(views, modules, pixels, sigma[:, None, None] ** 2 * np.eye(2))
    np.testing.assert_allclose(by_matrix.covariance, fit.covariance, rtol=1e-8)
    np.testing.assert_allclose(fit.standard_deviations**2, np.diag(fit.covariance))


@pytest.mark.parametrize("parallel", [False, pytest.param(True, marks=pytest.mark.long)])
def test_the_stated_covariance_holds_on_average(parallel):
    modules = [1, 4, 5]
    *fits, exact = noisy_fits(odd_views(parallel), modules, general_covariances(3), 1000, 1)
    distances = [(f.point - POINT) @ np.linalg.solve(f.covariance, f.point - POINT) for f in fits]
    # The mean of 1000 numbers of standard deviation sqrt(6) is known to 2.6 % of 3.
    np.testing.assert_allclose([np.mean(distances), np.mean([f.chi2 for f in fits])], 3, rtol=0.05)
    np.testing.assert_allclose(np.mean([f.misfits for f in fits]), 2, rtol=0.05)
    counts = np.histogram([f.p_value for f in fits], 5, (0, 1))[0]
    assert np.abs(counts - 200).max() < 45  # 3.5 standard deviations
    assert np.linalg.eigvalsh(exact.covariance).min() > 0


@pytest.mark.long
def test_the_stated_covariance_holds_for_a_marker_in_the_scanner(scanner):
    """All of it to 5 %, measured in its own axes; 8000 draws know a variance to 1.6 %."""
    modules = [0, 17, 44, 71]
    *fits, exact = noisy_fits(scanner.views(), modules, np.tile(0.25 * np.eye(2), (4, 1, 1)), 8000, 4)
    white = np.linalg.solve(np.linalg.cholesky(exact.covariance), (np.array([f.point for f in fits]) - POINT).T)
    np.testing.assert_allclose(white @ white.T / len(fits), np.eye(3), atol=0.05)


def test_p_values_are_those_of_chi2():
    stats = pytest.importorskip("scipy.stats", reason="scipy is not installed")
    views = odd_views()
    pixels = mph.project_points(views, [POINT])[:, 0]
    for n in (2, 3, 6):
        for size in (0.1, 1.0, 6.0):
            fit = mph.fit_marker(views, range(n), pixels[:n] + size * (-1) ** np.arange(n)[:, None])
            np.testing.assert_allclose(fit.p_value, stats.chi2.sf(fit.chi2, fit.degrees), rtol=1e-8)
            if n > 2:
                np.testing.assert_allclose(fit.misfit_p_values, stats.chi2.sf(fit.misfits, 2), rtol=1e-8)


@pytest.mark.parametrize("wrong", range(6))
def test_the_module_that_does_not_fit_is_found(wrong):
    views = odd_views()
    pixels = mph.project_points(views, [POINT])[:, 0] + np.random.default_rng(wrong).normal(size=(6, 2)) * 0.3
    fit = mph.fit_marker(views, range(6), pixels, 0.3)
    assert fit.p_value > 0.001 and fit.misfit_p_values.min() > 0.0005
    pixels[wrong] += [4, -3]
    fit = mph.fit_marker(views, range(6), pixels, 0.3)
    assert fit.p_value < 1e-6 and fit.worst == wrong and fit.misfit_p_values[wrong] < 1e-6
    others = np.delete(np.arange(6), wrong)
    without = mph.fit_marker(views, others, pixels[others], 0.3)
    # By as much chi2 falls without it; to first order, for an image that is wrong by 17 sigma.
    np.testing.assert_allclose(fit.misfits[wrong], fit.chi2 - without.chi2, rtol=0.02)


def test_of_two_images_none_is_called_wrong():
    views = odd_views()
    pixels = mph.project_points(views, [POINT])[[0, 3], 0]
    fit = mph.fit_marker(views, [0, 3], pixels + np.array([[0, 0], [0, 5]]), 0.3)
    assert fit.worst is None and np.isnan(fit.misfits).all() and fit.degrees == 1 and fit.p_value < 1e-6


@pytest.mark.parametrize(
    ("modules", "n_pixels", "sigma", "words"),
    [
        ([2], 1, 1.0, ("two or more views", "got 1")),
        (2, 1, 1.0, ("two or more views",)),
        ([2, 1, -4], 3, 1.0, ("each view once", "view 2 2 times")),
        ([2, 6], 2, 1.0, ("no view 6 among 6",)),
        ([0.0, 1.0], 2, 1.0, ("index of a view",)),
        ([0, 1], 3, 1.0, ("pixels", "2 x 2")),
        ([0, 1], 2, 0, ("sigma", "more than 0")),
        ([0, 1], 2, [1, 2, 3], ("sigma", "shape 2")),
        ([0, 1], 2, [np.eye(2), [[1, 2], [0, 1]]], ("sigma", "1 is not")),
        ([0, 1], 2, [np.eye(2), np.ones((2, 2))], ("sigma", "1 is not")),
    ],
)
def test_images_that_give_no_place_are_refused(modules, n_pixels, sigma, words):
    pixels = mph.project_points(odd_views(), [POINT])[:n_pixels, 0]
    refused(lambda: mph.triangulate(odd_views(), modules, pixels, sigma), *words)


def pair(apart, parallel=False):
    """Return two views 200 mm from the origin, their sources `apart` mm from each other, looking in one direction."""
    sources = np.array([[0, 0, -200.0], [apart, 0, -200]])
    return mph.Views(sources, sources + np.array([0, 0, 400]), [[1, 0, 0]] * 2, [[0, 1, 0]] * 2, (256, 256), parallel)


def test_rays_that_leave_the_depth_unknown_are_refused():
    for views, second, words in (
        (pair(40), [30, 40], ("parallel", "depth of the point is unknown")),
        (pair(40, True), [20, 40], ("parallel", "depth of the point is unknown")),
        (pair(40), [80, 40], ("behind the source of image",)),  # the rays meet there, as if swapped
        (pair(1e-5), [30 - 2e-5, 40], ("parallel",)),  # 200 mm away
    ):
        pixels = [[30, 40], second]
        refused(lambda views=views, pixels=pixels: mph.triangulate(views, [0, 1], pixels), *words)
    pixels = mph.project_points(pair(0.5), [[3, 4, 0]])[:, 0]
    np.testing.assert_allclose(mph.triangulate(pair(0.5), [0, 1], pixels), [3, 4, 0], atol=1e-9)
    refused(lambda: mph.fit_marker(pair(0.5), [0, 1], pixels), "nearly parallel", "200 mm from a source")
    fit = mph.fit_marker(pair(0.5), [0, 1], pixels, 0.01)
    # Depth z from the disparity d: dz = z^2 / (f b) dd, with f b = 400 px mm * 0.5 and dd = 0.01 sqrt(2) px.
    np.testing.assert_allclose(fit.standard_deviations[2], 200**2 / (400 * 0.5) * 0.01 * np.sqrt(2), rtol=1e-6)
