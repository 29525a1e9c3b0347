"""Runs of X-ray systems with their tubes: the model "spectral" of recipes, to counts, line integrals and volumes."""

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.cli import main

TUBES = {"shape": (12, 16), "panel_size": (300, 240), "mas": 0.5}
SYSTEM = mph.xray_ring(5, kvp=[120, 80, 120, 80, 120], filters="Al 3", **TUBES)
GRID = mph.Grid.centered(24, 6.0)
WATER = mph.ShapePhantom([mph.Cylinder(radius=60, height=120, mu=mph.attenuation("water", 60.0))], mu_energy=60.0)
CYLINDER = WATER.voxelize(GRID, quantity="mu")
SPECTRAL = {"model.kind": "spectral", "volume.energy": 60.0}


def made(system=SYSTEM, volume=CYLINDER, **given):
    (run,) = mph.run_recipe(mph.Recipe({**SPECTRAL, **given}), system, volume)
    return run


def by_hand(m, which, **settings):
    """Counts behind a cylinder of water."""
    A = mph.Projector(GRID, SYSTEM.views()[which])
    return m.project([CYLINDER.array / mph.attenuation("water", 60.0)], A, SYSTEM.mas[which])[0]


@pytest.mark.parametrize(
    ("given", "detector", "bins"),
    [
        ({}, mph.PhotonCounter(), ((0, 1000),)),
        (
            {"model.window": [40, 70], "model.sensor": "CdTe", "model.sensor_thickness": 1.5, "model.sensor_fwhm": 5.0},
            mph.PhotonCounter("CdTe", 1.5, 5.0),
            ((40, 70),),
        ),
        ({"model.panel": "energy", "model.sensor": "CsI"}, mph.EnergyIntegrator("CsI", 2.0), None),
    ],
)
def test_counts_of_a_recipe_are_those_of_the_spectra(given, detector, bins):
    """Each source has its own tube; the cylinder is all water."""
    run = made(**given, **{"model.intrinsic_fwhm": 0.7, "model.background": 3.0})
    assert run.unit == ("keV" if bins is None else "counts")
    for kvp, which in ((120, [0, 2, 4]), (80, [1, 3])):
        blur = mph.panel_blur(SYSTEM, 0.7)[which]
        tube = mph.tube_spectrum(kvp, {"Al": 3})
        m = mph.SpectralTransmission(SYSTEM.views()[which], tube, ("water",), bins, detector, blur, 3.0)
        np.testing.assert_allclose(run.projections[which], by_hand(m, which), rtol=1e-6)


def test_one_energy_is_transmission():
    system = SYSTEM.replace(focal_spot=np.zeros(5))
    at_70 = mph.Volume(CYLINDER.array * 0.9, GRID, "mu")
    model = mph.SpectralScan(system, spectrum=mph.Spectrum([70.0], [1e7]))
    nothing = mph.Volume(0 * at_70.array, GRID, "mu")
    behind, air = (
        mph.project_run(system, v, (12, 16), model=model, backend="numpy").projections for v in (at_70, nothing)
    )
    integrals = mph.Projector(GRID, system.views(), backend="numpy")(at_70)
    np.testing.assert_allclose(behind / air, np.exp(-np.asarray(integrals)), rtol=1e-6)


def test_bone_is_replaced_as_ct_numbers_say():
    hu = mph.Volume(np.random.default_rng(1).uniform(-200, 1500, GRID.shape), GRID, "hu")
    of_mu = made(volume=mph.hu_to_mu(hu, 60.0)).projections
    np.testing.assert_allclose(made(volume=hu).projections, of_mu, rtol=1e-3)  # air's own coefficient
    A = mph.Projector(GRID, SYSTEM.views()[[1, 3]])
    m = mph.SpectralTransmission(
        A.views, mph.tube_spectrum(80, {"Al": 3}), bins=((0, 1000),), blur=mph.panel_blur(SYSTEM)[[1, 3]]
    )
    np.testing.assert_allclose(of_mu[[1, 3]], m.project(mph.water_and_bone(hu), A, 0.5)[0], rtol=1e-3)


def test_each_bin_is_a_run_and_they_sum_to_all_photons():
    bins = list(mph.run_recipe(mph.Recipe({**SPECTRAL, "frames.bins": [0, 40, 40, 60, 60, 130]}), SYSTEM, CYLINDER))
    assert [run.recipe["model.window"] for run in bins] == [(0, 40), (40, 60), (60, 130)]
    np.testing.assert_allclose(sum(run.projections for run in bins), made().projections, rtol=1e-6)


def test_noise_is_of_poisson():
    expected, drawn = made().projections, made(**{"noise.seed": 3}).projections
    assert np.array_equal(drawn, mph.sample_counts(expected, 3).astype(np.float32))


