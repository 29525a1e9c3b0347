"""The binding of the C kernels: levels of processor, which library is loaded, what is refused. See also tests/kernels."""

from __future__ import annotations

import itertools
import os
import sys
from pathlib import Path

import numpy as np
import pytest

from mphdrr.core.errors import InputError
from mphdrr.core.geometry.grid import Grid
from mphdrr.core.rays.backends import cpu, reference
from mphdrr.core.rays.lattices import Lattices
from mphdrr.core.rays.ray_geometry import index_fans, index_rays, view_rays

from .conftest import run_python
from .test_projector import LINEAR, SHAPES, affine, nasty_rays, random_rays, some_views

LEVELS = cpu.levels()
TOLERANCE = {np.float32: 2e-5, np.float64: 1e-9}


@pytest.fixture(params=LEVELS)
def level(request, monkeypatch):
    monkeypatch.setattr(cpu, "level", LEVELS.index(request.param))


def lattices_of(rng, kind, shape=(7, 6, 9)):
    """Yield a volume and its lattices: without mu, with mu on its lattice, with mu on another lattice."""
    grid = Grid(shape, affine(LINEAR["rotated"], shape))
    other = Grid((5, 8, 4), affine(LINEAR["sheared"] * 1.2, (5, 8, 4)))
    volume = rng.random(shape).astype(kind)
    mu, other_mu = (0.2 * rng.random(n).astype(kind) for n in (shape, other.shape))
    yield volume, Lattices(grid)
    yield volume, Lattices(grid, mu=mu)
    yield volume, Lattices(grid, mu=other_mu, mu_grid=other)


def as_double(mapped):
    rays, attenuation = mapped
    if attenuation is not None:
        attenuation = type(attenuation)(attenuation.mu.astype(float), attenuation.rays)
    return rays, attenuation


def close(values, expected, kind):
    np.testing.assert_allclose(values, expected, rtol=0, atol=TOLERANCE[kind] * np.abs(expected).max())


@pytest.mark.parametrize("kind", TOLERANCE)
def test_every_level_agrees_with_the_reference(level, kind, rng):
    for volume, lattices in lattices_of(rng, kind):
        fans = np.concatenate([view_rays(some_views(rng, (11, 13)), m).vectors() for m in range(3)])
        rays = lattices.mapped(index_rays, *random_rays(rng, lattices.grid, 500))
        for mapped in (lattices.mapped(index_fans, fans, (11, 13), 0.0), rays):
            values = rng.random(len(mapped[0])).astype(kind)
            expected = reference.forward(volume.astype(float), *as_double(mapped))
            assert expected.any()
            close(cpu.forward(volume, *mapped), expected, kind)
            sums, expected = np.zeros_like(volume), np.zeros(volume.shape)
            cpu.backproject(sums, values, *mapped)
            reference.backproject(expected, values, *as_double(mapped))
            close(sums, expected, kind)
            close(
                cpu.derivatives(volume, *mapped), reference.derivatives(volume.astype(float), *as_double(mapped)), kind
            )
            if lattices.mu is not None:
                sums, expected = np.zeros_like(lattices.mu), np.zeros(lattices.mu.shape)
                cpu.mu_gradient(sums, volume, values, *mapped)
                reference.mu_gradient(expected, volume.astype(float), values, *as_double(mapped))
                close(sums, expected, kind)


@pytest.mark.parametrize("kind", TOLERANCE)
def test_every_level_takes_rays_along_faces_edges_and_corners(level, kind, rng):
    for shape, linear in itertools.product(SHAPES, LINEAR.values()):
        lattices, volume = Lattices(Grid(shape, affine(linear, shape))), rng.random(shape).astype(kind)
        mapped = lattices.mapped(index_rays, *nasty_rays(lattices.grid, rng))
        close(cpu.forward(volume, *mapped), reference.forward(volume.astype(float), *mapped), kind)


PRINT_LEVEL = "from mphdrr.core.rays.backends import cpu; print(cpu.levels()[cpu.level])"


@pytest.mark.parametrize("name", LEVELS)
def test_the_environment_names_a_level(name):
    done = run_python(PRINT_LEVEL, {cpu.LEVEL_VARIABLE: name})
    assert done.stdout.strip() == name, done.stderr


