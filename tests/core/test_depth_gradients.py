"""Derivatives by the geometry of the depth-dependent response: central differences, in numpy and in torch."""

from __future__ import annotations

import numpy as np
import pytest

import mphdrr.core as mph

from .conftest import WORKBOOK, refused

SYSTEM = mph.read_system(WORKBOOK)[[0, 21, 47]]
SYSTEM = SYSTEM.replace(tilt=0.02 * np.random.default_rng(1).normal(size=(3, 3)))
GRID = mph.Grid.centered((9, 8, 7), 7.0, center=(4.0, -3.0, 2.0))
SHAPE, PITCH, OFFSET = (15, 13), np.array([3.2, 3.4]), np.array([1.0, 2.0])
PHYSICS = {"aperture_mu": 3.0, "crystal_mu": 0.3, "photons_per_decay": 0.9}


def projector(system=SYSTEM, detector="real", pitch=PITCH, offset=OFFSET, double=True, **model):
    scale = 1 if detector == "real" else 10
    views = system.views(SHAPE, detector, 10.0, scale * pitch, scale * offset)
    return mph.Projector(GRID, views, mph.Emission(system, hole="depth", **{**PHYSICS, **model}), double=double)


def numbers(rng, modules=3):
    return rng.random(GRID.shape), rng.random((modules, *SHAPE))


def by_direction(settings):
    return "edge" in settings or "depth_layers" in settings


def system_for(settings):
    """One module where kernels depend on the direction, which takes long."""
    return SYSTEM[:1] if by_direction(settings) else SYSTEM


def difference(sums, step):
    return (sums(step) - sums(-step)) / (2 * step)


@pytest.mark.parametrize("settings", [
    {}, {"detector": "virtual"}, {"intrinsic_fwhm": 3.0}, {"within_crystal": True},
    pytest.param({"edge": "path", "plate_thickness": 3.5, "depth_layers": 2, "within_walls": True}, marks=pytest.mark.long),
])  # fmt: skip
def test_derivatives_are_central_differences(settings, rng):
    """By places, tilts, collimators, holes, pixels and the image's middle, each within 1e-6 of the largest of its kind.

    Where kernels depend on the direction steps are smaller: at many places a faint tap is left out or not.
    """
    system = system_for(settings)
    x, weights = numbers(rng, len(system))
    small = 0.1 if by_direction(settings) else 1.0

    def sums(system=system, **changes):
        return (projector(system, **{**settings, **changes})(x) * weights).sum(axis=(1, 2))

    gradient = mph.geometry_gradient(projector(system, **settings), x, weights)
    by_centers, by_tilt = gradient.by_columns(system)
    found = {"l": gradient.collimator_length, "d": gradient.pinhole_diameter}
    expected = {
        "l": difference(lambda e: sums(system.replace(collimator_length=system.collimator_length + e)), 1e-3 * small),
        "d": difference(lambda e: sums(system.replace(pinhole_diameter=system.pinhole_diameter + e)), 1e-5 * small),
    }
    for i, axis in enumerate(np.eye(3)):
        found |= {f"center {i}": by_centers[:, i], f"tilt {i}": by_tilt[:, i]}
        expected[f"center {i}"] = difference(
            lambda e, a=axis: sums(system.replace(centers=system.centers + e * a)), 1e-4 * small
        )
        expected[f"tilt {i}"] = difference(
            lambda e, a=axis: sums(system.replace(tilt=system.tilt + e * a)), 1e-6 * small
        )
    for i, axis in enumerate(np.eye(2)):
        found |= {f"pitch {i}": gradient.pitch[:, i], f"offset {i}": gradient.offset[:, i]}
        expected[f"pitch {i}"] = difference(lambda e, a=axis: sums(pitch=PITCH + e * a), 1e-5 * small)
        expected[f"offset {i}"] = difference(lambda e, a=axis: sums(offset=OFFSET + e * a), 1e-4 * small)
    for name, own in found.items():
        np.testing.assert_allclose(own, expected[name], rtol=0, atol=1e-6 * np.abs(expected[name]).max(), err_msg=name)


