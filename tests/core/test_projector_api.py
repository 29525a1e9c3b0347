"""What the projector accepts, refuses and returns; progress, memory, choice of the backend."""

from __future__ import annotations

import importlib
import os
import warnings

import numpy as np
import pytest

import mphdrr.core.memory
from mphdrr.core.errors import InputWarning
from mphdrr.core.geometry.grid import Grid
from mphdrr.core.geometry.views import Views
from mphdrr.core.projector import Projector, Transmission, trace_rays
from mphdrr.core.rays import backends
from mphdrr.core.rays.backends import cpu
from mphdrr.core.volumes.volume import Volume

from .conftest import dc_spect, emission, refused, run_python

GRID = Grid.centered((5, 4, 3), 1.0)
VIEWS = Views(
    [[0, 0, -20], [0, -20, 0]], [[0, 0, 20], [0, 20, 0]], [[1, 0, 0], [1, 0, 0]], [[0, 1, 0], [0, 0, 1]], (6, 7)
)
ONES = np.ones(GRID.shape, np.float32)


def test_types_out():
    reference = Projector(GRID, VIEWS, model=Transmission(), backend="numpy")
    assert reference(ONES).dtype == np.float64 and reference.T(reference(ONES)).dtype == np.float64
    A = Projector(GRID, VIEWS)
    for volume in (ONES, ONES.astype(float), ONES.astype(int), ONES > 0, np.asfortranarray(ONES), Volume(ONES, GRID)):
        y = A(volume)
        assert y.dtype == np.float32 and y.shape == (2, 6, 7)
        np.testing.assert_allclose(y, reference(ONES), rtol=1e-5)
    assert A.T(y).dtype == np.float32 and A.T(y).shape == GRID.shape
    assert trace_rays(Volume(ONES, GRID), [0, 0, -9], [0, 0, 9]).dtype == np.float32


def test_inputs_are_not_changed():
    A = Projector(GRID, VIEWS)
    x = ONES.copy()
    y = A(x)
    kept = y.copy()
    A.T(y)
    np.testing.assert_array_equal(x, ONES)
    np.testing.assert_array_equal(y, kept)


def test_no_views_give_no_images_and_no_rays_no_integrals():
    A = Projector(GRID, VIEWS[:0])
    assert A(ONES).shape == (0, 6, 7)
    np.testing.assert_array_equal(A.T(A(ONES)), np.zeros(GRID.shape))
    volume = Volume(ONES, GRID)
    for none in ([], np.empty((0, 3))):
        assert trace_rays(volume, none, none).shape == (0,)
        assert trace_rays(volume, [0, 0, -9], none).shape == (0,)


def test_bad_input_is_one_clear_line():
    A = Projector(GRID, VIEWS)
    holed = ONES.copy()
    holed[2, 1, 0] = np.nan
    refused(lambda: A(holed), "volume", "nan", "(2, 1, 0)")
    refused(lambda: A(np.ones((4, 4, 3))), "volume", "5 x 4 x 3", "4 x 4 x 3")
    refused(lambda: A(ONES * 1j), "volume", "real")
    refused(lambda: A("volume"), "volume", "real")
    refused(lambda: A(np.full(GRID.shape, 1e300)), "volume", "finite")
    images = np.zeros((2, 6, 7))
    images[1, 2, 3] = np.inf
    refused(lambda: A.T(images), "images", "inf", "(1, 2, 3)")
    refused(lambda: A.T(ONES), "images", "2 x 6 x 7")
    refused(lambda: A(Volume(ONES, Grid.centered((5, 4, 3), 2.0))), "grid", "2 x 2 x 2 mm", "1 x 1 x 1 mm")
    refused(lambda: A(Volume(ONES, Grid.centered((5, 4, 3), 1.0, (0, 0, 1)))), "grid")
    refused(lambda: Projector(VIEWS, GRID), "grid", "Views")
    refused(lambda: Projector(GRID, VIEWS, model="transmission"), "model", "Transmission")
    for bad in (0, -1, 1.5, True, "two"):
        refused(lambda bad=bad: Projector(GRID, VIEWS, threads=bad), "threads")
    volume = Volume(ONES, GRID)
    refused(lambda: trace_rays(ONES, [0, 0, 0], [1, 1, 1]), "Volume")
    refused(lambda: trace_rays(volume, [0, 0, 0], [[1, 1, np.nan]]), "targets", "(0, 2)")
    refused(lambda: trace_rays(volume, np.zeros((2, 3)), np.zeros((4, 3))), "2 sources", "4 targets")
    refused(lambda: trace_rays(volume, [[0, 0, 0], [1]], [1, 1, 1]), "sources")
    refused(lambda: trace_rays(volume, np.zeros((2, 2)), np.zeros((2, 3))), "sources", "expected shape 2 x 3")


def test_volume_of_the_same_grid_read_from_a_file_is_accepted():
    affine = GRID.affine.copy()
    affine[:3] *= 1 + 1e-7
    Projector(GRID, VIEWS)(Volume(ONES, Grid(GRID.shape, affine)))


def without(monkeypatch, *missing):
    require = backends._require

    def found(backend):
        if backend.name in missing:
            raise ImportError(f"no kernels and no {backend.name}")
        require(backend)

    monkeypatch.setattr(backends, "_require", found)
    backends._warn_slower.cache_clear()


def test_unknown_backends_and_missing_libraries_are_named(monkeypatch):
    refused(lambda: Projector(GRID, VIEWS, backend="gpu"), "'gpu'", "auto, cpu, torch, numpy, cuda")
    refused(lambda: trace_rays(Volume(ONES, GRID), [0, 0, 0], [1, 1, 1], "gpu"), "'gpu'", "cpu")
    without(monkeypatch, "cpu", "torch")
    refused(lambda: Projector(GRID, VIEWS, backend="cpu"), "backend 'cpu'", "no kernels")
    refused(lambda: Projector(GRID, VIEWS, backend="torch"), "pip install torch")


