"""Laws of SPECT counts: the pinhole's sensitivity, attenuation, aperture, detector, noise."""

from __future__ import annotations

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.physics.isotopes import photon_energy

from .conftest import BACKENDS, WORKBOOK, emission, general_grid, refused

TOLERANCE = {"numpy": 1e-12, "torch": 1e-5, "cpu": 1e-5}


def one_module(**changes):
    """Return a pinhole at x = 200 mm that looks along -x."""
    lengths = {"pinhole_diameter": 2.0, "collimator_length": 60.0, "detector_side": 50.0, "detector_thickness": 10.0}
    return mph.PinholeSystem(centers=[[200.0, 0.0, 0.0]], roi_radius=60.0, **(lengths | changes))


def sensitivity(system, points):
    """Return the law of a point source, (M, N): counts per decay at each of the points (N, 3)."""
    towards = points[None] - system.centers[:, None]
    distance = np.linalg.norm(towards, axis=2)
    h = np.einsum("mni,mi->mn", towards, system.principal_rays)
    return system.pinhole_diameter[:, None] ** 2 * (h / distance) ** 3 / (16 * h**2)


def in_ball(rng, radius, n):
    directions = rng.normal(size=(n, 3))
    return directions * (radius * rng.random((n, 1)) ** (1 / 3) / np.linalg.norm(directions, axis=1, keepdims=True))


def turned_grid(shape, spacing, center=(0.0, 0.0, 0.0)):
    """Return a grid without planes parallel to any module's rays."""
    affine = mph.euler_pose(0.3, 0.5, 0.2)
    affine[:3, :3] *= spacing
    affine[:3, 3] = center - affine[:3, :3] @ ((np.array(shape) - 1) / 2)
    return mph.Grid(shape, affine)


def assert_adjoint(A, rng):
    x, y = rng.random(A.shape_in), rng.random(A.shape_out)
    Ax, ATy = A(x).astype(float), A.T(y).astype(float)
    assert Ax.any()
    assert abs(np.vdot(Ax, y) - np.vdot(x, ATy)) < np.linalg.norm(Ax) * np.linalg.norm(y) * TOLERANCE[A.backend]


def assert_real_is_virtual(model, rng, pitch=4.0, magnification=3.0, offset=(0.0, 0.0)):
    """Check that images on the crystal are those of virtual detectors, point-inverted."""
    grid = general_grid(rng, (9, 8, 7))
    x, offset = rng.random(grid.shape), np.array(offset)
    views = (
        model.system.views((9, 10), "real", pitch=pitch, offset=offset),
        model.system.views((9, 10), "virtual", magnification, magnification * pitch, -magnification * offset),
    )
    real, virtual = (mph.Projector(grid, detector, model)(x) for detector in views)
    assert real.any()
    np.testing.assert_allclose(virtual[:, ::-1, ::-1], real, rtol=1e-5, atol=1e-5 * real.max())


@pytest.mark.parametrize("step", [20, pytest.param(1, marks=pytest.mark.long)])
def test_point_source_obeys_pinhole_sensitivity(rng, step):
    """A module of each ring, or all 80; 100 places in the ROI, the crystal's own pixels: total counts of a small spot.

    A spot is 27 voxels with weights 1-2-1 along each axis (a single voxel's edges would beat with the pixels). The
    total counts of every voxel are the adjoint of an image of ones.
    """
    system = mph.read_system(WORKBOOK)
    grid = turned_grid((27, 27, 27), 6.0)
    places = np.c_[in_ball(rng, system.roi_radius.min() - 6, 100), np.ones(100)]
    steps = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3, indexing="ij"), axis=-1).reshape(27, 3)
    weights = np.prod(0.5 ** (1 + np.abs(steps)), axis=1)
    index = np.rint((places @ grid.index_from_world.T)[:, None, :3]).astype(int) + steps
    voxels = index @ grid.affine[:3, :3].T + grid.affine[:3, 3]
    expected = sensitivity(system, voxels.reshape(-1, 3)).reshape(80, 100, 27) @ weights * grid.voxel_volume
    for m in range(0, len(system), step):
        pitch = system.detector_side[m] / 256  # and more around, so that nothing is cut off
        A = mph.Projector(grid, system[m].views((320, 320), "real", pitch=pitch), mph.Emission(system[m]))
        total = A.T(np.ones((1, 320, 320)))[tuple(np.moveaxis(index, -1, 0))] @ weights
        np.testing.assert_allclose(total, expected[m], rtol=0.01)


