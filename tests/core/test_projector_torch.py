"""Gradients through the projector, for every backend."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed")

from mphdrr.core.geometry.grid import Grid  # noqa: E402
from mphdrr.core.geometry.views import Views  # noqa: E402
from mphdrr.core.projector import Projector  # noqa: E402
from mphdrr.core.volumes.volume import Volume  # noqa: E402

from .conftest import BACKENDS, refused  # noqa: E402

GRID = Grid.centered((5, 4, 3), 1.0)
VIEWS = Views(
    [[0.1, 0.3, -20], [2, -20, 1]], [[0, 0, 20], [0, 20, 0]], [[1, 0, 0], [1, 0, 0]], [[0, 1, 0], [0, 0, 1]], (4, 5)
)


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
