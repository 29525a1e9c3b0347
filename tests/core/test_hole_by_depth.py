"""The whole hole, blurred depth by depth: laws, and agreement with points of the hole."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

import mphdrr.core as mph

from .conftest import dc_spect, general_grid, refused, voxel_centers
from .test_batch_axes import check_batch
from .test_emission import assert_adjoint, assert_real_is_virtual, one_module, sensitivity
from .test_projector import rotation
from .test_volume_formats import CHEST
from .traced_photons import misplaced

SYSTEM = dc_spect()[[0, 47]]


def depth_projector(grid, pixels=64, backend="auto", system=SYSTEM, **changes):
    return mph.Projector(grid, system.views((pixels, pixels)), mph.Emission(system, hole="depth", **changes), backend)


def disc_up_to(x, y):
    """Return the share of the unit disc's area left of x and below y."""
    x, y = np.clip(x, -1, 1), np.clip(y, -1, 1)

    def under(t):
        return (t * np.sqrt(np.maximum(1 - t * t, 0)) + np.arcsin(np.clip(t, -1, 1))) / 2

    half = np.sqrt(np.maximum(1 - y * y, 0))
    end = np.clip(x, -half, half)
    segment = under(end) - under(-half) - np.abs(y) * (end + half)  # beyond |y|, left of x
    return np.where(y >= 0, 2 * under(x) + math.pi / 2 - segment, segment) / math.pi


