"""Laws of phantoms and meshes on voxels of any shape: up to 500 times longer than wide, oblique and sheared."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.progress import Cancelled

from .test_phantoms import KINDS, PAINTING, SHAPES, total

trimesh = pytest.importorskip("trimesh")

SHEAR = np.array([[1, 0.6, -0.4], [0, 1, 0.3], [0, 0, -1]])  # and mirror
TURNED = mph.euler_pose(0.5, 1.1, -0.7)[:3, :3]
STRAIGHT, OBLIQUE, SHEARED = np.eye(3), TURNED, TURNED @ SHEAR
# The axes of the voxels, the lengths of their edges to each other, and their number; 0 makes one voxel of the whole length.
GRIDS = {
    "rods": (STRAIGHT, (1, 1, 20), 10_000),
    "one-slab": (STRAIGHT, (1, 0, 1), 10_000),
    "sheared-rods-500": (SHEARED, (500, 1, 1), 20_000),
    "oblique-slabs": (OBLIQUE, (25, 10, 1), 5_000),
    "one-sheared-slab": (SHEARED, (1, 1, 0), 10_000),
    "oblique-slabs-300": (OBLIQUE, (300, 300, 1), 2_000),
}
every_grid = pytest.mark.parametrize(
    "grid", [pytest.param(grid, marks=[pytest.mark.long] * ("one-s" not in grid)) for grid in GRIDS]
)


def on_grids(things) -> pytest.MarkDecorator:
    """Return the cases of each thing on each grid; only one grid for each is not `long`."""
    return pytest.mark.parametrize(
        ("thing", "grid"),
        [
            pytest.param(thing, grid, id=f"{name(thing)}-{grid}", marks=[pytest.mark.long] * ((i - j) % len(GRIDS) > 0))
            for i, thing in enumerate(things)
            for j, grid in enumerate(GRIDS)
        ],
    )


def name(thing: mph.Phantom | mph.Shape) -> str:
    return thing.title if isinstance(thing, mph.Phantom) else thing.KIND + ("-cut" if thing.cut else "")


def covering(axes: np.ndarray, sides, n_voxels: int, radius: float, center=(0.0, 0.0, 0.0)) -> mph.Grid:
    """Return about `n_voxels` voxels along the columns of `axes`, of proportions `sides`, that contain a ball."""
    reach = 2.002 * radius * np.linalg.norm(np.linalg.inv(axes), axis=1)
    sides, one = np.array(sides, float), np.array(sides) == 0
    sides[~one] *= (np.prod(reach[~one] / sides[~one]) / n_voxels) ** (1 / np.sum(~one))
    sides[one] = reach[one]
    shape = np.ceil(reach / sides - 1e-9).astype(int)
    affine = np.eye(4)
    affine[:3, :3] = axes * sides
    affine[:3, 3] = np.array(center) - affine[:3, :3] @ (shape - 1) / 2
    return mph.Grid(tuple(shape.tolist()), affine)


def without_warning(phantom: mph.Phantom, grid: mph.Grid, pose=None, quantity: str = "activity") -> mph.Volume:
    with warnings.catch_warnings():
        warnings.simplefilter("error", mph.InputWarning)
        return phantom.voxelize(grid, pose, quantity=quantity)


def plane_points(n: int) -> np.ndarray:
    """Return points (n, 2) that fill the unit square evenly: M. Roberts' R2 sequence."""
    return (0.5 + np.arange(1, n + 1)[:, None] * [0.7548776662466927, 0.5698402909980532]) % 1


def exact_means(phantom: mph.Phantom, grid: mph.Grid, low: np.ndarray, size, pose=None, n: int = 4000) -> np.ndarray:
    """Return a phantom's means over boxes of `size` voxels from indices `low` (m, 3), of `n` exact line integrals each."""
    axis = int(np.argmax(grid.spacing * size))
    others = [i for i in range(3) if i != axis]
    starts = np.repeat(low[:, None] - 0.5, n, axis=1)
    starts[..., others] += plane_points(n) * np.array(size)[others]
    ends = starts + np.eye(3)[axis] * size
    world = [index.reshape(-1, 3) @ grid.affine[:3, :3].T + grid.affine[:3, 3] for index in (starts, ends)]
    integrals = phantom.line_integrals(*world, pose)
    return integrals.reshape(len(low), n).mean(axis=1) / np.linalg.norm(world[1][0] - world[0][0])


@on_grids(KINDS)
def test_a_grid_that_holds_the_phantom_holds_its_activity(thing, grid):
    voxels = covering(*GRIDS[grid], thing.extent / 2)
    assert total(without_warning(thing, voxels)) == pytest.approx(thing.total_activity, rel=2e-4)


