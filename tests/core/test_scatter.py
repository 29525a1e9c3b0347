"""Scattered photons beside closed forms, integrals, and photons that really fly (photon_flights.py)."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

import mphdrr.core as mph
from mphdrr.core.physics.photon_scattering import Scatterer, compton_ratio
from mphdrr.core.rays.backends.cpu import MODULE
from mphdrr.core.scatter.body import Body
from mphdrr.core.scatter.histories import Histories, PhotonSource

from . import photon_flights as flights
from .conftest import refused

KEV = 140.5
MU = mph.attenuation("water", KEV)  # 1/mm
WINDOWS = ((126.0, 154.0), (100.0, 126.0))


def ring(n=24, diameter=24.0, distance=220.0, side=320.0, length=60.0, height=60.0):
    """Return modules in three rings, whose holes are wide and whose crystals see all."""
    turn = np.arange(n) * 2.4
    centers = np.stack([distance * np.cos(turn), distance * np.sin(turn), height * (np.arange(n) % 3 - 1)], axis=1)
    return mph.PinholeSystem(centers, diameter, length, side, 9.0, 75.0)


def model(system, isotope="Tc-99m", fwhm=0.1, **options):
    return mph.Emission(system, isotope=isotope, energy_fwhm=fwhm, **options)


def water(grid, density=1.0):
    return mph.Volume(np.full(grid.shape, density * MU, np.float32), grid, "mu")


def point(place=(0.0, 0.0, 0.0)):
    """Return an activity of one decay per s in a voxel of 0.2 mm."""
    pose = np.diag([0.2, 0.2, 0.2, 1.0])
    pose[:3, 3] = place
    return mph.Volume(np.full((1, 1, 1), 125.0, np.float32), mph.Grid((1, 1, 1), pose), "activity")


def histories(body, activity, energy=KEV, seed=0):
    """Return histories of photons of one energy, seen by no module."""
    energies = np.linspace(30.0, energy, 512)
    places = np.zeros(body.grid.shape, np.int32)
    return Histories(
        body, PhotonSource.of(activity, [(energy, 1.0)]), np.zeros(0, MODULE), energies, np.zeros((0, 1, 512), np.float32),
        places, 1, 1, seed, 1, False,
    )  # fmt: skip


def test_photons_pass_a_sphere_unscattered_as_its_radius_says():
    grid, radius = mph.Grid.centered(120, 1.0), 50.0
    x = (np.indices(grid.shape) - 59.5).reshape(3, -1)
    inside = ((x**2).sum(axis=0) < radius**2).reshape(grid.shape)
    body = Body.of(mph.Volume(np.where(inside, MU, 0).astype(np.float32), grid, "mu"), KEV)
    found = histories(body, point()).collisions(40_000)
    collide = found["weight"][found["order"] == 1].sum() / 40_000
    assert 1 - collide == pytest.approx(np.exp(-MU * radius), abs=4 * np.sqrt(0.25 / 1e7))


@pytest.mark.parametrize("energy", [60.0, 140.5, 364.5])
def test_angles_and_energies_after_a_collision_follow_the_cross_sections(energy):
    body = Body.of(water(mph.Grid.centered(20, 100.0)), KEV)
    found = histories(body, point(), energy).collisions(100_000)
    second = np.flatnonzero(found["order"] == 2)
    cosines = np.clip((found["direction"][second] * found["direction"][second - 1]).sum(axis=1), -1, 1)
    scattered = found["energy"][second] < energy * (1 - 1e-12)
    np.testing.assert_allclose(
        found["energy"][second][scattered], energy * compton_ratio(energy, cosines[scattered]), rtol=1e-9
    )
    scatterer = Scatterer("water")
    _, incoherent, coherent = scatterer.coefficients(energy)
    share = incoherent / (incoherent + coherent)
    n = len(second)
    assert scattered.mean() == pytest.approx(share, abs=4 * np.sqrt(share * (1 - share) / n))
    for which, law, bins in ((scattered, scatterer.incoherent, 40), (~scattered, scatterer.coherent, 12)):
        fine = 1 - 2 * np.linspace(0, 1, 200_001) ** 3  # cosines, close to one another where Rayleigh scattering peaks
        middle, width = (fine[1:] + fine[:-1]) / 2, fine[:-1] - fine[1:]
        until = np.concatenate([[0], np.cumsum(law(energy, middle) * width)])
        edges = np.interp(np.linspace(0, until[-1], bins + 1), until, fine)
        counts = np.histogram(cosines[which], edges[::-1])[0]
        assert stats.chisquare(counts).pvalue > 1e-4


def test_weights_are_what_survives_absorption():
    """Photons of the third collision are those of the second times the chances to scatter and to meet again."""
    body = Body.of(water(mph.Grid.centered(20, 100.0)), KEV)
    found = histories(body, point()).collisions(2_000)
    second = np.flatnonzero(found["order"] == 2)
    total, incoherent, coherent = Scatterer("water").coefficients(KEV)
    ratio = found["weight"][second] / found["weight"][second - 1]
    np.testing.assert_allclose(ratio, (incoherent + coherent) / total, rtol=2e-3)


def test_first_collisions_are_an_integral_over_the_body():
    """Over directions and distances from a point in a slab, to a module on its axis."""
    grid, half = mph.Grid.centered((20, 20, 10), 5.0), np.array([50.0, 50.0, 25.0])
    system = mph.PinholeSystem(np.array([[0.0, 0.0, 200.0]]), 1.0, 60.0, 200.0, 9.0, 75.0)
    views, optics, place = system.views((40, 40), "real"), model(system, tolerance=0.002), np.array([6.0, 4.0, -3.0])
    found = mph.scatter_images(
        point(place), water(grid), views, optics, windows=[WINDOWS[0]], orders=2, histories=4_800_000
    )
    u = (np.arange(400) + 0.5) / 400
    cosine, azimuth, step = np.meshgrid(2 * u - 1, 2 * np.pi * u[::4], (np.arange(60) + 0.5) / 60, indexing="ij")
    sine = np.sqrt(1 - cosine**2)
    to = np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), cosine], axis=-1)
    ends = np.min((np.sign(to) * half - place) / to, axis=-1)
    r = step * ends
    places = place + r[..., None] * to
    towards = system.centers[0] - places
    distance = np.linalg.norm(towards, axis=-1)
    towards /= distance[..., None]
    path = np.min((np.sign(towards) * half - places) / towards, axis=-1)
    angle = (towards * to).sum(axis=-1)
    after = KEV * compton_ratio(KEV, angle)
    scatterer = Scatterer("water")
    mu = np.interp(after, flights.ENERGIES, flights.COEFFICIENTS[0])
    share = lambda energies: flights.counted(energies, WINDOWS[0], 0.1, KEV)  # noqa: E731
    seen = scatterer.incoherent(KEV, angle) * share(after) * np.exp(-mu * path)
    seen += scatterer.coherent(KEV, angle) * share(np.full(1, KEV)) * np.exp(-MU * path)
    hole = np.pi / 4 / distance**2 * towards[..., 2]  # its solid angle
    integral = (np.exp(-MU * r) * seen * hole * ends).mean()
    photons = dict(optics.isotope.lines)[KEV] + dict(optics.isotope.weak_lines)[142.6]  # per s
    assert found.by_order[0, 0].sum() == pytest.approx(photons * integral, rel=0.005)


def flown(body, views, lines, windows, n, rng, places, reference):
    """Return counts (W, M, n_v, n_u) and their variances of n photons that really fly, of these lines."""
    counts, variances = (np.zeros((len(windows), len(views), *views.shape)) for _ in range(2))
    density, emitted = body.array / MU, sum(weight for _, weight in lines)
    for _ in range(max(1, n // 500_000)):
        begin = places(min(n, 500_000), rng)
        energies = rng.choice([e for e, _ in lines], len(begin), p=[weight / emitted for _, weight in lines])
        photons = flights.left(density, body.grid.spacing[0], begin, energies, rng)
        was = photons.orders > 0
        photons = flights.Photons(*(part[was] for part in vars(photons).values()))
        shares = [flights.counted(photons.energies, window, 0.1, reference) for window in windows]
        for m in range(len(views)):
            rows, columns, index = flights.seen(photons, views, m, 12.0, 60.0)
            for w, share in enumerate(shares):
                np.add.at(counts[w, m], (rows, columns), emitted / n * share[index])
                np.add.at(variances[w, m], (rows, columns), (emitted / n * share[index]) ** 2)
    return counts, variances


def at(place):
    """Return the places of photons that begin in the voxel of `point`."""
    return lambda n, rng: np.asarray(place) + rng.uniform(-0.1, 0.1, (n, 3))


def compare(found, counts, variances):
    """Compare totals of windows, of modules, and images by chi-square."""
    for w, images in enumerate(found.images):
        sd = np.sqrt(variances[w].sum() + (found.deviation[w] ** 2).sum())
        assert images.sum() == pytest.approx(counts[w].sum(), abs=4 * sd), (w, sd / images.sum())
        sd = np.sqrt(variances[w].sum(axis=(1, 2)) + (found.precision[w] * images.sum(axis=(1, 2))) ** 2)
        deviations = (images.sum(axis=(1, 2)) - counts[w].sum(axis=(1, 2))) / sd
        assert 0.4 < (deviations**2).mean() < 1.8, deviations
    first, weight = found.images[0], variances[0].sum() / counts[0].sum()  # of a photon that flew
    enough = first > 8 * weight
    spread = first * weight + found.deviation[0] ** 2
    chi2 = ((first - counts[0]) ** 2 / np.where(enough, spread, 1))[enough].mean()
    assert 0.7 < chi2 < 1.3, chi2


def lines_of(optics):
    """Return the lines of a model's isotope that can count for anything here."""
    lines = (*optics.isotope.lines, *optics.isotope.weak_lines)
    return [line for line in lines if line[0] > 30 and line[1] > 1e-3]


