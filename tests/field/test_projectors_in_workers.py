"""Projectors, models and DRR modules in other processes, under torch.compile and torch.func, and of any number type.

https://github.com/pytorch/pytorch/issues/22585 (spawned workers), https://github.com/xingyizhou/CenterNet/issues/649
(local objects on Windows), https://github.com/eigenvivek/DiffDRR/issues/393 (masks).
"""

from __future__ import annotations

import multiprocessing
import pickle

import numpy as np
import pytest

import mphdrr.core as mph

from ..core.conftest import refused

GRID = mph.Grid.centered(8, 6.0)
MU = mph.Volume(np.full((8, 8, 8), 0.015), GRID, "mu")
MODELS = {
    "default": {}, "rays": {"hole": "rays"}, "depth": {"hole": "depth"},
    "layers": {"hole": "depth", "depth_layers": 3, "crystal_mu": 0.2},
    "edge": {"edge": "path", "aperture_mu": 3.0}, "attenuated": {"mu": MU},
    "septa": {"within_walls": True}, "blur": {"within_cone": True, "intrinsic_fwhm": 2.0},
    "walls": {"edge": "path", "wall_thickness": 3.0, "plate_thickness": 3.0, "aperture_mu": 3.0},
    "lines apart": {"isotope": "In-111", "lines": "apart", "energy_fwhm": 0.1, "window": (150.0, 270.0)},
}  # fmt: skip
XRAY = mph.XraySystem([[0, 500, 0]], [[0, -500, 0]], [[-9, 0, 0]], [[0, 0, -9]], (6, 6), 80, 1)
OTHERS = {
    "lines": lambda A, system: mph.Projector(GRID, A.views),
    "inverse square": lambda A, system: mph.Projector(GRID, A.views, mph.InverseSquareSum(system)),
    "X rays": lambda A, system: mph.Projector(GRID, XRAY.views(), mph.SpectralScan(XRAY)),
    "double": lambda A, system: mph.Projector(GRID, A.views, A.model, double=True),
    "adjoint": lambda A, system: A.T, "subset": lambda A, system: A.subsets(2)[1],
    "frames": lambda A, system: mph.FrameProjector(A, [1.0, 2.0]),
}  # fmt: skip


@pytest.fixture
def make(system):
    """Return the function that makes a projector by its name in `MODELS` or `OTHERS`."""
    few = system[:3]

    def make(name):
        options = MODELS.get(name, {})
        A = mph.Projector(GRID, few.views((6, 6), "real"), mph.Emission(few, **{"time": 600.0, **options}))
        return OTHERS[name](A, few) if name in OTHERS else A

    return make


@pytest.mark.parametrize("name", [*MODELS, *OTHERS])
def test_a_projector_is_the_same_in_another_process(make, rng, name):
    A = make(name)
    again = pickle.loads(pickle.dumps(A))
    x = rng.uniform(size=A.shape_in).astype(np.float32)
    np.testing.assert_array_equal(again(x), A(x))
    np.testing.assert_array_equal(again.T(A(x)), A.T(A(x)))
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(A))(x), A(x), "also after its use")


def test_spawned_workers_of_a_loader_hold_projectors(make):
    torch = pytest.importorskip("torch")
    from mphdrr.core.diffdrr import DRR

    pose = torch.eye(4, dtype=torch.float64)
    pose[2, 3] = -100.0
    A = make("default")
    drr = DRR(torch.ones(8, 8, 8), GRID.affine, sdd=800.0, height=5, delx=2.0)
    spawn = multiprocessing.get_context("spawn")
    for module, inputs in ((A, [torch.full(A.shape_in, 2.0), torch.ones(A.shape_in)]), (drr, [pose, pose / 2])):
        options = {"collate_fn": module, "num_workers": 1, "multiprocessing_context": spawn}
        images = torch.utils.data.DataLoader(inputs, batch_size=None, **options)
        for image, x in zip(images, inputs, strict=True):
            assert torch.equal(image, module(x))


def images_and_gradients(module, *inputs):
    """Return a module's result, and the gradients of its weighted sum by the inputs."""
    import torch

    inputs = [x.clone().requires_grad_() for x in inputs]
    result = module(*inputs)
    weights = torch.linspace(0, 1, result.numel(), dtype=result.dtype).reshape(result.shape)
    return result.detach(), *torch.autograd.grad((result * weights).sum(), inputs)


@pytest.mark.parametrize("kind", ["float32", "float64"])
@pytest.mark.parametrize("name", ["default", "attenuated", "rays", "lines", "adjoint", "double", "frames"])
def test_compiled_modules_give_the_same_numbers(make, name, kind):
    torch = pytest.importorskip("torch")
    A = make(name)

    class Module(torch.nn.Module):
        def forward(self, x):
            return 2 * A(3 * x)

    x = torch.rand(A.shape_in, dtype=getattr(torch, kind))
    torch.compiler.reset()
    compiled = torch.compile(Module(), backend="aot_eager")
    for expected, found in zip(images_and_gradients(Module(), x), images_and_gradients(compiled, x), strict=True):
        assert torch.equal(expected, found)
    if name == "attenuated":
        mu = torch.full(GRID.shape, 0.01, dtype=x.dtype)
        both = [lambda x, mu: A(x, mu=mu)]
        both.append(torch.compile(both[0], backend="aot_eager"))
        results = [images_and_gradients(f, x, mu) for f in both]
        assert all(torch.equal(*pair) for pair in zip(*results, strict=True))


