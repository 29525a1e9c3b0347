"""Laws of the projector: closed forms, adjointness, linearity, agreement of the backends."""

from __future__ import annotations

import numpy as np
import pytest

from mphdrr.core.geometry.grid import Grid
from mphdrr.core.geometry.views import Views
from mphdrr.core.projector import Projector, trace_rays
from mphdrr.core.volumes.volume import Volume

from .conftest import BACKENDS

TOLERANCE = {"numpy": 1e-9, "torch": 1e-5, "cpu": 1e-5}


def rotation(rng):
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q if np.linalg.det(q) > 0 else -q


def affine(linear, shape, center=(3.0, -5.0, 2.0)):
    """Return an affine with its grid's centre at `center`."""
    a = np.eye(4)
    a[:3, :3] = linear
    a[:3, 3] = center - a[:3, :3] @ ((np.array(shape) - 1) / 2)
    return a


_rng = np.random.default_rng(0)
LINEAR = {
    "plain": np.eye(3) * 2.0,
    "anisotropic": np.diag([0.7, 2.0, 3.5]),
    "mirrored": np.diag([-1.0, 1.5, 1.0]),
    "permuted": np.eye(3)[[2, 0, 1]] * 1.5,
    "rotated": rotation(_rng) * 1.3,
    "sheared": rotation(_rng) @ (np.diag([1.0, 1.4, 0.8]) + np.triu(_rng.uniform(-0.5, 0.5, (3, 3)), 1)),
}
SHAPES = [(5, 7, 6), (1, 1, 1), (1, 9, 4), (6, 5, 1)]


def clipped_length(grid, sources, targets, index):
    """Return the length in mm of each ray inside a voxel, by the slab method on voxel centres."""
    low, high = np.array(index) - 0.5, np.array(index) + 0.5
    inverse = np.linalg.inv(grid.affine)
    a = np.c_[sources, np.ones(len(sources))] @ inverse.T[:, :3]
    b = np.c_[targets, np.ones(len(targets))] @ inverse.T[:, :3]
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.stack([(low - a) / (b - a), (high - a) / (b - a)])
    enter = np.maximum(t.min(axis=0).max(axis=1), 0)
    leave = np.minimum(t.max(axis=0).min(axis=1), 1)
    return np.maximum(leave - enter, 0) * np.linalg.norm(targets - sources, axis=1)