def test_point_source_obeys_pinhole_sensitivity_to_a_thousandth_with_fine_pixels(rng):
    system = mph.read_system(WORKBOOK)[::27]
    for place in in_ball(rng, 60, 2):
        grid = turned_grid((1, 1, 1), 3.0, place)
        expected = sensitivity(system, place[None])[:, 0] * grid.voxel_volume
        matrices = system.views(shape=(1, 1), detector="real").projection_matrices()
        for m in range(len(system)):
            column, row, factor = matrices[m] @ [*place, 1.0]  # look only at where the voxel's image is
            side = system.detector_side[m]
            views = system[m].views((700, 700), "real", pitch=0.003, offset=np.array([column, row]) / factor * side)
            total = mph.Projector(grid, views, emission(system[m]))(np.ones((1, 1, 1))).sum(dtype=float)
            np.testing.assert_allclose(total, expected[m], rtol=0.001)


@pytest.mark.parametrize("backend", BACKENDS)
def test_counts_per_solid_angle_follow_the_formula(backend):
    """A slab across the field of view: T p d^2 a cos^4(psi) / (16 l^2) times its path length, thickness / cos(psi).

    The crystal counts what it stops: 1 - exp(-mu t / cos(psi)).
    """
    system = one_module(pinhole_diameter=3.0)
    grid = mph.Grid.centered((1, 1, 1), (10, 400, 400))
    views = system.views((8, 9), detector="real", pitch=(3.0, 2.0), offset=(4.0, -5.0))
    u = (np.arange(9) - 4) * 3.0 + 4.0
    v = (np.arange(8) - 3.5)[:, None] * 2.0 - 5.0
    cosine = 60 / np.sqrt(60**2 + u**2 + v**2)
    expected = 7 * 0.5 * 3**2 * 6 * cosine**3 / (16 * 60**2) * 5 * 10
    for crystal_mu, stopped in ((None, 1), (0.06, 1 - np.exp(-0.06 * 10 / cosine))):
        model = emission(system, time=7.0, photons_per_decay=0.5, crystal_mu=crystal_mu)
        counts = mph.Projector(grid, views, model, backend)(np.full((1, 1, 1), 5.0))[0]
        np.testing.assert_allclose(counts, expected * stopped, rtol=1e-5)


def test_views_of_another_system_and_what_is_no_mu_are_refused(system):
    torch = pytest.importorskip("torch", reason="torch is not installed")
    grid = mph.Grid.centered((4, 4, 4), 1.0)
    views, ones = system.views((4, 4)), np.ones(grid.shape)
    sources, centers, u, v = views.sources, views.detector_centers, views.u_steps, views.v_steps
    for words, changes in (
        (("12 modules", "4 views"), {"views": system[:4].views((4, 4))}),
        (("view 0", "pinhole"), {"views": system[np.arange(12)[::-1]].views((4, 4))}),
        (("view 0", "along"), {"views": mph.Views(sources, centers, u + np.array([0, 0, 1]), v, (4, 4))}),
        (("in front",), {"views": mph.Views(sources, 2 * sources - centers, u, v, (4, 4))}),
        (("PinholeSystem",), {"system": views}),
        (("time",), {"time": 0}),
        (("Volume",), {"mu": ones}),
        (("activity",), {"mu": mph.Volume(ones, grid)}),
        (("negative",), {"mu": mph.Volume(-ones, grid, "mu")}),
        (("A(x, mu=...)",), {"mu": torch.ones(grid.shape, requires_grad=True)}),
    ):
        options = {"system": system, "views": views, **changes}
        refused(lambda options=options: mph.Projector(grid, options.pop("views"), emission(**options)), *words)
    refused(lambda: mph.Projector(grid, views, emission(system))(mph.Volume(ones, grid, "hu")), "activity")


def some_mu(rng, grid):
    """Return mu between air and more than bone, with empty margins."""
    array = rng.uniform(0, 0.05, grid.shape)
    array[0] = array[:, -1] = 0
    return mph.Volume(array, grid, "mu")


def mu_grids(grid, rng):
    """Return the activity's grid; one coarser, turned and larger; one that begins behind the pinhole; one elsewhere."""
    around = mph.Grid.centered((7, 8, 9), (90.0, 80.0, 70.0), (20.0, 10.0, -5.0))
    return [grid, turned_grid((6, 5, 7), 25.0, (4.0, 3.0, 1.0)), around, mph.Grid.centered((3, 3, 3), 5.0, (0, 0, 900))]


