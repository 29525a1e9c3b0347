"""Photons through the solid of collimators: closed forms, photons traced one by one, adjoint, and walls that stop all."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.geometry.collimator import Collimator, Construction
from mphdrr.core.models.wall_penetration import models_with_walls

from .conftest import WORKBOOK, refused

MU, WALL, PLATE = 0.2, 4.0, 2.0
SIDE, LENGTH = 40.0, 60.0


def two_modules(hole=4.0):
    """Return two modules side by side, 50 mm apart, aimed at the isocentre."""
    places = [[400 * math.sin(t), -400 * math.cos(t), 0.0] for t in (0.0, 0.125)]
    return mph.PinholeSystem(places, hole, LENGTH, SIDE, 10.0, 50.0)


def profile(hole):
    """Return half-widths, mm, of a collimator's front and of its channel's begin, 1 mm before and behind the hole."""
    built = Collimator(hole, LENGTH, SIDE, Construction(PLATE, WALL))
    return built.front_half_width, built.channel_half_width


def beside_and_through(system, **more):
    """Return the models of what comes beside the first module's hole, and through the second one's."""
    given = {"aperture_mu": MU, "wall_thickness": WALL, "aperture_points": 30, "pixel_points": 34, **more}
    _, *parts = models_with_walls(mph.Emission(system, **given))
    return [next(part for part in parts if part.holes[0] == hole) for hole in (0, 1)]


def counted(system, model, place, size, pixels=32, n=1):
    """Return the first module's counts of one decay a second in a cube."""
    grid = mph.Grid.centered((n, n, n), size / n, place)
    return mph.Projector(grid, system.views((pixels, pixels)), model)(np.full(grid.shape, size**-3))[0].sum()


def test_walls_that_stop_all_leave_every_count_as_it_is(rng):
    system = two_modules()
    x, views = rng.random((6, 6, 6)), system.views((12, 12))

    def images(**more):
        model = mph.Emission(system, aperture_mu=MU, **more)
        return mph.Projector(mph.Grid.centered((6, 6, 6), 40.0), views, model)(x)

    plain = images()
    np.testing.assert_array_equal(images(wall_thickness=500.0), plain)
    leaky = images(wall_thickness=WALL)
    assert (leaky >= plain).all() and leaky.sum() > 1.01 * plain.sum()


def traced(system, place, size, points, areas, of_hole, rng):
    """Return the first crystal's counts of a decay a second in a cube, and their standard deviation.

    Photons go from random places of it to random points of a plane, each of which stands for its area. Steps between
    collisions are exponential, in a material that fills everything: where it is none, they are not counted.
    """
    n, (hole, normal) = len(points), (1 if of_hole else 0, system.frames()[1 if of_hole else 0, 2])
    start = place + size * (rng.random((n, 3)) - 0.5)
    distance = np.linalg.norm(start - points, axis=1)
    way = (points - start) / distance[:, None]
    weight = areas * -(way @ normal) / (4 * math.pi * distance**2)
    (u, v, k), front = system.frames()[0], system.centers[0] - LENGTH * system.frames()[0, 2]
    far = (front - points) @ k / (way @ k)
    end = points + far[:, None] * way - front
    passed = (np.abs(end @ u) < SIDE / 2) & (np.abs(end @ v) < SIDE / 2)
    if of_hole:
        passed &= -(way @ normal) > math.cos(math.pi / 4)
    front_half, channel_half = profile(4.0)
    alive, at = np.flatnonzero(passed), np.full(n, -20.0)
    while len(alive):
        at[alive] += rng.exponential(1 / MU, len(alive))
        alive = alive[at[alive] < far[alive]]
        places = points[alive] + at[alive, None] * way[alive]
        stopped = np.zeros(len(alive), bool)
        for m in {0, hole}:
            x, y, up = system.frames()[m] @ (places - system.centers[m]).T
            widest, s = np.maximum(np.abs(x), np.abs(y)), -up
            outside = front_half + (SIDE / 2 + WALL - front_half) * (s + 1) / (LENGTH + 1)
            channel = channel_half + (SIDE / 2 - channel_half) * (s - 1) / (LENGTH - 1)
            first = -1.0 if m == 0 else 1.0
            stopped |= (s > first) & (s < LENGTH) & (widest < outside) & ~((s > 1) & (widest < channel))
        passed[alive[stopped]] = False
        alive = alive[~stopped]
    counted = weight * passed
    return counted.mean(), counted.std() / math.sqrt(n)


