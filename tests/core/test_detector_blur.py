"""The detector's blur acts on photons before pixels count them; the truth is photons blurred on a continuous crystal."""

import math

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.physics.crystal import gaussian_blur, point_blur

FWHM_PER_SIGMA = math.sqrt(8 * math.log(2))
ERF = np.vectorize(math.erf)
VOXEL = (5, 2, 6)


@pytest.fixture(scope="module")
def module():
    return mph.read_system("examples/dc-spect-80.xlsx")[:1]


def one_voxel(spacing):
    grid = mph.Grid.centered((9, 9, 9), spacing=spacing)
    x = np.zeros(grid.shape)
    x[VOXEL] = 1.0
    return grid, x


def photons_in_pixels(system, n, grid, fwhm):
    """Return the shares (n, n) of a voxel's photons in the pixels of a real detector, by quadrature over voxel and hole.

    Photons that do not meet the detector are lost.

    Each line through a point of the hole ends in a Gaussian on the crystal, whose integral over a pixel is a product of
    differences of error functions.
    """
    (u, v, k), l, d = system.frames()[0], system.collimator_length[0], system.pinhole_diameter[0]
    x, w = np.polynomial.legendre.leggauss(24)
    angles = 2 * np.pi * np.arange(48) / 48
    radii = d / 2 * np.sqrt((x + 1) / 2)
    hole = np.stack([np.outer(radii, np.cos(angles)).ravel(), np.outer(radii, np.sin(angles)).ravel()])
    x3, w3 = np.polynomial.legendre.leggauss(3)
    places = np.stack(np.meshgrid(x3 / 2, x3 / 2, x3 / 2, indexing="ij"), -1).reshape(-1, 3) + VOXEL
    points = places @ grid.affine[:3, :3].T + grid.affine[:3, 3] - system.centers[0]
    along_u, along_v, h = points @ u, points @ v, points @ k
    positions = [(a * l / h)[:, None] - b * (1 + l / h)[:, None] for a, b in zip((along_u, along_v), hole, strict=True)]
    squared_slope = ((along_u[:, None] - hole[0]) ** 2 + (along_v[:, None] - hole[1]) ** 2) / h[:, None] ** 2
    weights = np.einsum("i,j,k->ijk", w3, w3, w3).reshape(-1, 1) / h[:, None] ** 2 * (1 + squared_slope) ** -1.5
    weights = (weights * np.repeat(w, 48)).ravel()
    meets = np.all([np.abs(p.ravel()) < system.detector_side[0] / 2 for p in positions], axis=0)
    edges = (np.arange(n + 1) - n / 2) * system.detector_side[0] / n
    scale = FWHM_PER_SIGMA / fwhm / math.sqrt(2)
    ticks = np.linspace(-6, 6, 20_001)
    steps = ERF(ticks)
    in_u, in_v = (np.diff(np.interp(scale * (edges - p.reshape(-1, 1)), ticks, steps) / 2, axis=1) for p in positions)
    return (in_v * (weights * meets)[:, None]).T @ in_u / weights.sum()


def upright(image, truth):
    """Return the truth in the orientation of the image."""
    turned = [truth[::a, ::b] for a in (1, -1) for b in (1, -1)]
    return min(turned, key=lambda t: np.abs(image / image.sum() - t).sum())


def variance(image):
    profile = image.sum(axis=0) / image.sum()
    places = np.arange(len(profile))
    return profile @ places**2 - (profile @ places) ** 2


CASES = [(16, 0.2), (16, 1.0), (16, 3.0), (32, 0.2), (32, 1.5), (32, 3.0), (64, 0.5), (64, 1.0), (64, 3.0), (64, 6.0),
         (128, 0.35), (128, 1.0), (128, 3.0), (256, 0.5)]  # fmt: skip


@pytest.mark.parametrize(("n", "fwhm"), [*CASES, pytest.param(512, 0.2, marks=pytest.mark.long)])
def test_photons_are_blurred_before_pixels_count_them(module, n, fwhm):
    """Of a voxel's counts at most 0.3 % are in other pixels, and the image is as wide as that of the photons."""
    grid, x = one_voxel(1.0)
    A = mph.Projector(grid, module.views((n, n)), mph.Emission(module, intrinsic_fwhm=fwhm), double=True)
    image = A(x)[0]
    truth = upright(image, photons_in_pixels(module, n, grid, fwhm))
    assert np.abs(image / image.sum() - truth / truth.sum()).sum() / 2 < 0.0015
    assert variance(image) == pytest.approx(variance(truth), rel=1e-3)


ENDS = [(16, 0.2), (16, 2.0), (32, 1.0), (64, 0.2), (64, 3.0), (64, 6.0), (128, 0.35), (256, 3.0)]


@pytest.mark.parametrize(("n", "fwhm"), ENDS)
@pytest.mark.parametrize("beyond", [-2.0, -1.0, 0.0, 1.0])
def test_photons_beyond_the_detector_are_lost(module, n, fwhm, beyond):
    """Of the photons of a voxel whose image the detector's end cuts, at most 0.3 % are in another pixel, or wrongly lost."""
    u, v, k = module.frames()[0]
    h, l = module.pinhole_distance[0], module.collimator_length[0]
    place = module.centers[0] + h * k + h / l * ((module.detector_side[0] / 2 + beyond) * u + 3 * v)
    grid = mph.Grid.centered((9, 9, 9), 1.0, center=place)
    x = np.zeros(grid.shape)
    x[VOXEL] = 1.0
    wide = module.replace(detector_side=2 * module.detector_side)
    model, everywhere = mph.Emission(module, intrinsic_fwhm=fwhm), mph.Emission(wide)
    image = mph.Projector(grid, module.views((n, n)), model, double=True)(x)[0]
    total = mph.Projector(grid, wide.views((64, 64)), everywhere, double=True)(x).sum()
    errors = image / total - upright(image, photons_in_pixels(module, n, grid, fwhm))
    assert (np.abs(errors).sum() + abs(errors.sum())) / 2 < 0.003