def test_auto_falls_back_and_says_so_once(monkeypatch):
    without(monkeypatch, "cpu", "torch")
    with pytest.warns(InputWarning, match=r"run with numpy, many times slower than with the backend cpu \(no kernels"):
        A = Projector(GRID, VIEWS)
    assert A.backend == "numpy" and A(ONES).dtype == np.float32 and A.T(A(ONES)).dtype == np.float32
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Projector(GRID, VIEWS)
    backends._warn_slower.cache_clear()


def test_auto_is_cpu_and_its_old_name_is_taken_silently():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        A = Projector(GRID, VIEWS, backend="numba")
        integral = trace_rays(Volume(ONES, GRID), [0, 0, -9], [0, 0, 9], "numba")
    assert A.backend == Projector(GRID, VIEWS).backend == "cpu" and integral == 3


def test_what_cannot_fit_is_refused_before_it_starts(monkeypatch):
    """Also a copy of a number's broadcast, and the rays of an image."""
    large = Grid.centered((10**5, 10**5, 10**4), 1.0)
    one = np.broadcast_to(np.float32(1), large.shape)
    refused(lambda: Projector(large, VIEWS)(one), "volume of 100000 x 100000 x 10000", "of memory")
    views = Views([[0, 0, -9]], [[0, 0, 9]], [[1, 0, 0]], [[0, 1, 0]], shape=(10**6, 10**6))
    refused(lambda: next(Projector(GRID, views).iter_views(ONES)), "an image of 1000000 x 1000000 pixels", "of memory")
    monkeypatch.setattr(mphdrr.core.memory, "available", lambda: 200)
    A = Projector(GRID, VIEWS, threads=1)
    refused(lambda: A(ONES), "5 x 4 x 3 voxels", "2 images of 6 x 7", "memory")
    refused(lambda: A.T(np.ones(A.shape_out)), "5 x 4 x 3", "memory")


def test_adjoint_uses_fewer_threads_when_memory_is_short(monkeypatch):
    images = np.random.default_rng(0).random((2, 6, 7))
    expected = Projector(GRID, VIEWS, threads=1).T(images)
    monkeypatch.setattr("mphdrr.core.rays.execution.available", lambda: 1)
    np.testing.assert_array_equal(Projector(GRID, VIEWS, threads=4).T(images), expected)


FORK = """
import multiprocessing, numpy as np
from mphdrr.core.geometry.grid import Grid
from mphdrr.core.projector import Projector
from mphdrr.core.geometry.views import Views
grid = Grid.centered(8, 1.0)
A = Projector(grid, Views([[0, 0, -50]], [[0, 0, 50]], [[0.2, 0, 0]], [[0, 0.2, 0]], (60, 60)), threads=2)
def total(_): return float(A(np.ones(grid.shape)).sum())
first = total(0)
with multiprocessing.get_context("fork").Pool(2) as pool:
    print(len({first, *pool.map(total, range(3))}))
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes fork on POSIX only")
def test_forked_processes_project_too():
    """Threads do not survive a fork, which is how data loaders start their workers."""
    done = run_python(FORK, timeout=600)
    assert done.stdout.strip() == "1", done.stderr


@pytest.mark.parametrize("pixel_points", [1, 150])
def test_progress_comes_as_often_however_many_rays_a_pixel_has(pixel_points, monkeypatch):
    n_views, shape = (40, (128, 128)) if pixel_points == 1 else (8, (64, 64))
    u, v = np.tile([[0.5, 0, 0]], (n_views, 1)), np.tile([[0, 0.5, 0]], (n_views, 1))
    views = Views(np.tile([[0, 0, -50.0]], (n_views, 1)), np.tile([[0, 0, 50.0]], (n_views, 1)), u, v, shape)
    A = Projector(GRID, views, Transmission(pixel_points), threads=2)
    traced, before = [0], [0]
    backproject = cpu.backproject

    def counted(volume, values, rays, attenuation=None):
        traced[0] += len(rays)
        backproject(volume, values, rays, attenuation)

    def look(done, total):
        assert traced[0] - before[0] <= 2**20
        before[0] = traced[0]

    monkeypatch.setattr(cpu, "backproject", counted)
    A.T(np.ones(A.shape_out), look)
    assert traced[0] > 0


def test_images_do_not_depend_on_threads_where_they_are_attenuated():
    system = dc_spect()[::10]
    mu = Volume(np.random.default_rng(0).random(GRID.shape) * 0.6, GRID, "mu")
    first, second = (
        Projector(GRID, system.views((72, 72)), emission(system, mu), threads=threads)(ONES) for threads in (1, 6)
    )
    np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize(
    ("path", "name", "new"),
    [
        ("backends", "BACKENDS", "rays.backends"),
        ("backends.cpu", "levels", "rays.backends.cpu"),
        ("emission", "Emission", "models.emission"),
        ("models", "Transmission", "models.model"),
        ("parallel", "thread_count", "rays.parallel"),
        ("rays", "view_rays", "rays.ray_geometry"),
    ],
)
def test_old_paths_of_modules_give_the_same_names_and_say_the_new_path(path, name, new):
    old = importlib.import_module(f"mphdrr.core.projector.{path}")
    words = f"mphdrr.core.projector.{path} is deprecated: import {name} from mphdrr.core.{new}"
    with pytest.warns(DeprecationWarning, match=f"^{words}$"):
        value = getattr(old, name)
    assert value is getattr(importlib.import_module(f"mphdrr.core.{new}"), name)
