"""Images from poses: the rays of `Views`, and pose gradients against central differences."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed")

from mphdrr.core.projector import Projector  # noqa: E402
from mphdrr.core.projector.torch_cameras import pinhole_images, pinhole_rays  # noqa: E402
from mphdrr.core.volumes.volume import Volume  # noqa: E402

from .conftest import BACKENDS, general_grid, refused  # noqa: E402


def cameras(system):
    poses = torch.tensor(system.poses())
    distance = torch.tensor(10 * system.collimator_length)
    return poses[:, :3, 3], poses[:, :3, :3], distance


def test_rays_are_those_of_the_views(system, rng):
    views = system.views((5, 7), pitch=(20.0, 31.0), offset=(3.0, -5.0))
    sources, targets = pinhole_rays(*cameras(system), [20.0, 31.0], (5, 7), [3.0, -5.0])
    for m in range(len(system)):
        for got, expected in zip((sources[m], targets[m]), views.rays(m), strict=True):
            np.testing.assert_allclose(got, expected, rtol=0, atol=1e-9)
    grid = general_grid(rng, (9, 8, 7))
    volume = Volume(rng.random(grid.shape), grid)
    images = pinhole_images(volume, *cameras(system), [20.0, 31.0], (5, 7), [3.0, -5.0])
    np.testing.assert_allclose(images, Projector(grid, views)(volume), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("backend", BACKENDS)
def test_gradient_by_every_number_of_a_camera(backend, system, rng):
    """Position, rotation, distance (magnification), pitch and principal point against central differences."""
    grid = general_grid(rng, (8, 7, 6))
    smooth = np.add.outer(np.add.outer(np.hanning(8), np.hanning(7)), np.hanning(6))
    volume = Volume(smooth, grid)
    position, rotation, distance = (x[3] for x in cameras(system))
    weights = torch.tensor(rng.random((20, 20)))

    def loss(p):
        turned = torch.linalg.matrix_exp(torch.stack([
            torch.stack([0 * p[3], -p[5], p[4]]), torch.stack([p[5], 0 * p[3], -p[3]]), torch.stack([-p[4], p[3], 0 * p[3]])
        ]))  # fmt: skip
        image = pinhole_images(
            volume, position + p[:3], turned @ rotation, distance * torch.exp(p[6]), 5.4 * torch.exp(p[7]), (20, 20), p[8:],
            backend=backend,
        )  # fmt: skip
        return (image * weights).mean()

    parameters = torch.zeros(10, dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(loss(parameters), parameters)
    steps = torch.diag(torch.tensor([1e-5] * 3 + [1e-7] * 5 + [1e-5] * 2, dtype=torch.float64))
    with torch.no_grad():
        difference = torch.stack([(loss(s) - loss(-s)) / (2 * s.sum()) for s in steps])
    np.testing.assert_allclose(gradient, difference, rtol=1e-3, atol=1e-4 * float(gradient[:3].abs().max()))


def test_types_and_shapes():
    rotation = torch.eye(3)
    sources, targets = pinhole_rays(torch.zeros(3), rotation, 10, 1, (2, 3))
    assert sources.shape == targets.shape == (6, 3) and targets.dtype == torch.float32
    np.testing.assert_allclose(targets[0], [-1.0, -0.5, 10.0])
    assert pinhole_rays(torch.zeros(3), rotation.double(), 10, 1, (2, 3))[1].dtype == torch.float64
    batch = pinhole_rays(torch.zeros(4, 1, 3), rotation.expand(5, 3, 3), torch.full((5,), 9.0), 1.0, (2, 2))
    assert batch[1].shape == (4, 5, 4, 3)
    for call, word in (
        (lambda: pinhole_rays([0, 0, 0], rotation, 10, 1, (2, 2)), "positions"),
        (lambda: pinhole_rays(torch.zeros(3), rotation[:2], 10, 1, (2, 2)), "rotations"),
        (lambda: pinhole_rays(torch.zeros(2, 3), rotation, torch.ones(3), 1, (2, 2)), "rays"),
    ):
        refused(call, word)