@pytest.mark.parametrize("hole", ["point", "rays"])
@pytest.mark.parametrize(("n", "fwhm"), [(16, 1.0), (32, 0.2), (32, 3.0)])
def test_by_rays_photons_are_blurred_before_pixels_count_them(module, hole, n, fwhm):
    """The truth is the image without blur in pixels 1/16 as wide, blurred by differences of error functions."""
    grid = mph.Grid.centered((21, 21, 21), spacing=1.0)
    ball = 1.0 * (((np.indices(grid.shape) - 10) ** 2).sum(axis=0) <= 36)
    options = {"hole": hole, **({"aperture_points": 19} if hole == "rays" else {})}
    fine = 512
    sharp = mph.Projector(grid, module.views((fine, fine)), mph.Emission(module, **options))(ball)[0]
    blur = gaussian_of_positions(n, fine, module.detector_side[0], fwhm)
    truth = blur @ sharp @ blur.T
    image = mph.Projector(grid, module.views((n, n)), mph.Emission(module, intrinsic_fwhm=fwhm, **options))(ball)[0]
    assert np.abs(image / image.sum() - truth / truth.sum()).sum() / 2 < 0.003
    assert image.sum() == pytest.approx(truth.sum(), rel=1e-3)


def gaussian_of_positions(n, fine, side, fwhm):
    """Return the shares (n, fine) of photons at the centres of fine pixels that are recorded in each of n pixels."""
    centres, edges = ((np.arange(fine) + 0.5) / fine - 0.5) * side, (np.arange(n + 1) / n - 0.5) * side
    return np.diff(ERF((edges[:, None] - centres) * FWHM_PER_SIGMA / fwhm / math.sqrt(2)) / 2, axis=0)


def test_subsets_have_the_images_of_the_whole():
    """Modules with pixels of two sizes need different numbers of parts; a subset takes those of the whole."""
    system = mph.read_system("examples/dc-spect-80.xlsx")[:4].replace(pinhole_diameter=[0.3, 0.3, 6.0, 6.0])
    grid, x = one_voxel(4.0)
    A = mph.Projector(grid, system.views((16, 16)), mph.Emission(system, intrinsic_fwhm=4.0), double=True)
    for subset in A.subsets(4):
        np.testing.assert_allclose(subset(x), A(x)[subset.which], rtol=1e-12)


@pytest.mark.filterwarnings("ignore:.*points of each pixel")
def test_subsets_of_lines_with_walls_have_the_images_of_the_whole():
    """Lines have walls' photons as parts, of several numbers of parts of pixels; all of them are those of the whole."""
    system = mph.read_system("examples/dc-spect-80.xlsx")[:2].replace(pinhole_diameter=[0.3, 6.0])
    model = mph.Emission(system, isotope="I-131", window=(280, 370), lines="apart", wall_thickness=2.0, intrinsic_fwhm=4.0,
                         aperture_mu="tungsten", crystal_mu="NaI", aperture_points=3, pixel_points=1)  # fmt: skip
    A = mph.Projector(mph.Grid.centered((4, 4, 4), 12.0), system.views((8, 8)), model, double=True)
    x = np.ones(A.shape_in)
    assert any(line._parts for line in A._parts)
    for subset in A.subsets(2):
        np.testing.assert_allclose(subset(x), A(x)[subset.which], rtol=1e-12)


@pytest.mark.parametrize("parts", [1, 3])
@pytest.mark.parametrize("sigma", [0.01, 0.2, 0.45, 0.7, 1.63, 3.0])
def test_a_blur_has_its_variance(sigma, parts):
    """A row adds the blur's variance to a part's own, and keeps the counts; no weight is below 0."""
    n = 61
    matrix = gaussian_blur(n, sigma, parts)
    places = (np.arange(n * parts) + 0.5) / parts - 0.5
    row = matrix[n // 2]
    assert row.sum() == pytest.approx(parts, rel=1e-12)
    assert matrix.min() >= 0
    within_pixel = (1 - 1 / parts**2) / 12  # of the parts of a pixel around its centre
    assert row @ (places - n // 2) ** 2 / parts == pytest.approx(sigma**2 + within_pixel, rel=1e-3)


def test_values_at_centres_become_means_of_pixels():
    """Of a quadratic function, whose blurred mean is known."""
    places = np.arange(61) - 30.0
    assert point_blur(61, 2.0)[30] @ places**2 == pytest.approx(2.0**2 + 1 / 12, rel=1e-9)


@pytest.mark.parametrize("blur", [lambda n, sigma: gaussian_blur(n, sigma, 3), point_blur])
@pytest.mark.parametrize("sigma", [0.05, 0.3, 1.0, 2.5])
def test_an_even_flux_is_blurred_exactly_up_to_the_ends(blur, sigma):
    """The truth is photons at many places of each pixel, with none beyond the ends; or its slope is even."""
    n, fine = 24, 4800
    places, edges = (np.arange(fine) + 0.5) * n / fine, np.arange(n + 1)
    recorded = np.diff(ERF((edges[:, None] - places) / sigma / math.sqrt(2)) / 2, axis=0) * n / fine
    matrix = blur(n, sigma)
    parts = matrix.shape[1] // n
    for flux in (lambda x: 1 + 0 * x, lambda x: x):
        means = flux((np.arange(n * parts) + 0.5) / parts) / parts
        np.testing.assert_allclose(matrix @ means, recorded @ flux(places), rtol=0, atol=2e-4 * n)
