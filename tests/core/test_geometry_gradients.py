"""Gradients of line integrals by the ends of the rays and the volume, against differences and closed forms; tensors."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed")

from mphdrr.core.errors import InputError  # noqa: E402
from mphdrr.core.geometry.grid import Grid  # noqa: E402
from mphdrr.core.geometry.views import Views  # noqa: E402
from mphdrr.core.projector import Projector, trace_rays  # noqa: E402
from mphdrr.core.rays import execution  # noqa: E402
from mphdrr.core.rays.tracing import trace_fans  # noqa: E402
from mphdrr.core.volumes.volume import Volume  # noqa: E402

from .conftest import BACKENDS, general_grid, refused, same_matter  # noqa: E402

GRID = Grid.centered((5, 4, 3), 1.0)
VIEWS = Views(
    [[0.1, 0.3, -20], [2, -20, 1]], [[0, 0, 20], [0, 20, 0]], [[1, 0, 0], [1, 0, 0]], [[0, 1, 0], [0, 0, 1]], (4, 5)
)
MU = [None, "shared", "own"]
SHAPES = [(12, 9, 10), (7, 5, 6), (1, 6, 4), (5, 1, 3), (4, 5, 1), (1, 1, 1)]


def oblique_rays(rng, grid, n=60):
    """Return rays through the grid: from outside, from inside, ending inside, both."""
    size = np.ptp(grid.corners(), axis=0).max()
    sources = grid.center + rng.normal(size=(n, 3)) * size * 1.5
    targets = 2 * grid.center - sources + rng.normal(size=(n, 3)) * size * 0.3
    sources[: n // 3] = grid.center + rng.uniform(-0.2, 0.2, (n // 3, 3)) * size
    targets[n // 4 : n // 2] = grid.center + rng.uniform(-0.2, 0.2, (n // 2 - n // 4, 3)) * size
    return sources, targets


def some_mu(rng, grid, which):
    """Return mu by name: none; on the volume's grid; on another one that cuts across it."""
    if which is None:
        return None
    if which == "own":
        grid = Grid((4, 3, 5), general_grid(rng, (4, 3, 5)).affine @ np.diag([1.5, 2, 1.2, 1]))
    return Volume(rng.uniform(0, 0.2, grid.shape), grid, "mu")


def gradients(volume, sources, targets, backend, weights, mu=None):
    s, t = (torch.tensor(x, requires_grad=True) for x in (sources, targets))
    y = trace_rays(volume, s, t, backend, mu=mu)
    assert y.dtype == torch.float64
    (y * torch.as_tensor(weights)).sum().backward()
    return s.grad.numpy(), t.grad.numpy()


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("which", MU)
@pytest.mark.parametrize("shape", SHAPES)
def test_gradient_is_the_central_difference_and_that_of_the_reference(backend, which, shape, rng):
    grid = general_grid(rng, shape)
    volume, mu = Volume(rng.random(shape), grid), some_mu(rng, grid, which)
    sources, targets = oblique_rays(rng, grid)
    n, h = len(sources), 1e-6
    got = gradients(volume, sources, targets, backend, np.ones(n), mu)
    reference, scale = gradients(volume, sources, targets, "numpy", np.ones(n), mu), np.abs(got).max()
    np.testing.assert_allclose(got, reference, rtol=1e-8, atol=1e-8 * scale)
    for end in range(2):
        for axis in range(3):
            step = np.zeros(3)
            step[axis] = h
            ahead, behind = (
                trace_rays(volume, torch.tensor(sources + sign * step * (end == 0)),
                           torch.tensor(targets + sign * step * (end == 1)), backend, mu=mu).numpy()
                for sign in (1, -1)
            )  # fmt: skip
            difference = (ahead - behind) / (2 * h)
            # A ray within h of a voxel's edge has a kink there: these are few.
            close = np.abs(difference - got[end][:, axis]) < 1e-5 * scale
            assert close.mean() >= 0.97, (end, axis, np.abs(difference - got[end][:, axis]).max())


