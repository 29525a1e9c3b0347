"""Laws of generated systems, and of the parameters found for given ones."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import mphdrr.core as mph

from .conftest import refused

MODULE = {"pinhole_diameter": 2.3, "detector_side": 50.0, "detector_thickness": 10.0, "roi_radius": 75.0}
# An ellipse that is off the isocentre and turned.
TILTED = {"semi_axes": (270.0, 210.0), "center": (30.0, -40.0), "rotation": 0.4}


@pytest.mark.parametrize(("start", "end"), [(0.3, 4.4), (4.4, 0.3), (-1.0, -1.0 + 2 * math.pi)])
def test_rings_stand_on_their_ellipse_evenly(start, end):
    system = mph.ellipse_rings(24, z=(-70.0, -24.0), start=start, end=end, mirrored=True, **TILTED, **MODULE)
    assert len(system) == 96
    c, s = math.cos(TILTED["rotation"]), math.sin(TILTED["rotation"])
    turned = (system.centers[:, :2] - TILTED["center"]) @ np.array([[c, -s], [s, c]])
    assert np.allclose(((turned / TILTED["semi_axes"]) ** 2).sum(axis=1), 1, atol=1e-12)
    assert np.allclose(system.centers.reshape(4, 24, 3)[:, :, 2], np.array([[-70], [-24], [24], [70]]))
    azimuths = np.unwrap(np.arctan2(*system.centers[:24, 1::-1].T))
    closed = abs(end - start) > 6.28
    assert np.allclose(np.diff(azimuths), (end - start) / (24 if closed else 23))
    assert math.cos(azimuths[0] - start) == pytest.approx(1)
    b = system.pinhole_distance
    assert np.allclose(system.collimator_length, mph.collimator_length(b, 2.3, 50.0, 75.0))


def test_equal_arcs_are_equally_long():
    system = mph.ellipse_rings(13, z=0.0, start=0.5, end=5.0, spacing="arc", **TILTED, **MODULE)
    azimuths = np.unwrap(np.arctan2(system.centers[:, 1], system.centers[:, 0]))
    lengths = []
    for first, last in itertools.pairwise(azimuths):
        fine = mph.ellipse_rings(np.linspace(first, last, 20001), z=0.0, **TILTED, **MODULE)
        lengths.append(np.linalg.norm(np.diff(fine.centers, axis=0), axis=1).sum())
    assert np.ptp(lengths) < 1e-4
    assert azimuths[[0, -1]] == pytest.approx([0.5, 5.0])


def test_plates_carry_their_modules_evenly(rng):
    corners = mph.regular_polygon(5, 230.0, rotation=0.7)
    middles = (corners + np.roll(corners, -1, axis=0)) / 2
    assert np.allclose(middles[0], [230 * math.cos(0.7), 230 * math.sin(0.7)])
    assert np.allclose(np.linalg.norm(middles, axis=1), 230)
    counts = [3, 0, 4, 1, 2]
    system = mph.plate_rings(counts, corners, (-20.0, 30.0), collimator_length=60.0, **MODULE)
    assert len(system) == 20
    assert np.all(system.collimator_length == 60)
    first = 0
    for n, start, end in zip(counts, corners, np.roll(corners, -1, axis=0), strict=True):
        places = system.centers[first : first + n, :2]
        along = (places - start) @ (end - start) / ((end - start) @ (end - start))
        assert np.allclose(along, (np.arange(n) + 0.5) / n)
        assert np.allclose(places, start + along[:, None] * (end - start))
        first += n
    assert len(mph.plate_rings(2, corners, 0.0, closed=False, **MODULE)) == 8


@pytest.mark.parametrize("spacing", ["angle", "arc"])
@pytest.mark.parametrize("curve", [TILTED, {"semi_axes": 240.0}, {"semi_axes": (200.0, 290.0)}])
@pytest.mark.parametrize(("start", "turn"), [(4.0, -4.5), (2.0, 2.0), (3.0, -1.5), (2.0, 2 * np.pi), (2.0, -2 * np.pi)])
def test_what_was_generated_is_found_again_from_the_first_module(spacing, curve, start, turn):
    made = mph.ellipse_rings(18, z=(-50.0, 10.0), start=start, end=start + turn, spacing=spacing, **curve, **MODULE)
    for ring, fit in enumerate(mph.fit_rings(made)):
        assert np.array_equal(fit.numbers, made.numbers[18 * ring : 18 * ring + 18])
        assert np.allclose(fit.semi_axes, curve["semi_axes"], atol=1e-6)
        assert np.allclose(fit.center, curve.get("center", 0), atol=1e-6)
        assert fit.curve_deviation < 1e-8
        assert fit.even_deviation < 1e-5
        for even, tolerance in ((False, 1e-7), (True, 1e-5)):
            again = mph.ellipse_rings(**fit.parameters(even), **MODULE)
            assert np.allclose(again.centers, made.centers[18 * ring : 18 * ring + 18], atol=tolerance)


def test_the_fit_is_the_nearest_ellipse(rng):
    """For noisy pinholes: no ellipse near it has a smaller sum of squares."""
    made = mph.ellipse_rings(40, z=0.0, **TILTED, **MODULE)
    noisy = mph.PinholeSystem(made.centers + rng.normal(size=(40, 3)) * [2, 2, 0.1], 2.3, 60.0, 50.0, 10.0, 75.0)
    (fit,) = mph.fit_rings(noisy)
    best = np.array([*fit.semi_axes, *fit.center, fit.rotation])

    def squares(p):
        turn = np.linspace(0, 2 * np.pi, 20001)
        curve = np.stack([p[0] * np.cos(turn), p[1] * np.sin(turn)], axis=1)
        c, s = np.cos(p[4]), np.sin(p[4])
        curve = curve @ np.array([[c, s], [-s, c]]) + p[2:4]
        return sum((((curve - x) ** 2).sum(axis=1)).min() for x in noisy.centers[:, :2])

    least = squares(best)
    assert np.sqrt(least / 40) < 2.5
    for i, step in enumerate((0.3, 0.3, 0.3, 0.3, 0.003)):
        for sign in (-1, 1):
            assert squares(best + sign * step * np.eye(5)[i]) > least


def test_the_real_scanner_stands_on_one_ellipse(scanner):
    """Semi-axes of 273 and 220.5 mm, its centre 60 mm from the isocentre; the modules are not evenly spaced."""
    fits = mph.fit_rings(scanner)
    assert [len(fit.numbers) for fit in fits] == [20, 20, 20, 20]
    for ring, fit in enumerate(fits):
        assert np.allclose(fit.semi_axes, [273.0, 220.5], atol=1e-3)
        assert np.allclose(fit.center, [60 / math.sqrt(2), -60 / math.sqrt(2)], atol=1e-3)
        assert abs(fit.rotation) < 1e-5
        assert fit.curve_deviation < 0.001
        assert fit.even_deviation == pytest.approx(8.415, abs=0.01)
        again = mph.ellipse_rings(**fit.parameters(), **MODULE)
        those = scanner[20 * ring : 20 * ring + 20]
        assert np.abs(again.centers - those.centers).max() < 0.001
        assert np.abs(again.collimator_length - those.collimator_length).max() < 0.001


@pytest.mark.parametrize("places", [[[200, 0], [0, 220], [-210, 0]], [[100.0, x] for x in range(-200, 201, 50)]])
def test_rings_that_fit_no_ellipse_get_a_circle(places):
    centers = np.c_[places, np.zeros(len(places))]
    (fit,) = mph.fit_rings(mph.PinholeSystem(centers, 2.3, 60.0, 50.0, 10.0, 75.0))
    distance = np.linalg.norm(centers, axis=1)
    assert np.allclose(fit.semi_axes, distance.mean())
    assert fit.curve_deviation == pytest.approx(np.abs(distance - distance.mean()).max())


def rings(**changes):
    return mph.ellipse_rings(**{"modules": 12, "semi_axes": (250, 230), "z": 20.0, **MODULE, **changes})


def plates(modules, vertices):
    return mph.plate_rings(modules, vertices, 0.0, **MODULE)


TRIANGLE = mph.regular_polygon(3, 200)
REFUSALS = [
    (lambda: rings(modules=0), "modules"),
    (lambda: rings(modules=2.5), "modules: expected a whole number of at least 1"),
    (lambda: rings(modules=10**9), "modules: expected at most 10000"),
    (lambda: rings(semi_axes=(200, -1)), "semi_axes"),
    (lambda: rings(semi_axes=(200, 100, 50)), "semi_axes"),
    (lambda: rings(center=(0, 400)), "isocentre must be inside"),
    (lambda: rings(end=9.0), "full turn"),
    (lambda: rings(spacing="even"), "spacing"),
    (lambda: rings(z=[[1, 2, 3]]), "z: expected"),
    (lambda: rings(z=0.0, mirrored=True), "mirrored"),
    (lambda: rings(start=1.0, end=1.0), "same pinhole centre"),
    (lambda: rings(roi_radius=500.0), "b, the distance from pinhole"),
    (lambda: rings(detector_side=[1.0, 2.0]), "detector_side"),
    (lambda: plates(2, [[1, 2]]), "vertices"),
    (lambda: plates([1, 2], TRIANGLE), "modules"),
    (lambda: plates([1, [2, 3], 1], TRIANGLE), "modules"),
    (lambda: mph.regular_polygon(2, 200), "sides"),
    (lambda: mph.ring_order(TRIANGLE), "ring_order: expected a PinholeSystem"),
]


@pytest.mark.parametrize("refusal", REFUSALS)
def test_what_cannot_be_made_is_refused(refusal):
    refused(*refusal)


def test_a_module_on_the_axis_is_on_no_ring():
    system = mph.PinholeSystem(np.array([[200.0, 0, 0], [0, 0, 250.0]]), 2.3, 60.0, 50.0, 10.0, 75.0)
    refused(lambda: mph.fit_rings(system), "module 2: stands on the z axis")
    (alone,) = mph.fit_rings(system[:1])
    assert np.allclose(mph.ellipse_rings(**alone.parameters(), **MODULE).centers, [[200, 0, 0]])


@settings(max_examples=20, deadline=None)
@given(st.permutations(range(17)), st.booleans(), st.floats(-180, 180))
def test_ring_order_is_along_the_rings_whatever_the_order_was(permutation, closed, start):
    reach = 2 * np.pi if closed else 2.5
    azimuth = np.radians(start) + np.linspace(0, reach, 8, endpoint=not closed)
    rings = [np.column_stack([200 * np.cos(azimuth), 230 * np.sin(azimuth), np.full(8, z)]) for z in (-30.0, 25.0)]
    centers = np.concatenate([*rings, [[190.0, 10.0, 90.0]]])
    mixed = mph.PinholeSystem(centers[list(permutation)], 2.3, 60.0, 50.0, 10.0, 75.0)
    order = mph.ring_order(mixed)
    ordered = mixed[order]
    assert sorted(order) == list(range(17)) and np.all(np.diff(ordered.rings()) >= 0)
    assert np.array_equal(mph.ring_order(ordered), np.arange(17))
    ways = set()
    for ring in (0, 8):  # neighbours follow each other
        steps = np.diff(np.unwrap(np.arctan2(ordered.centers[ring : ring + 8, 1], ordered.centers[ring : ring + 8, 0])))
        assert np.all(steps * steps[0] > 0) and np.abs(steps).max() < 1.0
        ways.add(np.sign(steps[0]))
    assert len(ways) == 1
