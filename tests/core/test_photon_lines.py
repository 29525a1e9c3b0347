"""Isotopes of several lines: each with its own attenuation, aperture, crystal and share in the energy window."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core import events
from mphdrr.core.cli import main

from .conftest import BACKENDS, WORKBOOK, refused
from .small_events import TEXT, small_recipe

DEPTH = 50.0  # mm of water before the source
RAYS = {"hole": "rays", "aperture_points": 1, "pixel_points": 1, "tolerance": 1e9}
TUMOR = ("I-131", (250.0, 700.0))  # three lines


@pytest.fixture
def module():
    """Return a pinhole at x = 200 mm that looks along -x; it is small, as the sources of these laws are."""
    return mph.PinholeSystem([[200.0, 0.0, 0.0]], 0.2, 60.0, 0.8, 10.0, roi_radius=60.0)


@pytest.fixture
def ct(rng):
    """Return CT numbers of tissues and bone around the isocentre."""
    return mph.Volume(rng.uniform(-900, 900, (6, 5, 4)), mph.Grid.centered((6, 5, 4), 20.0), "hu")


def water(quantity="hu", value=0.0):
    """Return a slab of water between the isocentre and the module."""
    return mph.Volume(np.full((1, 1, 1), value), mph.Grid.centered(1, (DEPTH, 80.0, 80.0), (60.0, 0.0, 0.0)), quantity)


def gaussian_share(energy, window, fwhm):
    """Return the share of a Gaussian within a window, by integration."""
    nodes, weights = np.polynomial.legendre.leggauss(200)
    low, high = window
    sigma = fwhm / math.sqrt(8 * math.log(2))
    energies = low + (high - low) * (nodes + 1) / 2
    density = np.exp(-(((energies - energy) / sigma) ** 2) / 2) / (sigma * math.sqrt(2 * math.pi))
    return float((high - low) / 2 * weights @ density)


@pytest.mark.parametrize(
    ("name", "window"),
    [("Tc-99m", None), ("I-131", None), ("In-111", (150, 190)), ("Ga-67", (80, 330)), ("Lu-177", None)],
)
def test_a_window_counts_each_lines_part_of_the_gaussian(module, name, window):
    model = mph.Emission(module, isotope=name, window=window, energy_fwhm=0.095)
    isotope = mph.isotope(name)
    reference, _ = max(isotope.lines_within(*model.window), key=lambda line: line[1])
    found = dict(model.photon_lines)
    widths = {energy: 0.095 * math.sqrt(reference * energy) for energy, _ in isotope.lines}
    shares = {energy: n * gaussian_share(energy, model.window, widths[energy]) for energy, n in isotope.lines}
    least = 1e-4 * max(shares.values())
    assert list(found) == [energy for energy, share in shares.items() if share > least]
    for energy, photons in found.items():
        assert photons == pytest.approx(shares[energy], abs=1e-9)
    assert model.photons_per_decay == pytest.approx(sum(found.values()), rel=1e-12)
    sharp = mph.Emission(module, isotope=name, window=window, energy_fwhm=1e-6)
    assert sharp.photons_per_decay == pytest.approx(isotope.photons_per_decay(*model.window), rel=1e-12)


@pytest.mark.parametrize("energy_fwhm", [None, 0.1])
@pytest.mark.parametrize("options", [{"hole": "point"}, {"hole": "rays"}, {"hole": "depth"}, {"aperture_points": 7}])
def test_water_before_a_point_lets_each_line_pass_by_its_own_law(module, options, energy_fwhm):
    grid, views = mph.Grid.centered(1, 0.3), module.views((16, 16), "real")
    given = {"isotope": "Ga-67", "window": (170, 330), "energy_fwhm": energy_fwhm, "time": 1e-3, **options}
    bare = mph.Emission(module, **given)
    energies, photons = np.transpose(bare.photon_lines)
    assert len(energies) > 2
    mu = [mph.attenuation("water", energy) for energy in energies]
    share = photons @ np.exp(-np.array(mu) * DEPTH) / photons.sum()
    free = mph.Projector(grid, views, bare, double=True)(np.ones(grid.shape)).sum()
    for matter in (water(), [water("mu", each) for each in mu]):
        A = mph.Projector(grid, views, mph.Emission(module, mu=matter, **given), double=True)
        assert A(np.ones(grid.shape)).sum() / free == pytest.approx(share, rel=1e-6)
    narrow = mph.Emission(module, mu=water(), isotope="Ga-67", window=(170, 190), **options)
    assert narrow.mu.quantity == "mu" and len(narrow.parts()) == 1


def several(system, ct=None, **changes):
    name, window = TUMOR
    given = {"isotope": name, "window": window, "time": 10.0, "aperture_mu": "tungsten", "crystal_mu": "CZT"}
    return mph.Emission(system, mu=ct, **(given | changes))


def each_line(system, ct, **changes):
    """Return models of the lines, each in a window of its own."""
    lines = mph.isotope(TUMOR[0]).lines_within(*TUMOR[1])
    return [several(system, mph.hu_to_mu(ct, e), window=(e - 1, e + 1), **changes) for e, _ in lines]


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("options", [pytest.param({}, id="depth"), pytest.param(RAYS | {"edge": "path"}, id="rays")])
def test_images_and_adjoint_are_the_sums_of_the_lines(system, ct, rng, backend, options):
    if not options and backend != "cpu":
        pytest.skip("numpy is slow, and torch takes the same kernels")
    system = system[:2]
    grid, views = mph.Grid.centered((5, 4, 3), 15.0), system.views((6, 7))
    x, y = rng.random(grid.shape), rng.random((2, 6, 7))
    A = mph.Projector(grid, views, several(system, ct, **options), backend, double=True)
    each = [mph.Projector(grid, views, model, backend, double=True) for model in each_line(system, ct, **options)]
    images, close = A(x), {"rtol": 1e-12, "atol": 1e-14}
    assert len(each) == 3 and images.max() > 1e-4
    np.testing.assert_allclose(images, sum(line(x) for line in each), **close)
    np.testing.assert_allclose(A.T(y), sum(line.T(y) for line in each), **close)
    assert abs(np.vdot(images, y) - np.vdot(x, A.T(y))) < 1e-6 * np.linalg.norm(images) * np.linalg.norm(y)
    np.testing.assert_array_equal(np.stack(list(A.iter_views(x))), images)
    for part in A.subsets(2):
        np.testing.assert_allclose(part(x), images[part.which], **close)
    np.testing.assert_allclose(A(np.stack([x, 2 * x]))[1], 2 * images, **close)


def test_one_line_is_computed_as_ever_bit_for_bit(system, ct, rng):
    system = system[:4]
    grid, views = mph.Grid.centered((7, 6, 5), 12.0), system.views((8, 9))
    x = rng.random(grid.shape)
    for given in ({}, {"window": (120, 150)}, RAYS):
        common = {"isotope": "Tc-99m", "aperture_mu": "lead", "crystal_mu": "NaI", **given}
        plain = mph.Projector(grid, views, mph.Emission(system, mph.hu_to_mu(ct, 140.5), **common))
        for mu in (ct, [mph.hu_to_mu(ct, 140.5)]):
            apart = mph.Projector(grid, views, mph.Emission(system, mu, lines="apart", **common))
            np.testing.assert_array_equal(apart(x), plain(x))
            np.testing.assert_array_equal(apart.T(plain(x)), plain.T(plain(x)))


def test_lines_apart_without_attenuation_have_their_own_holes_and_crystals(system, rng):
    grid, views = mph.Grid.centered((7, 6, 5), 12.0), system.views((8, 9))
    x = rng.random(grid.shape)
    models = (several(system, aperture_mu=None, crystal_mu=None, lines=word) for word in ("together", "apart"))
    plain, apart = (mph.Projector(grid, views, model) for model in models)
    np.testing.assert_allclose(apart(x), plain(x), rtol=1e-5)
    model = several(system, lines="apart", photons_per_decay=2.0, intrinsic_fwhm=3.0)
    energies = (284.3, 364.5, 637.0)
    assert [part.aperture_mu for part in model.parts()] == [mph.attenuation("tungsten", e) for e in energies]
    assert sum(part.photons_per_decay for part in model.parts()) == pytest.approx(2.0)
    again = dataclasses.replace(model, time=20.0)
    assert [part.crystal_mu for part in again.parts()] == [part.crystal_mu for part in model.parts()]
    assert model.record()["aperture_mu"] == "tungsten" and model.record()["lines"] == "apart"
    together = several(system, photons_per_decay=2.0)
    assert model.optics.aperture_mu == together.aperture_mu
    np.testing.assert_array_equal(model.effective_diameter, together.effective_diameter)


def test_lines_apart_have_the_times_and_efficiencies_of_the_modules(system, rng):
    grid, views = mph.Grid.centered((7, 6, 5), 12.0), system.views((8, 9))
    x, y = rng.random(grid.shape), rng.random((12, 8, 9))
    efficiency = rng.uniform(0.5, 1.5, (12, 8, 9)) * (rng.random((12, 8, 9)) > 0.1)
    own = {"time": rng.uniform(10, 20, 12), "start": 3600.0 * np.arange(12), "lines": "apart"}
    models = (several(system, **own, efficiency=e) for e in (1.0, efficiency))
    even, uneven = (mph.Projector(grid, views, model, double=True) for model in models)
    np.testing.assert_allclose(uneven(x), efficiency * even(x), rtol=1e-12)
    np.testing.assert_allclose(uneven.T(y), even.T(efficiency * y), rtol=1e-9)
    factor = several(system, **own).effective_time / several(system, time=10.0).effective_time
    plain = mph.Projector(grid, views, several(system, lines="apart"), double=True)
    np.testing.assert_allclose(even(x), factor[:, None, None] * plain(x), rtol=1e-12)


def test_torch_knows_the_gradients_of_lines_apart(system, ct, rng):
    torch = pytest.importorskip("torch")
    system = system[:3]
    grid, views = mph.Grid.centered((5, 4, 3), 15.0), system.views((6, 5))
    A = mph.Projector(grid, views, several(system, ct))
    x = torch.tensor(rng.random(grid.shape), requires_grad=True)
    y = torch.tensor(rng.random(A.shape_out))
    (A(x) * y).sum().backward()
    np.testing.assert_allclose(x.grad, A.T(y), rtol=1e-10)
    refused(lambda: A(x, mu=x), "mu", "each of the model's lines")
    # One mu for all lines, apart for their holes and crystals: a tensor takes its place.
    one = mph.hu_to_mu(ct, 364.5)
    A = mph.Projector(grid, views, several(system, one, lines="apart"))
    mu = torch.tensor(np.array(one.array, float), requires_grad=True)
    (A(x.detach(), mu=mu) * y).sum().backward()
    step = torch.tensor(rng.normal(size=mu.shape)) * 1e-5
    difference = ((A(x.detach(), mu=mu.detach() + step) - A(x.detach(), mu=mu.detach() - step)) * y).sum() / 2
    assert float((mu.grad * step).sum()) == pytest.approx(float(difference), rel=1e-5)


def test_the_geometry_moves_images_of_lines_apart(system, rng):
    system = system[:2]
    grid, views = mph.Grid.centered((5, 4, 3), 15.0), system.views((9, 8))
    x, y = rng.random(grid.shape), rng.random((2, 9, 8))

    def images(system):
        return mph.Projector(grid, system.views((9, 8)), several(system, lines="apart"), double=True)(x)

    A = mph.Projector(grid, views, several(system, lines="apart"), double=True)
    found = mph.geometry_gradient(A, x, y).pinhole_diameter
    step = 1e-4 * system.pinhole_diameter
    wide, narrow = (dataclasses.replace(system, pinhole_diameter=system.pinhole_diameter + s) for s in (step, -step))
    change = ((images(wide) - images(narrow)) * y).sum(axis=(1, 2)) / (2 * step)
    np.testing.assert_allclose(found, change, rtol=1e-5)


def test_what_does_not_go_together_is_refused(module, ct):
    indium = {"isotope": "In-111", "window": (150, 270)}
    for given, words in (
        ({"energy_fwhm": 0.1}, ("energy_fwhm needs an isotope",)),
        ({"lines": "apart"}, ("lines needs an isotope",)),
        ({"lines": "each", "isotope": "In-111"}, ("lines", "together")),
        ({"energy_fwhm": 9.5, "isotope": "I-131"}, ("share of the energy", "9.5")),
        ({"mu": ct}, ("expected a volume of mu, got hu",)),
        ({"mu": [water("mu", 0.01)]}, ("without an isotope",)),
        ({"mu": [water("mu", 0.01)] * 3, **indium}, ("2 volumes", "171.3, 245.4", "3")),
        ({"mu": [ct, ct], **indium}, ("mu", "hu")),
        (indium | {"window": (190, 230), "energy_fwhm": 0.1, "photons_per_decay": 1.0}, ("In-111", "171.3")),
    ):
        refused(lambda given=given: mph.Emission(module, **given), *words)


def test_recipes_take_ct_numbers_at_each_line(system, ct, tmp_path):
    mph.write_volume(ct, tmp_path / "ct.nii.gz")
    kept = mph.read_volume(tmp_path / "ct.nii.gz")
    volume = mph.Volume(np.ones((4, 4, 4)), mph.Grid.centered(4, 15.0), "activity")
    recipe = mph.Recipe({
        "model.kind": "emission", "model.isotope": "In-111", "model.window": (150, 270), "model.energy_fwhm": 0.1,
        "attenuation.file": str(tmp_path / "ct.nii.gz"), "attenuation.energy": "lines",
        "detector.rows": 6, "detector.columns": 6,
    })  # fmt: skip
    (run,) = mph.run_recipe(recipe, system, volume)
    model = mph.Emission(system, kept, isotope="In-111", window=(150, 270), energy_fwhm=0.1)
    A = mph.Projector(volume.grid, run.views, model)
    np.testing.assert_allclose(run.projections, A(volume), rtol=1e-6)
    again = mph.projector_of_run(run, volume.grid)
    np.testing.assert_allclose(again(volume), run.projections, rtol=1e-6)
    (one,) = mph.run_recipe(recipe.updated({"attenuation.energy": "In-111"}), system, volume)
    both = mph.Emission(system, mph.hu_to_mu(kept, 245.4), isotope="In-111", window=(150, 270), energy_fwhm=0.1)
    np.testing.assert_allclose(one.projections, mph.Projector(volume.grid, run.views, both)(volume), rtol=1e-6)
    (apart,) = mph.run_recipe(recipe.updated({"attenuation.file": None, "model.lines": "apart"}), system, volume)
    assert len(mph.projector_of_run(apart, volume.grid).model.parts()) == 2


@pytest.fixture
def mu_files(ct, tmp_path):
    """Write files of mu for the two lines of In-111 that are counted; return their names and contents."""
    files = [tmp_path / f"{energy}.nii.gz" for energy in (171, 245)]
    for file, energy in zip(files, (171.3, 245.4), strict=True):
        mph.write_volume(mph.hu_to_mu(ct, energy), file)
    return [str(file) for file in files], [mph.read_volume(file) for file in files]


def test_recipes_and_options_take_a_file_of_mu_for_each_line(system, mu_files, tmp_path):
    files, mu = mu_files
    volume = mph.Volume(np.ones((4, 4, 4)), mph.Grid.centered(4, 15.0), "activity")
    counted = {"isotope": "In-111", "window": (150, 270), "energy_fwhm": 0.1}
    recipe = mph.Recipe(
        {"model.kind": "emission", "attenuation.file": files, "detector.rows": 6, "detector.columns": 6}
        | {f"model.{name}": value for name, value in counted.items()}
    )
    (run,) = mph.run_recipe(recipe, system, volume)
    A = mph.Projector(volume.grid, run.views, mph.Emission(system, mu, **counted))
    np.testing.assert_allclose(run.projections, A(volume), rtol=1e-6)
    mph.write_recipe(recipe.updated({"system.file": str(WORKBOOK)}), tmp_path / "recipe.toml")
    mph.write_volume(volume, tmp_path / "volume.nii.gz")
    words = ["project", str(tmp_path / "recipe.toml"), "--volume", str(tmp_path / "volume.nii.gz"), "--modules", "1,48"]
    assert main([*words, "--mu", *reversed(files), "-o", str(tmp_path / "run.h5")]) == 0
    other = mph.read_run(tmp_path / "run.h5")
    swapped = mph.Projector(volume.grid, other.views, mph.Emission(other.system, mu[::-1], **counted))
    np.testing.assert_allclose(other.projections, swapped(volume), rtol=1e-6)
    np.testing.assert_allclose(mph.projector_of_run(other, volume.grid)(volume), other.projections, rtol=1e-6)
    one_line = {"model.window": (160, 180), "model.energy_fwhm": None}
    for changes, words in (
        ({"attenuation.file": files[:1] * 2} | one_line, ("attenuation.file", "got 2")),
        ({"attenuation.file": files[:1] * 3, "model.energy_fwhm": None}, ("attenuation.file", "got 3")),
        ({"attenuation.energy": 171.3}, ("attenuation.energy", "one file")),
    ):
        refused(lambda changes=changes: next(mph.run_recipe(recipe.updated(changes), system, volume)), *words)


@pytest.mark.parametrize("each", [False, True])
def test_event_sets_keep_what_attenuates_each_line(each, ct, mu_files, tmp_path):
    mph.write_volume(ct, tmp_path / "ct.nii.gz")
    given = '["171.nii.gz", "245.nii.gz"]' if each else '"ct.nii.gz"\nattenuation_energy = "lines"'
    counts = f'kind = "emission"\nisotope = "In-111"\nwindow = [150, 270]\nattenuation = {given}\n'
    text = TEXT[: TEXT.index("[models.lines]")] + f"[models.counts]\n{counts}"
    (event,) = events.make(small_recipe(tmp_path, text.replace('"1-4,21-24"', '"1-3"')), tmp_path / "set", 1)
    run = event.run("counts")
    A = mph.projector_of_run(run, event.truth.grid)
    assert len(A.model.parts()) == 2 and isinstance(A.model.mu, tuple) == each
    np.testing.assert_allclose(A(event.truth), event.images("counts"), rtol=1e-5)