@pytest.mark.parametrize("settings", [
    pytest.param({"edge": "path"}, marks=pytest.mark.long), {"depth_layers": 2},
    pytest.param({"edge": "path", "depth_layers": 2}, marks=pytest.mark.long),
])  # fmt: skip
def test_all_numbers_at_once_where_kernels_depend_on_the_direction(settings, rng):
    x, weights = numbers(rng)
    by_l, by_d, by_center, by_tilt, by_pitch, by_offset = (
        rng.normal(size=shape) for shape in (3, 3, (3, 3), (3, 3), 2, 2)
    )

    def sums(e):
        system = SYSTEM.replace(
            collimator_length=SYSTEM.collimator_length + e * by_l,
            pinhole_diameter=SYSTEM.pinhole_diameter + 0.1 * e * by_d,
            centers=SYSTEM.centers + e * by_center,
            tilt=SYSTEM.tilt + 0.01 * e * by_tilt,
        )
        A = projector(system, pitch=PITCH + 0.1 * e * by_pitch, offset=OFFSET + e * by_offset, **settings)
        return (A(x) * weights).sum(axis=(1, 2))

    found = mph.geometry_gradient(projector(**settings), x, weights)
    centers, tilt = found.by_columns(SYSTEM)
    along = found.collimator_length * by_l + 0.1 * found.pinhole_diameter * by_d
    along += (centers * by_center + 0.01 * tilt * by_tilt).sum(axis=1)
    along += 0.1 * found.pitch @ by_pitch + found.offset @ by_offset
    np.testing.assert_allclose(along, difference(sums, 1e-6), rtol=0, atol=1e-6 * np.abs(along).max())


@pytest.mark.parametrize("settings", [{}, pytest.param({"edge": "path", "depth_layers": 2}, marks=pytest.mark.long)])
def test_attenuated_too(settings, rng):
    """What passes moves with the pinhole alone. The step is small: rays pass from voxel to voxel at many places."""
    system = system_for(settings)
    x, weights = numbers(rng, len(system))
    grid = mph.Grid.centered((5, 6, 5), 11.0)
    mu = mph.Volume(rng.uniform(0, 0.02, grid.shape), grid, "mu")

    def sums(**changes):
        return (projector(system.replace(**changes), mu=mu, **settings)(x) * weights).sum(axis=(1, 2))

    by_centers, by_tilt = mph.geometry_gradient(projector(system, mu=mu, **settings), x, weights).by_columns(system)
    plain, _ = mph.geometry_gradient(projector(system, **settings), x, weights).by_columns(system)
    for i, axis in enumerate(np.eye(3)):
        centers = difference(lambda e, a=axis: sums(centers=system.centers + e * a), 1e-7)
        tilt = difference(lambda e, a=axis: sums(tilt=system.tilt + e * a), 1e-6)
        np.testing.assert_allclose(by_centers[:, i], centers, atol=2e-6 * np.abs(by_centers).max())
        np.testing.assert_allclose(by_tilt[:, i], tilt, atol=2e-6 * np.abs(by_tilt).max())
    assert np.abs(plain - by_centers).max() > 0.1 * np.abs(by_centers).max()


@pytest.mark.long
@pytest.mark.parametrize("settings", [{}, {"edge": "path", "depth_layers": 2}])
def test_the_reference_and_float32_agree_with_it(settings, rng):
    system = system_for(settings)
    x, weights = numbers(rng, len(system))
    A = projector(system, **settings)
    exact = mph.geometry_gradient(A, x, weights)
    reference = mph.Projector(GRID, A.views, A.model, "numpy")
    for other, bound in ((reference, 1e-7), (projector(system, double=False, **settings), 1e-4)):
        for name, own, expected in zip(exact._fields, mph.geometry_gradient(other, x, weights), exact, strict=True):
            np.testing.assert_allclose(own, expected, atol=bound * np.abs(expected).max(), err_msg=name)


def test_of_a_batch_it_is_the_sum(rng):
    (x, weights), (other, more) = numbers(rng), numbers(rng)
    A = projector(intrinsic_fwhm=3.0)
    both = mph.geometry_gradient(A, np.stack([x, other]), np.stack([weights, more]))
    each = mph.geometry_gradient(A, x, weights), mph.geometry_gradient(A, other, more)
    for own, first, second in zip(both, *each, strict=True):
        np.testing.assert_allclose(own, first + second, rtol=0, atol=1e-9 * np.abs(own).max())
    refused(lambda: mph.geometry_gradient(A, np.stack([x, other]), weights), "2 volumes", "of 1")


@pytest.mark.parametrize("settings", [{}, pytest.param({"depth_layers": 2}, marks=pytest.mark.long)])
def test_a_part_of_the_volume_has_its_part_of_them(settings, rng):
    system = system_for(settings)
    x, weights = numbers(rng, len(system))
    part = np.zeros_like(x)
    part[2:5, 3:7, 1:4] = x[2:5, 3:7, 1:4]
    A = projector(system, **settings)
    for parts in zip(*(mph.geometry_gradient(A, each, weights) for each in (part, x - part, x)), strict=True):
        np.testing.assert_allclose(parts[0] + parts[1], parts[2], atol=1e-6 * np.abs(parts[2]).max())


BY_DIRECTION = {"edge": "path", "crystal_mu": 0.3, "depth_layers": 2, "crystal_thickness": 9.0}