@pytest.mark.parametrize("given", [{}, {"model.panel": "energy", "model.sensor": "CsI"}, {"model.background": 50.0}])
def test_line_integrals_are_those_of_water(given):
    system = SYSTEM.replace(focal_spot=np.zeros(5))
    at_70 = mph.Projector(GRID, SYSTEM.views())(
        CYLINDER.array * mph.attenuation("water", 70) / mph.attenuation("water", 60)
    )
    np.testing.assert_allclose(mph.run_line_integrals(made(system, **given)), at_70, atol=1e-4)


def test_a_reconstruction_is_of_mu_at_70_keV_and_mere_logarithms_are_cupped():
    system = mph.xray_ring(24, z=0.1, kvp=120, mas=1.0, shape=(48, 48), panel_size=300)
    run = made(system)
    tables = {
        "reconstruction.method": "sirt",
        "reconstruction.iterations": 30,
        "reconstruction.voxels": 16,
        "reconstruction.spacing": 9.0,
    }
    middles, cups = [], []
    for ignored in (False, True):
        recipe = mph.Recipe({**tables, "reconstruction.ignore_beam_hardening": ignored})
        found = mph.reconstruct_run(run, recipe).volume
        assert found.quantity == "mu"
        middles.append(found.array[6:10, 6:10, 6:10].mean())
        cups.append(1 - middles[-1] / found.array[[3, 12], 6:10, 6:10].mean())
    assert cups[1] > cups[0] + 0.02
    assert middles[0] == pytest.approx(mph.attenuation("water", 70), rel=0.02)
    assert run.volume.array.max() == pytest.approx(mph.attenuation("water", 70), rel=1e-6)


@pytest.mark.parametrize(
    ("given", "kvp", "message"),
    [
        ({}, 200, r"X-ray source 2: kvp: expected 40 to 150 kV, got 200"),
        ({"model.window": [130, 140]}, 100, r"X-ray source 1: bins: no photon reaches bin 0"),
        ({"frames.bins": [20, 60, 50, 90]}, 100, r"bins: bins 0 and 1 overlap"),
        ({"frames.bins": [20, 60, 90]}, 100, r"frames.bins: expected pairs of energies"),
        ({"model.panel": "energy", "noise.seed": 1}, 100, r"noise.seed \(--noise\) does not go with model.panel"),
        ({"volume.energy": None}, 100, r"volume.energy \(--energy\): missing"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(given, kvp, message):
    system = SYSTEM.replace(kvp=[100, kvp, 100, 100, 100])
    with pytest.raises(mph.InputError, match=message) as error:
        given = {key: value for key, value in {**SPECTRAL, **given}.items() if value is not None}
        list(mph.run_recipe(mph.Recipe(given), system, CYLINDER))
    assert "\n" not in str(error.value)


def test_pinholes_have_no_tubes(system):
    with pytest.raises(
        mph.InputError, match="spectral: expected a scanner of X-ray tubes and panels, got one of the kind pinhole"
    ):
        list(mph.run_recipe(mph.Recipe(SPECTRAL), system, CYLINDER))


def test_the_command_makes_the_same_counts_and_lines(tmp_path, capsys):
    book, volume, run = (str(tmp_path / name) for name in ("both.xlsx", "mu.npz", "run.npz"))
    mph.write_system(SYSTEM, book)
    mph.write_volume(CYLINDER, volume)
    project = ["project", book, "--scanner-kind", "x-ray", "--volume", volume, "--spectral", "--noise", "4", "-o", run]
    assert main([*project, "--energy", "60", "--bins", "20", "60", "60", "130"]) == 0
    lines = capsys.readouterr().out
    script = mph.Recipe({**SPECTRAL, "frames.bins": [20, 60, 60, 130], "noise.seed": 4})
    for number, expected in enumerate(mph.run_recipe(script, SYSTEM, CYLINDER), 1):
        found = mph.read_run(tmp_path / f"run-{number}.npz")
        assert f"run-{number}.npz" in lines and found.seed == 3 + number
        np.testing.assert_array_equal(found.projections, expected.projections)
    first, again = str(tmp_path / "run-1.npz"), str(tmp_path / "again.npz")
    assert main(["project", first, "-o", again]) == 0
    np.testing.assert_array_equal(mph.read_run(again).projections, mph.read_run(first).projections)
    capsys.readouterr()
    assert main(project) == 1
    assert capsys.readouterr().err.rstrip().endswith("of mu, give the energy at which it holds (--energy)")


def test_event_sets_have_one_energy(tmp_path):
    mph.write_system(SYSTEM, tmp_path / "x.xlsx")
    (tmp_path / "events.toml").write_text("""
        version = 1
        system = {file = "x.xlsx", kind = "x-ray"}
        truth = {quantity = "mu", spacing = 8, voxels = 16}
        phantoms = [{kind = "torso"}]
        models = {ct = {kind = "spectral"}}
    """)
    with pytest.raises(mph.InputError, match="event sets have X rays of one energy"):
        mph.events.read_recipe(tmp_path / "events.toml")