BOX = (30, 30, 24)
CASES = {
    "the middle of a box": ("Tc-99m", (0.0, 0.0, 0.0), WINDOWS),
    "off its axis": ("Tc-99m", (45.0, -20.0, 10.0), WINDOWS),
    "two lines": ("In-111", (20.0, 10.0, 0.0), ((220.0, 270.0), (150.0, 190.0))),
    "lines above the window": ("I-131", (0.0, 30.0, 20.0), ((328.0, 400.0), (200.0, 260.0))),
}


@pytest.mark.long
@pytest.mark.parametrize("name", CASES)
def test_images_are_those_of_photons_that_really_fly(rng, name):
    isotope, place, windows = CASES[name]
    body, system = water(mph.Grid.centered(BOX, 6.0)), ring()
    views, optics = system.views((16, 16), "real"), model(system, isotope)
    reference = max(optics.isotope.lines, key=lambda line: line[1])[0]
    if reference != KEV:  # mu holds at the strongest line
        body = mph.Volume(body.array * np.float32(mph.attenuation("water", reference) / MU), body.grid, "mu")
    found = mph.scatter_images(point(place), body, views, optics, windows=windows, precision=0.005)
    body = water(body.grid)
    compare(found, *flown(body, views, lines_of(optics), windows, 4_000_000, rng, at(place), reference))