MODELS = {
    "point": {},
    **{f"point through mu {which}": {"mu": which} for which in range(4)},
    "inverse square": mph.InverseSquareSum,
    "points of pixels": {"pixel_points": 5, "mu": 1},
    "points of pixels and hole": {"pixel_points": 3, "aperture_points": 4, "crystal_mu": 0.1, "depth_layers": 2},
    "points for a tolerance": {"aperture_tolerance": 0.3, "isotope": "Tc-99m", "time": 600.0},
    "edge": {"aperture_points": 3, "aperture_mu": 2.0, "edge": "path"},
    "cone and walls": {"aperture_mu": 2.0, "edge": "path", "within_cone": True, "within_walls": True},
    "depth": {"crystal_mu": 0.1, "depth_layers": 3, "within_walls": True, "within_crystal": True, "intrinsic_fwhm": 5.0},
    "camera": {
        "mu": 1, "aperture_points": 3, "aperture_mu": 3.0, "crystal_mu": 0.1, "intrinsic_fwhm": 8.0, "within_crystal": True,
    },
}  # fmt: skip
"""Settings by name: `mu` is the number of a grid of `mu_grids`."""


def model_of(name, system, grid, rng):
    """Make the model of counts that has this name."""
    if not isinstance(options := MODELS[name], dict):
        return options(system)
    mu = some_mu(rng, mu_grids(grid, rng)[options["mu"]]) if "mu" in options else None
    return emission(system, **{**options, "mu": mu})


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("name", MODELS)
def test_every_models_adjoint_is_exact_and_backends_agree(backend, name, system, rng):
    """The straight modules' rays run along voxels' faces: an odd number of pixels, even voxels."""
    straight = mph.PinholeSystem([[150, 0, 0], [0, -140, 0], [0, 30, 130]], 2.0, 60.0, 50.0, 10.0, 60.0)
    for scanner, grid, offset in (
        (system[3:6], general_grid(rng, (9, 8, 7)), (20.0, 0.0)),
        (straight, mph.Grid.centered((9, 8, 7), 6.0), (0.0, 0.0)),
    ):
        views, model = scanner.views((9, 11), offset=offset), model_of(name, scanner, grid, rng)
        A, reference = (
            mph.Projector(grid, views, model, backend_name, threads=2) for backend_name in (backend, "numpy")
        )
        assert_adjoint(A, rng)
        x = rng.random(grid.shape)
        x[:, :, 0] = x[0] = 0
        expected = reference(x)
        np.testing.assert_allclose(A(x), expected, rtol=2e-5, atol=2e-5 * expected.max())


@pytest.mark.parametrize("magnification", [0.7, 10.0])
@pytest.mark.parametrize("name", [name for name, options in MODELS.items() if isinstance(options, dict)])
def test_virtual_detectors_count_what_the_crystal_does(name, magnification, system, rng):
    """Wherever they are: in front of, inside or behind the volume."""
    model = model_of(name, system[3:6], general_grid(rng, (9, 8, 7)), rng)
    assert_real_is_virtual(model, rng, 7.0, magnification, (2.0, -3.0))


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("which", range(4))
def test_attenuation_equals_a_fine_sum_along_the_ray(backend, which, rng):
    """Against midpoints on every ray, each attenuated by the line integral of mu from the pinhole to there."""
    system = one_module()
    grid = turned_grid((5, 6, 7), 12.0)
    volume = mph.Volume(rng.random(grid.shape), grid)
    mu = some_mu(rng, mu_grids(grid, rng)[which])
    views = system.views((2, 3), pitch=200.0, magnification=7.0)
    counts = mph.Projector(grid, views, emission(system, mu), backend)(volume)
    ideal = mph.Projector(grid, views, emission(system), "numpy")(volume)

    sources, targets = views.rays(0)
    n = 4000
    for pixel, (source, target) in enumerate(zip(sources, targets, strict=True)):
        points = source + (np.arange(n) + 0.5)[:, None] / n * (target - source)
        index = np.rint((np.c_[points, np.ones(n)] @ grid.index_from_world.T)[:, :3]).astype(int)
        inside = np.all((index >= 0) & (index < grid.shape), axis=1)
        activity = np.where(inside, volume.array[tuple(np.where(inside[:, None], index, 0).T)], 0)
        left = np.exp(-mph.trace_rays(mu, source, points, "numpy"))
        expected = (activity * left).sum() / max(activity.sum(), 1e-9) * ideal.reshape(-1)[pixel]
        np.testing.assert_allclose(counts.reshape(-1)[pixel], expected, rtol=2e-3, atol=1e-12)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("mu", [1e-6, 0.0154, 0.3, 8.0])
