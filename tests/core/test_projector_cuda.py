"""The "cuda" backend's kernels: on a GPU with MPHDRR_CUDA_DEVICE=cuda, else the same kernels on Warp's CPU device."""

from __future__ import annotations

import os
import sys
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("warp", reason="warp-lang is not installed")
pytest.importorskip("torch", reason="torch is not installed")

import warp

from mphdrr.core.geometry.grid import Grid
from mphdrr.core.geometry.views import Views
from mphdrr.core.projector import Projector
from mphdrr.core.projector import trace_rays as trace
from mphdrr.core.rays import backends
from mphdrr.core.rays.backends import cuda, reference
from mphdrr.core.rays.ray_geometry import Attenuation, IndexFans, IndexRays, index_fans, view_rays
from mphdrr.core.volumes.volume import Volume

from .conftest import emission, general_grid, refused
from .test_projector import LINEAR, SHAPES, affine, nasty_rays, random_rays, some_views

SHAPE = (6, 7, 5)


@pytest.fixture(autouse=True)
def device(monkeypatch):
    monkeypatch.setenv(cuda.DEVICE_VARIABLE, os.environ.get(cuda.DEVICE_VARIABLE, "cpu"))


@pytest.fixture
def small_pieces(monkeypatch):
    """Launch 17 rays at once: rows and fans in several pieces."""
    monkeypatch.setattr(cuda, "_RAYS_AT_ONCE", 17)


@pytest.fixture
def fans(rng):
    """Return a volume, and the fans of four views."""
    views = some_views(rng, (7, 30), n=4)
    vectors = np.concatenate([view_rays(views, m).vectors() for m in range(4)])
    fans = index_fans(Grid(SHAPE, affine(LINEAR["sheared"], SHAPE)), vectors, views.shape)
    return rng.random(SHAPE, dtype=np.float32), fans


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("kind", LINEAR)
def test_nasty_rays(shape, kind, rng):
    grid = Grid(shape, affine(LINEAR[kind], shape))
    volume = Volume(rng.uniform(0.5, 1.5, shape).astype(np.float32), grid)
    for rays in (nasty_rays(grid, rng), random_rays(rng, grid)):
        expected = trace(volume, *rays, "numpy")
        assert np.count_nonzero(expected) > 20
        np.testing.assert_allclose(trace(volume, *rays, "cuda"), expected, rtol=2e-5, atol=2e-5)


