"""CT by few stationary sources: motion and change against a reference, likelihood of photons, mu for SPECT, kerma."""

from dataclasses import replace

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.geometry.frames import affine_matrix, rotations

from .conftest import refused

PHOTONS = 1e5
GRID = mph.Grid.centered(48, 3.0)
BODY = mph.ShapePhantom([
    mph.Ellipsoid(radii=(66, 42, 56), mu=0.020),
    mph.Ellipsoid(radii=(20, 14, 30), position=(-22, 8, 4), mu=0.006),
    mph.Ellipsoid(radii=(16, 22, 12), position=(24, -12, -14), mu=0.035),
    mph.Ellipsoid(radii=(10, 8, 16), position=(6, 26, 18), euler=(0.4, 0.7, 0.1), mu=0.028),
])  # fmt: skip
VIEWS = mph.xray_arc(shape=(64, 64)).views()


def line_integrals(phantom, views, pose=None, photons=PHOTONS, seed=0):
    """Return line integrals of voxels half as large, with noise."""
    fine = phantom.voxelize(mph.Grid.centered(96, 1.5), pose, quantity="mu")
    passed = photons * np.exp(-np.asarray(mph.Projector(fine.grid, views)(fine)))
    return np.log(photons / np.maximum(mph.sample_counts(passed, seed), 0.5))


def pose_of(shift, rotation):
    return affine_matrix(rotations(np.array([rotation], float))[0], shift)


@pytest.fixture(scope="module")
def reference():
    return BODY.voxelize(GRID, quantity="mu")


@pytest.fixture(scope="module")
def finder(reference):
    return mph.MotionFinder(reference, VIEWS, PHOTONS)


@pytest.mark.parametrize("seed", range(3))
def test_a_motion_of_5_mm_and_3_degrees_is_found(finder, seed):
    rng = np.random.default_rng(seed)
    shift, rotation = (
        s * x / np.linalg.norm(x) for s, x in zip((5, np.radians(3)), rng.normal(size=(2, 3)), strict=True)
    )
    motion = finder(line_integrals(BODY, VIEWS, pose_of(shift, rotation), seed=seed))
    assert motion.settled
    assert np.linalg.norm(motion.shift - shift) < 0.2
    assert np.degrees(np.linalg.norm(motion.rotation - rotation)) < 0.2
    np.testing.assert_allclose(motion.pose, pose_of(motion.shift, motion.rotation), atol=1e-12)  # about the origin


def test_of_exact_images_of_itself_there_is_no_motion(reference):
    fine = replace(VIEWS, u_steps=VIEWS.u_steps / 4, v_steps=VIEWS.v_steps / 4, shape=(256, 256))
    images = np.reshape(mph.Projector(GRID, fine)(reference), (-1, 64, 4, 64, 4)).mean((2, 4), float)  # means of pixels
    motion = mph.find_motion(reference, images, VIEWS)
    np.testing.assert_allclose([*motion.shift, *motion.rotation], 0, atol=2e-3)  # coarse pixels settle first


def test_what_has_changed_is_found_beside_the_motion(reference):
    pose = pose_of((3.0, -2.0, 1.0), (0.0, 0.02, 0.0))
    place = np.array([-2.0, -14.0, 6.0])
    changed = mph.ShapePhantom([*BODY.shapes, mph.Sphere(radius=9, position=place, mu=0.026)])
    images = line_integrals(changed, VIEWS, pose)
    motion = mph.find_motion(reference, images, VIEWS, PHOTONS)
    change = mph.find_change(reference, images, VIEWS, motion, 10)
    np.testing.assert_allclose(change.grid.affine, motion.pose @ GRID.affine)
    at = change.grid.affine @ [*np.unravel_index(change.array.argmax(), GRID.shape), 1.0]
    assert np.linalg.norm(at[:3] - (pose @ [*place, 1.0])[:3]) < 9


def test_what_motion_and_ostr_refuse(reference, finder):
    images, A = np.zeros((24, 64, 64)), mph.Projector(SMALL, VIEWS[:4])
    hu, nothing = mph.Volume(reference.array, GRID, "hu"), mph.Volume(np.zeros(GRID.shape), GRID, "mu")
    for call, words in (
        (lambda: mph.find_motion(hu, images, VIEWS), "expected a volume of activity or mu, got hu"),
        (lambda: finder(np.zeros((24, 3, 3))), "images: expected"),
        (lambda: mph.find_motion(reference, images, VIEWS, photons=0.0), "photons: expected more than 0"),
        (lambda: mph.find_motion(nothing, images, VIEWS), "do not show all of a motion"),
        (lambda: mph.ostr(A, np.zeros(A.shape_out), photons=-1), "photons: expected more than 0"),
    ):
        refused(call, words)


