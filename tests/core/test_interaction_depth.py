"""The depth-dependent response with the photons' depth in the crystal: laws, photons one by one, and rays."""

from __future__ import annotations

import math

import numpy as np
import pytest

import mphdrr.core as mph

from .conftest import BACKENDS, WORKBOOK
from .test_penetrating_response import PLACES, TUNGSTEN, assert_exact, bound
from .traced_photons import image_of_voxel, in_blocks, misplaced, module, traced_image

SYSTEM = mph.read_system(WORKBOOK)[[0, 47]]
IODIDE = 0.26
DEEP = {"crystal_mu": IODIDE, "depth_layers": 8}


@pytest.mark.parametrize("mu", [0.08, IODIDE])
def test_the_mean_shift_is_that_of_exponential_absorption(mu):
    system, thickness, place = module(), 10.0, (50.0, 0.0, 200.0)
    means = []
    for layers in (1, 2):
        image = image_of_voxel(system, place, 160, crystal_mu=mu, depth_layers=layers)
        across = (np.arange(160) - 79.5) * 50 / 160
        means.append((image.sum(axis=0) * across).sum() / image.sum())
    psi = math.atan2(place[0], place[2])
    tau = mu * thickness / math.cos(psi)
    law = math.tan(psi) * math.cos(psi) / mu * (1 - tau * math.exp(-tau) / -math.expm1(-tau))
    assert abs(means[1] - means[0]) == pytest.approx(law, rel=5e-3)


@pytest.mark.parametrize("place", PLACES[1:3])
def test_a_point_has_the_image_of_photons_one_by_one(place):
    system = module()
    exact = traced_image(system, place, 48, edge_mu=TUNGSTEN, crystal_mu=IODIDE)
    found = image_of_voxel(system, place, 48, edge="path", aperture_mu=TUNGSTEN, **DEEP)
    assert misplaced(found, exact) < bound(place)
    assert found.sum() == pytest.approx(exact.sum(), rel=3e-3)


@pytest.mark.long
@pytest.mark.parametrize(("edge_mu", "mu"), [(None, IODIDE), (TUNGSTEN, IODIDE), (None, 0.08), (TUNGSTEN, 0.08)])
def test_so_it_has_for_any_pixels_and_crystals(edge_mu, mu):
    system = module()
    edge = {} if edge_mu is None else {"edge": "path", "aperture_mu": edge_mu}
    for place in PLACES[1:3]:
        fine = traced_image(system, place, 96, n=2**20, edge_mu=edge_mu, crystal_mu=mu)
        for pixels, exact in ((96, fine), (32, in_blocks(fine, 3))):
            found = image_of_voxel(system, place, pixels, crystal_mu=mu, depth_layers=2, **edge)
            assert misplaced(found, exact) < 2 * bound(place)
            assert found.sum() == pytest.approx(exact.sum(), rel=6e-3)


def test_beyond_the_crystals_side_nothing_is_recorded():
    system = module(side=40.0)
    views = system.views((60, 60), "real", pitch=1.0)
    grid = mph.Grid.centered((9, 9, 9), 12.0)
    for within in ({"within_crystal": True}, {"within_walls": True}):
        image = mph.Projector(grid, views, mph.Emission(system, **DEEP, **within))(np.ones(grid.shape))[0]
        assert image[:10].max() == image[:, :10].max() == image[50:].max() == image[:, 50:].max() == 0
        assert image[10:50, 10:50].min() > 0


@pytest.mark.parametrize("backend", [b for b in BACKENDS if b in ("cpu", "numpy")])
@pytest.mark.parametrize("edge", [{}, {"edge": "path", "aperture_mu": 2.0}])
def test_adjoint_is_exact_and_backends_agree(backend, edge, rng):
    model = mph.Emission(SYSTEM, hole="depth", within_crystal=True, intrinsic_fwhm=2.0, **DEEP, **edge)
    assert_exact(model, backend, rng)


def test_it_agrees_with_rays(rng):
    grid = mph.Grid.centered((12, 12, 12), 6.0)
    x = rng.random(grid.shape) ** 8
    given = {"edge": "path", "aperture_mu": TUNGSTEN, "within_crystal": True, **DEEP}
    A = mph.Projector(grid, SYSTEM[1:].views((24, 24)), mph.Emission(SYSTEM[1:], **given))
    rays = mph.Emission(SYSTEM[1:], hole="rays", aperture_points=37, pixel_points=8, tolerance=1e9, **given)
    assert misplaced(A(x), mph.Projector(grid, A.views, rays)(x)) < 0.012


def test_attenuation_and_its_derivatives_come_with_it(rng):
    """Central differences by mu, and by activity."""
    torch = pytest.importorskip("torch")
    grid = mph.Grid.centered((6, 6, 6), 8.0)
    mu = mph.Volume(np.full(grid.shape, 0.01), grid, "mu")
    model = mph.Emission(SYSTEM, mu, hole="depth", edge="path", aperture_mu=TUNGSTEN, **DEEP)
    A = mph.Projector(grid, SYSTEM.views((9, 8)), model, double=True)
    weights, along = torch.tensor(rng.random(A.shape_out)), torch.tensor(rng.random(grid.shape))
    x, given = (torch.tensor(rng.uniform(0, most, grid.shape), requires_grad=True) for most in (1, 0.01))
    (A(x, mu=given) * weights).sum().backward()
    free, at, step = x.detach(), given.detach(), 1e-6
    more, less = ((A(free, mu=at + sign * step * along) * weights).sum() for sign in (1, -1))
    np.testing.assert_allclose((given.grad * along).sum(), (more - less) / (2 * step), rtol=1e-6)
    np.testing.assert_allclose((x.grad * along).sum(), (A(along, mu=at) * weights).sum(), rtol=1e-9)