def test_totals_are_those_of_photons_that_really_fly(rng):
    body, system = water(mph.Grid.centered(BOX, 6.0)), ring()
    views, optics = system.views((16, 16), "real"), model(system)
    found = mph.scatter_images(point((45.0, -20.0, 10.0)), body, views, optics, windows=WINDOWS, precision=0.02)
    compare(found, *flown(body, views, lines_of(optics), WINDOWS, 500_000, rng, at((45.0, -20.0, 10.0)), KEV))


@pytest.mark.long
def test_a_torso_scatters_as_photons_that_really_fly(rng):
    """From the heart's muscle and the liver, in lungs and soft tissue; bone is taken out, which water cannot be."""
    torso, grid = mph.CardiacTorso(), mph.Grid.centered((60, 44, 40), 6.0)
    activity, mu = torso.voxelize(grid), torso.voxelize(grid, quantity="mu")
    mu = mph.Volume(np.minimum(mu.array, np.float32(MU)), grid, "mu")
    system = ring(distance=260.0)
    views, optics = system.views((16, 16), "real"), model(system)
    found = mph.scatter_images(activity, mu, views, optics, windows=WINDOWS, precision=0.005)
    shares = np.cumsum(activity.array.ravel(), dtype=float)

    def places(n, rng):
        voxels = np.searchsorted(shares, rng.random(n) * shares[-1], side="right")
        index = np.stack(np.unravel_index(voxels, grid.shape), axis=1) + rng.uniform(-0.5, 0.5, (n, 3))
        return index @ grid.affine[:3, :3].T + grid.affine[:3, 3]

    counts, variances = flown(mu, views, lines_of(optics), WINDOWS, 6_000_000, rng, places, KEV)
    decays = shares[-1] * grid.voxel_volume
    compare(found, decays * counts, decays**2 * variances)


