"""Gradients of counts in torch: by the activity, its attenuation and the camera."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed")

import mphdrr.core as mph  # noqa: E402
from mphdrr.core.errors import InputError  # noqa: E402
from mphdrr.core.geometry.rotations import se3_exp  # noqa: E402
from mphdrr.core.physics.crystal import gaussian_blur  # noqa: E402
from mphdrr.core.projector.torch_cameras import emission_images  # noqa: E402

from .conftest import BACKENDS, emission, general_grid, refused  # noqa: E402
from .test_emission import mu_grids, some_mu  # noqa: E402


def grid_of_mu(which, grid, rng):
    """Return the activity's grid, or one that is larger, coarser and rotated."""
    return mu_grids(grid, rng)[("shared", "own").index(which)]


def camera(system, m=3):
    pose = torch.tensor(system.poses()[m])
    return pose[:3, 3], pose[:3, :3], float(system.collimator_length[m])


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("which", ["shared", "own"])
def test_mu_given_is_the_models_mu(backend, which, system, rng):
    """A(x, mu) equals the images of a model with that mu, for arrays and tensors; likewise its adjoint."""
    grid = general_grid(rng, (9, 8, 7))
    x = rng.random(grid.shape).astype(np.float32)
    views = system[3:5].views((10, 11), pitch=5.0)
    mu_grid = grid_of_mu(which, grid, rng)
    mu, other = some_mu(rng, mu_grid), some_mu(rng, mu_grid)
    A, expected = (mph.Projector(grid, views, emission(system[3:5], m), backend) for m in (mu, other))
    y = expected(x)
    assert np.abs(y - A(x)).max() > 1e-3 * y.max()
    for given in (other.array, torch.tensor(other.array)):
        for volume in (x, torch.tensor(x), mph.Volume(x, grid, "activity")):
            got = A(volume, mu=given)
            assert isinstance(got, torch.Tensor) == isinstance(given, torch.Tensor) | isinstance(volume, torch.Tensor)
            np.testing.assert_allclose(got, y, rtol=1e-6)
    values = torch.rand(A.shape_out)
    volume = torch.tensor(x, requires_grad=True)
    (A(volume, mu=other.array) * values).sum().backward()
    np.testing.assert_allclose(volume.grad, expected.T(values), rtol=1e-5, atol=1e-5 * float(volume.grad.abs().max()))


@pytest.mark.parametrize("backend", ["numpy", pytest.param("torch", marks=pytest.mark.long)])
@pytest.mark.parametrize("which", ["shared", "own"])
def test_gradcheck_by_activity_and_mu(backend, which, system, rng):
    """Also of the whole camera, whose rays start in several points and whose images are blurred."""
    grid = general_grid(rng, (3, 2, 4))
    mu = some_mu(rng, grid_of_mu(which, grid, rng))
    model = emission(system[3:4], mu, time=1e4, aperture_points=3, crystal_mu=0.1, intrinsic_fwhm=6.0)
    A = mph.Projector(grid, system[3:4].views((3, 3), pitch=10.0), model, backend, threads=2)
    x = torch.tensor(rng.random(grid.shape), requires_grad=True)
    values = torch.tensor(mu.array + 0.01, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x, mu: torch.log1p(A(x, mu=mu)), (x, values), atol=1e-6, rtol=1e-6)
    assert torch.autograd.gradgradcheck(lambda x: A(x, mu=values.detach()) ** 2, (x,))


@pytest.mark.parametrize("backend", BACKENDS[1:])
@pytest.mark.parametrize("which", ["shared", "own"])
def test_backends_agree_on_gradients_by_mu(backend, which, system, rng):
    """Wherever a ray passes in front of activity, also in air and outside the activity's box, for any number of threads."""
    grid = general_grid(rng, (9, 8, 7))
    x = np.zeros(grid.shape, np.float32)
    x[3:6, 2:5, 2:6] = rng.random((3, 3, 4))
    mu = some_mu(rng, grid_of_mu(which, grid, rng))
    views = system[3:6].views((12, 13), pitch=4.0)
    weights = torch.rand((3, 12, 13), dtype=torch.float64)
    gradients = []
    for name, threads in (("numpy", 1), ("numpy", 3), (backend, 1), (backend, 3)):
        A = mph.Projector(grid, views, emission(system[3:6], mu), name, threads)
        values = torch.tensor(mu.array, requires_grad=True)
        (A(x, mu=values) * weights).sum().backward()
        gradients.append(values.grad)
    reference = gradients[0]
    assert (reference[mu.array == 0] < 0).any() and (reference <= 0).all()
    for gradient in gradients[1:]:
        torch.testing.assert_close(gradient, reference, rtol=2e-5, atol=2e-5 * float(reference.abs().max()))


def test_what_is_no_mu_is_refused(system, rng):
    grid = general_grid(rng, (4, 3, 2))
    views, mu = system[:1].views((2, 2)), some_mu(rng, grid)
    x = np.ones(grid.shape)
    A = mph.Projector(grid, views, emission(system[:1], mu))
    without = mph.Projector(grid, views, emission(system[:1]))
    point = torch.zeros(3)
    for call, word in (
        (lambda: without(x, mu=x), "none"),
        (lambda: A(x, mu=np.ones((2, 2, 2))), "4 x 3 x 2"),
        (lambda: A(x, mu=-x), "negative"),
        (lambda: A(x, mu=torch.tensor(x * np.nan)), "finite"),
        (lambda: mph.trace_rays(x, point, point, grid=grid, mu=-x), "negative"),
        (lambda: mph.trace_rays(x, point, point, grid=grid, mu=np.ones(3)), "mu"),
        (lambda: mph.trace_rays(x, point, point, grid=grid, mu=mu, mu_grid=general_grid(rng, (4, 3, 2))), "mu"),
        (lambda: mph.trace_rays(x, point, point, grid=grid, mu=mph.Volume(x, grid, "hu")), "hu"),
    ):
        refused(call, word)


