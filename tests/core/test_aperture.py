"""Laws of the pinhole's plane: the knife edge, the hole's quadrature, and what stops photons."""

from __future__ import annotations

import functools
import itertools

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.physics.aperture import KnifeEdge, openings

from .conftest import emission, refused
from .test_emission import one_module, turned_grid
from .traced_photons import image_of_voxel, misplaced, traced_image

KNIFE = KnifeEdge(radius=1.1, mu=3.0, tangent=0.8)


def ellipse_area(length, slope):
    """Return the area, mm^2, of the pinhole's plane where lines of a slope run less than `length` mm through the edge.

    Its rim is an ellipse: |(t x, w y) - f| + |(t x, w y) + f| = 2 K with w^2 = t^2 - slope^2, f = (a slope, 0) and
    2 K = 2 a t + length w^2 / sqrt(1 + slope^2), from the squared distances to the two cones.
    """
    a, t = KNIFE.radius, KNIFE.tangent
    squared = t**2 - slope**2
    k = a * t + length * squared / np.sqrt(1 + slope**2) / 2
    return np.pi * k * np.sqrt(k**2 - (a * slope) ** 2) / (t * np.sqrt(squared))


@pytest.mark.parametrize(
    ("plate", "nearest", "tangent"), [(None, 1.1, 0.8), (0.6, 0.0, 0.3), (2.0, 0.0, 0.8), (4.0, 0.0, 1.4)]
)
def test_path_through_the_edge_and_its_plate_equals_a_fine_walk_along_the_line(plate, nearest, tangent, rng):
    edge = KnifeEdge(1.1, 0.3, tangent, plate)
    z = np.linspace(-60, 60, 1_200_001)
    for _ in range(12):
        radius, angle, slope_u, slope_v = rng.uniform((nearest, 0, -0.5, -0.5), (2.5, 7, 0.5, 0.5))
        x, y = radius * np.cos(angle), radius * np.sin(angle)
        inside = np.hypot(x + z * slope_u, y + z * slope_v) > edge.radius + np.abs(z) * tangent
        inside &= np.abs(z) < (plate or np.inf) / 2
        length = inside.sum() * (z[1] - z[0]) * np.sqrt(1 + slope_u**2 + slope_v**2)
        passed = edge.transmission(x, y, np.array([slope_u]), np.array([slope_v]))[0]
        assert passed == pytest.approx(np.exp(-edge.mu * length), abs=3e-4)


def test_nothing_passes_steeper_than_the_cone():
    slope = np.array([0.79999, 0.8, 0.9, 5.0])
    assert (KNIFE.transmission(1.2, 0.0, slope, 0 * slope) == 0).all()
    for opening in openings(7, 2.2, KNIFE):
        assert not np.any(opening.area(slope[1:], 0 * slope[1:]))


@pytest.mark.parametrize("n", [1, 3, 7, 64])
def test_open_area_equals_the_integral_over_paths(n):
    """Along the axis d^2 + 2 d t / mu + 2 t^2 / mu^2 (Metzler 2001); inclined, mu times the integral of exp(-mu L) A(L)."""
    d, t, mu = 2 * KNIFE.radius, KNIFE.tangent, KNIFE.mu
    lengths = (np.arange(200_000) + 0.5) * 1e-4
    for slope, tolerance in ((0.0, 1e-6), (0.2, 1e-4), (0.4, 2e-4), (0.56, 2e-3), (0.75, 1.3e-2)):
        for angle in (0.0, 1.0, 2.5):
            slopes = np.array([slope * np.cos(angle)]), np.array([slope * np.sin(angle)])
            area = sum(opening.area(*slopes)[0] for opening in openings(n, d, KNIFE))
            expected = np.sum(np.exp(-mu * lengths) * ellipse_area(lengths, slope)) * mu * 1e-4
            assert abs(area - expected) < tolerance * np.pi / 4 * d**2
            if slope == 0:
                assert area * 4 / np.pi == pytest.approx(d**2 + 2 * d * t / mu + 2 * t**2 / mu**2, rel=1e-12)


FINE, SIDE = 0.1, 8.0


