"""Calibrations from photons that benchmarks/calibration.py makes one by one, apart from the disc and blur of the fit."""

from __future__ import annotations

import importlib.util
import re
import warnings
from pathlib import Path

import numpy as np
import pytest

import mphdrr.core as mph

pytest.importorskip("scipy", reason="no scipy")

from scipy import special

from mphdrr.core.design.point_images import disc_fractions

_spec = importlib.util.spec_from_file_location("photons", Path(__file__).parents[2] / "benchmarks" / "calibration.py")
photons = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(photons)

SHAPE, SIGMA = (64, 64), 1 / (2 * np.sqrt(2 * np.log(2)))
DEPTH = "without their depth of interaction"
ONE_LAYER = (np.ones((1, 1)),) * 3


def said(call):
    """Return the result of a call, and the warnings that it gave but for the crystals' depth."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        result = call()
    return result, [str(w.message) for w in caught if DEPTH not in str(w.message)]


@pytest.fixture(scope="module")
def nominal():
    return mph.read_system(photons.WORKBOOK)[::8]


class Case:
    """True scanner, and photons of sources in its images."""

    def __init__(self, nominal, n=8, seed=1, **physics):
        rng = np.random.default_rng(seed)
        self.nominal, self.true, self.points = nominal, photons.misaligned(nominal, rng), photons.sources(n, rng)
        self.images = photons.photon_images(self.true, self.points, SHAPE, rng, **{"blur": 1.0, **physics})

    def found(self, images=None, told=(), **options):
        """Return the calibration and its warnings."""
        model = mph.Emission(self.nominal, **{"intrinsic_fwhm": 1.0, **dict(told)})
        images = self.images if images is None else images
        return said(lambda: mph.calibrate(self.nominal, images, self.nominal.views(SHAPE), model=model, **options))

    def rms(self, found):
        """Return the root mean square errors along u, v and k, mm."""
        return np.sqrt((photons.errors(found, self.true)[:, :3] ** 2).mean(axis=0))


@pytest.fixture(scope="module")
def case(nominal):
    return Case(nominal)


def image(pixels, radius, fwhm, center=(0.0, 0.0), side=50.0):
    """Return the fractions (n, n) of a disc in the pixels of a crystal."""
    ends = np.linspace(-side / 2, side / 2, pixels + 1)[None]
    arguments = np.array([center]), np.array([radius]), np.array([fwhm * SIGMA])
    return disc_fractions([ends, ends], *arguments, ONE_LAYER)[0][0]


@pytest.mark.parametrize("fwhm", [0.2, 1.0, 6.0])
@pytest.mark.parametrize("pixels", [16, 64, 512])
def test_discs_are_blurred_before_they_are_binned(pixels, fwhm):
    """A million points of a disc, each of which a Gaussian spreads over the pixels."""
    radius, center = 1.5, np.array([0.37, -1.21])
    ends, steps = np.linspace(-25, 25, pixels + 1), radius * (2 * (np.arange(1000) + 0.5) / 1000 - 1)
    inside = steps[:, None] ** 2 + steps**2 < radius**2
    u, v = (np.diff(special.ndtr((ends - (x + steps)[:, None]) / (fwhm * SIGMA)), axis=1) for x in center)
    assert np.abs(image(pixels, radius, fwhm, center) - v.T @ (inside / inside.sum()) @ u).sum() < 1e-3


@pytest.mark.parametrize("fwhm", [0.0, 0.2, 2.0, 6.0])
def test_the_variance_is_that_of_hole_blur_and_one_pixel(fwhm):
    radius, pixel = 1.5, 50 / 64
    middles = (np.arange(64) - 31.5) * pixel
    # On average over where the spot lies in a pixel.
    variances = [
        (image(64, radius, fwhm, (x, 0.0)).sum(axis=0) * (middles - x) ** 2).sum()
        for x in pixel * (np.arange(40) + 0.5) / 40
    ]
    assert np.mean(variances) == pytest.approx(radius**2 / 4 + (fwhm * SIGMA) ** 2 + pixel**2 / 12, rel=1e-3)


def test_the_derivatives_are_those_of_central_differences():
    ends = [np.linspace(-5, 5, 20)[None], np.linspace(6, -6, 23)[None]]  # the rows of a real detector descend
    layers = np.array([[0.3, 0.7]]), np.array([[1.0, 1.2]]), np.array([[1.0, 1.1]])

    def at(x):
        return disc_fractions(ends, np.array([x[:2]]), np.array([x[2]]), np.array([x[3]]), layers)

    x = np.array([0.3, -0.4, 1.5, 0.4])
    for slope, step in zip(at(x)[1], 1e-6 * np.eye(4), strict=True):
        assert np.allclose((at(x + step)[0] - at(x - step)[0]) / 2e-6, slope, atol=1e-8)


@pytest.mark.parametrize(
    ("physics", "told", "diameter"),
    [
        ({}, {}, 0.0),
        ({"ball": 4.0}, {}, 4.0),
        ({"crystal_mu": photons.CZT}, {"crystal_mu": photons.CZT, "depth_layers": 2}, 0.0),
    ],
)
def test_point_images_are_those_of_photons(nominal, physics, told, diameter):
    system, points, n = nominal[:1], np.array([[30.0, -20, 25], [-40, 10, 5]]), 400_000
    counts = photons.photon_images(system, points, SHAPE, np.random.default_rng(2), n, blur=1.0, **physics)
    model = mph.Emission(system, intrinsic_fwhm=1.0, **told)
    expected = mph.point_images(model, system.views(SHAPE), points, source_diameter=diameter)
    expected *= counts.sum((2, 3), keepdims=True) / expected.sum((2, 3), keepdims=True)
    noise = np.sqrt(2 / np.pi * np.maximum(expected, 1e-3)).sum() / expected.sum()
    assert np.abs(counts - expected).sum() / expected.sum() < noise + 0.004


@pytest.mark.parametrize("told", [0.0, 3.0])
def test_a_wrong_blur_moves_nothing_and_is_found(case, told):
    true, _ = case.found()
    found, texts = case.found(told={"intrinsic_fwhm": told})
    assert texts == [] and np.linalg.norm(case.rms(found)) < 1.05 * np.linalg.norm(case.rms(true))
    assert np.abs(found.blur - 1).max() < 5 * found.blur_sd[0] and 0 < found.blur_sd[0] < 0.005
    assert found.chi_square.mean() == pytest.approx(1, abs=0.06)


def test_blurs_that_differ_keep_their_ratios(nominal):
    case, told = Case(nominal, n=4), np.linspace(1.0, 1.3, len(nominal))
    images = photons.photon_images(case.true, case.points, SHAPE, np.random.default_rng(3), blur=0.0)
    assert images.shape == case.images.shape
    sharp, _ = case.found(images, told={"intrinsic_fwhm": 0.0})
    assert sharp.blur.max() < 0.15
    found, _ = case.found(told={"intrinsic_fwhm": told})
    assert np.allclose(found.blur / found.blur[0], told / told[0]) and found.blur.mean() == pytest.approx(1, abs=0.1)


def test_depth_of_interaction_moves_no_module_that_is_told_of_it(nominal):
    case = Case(nominal, crystal_mu=photons.CZT)
    found, texts = case.found(told={"crystal_mu": photons.CZT, "depth_layers": 5})
    assert texts == [] and case.rms(found).max() < 0.1 and found.misfitting == ()
    assert photons.consistency(found, case.true).mean() < 1.6
    with pytest.warns(mph.InputWarning, match="crystals of 10 mm without their depth of interaction"):
        model = mph.Emission(nominal, intrinsic_fwhm=1.0)
        front = mph.calibrate(nominal, case.images, nominal.views(SHAPE), model=model)
    assert case.rms(front).max() > 0.5


@pytest.mark.parametrize(("physics", "diameter"), [({"ball": 2.0}, 2.0), ({"cube": 2.0}, 2.58)])
def test_sources_that_are_no_points_are_told_or_said(nominal, physics, diameter):
    case = Case(nominal, **physics)
    found, texts = case.found(source_diameter=diameter)
    assert texts == [] and photons.consistency(found, case.true).mean() < 1.6
    (text,) = case.found()[1]
    stated = float(re.search(r"like balls of ([\d.]+) mm instead of 0 mm \(source_diameter\)", text)[1])
    assert stated == pytest.approx(diameter, abs=0.5)


def test_photons_through_the_edge_are_told_or_said(nominal):
    case = Case(nominal, n=5, seed=2, edge_mu=photons.TUNGSTEN)
    found, texts = case.found(told={"aperture_mu": photons.TUNGSTEN, "edge": "path"})
    assert texts == [] and photons.consistency(found, case.true).mean() < 1.6
    assert found.blur[0] == pytest.approx(1, abs=0.02)
    assert re.search(r"1\.1\d* times as wide as the holes' shadows: .*aperture_mu, edge", case.found()[1][0])


@pytest.mark.parametrize("known", ["points", "distances"])
@pytest.mark.parametrize("scale", [0.9, 1.05])
def test_a_wrong_scale_is_said_and_moves_nothing(case, known, scale):
    table = np.full((8, 8), np.nan)
    table[0, 1] = scale * np.linalg.norm(case.points[0] - case.points[1])
    plain, _ = case.found()
    found, (text,) = case.found(**{known: scale * case.points if known == "points" else table})
    assert f"{known}: they are {scale:g}" in text and "a scale" in text
    assert np.allclose(found.system.centers, plain.system.centers, atol=1e-3) and "scale" in found.gauge


def test_a_wrong_place_is_named_and_moves_no_module(case):
    honest, texts = case.found(points=case.points)
    assert texts == []
    points = case.points + [[3.0, 0, 0] if k == 4 else [0, 0, 0] for k in range(8)]
    found, (text,) = case.found(points=points)
    assert re.search(r"points: 5, [23]\.\d\d mm off, .* left out", text)
    assert found.misfitting == () and not found.used[4].any() and found.used[:4].all()
    assert np.linalg.norm(case.rms(found)) < 1.2 * np.linalg.norm(case.rms(honest))


def test_a_wrong_distance_is_named(case):
    table = np.linalg.norm(case.points[:, None] - case.points, axis=2)
    table[1, 6] = table[6, 1] = table[1, 6] + 3
    found, (text,) = case.found(distances=table)
    assert "distances: 2 to 7, 3.0" in text and "scale" not in found.gauge and found.misfitting == ()


def test_images_that_are_no_counts_are_said(case):
    honest, _ = case.found()
    found, texts = case.found(1000 * case.images / case.images.sum((2, 3), keepdims=True))
    assert "expected counts, whole numbers" in texts[0] and "chi-square is 0.05" in texts[1] and len(texts) == 2
    assert np.linalg.norm(case.rms(found)) < 1.2 * np.linalg.norm(case.rms(honest))
    found, (text,) = case.found(3 * case.images)
    assert "chi-square is 3" in text and "no counts but scaled" in text


def test_the_errors_are_as_large_as_stated(nominal):
    ratios = []
    for seed in range(3):
        case = Case(nominal, seed=seed)
        ratios.append(photons.consistency(case.found()[0], case.true).mean())
    assert 0.6 < np.mean(ratios) < 1.5


@pytest.mark.long
@pytest.mark.parametrize("name", photons.CASES)
def test_the_errors_are_as_large_as_stated_in_20_draws(nominal, name):
    ratios = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", mph.InputWarning)
        for seed in range(20):
            found, true = photons.calibration(nominal, np.random.default_rng(seed), **photons.CASES[name])
            ratios.append(photons.consistency(found, true).mean())
    assert 0.8 < np.mean(ratios) < 1.3
