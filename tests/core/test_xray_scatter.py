"""Photons of tubes that scatter into panels, beside integrals, photons that fly (photon_flights.py), and FDK."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.stats import qmc

import mphdrr.core as mph
from mphdrr.core.physics.photon_scattering import Scatterer, compton_ratio

from . import photon_flights as flights
from .conftest import refused

MU = mph.attenuation("water", 70.0)  # 1/mm
SIDE = 320.0  # mm, of panels


def system(n=1, side=SIDE, shape=(16, 16)):
    """Return tubes 500 mm from the isocentre in the plane z = 0, with panels 250 mm behind it."""
    a = 2 * np.pi * np.arange(n) / n
    out = np.stack([np.cos(a), np.sin(a), 0 * a], axis=1)
    along = np.stack([-np.sin(a), np.cos(a), 0 * a], axis=1)
    u, v = side / shape[1] * along, np.tile([0.0, 0.0, -side / shape[0]], (n, 1))
    return mph.XraySystem(500 * out, -250 * out, u, v, shape, 100, 2.0, {"Al": 2.5})


def scan(spectrum=None, n=1, shape=(16, 16), **settings):
    return mph.SpectralScan(system(n, shape=shape), spectrum=spectrum, **settings)


def water(grid, density=1.0):
    return mph.Volume(np.broadcast_to(density * MU, grid.shape).astype(np.float32), grid, "mu")


def sphere(radius, n=32, spacing=5.0):
    grid = mph.Grid.centered(n, spacing)
    places = (np.indices(grid.shape) - (n - 1) / 2) * spacing
    return water(grid, (places**2).sum(axis=0) < radius**2)


def exits(places, to, half):
    """Return the mm from places in a box to its surface."""
    with np.errstate(divide="ignore"):
        return np.min((np.sign(to) * half - places) / to, axis=-1)


def panel_places(x, shares):
    """Return places on the panel of the first source."""
    n_v, n_u = x.pixels
    return x.panel_centers[0] + (shares[:, :1] - 0.5) * n_u * x.panel_u[0] + (shares[:, 1:] - 0.5) * n_v * x.panel_v[0]


@pytest.mark.parametrize("side", [SIDE, 60.0])
def test_first_collisions_are_an_integral_over_cone_body_and_panel(side):
    energy, half = 70.0, np.array([40.0, 50.0, 50.0])
    x = system(side=side)
    model = mph.SpectralScan(
        x, spectrum=mph.Spectrum([energy], [1e4]), panel="energy", sensor="CsI", sensor_thickness=0.6
    )
    body = water(mph.Grid.centered((8, 10, 10), 10.0))
    result = mph.xray_scatter(body, x.views(), model, orders=2, precision=0.003)
    shares = qmc.Sobol(5, seed=1).random_base2(17)
    source, towards = x.sources[0], panel_places(x, shares[:, :2]) - x.sources[0]
    far = np.linalg.norm(towards, axis=1)
    photons = 2.0 * 1e4 * 1e6 * side**2 * 750.0 / far**3  # mAs, per sr, times the solid angle of the panel
    towards /= far[:, None]
    entry = np.max((-np.sign(towards) * half - source) / towards, axis=1)
    inside = source + entry[:, None] * towards
    chord = np.maximum(exits(inside, towards, half), 0)
    hits = (np.abs(inside) < half + 1e-6).all(axis=1)
    depth = shares[:, 2] * chord
    places = inside + depth[:, None] * towards
    on = panel_places(x, shares[:, 3:]) - places
    distance = np.linalg.norm(on, axis=1)
    on /= distance[:, None]
    cosine = (on * towards).sum(axis=1)
    after, scatterer = energy * compton_ratio(energy, cosine), Scatterer("water")
    path = np.maximum(exits(places, on, half), 0)
    mu = np.interp(after, flights.ENERGIES, flights.COEFFICIENTS[0])
    signal = scatterer.incoherent(energy, cosine) * signals("energy", after) * np.exp(-mu * path)
    signal += scatterer.coherent(energy, cosine) * signals("energy", np.array([energy])) * np.exp(-MU * path)
    angle = side**2 * -on[:, 0] / distance**2
    expected = np.mean(np.where(hits, photons * np.exp(-MU * depth) * chord * signal * angle, 0))
    assert result.by_order[0].sum() == pytest.approx(expected, rel=0.01)


def signals(panel, energies):
    """Return what a panel of 0.6 mm CsI makes of photons: 1 or their energy, times the share that it stops."""
    table = 1 - np.exp(-0.6 * np.array([mph.attenuation("CsI", float(energy)) for energy in flights.ENERGIES]))
    return np.interp(energies, flights.ENERGIES, table) * (energies if panel == "energy" else 1.0)


def flown(body, x, spectrum, panel, n, rng):
    """Return the scattered signal (n_v, n_u) and its variance of n photons that really fly to the panel of a source."""
    n_v, n_u = x.pixels
    u, v, source = x.panel_u[0] * n_u, x.panel_v[0] * n_v, x.sources[0]
    area, corner = np.linalg.norm(np.cross(u, v)), x.panel_centers[0] - u / 2 - v / 2
    half = np.array(body.grid.shape) * body.grid.spacing / 2
    towards = panel_places(x, rng.random((n, 2))) - source
    far = np.linalg.norm(towards, axis=1)
    towards = towards[rng.random(n) < (750.0 / far) ** 3]  # as many in equal solid angles
    photons = 2.0 * spectrum.photons.sum() * 1e6 * area / 750.0**2 / n
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    entry = np.max((-np.sign(towards) * half - source) / towards, axis=1) + 1e-6
    inside = source + entry[:, None] * towards
    hits = (np.abs(inside) < half).all(axis=1)
    energies = rng.choice(spectrum.energies, hits.sum(), p=spectrum.photons / spectrum.photons.sum())
    arguments = body.array / MU, body.grid.spacing[0], inside[hits], energies, rng
    gone = flights.left(*arguments, lowest=20.0, directions=towards[hits])
    ahead = (gone.orders > 0) & (gone.directions[:, 0] < 0)  # the panel is on the side of -x
    places, ways = gone.places[ahead], gone.directions[ahead]
    on = places + ((-250 - places[:, :1]) / ways[:, :1]) * ways - corner
    columns, rows = (np.floor(on @ step / (step @ step)).astype(int) for step in (x.panel_u[0], x.panel_v[0]))
    seen = (columns >= 0) & (columns < n_u) & (rows >= 0) & (rows < n_v)
    values = photons * signals(panel, gone.energies[ahead][seen])
    index = rows[seen] * n_u + columns[seen]
    sums = [np.bincount(index, values**power, n_v * n_u).reshape(n_v, n_u) for power in (1, 2)]
    return sums[0], sums[1]


SPECTRA = {
    "one energy": mph.Spectrum([60.0], [1e4]),
    "three energies": mph.Spectrum([40.0, 70.0, 110.0], [2e4, 3e4, 1e4]),
}


def compare(body, name, panel, n, precision, rng):
    spectrum, x = SPECTRA[name], system(shape=(8, 8))
    model = mph.SpectralScan(x, spectrum=spectrum, panel=panel, sensor="CsI", sensor_thickness=0.6)
    result = mph.xray_scatter(body, x.views(), model, precision=precision)
    sums = [flown(body, x, spectrum, panel, 250_000, rng) for _ in range(n // 250_000)]
    image, variance = (np.mean([each[i] for each in sums], axis=0) for i in (0, 1))
    variance = variance / len(sums)
    assert result.images.sum() == pytest.approx(image.sum(), rel=0.02)
    sd = np.hypot(np.sqrt(variance.sum()), result.precision[0] * result.images.sum())
    assert result.images.sum() == pytest.approx(image.sum(), abs=4 * sd)
    chi2 = ((result.images[0] - image) ** 2 / (variance + result.deviation[0] ** 2)).mean()
    assert 0.6 < chi2 < 1.5, chi2  # 64 pixels: four standard deviations


@pytest.mark.parametrize(("name", "panel"), [("one energy", "counting"), ("three energies", "energy")])
def test_panels_see_the_photons_that_really_fly_to_them(name, panel, rng):
    compare(sphere(75.0, 16, 10.0), name, panel, 250_000, 0.005, rng)


@pytest.mark.long
@pytest.mark.parametrize("name", SPECTRA)
@pytest.mark.parametrize("panel", ["counting", "energy"])
def test_many_photons_that_really_fly_make_the_same_images(name, panel, rng):
    compare(water(mph.Grid.centered((20, 16, 12), 10.0)), name, panel, 3_000_000, 0.004, rng)


def test_the_same_seed_gives_the_same_images_bit_for_bit_by_any_number_of_threads():
    body, model = sphere(60.0, 16, 10.0), scan(n=3)
    views = model.system.views()
    results = [mph.xray_scatter(body, views, model, histories=2000, seed=5, threads=n) for n in (1, 2, 3)]
    assert len({result.images.tobytes() for result in results}) == 1
    assert len({result.deviation.tobytes() for result in results}) == 1
    other = mph.xray_scatter(body, views, model, histories=2000, seed=6)
    assert not np.array_equal(other.images, results[0].images)
    assert not np.array_equal(other.images[0], other.images[1])  # views have histories of their own
    np.testing.assert_allclose(other.images.sum(axis=(1, 2)), results[0].images.sum(axis=(1, 2)), rtol=0.15)


def test_finer_pixels_share_the_same_photons():
    body, model = sphere(60.0, 16, 10.0), scan()
    coarse, fine = (mph.xray_scatter(body, model.system.views(shape), model, histories=2000).images[0]
                    for shape in ((10, 10), (30, 50)))  # fmt: skip
    np.testing.assert_allclose(fine.reshape(10, 3, 10, 5).sum(axis=(1, 3)), coarse, rtol=2e-5)
    odd = mph.xray_scatter(body, model.system.views((1, 50)), model, histories=2000).images
    assert odd.sum() == pytest.approx(coarse.sum(), rel=0.05)


def test_orders_sum_to_the_images_and_precision_holds():
    body, model = sphere(70.0, 16, 10.0), scan(sensor="CsI")
    result = mph.xray_scatter(body, model.system.views(), model, orders=3, precision=0.02)
    assert result.by_order.shape == (3, 1, 16, 16) and 0 < result.precision[0] < 0.022
    np.testing.assert_allclose(result.by_order.sum(axis=0), result.images, rtol=1e-5)
    exact = mph.xray_scatter(body, model.system.views(), model, precision=0.005, seed=9).images.sum()
    assert result.images.sum() == pytest.approx(exact, rel=4 * 0.021)


def test_photons_above_the_window_scatter_down_into_it():
    body = sphere(60.0, 16, 10.0)
    model = scan(mph.Spectrum([50.0, 110.0], [1e-3, 1e4]), window=(20.0, 100.0))
    assert mph.xray_scatter(body, model.system.views(), model, histories=2000).images.min() > 0


def test_nothing_scatters_in_a_vacuum():
    grid = mph.Grid.centered(8, 10.0)
    model = scan(n=2)
    for body in (water(grid, 0.0), mph.Volume(np.full(grid.shape, -1000.0, np.float32), grid, "hu")):
        result = mph.xray_scatter(body, model.system.views(), model)
        assert not result.images.any() and not result.deviation.any() and not result.precision.any()


def test_fdk_of_a_sphere_is_right_when_the_scatter_is_subtracted():
    """One view, the same from all sides, stands for 60; the subtracted scatter has another seed than the measured one."""
    body, model = sphere(70.0, 18, 8.0), scan(shape=(64, 64), panel="energy", sensor="CsI", sensor_thickness=0.6)
    views, all_views = model.system.views(), system(60, shape=(64, 64)).views()
    source, targets = views.rays(0)
    ways = (targets - source) / np.linalg.norm(targets - source, axis=1, keepdims=True)
    off = (source**2).sum(axis=1) - (ways * source).sum(axis=1) ** 2  # squared distance from the middle
    chords = 2 * np.sqrt(np.maximum(70.0**2 - off, 0)).reshape(1, 64, 64)
    _, transmission = next(model.transmissions(views, ("water",)))
    primary = transmission.images(chords[None], model.system.mas)[0]
    scatter = [mph.xray_scatter(body, views, model, histories=150_000, seed=seed).images[0] for seed in (1, 2)]
    scatter = [sum(np.rot90(image + image.T, k) for k in range(4))[None] / 8 for image in scatter]
    slices = mph.Grid.centered((36, 36, 1), 4.0)
    radius = np.hypot(*(np.indices((36, 36)) - 17.5)) * 4

    def values(images, background):
        """Return mu in the middle and near the surface."""
        integrals = dataclasses.replace(model, background=background).line_integrals(images, views)
        volume = mph.fdk(np.repeat(integrals, 60, axis=0), all_views, slices).array[..., 0]
        return np.array([volume[radius < 20].mean(), volume[(radius > 45) & (radius < 60)].mean()])

    without = values(primary, 0.0)
    assert without == pytest.approx([MU, MU], rel=0.01)
    measured = values(primary + scatter[0], 0.0)
    assert measured[0] < 0.95 * measured[1]  # cupping
    assert measured[0] < 0.85 * without[0]
    corrected = values(primary + scatter[0], scatter[1])
    np.testing.assert_allclose(corrected, without, rtol=0.01)


def test_what_is_missing_or_wrong_is_said_in_one_line():
    body, model = sphere(60.0, 16, 10.0), scan()
    views = model.system.views()
    refused(lambda: mph.xray_scatter(body, views, mph.Transmission()), "scatter: model")
    refused(lambda: mph.xray_scatter(mph.Volume(body.array, body.grid, "activity"), views, model), "scatter: body")
    refused(lambda: mph.xray_scatter(mph.Volume(-body.array, body.grid, "mu"), views, model), "0 or more")
    refused(lambda: mph.xray_scatter(body, system(2).views(), model), "1 views")
    refused(lambda: mph.xray_scatter(body, views, scan(materials="water")), "water-bone")
    refused(lambda: mph.xray_scatter(body, views, model, histories=0), "histories")
    refused(lambda: mph.xray_scatter(body, views, model, precision=0.0), "precision")
    refused(lambda: mph.xray_scatter(body, views, model, orders=0), "orders")
    refused(lambda: mph.xray_scatter(body, views, scan(mph.Spectrum([8.0], [1.0]))), "ends at 8 keV")
    refused(lambda: scan(background=np.zeros((2, 16, 16))), "spectral: background")
    refused(lambda: dataclasses.replace(model, background=np.zeros((1, 9, 9))).check(views), "spectral: background")