def test_photons_one_by_one_through_a_neighbours_hole(rng):
    system, size, n = two_modules(), 6.0, 2**20
    _, through = beside_and_through(system)
    (u, _, k), q = system.frames()[0], system.centers[1]
    pixel = system.centers[0] - LENGTH * k + 0.3 * SIDE * u * np.sign((q - system.centers[0]) @ u)
    place = q + 1.5 * (q - pixel)  # the first crystal sees it through the second module's hole
    radius, (u, v, _) = through.scanner.effective_diameter[1] / 2, system.frames()[1]
    angle, r = 2 * math.pi * rng.random(n), radius * np.sqrt(rng.random(n))
    points = system.centers[1] + (r * np.cos(angle))[:, None] * u + (r * np.sin(angle))[:, None] * v
    mean, sd = traced(system, place, size, points, math.pi * radius**2, True, rng)
    assert abs(counted(system, through, place, size) - mean) < 3 * sd


@pytest.mark.parametrize("plate", [None, PLATE])
def test_photons_one_by_one_beside_the_hole(rng, plate):
    system, size, n, place = two_modules(), 60.0, 2**20, np.array([5.0, 3.0, -4.0])
    given = {} if plate is None else {"edge": "path", "plate_thickness": plate}
    beside, _ = beside_and_through(system, **given, pixel_points=None)
    reach = SIDE / 2 + WALL
    across = reach * (2 * rng.random((n, 2)) - 1)
    is_open = np.abs(across).max(axis=1) > profile(4.0)[0] if plate is None else np.hypot(*across.T) > 2.0
    points = system.centers[0] + across @ system.frames()[0, :2]
    mean, sd = traced(system, place, size, points, 4 * reach**2 * is_open, False, rng)
    assert abs(counted(system, beside, place, size, n=8) - mean) < 3 * sd


@pytest.mark.filterwarnings("ignore:.*points of each pixel")
def test_adjoint_subsets_and_efficiency_with_walls(rng):
    system = mph.read_system(WORKBOOK)[[0, 1, 20, 21]]
    model = mph.Emission(
        system, isotope="I-131", aperture_mu="tungsten", crystal_mu="NaI", wall_thickness=2.0, lines="apart",
        time=np.arange(1.0, 5), efficiency=rng.random(4), intrinsic_fwhm=2.0, window=(280, 370), aperture_points=3,
        pixel_points=3,
    )  # fmt: skip
    A = mph.Projector(mph.Grid.centered((6, 6, 6), 30.0), system.views((10, 10)), model, double=True)
    x, y = rng.random(A.shape_in), rng.random(A.shape_out)
    images = A(x)
    assert (images * y).sum() == pytest.approx((x * A.T(y)).sum(), rel=1e-6)
    for part in A.subsets(2):
        np.testing.assert_allclose(part(x), images[part.which], rtol=1e-9)
    plain = mph.Projector(A.grid, A.views, replace(model, wall_thickness=None), double=True)
    assert (images > plain(x)).all()


def test_walls_are_refused_where_they_say_nothing():
    system = two_modules()
    refused(lambda: mph.Emission(system, wall_thickness=2.0), "wall_thickness", "aperture_mu")
    refused(lambda: mph.Emission(system, aperture_mu=1.0, wall_thickness=-2.0), "wall_thickness", "-2")