@functools.cache
def voxel_image(n, fwhm):
    """Return the image on fine pixels, of sum 1, of a voxel of 8 mm^3 at the isocentre through n points of the hole."""
    grid, system = turned_grid((1, 1, 1), 2.0), one_module()
    views = system.views((round(SIDE / FINE),) * 2, "real", pitch=FINE)
    image = mph.Projector(grid, views, emission(system, aperture_points=n, pixel_points=8, intrinsic_fwhm=fwhm))(
        np.ones((1, 1, 1))
    )
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
    """Return the image of a slab that fills the pixels' field of view."""
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


def test_bad_apertures_and_crystals_are_refused(system):
    for arguments, word in (
        ({"aperture_points": 0}, "aperture_points"),
        ({"aperture_points": 2}, "aperture_points"),
        ({"aperture_points": 2.5}, "aperture_points"),
        ({"aperture_mu": -1}, "aperture_mu"),
        ({"opening_angle": 4}, "opening_angle"),
        ({"crystal_mu": 0}, "crystal_mu"),
        ({"intrinsic_fwhm": -1}, "intrinsic_fwhm"),
        ({"aperture_tolerance": 0}, "aperture_tolerance"),
        ({"aperture_tolerance": 0.1, "aperture_points": 7}, "not both"),
        ({"edge": "sharp"}, "'paix' or 'path'"),
        ({"edge": "path"}, "aperture_mu"),
        ({"depth_layers": 0}, "depth_layers"),
        ({"depth_layers": 3}, "crystal_mu"),
    ):
        refused(lambda arguments=arguments: emission(system, **arguments), word)
    grid = mph.Grid.centered((4, 4, 4), 0.01)
    model = emission(system, aperture_tolerance=1e-3)
    refused(lambda: mph.Projector(grid, system.views((900, 900)), model), "more than 1000 points")


def test_weights_of_tensors_are_those_of_arrays_and_differentiable():
    """By the pixels' positions and the collimator's length, for optimising the poses of cameras that count photons."""
    torch = pytest.importorskip("torch", reason="torch is not installed")
    model = emission(
        one_module(), aperture_points=3, aperture_mu=2.0, edge="path", crystal_mu=0.1, depth_layers=3, within_cone=True,
        within_walls=True, within_crystal=True,
    )  # fmt: skip
    u, v = np.linspace(-24, 23, 6)[None], np.linspace(-22, 21, 5)[:, None]
    for opening in model.openings(0, 3)[::4]:
        for layer in (0, 2):
            expected = model.pixel_weights(0, u, v, (0.5, 0.4), 60.0, opening, layer)
            given = [torch.tensor(x, dtype=torch.float64, requires_grad=True) for x in (u, v, 60.0)]

            def weights(u, v, length, opening=opening, layer=layer):
                return model.pixel_weights(0, u, v, (0.5, 0.4), length, opening, layer)

            np.testing.assert_allclose(weights(*given).detach().numpy(), expected, rtol=1e-12)
            assert torch.autograd.gradcheck(lambda *x: 1e6 * weights(*x), given)


def test_memory_is_asked_for_mu_and_for_weights(system, monkeypatch):
    """Before it is allocated: with a large mu, or voxel weights, a smaller volume fits."""
    grid, views = mph.Grid.centered((40, 40, 40), 2.0), system.views((4, 4))
    large = mph.Volume(np.zeros((80, 80, 80), np.float32), mph.Grid.centered(80, 2.0), "mu")
    monkeypatch.setattr("mphdrr.core.memory.available", lambda: 600_000)
    for model in (None, emission(system, large), mph.InverseSquareSum(system)):
        A = mph.Projector(grid, views, model or emission(system), "numpy")
        for run, x in ((A, np.zeros(grid.shape)), (A.T, np.zeros(A.shape_out))):
            if model:
                refused(lambda run=run, x=x: run(x), "of memory")
            else:
                run(x)


def test_the_whole_camera_counts_like_photons_one_by_one():
    """Photons from a cube through the edge into the crystal."""
    system, place, size = one_module(), (20.0, -12.0, 190.0), 6.0
    exact = traced_image(system, place, 16, size, edge_mu=1.5, crystal_mu=0.15)
    rays = {"hole": "rays", "aperture_points": 37, "pixel_points": 21, "depth_layers": 9, "tolerance": 1e9}
    image = image_of_voxel(system, place, 16, size, aperture_mu=1.5, edge="path", crystal_mu=0.15, **rays)
    assert misplaced(image, exact) < 0.015
    assert image.sum() == pytest.approx(exact.sum(), rel=0.01)
