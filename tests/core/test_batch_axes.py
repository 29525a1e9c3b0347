"""Axes before those of a volume or of images: one operator for a batch, as for each of it alone."""

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.progress import Cancelled

from .conftest import BACKENDS, emission, general_grid


@pytest.fixture
def grid(rng):
    return general_grid(rng, (4, 5, 6))


def projector(system, grid, rng, backend="auto", blurred=True):
    mu = mph.Volume(rng.uniform(0, 0.02, grid.shape), grid, "mu")
    model = emission(system[:3], mu, time=1e4, intrinsic_fwhm=3.0 if blurred else 0.0)
    return mph.Projector(grid, system[:3].views((7, 8)), model, backend)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("batch", [(2,), (2, 1, 3), (1, 1)])
def test_a_batch_is_each_alone(system, grid, rng, backend, batch):
    check_batch(projector(system, grid, rng, backend), rng, batch)


def check_batch(A, rng, batch):
    x, y = rng.uniform(size=(*batch, *A.shape_in)), rng.uniform(size=(*batch, *A.shape_out))
    images, volumes = A(x), A.T(y)
    assert images.shape == (*batch, *A.shape_out) and volumes.shape == (*batch, *A.shape_in)
    assert images.dtype == A(x[(0,) * len(batch)]).dtype and volumes.dtype == A.T(y[(0,) * len(batch)]).dtype
    for index in np.ndindex(*batch):
        np.testing.assert_array_equal(images[index], A(x[index]))
        np.testing.assert_array_equal(volumes[index], A.T(y[index]))
    assert np.vdot(images.astype(float), y) == pytest.approx(np.vdot(x, volumes.astype(float)), rel=1e-5)


def test_any_layout_and_none(system, grid, rng):
    A = projector(system, grid, rng)
    x = rng.uniform(size=(*A.shape_in[::-1], 2)).astype(np.float32).T  # no C order
    np.testing.assert_array_equal(A(x)[1], A(x[1].copy()))
    np.testing.assert_array_equal(A(x.tolist()), A(x))
    assert A(np.zeros((0, *A.shape_in))).shape == (0, *A.shape_out)
    assert A.T(np.zeros((3, 0, *A.shape_out))).shape == (3, 0, *A.shape_in)


@pytest.mark.parametrize("model", [lambda system: mph.Transmission(), mph.InverseSquareSum])
def test_other_models_take_batches(system, grid, rng, model):
    check_batch(mph.Projector(grid, system[:3].views((5, 4)), model(system[:3])), rng, (2,))


def test_a_wrong_shape_says_what_is_expected(system, grid, rng):
    A = projector(system, grid, rng)
    for bad, said in (
        (np.ones((2, 4, 5, 7)), "volume: expected shape 2 x 4 x 5 x 6, got 2 x 4 x 5 x 7"),
        (np.ones((5, 6)), "volume: expected shape 4 x 5 x 6, got 5 x 6"),
        ([[1.0], [2.0, 3.0]], "volume: expected real numbers"),
    ):
        with pytest.raises(mph.InputError, match=said):
            A(bad)
    with pytest.raises(mph.InputError, match="images: expected shape 2 x 3 x 7 x 8, got 2 x 3 x 7 x 9"):
        A.T(np.ones((2, 3, 7, 9)))
    bad = np.ones((2, *grid.shape))
    with pytest.raises(mph.InputError, match="volume: expected shape 4 x 5 x 6"):
        A.iter_views(bad)  # immediately, not at the first image
    bad[1, 2, 3, 4] = np.nan
    with pytest.raises(mph.InputError, match=r"volume: nan is not a finite number at index \(1, 2, 3, 4\)"):
        A(bad)


@pytest.mark.parametrize("batch", [(), (4,)])
@pytest.mark.parametrize("adjoint", [False, True])
def test_progress_counts_the_views_of_the_whole_batch_and_stops_it(system, grid, rng, adjoint, batch):
    A = projector(system, grid, rng)
    A, total = A.T if adjoint else A, 12 if batch else 3
    x, calls = np.ones((*batch, *A.shape_in)), []
    A(x, progress=lambda done, total: calls.append((done, total)))
    assert calls == sorted(calls) and sorted(set(calls)) == [(k, total) for k in range(total + 1)]

    def stop(done, total):
        if done > total / 2:
            raise Cancelled

    with pytest.raises(Cancelled):
        A(x, progress=stop)
    assert A(x) is not None


def test_too_large_a_batch_is_refused_before_it_begins(system, rng, monkeypatch):
    from mphdrr.core import memory

    grid = mph.Grid.centered(2, 10.0)
    A = projector(system, grid, rng)
    monkeypatch.setattr(memory, "available", lambda: 10_000)
    with pytest.raises(mph.InputError, match="a batch of 100 times 3 x 7 x 8 numbers"):
        A(np.ones((100, 2, 2, 2), np.float32))


@pytest.mark.parametrize("backend", BACKENDS)
def test_torch_has_gradients_of_batches(system, grid, rng, backend):
    torch = pytest.importorskip("torch", reason="no torch")
    A = projector(system, grid, rng, backend)
    x = torch.tensor(rng.uniform(size=(2, 1, *A.shape_in)), requires_grad=True)
    y = torch.tensor(rng.uniform(size=(2, 1, *A.shape_out)))
    (A(x) * y).sum().backward()
    torch.testing.assert_close(x.grad, A.T(y))
    assert x.grad.shape == x.shape
    if backend == "cpu":
        assert torch.autograd.gradcheck(lambda x: A(x).sum((2, 3, 4)), x.detach().requires_grad_(), fast_mode=True)
    images = y.clone().requires_grad_()
    A.T(images).sum().backward()
    torch.testing.assert_close(images.grad[1, 0], A(torch.ones(A.shape_in, dtype=torch.float64)))


def test_one_mu_of_a_whole_batch(system, grid, rng):
    torch = pytest.importorskip("torch", reason="no torch")
    A = projector(system.replace(tilt=0.0), grid, rng)
    x = torch.tensor(rng.uniform(size=(3, *grid.shape)), requires_grad=True)
    mu = torch.tensor(rng.uniform(0, 0.03, grid.shape), requires_grad=True)
    y = torch.tensor(rng.uniform(size=(3, *A.shape_out)))
    (A(x, mu=mu) * y).sum().backward()
    by_x, by_mu = x.grad.clone(), mu.grad.clone()
    x.grad = mu.grad = None
    for one, images in zip(x, y, strict=True):
        (A(one, mu=mu) * images).sum().backward()
    torch.testing.assert_close(x.grad, by_x)
    torch.testing.assert_close(mu.grad, by_mu)
    np.testing.assert_allclose(A(x.detach().numpy(), mu=mu.detach().numpy())[2], A(x[2].detach(), mu=mu.detach()), 1e-6)
