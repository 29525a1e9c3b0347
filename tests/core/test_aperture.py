"""Laws of the pinhole's plane: the knife edge, the hole's quadrature, and what stops photons."""

import dataclasses
import functools
import itertools

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.physics.aperture import KnifeEdge, openings

from .conftest import emission, general_grid, refused
from .test_emission import BACKENDS, assert_adjoint, assert_real_is_virtual, one_module, spot_image, turned_grid

KNIFE = KnifeEdge(radius=1.1, mu=3.0, tangent=0.8)
OPTIONS = {
    "aperture_points": 3, "aperture_mu": 2.0, "edge": "path", "crystal_mu": 0.1, "depth_layers": 3,
    "within_cone": True, "within_walls": True, "within_crystal": True,
}  # fmt: skip


def ellipse_area(length, slope):
    """Area, mm^2, of the pinhole's plane where a line with this slope runs less than `length` mm through the edge.

    Its rim is an ellipse: |(t x, w y) - f| + |(t x, w y) + f| = 2 K with w^2 = t^2 - slope^2, f = (a slope, 0) and
    2 K = 2 a t + length w^2 / sqrt(1 + slope^2), from the squared distances to the two cones.
    """
    a, t = KNIFE.radius, KNIFE.tangent
    squared = t**2 - slope**2
    k = a * t + length * squared / np.sqrt(1 + slope**2) / 2
    return np.pi * k * np.sqrt(k**2 - (a * slope) ** 2) / (t * np.sqrt(squared))


def open_area(n, knife, slope, angle=0.0):
    """Area, mm^2, of n openings of a hole with this edge, for a line with this slope."""
    slopes = np.array([slope * np.cos(angle)]), np.array([slope * np.sin(angle)])
    return sum(opening.area(*slopes)[0] for opening in openings(n, 2 * KNIFE.radius, knife))


def test_path_through_the_edge_equals_a_fine_walk_along_the_line(rng):
    for _ in range(12):
        radius, angle, slope_u, slope_v = rng.uniform((1.1, 0, -0.5, -0.5), (2.5, 7, 0.5, 0.5))
        x, y = radius * np.cos(angle), radius * np.sin(angle)
        z = np.linspace(-60, 60, 1_200_001)
        inside = np.hypot(x + z * slope_u, y + z * slope_v) > KNIFE.radius + np.abs(z) * KNIFE.tangent
        length = inside.sum() * (z[1] - z[0]) * np.sqrt(1 + slope_u**2 + slope_v**2)
        slopes = np.array([slope_u]), np.array([slope_v])
        passed = dataclasses.replace(KNIFE, mu=0.01).transmission(x, y, *slopes)[0]
        assert -np.log(passed) / 0.01 == pytest.approx(length, abs=1e-3)


def test_nothing_passes_steeper_than_the_cone():
    slope = np.array([0.79999, 0.8, 0.9, 5.0])
    assert (KNIFE.transmission(1.2, 0.0, slope, 0 * slope) == 0).all()
    assert not any(open_area(7, KNIFE, s) for s in slope[1:])


@pytest.mark.parametrize("n", [1, 3, 7, 64])
def test_open_area_equals_the_integral_over_paths(n):
    """Along the axis d^2 + 2 d t / mu + 2 t^2 / mu^2 (Metzler 2001); inclined, mu times the integral of exp(-mu L) A(L).

    An opaque edge leaves the hole, at every angle within the cone: the hole's obliquity is in cos^4(psi).
    """
    d, t, mu = 2 * KNIFE.radius, KNIFE.tangent, KNIFE.mu
    lengths = (np.arange(200_000) + 0.5) * 1e-4
    for slope, tolerance in ((0.0, 1e-6), (0.2, 1e-4), (0.4, 2e-4), (0.56, 2e-3), (0.75, 1.3e-2)):
        expected = np.sum(np.exp(-mu * lengths) * ellipse_area(lengths, slope)) * mu * 1e-4
        for angle in (0.0, 1.0, 2.5):
            assert abs(open_area(n, KNIFE, slope, angle) - expected) < tolerance * np.pi / 4 * d**2
    axial = d**2 + 2 * d * t / mu + 2 * t**2 / mu**2
    assert open_area(n, KNIFE, 0.0) * 4 / np.pi == pytest.approx(axial, rel=1e-12)
    for slope in (0.0, 0.3, 0.79):
        opaque = open_area(n, dataclasses.replace(KNIFE, mu=1e7), slope)
        assert opaque == pytest.approx(np.pi / 4 * d**2, rel=1e-6)


