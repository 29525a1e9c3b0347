"""DiffDRR's interface: the same arguments and poses give DiffDRR's images, points and gradients.

Results are compared with DiffDRR 0.6.1 if it is installed; the arguments before 0.4 with their definition.
"""

import itertools
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed")
pytest.importorskip("roma", reason="roma is not installed")

import mphdrr.core as mph  # noqa: E402
from mphdrr.core import diffdrr as ours  # noqa: E402
from mphdrr.core.diffdrr import DRR, RigidTransform, Subject, convert, drr_arguments, hu_to_density, read  # noqa: E402
from mphdrr.core.geometry.rotations import rotation_parameters, se3_exp  # noqa: E402

from .conftest import general_grid, refused  # noqa: E402

AXIS_ANGLE = {"parameterization": "axis_angle"}
EULER = {"parameterization": "euler_angles", "convention": "ZXY"}
OLD_EULER = {"parameterization": "euler_angles", "convention": "ZYX"}
"""The arguments before 0.4 know no other angles."""
ROTATION = torch.tensor([[0.3, -0.2, 0.1], [-0.4, 0.6, 1.2]])
TRANSLATION = torch.tensor([[4.0, 120.0, -7.0], [-9.0, 150.0, 5.0]])


@pytest.fixture
def theirs():
    """Return DiffDRR's modules and TorchIO."""
    names = ("diffdrr.drr", "diffdrr.pose", "diffdrr.data", "torchio")
    reason = "DiffDRR is not installed ({} is missing)"
    modules = (pytest.importorskip(name, reason=reason.format(name), exc_type=ImportError) for name in names)
    return SimpleNamespace(**dict(zip(("drr", "pose", "data", "torchio"), modules, strict=True)))


def ct(rng, shape=(24, 20, 22)):
    """Return CT numbers: air around an uneven body."""
    hu = np.full(shape, -1000.0, np.float32)
    hu[4:-4, 3:-3, 4:-4] = rng.uniform(-200, 900, tuple(np.array(shape) - [8, 6, 8]))
    return hu


@pytest.fixture
def subject(rng):
    grid = general_grid(rng, (24, 20, 22))
    hu = torch.from_numpy(ct(rng))
    mask = torch.from_numpy(rng.integers(0, 3, grid.shape))
    return Subject(hu_to_density(hu), grid.affine, torch.tensor(
        [[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]]), hu, mask)  # fmt: skip


@pytest.fixture
def torchio_subject(subject, theirs):
    images = {
        name: theirs.torchio.ScalarImage(tensor=x[None], affine=subject.affine)
        for name, x in (("volume", subject.hu), ("density", subject.density))
    }
    mask = theirs.torchio.LabelMap(tensor=subject.mask[None], affine=subject.affine)
    return theirs.torchio.Subject(**images, mask=mask, reorient=subject.reorient, fiducials=None)


CALIBRATION = torch.tensor([[5.0, 0.2, 0, 3], [0.1, 4.0, 0, -6], [0, 0, 220.0, 0], [0, 0, 0, 1]])