@on_grids(SHAPES)
def test_every_shape_keeps_its_content_however_it_is_scaled_and_sheared(thing, grid, rng):
    phantom = mph.ShapePhantom([thing])
    pose = mph.euler_pose(*rng.uniform(-3, 3, 3), translation=(1, -2, 3))
    pose[:3, :3] = pose[:3, :3] @ [[1.4, 0.3, 0], [0, -0.6, 0.2], [0, 0, 0.9]]
    voxels = covering(*GRIDS[grid], np.linalg.norm(pose[:3, :3], 2) * phantom.extent / 2, (1, -2, 3))
    content = phantom.total_activity * 1.4 * 0.6 * 0.9
    assert total(without_warning(phantom, voxels, pose)) == pytest.approx(content, rel=2e-4)


def test_a_slab_just_as_thick_as_a_derenzo_phantom_holds_it():
    n = 200
    phantom = mph.DerenzoPhantom(32, (7, 5, 4, 3, 0, 2), 30, activity=4)
    grid = mph.Grid.centered((n, n, 1), (64.5 / n, 64.5 / n, 30))
    assert total(without_warning(phantom, grid)) == pytest.approx(phantom.total_activity, rel=1e-4)


@on_grids([KINDS[0], PAINTING, KINDS[1], KINDS[5]])
def test_long_voxels_hold_their_mean(thing, grid, rng):
    pose = mph.euler_pose(0.4, 0.7, -1.1, (1, 2, -3))
    voxels = covering(*GRIDS[grid], thing.extent / 2, (1, 2, -3))
    values = without_warning(thing, voxels, pose).array
    partly = np.argwhere((values > 0.02 * values.max()) & (values < 0.98 * values.max()))
    index = rng.permutation(partly)[:60]
    error = (values[tuple(index.T)] - exact_means(thing, voxels, index, (1, 1, 1), pose)) / values.max()
    assert np.sqrt(np.mean(error**2)) < 0.02 and np.abs(error).max() < 0.08
    assert abs(error.mean()) < 0.006


@every_grid
def test_of_a_phantom_partly_outside_the_grid_holds_its_part_and_says_how_much_is_missing(grid):
    where = (9, -6, 8)
    voxels = covering(*GRIDS[grid], 0.3 * PAINTING.extent, where)
    held = exact_means(PAINTING, voxels, np.zeros((1, 3)), voxels.shape, n=100_000).item()
    held *= voxels.voxel_volume * voxels.n_voxels * 1e-3
    missing = 100 * (1 - held / PAINTING.total_activity)
    with pytest.warns(mph.InputWarning, match="of the phantom lies outside the grid") as said:
        volume = PAINTING.voxelize(voxels)
    assert total(volume) == pytest.approx(held, rel=1e-3)
    assert missing > 5 and abs(int(str(said[0].message).split("%")[0]) - missing) < 0.6


@every_grid
def test_meshes_keep_their_volume(grid):
    """Also where parts of them overlap, look inwards, or share faces, all within one voxel."""

    def joined(*parts) -> trimesh.Trimesh:
        return trimesh.util.concatenate(parts)

    def box(size, center=(0, 0, 0), inwards=False) -> trimesh.Trimesh:
        part = trimesh.creation.box(size).apply_translation(center)
        if inwards:
            part.invert()
        return part

    voxels = covering(*GRIDS[grid], 20, (1, -2, 3))
    ball = trimesh.creation.icosphere(subdivisions=3, radius=14)
    for mesh, volume in (
        (ball, ball.volume),
        (trimesh.creation.torus(12, 3), None),
        (box((20, 24, 0.1)), 48),
        (joined(box((20, 10, 10), (-2.5, 0, 0)), box((20, 10, 10), (2.5, 2, 1.5))), 4000 - 15 * 8 * 8.5),
        (joined(box((20, 10, 10)), box((4, 4, 4))), 2000),
        (joined(box((20, 10, 10)), box((4, 4, 4), inwards=True)), 2000 - 64),
        (joined(box((6, 6, 6), (-5, -3, 4)), box((6, 6, 6), (5, 4, -4), inwards=True)), 432),
        (joined(box((6, 6, 6), (-3, 0, 0)), box((6, 6, 6), (3, 0, 0))), 432),
    ):
        vertices = mesh.vertices @ mph.euler_pose(0.2, 0.4, 0.6)[:3, :3].T + [1, -2, 3]
        covered = mph.voxelize_mesh((vertices, mesh.faces), voxels)
        content = covered.array.sum(dtype=np.float64) * voxels.voxel_volume
        assert content == pytest.approx(mesh.volume if volume is None else volume, rel=2e-4)
        assert covered.array.min() >= 0 and covered.array.max() <= 1


def test_a_single_layer_of_long_voxels_can_be_cancelled_and_comes_out_the_same_again():
    grid, calls = covering(*GRIDS["sheared-rods-500"], PAINTING.extent / 2), []
    first = PAINTING.voxelize(grid, progress=lambda done, total: calls.append((done, total)))
    assert [done for done, _ in calls] == list(range(1, calls[-1][1] + 1)) and len(calls) > 10
    np.testing.assert_array_equal(first.array, PAINTING.voxelize(grid).array)

    def cancel(done: int, total: int) -> None:
        assert done <= 3
        if done == 3:
            raise Cancelled

    with pytest.raises(Cancelled):
        PAINTING.voxelize(grid, progress=cancel)