def random_rays(rng, grid, n=400):
    """Return oblique rays: through, starting inside, ending inside, wholly inside, missing."""
    size = np.ptp(grid.corners(), axis=0).max()

    def points(scale):
        return grid.center + rng.normal(size=(n, 3)) * size * scale

    sources, targets = points(1.5), points(1.5)
    sources[: n // 4] = points(0.2)[: n // 4]
    targets[n // 8 : n // 2] = points(0.2)[n // 8 : n // 2]
    return sources, targets


def nasty_rays(grid, rng):
    """Return rays along axes, faces and edges, through corners, ending on faces, of length zero."""
    n = np.array(grid.shape)
    starts, ends = [], []

    def add(start, end):
        starts.append(np.asarray(start, float) - 0.5)  # faces at whole numbers here; centres in the affine
        ends.append(np.asarray(end, float) - 0.5)

    for axis in range(3):
        others = [i for i in range(3) if i != axis]
        for first in (0, 0.5, n[others[0]] / 2, n[others[0]], n[others[0]] - 1, -1):
            for second in (0, 0.3, n[others[1]], n[others[1]] // 2):
                a = np.zeros(3)
                a[others] = first, second
                b = a.copy()
                a[axis], b[axis] = -3, n[axis] + 3
                add(a, b)
                add(b, a)
                a[axis], b[axis] = 0.25, n[axis] - 0.5
                add(a, b)
                a[axis], b[axis] = 0, n[axis]
                add(a, b)
    corners = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), -1).reshape(-1, 3) * n
    for p in corners:
        for q in corners:
            add(p, q)  # edges, diagonals of faces and of the box, and one point (length zero)
            add(2.0 * p - q, 2.0 * q - p)
        far = rng.normal(size=3) * 20
        add(far, p)
        add(far, 2 * p - far)  # grazing a corner
    for _ in range(60):  # through lattice points, in lattice directions, and in planes of faces
        p = rng.integers(-1, n + 2)
        step = rng.integers(-3, 4, size=3)
        add(p - 5 * step, p + 5 * step)
        add(p - 5 * step, p)
        add(p, p)
        q = p + rng.normal(size=3)
        add(q, q)
        q[rng.integers(3)] = p[0]
        r = q + rng.normal(size=3) * 10
        flat = rng.integers(3)
        q[flat] = r[flat] = rng.integers(0, n[flat] + 1)
        add(q, r)

    def world(index):
        return np.array(index) @ grid.affine[:3, :3].T + grid.affine[:3, 3]

    return world(starts), world(ends)


def some_views(rng, shape=(6, 5), n=3, distance=60.0):
    directions = np.array([rotation(rng) for _ in range(n)])
    u, v, k = directions[:, 0], directions[:, 1], directions[:, 2]
    return Views(-distance * k, distance * k, u * 4.0, v * 5.0, shape)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("kind", LINEAR)
def test_integrals_are_the_sums_of_the_voxels_clipped_lengths(backend, shape, kind):
    """An independent Siddon of voxels amid empty margins, which are cropped."""
    rng = np.random.default_rng(1)
    array = np.pad(rng.uniform(0.5, 3, shape).astype(np.float32), rng.integers(0, 3, (3, 2)))
    grid = Grid(array.shape, affine(LINEAR[kind], array.shape))
    sources, targets = random_rays(rng, grid)
    expected = sum(array[tuple(i)] * clipped_length(grid, sources, targets, i) for i in np.argwhere(array))
    assert np.count_nonzero(expected) > 10
    integrals = trace_rays(Volume(array, grid), sources, targets, backend)
    np.testing.assert_allclose(integrals, expected, rtol=TOLERANCE[backend], atol=TOLERANCE[backend])


@pytest.mark.parametrize("backend", BACKENDS[1:])
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("kind", LINEAR)
def test_backends_agree_on_nasty_rays(backend, shape, kind):
    rng = np.random.default_rng(5)
    grid = Grid(shape, affine(LINEAR[kind], shape))
    volume = Volume(rng.uniform(0.5, 1.5, shape).astype(np.float32), grid)
    sources, targets = nasty_rays(grid, rng)
    reference = trace_rays(volume, sources, targets, "numpy")
    got = trace_rays(volume, sources, targets, backend)
    np.testing.assert_allclose(got, reference, rtol=2e-5, atol=2e-5)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("kind", LINEAR)
def test_face_belongs_to_the_voxel_above(backend, kind):
    """A ray in a plane of faces sees the upper voxel: the lower outer face is inside, the upper one outside."""
    shape = (2, 3, 4)
    grid = Grid(shape, affine(LINEAR[kind], shape))
    array = np.zeros(shape, np.float32)
    array[:, 1] = 1.0
    array[:, 2] = 10.0
    for face, value in ((0, 0.0), (1, 1.0), (2, 10.0), (3, 0.0)):
        ends = np.array([[-1, face - 0.5, 1.2], [3, face - 0.5, 1.2]]) @ grid.affine[:3, :3].T + grid.affine[:3, 3]
        expected = value * 2 * grid.spacing[0]
        for a, b in (ends, ends[::-1]):
            np.testing.assert_allclose(trace_rays(Volume(array, grid), a, b, backend), [expected], rtol=1e-6)


@pytest.mark.parametrize("backend", BACKENDS)
def test_ray_stops_at_its_target(backend):
    grid = Grid.centered((10, 1, 1), 1.0)
    volume = Volume(np.ones(grid.shape, np.float32), grid)
    sources = np.array([[-9.0, 0.1, 0.1], [-1.25, 0.1, 0.1], [0.5, 0.1, 0.1], [0.5, 0.1, 0.1]])
    targets = np.array([[1.25, 0.1, 0.1], [1.5, 0.1, 0.1], [0.75, 0.1, 0.1], [0.5, 0.1, 0.1]])
    got = trace_rays(volume, sources, targets, backend)
    np.testing.assert_allclose(got, [6.25, 2.75, 0.25, 0.0], rtol=1e-6)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("kind", LINEAR)
def test_adjoint(backend, kind):
    rng = np.random.default_rng(6)
    shape = (7, 6, 5)
    A = Projector(Grid(shape, affine(LINEAR[kind], shape)), some_views(rng), backend=backend, threads=2)
    x, y = rng.normal(size=shape), rng.normal(size=A.shape_out)
    Ax, ATy = A(x), A.T(y)
    assert Ax.any() and ATy.shape == shape and A.T.T is A and not A(np.zeros(shape)).any()
    scale = np.linalg.norm(Ax) * np.linalg.norm(y)
    assert abs(np.vdot(Ax.astype(float), y) - np.vdot(x, ATy.astype(float))) < scale * (
        1e-12 if backend == "numpy" else 1e-5
    )


@pytest.mark.parametrize("backend", BACKENDS)
def test_adjoint_matrix_is_the_transpose(backend):
    """Column by column on a small grid, axis-parallel rays along faces included."""
    grid = Grid.centered((3, 2, 2), 1.0)
    views = Views(
        [[0, 0, -9], [1.0, -9, 0]], [[0, 0, 9], [1.0, 9, 0]], np.eye(3)[[0, 0]] / 2, np.eye(3)[[1, 2]] / 2, (3, 4)
    )
    A = Projector(grid, views, backend=backend)
    forward = np.array([A(e.reshape(A.shape_in)).ravel() for e in np.eye(12)]).T
    adjoint = np.array([A.T(e.reshape(A.shape_out)).ravel() for e in np.eye(24)]).T
    np.testing.assert_allclose(adjoint, forward.T, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("backend", BACKENDS)
def test_projector_images_are_the_views_rays(backend):
    rng = np.random.default_rng(8)
    shape = (6, 5, 4)
    grid = Grid(shape, affine(LINEAR["sheared"], shape))
    views = some_views(rng, (7, 3), n=2)
    volume = Volume(rng.random(shape, dtype=np.float32), grid)
    A = Projector(grid, views, backend=backend)
    images = A(volume)
    for m in range(2):
        np.testing.assert_allclose(images[m].ravel(), trace_rays(volume, *views.rays(m), backend), rtol=1e-6)
    np.testing.assert_array_equal(np.stack(list(A.iter_views(volume))), images)
    begun = A.iter_views(volume)
    next(begun)
    begun.close()
    np.testing.assert_array_equal(A(volume), images)


@pytest.mark.parametrize("backend", BACKENDS)
def test_swapping_the_detectors_axes_transposes_the_images(backend):
    rng = np.random.default_rng(10)
    grid = Grid((6, 5, 4), affine(LINEAR["sheared"], (6, 5, 4)))
    views = some_views(rng, (7, 3), n=4)
    swapped = Views(views.sources, views.detector_centers, views.v_steps, views.u_steps, (3, 7))
    A, B = Projector(grid, views, backend=backend), Projector(grid, swapped, backend=backend)
    x, y = rng.random(grid.shape), rng.random(A.shape_out)
    np.testing.assert_allclose(B(x).swapaxes(1, 2), A(x), rtol=1e-6)
    np.testing.assert_allclose(B.T(y.swapaxes(1, 2)), A.T(y), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("backend", BACKENDS[::2])  # torch has threads of its own
def test_threads_change_nothing(backend):
    rng = np.random.default_rng(9)
    shape = (20, 21, 22)
    grid = Grid(shape, affine(LINEAR["rotated"], shape))
    views = some_views(rng, (150, 100), n=2)  # more than one block of rays
    x = rng.random(shape)
    one, two = (Projector(grid, views, backend=backend, threads=n) for n in (1, 2))
    y = one(x)
    np.testing.assert_array_equal(y, two(x))
    np.testing.assert_allclose(one.T(y), two.T(y), rtol=2e-6)
    np.testing.assert_array_equal(two.T(y), two.T(y))
