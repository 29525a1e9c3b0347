"""Meshes to volumes and back: volumes by the divergence theorem, on any grid; open meshes are refused with the place."""

from __future__ import annotations

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.volumes.meshes.mesh import MESH_FORMATS

from .conftest import general_grid

trimesh = pytest.importorskip("trimesh")


def sphere(radius: float = 20.0, center=(1.3, -2.2, 0.7), subdivisions: int = 5) -> mph.Mesh:
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return mph.Mesh(mesh.vertices + np.array(center), mesh.faces)


def box(size=(2.0, 2.0, 2.0), center=(0.0, 0.0, 0.0)) -> mph.Mesh:
    mesh = trimesh.creation.box(size)
    return mph.Mesh(mesh.vertices + np.array(center), mesh.faces)


def content(volume: mph.Volume) -> float:
    return float(volume.array.sum(dtype=np.float64) * volume.grid.voxel_volume)


@pytest.mark.parametrize("voxel", [30.0, 5.0])
def test_a_sphere_has_its_volume_on_any_grid(rng, voxel):
    ball = 4 / 3 * np.pi * 20**3
    n = int(60 / voxel) + 3
    for _ in range(3):
        affine = general_grid(rng, (n, n, n)).affine @ np.diag([voxel, voxel, voxel / 2, 1])
        affine[:3, 3] -= mph.Grid((n, n, 2 * n), affine).center
        grid = mph.Grid((n, n, 2 * n), affine)
        volume = mph.voxelize_mesh(sphere(), grid, value=3.0, quantity="mu")
        assert volume.quantity == "mu"
        assert volume.array.min() >= 0
        assert volume.array.max() <= 3
        assert content(volume) / 3 == pytest.approx(sphere().volume, rel=1e-6)
        assert content(volume) / 3 == pytest.approx(ball, rel=5e-3)


def test_every_voxel_of_a_box_holds_its_share(rng):
    low, high = np.array([-3.3, -2.1, -4.7]), np.array([2.6, 3.9, 1.2])
    mesh = box(high - low, (low + high) / 2)
    for grid in (mph.Grid.centered((9, 8, 11), (1.0, 1.3, 0.7)), mph.Grid.centered((3, 3, 3), 1.0)):
        faces = [np.arange(n + 1) - 0.5 for n in grid.shape]
        edges = [f * s + o for f, s, o in zip(faces, grid.spacing, grid.affine[:3, 3], strict=True)]
        shares = [
            np.clip(np.minimum(e[1:], b) - np.maximum(e[:-1], a), 0, None) / np.diff(e)
            for e, a, b in zip(edges, low, high, strict=True)
        ]
        expected = np.einsum("i,j,k->ijk", *shares)
        assert np.allclose(mph.voxelize_mesh(mesh, grid).array, expected, atol=1e-6)


def test_coverage_of_an_oblique_voxel_is_that_of_many_points(rng):
    grid = general_grid(rng, (6, 6, 6))
    mesh = sphere(4.0, (0.5, 0.2, -0.4))
    coverage = mph.voxelize_mesh(mesh, grid).array
    index = np.moveaxis(np.indices(grid.shape), 0, -1)[..., None, :]
    points = (index + rng.uniform(-0.5, 0.5, (4000, 3))) @ grid.affine[:3, :3].T + grid.affine[:3, 3]
    inside = (np.linalg.norm(points - [0.5, 0.2, -0.4], axis=-1) < 4).mean(axis=-1)
    assert np.abs(coverage - inside).max() < 0.04


def test_later_meshes_replace_earlier_ones():
    grid = mph.Grid.centered(16, 0.5)
    volume = mph.voxelize_mesh([box((6.0, 6, 6)), box((2.0, 2, 2))], grid, value=[1.0, 5.0])
    assert content(volume) == pytest.approx(216 - 8 + 5 * 8, rel=1e-6)
    assert volume.array[8, 8, 8] == 5


def test_what_lies_beside_the_grid_is_left_out():
    mesh = sphere(20, (0, 0, 0))
    grid = mph.Grid.centered(8, 5.0, (20, 20, 20))
    assert content(mph.voxelize_mesh(mesh, grid)) == pytest.approx(mesh.volume / 8, rel=1e-3)
    assert np.all(mph.voxelize_mesh(mesh, mph.Grid.centered(5, 1.0)).array == 1)
    assert np.all(mph.voxelize_mesh(mesh, mph.Grid.centered(5, 1.0, (90, 0, 0))).array == 0)
    assert np.all(mph.voxelize_mesh(mesh, mph.Grid.centered(5, 1.0, (18, 18, 18))).array == 0)


@pytest.mark.parametrize("suffix", MESH_FORMATS)
def test_files_come_back_in_every_format_and_unit(tmp_path, suffix):
    mesh = sphere(subdivisions=3)
    path = tmp_path / f"m{suffix}"
    for unit in (None, "cm"):
        mph.write_mesh(mesh, path, unit)
        back = mph.read_mesh(path, unit)
        assert back.volume == pytest.approx(mesh.volume, rel=1e-5)
        volume = mph.voxelize_mesh(back, mph.Grid.centered(10, 6.0))
        assert content(volume) == pytest.approx(mesh.volume, rel=1e-5)
    assert mph.read_mesh(path, "mm").volume == pytest.approx(mesh.volume / 1000, rel=1e-5)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_meshes_are_taken_as_paths_arrays_and_trimeshes(tmp_path):
    mesh = trimesh.creation.box((4.0, 4, 4))
    mph.write_mesh(mph.Mesh(mesh.vertices, mesh.faces), tmp_path / "m.stl")
    grid = mph.Grid.centered(6, 1.0)
    scene = trimesh.Scene([mesh])
    for given in (mesh, scene, (mesh.vertices, mesh.faces), tmp_path / "m.stl", str(tmp_path / "m.stl"), [mesh]):
        assert content(mph.voxelize_mesh(given, grid)) == pytest.approx(64)
    turned = mph.Mesh(mesh.vertices * [2, 1, -1], mesh.faces)
    assert content(mph.voxelize_mesh(turned, mph.Grid.centered(10, 1.0))) == pytest.approx(128)