def test_uniform_body_counts_in_closed_form(backend, mu):
    """Each chord L counts f (1 - exp(-mu L)) / mu, whatever the voxels."""
    system = one_module()
    for grid in (turned_grid((9, 8, 7), 10.0), turned_grid((3, 2, 1), (30.0, 40.0, 70.0))):
        views = system.views((12, 13))
        chord = mph.trace_rays(mph.Volume(np.ones(grid.shape), grid), *views.rays(0), "numpy").reshape(1, 12, 13)
        ideal = mph.Projector(grid, views, emission(system), "numpy")(np.full(grid.shape, 3.0))
        model = emission(system, mph.Volume(np.full(grid.shape, mu), grid, "mu"))
        counts = mph.Projector(grid, views, model, backend)(np.full(grid.shape, 3.0))
        coefficient = float(np.float32(mu))
        mean = np.where(chord > 0, -np.expm1(-coefficient * chord) / np.maximum(coefficient * chord, 1e-12), 0)
        tolerance = 1e-9 if backend == "numpy" else 2e-5
        np.testing.assert_allclose(counts, ideal * mean, rtol=tolerance, atol=tolerance * counts.max())


def spot_image(model, place, pitch=0.05, n=160):
    """Return a spot's image, of 1 mm, around the centre of its projection, and the pixels' positions on the crystal in u."""
    system = model.system
    column, row, factor = system.views((1, 1), "real").projection_matrices()[0] @ [*place, 1.0]
    offset = np.array([column, row]) / factor * system.detector_side[0]
    grid = turned_grid((3, 3, 3), 0.4, place)
    views = system.views((n, n), "real", pitch=pitch, offset=offset)
    image = mph.Projector(grid, views, model)(np.ones((3, 3, 3)))[0].astype(float)
    return image, (np.arange(n) - (n - 1) / 2) * pitch


def width(image, places):
    """Return the standard deviation along u."""
    profile = image.sum(axis=0) / image.sum()
    return np.sqrt(profile @ places**2 - (profile @ places) ** 2)


@pytest.mark.parametrize("n", [7, 19, 64])
def test_aperture_blur_is_as_wide_as_the_holes_shadow(n):
    """A disk of diameter D has standard deviation D / 4 along u; at the source D = d (1 + b / l)."""
    system = one_module()
    sharp, places = spot_image(emission(system), (0, 0, 0))
    blurred, _ = spot_image(emission(system, aperture_points=n), (0, 0, 0))
    b, l, d = 200.0, 60.0, 2.0
    diameter = 4 * np.sqrt(width(blurred, places) ** 2 - width(sharp, places) ** 2)  # on the crystal
    assert diameter * b / l == pytest.approx(d * (1 + b / l), rel=0.02)
    assert blurred.sum() == pytest.approx(sharp.sum(), rel=0.01)


def test_disk_points_have_the_moments_of_the_disk():
    from mphdrr.core.physics.aperture import disk_points

    assert not disk_points(1).any()
    for n in (3, 4, 7, 19, 50, 200):
        points = disk_points(n)
        assert points.shape == (n, 2) and np.linalg.norm(points, axis=1).max() < 1.2
        np.testing.assert_allclose(points.mean(axis=0), 0, atol=1e-12)
        np.testing.assert_allclose(points.T @ points / n, np.eye(2) / 4, atol=1e-12)


def test_penetration_widens_the_pinhole():
    """Paix: d_e^2 = d (d + 2 / mu tan(alpha / 2))."""
    system = one_module()
    model = emission(system, aperture_mu=3.0, opening_angle=np.deg2rad(90))
    expected = 2.0 * (2.0 + 2 / 3)
    np.testing.assert_allclose(model.effective_diameter**2, expected)
    ideal, _ = spot_image(emission(system), (5, 6, 7))
    image, _ = spot_image(model, (5, 6, 7))
    np.testing.assert_allclose(image, ideal * expected / 4, rtol=1e-6)
    assert emission(system, aperture_mu=1e9).effective_diameter == pytest.approx(2.0)
    path = emission(system, aperture_points=7, aperture_mu=3.6, edge="path")
    assert path.effective_diameter[0] ** 2 == pytest.approx(4 + 4 / 3.6 + 2 / 3.6**2)


