"""Programs written for DiffDRR: label maps of any affine, images of torchio, DiffDRR's reconstruction tutorial.

https://github.com/eigenvivek/DiffDRR/issues/346 (a label map in another orientation than the CT),
https://vivekg.dev/DiffDRR/tutorials/reconstruction.html (density as a parameter).
"""

from __future__ import annotations

import itertools
from types import SimpleNamespace

import numpy as np
import pytest

import mphdrr.core as mph

from ..core.conftest import general_grid, refused

torch = pytest.importorskip("torch", reason="torch is not installed")
pytest.importorskip("roma", reason="roma is not installed")

from mphdrr.core.diffdrr import DRR, RigidTransform, convert, read  # noqa: E402

SHAPE = (14, 12, 10)
EULER = {"parameterization": "euler_angles", "convention": "ZXY"}
POSE = convert(torch.tensor([[0.3, -0.1, 0.2]]), torch.tensor([[3.0, 300.0, -5.0]]), **EULER)


@pytest.fixture
def ct(rng):
    return mph.Volume(rng.uniform(-1000, 1500, SHAPE), general_grid(rng, SHAPE), "hu")


def permuted(grid, axes, signs):
    """Return the affine of the same voxels with index axes in another order, some reversed, and the map of arrays."""
    flips = tuple(slice(None, None, sign) for sign in signs)
    matrix = grid.affine.copy()
    for axis, sign in enumerate(signs):
        if sign < 0:
            matrix[:3, 3] += matrix[:3, axis] * (grid.shape[axis] - 1)
            matrix[:3, axis] *= -1
    return matrix[:, [*axes, 3]], lambda array: np.ascontiguousarray(array[flips].transpose(axes))


@pytest.mark.parametrize("axes", [(0, 1, 2), (2, 1, 0), (1, 2, 0)])
@pytest.mark.parametrize("signs", [(1, 1, 1), (-1, 1, 1), (-1, -1, 1), (1, -1, -1)])
def test_a_label_map_in_another_orientation_keeps_the_same_voxels(ct, rng, axes, signs):
    labels = rng.integers(0, 4, SHAPE)
    expected = read(ct, labels, [1, 3])
    affine, rearranged = permuted(ct.grid, axes, signs)
    array = rearranged(labels)
    for labelmap in (
        mph.Volume(array, mph.Grid(array.shape, affine)),
        SimpleNamespace(data=torch.tensor(array)[None], affine=affine),
    ):
        subject = read(ct, labelmap, [1, 3])
        assert torch.equal(subject.density, expected.density) and torch.equal(subject.mask, expected.mask)
        assert bool((subject.density[labels == 3] > 0).any()) and not subject.density[labels == 2].any()


@pytest.mark.parametrize("change", ["fine", "coarse", "sheared", "turned", "larger"])
def test_a_voxel_gets_the_label_at_its_centre(ct, rng, change):
    corners = ct.grid.corners()
    axes = {
        "fine": np.diag([1.1, 0.7, 0.9]), "coarse": np.diag([4.3, 5.1, 3.9]), "larger": ct.grid.affine[:3, :3],
        "sheared": np.array([[2.0, 0.7, 0], [0, 1.7, -0.6], [0.3, 0, 2.2]]),
        "turned": mph.euler_pose(0.4, 0.9, -1.3)[:3, :3] * 1.7,
    }[change]  # fmt: skip
    index = np.linalg.solve(axes, corners.T)
    low, n = np.floor(index.min(axis=1)), np.ceil(np.ptp(index, axis=1)).astype(int) + 2
    affine = np.eye(4)
    affine[:3, :3], affine[:3, 3] = axes, axes @ low + rng.uniform(-0.2, 0.2, 3) @ axes.T
    labels = rng.integers(0, 9, n)
    mask = read(ct, mph.Volume(labels, mph.Grid(tuple(n), affine))).mask
    for voxel in rng.integers(0, SHAPE, (300, 3)):
        point = np.linalg.solve(affine, ct.grid.affine @ [*voxel, 1.0])[:3]
        assert mask[tuple(voxel)] == labels[tuple(np.floor(point + 0.5).astype(int))]


@pytest.mark.parametrize(("axis", "side"), [*itertools.product(range(3), (0, 1))])
def test_a_label_map_that_does_not_cover_the_volume_is_refused(ct, axis, side):
    shape = np.array(SHAPE)
    shape[axis] -= 1
    grid = ct.grid.box(np.eye(3, dtype=int)[axis] * side, tuple(shape))
    refused(lambda: read(ct, mph.Volume(np.ones(grid.shape), grid), 1), "labelmap", "covers all of the volume")
    # Shifted by half a voxel, the outermost centres are on its faces: it covers them.
    grid = ct.grid.box(np.eye(3)[axis] * (side - 0.5), SHAPE)
    assert bool((read(ct, mph.Volume(np.ones(SHAPE), grid)).mask == 1).all())


