"""Laws of systems, frames, views and grids."""

import dataclasses

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.geometry.frames import module_frames, module_poses

from .conftest import refused


def test_frames_are_right_handed_and_aim_at_the_isocentre(rng):
    centers = np.concatenate([rng.normal(size=(50, 3)) * 100, [[0, 0, 50], [0, 0, -50]]])
    frames = module_frames(centers)
    assert np.allclose(frames @ frames.transpose(0, 2, 1), np.eye(3), atol=1e-12)
    assert np.allclose(np.linalg.det(frames), 1)
    assert np.allclose(frames[:, 2], -centers / np.linalg.norm(centers, axis=1)[:, None])
    assert np.allclose(frames[:-2, 0, 2], 0)  # u is horizontal
    assert np.all(frames[:-2, 1, 2] > 0)  # v points up
    assert np.allclose(frames[-2], [[0, 1, 0], [1, 0, 0], [0, 0, -1]])  # x_hat x k where z is parallel to k


def test_poses_take_module_coordinates_to_the_world(rng):
    centers = rng.normal(size=(9, 3)) * 100
    b = np.linalg.norm(centers, axis=1)
    isocentres = module_poses(centers) @ np.stack([0 * b, 0 * b, b, 0 * b + 1], axis=1)[:, :, None]
    assert np.allclose(isocentres[:, :3, 0], 0, atol=1e-10)


def test_field_of_view_is_tangent_to_the_roi_sphere(rng):
    b, d, side, radius = rng.uniform(150, 300, 99), rng.uniform(0.5, 4, 99), rng.uniform(30, 70, 99), 75.0
    length = mph.collimator_length(b, d, side, radius)
    s = (side - d) / (2 * length)
    assert np.allclose(b * s - d / 2, radius * np.sqrt(1 + s**2), rtol=1e-12)


SYSTEM = {
    "centers": [[200, 0, 0], [0, 200, 0], [0, 0, 200]],
    "pinhole_diameter": 2.0,
    "collimator_length": 60.0,
    "detector_side": 50.0,
    "detector_thickness": 10.0,
    "roi_radius": 75.0,
}


def changed(**changes):
    return mph.PinholeSystem(**SYSTEM | changes)


def volume_of(array, quantity="mu"):
    return mph.Volume(array, mph.Grid.centered((3, 4, 5), 1.0), quantity)


REFUSALS = [
    (lambda: mph.collimator_length(70, 2, 50, 75), "b, the distance from pinhole to isocentre, must be more than R mm"),
    (lambda: mph.collimator_length(np.nan, 2, 50, 75), "b, the distance from pinhole to isocentre"),
    (lambda: mph.collimator_length(200, 0, 50, 75), "d, the pinhole diameter, must be more than 0"),
    (lambda: mph.collimator_length(200, 60, 50, 75), "Ld, the crystal's side, must be more than d"),
    (lambda: mph.collimator_length(200, 2, 50, -1), "R, the ROI radius, must be more than 0"),
    (lambda: changed(centers=[[200, 0, 0], [0, 200, 0], [0, 0, 0]]), "module 3: its pinhole is 0 mm from the iso"),
    (lambda: changed(centers=[[200, 0, 0], [0, 50, 0], [0, 0, 200]]), "module 2:", "inside the ROI"),
    (lambda: changed(centers=[[200, 0, 0], [0, 200, 0], [200, 0, 0]]), "module 3: another module has the same pin"),
    (lambda: changed(centers=[[9, 0, 0], [0, np.nan, 0]]), "pinhole centres: nan is not a finite", "(1, 1)"),
    (lambda: changed(centers=[[1, 2]]), "pinhole centres: expected shape any x 3"),
    (lambda: changed(centers=np.zeros((0, 3))), "at least one module"),
    (lambda: changed(numbers=[1, 2, 2]), "module 2: another module has the same number"),
    (lambda: changed(numbers=[1, 2.5, 3]), "numbers: expected whole numbers"),
    (
        lambda: changed(pinhole_diameter=[2, 2, 60]),
        "module 3: pinhole_diameter 60 mm must be less than detector_side 50",
    ),
    (lambda: changed(collimator_length=[60, -1, 60]), "module 2: collimator_length must be more than 0 mm, got -1"),
    (lambda: changed(detector_side="wide"), "detector_side: expected real numbers"),
    (lambda: changed(roi_radius=[75, 75]), "roi_radius: expected shape 3, got 2"),
    (lambda: changed().views((0, 4)), "image shape"),
    (lambda: changed().views((4.5, 4)), "image shape"),
    (lambda: changed().views(4), "image shape"),
    (lambda: changed().views(detector="crystal"), "detector 'crystal'"),
    (lambda: changed().views(magnification=0), "magnification"),
    (lambda: changed().views(magnification=np.inf), "magnification"),
    (lambda: changed().views(pitch=-1), "pixel pitch"),
    (lambda: changed().views(pitch=(1, 2, 3)), "pixel pitch"),
    (lambda: changed().views(offset=3), "image offset"),
    (lambda: mph.Views([[0, 0, 5], [0, 0, 0]], np.zeros((2, 3)), [[1, 0, 0]] * 2, [[0, 1, 0]] * 2, (4, 4)), "view 1"),
    (lambda: mph.Grid((4, 4), np.eye(4)), "grid shape"),
    (lambda: mph.Grid((4, 4, 0), np.eye(4)), "grid shape"),
    (lambda: mph.Grid((4, 4, 4), np.eye(3)), "grid affine: expected shape"),
    (lambda: mph.Grid((4, 4, 4), np.diag([1, 1, 0, 1])), "cannot be inverted"),
    (lambda: mph.Grid((4, 4, 4), np.diag([1, 1, 1, 2])), "as the last row"),
    (lambda: mph.Grid((4, 4, 4), np.diag([1, 1, np.nan, 1])), "grid affine: nan"),
    (lambda: volume_of(np.zeros((3, 4, 6))), "expected shape 3 x 4 x 5, got 3 x 4 x 6"),
    (lambda: volume_of(np.full((3, 4, 5), np.inf)), "inf is not a finite number at index (0, 0, 0)"),
    (lambda: volume_of(np.zeros((3, 4, 5)), "warmth"), "expected one of activity, mu, hu"),
    (lambda: volume_of(np.zeros((3, 4, 5), complex)), "expected real numbers"),
    (lambda: volume_of(np.full((3, 4, 5), 1e300)), "not a finite number"),
]