@pytest.mark.parametrize("fwhm", [0.3, 3.0])
def test_intrinsic_blur_has_its_width_and_keeps_the_counts(fwhm):
    system = one_module()
    sharp, places = spot_image(emission(system, pixel_points=16), (0, 0, 0), pitch=0.1)
    blurred, _ = spot_image(emission(system, pixel_points=16, intrinsic_fwhm=fwhm), (0, 0, 0), pitch=0.1)
    sigma = np.sqrt(width(blurred, places) ** 2 - width(sharp, places) ** 2)
    assert sigma == pytest.approx(fwhm / 2.35482, rel=0.01)
    assert blurred.sum() == pytest.approx(sharp.sum(), rel=1e-3)


def test_pixels_count_what_falls_on_the_crystal():
    """Total counts in a flat field grow with the crystal's area, wherever the pixels' edges lie."""
    system = one_module(detector_side=40.0)
    grid = mph.Grid.centered((1, 1, 1), (10, 900, 900))
    views = system.views((20, 20), detector="real", pitch=3.0, offset=(0.7, -0.4))
    everything, inside = (
        mph.Projector(grid, views, emission(system, within_crystal=flag))(np.ones((1, 1, 1)))[0]
        for flag in (False, True)
    )
    share = inside / everything
    assert share.sum() * 9 == pytest.approx(40.0**2) and share.max() == 1 and share.min() == 0


def test_counts_are_poisson():
    mean = np.broadcast_to(np.array([0.3, 20.0, 1e6])[:, None, None], (3, 200, 200))
    counts = mph.sample_counts(mean, seed=1)
    assert counts.dtype == np.int64 and counts.min() == 0
    error = np.sqrt(mean[:, 0, 0] / 40000)
    assert (np.abs(counts.mean(axis=(1, 2)) - mean[:, 0, 0]) < 4 * error).all()
    np.testing.assert_allclose(counts.var(axis=(1, 2)), mean[:, 0, 0], rtol=0.04)


def test_a_views_noise_depends_on_the_seed_and_on_itself_only(rng):
    mean = rng.uniform(0, 50, (4, 6, 5))
    counts = mph.sample_counts(mean, seed=7)
    np.testing.assert_array_equal(mph.sample_counts(mean, seed=7), counts)
    other = mean.copy()
    other[[0, 1, 3]] *= 10
    np.testing.assert_array_equal(mph.sample_counts(other, seed=7)[2], counts[2])
    np.testing.assert_array_equal(mph.sample_counts(mean[:3], seed=7), counts[:3])
    assert (mph.sample_counts(mean, seed=8) != counts).any()
    assert (mph.sample_counts(mean[[0, 0]], seed=7)[0] != mph.sample_counts(mean[[0, 0]], seed=7)[1]).any()
    for bad in (-mean, np.full((1, 2), np.nan), np.full((1, 2), 1e19), [[1], [1, 2]], 3.0):
        refused(lambda bad=bad: mph.sample_counts(bad, 1))
    for seed in (-1, 1.5):
        refused(lambda seed=seed: mph.sample_counts(mean, seed))


def test_isotopes():
    tc = mph.isotope("Tc-99m")
    assert tc.photons_per_decay(126, 155) == 0.891 and tc.photons_per_decay(30, 100) == 0
    assert tc.mean_decay_time(1e-3) == pytest.approx(1e-3)
    assert tc.mean_decay_time(100 * tc.half_life) == pytest.approx(tc.half_life / np.log(2))
    refused(lambda: mph.isotope("Unobtainium"), "Tl-201")
    for name, isotope in mph.ISOTOPES.items():
        energies, photons = np.transpose(isotope.lines)
        assert isotope.name == name and (np.diff(energies) > 0).all() and 0.005 < photons.min() <= photons.max() <= 2
        low, high = isotope.window
        assert isotope.photons_per_decay(low, high) >= photons.max()


