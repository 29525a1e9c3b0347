"""Laws of the modules' field of view, sensitivity and resolution."""

import math

import numpy as np
import pytest

import mphdrr.core as mph

EDGE = {"aperture_mu": 3.4, "opening_angle": 1.2}


def test_a_module_sees_what_its_crystal_shows(system, rng):
    """The projection matrices of views that cover the crystal agree."""
    points = rng.uniform(-250, 250, (3000, 3))
    matrices = system.views(shape=(8, 8), detector="real").projection_matrices()
    projected = np.einsum("mij,pj->pmi", matrices, np.c_[points, np.ones(len(points))])
    pixel = projected[..., :2] / projected[..., 2:]
    inside = (projected[..., 2] > 0) & np.all(np.abs(pixel - 3.5) <= 4, axis=2)
    assert np.array_equal(mph.seen(system, points), inside)
    assert 0.05 < inside.mean() < 0.95


def test_sensitivity_is_the_law_of_the_point_source(system, rng):
    """Photons d_e^2 sin^3 / (16 h^2) and the share that the crystal stops, where a module sees the point."""
    points = rng.uniform(-60, 60, (40, 3))
    rays = points[:, None] - system.centers
    u, v, h = np.einsum("maj,pmj->apm", system.frames(), rays)
    sine, d = h / np.linalg.norm(rays, axis=2), system.pinhole_diameter
    stopped = 1 - np.exp(-0.3 * system.detector_thickness / sine)
    counts = 0.9 * d * (d + 2 / 3.4 * math.tan(0.6)) * sine**3 / (16 * h**2) * stopped
    reach = system.detector_side / 2 * h / system.collimator_length
    expected = np.where(np.maximum(abs(u), abs(v)) <= reach, counts, 0)
    result = mph.sensitivity(system, points, crystal_mu=0.3, photons_per_decay=0.9, **EDGE)
    np.testing.assert_allclose(result, expected, rtol=1e-12)
    assert 0 < np.count_nonzero(expected) < expected.size


def test_resolution_is_the_width_of_the_shadow_in_object_space(system, rng):
    points = rng.uniform(-60, 60, (40, 3))
    h = np.einsum("pmi,mi->pm", points[:, None] - system.centers, system.principal_rays)
    l, d = system.collimator_length, system.pinhole_diameter
    assert np.allclose(mph.magnification(system, points), l / h)
    found = mph.resolution(system, points, intrinsic_fwhm=3.0, **EDGE)
    # Through the edge at the rim's half-value diameter half of the photons pass: exp(-mu 2 (r - d/2) / tan(alpha/2)).
    d_re = np.sqrt(found**2 - (3.0 * h / l) ** 2) / (1 + h / l)
    half = np.exp(-3.4 * (d_re - d) / math.tan(0.6))
    visible = mph.seen(system, points)
    assert np.allclose(half[visible], 0.5)
    assert np.array_equal(np.isnan(found), ~visible)


def test_what_is_behind_is_neither_seen_nor_imaged():
    one = mph.PinholeSystem(np.array([[0.0, 200, 0]]), 2.0, 80.0, 50.0, 10.0, 60.0)
    behind = [[0.0, 300, 0], [0.0, 200, 0]]
    assert not mph.seen(one, behind).any() and not mph.sensitivity(one, behind, crystal_mu=0.2).any()
    assert np.isnan(mph.resolution(one, behind)).all() and np.isnan(mph.magnification(one, behind)).all()


def test_isocentre_from_the_numbers_of_a_module_is_that_of_the_points(system):
    system = system.replace(tilt=0.0)
    sizes = ("pinhole_distance", "pinhole_diameter", "collimator_length", "detector_side", "detector_thickness")
    numbers, origin = [getattr(system, name) for name in sizes], np.zeros((1, 3))
    counts = {"crystal_mu": 0.2, "photons_per_decay": 0.5}
    performance = mph.isocentre_performance(*numbers, intrinsic_fwhm=2.5, **EDGE, **counts)
    for value, expected in (
        (performance.sensitivity, mph.sensitivity(system, origin, **EDGE, **counts)),
        (performance.resolution, mph.resolution(system, origin, intrinsic_fwhm=2.5, **EDGE)),
        (performance.magnification, mph.magnification(system, origin)),
    ):
        np.testing.assert_allclose(value, expected[0], rtol=1e-13)
    first = mph.isocentre_performance(*(x[0] for x in numbers), intrinsic_fwhm=2.5, **EDGE, **counts)
    np.testing.assert_allclose(first, [values[0] for values in performance], rtol=1e-14)


def test_roi_radius_seen_inverts_the_design_formula(rng):
    d, side, radius = rng.uniform(0.5, 4, 999), rng.uniform(5, 70, 999), rng.uniform(1, 150, 999)
    b = radius * rng.uniform(1.01, 5, 999)
    length = mph.collimator_length(b, d, side, radius)
    assert np.allclose(mph.roi_radius_seen(b, d, side, length), radius, rtol=1e-12)
    assert mph.roi_radius_seen(100, 5, 6, 1000) == 0  # even the isocentre is not seen through the whole hole


