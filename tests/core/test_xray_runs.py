"""Runs of X-ray systems with their tubes: the model "spectral" of recipes, to counts, line integrals and volumes."""

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.cli import main

from .conftest import refused, refused_command

TUBES = {"shape": (12, 16), "panel_size": (300, 240), "mas": 0.5}
SYSTEM = mph.xray_ring(5, kvp=[120, 80, 120, 80, 120], filters="Al 3", **TUBES)
GRID = mph.Grid.centered(24, 6.0)
WATER = mph.ShapePhantom([mph.Cylinder(radius=60, height=120, mu=mph.attenuation("water", 60.0))], mu_energy=60.0)
CYLINDER = WATER.voxelize(GRID, quantity="mu")
SPECTRAL = {"model.kind": "spectral", "volume.energy": 60.0}


def make_run(system=SYSTEM, volume=CYLINDER, **settings):
    return next(mph.run_recipe(mph.Recipe({**SPECTRAL, **settings}), system, volume))


CDTE = {"model.window": [40, 70], "model.sensor": "CdTe", "model.sensor_thickness": 1.5, "model.sensor_fwhm": 5.0}
PANEL = {"model.panel": "energy", "model.sensor": "CsI"}


@pytest.mark.parametrize(
    ("settings", "detector", "bins"),
    [
        ({}, mph.PhotonCounter(), ((0, 1000),)),
        (CDTE, mph.PhotonCounter("CdTe", 1.5, 5.0), ((40, 70),)),
        (PANEL, mph.EnergyIntegrator("CsI", 2.0), None),
    ],
)
def test_counts_of_a_recipe_are_those_of_the_spectra(settings, detector, bins):
    """Each source has its own tube; the cylinder is all water."""
    run = make_run(**settings, **{"model.intrinsic_fwhm": 0.7, "model.background": 3.0})
    assert run.unit == ("keV" if bins is None else "counts")
    water = [CYLINDER.array / mph.attenuation("water", 60.0)]
    for kvp, which in ((120, [0, 2, 4]), (80, [1, 3])):
        A, blur = mph.Projector(GRID, SYSTEM.views()[which]), mph.panel_blur(SYSTEM, 0.7)[which]
        m = mph.SpectralTransmission(A.views, mph.tube_spectrum(kvp, {"Al": 3}), ("water",), bins, detector, blur, 3.0)
        np.testing.assert_allclose(run.projections[which], m.project(water, A, SYSTEM.mas[which])[0], rtol=1e-6)


def test_one_energy_is_transmission():
    system = SYSTEM.replace(focal_spot=np.zeros(5))
    model = mph.SpectralScan(system, spectrum=mph.Spectrum([70.0], [1e7]))
    at_70, nothing = (mph.Volume(factor * CYLINDER.array, GRID, "mu") for factor in (0.9, 0.0))
    options = {"model": model, "backend": "numpy"}
    behind, air = (mph.project_run(system, v, (12, 16), **options).projections for v in (at_70, nothing))
    integrals = mph.Projector(GRID, system.views(), backend="numpy")(at_70)
    np.testing.assert_allclose(behind / air, np.exp(-np.asarray(integrals)), rtol=1e-6)


def test_bone_is_replaced_as_ct_numbers_say():
    hu = mph.Volume(np.random.default_rng(1).uniform(-200, 1500, GRID.shape), GRID, "hu")
    of_mu = make_run(volume=mph.hu_to_mu(hu, 60.0)).projections
    np.testing.assert_allclose(make_run(volume=hu).projections, of_mu, rtol=1e-3)  # air's own coefficient
    A, tube = mph.Projector(GRID, SYSTEM.views()[[1, 3]]), mph.tube_spectrum(80, {"Al": 3})
    m = mph.SpectralTransmission(A.views, tube, bins=((0, 1000),), blur=mph.panel_blur(SYSTEM)[[1, 3]])
    np.testing.assert_allclose(of_mu[[1, 3]], m.project(mph.water_and_bone(hu), A, 0.5)[0], rtol=1e-3)


def test_each_bin_is_a_run_they_sum_to_all_photons_and_noise_is_of_poisson():
    bins = list(mph.run_recipe(mph.Recipe({**SPECTRAL, "frames.bins": [0, 40, 40, 60, 60, 130]}), SYSTEM, CYLINDER))
    assert [run.recipe["model.window"] for run in bins] == [(0, 40), (40, 60), (60, 130)]
    expected = make_run().projections
    np.testing.assert_allclose(sum(run.projections for run in bins), expected, rtol=1e-6)
    drawn = make_run(**{"noise.seed": 3}).projections
    assert np.array_equal(drawn, mph.sample_counts(expected, 3).astype(np.float32))