SMALL = mph.Grid.centered(10, 14.0)


def test_the_likelihood_of_one_subset_rises_to_its_maximum(rng):
    views = mph.xray_ring(12, shape=(16, 16)).views()
    A = mph.Projector(SMALL, views)
    truth = BODY.voxelize(SMALL, quantity="mu")
    counts = mph.sample_counts(500 * np.exp(-np.asarray(A(truth))), 1)
    images = np.log(500 / np.maximum(counts, 0.5))
    prior = mph.Quadratic(2e5)
    result = mph.ostr(A, images, 150, 1, prior, 500, nonnegative=False)
    assert (np.diff(result.objective) > -1e-6 * np.abs(result.objective[1:])).all()
    x = result.volume.array
    passed, measured = 500 * np.exp(-np.asarray(A(x))), 500 * np.exp(-images)
    gradient = A.T((passed - measured).astype(np.float32)) - prior.on(SMALL).gradient(x)
    assert np.abs(gradient).max() < 1e-3 * np.abs(A.T((500 - measured).astype(np.float32))).max()
    assert mph.ostr(A, images, 8, 4, prior, 500, nonnegative=False).objective[-1] > result.objective[8]
    assert mph.nrmse(x, truth.array) < 0.5


def test_ct_numbers_and_attenuation_are_inverse():
    hu = mph.Volume(np.linspace(-1000, 2000, 8).reshape(2, 2, 2), mph.Grid.centered(2, 1.0), "hu")
    np.testing.assert_allclose(mph.mu_to_hu(mph.hu_to_mu(hu, 70.0), 70.0).array[0], hu.array[0], atol=0.5)
    water = mph.Volume(np.full((2, 2, 2), mph.attenuation("water", 60.0)), hu.grid, "mu")
    np.testing.assert_allclose(mph.mu_to_hu(water, 60.0).array, 0, atol=1e-3)


def test_kerma_at_the_isocentre():
    system = mph.xray_arc(3, kvp=(80, 100, 120), mas=(1, 2, 3), filters="Al 2.5 + Cu 0.1")
    kerma = [mph.tube_spectrum(kvp, {"Al": 2.5, "Cu": 0.1}).kerma * mas for kvp, mas in ((80, 1), (100, 2), (120, 3))]
    np.testing.assert_allclose(mph.isocentre_kerma(system), np.array(kerma) * (1000 / 300) ** 2, rtol=1e-9)


@pytest.mark.long
def test_spect_with_the_mu_of_the_ct(scanner):
    grid = mph.Grid.centered((44, 32, 54), 8.0, (35, -30, -30))
    fine = mph.Grid.centered((88, 64, 108), 4.0, (35, -30, -30))
    torso = mph.CardiacTorso()
    activity, mu = torso.voxelize(fine), torso.voxelize(fine, quantity="mu")
    ct = mph.hu_to_mu(mph.mu_to_hu(mu, 140.5), 70.0)
    xray = mph.xray_ring(source_radius=600, panel_size=(800, 600), shape=(36, 48)).views()  # they see all of the torso
    passed = 1e6 * np.exp(-np.asarray(mph.Projector(fine, xray)(ct)))
    images = np.log(1e6 / np.maximum(mph.sample_counts(passed, 1), 0.5))
    body = torso.voxelize(grid, quantity="mu").array > 0.002
    volume = mph.tv(mph.Projector(grid, xray), images, 2.0, 30, start=0.019 * body, mask=body).volume
    pinholes = scanner[::4]
    views = pinholes.views((16, 16), magnification=1.0)

    def projector(grid, mu):
        return mph.Projector(grid, views, mph.Emission(pinholes, mu=mu, hole="point", pixel_points=1, tolerance=1e9))

    counts = np.asarray(projector(fine, mu)(activity))
    heart = mph.resample(activity, grid, "mean").array > 30
    maps = (mu, mph.hu_to_mu(mph.mu_to_hu(volume, 70.0), 140.5), None)
    true, by_ct, without = (mph.osem(projector(grid, x), counts, 4, 4).volume.array[heart].mean() for x in maps)
    assert by_ct == pytest.approx(true, rel=0.03) and without < 0.6 * true