def exact_image(system, pixels, edges, at, work):
    """Return a voxel's image in module 0, all of it on the crystal: the discs of its points, as pixels cut them."""
    (u, v, k), l = system.frames()[0], float(system.collimator_length[0])
    d, pitch = float(system.pinhole_diameter[0]), float(system.detector_side[0]) / pixels
    from_hole = at - system.centers[0]
    wide = int(d * (1 + l / (from_hole @ k - np.abs(edges).sum() / 2)) / pitch) + 2  # pixels around a disc
    n = int(np.clip(work / wide**2, 400, 1_000_000))
    points = (
        (0.5 + np.arange(n)[:, None] * [0.8191725134, 0.6710436067, 0.5497004779]) % 1 - 0.5
    ) @ edges.T + from_hole
    image = np.zeros((pixels + 2 * wide,) * 2)  # no disc reaches over its edge
    for some in np.array_split(points, 1 + n * wide**2 // 1_000_000):
        h, places = some @ k, some @ np.stack([u, v]).T
        radius, middles = (
            d / 2 * (1 + l / h),
            places * (l / h)[:, None] / pitch + pixels / 2,
        )  # of discs: mm, and pixels
        first = np.floor(middles - radius[:, None] / pitch).astype(int)
        borders = first[..., None] + np.arange(wide + 1)
        x, y = np.moveaxis((borders - middles[..., None]) * (pitch / radius)[:, None, None], 1, 0)
        shares = np.diff(np.diff(disc_up_to(x[:, None], y[:, :, None]), axis=1), axis=2)
        # The photon that meets the crystal there has passed the hole at (middle - there) / (1 + l / h).
        there = (borders[..., 1:] - 0.5 - middles[..., None]) * pitch
        slope_u, slope_v = np.moveaxis(
            (places[..., None] + there / (1 + l / h)[:, None, None]) / h[:, None, None], 1, 0
        )
        shares *= (1 + slope_u[:, None] ** 2 + slope_v[:, :, None] ** 2) ** -1.5 / (h**2)[:, None, None]
        columns, rows = np.moveaxis(borders[..., :-1], 1, 0)
        np.add.at(image, tuple(np.broadcast_arrays(rows[:, :, None] + wide, columns[:, None] + wide)), shares)
    return image[wide:-wide, wide:-wide] * d**2 / 16 * abs(np.linalg.det(edges)) / n


def errors_of_voxels(rng, size, pixels, hole, near=False, voxels=1, depth=80, work=2e6):
    """Return errors of single voxels anywhere in a grid, seen aslant or straight: share misplaced, and of the total.

    The grid is 50 mm wide, or `depth` voxels. With `near`, it is as close to the pinhole as "depth" takes it.
    """
    system = dc_spect()[[int(rng.integers(80))]]
    system = dataclasses.replace(system, pinhole_diameter=hole)
    n = 2 * round(min(25 / size, depth / 2)) + 1
    turn = rotation(rng) if rng.random() < 0.6 else np.eye(3)
    affine, (u, v, k) = np.eye(4), system.frames()[0]
    affine[:3, :3] = turn * size
    affine[:3, 3] = -affine[:3, :3] @ np.full(3, n // 2)
    l, side, found = float(system.collimator_length[0]), float(system.detector_side[0]), []
    deep = np.abs(k @ affine[:3, :3]).sum() * n / 2
    distances = np.arange(deep + 1, 400)
    shadows = [1 + l / (distances + a) for a in (-deep, deep)]
    nearest = distances[np.argmax(shadows[0] < 2.4 * shadows[1])]
    distance = nearest if near else max(nearest, rng.uniform(190, 260))
    affine[:3, 3] += system.centers[0] + distance * k
    A = mph.Projector(mph.Grid((n, n, n), affine), system.views((pixels, pixels)), mph.Emission(system, hole="depth"))
    while len(found) < voxels:
        index = rng.integers(0, n, 3)
        at = A.grid.affine[:3, :3] @ index + A.grid.affine[:3, 3] - system.centers[0]
        reach = max(abs(at @ u), abs(at @ v)) * l / (at @ k) + (hole + size) * (1 + l / (at @ k)) / 2
        if (at @ k) < 1 or (near and at @ k > distance - deep / 2) or reach > side / 2:
            continue
        x = np.zeros(A.shape_in, np.float32)
        x[tuple(index)] = 1
        exact = exact_image(system, pixels, A.grid.affine[:3, :3], at + system.centers[0], work)
        image = A(x)[0]
        assert image.min() >= 0
        found.append((np.abs(image - exact).sum() / exact.sum(), abs(image.sum() / exact.sum() - 1)))
    return found


# Of a voxel, mm; pixels along the crystal's side; of the hole, mm.
SIZES = [(0.2, 32, 12.0), (3.4, 32, 0.6), (6.0, 128, 0.3)]
NEAR = [(0.3, 32, 11.0), (2.1, 64, 0.9)]


def assert_right(errors):
    misplaced, totals = np.array(errors).T
    assert misplaced.max() < 0.01 and misplaced.mean() < 0.005, misplaced
    assert totals.max() < 1e-3, totals


@pytest.mark.long
def test_voxels_of_any_size_have_the_whole_holes_image_as_near_to_the_pinhole_as_it_goes(rng):
    far = [error for sizes in SIZES for error in errors_of_voxels(rng, *sizes)]
    assert_right(far + [error for sizes in NEAR for error in errors_of_voxels(rng, *sizes, near=True)])


@pytest.mark.long
@pytest.mark.parametrize(("near", "work"), [(False, 5e6), (True, 2e7)], ids=["far", "near"])
def test_many_voxels_have_the_whole_holes_image(near, work, rng):
    def any_sizes():
        size, hole = np.exp(rng.uniform(*np.log([[0.2, 0.2], [6, 12]]))).tolist()
        return size, int(rng.choice([32, 64, 128, 256, 512])), hole

    assert_right([error for _ in range(5) for error in errors_of_voxels(rng, *any_sizes(), near, 2, 400, work)])


def test_no_voxel_is_missed():
    """Counts of single small voxels by the law of a point source, wherever they are between the pixels."""
    grid = mph.Grid.centered((40, 40, 40), 0.3)
    system = one_module()
    A = depth_projector(grid, 16, system=system)
    law = sensitivity(system, voxel_centers(grid).reshape(-1, 3))[0].reshape(grid.shape) * 0.3**3
    np.testing.assert_allclose(A.T(np.ones(A.shape_out)), law, rtol=2e-3)


EDGE = {"edge": "path", "aperture_mu": 2.0}
DEEP = {"crystal_mu": 0.26, "depth_layers": 8}
WITHIN = {"intrinsic_fwhm": 2.0, "within_crystal": True}


@pytest.mark.parametrize("backend", ["cpu", "numpy"])
@pytest.mark.parametrize("settings", [EDGE, {**DEEP, **WITHIN}, {**DEEP, **EDGE, **WITHIN}, WITHIN])
def test_adjoint_is_exact_and_backends_agree(settings, backend, rng):
    grid, views, model = (
        general_grid(rng, (9, 8, 21)),
        SYSTEM.views((22, 19)),
        mph.Emission(SYSTEM, hole="depth", **settings),
    )
    x, y = rng.random(grid.shape), rng.random((2, 22, 19))
    reference = mph.Projector(grid, views, model, "numpy", double=True)
    for double in (False, True)[settings is not WITHIN :]:
        A = mph.Projector(grid, views, model, backend, double=double)
        assert_adjoint(A, rng)
        assert not double or (A(x) * y).sum() == pytest.approx((A.T(y) * x).sum(), rel=1e-12)
        for numbers, expected in ((A(x), reference(x)), (A.T(y), reference.T(y))):
            np.testing.assert_allclose(numbers, expected, rtol=0, atol=(1e-12 if double else 1e-5) * expected.max())


@pytest.mark.parametrize(("settings", "points", "bound"), [
    ({"intrinsic_fwhm": 1.0, "crystal_mu": "NaI", "isotope": "Tc-99m", "aperture_mu": "tungsten"}, (61, 13), 0.01),
    ({"edge": "path", "aperture_mu": 3.6, "plate_thickness": 3.0}, (61, 13), 0.01),
    ({"edge": "path", "aperture_mu": 3.6, "within_crystal": True, **DEEP}, (37, 8), 0.012),
])  # fmt: skip
def test_images_are_those_of_many_rays(settings, points, bound, rng):
    grid, system = mph.Grid.centered((12, 12, 12), 6.0), SYSTEM[1:]
    x = rng.random(grid.shape) ** 8
    A = depth_projector(grid, 24, system=system, **settings)
    hole_points, pixel_points = points
    rays = mph.Emission(
        system, hole="rays", aperture_points=hole_points, pixel_points=pixel_points, tolerance=1e9, **settings
    )
    assert misplaced(A(x), mph.Projector(grid, A.views, rays)(x)) < bound


def test_threads_change_nothing(rng):
    grid = mph.Grid.centered((12, 12, 12), 4.0)
    views, model = SYSTEM.views((16, 16)), mph.Emission(SYSTEM, hole="depth")
    one, three = (mph.Projector(grid, views, model, threads=n) for n in (1, 3))
    x, y = rng.random(grid.shape), rng.random(one.shape_out)
    np.testing.assert_array_equal(one(x), three(x))
    np.testing.assert_array_equal(one.T(y), three.T(y))


def test_real_detectors_images_are_inverted(rng):
    assert_real_is_virtual(mph.Emission(SYSTEM, hole="depth"), rng)


@pytest.mark.parametrize("backend", ["cpu", "numpy"])
def test_attenuated_it_agrees_with_rays(backend, rng):
    """An active ball, off the middle of a water cylinder on a grid of its own; and the adjoint."""
    n = 20 if backend == "cpu" else 8
    grid = mph.Grid.centered((n, n, n), 60 / n)
    water = mph.Grid.centered((40, 40, 40), 4.0, (1.0, 2.0, 3.0))
    x, y, _ = np.moveaxis(voxel_centers(water), -1, 0)
    mu = mph.Volume((np.hypot(x, y) < 60) * 0.0154, water, "mu")
    A = depth_projector(grid, 24, backend, mu=mu)
    assert_adjoint(A, rng)
    if backend == "cpu":
        middle = np.linalg.norm(voxel_centers(grid) - (10, 5, 0), axis=-1) < 15
        rays = mph.Emission(SYSTEM, mu, aperture_points=61, pixel_points=13, tolerance=0.2)
        exact = mph.Projector(grid, A.views, rays)(middle.astype(float))
        assert np.abs(A(middle.astype(float)) - exact).sum() < 0.01 * exact.sum()


@pytest.mark.parametrize("wide", [4.0, 80.0, 500.0])
def test_every_voxel_loses_photons_however_wide_those_of_mu_are(wide):
    """Behind a slab of mu, of voxels as wide as this, exp(-mu d / cos(psi)) are left."""
    system = one_module()
    n = max(1, round(120 / wide))
    slab = mph.Volume(
        np.full((1, n, n), 0.02), mph.Grid.centered((1, n, n), (40.0, wide, wide), (60.0, 0.0, 0.0)), "mu"
    )
    grid = mph.Grid.centered(24, 1.5)
    bare, behind = (depth_projector(grid, 32, system=system, mu=mu).T(np.ones((1, 32, 32))) for mu in (None, slab))
    x, y, z = np.moveaxis(voxel_centers(grid), -1, 0)
    secant = np.sqrt(1 + (y**2 + z**2) / (200 - x) ** 2)
    np.testing.assert_allclose(behind / bare, np.exp(-0.02 * 40 * secant), rtol=1e-3)


def test_so_near_to_a_pinhole_rays_take_over(rng):
    """A grid around pinholes: what "auto" leaves to rays has their images, and the adjoint is exact."""
    affine = np.eye(4)
    affine[:3, :3] = 8 * rotation(rng)
    affine[:3, 3] = 0.8 * SYSTEM.centers[0] - affine[:3, :3] @ np.array([12, 11, 10])
    grid = mph.Grid((25, 23, 21), affine)
    views = SYSTEM.views((24, 20))
    mu = mph.Volume(np.where(rng.random(grid.shape) < 0.5, 0.01, 0.0), grid, "mu")
    A = mph.Projector(grid, views, mph.Emission(SYSTEM, mu, intrinsic_fwhm=1.0))
    assert_adjoint(A, rng)
    rays = mph.Projector(grid, views, mph.Emission(SYSTEM, mu, hole="rays", aperture_points=19, pixel_points=9,
                                                   tolerance=1e9, intrinsic_fwhm=1.0))  # fmt: skip
    x = rng.random(grid.shape) * (np.linalg.norm(voxel_centers(grid) - SYSTEM.centers[0], axis=-1) < 60)
    found, expected = A(x)[0], rays(x)[0]
    assert expected.sum() > 0
    assert np.abs(found - expected).sum() < 0.03 * expected.sum()


@pytest.mark.parametrize("backend", ["cpu", "numpy"])
def test_attenuation_given_in_the_call_is_that_of_the_model(backend, rng):
    grid, own = general_grid(rng, (9, 8, 7)), general_grid(rng, (5, 4, 6))
    mu, other = (mph.Volume(rng.uniform(0, 0.05, own.shape), own, "mu") for _ in range(2))
    A, expected = (depth_projector(grid, 12, backend, mu=each) for each in (mu, other))
    x, y = rng.random(grid.shape), rng.random(A.shape_out)
    assert np.abs(A(x) - expected(x)).max() > 1e-3 * expected(x).max()
    np.testing.assert_array_equal(A(x, mu=other.array), expected(x))
    np.testing.assert_array_equal(A(x), A(x, mu=mu.array))
    torch = pytest.importorskip("torch")
    x = torch.tensor(x, requires_grad=True)
    (A(x, mu=torch.tensor(other.array)) * torch.tensor(y)).sum().backward()
    np.testing.assert_allclose(x.grad, expected.T(y), rtol=1e-6)


@pytest.mark.parametrize(("size", "settings"), [
    pytest.param(130.0, {}, marks=pytest.mark.long), (8.0, {**DEEP, **EDGE, "hole": "depth"}),
])  # fmt: skip
def test_gradients_by_attenuation_and_activity_are_central_differences(size, settings, rng):
    """Also where some voxels are so close to a pinhole that rays project them."""
    torch = pytest.importorskip("torch")
    grid = mph.Grid.centered((5, 5, 5), size)
    views, mu = SYSTEM.views((6, 6)), mph.Volume(np.zeros(grid.shape), grid, "mu")
    A = mph.Projector(grid, views, mph.Emission(SYSTEM, mu, **settings), double=True)
    assert bool(A._close_parts) == (size == 130.0)
    x, values = (torch.tensor(rng.uniform(0, largest, grid.shape), requires_grad=True) for largest in (1, 0.1 / size))
    weights, along, step = torch.tensor(rng.random(A.shape_out)), torch.tensor(rng.random(grid.shape)), 1e-6
    (A(x, mu=values) * weights).sum().backward()
    activity, mu_values = x.detach(), values.detach()
    ahead, behind = ((A(activity, mu=mu_values + sign * step * along) * weights).sum() for sign in (1, -1))
    np.testing.assert_allclose((values.grad * along).sum(), (ahead - behind) / (2 * step), rtol=1e-6)
    np.testing.assert_allclose((x.grad * along).sum(), (A(along, mu=mu_values) * weights).sum(), rtol=1e-9)


def test_a_batch_is_each_alone(rng):
    grid = mph.Grid.centered((9, 8, 7), 6.0)
    mu = mph.Volume(rng.uniform(0, 0.02, grid.shape), grid, "mu")
    check_batch(depth_projector(grid, 10, mu=mu), rng, (2,))


@pytest.mark.parametrize("settings", [{}, EDGE])
def test_a_part_of_a_volume_has_its_part_of_the_images(settings, rng):
    """What is empty is left out, and changes nothing, whatever was projected before."""
    grid, views = general_grid(rng, (20, 18, 16)), SYSTEM.views((40, 40))
    mu = None if settings else mph.Volume(rng.uniform(0, 0.02, grid.shape), grid, "mu")
    model = mph.Emission(SYSTEM, mu, hole="depth", **settings)
    x, part = rng.random(grid.shape), np.zeros(grid.shape)
    part[7:12, :, 5:9] = x[7:12, :, 5:9]
    A = mph.Projector(grid, views, model, double=True)
    small, rest, whole = A(part), A(x - part), A(x)
    np.testing.assert_allclose(small + rest, whole, rtol=0, atol=(1e-12 if settings else 1e-4) * whole.max())
    np.testing.assert_array_equal(mph.Projector(grid, views, model, double=True)(part), small)


@pytest.mark.parametrize("changes", [
    {"edge": "path", "aperture_mu": 3.0, "aperture_points": 4}, {"pixel_points": 4}, {"aperture_points": 5},
    {"aperture_tolerance": 0.3}, {"crystal_mu": 0.2, "depth_layers": 2, "pixel_points": 4},
])  # fmt: skip
@pytest.mark.long
def test_by_itself_it_takes_rays_where_depth_cannot_be_and_where_they_are_asked_for(changes, rng):
    grid, views = mph.Grid.centered((6, 6, 6), 8.0), SYSTEM.views((8, 8))
    x, common = rng.random(grid.shape), {"tolerance": 1e9, **changes}
    found, rays = (
        mph.Projector(grid, views, mph.Emission(SYSTEM, hole=hole, **common))(x) for hole in ("auto", "rays")
    )
    np.testing.assert_array_equal(found, rays)


def test_a_hole_is_a_hole_unless_a_point_is_asked_for(rng):
    grid, views = mph.Grid.centered((6, 6, 6), 4.0), SYSTEM.views((64, 64))
    x = np.zeros(grid.shape)
    x[3, 3, 3] = 1
    plain, depth, point = (mph.Projector(grid, views, mph.Emission(SYSTEM, **hole))(x)
                           for hole in ({}, {"hole": "depth"}, {"hole": "point"}))  # fmt: skip
    np.testing.assert_array_equal(plain, depth)
    assert plain.max() < 0.6 * point.max()
    assert plain.sum() == pytest.approx(point.sum(), rel=0.02)


def test_what_it_does_not_take_is_refused():
    near = depth_projector(mph.Grid.centered((4, 4, 4), 90.0), 8)
    for call, *words in (
        (lambda: mph.Emission(SYSTEM, hole="cone"), "hole: expected 'auto', 'depth', 'rays' or 'point'"),
        (lambda: mph.Emission(SYSTEM, hole="depth", aperture_points=7), "hole 'depth' takes no points"),
        (lambda: mph.Emission(SYSTEM, hole="point", aperture_points=7), "hole 'point' takes no points"),
        (lambda: near(np.ones(near.shape_in)), "take a smaller grid", "hole 'auto' or 'rays'"),
    ):
        refused(call, *words)


def transmitted(mu, edges, at, m, n=40_000):
    """Return the mean exp(-integral of mu) of straight photons from anywhere in a voxel through anywhere in the hole."""
    u, v, _ = SYSTEM.frames()[m]
    sequence = (0.5 + np.arange(n)[:, None] / 1.1673039782614187 ** np.arange(1, 6)) % 1  # R5 of M. Roberts
    points = (sequence[:, :3] - 0.5) @ edges.T + at
    radius, angle = SYSTEM.pinhole_diameter[m] / 2 * np.sqrt(sequence[:, 3]), 2 * np.pi * sequence[:, 4]
    hole = SYSTEM.centers[m] + np.outer(radius * np.cos(angle), u) + np.outer(radius * np.sin(angle), v)
    return float(np.exp(-mph.trace_rays(mu, hole, points).astype(float)).mean())


def worst_share_off(mu, grid, region, rng, n):
    """Return the largest relative error of the transmittance of photons from `n` voxels of a region."""
    views, errors = SYSTEM.views((64, 64)), []
    attenuated, free = (mph.Projector(grid, views, mph.Emission(SYSTEM, each)) for each in (mu, None))
    for index in rng.permutation(np.argwhere(region))[:n]:
        x = np.zeros(grid.shape, np.float32)
        x[tuple(index)] = 1
        left = attenuated(x).sum(axis=(1, 2), dtype=float) / free(x).sum(axis=(1, 2), dtype=float)
        at = grid.affine[:3, :3] @ index + grid.affine[:3, 3]
        errors += [abs(left[m] / transmitted(mu, grid.affine[:3, :3], at, m) - 1) for m in range(len(SYSTEM))]
    return max(errors)


@pytest.mark.parametrize(
    ("coefficient", "size", "voxel"),
    [(0.028, 2.0, 3.0), pytest.param(0.06, 2.0, 2.0, marks=pytest.mark.long)],
)
def test_attenuation_of_a_thin_shell_beside_air_is_within_one_per_cent(coefficient, size, voxel, rng):
    spheres = [mph.Sphere(radius=radius, mu=value) for radius, value in ((40, coefficient), (36, 0))]
    shapes = [mph.Cylinder(radius=70, height=140, mu=0.0154), *spheres]
    mu = mph.ShapePhantom(shapes).voxelize(mph.Grid.centered(round(150 / size), size), quantity="mu")
    grid = mph.Grid.centered(round(100 / voxel), voxel, (0.3, 0.4, -0.2))
    radius = np.linalg.norm(voxel_centers(grid), axis=-1)
    assert worst_share_off(mu, grid, (radius > 30) & (radius < 44), rng, 15) < 0.01


@pytest.mark.long
def test_attenuation_of_a_chest_is_within_one_per_cent(rng):
    if not CHEST.exists():
        pytest.skip("no chest CT")
    mu = mph.hu_to_mu(mph.read_volume(CHEST))
    affine = mu.grid.affine.copy()
    affine[:3, 3] -= mu.grid.center
    grid = mph.Grid(mu.grid.shape, affine)
    middle = np.linalg.norm(voxel_centers(grid), axis=-1) < 75
    assert worst_share_off(mph.Volume(mu.array, grid, "mu"), grid, middle, rng, 40) < 0.01