@pytest.mark.parametrize(
    ("options", "arguments"),
    [
        ({"height": 12}, {}),
        ({"height": 9, "width": 14, "delx": 3.0, "dely": 5.0, "x0": 7.0, "y0": -4.0}, {}),
        ({"reverse_x_axis": False}, {}),
        ({"voxel_shift": 0.0}, {}),
        ({"reshape": False}, {}),
        ({"height": 8, "patch_size": 4}, {}),
        ({"p_subsample": 0.4}, {}),  # the same seed chooses the same pixels
        ({"sdd": 120.0}, {}),  # the detector is in the middle of the body, and the line counts beyond it
        ({}, {"mask_to_channels": True}),
        ({}, {"calibration": CALIBRATION}),
    ],
)
def test_images_points_and_gradients_are_those_of_diffdrr(options, arguments, theirs, torchio_subject):
    if "calibration" in arguments:
        arguments = {"calibration": theirs.pose.RigidTransform(CALIBRATION)}
    options = {"sdd": 240.0, "height": 10, "delx": 4.0, **options}
    chosen = slice(1 if "p_subsample" in options else 2)  # DiffDRR takes no two poses there
    drrs, images, gradients = [], [], []
    for module in (theirs.drr, ours):
        torch.manual_seed(5)
        drrs.append(drr := module.DRR(torchio_subject, **options))
        rotation, translation = ROTATION[chosen].clone().requires_grad_(), TRANSLATION[chosen].clone().requires_grad_()
        image = drr(rotation, translation, **EULER, **arguments)
        (image * torch.linspace(0, 1, image.numel()).reshape(image.shape)).sum().backward()
        images.append(image.detach())
        gradients.append((rotation.grad, translation.grad))
    expected, image = images
    assert image.shape == expected.shape and image.dtype == expected.dtype
    np.testing.assert_allclose(image, expected, rtol=1e-4, atol=2e-4 * float(expected.max()))
    for expected, gradient in zip(*gradients, strict=True):
        np.testing.assert_allclose(gradient, expected, rtol=2e-2, atol=5e-3 * float(expected.abs().max()))

    their_drr, our_drr = drrs
    pose = theirs.pose.convert(ROTATION[chosen], TRANSLATION[chosen], **EULER)
    np.testing.assert_allclose(our_drr(pose, **arguments), image, atol=1e-4 * float(image.max()))
    points = torch.randn(len(pose), 6, 3) * 20
    expected = their_drr.perspective_projection(pose, points)
    np.testing.assert_allclose(our_drr.perspective_projection(pose, points), expected, rtol=1e-3, atol=1e-3)
    pixels = torch.rand(len(pose), 6, 2) * 10
    unchanged = pixels.clone()
    points = our_drr.inverse_projection(pose, pixels)
    assert torch.equal(pixels, unchanged)
    np.testing.assert_allclose(points, their_drr.inverse_projection(pose, pixels), rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("orientation", ["AP", "PA", None])
def test_reading_a_ct_is_that_of_diffdrr(orientation, subject, theirs):
    options = {"orientation": orientation, "bone_attenuation_multiplier": 2.5}
    expected = theirs.data.read(theirs.torchio.ScalarImage(tensor=subject.hu[None], affine=subject.affine), **options)
    ct = read(mph.Volume(subject.hu.numpy(), mph.Grid(subject.hu.shape, subject.affine), "hu"), **options)
    np.testing.assert_allclose(ct.density, expected.density.data[0], atol=1e-6)
    np.testing.assert_allclose(ct.affine, expected.volume.affine, atol=1e-6)
    np.testing.assert_array_equal(ct.reorient, expected.reorient)


CONVENTIONS = ["".join(c) for c in itertools.product("XYZ", repeat=3) if c[1] not in c[::2]]


@pytest.mark.parametrize(
    ("parameterization", "size", "options"),
    [
        ("axis_angle", 3, {}), ("quaternion", 4, {}), ("rotation_6d", 6, {}), ("rotation_9d", 9, {}),
        ("rotation_10d", 10, {}), ("quaternion_adjugate", 10, {}), ("se3_log_map", 3, {}),
        *(("euler_angles", 3, {"convention": c, "degrees": d}) for c in CONVENTIONS for d in (False, True)),
    ],
)  # fmt: skip
def test_poses_are_those_of_diffdrr(parameterization, size, options, rng, theirs):
    translation = torch.tensor(rng.normal(size=(20, 3)) * 100, dtype=torch.float32)
    rotation = torch.tensor(rng.uniform(-1.2, 1.2, (20, size)), dtype=torch.float32)
    if parameterization == "quaternion_adjugate":  # DiffDRR chooses another column if the matrix is no q q^T
        quaternions = convert(rotation[:, :4], translation, parameterization="quaternion")
        rotation = rotation_parameters(quaternions.rotation, parameterization)
    convention, degrees = options.get("convention", "XYZ"), options.get("degrees", False)
    rotation[:, 1] += 1.3 if convention[0] == convention[2] else 0.0  # away from the gimbal's lock
    rotation = torch.rad2deg(rotation) if degrees else rotation
    arguments = {"parameterization": parameterization, **options}
    expected, pose = (module.convert(rotation, translation, **arguments) for module in (theirs.pose, ours))
    np.testing.assert_allclose(pose.rotation, expected.rotation, atol=2e-6 if options else 1e-4)
    np.testing.assert_allclose(pose.matrix, expected.matrix, rtol=1e-4, atol=1e-3)
    again = pose.convert(**arguments)
    np.testing.assert_allclose(convert(*again, **arguments).matrix, pose.matrix, rtol=1e-4, atol=2e-3)
    if options:
        np.testing.assert_allclose(again[0], rotation, atol=2e-2 if degrees else 3e-4)


def test_image_is_the_integral_along_the_rays_to_the_pixels(subject):
    """Without DiffDRR: pixels are where `inverse_projection` says, the source is the pose's origin."""
    drr = DRR(subject, 240.0, 7, 4.0, 9, 5.0, x0=3.0, y0=2.0, whole_line=False)
    pose = convert(ROTATION.double(), TRANSLATION.double(), **AXIS_ANGLE)
    image = drr(pose)
    row, column = np.mgrid[:7, :9]
    pixels = torch.tensor(np.stack([column + 0.5, row + 0.5], -1).reshape(1, -1, 2)).expand(2, -1, -1)
    targets = drr.inverse_projection(pose, pixels)
    np.testing.assert_allclose(drr.perspective_projection(pose, targets), pixels, atol=1e-9)
    for b in range(2):
        expected = mph.trace_rays(subject.density, pose.translation[b], targets[b], grid=drr.grid)
        np.testing.assert_allclose(image[b].reshape(-1), expected, rtol=1e-5, atol=1e-4)


def test_generation_before_04(rng):
    """Source at +x, detector at -x, the volume's corner at the origin and its first axis flipped."""
    hu, spacing = ct(rng), [1.5, 2.0, 1.0]
    drr = DRR(hu, spacing, 90.0, 8, 5.0, 11, 4.0, x0=2.0, y0=-3.0)
    center = torch.tensor(np.array(hu.shape) * spacing / 2)[None]
    rotation, translation = torch.tensor([[0.4, -0.3, 0.2]]), center.float()
    image = drr(rotation, translation, **OLD_EULER)
    assert image.shape == (1, 1, 8, 11)
    assert torch.equal(image, drr(rotation, translation))
    drr.reshape = False
    assert torch.equal(drr(rotation, translation), image.reshape(1, 88))
    drr.reshape = True
    turn = se3_exp(torch.tensor([[0, 0, 0, 0, 0, 0.4]])) @ se3_exp(torch.tensor([[0, 0, 0, 0, -0.3, 0]]))
    turn = (turn @ se3_exp(torch.tensor([[0, 0, 0, 0.2, 0, 0]])))[0, :3, :3].double()
    row, column = 6, 2
    target = turn @ torch.tensor([-90.0, (row - 3.5) * 5 + 3, (column - 5) * 4 - 2]).double() + center[0]
    source = turn @ torch.tensor([90.0, 0, 0]).double() + center[0]
    grid = mph.Grid.centered(hu.shape, spacing, center[0].numpy())
    expected = mph.trace_rays(hu_to_density(torch.from_numpy(hu)).flip([0]), source, target, grid=grid)
    np.testing.assert_allclose(image[0, 0, row, column], expected[0], rtol=1e-4)
    brighter = drr(rotation, translation, bone_attenuation_multiplier=3.0)
    assert not torch.allclose(brighter, image)
    assert torch.equal(DRR(hu, spacing=spacing, sdr=90.0, height=8, delx=5.0, bone_attenuation_multiplier=3.0).density,
                       drr.density)  # fmt: skip


ONE, WHERE = [0.3, -0.2, 0.1], [4.0, 120.0, -7.0]  # one pose


@pytest.mark.parametrize(("old", "where"), [(True, [17.0, 21.0, 10.0]), (False, WHERE)])
def test_every_form_of_the_arguments_means_the_same_pose(old, where, subject, rng):
    """One-dimensional, arrays, lists, whole numbers, names by position: as tensors (1, 3) and keywords."""
    drr = DRR(ct(rng), [1.5, 2.0, 1.0], 90.0, 6, 8.0) if old else DRR(subject, 240.0, 6, 8.0)
    expected = drr(torch.tensor([ONE]).double(), torch.tensor([where]).double(), **EULER)
    assert expected.shape == (1, 1, 6, 6) and expected.max() > 0
    for image in (
        drr(torch.tensor(ONE), torch.tensor(where), **EULER),
        drr(torch.tensor([ONE]), torch.tensor(where), **EULER),
        drr([ONE], where, **EULER),
        drr(np.array(ONE), np.array([where]), **EULER),
        drr(torch.tensor(ONE), torch.tensor([int(x) for x in where]), **EULER),
        drr(torch.tensor([ONE]), torch.tensor([where]), "euler_angles", "ZXY"),
        drr(torch.tensor([ONE]), torch.tensor([where]), "euler_angles", convention="ZXY"),
        drr(torch.tensor(ONE), torch.tensor(where), "ZXY", parameterization="euler_angles"),
    ):
        np.testing.assert_allclose(image, expected, rtol=1e-4, atol=1e-4)
    if not old:
        positional = convert(torch.tensor([ONE]), torch.tensor(where), "euler_angles", "ZXY")
        assert torch.equal(positional.matrix, convert(torch.tensor([ONE]), torch.tensor([where]), **EULER).matrix)
        np.testing.assert_allclose(drr(positional), expected, rtol=1e-4, atol=1e-4)
    several = drr(ROTATION, torch.tensor(where), **EULER)  # one translation for both
    np.testing.assert_allclose(several, drr(ROTATION, torch.tensor([where, where]), **EULER))
    with_convention = drr(torch.tensor(ONE), torch.tensor(where), parameterization="euler_angles", convention="XYZ")
    if old:  # the only parameterization is that of Euler angles, whatever the convention
        np.testing.assert_allclose(drr(torch.tensor(ONE), torch.tensor(where), convention="XYZ"), with_convention)


def test_gradients_reach_the_density_and_poses_of_any_form(subject):
    rotation, translation = (torch.tensor(x, dtype=torch.float64, requires_grad=True) for x in (ONE, WHERE))
    drr = DRR(subject, 240.0, 6, 8.0)
    drr(rotation, translation, "axis_angle").sum().backward()
    registration = ours.Registration(drr, *(torch.tensor([x], dtype=torch.float64) for x in (ONE, WHERE)), "axis_angle")
    registration().sum().backward()
    for one, registered in ((rotation, registration.rotation), (translation, registration.translation)):
        np.testing.assert_allclose(one.grad, registered.grad[0])
        assert one.grad.abs().min() > 0
    drr.density.requires_grad_()
    drr(registration.pose).sum().backward()
    assert drr.density.grad.shape == drr.density.shape and drr.density.grad.abs().sum() > 0


def test_rays_from_within_the_volume_and_away_from_it_are_followed_both_ways(subject):
    """The whole line: a source in the volume, one beyond it that looks away, and both in one batch."""
    drr = DRR(subject, 60.0, 7, 9.0, 8, 7.0, x0=3.0)
    turn = convert(ROTATION[:1].double(), torch.zeros(1, 3).double(), **AXIS_ANGLE).rotation
    center = torch.tensor(drr.grid.center)
    poses = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
    poses[:, :3, :3] = turn
    axis = (turn @ subject.reorient[:3, 2].double())[0]  # where the camera looks
    poses[:, :3, 3] = center + torch.tensor([[3.0], [200.0], [-200.0]]) * axis
    images = drr(poses)[:, 0]
    assert (images.amax(dim=(1, 2)) > 0).all()
    camera = RigidTransform(poses @ subject.reorient.double())
    source, corner, row_step, column_step = drr.detector.lattice()
    row, column = (torch.arange(n)[..., None] for n in (7, 8))
    targets = camera((corner + row[:, None] * row_step + column * column_step).reshape(1, -1, 3))
    for b in range(3):
        start = camera(source[None, None])[b]
        along = (targets[b] - start) * 50
        expected = mph.trace_rays(subject.density.double(), start - along, start + along, grid=drr.grid)
        np.testing.assert_allclose(images[b].reshape(-1), expected, rtol=1e-4, atol=1e-4)
        np.testing.assert_allclose(drr(poses[b])[0, 0], images[b], rtol=1e-5, atol=1e-5)  # alone, too


def test_a_call_copies_no_volume_and_sees_every_change_of_it(rng):
    """A call takes no memory of the volume's size, and edits of the density, however made, count in the next call."""
    import tracemalloc

    hu = np.full((160, 140, 90), 40.0, np.float32)
    hu[:40] = -1000  # whose margins are not cropped, either
    hu[60:70, 50:60, 20:30] = 700
    drr = DRR(hu, [1.0, 1.1, 1.2], sdr=400.0, height=40, delx=5.0)
    pose = torch.tensor([[0.2, -0.3, np.pi / 2]]), torch.tensor([[80.0, 77.0, 54.0]])
    first = drr(*pose)
    tracemalloc.start()
    again = drr(*pose)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 0.1 * drr.density.nbytes
    assert torch.equal(again, first) and first.max() > 0
    for change in (
        lambda: drr.density.mul_(2.0),
        lambda: drr.density.data.mul_(2.0),
        lambda: np.multiply(drr.density.numpy(), 2.0, out=drr.density.numpy()),
        lambda: setattr(drr, "density", drr.density * 2.0),
    ):
        change()
        changed = drr(*pose)
        np.testing.assert_allclose(changed, 2 * again, rtol=1e-6)
        again = changed


def test_one_prepared_volume_serves_every_module(scanner, rng):
    """`set_intrinsics_` makes another C-arm of the same volume, as a new `DRR` does."""
    hu, spacing = ct(rng), [3.0, 2.5, 2.0]
    middle = torch.tensor(np.array(hu.shape)[None] * spacing / 2)
    drr = DRR(hu, spacing, sdr=300.0, height=9, delx=6.0)
    for m in (3, 44):
        sdr = 5 * float(scanner.collimator_length[m])
        drr.set_intrinsics_(sdd=2 * sdr)
        angles = torch.tensor([[*angles_of(scanner, m), 0.0]])
        image = drr(angles, middle, "euler_angles", "ZYX")
        another = DRR(hu, spacing, sdr=sdr, height=9, delx=6.0)
        assert torch.equal(image, another(angles, middle, "euler_angles", "ZYX"))


@pytest.mark.long
def test_eighty_calls_on_a_chest_ct_take_four_seconds_of_two_cores():
    """512 x 512 x 133 voxels, 250 x 250 pixels, one call a module; by processor time, which other work disturbs less."""
    import time

    x, y, z = np.ogrid[-1:1:512j, -1:1:512j, -1:1:133j]
    hu = np.where(1.6 * x**2 + 2.9 * y**2 < 1, 100 * np.sin(9 * x + 7 * y + 5 * z), -1000).astype(np.float32)
    spacing = [0.703125, 0.703125, 2.5]
    drr = DRR(hu, spacing, sdr=450.0, height=250, delx=2.0)
    middle = torch.tensor(np.array(hu.shape)[None] * spacing / 2)
    seconds = []
    for azimuth in np.linspace(0.0, 4.5, 21):
        start = time.process_time()
        drr(torch.tensor([[azimuth, -0.24, 0.0]]), middle, **OLD_EULER)
        seconds.append(time.process_time() - start)
    assert 80 * float(np.median(seconds[1:])) / 2 < 4.0


def test_points_before_04(rng):
    """Where its formula fits its images, a pixel's point is where its ray ends; back and forth always."""
    pose = convert(torch.tensor([[0.4, -0.3, 0.2]]), TRANSLATION[:1], **OLD_EULER)
    pixels = torch.tensor(np.stack(np.mgrid[:11, :8][::-1], -1).reshape(1, -1, 2) + 0.5, dtype=torch.float64)
    drr = DRR(ct(rng), [1.5, 2.0, 1.0], 90.0, 11, 5.0, 8, x0=6.0, reverse_x_axis=True)
    _, corner, row_step, column_step = drr.detector.lattice()
    column, row = torch.floor(pixels[0]).T[..., None]
    ends = pose.to(torch.float64)((corner + row * row_step + column * column_step)[None])
    np.testing.assert_allclose(drr.inverse_projection(pose, pixels), ends, atol=1e-4)
    drr = DRR(ct(rng), [1.5, 2.0, 1.0], 90.0, 11, 5.0, 8, 4.0, x0=6.0, y0=-3.0)
    points = drr.inverse_projection(pose, pixels)
    nearer = torch.lerp(pose.to(torch.float64)(drr.detector.lattice()[None, :1]), points, 0.6)
    np.testing.assert_allclose(drr.perspective_projection(pose, nearer), pixels, atol=1e-4)


def test_subsampled_pixels(subject):
    full = DRR(subject, 240.0, 10, 4.0)
    some = DRR(subject, 240.0, 10, 4.0, p_subsample=0.3)
    pose = convert(ROTATION, TRANSLATION, **AXIS_ANGLE)
    image = some(pose)
    chosen = torch.zeros(100, dtype=torch.bool)
    chosen[some.subsample] = True
    assert int(chosen.sum()) == 30
    np.testing.assert_allclose(image.reshape(2, -1)[:, chosen], full(pose).reshape(2, -1)[:, chosen], rtol=1e-5)
    assert not image.reshape(2, -1)[:, ~chosen].any()
    some.reshape = False
    assert some(pose).shape == (2, 1, 30)


def test_changing_the_detector(subject):
    drr = DRR(subject, 240.0, 10, 4.0, x0=5.0)
    drr.rescale_detector_(0.5)
    assert (drr.detector.height, drr.detector.delx, drr.detector.x0) == (5, 8.0, 5.0)
    drr.set_intrinsics_(sdd=300.0, height=7)
    assert drr(convert(ROTATION, TRANSLATION, **AXIS_ANGLE)).shape == (2, 1, 7, 5)


def test_ways_to_give_the_volume(subject, rng, tmp_path):
    grid = mph.Grid(subject.density.shape, subject.affine)
    pose = convert(ROTATION, TRANSLATION, **AXIS_ANGLE)
    expected = DRR(subject, 240.0, 6, 4.0)(pose)
    density = subject.density
    for drr in (
        DRR(mph.Volume(density.numpy(), grid, "mu"), 240.0, 6, 4.0),
        DRR(density, grid.affine, 240.0, 6, 4.0),
        DRR(volume=density.numpy(), affine=grid.affine, sdd=240.0, height=6, delx=4.0),
    ):
        np.testing.assert_allclose(drr(pose), expected, rtol=1e-5)
    ct = read(mph.Volume(subject.hu.numpy(), grid, "hu"), subject.mask.numpy(), labels=[1, 2])
    centered = mph.Grid(grid.shape, ct.affine)
    np.testing.assert_allclose(centered.center, 0, atol=1e-9)
    assert not ct.density[subject.mask == 0].any()


@pytest.mark.parametrize("detector", ["virtual", "real"])
def test_a_view_is_a_pose(detector, system, subject):
    """For any view there are arguments of DiffDRR that give its image, also mirrored and with an offset."""
    grid = mph.Grid(subject.density.shape, subject.affine)
    views = system.views((9, 12), detector, pitch=(0.9, 1.2) if detector == "real" else (9.0, 12.0), offset=(2.0, 3.0))
    mirrored = mph.Views(views.sources, views.detector_centers, -views.u_steps, views.v_steps, views.shape)
    for m, seen in ((3, views), (7, mirrored)):
        for orientation in ("AP", "PA"):
            arguments, pose = drr_arguments(seen, m, orientation)
            placed = replace(
                subject, reorient=read(mph.Volume(subject.hu.numpy(), grid, "hu"), orientation=orientation).reorient
            )
            image = DRR(placed, **arguments, whole_line=False)(pose)[0, 0]
            expected = mph.Projector(grid, seen[m])(subject.density)[0]
            np.testing.assert_allclose(image, expected, rtol=1e-4, atol=1e-4 * float(expected.max()))
    with pytest.raises(mph.InputError, match="rectangles"):
        drr_arguments(mph.Views([[0, 0, -9]], [[0, 0, 9]], [[1, 0, 0]], [[1, 1, 0]], (3, 3)), 0)


def angles_of(system, m):
    """Return azimuth and elevation of module m, as in columns V and W of the workbook."""
    x, y, z = system.centers[m]
    return float(np.arctan2(y, x)), float(np.arctan2(z, np.hypot(x, y)))


def shown_by_diffdrr(theirs, hu, spacing, sdr, height, delx, angles):
    """Return the image by DiffDRR 0.6.1 of the scene that versions before 0.4 made of these arguments, and the density.

    Their source was at +x and the detector at -x, `sdr` from the camera's origin, with rows along y and columns along z;
    ZYX angles turned them, then they were moved to the middle of a volume whose first axis was reversed.
    """
    (ca, sa), (cb, sb), (cg, sg) = ((np.cos(a), np.sin(a)) for a in angles)
    turn = np.array([[ca, -sa, 0], [sa, ca, 0], [0, 0, 1]]) @ [[cb, 0, sb], [0, 1, 0], [-sb, 0, cb]]
    turn = turn @ [[1, 0, 0], [0, cg, -sg], [0, sg, cg]]
    middle = np.array(hu.shape) * spacing / 2
    pose = np.eye(4)  # 0.6.1: the source at the origin, the detector at +z, rows along -y, columns along -x
    pose[:3] = np.column_stack([-turn[:, 2], -turn[:, 1], -turn[:, 0], middle + sdr * turn[:, 0]])
    affine = np.diag([*spacing, 1.0])
    affine[:3, 3] = np.array(spacing) / 2
    density = hu_to_density(torch.from_numpy(hu)).flip([0])
    images = {"volume": torch.from_numpy(hu).flip([0]), "density": density}
    images = {name: theirs.torchio.ScalarImage(tensor=x[None], affine=affine) for name, x in images.items()}
    subject = theirs.torchio.Subject(**images, mask=None, reorient=torch.eye(4), fiducials=None)
    drr = theirs.drr.DRR(subject, 2 * sdr, height, delx)
    return drr(theirs.pose.RigidTransform(torch.tensor(pose[None], dtype=torch.float32)))[0, 0], density


@pytest.mark.parametrize(("m", "mirror"), [(0, 60), (25, 45), (79, 19)])
def test_with_the_workbooks_angles_diffdrr_looks_from_the_mirror_image_of_the_module(m, mirror, scanner, rng, theirs):
    """The users' own call, angles (azimuth, elevation, pi/2) and sdr = 5 l: module 1's numbers show what module 61 sees."""
    hu, spacing, sdr = ct(rng), [3.0, 2.5, 2.0], 5 * float(scanner.collimator_length[m])
    angles = [*angles_of(scanner, m), np.pi / 2]
    image, density = shown_by_diffdrr(theirs, hu, spacing, sdr, 12, 5.0, angles)
    drr = DRR(hu, spacing, sdr=sdr, height=12, delx=5.0)
    middle = torch.tensor(np.array(hu.shape)[None] * spacing / 2)
    ours = drr(torch.tensor([angles]), middle, **OLD_EULER)[0, 0]
    np.testing.assert_allclose(ours, image, atol=2e-4 * float(image.max()))
    grid, shown = mph.Grid.centered(hu.shape, spacing), {}
    for elevation in ("diffdrr", "module"):
        views = mph.c_arm_views(scanner, (12, 12), 5.0, elevation=elevation)
        shown[elevation] = mph.Projector(grid, views[[m, mirror]])(density)
    np.testing.assert_allclose(shown["diffdrr"][0], image, atol=2e-4 * float(image.max()))
    np.testing.assert_allclose(shown["diffdrr"][0], shown["module"][1], atol=1e-6 * float(image.max()))
    assert float((shown["module"][0] - image).abs().max()) > 0.05 * float(image.max())


@pytest.mark.parametrize(("elevation", "sign"), [("diffdrr", 1), ("module", -1)])
def test_a_c_arm_view_is_diffdrrs_image_pixel_by_pixel(elevation, sign, system, rng):
    """Third angle pi/2 as it is, 0 turned; `elevation` says whose sign the second angle has."""
    hu, spacing = ct(rng), [3.0, 2.5, 2.0]
    middle = torch.tensor(np.array(hu.shape)[None] * spacing / 2)
    views = mph.c_arm_views(system, shape=(11, 13), pitch=(4.0, 5.0), elevation=elevation)
    for m in (0, 8):
        azimuth, own = angles_of(system, m)
        sdr = 5 * system.collimator_length[m]
        upright = DRR(hu, spacing, sdr, height=11, delx=5.0, width=13, dely=4.0)
        turned = DRR(hu, spacing, sdr, height=13, delx=4.0, width=11, dely=5.0)
        expected = mph.Projector(mph.Grid.centered(hu.shape, spacing), views[m])(upright.density)[0]
        for drr, third, shown in ((upright, np.pi / 2, lambda x: x), (turned, 0.0, lambda x: x.T.flip([1]))):
            angles = torch.tensor([[azimuth, sign * own, third]])
            image = drr(angles, middle, **OLD_EULER)[0, 0]
            np.testing.assert_allclose(shown(image), expected, rtol=1e-4, atol=1e-4)


def test_rigid_transforms():
    pose = convert(ROTATION, TRANSLATION, **AXIS_ANGLE)
    points = torch.randn(2, 4, 3)
    np.testing.assert_allclose(pose.inverse()(pose(points)), points, atol=1e-4)
    both = pose.compose(pose.inverse())
    np.testing.assert_allclose(both.matrix, torch.eye(4).expand(2, 4, 4), atol=1e-4)
    assert len(pose) == 2 and pose[0].shape == (4, 4) and RigidTransform(torch.eye(4)).matrix.shape == (1, 4, 4)


def test_bad_input_is_one_clear_line(subject):
    drr = DRR(subject, 240.0, 6, 4.0)
    for call, word in (
        (lambda: DRR(subject.hu, [1.0, 1.0, 1.0], sdr=90.0, height=11), "DRR: missing a required argument: 'delx'"),
        (lambda: DRR(subject, sdd=90.0, height=11), "DRR: missing a required argument: 'delx'"),
        (lambda: DRR(subject, 240.0, 6, 4.0, renderer="cubic"), "siddon"),
        (lambda: DRR(subject, 240.0, 6, 4.0, renderer="trilinear"), "use DiffDRR itself"),
        (lambda: DRR(subject, 240.0, 6, 4.0, mode="bilinear"), "nearest"),
        (lambda: DRR(subject, 240.0, 6, 4.0, reducefn="max"), "sum"),
        (lambda: DRR(subject, 240.0, 6, 4.0, colour="red"), "colour"),
        (lambda: DRR(subject, 240.0, 0, 4.0), "height"),
        (lambda: DRR(subject, -1.0, 6, 4.0), "sdd"),
        (lambda: DRR(subject.density, 240.0, 6, 4.0), "affine"),
        (lambda: DRR(subject, 240.0, 6, 4.0, p_subsample=2), "p_subsample"),
        (lambda: drr(ROTATION, TRANSLATION), "parameterization"),
        (lambda: drr(ROTATION), "RigidTransform"),
        (lambda: drr(ROTATION, TRANSLATION, parameterization="euler"), "axis_angle"),
        (lambda: drr.set_intrinsics_(colour=1), "colour"),
        (lambda: drr(ROTATION, TRANSLATION, "euler_angles"), "convention"),
        (lambda: drr(ROTATION, TRANSLATION, "euler_angles", "ZXY", "ZYX"), "got 5 arguments"),
        (lambda: drr(ROTATION, parameterization="euler_angles"), "rotation, translation"),
        (lambda: drr(ROTATION, TRANSLATION[:, :2], "axis_angle"), "B x 3"),
        (lambda: drr(ROTATION, TRANSLATION.repeat(2, 1)[:3], "axis_angle"), "2 x 3 and 3 x 3"),
        (lambda: drr(ROTATION[0, :2], TRANSLATION[0], "axis_angle"), "x 3 for axis_angle"),
        (lambda: drr(0.3, TRANSLATION, "axis_angle"), "rotation"),
        (lambda: drr(None, TRANSLATION, "axis_angle"), "rotation"),
        (lambda: drr([0.1, 0.2, "a"], TRANSLATION, "axis_angle"), "rotation"),
        (lambda: drr([0.1, np.nan, 0.2], TRANSLATION, "axis_angle"), "rotation"),
        (lambda: drr(ROTATION * np.nan, TRANSLATION, "axis_angle"), "finite"),
        (lambda: drr(), "pose"),
        (lambda: DRR(np.full((3, 3, 3), np.nan), [1.0, 1.0, 1.0], 90.0, 6, 4.0), "volume"),
        (lambda: DRR(np.zeros((3, 3)), [1.0, 1.0, 1.0], 90.0, 6, 4.0), "volume"),
    ):
        refused(call, word)