def test_every_kind_of_image_is_the_same_ct(ct, rng, tmp_path):
    labels = rng.integers(0, 3, SHAPE)
    mph.write_volume(ct, tmp_path / "ct.npz")
    mph.write_volume(mph.Volume(labels, ct.grid, "hu"), tmp_path / "labels.npz")
    expected = read(ct, labels, 2)
    image = SimpleNamespace(data=torch.tensor(ct.array)[None], affine=ct.grid.affine)
    kinds = [
        (tmp_path / "ct.npz", tmp_path / "labels.npz", {}), (str(tmp_path / "ct.npz"), torch.tensor(labels), {}),
        (image, torch.tensor(labels)[None], {}), (ct.array, labels.astype(np.uint8), {"affine": ct.grid.affine}),
        (torch.tensor(ct.array), labels.tolist(), {"affine": torch.tensor(ct.grid.affine)}),
    ]  # fmt: skip
    for volume, labelmap, options in kinds:
        subject = read(volume, labelmap, [2], **options)
        for name in ("density", "mask", "hu"):
            assert torch.equal(getattr(subject, name), getattr(expected, name))
        np.testing.assert_array_equal(subject.affine, expected.affine)


def test_images_of_torchio(ct, rng):
    torchio = pytest.importorskip("torchio", exc_type=ImportError)
    labels = torch.tensor(rng.integers(0, 3, SHAPE))
    affine, rearranged = permuted(ct.grid, (2, 0, 1), (-1, 1, -1))
    image = torchio.ScalarImage(tensor=torch.tensor(ct.array)[None], affine=ct.grid.affine)
    turned = torchio.LabelMap(tensor=torch.tensor(rearranged(labels.numpy()))[None], affine=affine)
    subject, expected = read(image, turned, 1), read(ct, labels, 1)
    assert torch.equal(subject.density, expected.density) and torch.equal(subject.mask, expected.mask)
    # A whole subject, as DiffDRR's read gives it: its mask has an affine of its own, too.
    density = torchio.ScalarImage(tensor=read(ct).density[None], affine=ct.grid.affine)
    whole = torchio.Subject(volume=image, density=density, mask=turned, reorient=expected.reorient)
    found = DRR(whole, 400.0, 6, 9.0)(POSE, mask_to_channels=True)
    centered = read(ct, labels, center_volume=False)
    assert torch.equal(found, DRR(centered, 400.0, 6, 9.0)(POSE, mask_to_channels=True)) and found.shape[1] == 3


def test_structures_stay_chosen_when_bone_changes(ct, rng):
    labels = rng.integers(0, 3, SHAPE)
    drr = DRR(read(ct, labels, 1), 400.0, 6, 9.0)
    expected = DRR(read(ct, labels, 1, bone_attenuation_multiplier=3.0), 400.0, 6, 9.0)
    assert torch.equal(drr(POSE, bone_attenuation_multiplier=3.0), expected(POSE))


def test_what_read_cannot_use_is_one_line(ct, tmp_path):
    grid, file = ct.grid, tmp_path / "ct.npz"
    mph.write_volume(ct, file)
    two = SimpleNamespace(data=torch.zeros(2, *SHAPE), affine=grid.affine)
    for call, *words in (
        (lambda: read(ct, transform=RigidTransform(torch.eye(4))), "read has no argument 'transform'"),
        (lambda: read(ct, resample_target=2.0), "'resample_target'"),
        (lambda: read(ct.array), "volume", "affine"), (lambda: read(torch.tensor(ct.array)), "volume", "affine"),
        (lambda: read(ct, affine=grid.affine), "volume", "own"),
        (lambda: read(file, affine=grid.affine), "volume", "own"), (lambda: read(None), "volume"),
        (lambda: read(two), "volume"), (lambda: read(ct, two), "labelmap"),
        (lambda: read(mph.Volume(ct.array + 2000, grid)), "expected a volume of hu"),
        (lambda: read(ct, np.zeros((3, 3, 3))), "labelmap", "voxels"), (lambda: read(ct, 5), "labelmap"),
        (lambda: read(ct, np.full(SHAPE, 0.5)), "labelmap", "whole"), (lambda: read(ct, np.full(SHAPE, 2**24)), "whole"),
        (lambda: read(ct, np.full(SHAPE, -1)), "whole"),
        (lambda: read(ct, labels=1), "labelmap"), (lambda: read(ct, np.ones(SHAPE), "bone"), "labels"),
    ):  # fmt: skip
        refused(call, *words)
    read(ct, fiducials=None, transform=None)  # DiffDRR's defaults


