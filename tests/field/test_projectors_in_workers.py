"""Projectors, models and DRR modules in other processes and of any number type.

https://github.com/pytorch/pytorch/issues/22585 (spawned workers), https://github.com/xingyizhou/CenterNet/issues/649
(local objects on Windows), https://github.com/eigenvivek/DiffDRR/issues/393 (masks).
"""

from __future__ import annotations

import pickle

import numpy as np
import pytest

import mphdrr.core as mph

MODELS = {
    "default": {}, "rays": {"hole": "rays"}, "depth": {"hole": "depth"},
    "layers": {"hole": "depth", "depth_layers": 3, "crystal_mu": 0.2},
    "edge": {"edge": "path", "aperture_mu": 3.0}, "attenuated": {"attenuated": True},
    "septa": {"within_walls": True},
}  # fmt: skip


@pytest.mark.parametrize("name", MODELS)
def test_a_projector_is_the_same_in_another_process(system, rng, name):
    options = dict(MODELS[name])
    grid = mph.Grid.centered(8, 6.0)
    if options.pop("attenuated", False):
        options["mu"] = mph.Volume(np.full((8, 8, 8), 0.015), grid, "mu")
    few = system[:3]
    A = mph.Projector(grid, few.views((6, 6), "real"), mph.Emission(few, time=600.0, **options))
    again = pickle.loads(pickle.dumps(A))
    x = rng.uniform(size=(8, 8, 8)).astype(np.float32)
    np.testing.assert_array_equal(again(x), A(x))
    np.testing.assert_array_equal(again.T(A(x)), A.T(A(x)))
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(A))(x), A(x), "also after its use")


@pytest.mark.parametrize("kind", ["uint8", "int8", "int16", "int64", "bool"])
def test_whole_numbers_give_images_of_floats(kind):
    torch = pytest.importorskip("torch")
    from mphdrr.core.diffdrr import DRR

    affine = np.diag([2.0, 2.0, 2.0, 1.0])
    affine[:3, 3] = -29.0
    density = torch.full((30, 30, 30), 3 if kind != "bool" else 1).to(getattr(torch, kind))
    angles, shift = torch.tensor([[0.3, 0.1, 0.0]]), torch.tensor([[0.0, 400.0, 0.0]])
    arguments = {"parameterization": "euler_angles", "convention": "ZXY"}
    images = [
        DRR(x, affine, sdd=800.0, height=5, delx=2.0)(angles, shift, **arguments) for x in (density, density.float())
    ]
    assert images[0].dtype == torch.float32 and torch.equal(*images) and images[0].max() > 59
    none = DRR(density, affine, sdd=800.0, height=5, delx=2.0)(torch.zeros(0, 3), torch.zeros(0, 3), **arguments)
    assert none.shape == (0, 1, 5, 5) and none.dtype == torch.float32