@pytest.mark.parametrize("settings", [{}, pytest.param(BY_DIRECTION, marks=pytest.mark.long)])
def test_in_torch_all_numbers_have_gradients(settings, rng):
    """Gradcheck of the images by activity, mu, place, turn, l, d, pixels, the image's middle, time and penetration."""
    torch = pytest.importorskip("torch")
    from mphdrr.core.projector.torch_cameras import emission_images

    grid, mu_grid = mph.Grid.centered((2, 2, 2), 12.0), mph.Grid.centered((2, 2, 2), 15.0)
    given = [
        rng.random(grid.shape), rng.uniform(0, 0.01, mu_grid.shape), [[0.7, 0.3, -80.0], [2.0, 1.0, -85.0]],
        [[0.01, 0.02, 0.1], [0.1, -0.03, 0.02]], [60.0, 50.0], [3.0, 2.5], [[5.0, 5.2], [5.4, 5.0]],
        [[0.1, 0.2], [0.3, -0.4]], [2.0, 3.0], 3.0,
    ]  # fmt: skip
    if settings:  # of one module
        given = [*given[:2], *(each[:1] for each in given[2:-1]), given[-1]]
    given = [torch.tensor(np.array(each), requires_grad=True) for each in given]
    if settings:  # by path, penetration has none
        given[-1].requires_grad_(False)

    def images(x, mu, place, turn, l, d, pitch, offset, time, aperture_mu):
        a, b, c = turn.unbind(-1)
        o = torch.zeros_like(a)
        cross = torch.stack([o, -c, b, c, o, -a, -b, a, o], -1).reshape(-1, 3, 3)
        return emission_images(
            x, place, torch.linalg.matrix_exp(cross), l, pitch, (5, 4), offset, diameter=d, time=time,
            mu=mu, mu_grid=mu_grid, grid=grid, hole="depth", aperture_mu=aperture_mu, photons_per_decay=0.9,
            **settings,
        )  # fmt: skip

    assert torch.autograd.gradcheck(images, given, eps=1e-7, rtol=1e-5, atol=1e-7, fast_mode=True)
    assert torch.autograd.gradcheck(
        lambda x, *more: images(x, None, *more), [given[0], *given[2:]], rtol=1e-6, atol=1e-8, fast_mode=True
    )


@pytest.mark.parametrize("settings", [{}, {"edge": "path", "plate_thickness": 4.0, "depth_layers": 2}])
def test_in_torch_it_is_the_projector(settings, rng):
    torch = pytest.importorskip("torch")
    from mphdrr.core.projector.torch_cameras import emission_images

    x, _ = numbers(rng)
    poses = torch.tensor(SYSTEM.poses())
    images = emission_images(
        torch.tensor(x), poses[:, :3, 3], poses[:, :3, :3], SYSTEM.collimator_length, torch.tensor(PITCH), SHAPE,
        torch.tensor(OFFSET), diameter=SYSTEM.pinhole_diameter, crystal_thickness=SYSTEM.detector_thickness, grid=GRID,
        hole="depth", **PHYSICS, **settings,
    )  # fmt: skip
    np.testing.assert_allclose(images, projector(detector="virtual", **settings)(x), rtol=1e-9)


def test_in_torch_penetration_by_path_has_none():
    torch = pytest.importorskip("torch")
    from mphdrr.core.projector.torch_cameras import emission_images

    volume = mph.Volume(np.ones((2, 2, 2)), mph.Grid.centered(2, 12.0), "activity")
    place = torch.tensor([0.7, 0.3, -80.0])
    for name, value in (("aperture_mu", 3.0), ("opening_angle", 1.2)):
        given = {"aperture_mu": 3.0, name: torch.tensor(value, requires_grad=True)}
        refused(
            lambda given=given: emission_images(
                volume, place, torch.eye(3), 60.0, 5.0, (5, 4), diameter=3.0, hole="depth", edge="path", **given
            ),
            "no derivatives by", name,
        )  # fmt: skip


def test_what_cannot_be_is_refused(rng):
    x, weights = numbers(rng)
    A = projector()
    rays = mph.Projector(GRID, A.views, mph.Emission(SYSTEM, hole="rays"))
    refused(lambda: mph.geometry_gradient(rays, x, weights), "hole 'depth'", "emission_images")
    refused(lambda: mph.geometry_gradient(A, x, weights[1:]), "images", "3 x 15 x 13")
    wide = mph.Grid.centered((5, 5, 5), 130.0)
    near = mph.Projector(wide, A.views, mph.Emission(SYSTEM))
    refused(lambda: mph.geometry_gradient(near, np.ones(wide.shape), weights), "too close", "smaller grid")
