"""Laws of the networks of learned reconstruction, at toy sizes."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed")
pytest.importorskip("monai", reason="MONAI is not installed")

import mphdrr.core as mph  # noqa: E402
from mphdrr.core.learning.networks import NETWORKS  # noqa: E402
from mphdrr.core.learning.networks.network import UNet, normalized_backprojection, relative_residual  # noqa: E402
from mphdrr.core.learning.networks.parallel import parallel_beam  # noqa: E402
from mphdrr.core.learning.setup import Sample, ScannerSetup  # noqa: E402

from .conftest import dc_spect  # noqa: E402

SMALL: dict[str, dict[str, Any]] = {
    "after-osem": {"channels": (4, 4, 4)},
    "cameras": {"channels": (4, 4, 4), "camera_channels": (4, 4, 4), "cameras": 3, "rounds": 2},
    "parallel": {"channels": (4, 4, 4), "angles": 12},
    "unrolled": {"channels": (4, 4, 4), "steps": 2, "through": True, "dual": True},
    "channels": {"channels": (4, 4, 4), "latent": 8, "views": 5, "pixels": (8, 8), "voxels": (8, 8, 8)},
}
TOLD = ["after-osem", "cameras", "parallel", "unrolled"]
GRID = mph.Grid.centered((8, 8, 8), 12.0)


@pytest.fixture(autouse=True, scope="module")
def one_thread():
    """Use one thread: at toy sizes several wait for each other longer than they work."""
    usual = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(usual)


@cache
def setup_of(every: int = 16, permuted: int | None = None, backend: str = "auto", **model: Any) -> ScannerSetup:
    """Return the setup of every n-th module; `model` are settings of its `Emission`."""
    system = dc_spect()[::every]
    views = system.views(shape=(8, 8), detector="real")
    return ScannerSetup(
        mph.Projector(GRID, views, mph.Emission(system, time=60.0, **model), backend, threads=1), 2, (1, 2, 3), permuted
    )


def scan(setup: ScannerSetup, seed: int = 1, level: float = 1.0, background: float = 1.0) -> Sample:
    """Return a scan of a few hot voxels."""
    rng = np.random.default_rng(seed)
    truth = np.zeros(GRID.shape, np.float32)
    truth[2:6, 2:6, 2:6] = rng.uniform(0, 100, (4, 4, 4))
    images = np.asarray(setup.A(truth))
    counts = rng.poisson(images * (40 / images.mean()) + background).astype(np.float32)
    return setup.sample(level * counts, np.full_like(counts, level * background), truth)


def network(kind: str, random: bool = True, **options: Any) -> torch.nn.Module:
    """Return a small network, of weights that are not those it begins with."""
    torch.manual_seed(3)
    model = NETWORKS[kind].load()(**{**SMALL[kind], **options})
    if random:
        with torch.no_grad():
            for parameter in model.parameters():
                parameter += 0.05 * torch.randn_like(parameter)
            if kind == "channels":
                parameter += 1  # the last layer's bias: volumes that are not 0 everywhere
    return model


def result(model: torch.nn.Module, setup: ScannerSetup, sample: Sample) -> torch.Tensor:
    model.eval()
    with torch.no_grad():
        return model(setup, sample)[-1]


def joined(*samples: Sample) -> Sample:
    return Sample(*(torch.cat(each) for each in zip(*samples, strict=True)))


@pytest.mark.parametrize("kind", NETWORKS)
def test_gradients_flow_to_all_parameters(kind):
    setup, model = setup_of(), network(kind).train()
    sum(x.square().mean() for x in model(setup, scan(setup))).backward()
    without = [name for name, p in model.named_parameters() if p.grad is None or not p.grad.abs().max() > 0]
    assert without == []


@pytest.mark.parametrize("kind", NETWORKS)
def test_gradients_are_those_of_finite_differences(kind):
    options = (
        {"save_memory": False} if kind == "unrolled" else {}
    )  # computed again, U-Nets would have their own weights
    # In float64 throughout, and of one ray for each pixel: any projector's gradient is its adjoint.
    setup = setup_of(backend="numpy", hole="point", pixel_points=1, tolerance=1e9)
    model = network(kind, **options).double().eval()
    sample = Sample(*(each.double() for each in scan(setup)))
    parameters = dict(model.named_parameters())
    sizes = [p.numel() for p in parameters.values()]

    def outputs(values: torch.Tensor) -> tuple[torch.Tensor, ...]:
        parts = zip(parameters.items(), values.split(sizes), strict=True)
        return tuple(torch.func.functional_call(model, {n: v.view_as(p) for (n, p), v in parts}, (setup, sample)))

    values = torch.cat([p.detach().flatten() for p in parameters.values()]).requires_grad_()
    assert torch.autograd.gradcheck(
        outputs, values, eps=1e-8, atol=1e-6, rtol=1e-4, fast_mode=True, check_undefined_grad=False
    )


@pytest.mark.parametrize("kind", NETWORKS)
def test_volumes_have_the_grids_shape_and_are_not_negative_in_use(kind):
    setup = setup_of()
    x = result(network(kind), setup, scan(setup))
    assert x.shape == (1, 1, *GRID.shape)
    assert x.min() >= 0 and x.max() > 0


@pytest.mark.parametrize("kind", ["after-osem", "cameras", "unrolled"])
def test_a_network_begins_with_the_volume_that_it_corrects(kind):
    setup = setup_of()
    sample = scan(setup)
    torch.testing.assert_close(result(network(kind, random=False), setup, sample), sample.osem[:, 1:2])


@pytest.mark.parametrize("kind", NETWORKS)
def test_more_counts_are_as_much_more_activity(kind):
    """Up to the halves that are added to counts."""
    setup, model = setup_of(), network(kind)
    few, many = scan(setup, level=1e4), scan(setup, level=1e5)
    np.testing.assert_allclose(many.scale / few.scale, 10, rtol=1e-3)
    torch.testing.assert_close(result(model, setup, few), result(model, setup, many), rtol=2e-3, atol=2e-3)


@pytest.mark.parametrize("kind", NETWORKS)
def test_a_batch_is_its_scans_one_by_one(kind):
    setup, model = setup_of(), network(kind)
    scans = [scan(setup, seed) for seed in (1, 2)]
    both = result(model, setup, joined(*scans))
    torch.testing.assert_close(both, torch.cat([result(model, setup, one) for one in scans]), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("kind", TOLD)
def test_the_order_of_the_cameras_does_not_matter(kind):
    """With their images they may be in any: OSEM's subsets depend on places, not on the order."""
    setup, model = setup_of(), network(kind)
    sample, order = scan(setup), np.array([3, 0, 4, 1, 2])
    A = setup.A
    other = ScannerSetup(mph.Projector(A.grid, A.views[order], A.model.of_views(order), threads=1), 2, (1, 2, 3))
    turned = sample._replace(counts=sample.counts[:, order], background=sample.background[:, order])
    torch.testing.assert_close(result(model, other, turned), result(model, setup, sample), rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("kind", TOLD)
def test_what_is_told_the_geometry_takes_another_scanner(kind):
    other = setup_of(11)
    assert len(other.A.views) == 8
    assert result(network(kind), other, scan(other)).isfinite().all()


def test_without_geometry_another_scanner_is_refused():
    other = setup_of(11)
    with pytest.raises(mph.InputError, match=r"for 5 views of .8, 8. pixels and .8, 8, 8. voxels, not for 8 views"):
        network("channels")(other, scan(other))


def test_permuted_poses_explain_images_by_other_modules():
    true, permuted = setup_of(), setup_of(permuted=1)
    assert true.scanner != permuted.scanner
    images = true.A(np.ones(GRID.shape, np.float32))
    assert sorted(map(float, permuted.uniform.sum((1, 2)))) == pytest.approx(sorted(map(float, images.sum((1, 2)))))
    sample = scan(true)
    x = sample.osem[:, 1:2]
    exact = sample._replace(counts=true.A(x[:, 0] * sample.scale) + sample.background)
    assert relative_residual(true, exact, x).abs().max() < 1e-3
    assert relative_residual(permuted, exact, x).square().mean() > 0.01


def test_the_backprojected_residual_is_the_em_update():
    setup = setup_of()
    sample = scan(setup, level=1e6)
    x = np.asarray(sample.osem[0, 1] * sample.scale)
    updated = mph.mlem(setup.A, sample.counts[0].numpy(), 1, sample.background[0].numpy(), start=x).volume.array
    residual = relative_residual(setup, sample, sample.osem[:, 1:2])
    ours = sample.osem[:, 1:2] * (1 + normalized_backprojection(setup, residual))
    seen = np.asarray(setup.sensitivity) > 0.01 * float(setup.sensitivity.max())
    np.testing.assert_allclose((ours[0, 0] * sample.scale).numpy()[seen], updated[seen], rtol=1e-3, atol=1e-3 * x.max())


def test_cameras_in_training_are_a_random_few_and_in_use_all():
    setup = setup_of()
    sample, model = scan(setup), network("cameras", rounds=1)
    asked: list[int] = []
    whole = model._outputs

    def counted(setup: ScannerSetup, images: Any, volumes: Any, some: torch.Tensor) -> Any:
        asked.append(len(some))
        return whole(setup, images, volumes, some)

    model._outputs = counted
    model.train()(setup, sample)
    assert asked == [3]
    asked.clear()
    first = result(model, setup, sample)
    assert asked == [3, 2]
    model.cameras = 5
    torch.testing.assert_close(result(model, setup, sample), first, rtol=1e-4, atol=1e-5)


def test_parallel_projections_give_the_volume_of_fbp():
    """By the projector's adjoint, as by the voxels' own places in `fbp`."""
    grid = mph.Grid.centered((24, 24, 6), 4.0)
    index = np.stack(np.meshgrid(*map(np.arange, grid.shape), indexing="ij"), -1) - (np.array(grid.shape) - 1) / 2
    volume = np.exp(-np.sum((index / [4, 5, 3]) ** 2, -1)).astype(np.float32)
    beam = parallel_beam(grid, 96)
    images = beam.project(volume)
    found = beam.fbp(torch.as_tensor(images)[None])[0].numpy()
    np.testing.assert_allclose(found, mph.fbp(images, beam.project.views, grid).array, atol=0.02)
    np.testing.assert_allclose(found, volume, atol=0.03)


@pytest.mark.parametrize("shape", [(9, 10, 11), (12, 8, 5)])
def test_the_u_net_takes_any_size(shape):
    assert UNet(2, 3, (4, 4, 4))(torch.ones(1, 2, *shape)).shape == (1, 3, *shape)


@pytest.mark.parametrize(("kind", "name", "channels", "expected"), [
    *(("cameras", name, channels, "three levels or more") for name in ("channels", "camera_channels")
      for channels in ((), (4,), (4, 4), (4, 0, 4), (4, 4, -4))),
    *(("channels", "channels", channels, "one level or more") for channels in ((), (4, 0))),
])  # fmt: skip
def test_networks_of_too_few_levels_or_without_channels_are_refused_in_a_line(kind, name, channels, expected):
    with pytest.raises(mph.InputError) as refusal:
        network(kind, **{name: channels})
    assert str(refusal.value) == f"network.{name}: expected {expected}, each of 1 or more, got {list(channels)}"


def test_saving_memory_changes_no_gradient():
    setup, gradients = setup_of(), []
    for save_memory in (True, False):
        model = network("unrolled", save_memory=save_memory)
        sum(x.square().mean() for x in model(setup, scan(setup))).backward()
        gradients.append(torch.cat([p.grad.flatten() for p in model.parameters()]))
    torch.testing.assert_close(*gradients)