def test_open_meshes_are_refused_with_the_place(tmp_path):
    mesh = trimesh.creation.box((4.0, 4, 4))
    hole = mph.Mesh(mesh.vertices + np.array([10, 0, 0]), mesh.faces[1:])
    edges = hole.vertices[mesh.faces[0][[[0, 1], [1, 2], [2, 0]]]].mean(axis=1)
    grid = mph.Grid.centered(6, 1.0)
    with pytest.raises(mph.InputError, match="it is not closed at 3 edges, the first at") as error:
        mph.voxelize_mesh(hole, grid)
    place = np.fromstring(str(error.value).split("first at (")[1].split(")")[0], sep=",")
    assert np.isclose(edges, place).all(axis=1).any()
    turned = np.array(mesh.faces)
    turned[0] = turned[0][::-1]
    with pytest.raises(mph.InputError, match=r"faces look to different sides at 3 edges.*recalculate the normals"):
        mph.voxelize_mesh((mesh.vertices, turned), grid)
    stl = tmp_path / "open.stl"
    mph.write_mesh(hole, stl)
    with pytest.raises(mph.InputError, match="not closed at 3 edges"):
        mph.voxelize_mesh(stl, grid)


def test_what_is_no_mesh_is_refused_in_one_line(tmp_path):
    grid, face, damaged = mph.Grid.centered(3, 1.0), np.array([[0, 1, 2]]), tmp_path / "damaged.stl"

    def read(data):
        damaged.write_bytes(data)
        mph.read_mesh(damaged)

    for call, message in (
        (lambda: mph.voxelize_mesh(3, grid), "expected a mesh, vertices and faces, or a path, got int"),
        (lambda: mph.voxelize_mesh((np.zeros((3, 3)), face + 1), grid), "expected indices from 0 to 2"),
        (lambda: mph.voxelize_mesh((np.zeros((3, 3)), np.zeros((0, 3), int)), grid), "it has no faces"),
        (lambda: mph.voxelize_mesh((np.zeros((3, 2)), face), grid), "mesh vertices: expected shape any x 3"),
        (lambda: mph.voxelize_mesh((np.full((3, 3), np.nan), face), grid), "not a finite number"),
        (lambda: mph.voxelize_mesh([], grid), "expected at least one mesh"),
        (lambda: mph.voxelize_mesh(tmp_path / "none.stl", grid), "no such file"),
        (lambda: mph.voxelize_mesh(tmp_path / "m.step", grid), "expected a name ending in .stl"),
        (lambda: mph.voxelize_mesh(box(), grid, value=[1, 2]), "value: expected shape 1"),
        (lambda: mph.voxelize_mesh(box(), (3, 3, 3)), "voxelize_mesh: expected a Grid, got tuple"),
        (lambda: mph.read_mesh(tmp_path / "m.stl", "ft"), "unit 'ft'"),
        (
            lambda: mph.write_mesh(3, tmp_path / "m.stl"),
            "mesh: expected a mesh, vertices and faces, or a path, got int",
        ),
        *((lambda data=data: read(data), "damaged.stl: ") for data in (b"", b"solid nothing\nendsolid", b"\x00" * 50)),
    ):
        with pytest.raises(mph.InputError, match=message) as error:
            call()
        assert "\n" not in str(error.value)
    damaged.unlink()
    assert not list(tmp_path.iterdir())


def test_voxelizing_is_cancelled():
    def stop(done: int, total: int) -> None:
        raise mph.Cancelled

    with pytest.raises(mph.Cancelled):
        mph.voxelize_mesh(box(), mph.Grid.centered(5, 1.0), progress=stop)


def test_surfaces_of_any_volume_are_closed(rng):
    for shape in ((1, 1, 1), (7, 8, 9)):
        volume = mph.Volume(rng.normal(size=shape) + 1, general_grid(rng, shape), "mu")
        mesh = mph.volume_to_mesh(volume, float(volume.array.max()) * 0.4)
        assert mesh.volume > 0
        assert trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).is_watertight
        mph.voxelize_mesh(mesh, volume.grid)


def test_a_sphere_comes_back_from_its_volume(rng):
    mesh = sphere()
    errors = []
    for voxel in (4.0, 2.0, 1.0):
        n = int(44 / voxel) + 2
        grid = mph.Grid.centered(n, voxel, (1, -2, 1))
        back = mph.volume_to_mesh(mph.voxelize_mesh(mesh, grid))
        assert np.linalg.norm(back.vertices - [1.3, -2.2, 0.7], axis=1) == pytest.approx(20, abs=0.5 * voxel)
        errors.append(abs(back.volume / mesh.volume - 1))
    assert errors[0] / errors[2] > 8  # second order
    assert errors[2] < 4e-3