@pytest.fixture(scope="module")
def small():
    """Return an activity, a body, views and a model of four modules."""
    system = ring(4)
    return point(), water(mph.Grid.centered(16, 10.0)), system.views((8, 8), "real"), model(system, time=10.0)


def test_the_same_seed_gives_the_same_images_bit_for_bit_by_any_number_of_threads(small):
    first, second, third = (mph.scatter_images(*small, histories=20_000, seed=3, threads=n) for n in (1, 2, 3))
    assert first.images.tobytes() == second.images.tobytes() == third.images.tobytes()
    other = mph.scatter_images(*small, histories=20_000, seed=4)
    assert not np.array_equal(first.images, other.images)
    np.testing.assert_allclose(other.images.sum(), first.images.sum(), rtol=6 * np.hypot(*[0.004] * 2))


def test_orders_sum_to_the_images_and_precision_holds(small):
    found = mph.scatter_images(*small, windows=WINDOWS, orders=3, precision=0.01, spectra=True)
    assert found.images.shape == (2, 4, 8, 8) and found.by_order.shape == (3, 2, 4, 8, 8)
    np.testing.assert_allclose(found.by_order.sum(axis=0), found.images, rtol=1e-5)
    assert (found.precision[0] < 0.015).all() and found.spectra.shape == (4, len(found.energies))
    assert found.by_order[0].sum() > found.by_order[1].sum() > found.by_order[2].sum() > 0


def test_scattered_photons_are_as_many_when_all_lengths_grow_and_densities_fall(small):
    def grown(volume, factor):
        grid = mph.Grid(volume.grid.shape, np.diag([2, 2, 2, 1]) @ volume.grid.affine)
        return mph.Volume(volume.array * np.float32(factor), grid, volume.quantity)

    activity, body, views, optics = small
    first = mph.scatter_images(activity, body, views, optics, histories=50_000)
    larger = ring(4, 48.0, 440.0, 640.0, 120.0, 120.0)
    views, optics = larger.views((8, 8), "real"), model(larger, time=10.0)
    second = mph.scatter_images(grown(activity, 1 / 8), grown(body, 0.5), views, optics, histories=50_000)
    np.testing.assert_allclose(second.images.sum(axis=(2, 3)), first.images.sum(axis=(2, 3)), rtol=0.02)


def test_nothing_scatters_where_there_is_nothing(small):
    activity, body, views, optics = small
    for changed in ((activity, mph.Volume(np.zeros(body.grid.shape, np.float32), body.grid, "mu")),
                    (mph.Volume(np.zeros(activity.grid.shape, np.float32), activity.grid, "activity"), body)):  # fmt: skip
        found = mph.scatter_images(*changed, views, optics)
        assert not found.images.any() and not found.precision.any()
    above = mph.scatter_images(activity, body, views, optics, windows=[(400.0, 500.0)], histories=5000)
    assert not above.images.any()


def test_a_source_outside_the_body_scatters_in_it(small):
    _, body, views, optics = small
    found = mph.scatter_images(point((0.0, 0.0, 120.0)), body, views, optics, windows=[(30.0, 154.0)], histories=50_000)
    assert (found.images.sum(axis=(2, 3)) > 0).all()


def test_what_is_missing_or_wrong_is_said_in_one_line(small):
    activity, body, views, optics = small
    system = optics.system
    refused(lambda: mph.scatter_images(activity, body, views, mph.Emission(system)), "no isotope")
    refused(lambda: mph.scatter_images(activity, body, views, mph.Emission(system, isotope="Tc-99m")), "energy_fwhm")
    refused(lambda: mph.scatter_images(body, body, views, optics), "activity")
    refused(lambda: mph.scatter_images(activity, activity, views, optics), "scatter: body")
    refused(lambda: mph.scatter_images(activity, body, views, optics, windows=[(154, 126)]), "two ascending energies")
    refused(lambda: mph.scatter_images(activity, body, views, optics, histories=0), "histories")
    refused(lambda: mph.scatter_images(activity, body, views, optics, precision=-1.0), "precision")
    soft = mph.Isotope("soft", 1e4, ((25.0, 1.0),))
    low = mph.Emission(system, isotope=soft, energy_fwhm=0.1)
    refused(lambda: mph.scatter_images(activity, body, views, low), "above 30 keV; soft has none")
    negative = mph.Volume(-body.array, body.grid, "mu")
    refused(lambda: mph.scatter_images(activity, negative, views, optics), "0 or more")
