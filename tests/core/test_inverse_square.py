"""The sum of segments times 1/h^2, and the photons of a radiograph."""

from __future__ import annotations

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.errors import InputError

from .conftest import BACKENDS
from .test_emission import one_module, turned_grid


@pytest.mark.parametrize("backend", BACKENDS)
def test_one_voxel_is_its_chord_times_the_sensitivity_at_its_middle(backend):
    """d^2 sin^3(theta) / (16 h^2), theta the ray's elevation, h the height of the voxel's centre; nothing behind."""
    system = one_module()
    views = system.views((5, 6))
    sources, targets = views.rays(0)
    grid = turned_grid((3, 4, 5), 30.0)
    x = np.zeros(grid.shape)
    expected = np.zeros(30)
    for index in ((0, 1, 2), (2, 3, 4), (1, 1, 1)):
        one = np.zeros(grid.shape)
        one[index] = 1
        x += one
        center = grid.affine[:3, :3] @ index + grid.affine[:3, 3]
        towards = targets - sources
        h, sine = 200 - center[0], -towards[:, 0] / np.linalg.norm(towards, axis=1)
        chord = mph.trace_rays(mph.Volume(one, grid), sources, targets, "numpy")
        expected += chord * 2**2 * sine**3 / (16 * h**2)
    images = mph.Projector(grid, views, mph.InverseSquareSum(system), backend)(x)
    assert expected.any()
    np.testing.assert_allclose(images.reshape(-1), expected, rtol=2e-5, atol=2e-5 * expected.max())
    behind = mph.Grid.centered((2, 2, 2), 10.0, (250, 0, 0))
    assert not mph.Projector(behind, views, mph.InverseSquareSum(system), backend)(np.ones((2, 2, 2))).any()


@pytest.mark.parametrize("photons", [1.0, 1e5])
def test_radiographs_count_photons(photons, rng):
    lines = rng.uniform(0, 9, (2, 3, 4))
    np.testing.assert_allclose(mph.intensity(lines, photons), photons * np.exp(-lines))
    with pytest.raises(InputError, match="photons"):
        mph.intensity(lines, 0)
    for bad in (["air"], [[1], [1, 2]]):
        with pytest.raises(InputError, match="line integrals"):
            mph.intensity(bad, photons)
    torch = pytest.importorskip("torch", reason="torch is not installed")
    x = torch.tensor(lines, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: mph.intensity(x, photons), (x,))


def test_a_radiograph_of_water_has_poisson_photons():
    """A slab of water as a run: I0 exp(-mu L), and drawn with a seed."""
    slab = mph.Volume(np.full((1, 1, 1), 0.0154), mph.Grid.centered((1, 1, 1), (100, 600, 600)), "mu")
    system = one_module()
    mean = mph.project_run(system, slab, (40, 40), photons=1e4)
    u = (np.arange(40) - 19.5) * 50 / 40
    cosine = 60 / np.sqrt(60**2 + u**2 + u[:, None] ** 2)
    np.testing.assert_allclose(mean.projections[0], 1e4 * np.exp(-0.0154 * 100 / cosine), rtol=1e-4)
    assert (mean.unit, mean.settings["photons"], mean.seed) == ("photons", 1e4, None)
    drawn = mph.project_run(system, slab, (40, 40), photons=1e4, noise_seed=3)
    pull = (drawn.projections - mean.projections) / np.sqrt(mean.projections)
    assert abs(pull.mean()) < 4 / 40 and pull.std() == pytest.approx(1, abs=0.08) and drawn.seed == 3
    activity = mph.Volume(np.ones((1, 1, 1)), slab.grid)
    with pytest.raises(InputError, match="mu"):
        mph.project_run(system, activity, (4, 4), photons=1e4)
    with pytest.raises(InputError, match="photons"):
        mph.project_run(system, slab, (4, 4), photons=-1)