@pytest.mark.parametrize("distance", [1e3, 1e6])
def test_far_sources_and_short_chords(distance, rng):
    """Rays that cut a corner by less than a thousandth of a voxel are as exact, for their length, as any other."""
    grid = Grid.centered((200, 180, 190), 1.0)
    volume = Volume(rng.uniform(0.5, 1.5, grid.shape).astype(np.float32), grid)
    corner = grid.center + np.array(grid.shape) / 2
    inside = corner - 10 ** rng.uniform(-4, 2, (400, 1)) * rng.uniform(0.1, 1, (400, 3))
    direction = rng.normal(size=(400, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    sources, targets = inside - distance * direction, inside + 300 * direction
    expected = trace(volume, sources, targets, "numpy")
    assert (expected > 0).all() and expected.min() < 1e-2 < 100 < expected.max()
    # The coordinates themselves are rounded: by 1e-10 mm, of a source 1e6 mm away.
    np.testing.assert_allclose(trace(volume, sources, targets, "cuda"), expected, rtol=2e-5, atol=1e-9 * distance / 1e3)


def test_thousands_of_voxels_do_not_add_up_errors():
    volume = np.full((5000, 1, 1), 0.7, np.float32)
    starts, along = np.array([[-7.0, 0.4, 0.4]]), np.array([[6011.0, 0.1, 0.2]])
    rays = IndexRays(starts, along, np.linalg.norm(along, axis=1))
    for attenuation in (None, Attenuation(np.full(volume.shape, 3e-4, np.float32))):
        expected = reference.forward(volume.astype(float), rays, attenuation)
        np.testing.assert_allclose(cuda.forward(volume, rays, attenuation), expected, rtol=5e-7)


@pytest.mark.parametrize("kind", LINEAR)
def test_fans_in_planes_of_faces(kind, rng):
    """Rays made on the device meet the same voxels as the reference's, in spite of rounding."""
    grid = Grid(SHAPE, affine(LINEAR[kind], SHAPE))
    sources = np.array([[-9.5, 2.5, 1.5], [2.5, -9.5, 1.5], [2.5, 3.5, -9.5]] * 2)  # of the voxels' centres
    targets = sources + np.array([[30, 0, 0], [0, 30, 0], [0, 0, 30], [30, 10, 0], [10, 30, 0], [0, 10, 30]])
    steps = np.roll(np.eye(3), 1, axis=0)[[0, 1, 2] * 2], np.roll(np.eye(3), 2, axis=0)[[0, 1, 2] * 2]
    linear = grid.affine[:3, :3].T
    ends = [points @ linear + grid.affine[:3, 3] for points in (sources, targets)]
    views = Views(*ends, *(step @ linear for step in steps), (5, 5))
    volume = rng.uniform(0.5, 1.5, SHAPE).astype(np.float32)
    for x in (volume, volume * (np.indices(SHAPE).sum(axis=0) % 2)):
        expected = Projector(grid, views, backend="numpy")(x)
        assert expected.any(axis=(1, 2)).all()
        np.testing.assert_allclose(Projector(grid, views, backend="cuda")(x), expected, rtol=2e-5, atol=2e-5)


def single(*arrays):
    return [None if array is None else array.astype(np.float32) for array in arrays]


@pytest.mark.parametrize("rounding", [False, True])
def test_derivatives_depend_on_mu_and_not_on_its_grid(rounding, rng):
    """With mu on the volume's lattice, a twice finer, a larger and a smaller one, planes of both are crossed at once."""
    volume, mu = single(rng.random(SHAPE), rng.random(SHAPE) * 0.1)
    mu[0], mu[:, :, 3:] = 0, 0
    starts, ends = rng.normal(size=(2, 3000, 3)) * 6 + np.array(SHAPE) / 2
    lengths = np.linalg.norm(ends - starts, axis=1)
    expected = cuda.derivatives(volume, IndexRays(starts, ends - starts, lengths), Attenuation(mu))
    if rounding:
        linear = rng.normal(size=(3, 3))
        starts, ends = (points @ linear @ np.linalg.inv(linear) for points in (starts, ends))
    for array, factor, shift in (
        (mu.repeat(2, 0).repeat(2, 1).repeat(2, 2), 2, (0, 0, 0)),
        (np.pad(mu, ((1, 1), (2, 0), (3, 4))), 1, (1, 2, 3)),
        (mu[1:, :, :3].copy(), 1, (-1, 0, 0)),
    ):
        behind = IndexRays(starts * factor + shift, (ends - starts) * factor, lengths)
        got = cuda.derivatives(volume, IndexRays(starts, ends - starts, lengths), Attenuation(array, behind))
        got[:, 7:13] *= factor
        assert np.count_nonzero(got[:, 7:13]) > 2000
        scale = np.abs(expected).max(axis=0)
        np.testing.assert_allclose(got / scale, expected / scale, rtol=0, atol=2e-6)


@pytest.mark.parametrize("attenuation", [None, "same", "other"])
def test_projector_agrees_with_the_reference(attenuation, system, rng, monkeypatch):
    """All of emission, with views traced by rows and by columns, in launches of several views and of parts of one."""
    grid = general_grid(rng, (20, 18, 16))
    mu_grid = general_grid(rng, (12, 14, 10)) if attenuation == "other" else grid
    mu = Volume(rng.uniform(0, 0.02, mu_grid.shape), mu_grid, "mu") if attenuation else None
    model = emission(system, mu=mu, aperture_points=3, crystal_mu=0.2, intrinsic_fwhm=4.0)
    A, reference = (Projector(grid, system.views((9, 8)), model, backend=name) for name in ("cuda", "numpy"))
    assert {A._bundles[m].transposed for m in range(12)} == {True, False}
    x, y = rng.random(A.shape_in, dtype=np.float32), rng.random(A.shape_out, dtype=np.float32)
    expected, expected_T = reference(x), reference.T(y)
    assert np.count_nonzero(expected) > 0.5 * expected.size
    for rays_together, rays_at_once in ((2**22, 2**24), (5 * 72, 2**24), (2**22, 100), (2**22, 20)):
        few = replace(backends.BACKENDS["cuda"], rays_at_once=rays_together, rays_of_images=rays_together)
        monkeypatch.setattr(A, "_backend", few)
        monkeypatch.setattr(cuda, "_RAYS_AT_ONCE", rays_at_once)
        Ax, ATy = A(x), A.T(y)
        assert Ax.dtype == ATy.dtype == np.float32
        np.testing.assert_allclose(Ax, expected, rtol=2e-5, atol=2e-5 * expected.max())
        np.testing.assert_allclose(ATy, expected_T, rtol=2e-5, atol=2e-5 * expected_T.max())
        Ax, ATy = Ax.astype(float), ATy.astype(float)
        assert abs(np.vdot(Ax, y) - np.vdot(x, ATy)) < 1e-5 * np.linalg.norm(Ax) * np.linalg.norm(y)


def test_rays_of_fans_are_the_listed_rays(fans, small_pieces):
    volume, fans = fans
    for function in (cuda.forward, cuda.derivatives):
        together = function(volume, fans)
        assert together.any()
        np.testing.assert_allclose(together, function(volume, fans.listed()), rtol=1e-5, atol=1e-6)
        single = [function(volume, IndexFans(fan[None], fans.shape)) for fan in fans.table]
        np.testing.assert_array_equal(together, np.concatenate(single))


def test_arrays_are_added_to_in_place(fans, rng):
    volume, fans = fans
    values, mu = rng.random(len(fans), dtype=np.float32), 0.1 * rng.random(SHAPE, dtype=np.float32)
    for part, *volumes in (("backproject",), ("mu_gradient", volume)):
        sums, expected = np.ones(SHAPE, np.float32), np.ones(SHAPE)
        getattr(cuda, part)(sums, *volumes, values, fans, Attenuation(mu))
        getattr(reference, part)(
            expected, *(a.astype(float) for a in (*volumes, values)), fans, Attenuation(mu.astype(float))
        )
        np.testing.assert_allclose(sums, expected, rtol=2e-5, atol=2e-5 * np.abs(expected).max())


@pytest.mark.parametrize("rays_at_once", [2**24, 17])
def test_tensors_on_the_device_are_not_copied(rays_at_once, rng, monkeypatch):
    monkeypatch.setattr(cuda, "_RAYS_AT_ONCE", rays_at_once)
    torch = pytest.importorskip("torch", reason="torch is not installed")
    grid = Grid(SHAPE, affine(LINEAR["rotated"], SHAPE))
    place = "cuda" if os.environ[cuda.DEVICE_VARIABLE] != "cpu" else "cpu"
    volume = torch.tensor(rng.random(SHAPE), dtype=torch.float32, device=place)
    assert cuda.to_backend(volume).data_ptr() == volume.data_ptr()

    fan = index_fans(grid, view_rays(some_views(rng, (9, 5)), 0).vectors(), (9, 5))
    integrals = cuda.forward(volume, fan)
    assert integrals.device == volume.device and integrals.dtype == torch.float32
    np.testing.assert_allclose(integrals.cpu(), cuda.forward(volume.cpu().numpy(), fan), rtol=1e-6)
    torch.testing.assert_close(cuda.forward(cuda.to_backend(torch._neg_view(volume)), fan), -integrals)
    filled = torch.zeros_like(volume)
    cuda.backproject(filled, integrals, fan)
    torch.testing.assert_close((filled * volume).sum(), (integrals**2).sum())

    A = Projector(grid, some_views(rng), backend="cuda")
    x = volume.double().requires_grad_()  # float64 is computed in float32
    weights = torch.tensor(rng.random(A.shape_out), device=place)
    (A(x) * weights).sum().backward()
    assert x.grad.dtype == torch.float64
    np.testing.assert_allclose(x.grad.cpu(), A.T(weights.cpu().numpy()), rtol=1e-5, atol=1e-6)

    source = torch.tensor([0.3, 0.1, -30.0], dtype=torch.float64, requires_grad=True)
    slopes = []
    for backend in ("cuda", "numpy"):
        trace(volume.cpu(), source, [[0.5, 1.0, 30.0], [4.0, 0.0, 20.0]], backend, grid).sum().backward()
        slopes.append(source.grad.clone())
        source.grad = None
    assert slopes[0].any()
    torch.testing.assert_close(*slopes, rtol=2e-5, atol=1e-6)


def test_what_is_missing_is_said_in_one_line(monkeypatch):
    views = some_views(np.random.default_rng(0))
    grid = Grid.centered(SHAPE, 1.0)

    def made():
        Projector(grid, views, backend="cuda")

    def without_warp(name):
        raise ModuleNotFoundError("No module named 'warp'")

    with monkeypatch.context() as patch:
        patch.setenv(cuda.DEVICE_VARIABLE, "cuda")
        patch.setattr(cuda, "has_driver", lambda: False)
        refused(made, "no NVIDIA driver")
        backends._cuda_works.cache_clear()
        assert not backends._cuda_works()  # a tensor on a GPU then goes to torch
    backends._cuda_works.cache_clear()
    monkeypatch.setenv(cuda.DEVICE_VARIABLE, "cuda:99")
    monkeypatch.setattr(cuda, "has_driver", lambda: True)
    refused(made, "cuda:99")
    monkeypatch.setattr(backends, "load", without_warp)
    refused(made, "pip install warp-lang")


def test_short_memory_means_more_launches(monkeypatch, fans):
    launches, launch = [], warp.launch
    monkeypatch.setattr(warp, "launch", lambda *a, **k: launches.append(a[1]) or launch(*a, **k))
    expected = cuda.forward(*fans)
    monkeypatch.setattr(cuda, "_FEWEST_RAYS", 1)
    monkeypatch.setattr(type(cuda.device()), "free_memory", 1000)  # 500 for the rays: 2 or 3 rows of a view
    np.testing.assert_array_equal(cuda.forward(*fans), expected)
    assert launches[0] == (4, 7, 30) and len(launches) > 8 and {dim[0] for dim in launches[1:]} == {1}
    A = Projector(Grid.centered((40, 40, 40), 1.0), some_views(np.random.default_rng(0)), backend="cuda")
    refused(lambda: A(np.ones(A.shape_in)), "are free on")  # not even the volume fits


@pytest.mark.long
@pytest.mark.skipif(sys.platform == "darwin", reason="Warp has no CUDA on macOS")
def test_kernels_compile_for_gpus_without_one(tmp_path):
    from mphdrr.core.rays.backends import warp_kernels

    cuda.device()
    (compiled,) = warp.compile_aot_module(warp_kernels, arch=75, module_dir=tmp_path, use_ptx=True)
    assert compiled.read_text().count(".entry") == 2


@pytest.mark.parametrize("attenuation", [None, "same", "other"])
def test_gradients_are_those_of_the_reference(attenuation, system, rng, small_pieces):
    """For rays by volume, mu and ends; for a projector by volume and mu; for cameras by their parameters."""
    torch = pytest.importorskip("torch", reason="torch is not installed")
    from mphdrr.core.projector.torch_cameras import emission_images

    grid = general_grid(rng, (12, 9, 10))
    mu_grid = general_grid(rng, (9, 10, 8)) if attenuation == "other" else grid
    volume, mu = (torch.tensor(rng.random(g.shape)) for g in (grid, mu_grid))
    ends = rng.normal(size=(2, 500, 3)) * 20 + grid.center
    ends[1, :250] = 2 * grid.center - ends[0, :250] + rng.normal(size=(250, 3))  # others miss, start or end inside
    model_mu = Volume(rng.random(mu_grid.shape), mu_grid, "mu") if attenuation else None
    model = emission(system, mu=model_mu, aperture_points=3, pixel_points=2)
    views = system.views((9, 8))
    poses = torch.tensor(system.poses())

    def gradients(backend):
        x, m, sources, targets, places, lengths = inputs = [
            torch.as_tensor(a).clone().requires_grad_()
            for a in (volume, mu * 0.02, *ends, poses[:, :3, 3], system.collimator_length)
        ]
        numbers = np.random.default_rng(0)
        matter = {"mu": m} if attenuation else {}
        on = {"grid": grid, "backend": backend, **matter, **({"mu_grid": mu_grid} if attenuation else {})}
        gradients_by_input = []
        for y in (
            trace(x, sources, targets, **on),
            Projector(grid, views, model, backend=backend)(x, **matter),
            emission_images(x, places, poses[:, :3, :3], lengths, 2.0, (9, 8), diameter=2.0, pixel_points=2, **on),
        ):
            loss = (y * torch.tensor(numbers.normal(size=y.shape))).sum()
            gradients_by_input += [g for g in torch.autograd.grad(loss, inputs, allow_unused=True) if g is not None]
        return gradients_by_input

    pairs = list(zip(gradients("cuda"), gradients("numpy"), strict=True))
    assert len(pairs) == (4 + 2 + 4 if attenuation else 3 + 1 + 3)
    for got, expected in pairs:
        assert expected.any()
        np.testing.assert_allclose(got, expected, rtol=0, atol=2e-5 * float(expected.abs().max()))