@pytest.mark.parametrize("kind", ["float32", "float64"])
def test_compiled_drrs_give_the_same_numbers(kind):
    torch = pytest.importorskip("torch")
    from mphdrr.core.diffdrr import DRR

    dtype = getattr(torch, kind)
    drr = DRR(torch.rand(8, 8, 8, dtype=dtype), GRID.affine, sdd=800.0, height=5, delx=2.0)
    pose = torch.tensor([[0.3, 0.1, 0.0]], dtype=dtype), torch.tensor([[0.0, 400.0, 0.0]], dtype=dtype)
    torch.compiler.reset()
    results = [
        images_and_gradients(lambda r, t, f=f: f(r, t, parameterization="euler_angles", convention="ZXY"), *pose)
        for f in (drr, torch.compile(drr, backend="aot_eager"))
    ]
    assert all(torch.equal(*pair) for pair in zip(*results, strict=True))


@pytest.mark.parametrize("name", ["default", "lines", "adjoint", "double", "frames"])
def test_transforms_of_a_projector_are_those_of_a_linear_map(make, name):
    """A batch for vmap, for jvp the map itself, vjp the adjoint, also one within another."""
    torch = pytest.importorskip("torch")
    from torch import func

    A = make(name)
    x, tangent, y = torch.rand(3, *A.shape_in), torch.rand(*A.shape_in), torch.rand(*A.shape_out)
    batch = A(x)
    assert torch.equal(func.vmap(lambda x: A(x))(x), batch)
    assert torch.equal(func.vmap(lambda x: A(x), in_dims=-1, out_dims=1)(x.movedim(0, -1)), batch.movedim(0, 1))
    assert torch.equal(func.vmap(func.vmap(lambda x: A(x)))(x[None]), batch[None])
    for found, expected in zip(func.jvp(lambda x: A(x), (x[0],), (tangent,)), (batch[0], A(tangent)), strict=True):
        assert torch.equal(found, expected)
    assert torch.equal(func.vjp(lambda x: A(x), x[0])[1](y)[0], A.T(y).to(x))
    squares = func.vmap(func.grad(lambda x: (A(x) ** 2).sum()))(x)
    torch.testing.assert_close(squares, 2 * A.T(batch).to(x), rtol=1e-4, atol=1e-4 * float(squares.abs().max()))
    refused(lambda: func.vmap(lambda x: A(x))(x[..., 1:]), "expected shape")


def test_other_transforms_are_refused_in_one_line(make):
    torch = pytest.importorskip("torch")
    from torch import func

    from mphdrr.core.diffdrr import DRR
    from mphdrr.core.projector.torch_cameras import emission_images, pinhole_images

    drr = DRR(torch.rand(8, 8, 8), GRID.affine, sdd=800.0, height=5, delx=2.0)
    A, ones, point, turn = make("attenuated"), torch.ones(8, 8, 8), torch.tensor([0.0, 0.0, -200.0]), torch.eye(3)
    functions = (
        (lambda x: A(ones, mu=x).sum(), 0.01 * ones), (lambda x: drr(x).sum(), torch.eye(4)[None]),
        (lambda x: drr.render(x, *drr.detector(torch.eye(4)[None])).sum(), ones),
        (lambda x: mph.trace_rays(ones, x, [[0.0, 0.1, 90.0]], grid=GRID).sum(), point),
        (lambda x: pinhole_images(ones, x, turn, 60.0, 1.5, (5, 5), grid=GRID).sum(), point),
        (lambda x: emission_images(ones, x, turn, 60.0, 1.5, (5, 5), diameter=2.0, grid=GRID).sum(), point),
        (lambda x: emission_images(x, point, turn, 60.0, 1.5, (5, 5), diameter=2.0, grid=GRID, hole="depth").sum(), ones),
    )  # fmt: skip
    for function, x in functions:
        for call in (
            lambda f=function, x=x: func.vmap(f)(x[None]), lambda f=function, x=x: func.grad(f)(x),
            lambda f=function, x=x: func.jvp(f, (x,), (x,)),
        ):  # fmt: skip
            refused(call, "torch.func")


@pytest.mark.parametrize("kind", ["uint8", "int8", "int16", "int64", "bool"])
def test_whole_numbers_give_images_of_floats(kind):
    torch = pytest.importorskip("torch")
    from mphdrr.core.diffdrr import DRR

    affine = np.diag([2.0, 2.0, 2.0, 1.0])
    affine[:3, 3] = -29.0
    density = torch.full((30, 30, 30), 3 if kind != "bool" else 1).to(getattr(torch, kind))
    angles, shift = torch.tensor([[0.3, 0.1, 0.0]]), torch.tensor([[0.0, 400.0, 0.0]])
    arguments = {"parameterization": "euler_angles", "convention": "ZXY"}
    drrs = [DRR(x, affine, sdd=800.0, height=5, delx=2.0) for x in (density, density.float())]
    images = [drr(angles, shift, **arguments) for drr in drrs]
    assert images[0].dtype == torch.float32 and torch.equal(*images) and images[0].max() > 59
    assert drrs[0].render(density, *drrs[0].detector(torch.eye(4)[None])).dtype == torch.float32
    for subsample in (None, 0.4):
        drr = DRR(density, affine, sdd=800.0, height=5, delx=2.0, p_subsample=subsample)
        none = drr(torch.zeros(0, 3), torch.zeros(0, 3), **arguments)
        assert none.shape == (0, 1, 5, 5) and none.dtype == torch.float32
