"""Laws of the modules' field of view, sensitivity and resolution."""

from __future__ import annotations

import math

import numpy as np
import pytest

import mphdrr.core as mph

from .conftest import refused

EDGE = {"aperture_mu": 3.4, "opening_angle": 1.2}


def points_around(rng, n=40, size=60.0):
    return rng.uniform(-size, size, (n, 3))


def test_a_module_sees_what_its_crystal_shows(system, rng):
    """The projection matrices of views that cover the crystal agree."""
    points = points_around(rng, 3000, 250)
    n = 8
    matrices = system.views(shape=(n, n), detector="real").projection_matrices()
    projected = np.einsum("mij,pj->pmi", matrices, np.c_[points, np.ones(len(points))])
    pixel = projected[..., :2] / projected[..., 2:]
    inside = (projected[..., 2] > 0) & np.all(np.abs(pixel - (n - 1) / 2) <= n / 2, axis=2)
    assert np.array_equal(mph.seen(system, points), inside)
    assert 0.05 < inside.mean() < 0.95


def law_of_the_point_source(system, point, crystal_mu, photons):
    """Counts per decay (M,) with `EDGE`, module by module."""
    expected = np.zeros(len(system))
    for m in range(len(system)):
        u, v, k = system.frames()[m]
        ray = point - system.centers[m]
        h = ray @ k
        reach = system.detector_side[m] / 2 * h / system.collimator_length[m]
        if h > 0 and max(abs(ray @ u), abs(ray @ v)) <= reach:
            sine = h / np.linalg.norm(ray)
            d = system.pinhole_diameter[m]
            d_e_squared = d * (d + 2 / 3.4 * math.tan(0.6))
            stopped = 1 - math.exp(-crystal_mu * system.detector_thickness[m] / sine)
            expected[m] = photons * d_e_squared * sine**3 / (16 * h**2) * stopped
    return expected


def test_sensitivity_is_the_law_of_the_point_source(system, rng):
    points = points_around(rng)
    expected = np.array([law_of_the_point_source(system, point, 0.3, 0.9) for point in points])
    found = mph.sensitivity(system, points, crystal_mu=0.3, photons_per_decay=0.9, **EDGE)
    assert np.allclose(found, expected, rtol=1e-12)
    assert 0 < np.count_nonzero(expected) < expected.size


def test_sensitivity_is_what_emission_counts(system):
    """A small voxel's counts, summed over a crystal of fine pixels, for every setting in common."""
    grid = mph.Grid.centered(1, 3.0, (8.0, -5.0, 11.0))
    settings = {"crystal_mu": 0.25, "photons_per_decay": 0.88, **EDGE}
    for whole in ({}, settings):
        model = mph.Emission(system, within_crystal=True, **whole)
        views = system.views(shape=(256, 256), detector="real", pitch=0.1)
        counts = mph.Projector(grid, views, model)(np.ones(grid.shape)).sum(axis=(1, 2), dtype=np.float64)
        expected = mph.sensitivity(system, [grid.center], **whole)[0] * grid.voxel_volume
        assert np.allclose(counts, expected, rtol=0.015)


def test_resolution_is_the_width_of_the_shadow_in_object_space(system, rng):
    points = points_around(rng)
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
    assert not mph.seen(one, behind).any()
    assert np.all(mph.sensitivity(one, behind, crystal_mu=0.2) == 0)
    assert np.isnan(mph.resolution(one, behind)).all()
    assert np.isnan(mph.magnification(one, behind)).all()


def test_isocentre_from_the_numbers_of_a_module_is_that_of_the_points(system):
    system = system.replace(tilt=0.0)
    names = ("pinhole_distance", "pinhole_diameter", "collimator_length", "detector_side", "detector_thickness")
    numbers = [getattr(system, name) for name in names]
    counts = {"crystal_mu": 0.2, "photons_per_decay": 0.5}
    found = mph.isocentre_performance(*numbers, intrinsic_fwhm=2.5, **EDGE, **counts)
    origin = np.zeros((1, 3))
    assert np.allclose(found.sensitivity, mph.sensitivity(system, origin, **EDGE, **counts)[0], rtol=1e-13)
    assert np.allclose(found.resolution, mph.resolution(system, origin, intrinsic_fwhm=2.5, **EDGE)[0], rtol=1e-13)
    assert np.allclose(found.magnification, mph.magnification(system, origin)[0], rtol=1e-13)
    first = mph.isocentre_performance(*(x[0] for x in numbers), intrinsic_fwhm=2.5, **EDGE, **counts)
    assert all(float(one) == pytest.approx(many[0], rel=1e-14) for one, many in zip(first, found, strict=True))


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


@pytest.mark.parametrize(
    ("call", "names"),
    [
        (lambda s: mph.seen(s, [1, 2, 3]), "points"),
        (lambda s: mph.seen(s, [[1, 2, math.nan]]), "points"),
        (lambda s: mph.sensitivity(s, [[0, 0, 0]], aperture_mu=0), "aperture_mu"),
        (lambda s: mph.sensitivity(s, [[0, 0, 0]], crystal_mu=-1), "crystal_mu"),
        (lambda s: mph.sensitivity(s, [[0, 0, 0]], photons_per_decay=math.inf), "photons_per_decay"),
        (lambda s: mph.resolution(s, [[0, 0, 0]], opening_angle=math.pi), "opening_angle"),
        (lambda s: mph.resolution(s, [[0, 0, 0]], intrinsic_fwhm=-3), "intrinsic_fwhm"),
        (lambda s: mph.roi_radius_seen(100, 2, 50, 0), "l, the collimator length"),
        (lambda s: mph.collimator_length("far", 2, 50, 75), "b, d, Ld, R: expected real numbers"),
        (lambda s: mph.roi_radius_seen(100, 2, [50, 60, 70], [40, 50]), "b, d, Ld, l: expected real numbers"),
        (lambda s: mph.sensitivity("scanner.xlsx", [[0, 0, 0]]), "system: expected a PinholeSystem, got str"),
        (lambda s: mph.sampling_gaps("scanner.xlsx", [[0, 0, 0]]), "system: expected a PinholeSystem, got str"),
        (lambda s: mph.resolution_map("scanner.xlsx", mph.Grid.centered(3, 1)), "system: expected a PinholeSystem"),
        (lambda s: mph.modules_map(s, (3, 3, 3)), "grid: expected a Grid, got tuple"),
        (lambda s: mph.check_geometry("scanner.xlsx"), "check_geometry: expected a PinholeSystem, got str"),
        (lambda s: mph.fit_rings("scanner.xlsx"), "fit_rings: expected a PinholeSystem, got str"),
    ],
)
def test_what_cannot_be_is_refused_by_name(system, call, names):
    refused(lambda: call(system), f"^{names}")


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