@pytest.mark.parametrize("n", [1, 7])
def test_point_source_on_the_axis_counts_what_the_edge_lets_pass(n):
    """Against the solid angle of the hole and the edge, integrated over the plane with each point's own direction."""
    system, mu = one_module(), 3.6
    model = emission(system, aperture_points=n, aperture_mu=mu, edge="path")
    image, _ = spot_image(model, (0, 0, 0))
    h = 200.0
    r = (np.arange(400_000) + 0.5) * 1e-5  # to 4 mm
    passed = np.where(r < 1, 1.0, KnifeEdge(1.0, mu, 1.0).transmission(r, 0.0, r / h, 0 * r))
    solid = np.sum(passed * h / (h**2 + r**2) ** 1.5 * r) * 1e-5 / 2
    assert image.sum() == pytest.approx(solid * 1.2**3, rel=5e-3)
    assert model.effective_diameter[0] ** 2 == pytest.approx(4 + 4 / mu + 2 / mu**2)


FINE, SIDE = 0.1, 8.0


@functools.cache
def voxel_image(n, fwhm):
    """Image on fine pixels, of a sum of 1, of a voxel of 8 mm^3 at the isocentre through n points of the hole."""
    grid, system = turned_grid((1, 1, 1), 2.0), one_module()
    views = system.views((round(SIDE / FINE),) * 2, "real", pitch=FINE)
    model = emission(system, aperture_points=n, pixel_points=8, intrinsic_fwhm=fwhm)
    image = mph.Projector(grid, views, model)(np.ones((1, 1, 1)))
    return image[0] / image.sum()


