"""The depth-dependent response with paths through the knife edge and depths in the crystal: laws, and photons one by one."""

from __future__ import annotations

import math

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.physics.aperture import KnifeEdge
from mphdrr.core.physics.performance import sensitivity

from .conftest import WORKBOOK, refused, voxel_centers
from .traced_photons import image_of_voxel, in_blocks, misplaced, module, traced_image

TUNGSTEN = 3.6
IODIDE = 0.26
PLACES = [(0.0, 0.0, 200.0), (3.1, -2.2, 150.0), (50.0, 30.0, 190.0), (-60.0, 55.0, 220.0)]
"""On the axis, near it, and twice off it, (u, v, depth), mm."""


def bound(place):
    return 0.01 if np.hypot(*place[:2]) < 10 else 0.02


@pytest.mark.parametrize("degrees", [0.0, 20.0, 40.0, 60.0])
def test_what_passes_the_solid_plate_falls_with_its_length_there(degrees):
    psi, edge = math.radians(degrees), KnifeEdge(1.0, 0.4, 1.0, 3.0)
    slope = np.float64(math.tan(psi))
    passed = edge.transmission(np.float64(40.0), np.float64(3.0), slope, np.float64(0.0))
    assert passed == pytest.approx(math.exp(-0.4 * 3.0 / math.cos(psi)), rel=1e-4)


def test_on_the_axis_the_total_is_metzlers():
    for mu in (1.2, TUNGSTEN):
        total = image_of_voxel(module(), (0, 0, 200), 64, edge="path", aperture_mu=mu).sum()
        squared = 2.3**2 + 2 * 2.3 / mu + 2 / mu**2
        assert total == pytest.approx(squared / (16 * 200**2), rel=2e-3)


@pytest.mark.parametrize("plate", [None, 2.0])
def test_anywhere_the_total_is_the_sensitivity(plate):
    model = {"edge": "path", "aperture_mu": TUNGSTEN, "plate_thickness": plate}
    system = module()
    for place in PLACES:
        at = system.centers[0] + np.asarray(place) @ system.frames()[0]
        (law,) = sensitivity(system, at[None], optics=mph.Emission(system, **model).optics)[0]
        assert image_of_voxel(system, place, 64, **model).sum() == pytest.approx(
            law, rel=1e-3 if plate is None else 2e-3
        )


@pytest.mark.parametrize("deep", [{}, {"crystal_mu": IODIDE, "depth_layers": 8}])
@pytest.mark.parametrize("place", PLACES[1:3])
def test_a_point_has_the_image_of_photons_one_by_one(place, deep):
    system = module()
    exact = traced_image(system, place, 48, edge_mu=TUNGSTEN, crystal_mu=deep.get("crystal_mu"))
    by_path, paix = (
        image_of_voxel(system, place, 48, edge=edge, aperture_mu=TUNGSTEN, **deep) for edge in ("path", "paix")
    )
    assert misplaced(by_path, exact) < bound(place)
    assert by_path.sum() == pytest.approx(exact.sum(), rel=3e-3)
    assert misplaced(paix, exact) > 3 * misplaced(by_path, exact)


@pytest.mark.long
@pytest.mark.parametrize(("edge_mu", "plate", "crystal_mu", "within"), [
    (TUNGSTEN, None, None, 1.0), (TUNGSTEN, 2.0, None, 1.0), (0.9, None, None, 1.5), (0.6, 4.0, None, 2.5),
    *((edge_mu, None, crystal_mu, 2.0) for edge_mu in (None, TUNGSTEN) for crystal_mu in (IODIDE, 0.08)),
])  # fmt: skip
def test_so_it_has_for_any_pixels_edges_plates_and_crystals(edge_mu, plate, crystal_mu, within):
    system = module()
    edge = {} if edge_mu is None else {"edge": "path", "aperture_mu": edge_mu, "plate_thickness": plate}
    crystal = {} if crystal_mu is None else {"crystal_mu": crystal_mu, "depth_layers": 2}
    for place in PLACES[1:3]:
        fine = traced_image(system, place, 96, n=2**20, edge_mu=edge_mu, plate=plate or 20.0, crystal_mu=crystal_mu)
        for pixels, exact in ((96, fine), (32, in_blocks(fine, 3))):
            image = image_of_voxel(system, place, pixels, **edge, **crystal)
            assert misplaced(image, exact) < within * bound(place)
            assert crystal_mu is None or image.sum() == pytest.approx(exact.sum(), rel=4e-3)