def test_the_roi_that_is_seen_is_the_largest(system, rng):
    """Rays through all of the hole's rim from the sphere just meet the crystal."""
    radius = mph.isocentre_performance(
        system.pinhole_distance, system.pinhole_diameter, system.collimator_length, system.detector_side, 10.0
    ).roi_radius_seen
    turn = np.linspace(0, 2 * np.pi, 721)
    for m in range(len(system)):
        l, d = system.collimator_length[m], system.pinhole_diameter[m]
        sphere = np.stack([radius[m] * np.cos(turn), system.pinhole_distance[m] + radius[m] * np.sin(turn)])
        hits = [edge - (x - edge) * l / h for x, h in sphere.T for edge in (-d / 2, d / 2)]
        assert np.abs(hits).max() == pytest.approx(system.detector_side[m] / 2, rel=1e-4)
        assert np.abs(hits).max() <= system.detector_side[m] / 2 * (1 + 1e-12)


POINT = [[0, 0, 0]]
REFUSALS = [
    (lambda s: mph.seen(s, [1, 2, 3]), "points"),
    (lambda s: mph.seen(s, [[1, 2, math.nan]]), "points"),
    (lambda s: mph.sensitivity(s, POINT, aperture_mu=0), "aperture_mu"),
    (lambda s: mph.sensitivity(s, POINT, crystal_mu=-1), "crystal_mu"),
    (lambda s: mph.sensitivity(s, POINT, photons_per_decay=math.inf), "photons_per_decay"),
    (lambda s: mph.sensitivity(s, POINT, aperture_mu=[1.0, 2.0]), "aperture_mu: expected one number, or one for each"),
    (lambda s: mph.sensitivity(s, POINT, crystal_mu=12 * [0.0]), "crystal_mu: expected more than 0"),
    (lambda s: mph.sensitivity(s, POINT, opening_angle=3.2), "opening_angle: expected less than pi"),
    (lambda s: mph.sensitivity(s, POINT, edge="path"), ".*needs aperture_mu"),
    (lambda s: mph.sensitivity(s, POINT, depth_layers=2), ".*needs crystal_mu"),
    (lambda s: mph.resolution(s, POINT, opening_angle=math.pi), "opening_angle"),
    (lambda s: mph.resolution(s, POINT, intrinsic_fwhm=-3), "intrinsic_fwhm"),
    (lambda s: mph.roi_radius_seen(100, 2, 50, 0), "l, the collimator length"),
    (lambda s: mph.collimator_length("far", 2, 50, 75), "b, d, Ld, R: expected real numbers"),
    (lambda s: mph.roi_radius_seen(100, 2, [50, 60, 70], [40, 50]), "b, d, Ld, l: expected real numbers"),
    (lambda s: mph.sensitivity("scanner.xlsx", POINT), "system: expected a PinholeSystem, got str"),
    (lambda s: mph.sampling_gaps("scanner.xlsx", POINT), "system: expected a PinholeSystem, got str"),
    (lambda s: mph.resolution_map("scanner.xlsx", mph.Grid.centered(3, 1)), "system: expected a PinholeSystem"),
    (lambda s: mph.modules_map(s, (3, 3, 3)), "grid: expected a Grid, got tuple"),
    (lambda s: mph.modules_map(s, mph.Grid.centered(100_000, 1.0)), ".*memory"),
    (lambda s: mph.sensitivity_map(s, mph.Grid.centered(3, 10.0), crystal_mu=-1), "crystal_mu"),
    (lambda s: mph.completeness_map(s, mph.Grid.centered(3, 10.0), tolerance=1e-9), ".*tolerance"),
    (lambda s: mph.check_geometry("scanner.xlsx"), "check_geometry: expected a PinholeSystem, got str"),
    (lambda s: mph.fit_rings("scanner.xlsx"), "fit_rings: expected a PinholeSystem, got str"),
]


@pytest.mark.parametrize(("call", "words"), REFUSALS)
def test_what_cannot_be_is_refused_by_name(system, call, words):
    with pytest.raises(mph.InputError, match=f"^{words}"):
        call(system)


def test_poses_and_points_move_together(system, rng):
    """A point in a module's frame has the same performance wherever the module is."""
    local = np.array([10.0, -6.0, 150.0, 1.0])
    first, other = system[0:1], rng.normal(size=3)
    other *= system.pinhole_distance[0] / np.linalg.norm(other)
    arrays = {name: getattr(first, name) for name in ("pinhole_diameter", "collimator_length", "detector_side")}
    moved = mph.PinholeSystem(
        other[None], **arrays, detector_thickness=first.detector_thickness, roi_radius=75.0, tilt=rng.normal(size=3)
    )
    values = [mph.sensitivity(s, (s.poses()[0] @ local)[None, :3])[0, 0] for s in (first, moved)]
    assert values[0] == pytest.approx(values[1], rel=1e-12)