@pytest.mark.parametrize("refusal", REFUSALS)
def test_what_cannot_be_is_refused(refusal):
    refused(*refusal)


@pytest.mark.parametrize("detector", ["virtual", "real"])
def test_every_pixel_projects_onto_itself(system, detector):
    views = system.views(shape=(7, 12), detector=detector, magnification=4.0, offset=(3.0, -2.0))
    rows, columns = np.mgrid[:7, :12]
    for m, matrix in enumerate(views.projection_matrices()):
        sources, targets = views.rays(m)
        between = sources + 0.3 * (targets - sources)
        projected = np.c_[between, np.ones(len(between))] @ matrix.T
        assert np.all(projected[:, 2] > 0)
        assert np.allclose(projected[:, 0] / projected[:, 2], columns.ravel())
        assert np.allclose(projected[:, 1] / projected[:, 2], rows.ravel())


def test_virtual_pixel_pitch_and_middle_follow_the_module_frame(system):
    views = system.views(shape=(5, 8), magnification=10.0, pitch=(2.0, 1.0), offset=(4.0, 6.0))
    frames = system.frames()
    _, targets = views.rays(3)
    local = (targets - system.centers[3]) @ frames[3].T
    assert np.allclose(local[:, 2], 10 * system.collimator_length[3])
    u = (np.arange(8) + 0.5 - 4) * 2.0 + 4.0
    v = (np.arange(5) + 0.5 - 2.5) * 1.0 + 6.0
    assert np.allclose(local[:, 0].reshape(5, 8), u)
    assert np.allclose(local[:, 1].reshape(5, 8), v[:, None])


def test_real_detector_sees_by_the_same_rays_point_inverted(system):
    virtual = system.views(shape=(6, 9), detector="virtual")
    real = system.views(shape=(6, 9), detector="real")
    for m in range(len(system)):
        assert np.allclose(real.rays(m)[1], virtual.rays(m)[1][::-1])
        assert np.allclose(real.rays(m)[0], virtual.rays(m)[0])


def test_default_image_covers_the_crystal(system):
    real = system.views(shape=(10, 20), detector="real", magnification=5.0)
    # The ray through the crystal's corner, continued behind the pinhole, meets it at l.
    width = np.linalg.norm(real.u_steps, axis=1) * 20 / 5.0
    height = np.linalg.norm(real.v_steps, axis=1) * 10 / 5.0
    assert np.allclose(width, system.detector_side)
    assert np.allclose(height, system.detector_side)


def test_views_and_systems_slice_alike(system):
    views = system.views(shape=(4, 4))
    for which in (3, slice(2, 9), np.array([5, 1]), -1):
        part = system[which].views(shape=(4, 4))
        assert np.array_equal(part.sources, views[which].sources)
        assert np.array_equal(part.u_steps, views[which].u_steps)
    assert list(system[2:4].numbers) == [103, 104]


def test_rings_gather_modules_of_one_height(system):
    assert list(system.rings()) == [0] * 6 + [1] * 6


def test_systems_are_frozen(system):
    with pytest.raises(dataclasses.FrozenInstanceError):
        system.centers = 0
    with pytest.raises(ValueError, match="read-only"):
        system.centers[0, 0] = 1


def test_grid_centred_has_its_middle_there(rng):
    grid = mph.Grid.centered((4, 5, 8), (1.0, 2.0, 0.5), center=(3, -2, 1))
    assert np.allclose(grid.corners().mean(axis=0), [3, -2, 1])
    assert np.allclose(np.ptp(grid.corners(), axis=0), [4, 10, 4])
    assert np.allclose(grid.center, [3, -2, 1])
    assert np.allclose(grid.index_from_world @ grid.affine, np.eye(4))
    assert grid.voxel_volume == pytest.approx(1.0)
    assert mph.Grid.centered(6, 2.0) == mph.Grid.centered((6, 6, 6), (2, 2, 2))


def test_volumes_are_float32_copies_that_nobody_can_change(rng):
    values = rng.normal(size=(3, 4, 5))
    volume = mph.Volume(values, mph.Grid.centered((3, 4, 5), 1.0), "mu")
    values[:] = 7
    assert volume.array.dtype == np.float32
    assert volume.array.flags.c_contiguous
    assert not np.any(volume.array == 7)
    with pytest.raises(ValueError, match="read-only"):
        volume.array[0, 0, 0] = 1
    assert volume.unit == "1/mm"