def law_of_voxel(system, at, size, mu, n=2000):
    """Return the total of a voxel at `at`: solid angle times the share that the crystal absorbs, over hole and voxel."""
    u, v, k = system.frames()[0]
    random = (0.5 + np.arange(n)[:, None] / 1.1673039782614187 ** np.arange(1, 6)) % 1  # R5 of M. Roberts
    points = (random[:, :3] - 0.5) * size + at - system.centers[0]
    radius, angle = system.pinhole_diameter[0] / 2 * np.sqrt(random[:, 3]), 2 * math.pi * random[:, 4]
    h = points @ k
    slope = np.hypot(points @ u - radius * np.cos(angle), points @ v - radius * np.sin(angle)) / h
    secant = np.hypot(1, slope)
    absorbed = -np.expm1(-mu * system.detector_thickness[0] * secant)
    return size**3 * system.pinhole_diameter[0] ** 2 / 16 * np.mean(absorbed / (h**2 * secant**3))


@pytest.mark.parametrize(("crystal", "thickness", "pixels", "size", "voxels"), [
    ("NaI", 10.0, 64, 1.0, 150), ("CZT", 10.0, 64, 1.0, 150),
    *(pytest.param(*case, 1000, marks=pytest.mark.long) for case in (
        ("NaI", 10.0, 128, 0.3), ("NaI", 10.0, 64, 0.3), ("NaI", 10.0, 64, 2.0), ("NaI", 10.0, 64, 8.0),
        ("NaI", 3.0, 128, 2.0), ("CZT", 10.0, 128, 2.0), ("CZT", 5.0, 64, 1.0), ("CZT", 1.0, 64, 2.0))),
])  # fmt: skip
def test_with_depths_the_total_of_every_voxel_is_the_law(crystal, thickness, pixels, size, voxels, rng):
    """In the module of the shortest collimator, whose pixels' kernels differ most from node to node."""
    system = mph.read_system(WORKBOOK)[[27]].replace(detector_thickness=thickness)
    n = min(64, round(128 / size))
    grid, mu = mph.Grid.centered(n, size), mph.attenuation(crystal, 140.5)
    model = mph.Emission(system, hole="depth", crystal_mu=mu, depth_layers=2)
    A = mph.Projector(grid, system.views((pixels, pixels)), model)
    totals, centers = A.T(np.ones(A.shape_out)), voxel_centers(grid)
    u, v, k = np.moveaxis((centers - system.centers[0]) @ system.frames()[0].T, -1, 0)
    l, side = system.collimator_length[0] + thickness, system.detector_side[0]
    reach = np.maximum(np.abs(u), np.abs(v)) * l / k + (2.3 + 2 * size) * (1 + l / k) / 2
    seen = np.argwhere((reach < side / 2) & (np.linalg.norm(centers, axis=-1) < n * size / 2))
    errors = [
        totals[tuple(index)] / law_of_voxel(system, centers[tuple(index)], size, mu) - 1
        for index in rng.permutation(seen)[:voxels]
    ]
    assert len(errors) > 100 and np.abs(errors).max() < 3e-3


@pytest.mark.parametrize("mu", [0.08, IODIDE])
def test_the_mean_shift_is_that_of_exponential_absorption(mu):
    system, thickness, place = module(), 10.0, (50.0, 0.0, 200.0)
    across, means = (np.arange(160) - 79.5) * 50 / 160, []
    for layers in (1, 2):
        image = image_of_voxel(system, place, 160, crystal_mu=mu, depth_layers=layers)
        means.append((image.sum(axis=0) * across).sum() / image.sum())
    psi = math.atan2(place[0], place[2])
    tau = mu * thickness / math.cos(psi)
    law = math.tan(psi) * math.cos(psi) / mu * (1 - tau * math.exp(-tau) / -math.expm1(-tau))
    assert abs(means[1] - means[0]) == pytest.approx(law, rel=5e-3)


@pytest.mark.parametrize("within", ["within_crystal", "within_walls"])
def test_beyond_the_crystals_side_nothing_is_recorded(within):
    system = module(detector_side=40.0)
    views = system.views((60, 60), "real", pitch=1.0)
    grid = mph.Grid.centered((9, 9, 9), 12.0)
    model = mph.Emission(system, crystal_mu=IODIDE, depth_layers=8, **{within: True})
    image = mph.Projector(grid, views, model)(np.ones(grid.shape))[0]
    assert image[10:50, 10:50].min() > 0
    image[10:50, 10:50] = 0
    assert not image.any()


def test_a_thin_plate_is_warned_of_and_paix_has_none():
    system = module()
    grid, views = mph.Grid.centered((4, 4, 4), 5.0), system.views((8, 8))
    with pytest.warns(UserWarning, match="through the solid plate"):
        mph.Projector(grid, views, mph.Emission(system, edge="path", aperture_mu=0.6, plate_thickness=2.0))
    refused(lambda: mph.Emission(system, aperture_mu=3.0, plate_thickness=2.0), "plate_thickness", "edge 'path'")