class Reconstruction(torch.nn.Module):
    """Module of DiffDRR's tutorial: the density is a parameter, and `form` the method that draws it."""

    def __init__(self, subject, form, **options):
        super().__init__()
        self.drr, self.form = DRR(subject, sdd=400.0, height=12, delx=6.0, **options), form
        self.density = torch.nn.Parameter(torch.zeros(*subject.volume.spatial_shape))

    def forward(self, pose):
        drr = self.drr
        source, target = drr.detector(pose, None)
        if self.form == "render":  # since 0.4.2
            return drr.reshape_transform(drr.render(self.density, source, target), batch_size=len(pose))
        lengths = (target - source).norm(dim=-1).unsqueeze(1)
        image = drr.renderer(self.density, drr.affine_inverse(source), drr.affine_inverse(target), lengths)
        return drr.reshape_transform(image, batch_size=len(pose))


@pytest.mark.parametrize("form", ["render", "renderer"])
@pytest.mark.parametrize(
    "options", [{}, {"whole_line": False}, {"voxel_shift": 0.0}, {"p_subsample": 0.3}, {"reverse_x_axis": False}]
)
def test_the_tutorials_images_and_gradients_are_those_of_the_module(ct, form, options):
    subject = read(ct)
    recon, poses = (
        Reconstruction(subject, form, **options),
        torch.cat([POSE.matrix, torch.eye(4)[None]]),
    )  # and from within
    recon.density.data = subject.density.clone()
    recon.drr.density = torch.nn.Parameter(recon.drr.density)
    results = []
    for image, density in (
        (recon(RigidTransform(poses)), recon.density), (recon.drr(RigidTransform(poses)), recon.drr.density),
    ):  # fmt: skip
        results.append((image, *torch.autograd.grad((image**2).sum(), density)))
    for found, expected in zip(*results, strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-4 * float(expected.detach().abs().max()))


def test_the_tutorial_reconstructs_the_images_from_zeros(ct):
    subject = read(ct)
    drr = DRR(subject, sdd=400.0, height=12, delx=6.0)
    truth = drr(POSE)
    truth = (truth - truth.min()) / (truth.max() - truth.min())
    recon = Reconstruction(subject, "renderer")
    optimizer, criterion, losses = torch.optim.Adam(recon.parameters(), lr=1e-3), torch.nn.MSELoss(), []
    for _ in range(101):
        optimizer.zero_grad()
        loss = criterion(recon(POSE), truth)
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 1e-3 * losses[0]


def test_the_renderer_is_diffdrrs(ct, rng):
    """Rays between voxel indices, with and without their lengths, with and without a mask, gradients too."""
    renderers = pytest.importorskip("diffdrr.renderers", exc_type=ImportError)
    drr = DRR(read(ct), sdd=400.0, height=7, delx=6.0)
    source, target = (drr.affine_inverse(x) for x in drr.detector(POSE, None))
    lengths, mask = torch.rand(1, 1, 49) + 1, torch.tensor(rng.integers(0, 3, SHAPE), dtype=torch.float32)
    for shift, chosen in itertools.product((0.5, 0.0), (None, mask)):
        drr = DRR(read(ct), sdd=400.0, height=7, delx=6.0, voxel_shift=shift)
        results = []
        for renderer in (drr.renderer, renderers.Siddon(voxel_shift=shift)):
            inputs = [x.clone().requires_grad_() for x in (drr.density, source, target, lengths)]
            image = renderer(*inputs, mask=chosen)
            weights = torch.linspace(0, 1, image.numel()).reshape(image.shape)
            results.append((image.detach(), *torch.autograd.grad((image * weights).sum(), inputs)))
        for k, (found, expected) in enumerate(zip(*results, strict=True)):
            tolerance = (2e-4, 1e-3, 2e-2, 2e-2, 1e-3)[k] * float(expected.abs().max())
            torch.testing.assert_close(found, expected, rtol=1e-3, atol=tolerance)
    in_voxels = drr.renderer(drr.density, source, target)
    torch.testing.assert_close(
        in_voxels, drr.renderer(drr.density, source, target, (target - source).norm(dim=-1)[:, None])
    )