def test_a_level_that_there_is_not_is_refused():
    done = run_python(PRINT_LEVEL, {cpu.LEVEL_VARIABLE: "AVX-1024"})
    assert "InputError" in done.stderr and LEVELS[0] in done.stderr and "AVX-1024" in done.stderr


@pytest.mark.skipif(sys.platform == "win32", reason="the names are those of other systems")
def test_the_library_is_the_packages_own(tmp_path):
    """Not a library of the same name in the working folder, or in a folder that the environment names."""
    for name in ("libsiddon.so", "libsiddon.dylib"):
        (tmp_path / name).write_text("not a library")
    paths = dict.fromkeys(
        ("LD_LIBRARY_PATH", "DYLD_LIBRARY_PATH", "PATH"), f"{tmp_path}{os.pathsep}{os.environ['PATH']}"
    )
    done = run_python("from mphdrr.core.rays.backends import cpu; print(cpu.library._name)", paths, cwd=tmp_path)
    assert Path(done.stdout.strip()).parent == Path(cpu.__file__).with_name("kernels"), done.stderr


def test_a_library_of_another_version_is_not_used(monkeypatch):
    monkeypatch.setattr(cpu, "_CONTRACT", -1)
    with pytest.raises(ImportError, match="another version"):
        cpu._load()


@pytest.mark.parametrize("kind", TOLERANCE)
def test_denormal_numbers_are_0_in_kernels_and_nowhere_else(level, kind):
    """They are slow there, and what else runs in the thread may need them."""
    volume = np.full((8, 8, 8), np.finfo(kind).tiny / 8, kind)
    ends = np.full((1, 3), 9.0)
    mapped = Lattices(Grid.centered(volume.shape, 1.0)).mapped(index_rays, -ends, ends)
    assert not cpu.forward(volume, *mapped).any()
    assert cpu.forward(2**20 * volume, *mapped).all()
    assert (volume * kind(0.5)).all()


@pytest.mark.parametrize("kind", TOLERANCE)
def test_the_last_voxel_of_a_long_way_counts_whole(level, kind):
    grid = Grid.centered((8, 8, 512), 1.0)
    volume = np.zeros(grid.shape, kind)
    volume[..., -1] = 1
    ends = np.array([[1.3, -0.4, 900.0], [-2.2, 3.1, 700.0]])
    mapped = Lattices(grid).mapped(index_rays, -ends, ends)
    close(cpu.forward(volume, *mapped), reference.forward(volume.astype(float), *mapped), kind)
    sums, expected = np.zeros_like(volume), np.zeros(grid.shape)
    cpu.backproject(sums, np.ones(2, kind), *mapped)
    reference.backproject(expected, np.ones(2), *mapped)
    close(sums, expected, kind)


def test_what_does_not_fit_is_not_taken():
    volume = np.ones((3, 4, 5), np.float32)
    ends = np.array([[0.0, 0, 9]])
    mapped = Lattices(Grid.centered(volume.shape, 1.0)).mapped(index_rays, -ends, ends)
    shared = type("Attenuation", (), {"mu": volume[:2], "rays": None})
    read_only = volume.copy()
    read_only.flags.writeable = False
    for call in (
        lambda: cpu.forward(volume.astype(np.int32), *mapped),
        lambda: cpu.forward(volume.astype(np.float16), *mapped),
        lambda: cpu.forward(volume.astype(">f4"), *mapped),
        lambda: cpu.forward(np.asfortranarray(volume), *mapped),
        lambda: cpu.forward(volume, mapped[0], shared),
        lambda: cpu.backproject(volume, np.ones(0, np.float32), *mapped),
        lambda: cpu.backproject(read_only, np.ones(1, np.float32), *mapped),
    ):
        with pytest.raises((TypeError, ValueError), match="expected"):
            call()


@pytest.mark.parametrize("shape", [(2**11, 2**10, 2**10), (1, 1, 2**12 + 1)])
def test_volumes_too_large_for_the_indices_are_refused(shape):
    volume = np.broadcast_to(np.float32(1), shape)
    ends = np.array([[0.0, 0, 9]])
    mapped = Lattices(Grid.centered(shape, 1.0)).mapped(index_rays, -ends, ends)
    with pytest.raises(InputError, match=" x ".join(map(str, shape))):
        cpu.forward(volume, *mapped)