@pytest.mark.parametrize("backend", BACKENDS)
def test_chord_of_a_slab(backend):
    """Between its faces at x = +-8 it is 16 / cos of the angle to x; attenuated (1 - exp(-m chord)) / m.

    From outside and from inside; also with mu in front, on its own planes.
    """
    grid = Grid.centered((8, 40, 40), 2.0)
    front = Volume(np.full((2, 10, 10), 0.1), Grid.centered((2, 10, 10), 8.0, (-28.0, 0, 0)), "mu")  # x from -36 to -20
    activity, mu = Volume(np.ones(grid.shape), grid), Volume(np.full(grid.shape, 0.07), grid, "mu")
    m = float(mu.array[0, 0, 0])
    target = torch.tensor([60.0, 7.1, -3.9], dtype=torch.float64, requires_grad=True)
    for start, matter in ((-50.0, None), (-50.0, mu), (-3.0, mu), (-50.0, front), (-25.0, front)):
        source = torch.tensor([start, 1.3, 0.7], dtype=torch.float64, requires_grad=True)
        y = trace_rays(activity, source, target, backend, mu=matter)
        secant = (target - source).norm() / (target - source)[0]
        if matter is mu:
            expected = (1 - torch.exp(-m * (8 - source[0].clamp(min=-8)) * secant)) / m
        else:
            thickness = (
                (-20 - source[0].clamp(min=-36)) * secant * (0.0 if matter is None else float(front.array[0, 0, 0]))
            )
            expected = 16 * secant * torch.exp(-thickness)
        torch.testing.assert_close(y[0], expected)
        for gradient, right in zip(
            torch.autograd.grad(y.sum(), (source, target)), torch.autograd.grad(expected, (source, target)), strict=True
        ):
            torch.testing.assert_close(gradient, right, atol=1e-11, rtol=1e-8)


@pytest.mark.parametrize("backend", BACKENDS)
def test_integrals_and_gradients_depend_on_matter_and_not_on_its_grid(backend, rng):
    """The same mu on the volume's grid, on a twice finer and on a larger one: planes of both are crossed at once."""
    grid = general_grid(rng, (6, 5, 4))
    volume, values = Volume(rng.random(grid.shape), grid), rng.uniform(0, 0.2, grid.shape)
    ends = oblique_rays(rng, grid)
    reference, *results = (
        (trace_rays(volume, *ends, backend, mu=mu), *gradients(volume, *ends, backend, np.ones(len(ends[0])), mu))
        for mu in same_matter(grid, values)
    )
    for result in results:
        for k, (numbers, expected) in enumerate(zip(result, reference, strict=True)):
            share = 1e-8 if k or backend == "numpy" else 1e-6
            np.testing.assert_allclose(numbers, expected, rtol=0, atol=share * np.abs(expected).max())


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("which", [None, "shared"])
def test_odd_rays_have_gradients_too(backend, which):
    """Of length zero, missing, along an axis, in a plane of voxel faces, within one voxel, through corners: never NaN."""
    grid = Grid.centered((4, 4, 4), 1.0)
    sources, targets = np.array([
        [[0.2, 0.3, 0.1], [0.2, 0.3, 0.1]], [[9, 9, 9], [9, 9, 9]], [[30, 30, -30], [30, 30, 30]],
        [[0.3, 0.2, -9], [0.3, 0.2, 9]], [[0, 0, -9], [0, 0, 9]], [[-2, 0, 0], [2, 0, 0]],
        [[-5, -5, -5], [5, 5, 5]], [[0, 0, 0], [0.2, 0.3, 0.1]],
    ]).swapaxes(0, 1)  # fmt: skip
    volume = Volume(np.arange(64.0).reshape(4, 4, 4), grid)
    mu = which and Volume(np.full((4, 4, 4), 1e-12), grid, "mu")
    by_source, by_target = gradients(volume, sources, targets, backend, np.ones(8), mu)
    assert np.isfinite(by_source).all() and np.isfinite(by_target).all()
    assert not by_source[:3].any() and not by_target[:3].any()
    # Inside one voxel of value f the integral is f times the length.
    value = volume.array[2, 2, 2]
    direction = targets[7] / np.linalg.norm(targets[7])
    np.testing.assert_allclose(by_target[7], value * direction, rtol=1e-9)
    np.testing.assert_allclose(by_source[7], -value * direction, rtol=1e-9)