@pytest.mark.parametrize("settings", [{}, PANEL, {"model.background": 50.0}])
def test_line_integrals_are_those_of_water(settings):
    run = make_run(SYSTEM.replace(focal_spot=np.zeros(5)), **settings)
    to_70 = mph.attenuation("water", 70) / mph.attenuation("water", 60)
    expected = mph.Projector(GRID, SYSTEM.views())(CYLINDER.array * to_70)
    np.testing.assert_allclose(mph.run_line_integrals(run), expected, atol=1e-4)


def test_a_reconstruction_is_of_mu_at_70_keV_and_mere_logarithms_are_cupped():
    system = mph.xray_ring(24, z=0.1, kvp=120, mas=1.0, shape=(48, 48), panel_size=300)
    run = make_run(system)
    settings = {"method": "sirt", "iterations": 30, "voxels": 16, "spacing": 9.0}
    middles, cups = [], []
    for ignored in (False, True):
        settings["ignore_beam_hardening"] = ignored
        recipe = mph.Recipe({f"reconstruction.{key}": value for key, value in settings.items()})
        volume = mph.reconstruct_run(run, recipe).volume
        assert volume.quantity == "mu"
        middles.append(volume.array[6:10, 6:10, 6:10].mean())
        cups.append(1 - middles[-1] / volume.array[[3, 12], 6:10, 6:10].mean())
    assert cups[1] > cups[0] + 0.02
    assert middles[0] == pytest.approx(mph.attenuation("water", 70), rel=0.02)
    assert run.volume.array.max() == pytest.approx(mph.attenuation("water", 70), rel=1e-6)


def test_what_cannot_be_is_refused_in_one_line(system):
    for settings, kvp, words in (
        ({}, 200, "X-ray source 2: kvp: expected 20 to 150 kV, got 200"),
        ({"model.window": [130, 140]}, 100, "X-ray source 1: bins: no photon reaches bin 0"),
        ({"frames.bins": [20, 60, 50, 90]}, 100, "bins: bins 0 and 1 overlap"),
        ({"frames.bins": [20, 60, 90]}, 100, "frames.bins: expected pairs of energies"),
        ({"model.panel": "energy", "noise.seed": 1}, 100, "noise.seed (--noise) does not go with model.panel"),
    ):
        tubes = SYSTEM.replace(kvp=[100, kvp, 100, 100, 100])
        refused(lambda tubes=tubes, settings=settings: make_run(tubes, **settings), words)
    without_energy = mph.Recipe({"model.kind": "spectral"})
    refused(lambda: next(mph.run_recipe(without_energy, SYSTEM, CYLINDER)), "volume.energy (--energy): missing")
    words = "spectral: expected a scanner of X-ray tubes and panels, got one of the kind pinhole"
    refused(lambda: make_run(system), words)


def test_the_command_makes_the_same_counts_and_lines(tmp_path, capsys):
    book, volume, run = (str(tmp_path / name) for name in ("both.xlsx", "mu.npz", "run.npz"))
    mph.write_system(SYSTEM, book)
    mph.write_volume(CYLINDER, volume)
    project = ["project", book, "--scanner-kind", "x-ray", "--volume", volume, "--spectral", "--noise", "4", "-o", run]
    assert main([*project, "--energy", "60", "--bins", "20", "60", "60", "130"]) == 0
    lines = capsys.readouterr().out
    script = mph.Recipe({**SPECTRAL, "frames.bins": [20, 60, 60, 130], "noise.seed": 4})
    for number, expected in enumerate(mph.run_recipe(script, SYSTEM, CYLINDER), 1):
        written = mph.read_run(tmp_path / f"run-{number}.npz")
        assert f"run-{number}.npz" in lines and written.seed == 3 + number
        np.testing.assert_array_equal(written.projections, expected.projections)
    first, again = str(tmp_path / "run-1.npz"), str(tmp_path / "again.npz")
    assert main(["project", first, "-o", again]) == 0
    np.testing.assert_array_equal(mph.read_run(again).projections, mph.read_run(first).projections)
    capsys.readouterr()
    assert refused_command(capsys, *project).endswith("of mu, give the energy at which it holds (--energy)")


def test_event_sets_have_one_energy(tmp_path):
    mph.write_system(SYSTEM, tmp_path / "x.xlsx")
    (tmp_path / "events.toml").write_text("""
        version = 1
        system = {file = "x.xlsx", kind = "x-ray"}
        truth = {quantity = "mu", spacing = 8, voxels = 16}
        phantoms = [{kind = "torso"}]
        models = {ct = {kind = "spectral"}}
    """)
    refused(lambda: mph.events.read_recipe(tmp_path / "events.toml"), "event sets have X rays of one energy")
