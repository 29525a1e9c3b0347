"""Derivatives by the geometry of the depth-dependent response: central differences, in numpy and in torch."""

from __future__ import annotations

import numpy as np
import pytest

import mphdrr.core as mph

from .conftest import dc_spect, refused

SYSTEM = dc_spect()[[0, 21, 47]]
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


def system_for(settings):
    """Return one module where kernels depend on the direction, which takes long."""
    return SYSTEM[:1] if {"edge", "depth_layers"} & settings.keys() else SYSTEM


MU = mph.Volume(np.random.default_rng(2).uniform(0, 0.02, (5, 6, 5)), mph.Grid.centered((5, 6, 5), 11.0), "mu")
STEPS = {
    "collimator_length": 1e-3, "pinhole_diameter": 1e-5, "centers": 1e-4, "tilt": 1e-6, "pitch": 1e-5, "offset": 1e-4,
}  # fmt: skip
DIRECTED = {"edge": "path", "depth_layers": 2}


@pytest.mark.parametrize(("settings", "small"), [
    ({}, 1), ({"detector": "virtual"}, 1), ({"intrinsic_fwhm": 3.0}, 1), ({"within_crystal": True}, 1),
    ({"depth_layers": 2}, 1e-2), ({"mu": MU}, 1e-3),
    *(pytest.param(settings, small, marks=pytest.mark.long) for settings, small in (
        ({**DIRECTED, "plate_thickness": 3.5, "within_walls": True}, 1e-1), ({"edge": "path"}, 1e-2), (DIRECTED, 1e-2),
        ({**DIRECTED, "mu": MU}, 1e-3))),
])  # fmt: skip
def test_derivatives_are_central_differences(settings, small, rng):
    """Places, tilts, collimators, holes, pixels and the image's middle: each within 1e-6 of the largest of its kind.

    Where a faint tap of a kernel is left out or not, or rays pass from voxel to voxel, a small step is taken by all at once.
    """
    system = SYSTEM if small < 0.1 and "mu" not in settings else system_for(settings)
    x, weights = numbers(rng, len(system))
    gradient = mph.geometry_gradient(projector(system, **settings), x, weights)
    centers, tilt = gradient.by_columns(system)
    gradient = {**gradient._asdict(), "centers": centers, "tilt": tilt}
    values = {"pitch": PITCH, "offset": OFFSET}
    values |= {name: getattr(system, name) for name in STEPS if name not in values}
    along = {name: small * step * rng.normal(size=np.shape(values[name])) for name, step in STEPS.items()}

    def sums(names, sign):
        changes = {name: values[name] + sign * along[name] for name in names}
        optics = {name: changes.pop(name) for name in ("pitch", "offset") if name in changes}
        return (projector(system.replace(**changes), **optics, **settings)(x) * weights).sum(axis=(1, 2))

    for names in [[name] for name in STEPS] if small >= 0.1 else [list(STEPS)]:
        exact = sum((gradient[name] * along[name]).reshape(len(system), -1).sum(axis=1) for name in names)
        difference = (sums(names, 1) - sums(names, -1)) / 2
        np.testing.assert_allclose(exact, difference, rtol=0, atol=1e-6 * np.abs(exact).max(), err_msg=str(names))


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