ICRP_107 = {
    "F-18": (1.8295, {511.0: 1.9346}),
    "Ga-67": (78.27, {91.266: 0.0316, 93.311: 0.392, 184.576: 0.212, 208.95: 0.024, 300.219: 0.168, 393.529: 0.0468}),
    "Tc-99m": (6.015, {18.21: 0.02135, 18.33: 0.04059, 20.59: 0.00653, 140.511: 0.89057}),
    "In-111": (67.31, {
        22.96: 0.23957, 23.15: 0.45031, 26.04: 0.03973, 26.08: 0.07718, 26.61: 0.00809, 26.62: 0.01569,
        171.28: 0.9065, 245.35: 0.9409}),
    "I-123": (13.27, {
        27.19: 0.24978, 27.47: 0.46499, 30.94: 0.04281, 30.99: 0.08304, 31.67: 0.00887, 31.68: 0.01743,
        158.97: 0.833, 528.96: 0.01391}),
    "I-131": (192.5, {
        29.45: 0.01401, 29.78: 0.02594, 80.185: 0.02623, 284.305: 0.06136, 364.489: 0.817, 636.989: 0.07173,
        722.911: 0.01773}),
    "Xe-133": (125.8, {
        30.62: 0.14386, 30.98: 0.26567, 34.93: 0.02517, 34.99: 0.04879, 35.8: 0.0053, 35.82: 0.01032, 80.997: 0.38}),
    "Lu-177": (159.5, {54.72: 0.01632, 55.92: 0.02855, 63.38: 0.00587, 112.95: 0.064, 208.366: 0.11}),
    "Tl-201": (72.91, {
        11.55: 0.01163, 11.86: 0.10552, 11.93: 0.03539, 11.99: 0.01318, 13.88: 0.02108, 69.1: 0.2736, 71.07: 0.46371,
        80.08: 0.05122, 80.52: 0.09914, 82.68: 0.01208, 82.79: 0.02365, 83.28: 0.00548, 135.34: 0.02565, 167.43: 0.1}),
}  # fmt: skip
"""Half-lives, h, and photons per decay by their energies, keV: all above 10 keV and 0.5 % of the decays."""


@pytest.mark.parametrize("name", mph.ISOTOPES)
def test_photon_lines_are_those_of_icrp_107_and_half_lives_as_evaluated_there(name):
    hours, lines = ICRP_107[name]
    isotope = mph.ISOTOPES[name]
    assert isotope.half_life / 3600 == pytest.approx(hours, rel=4e-3)
    assert len(isotope.lines) == len(lines)
    np.testing.assert_allclose([energy for energy, _ in isotope.lines], list(lines), rtol=1e-3)
    np.testing.assert_allclose([photons for _, photons in isotope.lines], list(lines.values()), rtol=1e-2)


_IMAGED = {
    "F-18": 511.0, "Ga-67": 93.3, "Tc-99m": 140.5, "In-111": 245.4, "I-123": 159.0, "I-131": 364.5, "Xe-133": 81.0,
    "Lu-177": 208.4, "Tl-201": 71.0,
}  # fmt: skip


@pytest.mark.parametrize("name", mph.ISOTOPES)
def test_the_usual_window_is_around_the_line_that_is_imaged(name):
    assert photon_energy(name) == pytest.approx(_IMAGED[name], rel=2e-3)
    assert mph.isotope(name).window == pytest.approx((0.9 * _IMAGED[name], 1.1 * _IMAGED[name]), rel=2e-3)


def test_an_isotope_counts_its_photons_and_decays(rng):
    """Counts of its lines in the window, from an activity that halves every half-life."""
    system, grid = one_module(), turned_grid((5, 6, 7), 8.0)
    x = rng.random(grid.shape)

    def counts(**options):
        return mph.Projector(grid, system.views((8, 9)), emission(system, **options))(x)

    tl = mph.isotope("Tl-201")
    one = counts()
    np.testing.assert_allclose(counts(isotope=tl, time=0.01), 0.01 * (0.274 + 0.464) * one, rtol=1e-5)
    np.testing.assert_allclose(counts(isotope="Tl-201", window=(150, 180), time=0.01), 0.001 * one, rtol=1e-5)
    two = counts(isotope="Tl-201", time=2 * tl.half_life)
    np.testing.assert_allclose(two, 1.5 * counts(isotope="Tl-201", time=tl.half_life), rtol=1e-5)
    np.testing.assert_allclose(counts(isotope="Tl-201", photons_per_decay=0.5, time=0.01), 0.005 * one, rtol=1e-5)
    record = emission(system, isotope="Tc-99m").record()
    assert (record["isotope"], record["photons_per_decay"]) == ("Tc-99m", 0.891)
    for options, word in (
        ({"isotope": "Xx-1"}, "Tc-99m"),
        ({"isotope": "Tc-99m", "window": (30, 40)}, "its lines: 18.21, 18.33, 20.59, 140.5"),
        ({"window": (10, 20)}, "needs an isotope"),
    ):
        refused(lambda options=options: emission(system, **options), word)
