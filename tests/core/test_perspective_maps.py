"""Maps for networks: interpolation at the places that perspective grids say, and OSEM's volumes on its way."""

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.reconstruction.snapshots import Snapshots

from .conftest import dc_spect

torch = pytest.importorskip("torch", reason="torch is not installed")

from mphdrr.core.perspective.perspective_maps import PerspectiveMaps  # noqa: E402

GRID = mph.Grid.centered((9, 8, 10), (9.0, 10.0, 8.0))
SLOPE, LEVEL = np.array([0.3, -0.2, 0.5]), 40.0  # of a volume that is linear in world points


def views(kind: str) -> mph.Views:
    if kind == "parallel":
        return mph.parallel_views(np.array([0.3, 1.2]), (12, 14), 9.0)
    return dc_spect()[[3, 40, 71]].views((12, 14), "real")


@pytest.mark.parametrize("kind", ["pinholes", "parallel"])
def test_what_is_linear_in_space_is_kept_exactly_both_ways(kind):
    maps, which = PerspectiveMaps(views(kind), GRID, n_k=7), torch.tensor([1, 0])
    world = np.moveaxis(np.indices(GRID.shape), 0, -1) @ GRID.affine[:3, :3].T + GRID.affine[:3, 3]
    images = maps.to_views(torch.tensor(world @ SLOPE + LEVEL)[None, None], which)
    for v, m in enumerate(which.tolist()):
        centers = maps.grids[m].centers()
        index = (centers - GRID.affine[:3, 3]) @ np.linalg.inv(GRID.affine[:3, :3]).T
        inside = ((index >= 0) & (index <= np.array(GRID.shape) - 1)).all(-1)
        assert inside.any()
        np.testing.assert_allclose(images[0, v, 0].numpy()[inside], (centers @ SLOPE + LEVEL)[inside], atol=1e-4)
    # And back: a number that is linear in the cells' own indices.
    cells = np.indices(maps.grids[0].shape).astype(float).sum(0)
    back, sees = maps.to_volume(torch.tensor(cells)[None, None, None].expand(1, 2, 1, *cells.shape), which)
    for v, m in enumerate(which.tolist()):
        index = maps.grids[m].index_from_world(world)
        inside = ((index >= 0) & (index <= np.array(maps.grids[m].shape) - 1)).all(-1)
        assert np.allclose(back[0, v, 0].numpy()[inside], index.sum(-1)[inside], atol=1e-4)
        assert sees[0, v, 0].numpy()[inside].all()


def test_gradients_pass_the_maps():
    maps, which = PerspectiveMaps(views("pinholes"), mph.Grid.centered((4, 4, 4), 20.0), n_k=3), torch.tensor([0, 2])
    x = torch.rand(1, 2, 4, 4, 4, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: maps.to_volume(maps.to_views(x, which), which)[0], x)


@pytest.mark.parametrize("subsets", [1, 3])
def test_snapshots_are_the_volumes_of_osem(subsets):
    system = dc_spect()[::10]
    grid = mph.Grid.centered((10, 10, 10), 9.0)
    A = mph.Projector(grid, system.views((12, 12), "real"), mph.Emission(system, hole="point", time=600.0))
    truth = mph.DerenzoPhantom(35, (20, 18, 16, 14, 12, 10), 40, activity=80.0).voxelize(grid).array
    counts = np.random.default_rng(1).poisson(np.asarray(A(truth)) + 2.0).astype(np.float32)
    even = np.full(grid.shape, counts.sum(dtype=float) / A.T(np.ones_like(counts)).sum(dtype=float), np.float32)
    for volume, iterations in zip(Snapshots(A, subsets)(counts, (2, 5), 2.0), (2, 5), strict=True):
        expected = mph.osem(A, counts, iterations, subsets, background=2.0, start=even).volume.array
        assert np.abs(volume - expected).max() <= 1e-5 * expected.max()