@pytest.mark.parametrize("backend", ["numpy", "torch"])
@pytest.mark.parametrize("which", MU)
def test_gradcheck_by_everything(backend, which, rng):
    grid = general_grid(rng, (3, 2, 2))
    sources, targets = (torch.tensor(x, requires_grad=True) for x in oblique_rays(rng, grid, 3))
    volume = torch.tensor(rng.random(grid.shape), requires_grad=True)
    matter = some_mu(rng, grid, which)
    mu = () if matter is None else (torch.tensor(matter.array + 0.01, dtype=torch.float64, requires_grad=True),)

    def function(volume, sources, targets, mu=None):
        return trace_rays(volume, sources, targets, backend, grid, mu, matter and matter.grid) ** 2

    assert torch.autograd.gradcheck(function, (volume, sources, targets, *mu), atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("which", MU)
def test_fans_are_their_rays(backend, which, rng, monkeypatch):
    """Integrals and all gradients: rows along either axis, in blocks, from outside and from inside; also for arrays."""
    monkeypatch.setattr(execution, "_FEWEST_RAYS", 16)
    grid = general_grid(rng, (9, 8, 7))
    mu_grid = (some_mu(rng, grid, which) or Volume(np.ones(grid.shape), grid)).grid
    shape = (9, 5)
    sources = grid.center + np.array([[30.0, 4, -2], [1, 2, -50], [0.3, 0.2, 0.1]])
    middles, step = 2 * grid.center - sources + rng.normal(size=(3, 3)), rng.normal(size=(3, 2, 3))
    vectors = np.stack([sources, middles - 4 * step[:, 0] - 2 * step[:, 1], step[:, 0], step[:, 1]], axis=1)
    vectors = np.concatenate([vectors, vectors[:, [0, 1, 3, 2]]]).reshape(2, 3, 4, 3)
    weights = torch.tensor(rng.normal(size=(2, 3, *shape)))
    fields = torch.tensor(rng.random(grid.shape)), torch.tensor(rng.uniform(0, 0.2, mu_grid.shape))

    def traced(function):
        x, mu, v = (a.clone().requires_grad_() for a in (*fields, torch.tensor(vectors)))
        y = function(x, v, (mu, mu_grid) if which else ())
        assert y.shape == weights.shape and y.dtype == torch.float64
        return y, *torch.autograd.grad((y * weights).sum(), [x, v] + [mu] * bool(which))

    def by_ends(x, v, mu):
        line, ray = (torch.arange(n, dtype=v.dtype)[:, None] for n in shape)
        source, corner, line_step, ray_step = v[..., None, None, :, :].unbind(dim=-2)
        targets = corner + line[:, None] * line_step + ray * ray_step
        ends = (source.expand_as(targets).reshape(-1, 3), targets.reshape(-1, 3))
        return trace_rays(x, *ends, backend, grid, *mu).reshape(weights.shape)

    expected = traced(by_ends)
    got = traced(lambda x, v, mu: trace_fans(x, v, shape, backend, grid, *mu))
    assert all(gradient.abs().max() > 0 for gradient in expected)
    for one, other in zip(got, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=1e-9 * float(other.detach().abs().max()))
    mu = (fields[1].numpy(), mu_grid) if which else ()
    array = trace_fans(fields[0].numpy(), vectors, shape, backend, grid, *mu)
    assert array.dtype == (np.float64 if backend == "numpy" else np.float32)
    np.testing.assert_allclose(array, expected[0].detach(), rtol=0, atol=1e-5 * float(array.max()))


@pytest.mark.parametrize("backend", BACKENDS)
def test_gradient_by_volume_is_the_adjoint(backend, rng):
    values = torch.tensor(rng.random(20), dtype=torch.float32)
    volume = torch.rand(GRID.shape, requires_grad=True)
    y = trace_rays(volume, *VIEWS.rays(0), backend, GRID)
    assert y.dtype == (torch.float64 if backend == "numpy" else torch.float32)
    (y * values).sum().backward()
    expected = Projector(GRID, VIEWS[:1], backend=backend).T(values.numpy().reshape(1, 4, 5))
    np.testing.assert_allclose(volume.grad.numpy(), expected, rtol=1e-5, atol=1e-6)


def test_kinds_of_arguments(rng):
    grid = Grid.centered((4, 4, 4), 1.0)
    array = rng.random(grid.shape).astype(np.float32)
    sources, targets = rng.normal(size=(2, 6, 3)) * 5
    expected = trace_rays(Volume(array, grid), sources, targets)
    assert isinstance(expected, np.ndarray)
    np.testing.assert_array_equal(trace_rays(array, sources, targets, grid=grid), expected)
    for s, t in (
        (torch.tensor(sources), targets),
        (sources.tolist(), torch.tensor(targets, dtype=torch.float32)),
        (torch.tensor(sources, dtype=torch.float32, requires_grad=True), torch.tensor(targets)),
    ):
        y = trace_rays(Volume(array, grid), s, t)
        kinds = [x.dtype for x in (s, t) if isinstance(x, torch.Tensor)]
        assert y.dtype == (torch.float64 if torch.float64 in kinds else torch.float32)
        np.testing.assert_allclose(y.detach(), expected, rtol=1e-4, atol=1e-5)
    one = torch.tensor([0.0, 0.1, -9.0], requires_grad=True)  # one source for all: its gradient is the sum
    trace_rays(Volume(array, grid), one, targets).sum().backward()
    assert one.grad.shape == (3,) and one.grad.dtype == torch.float32
    assert trace_rays(Volume(array, grid), one, torch.zeros((0, 3))).shape == (0,)
    assert trace_rays(Volume(array, grid), one.bfloat16(), targets).dtype == torch.bfloat16
    assert trace_fans(Volume(array, grid), torch.zeros((0, 4, 3)), (2, 3)).shape == (0, 2, 3)


def test_bad_input_is_one_clear_line():
    grid = GRID
    ones, point = torch.ones(grid.shape), torch.zeros(3)
    for call, word in (
        (lambda: trace_rays(ones, point, point), "grid"),
        (lambda: trace_rays(ones, point, point, grid=3), "int"),
        (lambda: trace_rays(ones * np.nan, point, point + 9, grid=grid), "volume: nan"),
        (lambda: trace_rays(torch.ones(3, 3, 3), point, point, grid=grid), "5 x 4 x 3"),
        (lambda: trace_rays(ones, torch.zeros(2), point, grid=grid), "sources"),
        (lambda: trace_rays(ones, torch.zeros((2, 3)), torch.zeros((4, 3)), grid=grid), "2 sources"),
        (lambda: trace_rays(ones, point, torch.tensor([0, 0, np.nan]), grid=grid), "targets"),
        (lambda: trace_rays(ones, point, torch.zeros(3, dtype=torch.complex64), grid=grid), "targets"),
        (lambda: trace_rays(ones, point, torch.zeros(1, 3).to_sparse(), grid=grid), "targets"),
        (lambda: trace_rays(ones, [torch.zeros(3, requires_grad=True)], point, grid=grid), "detach"),
        (lambda: trace_fans(ones, torch.zeros(2, 3), (2, 2), grid=grid), "4 x 3"),
        (lambda: trace_fans(ones, torch.full((4, 3), np.nan), (2, 2), grid=grid), "vectors"),
        (lambda: trace_fans(ones, torch.zeros(4, 3), (2, 0), grid=grid), "shape"),
    ):
        refused(call, word)


def test_gradients_of_gradients_are_refused(rng):
    source = torch.tensor([0.1, 0.2, -9.0], requires_grad=True)
    y = trace_rays(torch.rand(GRID.shape), source, [0.0, 0.3, 9.0], grid=GRID).sum()
    (gradient,) = torch.autograd.grad(y, source, create_graph=True)
    with pytest.raises(InputError, match="create_graph"):
        torch.autograd.grad(gradient.sum(), source)


@pytest.mark.parametrize("backend", ["numpy", "torch"])
def test_gradcheck_in_float64(backend):
    grid = Grid.centered((3, 2, 2), 2.0)
    A = Projector(
        grid, Views(VIEWS.sources, VIEWS.detector_centers, VIEWS.u_steps, VIEWS.v_steps, (2, 3)), backend=backend
    )
    x = torch.rand(grid.shape, dtype=torch.float64, requires_grad=True)
    assert A(x).dtype == torch.float64
    assert torch.autograd.gradcheck(lambda x: A(x) ** 2, (x,), check_forward_ad=True)
    assert torch.autograd.gradgradcheck(lambda x: A(x) ** 2, (x,))


@pytest.mark.parametrize("backend", BACKENDS)
def test_tensor_in_tensor_out(backend):
    A = Projector(GRID, VIEWS, backend=backend)
    x = torch.rand(GRID.shape)
    y = A(x)
    assert (
        isinstance(y, torch.Tensor)
        and not y.requires_grad
        and y.dtype == (torch.float64 if backend == "numpy" else torch.float32)
    )
    assert isinstance(A.T(y), torch.Tensor) and isinstance(next(A.iter_views(x)), torch.Tensor)
    np.testing.assert_allclose(y.numpy(), A(x.numpy()), rtol=1e-6)
    np.testing.assert_allclose(A(x.permute(2, 1, 0).contiguous().permute(2, 1, 0)), y, rtol=1e-6)
    np.testing.assert_allclose(A(torch._neg_view(-x)), y, rtol=1e-6)  # torch's lazy minus sign
    for other in (torch.float16, torch.bfloat16, torch.int32):
        assert torch.is_floating_point(A(torch.ones(GRID.shape, dtype=other)))


def test_gradient_through_a_bad_loss_is_not_refused():
    """A loss of NaN is for the training loop to notice; it must not raise inside backward."""
    A = Projector(GRID, VIEWS)
    x = torch.zeros(GRID.shape, requires_grad=True)
    (A(x) * float("nan")).sum().backward()
    assert torch.isnan(x.grad).any() and x.grad.dtype == torch.float32


def test_bad_tensors_are_one_clear_line():
    A = Projector(GRID, VIEWS)
    x = torch.ones(GRID.shape)
    x[1, 2, 0] = float("inf")
    for bad, word in (
        (x, "(1, 2, 0)"),
        (torch.ones(3, 3, 3), "5 x 4 x 3"),
        (torch.ones(GRID.shape, dtype=torch.complex64), "complex64"),
        (torch.ones(GRID.shape).to_sparse(), "sparse"),
        (torch.ones(GRID.shape, device="meta"), "meta"),
    ):
        refused(lambda bad=bad: A(bad), word)
    refused(lambda: Volume(torch.ones(GRID.shape, requires_grad=True), GRID), "volume: ", "detach")