def test_gradients_of_gradients_by_mu_are_refused(system, rng):
    grid = general_grid(rng, (4, 3, 2))
    A = mph.Projector(grid, system[:1].views((4, 4)), emission(system[:1], some_mu(rng, grid)), "torch")
    x, mu = (torch.rand(grid.shape, requires_grad=True) for _ in range(2))
    (gradient,) = torch.autograd.grad(A(x, mu=mu).sum(), x, create_graph=True)
    with pytest.raises(InputError, match="create_graph"):
        torch.autograd.grad(gradient.sum(), mu)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("which", [None, "shared", "own"])
def test_images_are_those_of_the_projector(backend, which, system, rng):
    """All cameras at once: real detectors' images are point-inverted, virtual ones' scaled."""
    grid = general_grid(rng, (9, 8, 7))
    activity = mph.Volume(rng.random(grid.shape), grid, "activity")
    mu = which and some_mu(rng, grid_of_mu(which, grid, rng))
    same = {"time": 20.0, "photons_per_decay": 0.9, "aperture_points": 4, "pixel_points": 1, "crystal_mu": 0.1}
    model = emission(system, mu, aperture_mu=3.0, intrinsic_fwhm=0.8, **same)
    poses = torch.tensor(system.poses())
    parts = model.pixel_parts(system.views((9, 8), "real", pitch=(0.4, 0.6), offset=(-0.1, 0.2)), grid)
    got = emission_images(
        activity, poses[:, :3, 3], poses[:, :3, :3], torch.tensor(system.collimator_length),
        [0.4 / parts, 0.6 / parts], (9 * parts, 8 * parts), [0.1, -0.2],
        diameter=torch.tensor(model.effective_diameter), crystal_thickness=torch.tensor(system.detector_thickness),
        mu=mu, backend=backend, **same,
    ).numpy()  # fmt: skip
    along_v, along_u = (gaussian_blur(n, 0.8 / 2.35482 / pitch, parts) for n, pitch in ((9, 0.6), (8, 0.4)))
    got = along_v @ got @ along_u.T
    virtual = system.views((9, 8), "virtual", 10.0, pitch=(4.0, 6.0), offset=(1.0, -2.0))
    real = system.views((9, 8), "real", pitch=(0.4, 0.6), offset=(-0.1, 0.2))
    for views, images in ((virtual, got), (real, got[:, ::-1, ::-1])):
        expected = mph.Projector(grid, views, model, backend)(activity)
        np.testing.assert_allclose(images, expected, rtol=1e-5, atol=1e-5 * expected.max())


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("which", ["shared", "own"])
def test_gradient_by_every_number_of_a_camera(backend, which, system, rng):
    """Pose, collimator length, pitch, principal point and hole against central differences, through matter."""
    grid = general_grid(rng, (8, 7, 6))
    smooth = np.multiply.outer(np.multiply.outer(np.hanning(8), np.hanning(7)), np.hanning(6))
    activity = mph.Volume(smooth, grid, "activity")
    mu_grid = grid_of_mu(which, grid, rng)
    mu = mph.Volume(rng.uniform(0.005, 0.03, mu_grid.shape), mu_grid, "mu")
    position, rotation, l = camera(system)
    base = torch.eye(4, dtype=torch.float64)
    base[:3, :3], base[:3, 3] = rotation, position
    rows, columns = torch.meshgrid(*[torch.linspace(0, 3, 8, dtype=torch.float64)] * 2, indexing="ij")
    weights = 1 + torch.sin(rows) * torch.cos(columns)

    def loss(p):
        pose = se3_exp(p[:6]) @ base
        image = emission_images(
            activity, pose[:3, 3], pose[:3, :3], l * torch.exp(p[6]), 0.9 * torch.exp(p[7]), (8, 8), p[8:10],
            diameter=2 * torch.exp(p[10]), aperture_points=3, pixel_points=2, crystal_mu=0.1, crystal_thickness=10.0,
            time=1e5, mu=mu, backend=backend,
        )  # fmt: skip
        return (image * weights).sum()

    parameters = torch.zeros(11, dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(loss(parameters), parameters)
    steps = 1e-6 * torch.eye(11, dtype=torch.float64)
    with torch.no_grad():
        difference = torch.stack([(loss(s) - loss(-s)) / (2 * s.sum()) for s in steps])
    assert gradient.abs().min() > 0
    np.testing.assert_allclose(gradient, difference, rtol=1e-3)


def test_bad_cameras_are_one_clear_line(system, rng):
    grid = general_grid(rng, (4, 3, 2))
    activity = torch.ones(grid.shape)
    position, rotation, l = camera(system)
    good = {"volume": activity, "collimator_length": l, "pitch": 1.0, "diameter": 2.0, "grid": grid}
    for wrong, word in (
        ({"grid": None}, "grid"),
        ({"collimator_length": -1.0}, "collimator_length"),
        ({"pitch": torch.tensor([1.0, 0.0])}, "pitch"),
        ({"diameter": torch.ones(2, 3)[:, None], "collimator_length": torch.ones(2)}, "rays"),
        ({"aperture_points": 2}, "aperture_points"),
        ({"crystal_mu": 0.1}, "crystal_thickness"),
    ):
        given = good | wrong
        refused(
            lambda given=given: emission_images(positions=position, rotations=rotation, shape=(2, 2), **given), word
        )
