"""The depth-dependent response with penetration of the knife edge by path: laws, photons one by one, and rays."""

from __future__ import annotations

import math

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.physics.aperture import KnifeEdge
from mphdrr.core.physics.performance import sensitivity

from .conftest import BACKENDS, WORKBOOK, general_grid, refused
from .test_emission import assert_adjoint
from .traced_photons import image_of_voxel, in_blocks, misplaced, module, traced_image

TUNGSTEN = 3.6
SYSTEM = mph.read_system(WORKBOOK)[[0, 47]]
PLACES = [(0.0, 0.0, 200.0), (3.1, -2.2, 150.0), (50.0, 30.0, 190.0), (-60.0, 55.0, 220.0)]
"""On the axis, near it, and twice off it, (u, v, depth), mm."""


def bound(place):
    return 0.01 if np.hypot(*place[:2]) < 10 else 0.02


@pytest.mark.parametrize("degrees", [0.0, 20.0, 40.0, 60.0])
def test_what_passes_the_solid_plate_falls_with_its_length_there(degrees):
    psi, edge = math.radians(degrees), KnifeEdge(1.0, 0.4, 1.0, 3.0)
    slope = np.float64(math.tan(psi))
    passed = edge.transmission(np.float64(40.0), np.float64(3.0), slope, np.float64(0.0))
    assert passed == pytest.approx(math.exp(-0.4 * 3.0 / math.cos(psi)), rel=1e-4)


def test_any_line_through_the_plate_is_weighted_with_its_length_in_it(rng):
    for _ in range(40):
        edge = KnifeEdge(1.0, rng.uniform(0.2, 1), rng.uniform(0.3, 1.5), rng.uniform(0.5, 4))
        x, y, a, b = rng.normal(size=4) * [1.5, 1.5, 0.7, 0.7]
        z = (np.arange(20_000) + 0.5) / 20_000 * edge.plate - edge.plate / 2
        inside = (np.hypot(x + z * a, y + z * b) > 1 + np.abs(z) * edge.tangent).mean() * edge.plate
        expected = math.exp(-edge.mu * inside * math.sqrt(1 + a * a + b * b))
        assert edge.transmission(x, y, np.float64(a), np.float64(b)) == pytest.approx(expected, abs=2e-4)


def test_on_the_axis_the_total_is_metzlers():
    for mu in (1.2, TUNGSTEN):
        total = image_of_voxel(module(), (0, 0, 200), 64, edge="path", aperture_mu=mu).sum()
        squared = 2.3**2 + 2 * 2.3 / mu + 2 / mu**2
        assert total == pytest.approx(squared / (16 * 200**2), rel=2e-3)


@pytest.mark.parametrize("plate", [None, 2.0])
def test_anywhere_the_total_is_the_sensitivity(plate):
    model = {"edge": "path", "aperture_mu": TUNGSTEN, "plate_thickness": plate}
    system = module()
    for place in PLACES:
        at = system.centers[0] + np.asarray(place) @ system.frames()[0]
        (law,) = sensitivity(system, at[None], optics=mph.Emission(system, **model).optics)[0]
        assert image_of_voxel(system, place, 64, **model).sum() == pytest.approx(
            law, rel=1e-3 if plate is None else 2e-3
        )


@pytest.mark.parametrize("place", PLACES[1:3])
def test_a_point_has_the_image_of_photons_one_by_one(place):
    system = module()
    exact = traced_image(system, place, 48, edge_mu=TUNGSTEN)
    found = image_of_voxel(system, place, 48, edge="path", aperture_mu=TUNGSTEN)
    assert misplaced(found, exact) < bound(place)
    paix = image_of_voxel(system, place, 48, edge="paix", aperture_mu=TUNGSTEN)
    assert misplaced(paix, exact) > 3 * misplaced(found, exact)


@pytest.mark.long
@pytest.mark.parametrize(
    ("mu", "plate", "within"), [(TUNGSTEN, None, 1.0), (TUNGSTEN, 2.0, 1.0), (0.9, None, 1.5), (0.6, 4.0, 2.5)]
)
def test_so_it_has_for_any_pixels_edges_and_plates(mu, plate, within):
    system = module()
    for place in PLACES[1:3]:
        fine = traced_image(system, place, 96, n=2**20, edge_mu=mu, plate=plate or 20.0)
        for pixels, exact in ((96, fine), (32, in_blocks(fine, 3))):
            found = image_of_voxel(system, place, pixels, edge="path", aperture_mu=mu, plate_thickness=plate)
            assert misplaced(found, exact) < within * bound(place)


def assert_exact(model, backend, rng):
    """The adjoint of a model of SYSTEM is exact, and the backend's numbers are the reference's."""
    grid, views = general_grid(rng, (9, 8, 21)), SYSTEM.views((22, 19))
    A, reference = (mph.Projector(grid, views, model, name, double=True) for name in (backend, "numpy"))
    assert_adjoint(A, rng)
    x, y = rng.random(A.shape_in), rng.random(A.shape_out)
    assert (A(x) * y).sum() == pytest.approx((A.T(y) * x).sum(), rel=1e-12)
    for found, expected in ((A(x), reference(x)), (A.T(y), reference.T(y))):
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * expected.max())


@pytest.mark.parametrize("backend", [b for b in BACKENDS if b in ("cpu", "numpy")])
def test_adjoint_is_exact_and_backends_agree(backend, rng):
    model = mph.Emission(SYSTEM, hole="depth", edge="path", aperture_mu=2.0, within_crystal=True)
    assert_exact(model, backend, rng)


def test_it_agrees_with_rays(rng):
    grid = mph.Grid.centered((12, 12, 12), 6.0)
    x = rng.random(grid.shape) ** 8
    given = {"edge": "path", "aperture_mu": TUNGSTEN, "plate_thickness": 3.0}
    A = mph.Projector(grid, SYSTEM[:1].views((24, 24)), mph.Emission(SYSTEM[:1], **given))
    rays = mph.Emission(SYSTEM[:1], hole="rays", aperture_points=61, pixel_points=13, tolerance=1e9, **given)
    assert misplaced(A(x), mph.Projector(grid, A.views, rays)(x)) < 0.01


def test_a_part_of_a_volume_has_its_part_of_the_images(rng):
    grid = general_grid(rng, (20, 18, 16))
    x, part = rng.random(grid.shape), np.zeros(grid.shape)
    part[7:12, :, 5:9] = x[7:12, :, 5:9]
    A = mph.Projector(grid, SYSTEM.views((40, 40)), mph.Emission(SYSTEM, edge="path", aperture_mu=2.0), double=True)
    np.testing.assert_allclose(A(part) + A(x - part), A(x), rtol=0, atol=1e-12 * A(x).max())


def test_a_thin_plate_is_warned_of_and_paix_has_none():
    system = module()
    grid, views = mph.Grid.centered((4, 4, 4), 5.0), system.views((8, 8))
    with pytest.warns(UserWarning, match="through the solid plate"):
        mph.Projector(grid, views, mph.Emission(system, edge="path", aperture_mu=0.6, plate_thickness=2.0))
    refused(lambda: mph.Emission(system, aperture_mu=3.0, plate_thickness=2.0), "plate_thickness", "edge 'path'")