@pytest.mark.parametrize("fwhm", [0.0, pytest.param(1.0, marks=pytest.mark.long)])
def test_points_for_a_tolerance_keep_it(fwhm):
    """A voxel's counts, integrated over whole pixels at any offset; a third of the points would not suffice."""
    system = one_module()
    exact = voxel_image(400, fwhm)

    def error(n, pitch):
        fine = voxel_image(n, fwhm) - exact
        pixels = round(SIDE / pitch), round(pitch / FINE)
        begins = range(0, pixels[1], max(1, pixels[1] // 5))
        shifted = (np.roll(fine, shift, axis=(0, 1)) for shift in itertools.product(begins, begins))
        return max(np.abs(image.reshape(pixels + pixels).sum(axis=(1, 3))).sum() for image in shifted)

    for pitch in (0.2, 1.6, 4.0):
        for tolerance in (0.1, 0.04):
            model = emission(system, aperture_tolerance=tolerance, intrinsic_fwhm=fwhm)
            n = model.hole_points(system.views((8, 8), "real", pitch=pitch), 0, mph.Grid.centered((1, 1, 1), 2.0))
            assert error(n, pitch) < tolerance
            if n > 8:
                assert error(n // 3, pitch) > tolerance


def flat_field(model, n=120, pitch=1.0):
    """Image of a slab that fills the pixels' field of view."""
    slab = mph.Grid.centered((1, 1, 1), (10, 2000, 2000))
    views = model.system.views((n, n), "real", pitch=pitch)
    return mph.Projector(slab, views, model)(np.ones((1, 1, 1)))[0].astype(float)


@pytest.mark.parametrize("edge", [{"within_cone": True}, {"aperture_mu": 1e7, "edge": "path"}])
def test_the_cone_lets_a_disk_of_the_crystal_see(edge):
    """Its radius l tan(alpha / 2); inside nothing changes."""
    system, angle = one_module(), np.deg2rad(50)
    share = flat_field(emission(system, opening_angle=angle, **edge)) / flat_field(emission(system))
    np.testing.assert_allclose(share[share > 0], 1, rtol=1e-6)
    assert (share > 0).sum() == pytest.approx(np.pi * (60 * np.tan(angle / 2)) ** 2, rel=0.01)


def test_walls_stop_what_would_enter_the_crystals_sides():
    """At depth z photons from the front are within (l + z) / l Ld; at the front the walls end at the crystal's edges."""
    system = one_module(detector_side=40.0)
    walls = flat_field(emission(system, within_walls=True))
    np.testing.assert_allclose(walls, flat_field(emission(system, within_crystal=True)), rtol=1e-6)
    deep = {"crystal_mu": 1e-6, "depth_layers": 2}  # absorbed as often at the front as at the back, at 70 mm
    share = flat_field(emission(system, within_walls=True, **deep)) / flat_field(emission(system, **deep))
    places = np.abs(np.arange(120) - 59.5)
    # One of the two layers ends at 20 mm, the other at 20 * 70 / 60, smoothed over a pixel.
    middle = share[60]
    np.testing.assert_allclose(middle[places < 19], 1, rtol=1e-5)
    # In between only the back layer counts: cos^2 / distance^2, from cos^4, the slab's path and the crystal's.
    between = places[(places > 20.5) & (places < 22.5)]
    front, back = (1 / (distance**2 + between**2 + 0.25) for distance in (60, 70))
    np.testing.assert_allclose(middle[(places > 20.5) & (places < 22.5)], back / (front + back), rtol=1e-5)
    assert not middle[places > 24].any()


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(
    "options",
    [
        {"aperture_points": 3, "aperture_mu": 2.0, "edge": "path"},
        {"aperture_mu": 2.0, "edge": "path", "within_cone": True, "within_walls": True},
        {"crystal_mu": 0.1, "depth_layers": 3, "within_walls": True, "within_crystal": True, "intrinsic_fwhm": 5.0},
        {"aperture_tolerance": 0.3, "isotope": "Tc-99m", "time": 600.0},
    ],
)
def test_adjoint_of_every_option(backend, options, system, rng):
    system, grid = system[3:5], general_grid(rng, (9, 8, 7))
    views, model = system.views((10, 11), offset=(20.0, 0.0)), emission(system, **options)
    assert_adjoint(mph.Projector(grid, views, model, backend, threads=2), rng)


def test_real_and_virtual_detector_agree_on_every_option(system, rng):
    assert_real_is_virtual(emission(system, **OPTIONS), rng)


def test_bad_apertures_and_crystals_are_refused(system):
    for name, values in (
        ("aperture_points", (0, 2, 2.5)),
        ("aperture_mu", (-1,)),
        ("opening_angle", (4,)),
        ("crystal_mu", (0,)),
        ("intrinsic_fwhm", (-1,)),
        ("aperture_tolerance", (0,)),
        ("depth_layers", (0,)),
    ):
        for value in values:
            refused(lambda setting={name: value}: emission(system, **setting), name)
    for settings, words in (
        ({"aperture_tolerance": 0.1, "aperture_points": 7}, "not both"),
        ({"edge": "sharp"}, "'paix' or 'path'"),
        ({"edge": "path"}, "aperture_mu"),
        ({"depth_layers": 3}, "crystal_mu"),
    ):
        refused(lambda settings=settings: emission(system, **settings), words)
    grid = mph.Grid.centered((4, 4, 4), 0.01)
    model = emission(system, aperture_tolerance=1e-3)
    refused(lambda: mph.Projector(grid, system.views((900, 900)), model), "more than 1000 points")


def test_weights_of_tensors_are_those_of_arrays_and_differentiable():
    """By the pixels' positions and the collimator's length, for optimising the poses of cameras that count photons."""
    torch = pytest.importorskip("torch", reason="torch is not installed")
    model = emission(one_module(), **OPTIONS)
    u, v = np.linspace(-24, 23, 6)[None], np.linspace(-22, 21, 5)[:, None]
    for opening in model.openings(0, 3)[::4]:
        for layer in (0, 2):

            def weights(u, v, length, opening=opening, layer=layer):
                return model.pixel_weights(0, u, v, (0.5, 0.4), length, opening, layer)

            tensors = [torch.tensor(x, dtype=torch.float64, requires_grad=True) for x in (u, v, 60.0)]
            np.testing.assert_allclose(weights(*tensors).detach().numpy(), weights(u, v, 60.0), rtol=1e-12)
            assert torch.autograd.gradcheck(lambda *x, weights=weights: 1e6 * weights(*x), tensors)


def test_memory_is_asked_for_mu_and_for_weights(system, monkeypatch):
    """Before it is allocated: with a large mu, or voxel weights, a smaller volume fits."""
    grid, views = mph.Grid.centered((40, 40, 40), 2.0), system.views((4, 4))
    large = mph.Volume(np.zeros((80, 80, 80), np.float32), mph.Grid.centered(80, 2.0), "mu")
    monkeypatch.setattr("mphdrr.core.memory.available", lambda: 600_000)
    for model in (emission(system), emission(system, large), mph.InverseSquareSum(system)):
        A = mph.Projector(grid, views, model, "numpy")
        for operator, x in ((A, np.zeros(grid.shape)), (A.T, np.zeros(A.shape_out))):
            if isinstance(model, mph.Emission) and model.mu is None:
                operator(x)
            else:
                refused(lambda operator=operator, x=x: operator(x), "of memory")


def test_the_whole_camera_counts_like_photons_one_by_one(rng):
    """Photons from a spot through the edge into the crystal: number, mean and deviation of the recorded positions."""
    system, n = one_module(detector_side=30.0), 1_000_000
    grid = turned_grid((3, 3, 3), 1.0, (20.0, 37.0, -20.0))
    edge, crystal_mu, far = KnifeEdge(1.0, 1.5, 1.0), 0.15, 4.0

    # From anywhere in the spot, to anywhere in the pinhole's plane around the hole: (u, v, towards the pinhole), mm.
    inside = rng.uniform(-0.5, 2.5, (n, 3)) @ grid.affine[:3, :3].T + grid.affine[:3, 3] - system.centers[0]
    u, v, h = system.frames()[0] @ inside.T
    radius, angle = far * np.sqrt(rng.random(n)), rng.uniform(0, 2 * np.pi, n)
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    slope_u, slope_v = (u - x) / h, (v - y) / h
    cosine = 1 / np.sqrt(1 + slope_u**2 + slope_v**2)
    chance = np.pi * far**2 * cosine**3 / (4 * np.pi * h**2)  # to leave towards the area of the plane
    beyond = edge.transmission(x, y, slope_u, slope_v)
    chance *= np.where(radius < 1, slope_u**2 + slope_v**2 < 1, beyond)
    depth = rng.exponential(cosine / crystal_mu)
    front_u, front_v = x - 60 * slope_u, y - 60 * slope_v
    chance *= (depth < 10) & (np.abs(front_u) < 15) & (np.abs(front_v) < 15)
    seen = chance / chance.sum()
    places = np.stack([x - (60 + depth) * slope_u, y - (60 + depth) * slope_v])

    model = emission(
        system, aperture_points=37, aperture_mu=edge.mu, edge="path", crystal_mu=crystal_mu, depth_layers=9,
        within_walls=True,
    )  # fmt: skip
    views = system.views((100, 100), "real", pitch=0.4)
    image = mph.Projector(grid, views, model)(np.ones(grid.shape))[0].astype(float)
    pixels = np.arange(100) * 0.4 - 19.8
    marginals = image.sum(axis=0) / image.sum(), image.sum(axis=1) / image.sum()
    assert image.sum() == pytest.approx(chance.mean() * 27, rel=0.01)
    for place, marginal in zip(places, marginals, strict=True):
        mean = marginal @ pixels
        assert mean == pytest.approx(seen @ place, abs=0.02)
        spread = np.sqrt(seen @ place**2 - (seen @ place) ** 2)
        assert np.sqrt(marginal @ pixels**2 - mean**2) == pytest.approx(spread, rel=0.02)
