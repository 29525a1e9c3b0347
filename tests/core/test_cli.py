"""The command line: what users type, and what it says about mistakes."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.addon.cli import main

from .conftest import WORKBOOK

SMALL = ["--voxels", "12", "--spacing", "8", "--size", "12", "16"]


def test_geometry_show_prints_every_module(capsys):
    assert main(["geometry", "show", str(WORKBOOK), "--json"]) == 0
    modules = json.loads(capsys.readouterr().out)["modules"]
    assert len(modules) == 80
    assert modules[79]["ring"] == 4
    assert modules[0]["l"] == pytest.approx(89.070206162965, abs=1e-8)
    assert main(["geometry", "show", str(WORKBOOK), "--modules", "1-2,80"]) == 0
    assert len(capsys.readouterr().out.splitlines()) == 5


def test_geometry_check_names_cells_that_disagree(small_workbook, tmp_path, capsys):
    import openpyxl

    book = openpyxl.load_workbook(small_workbook)
    book["Coordinates"]["G5"] = 99.0
    book.save(tmp_path / "a.xlsx")
    assert main(["geometry", "check", str(tmp_path / "a.xlsx"), "--json"]) == 0
    warnings = json.loads(capsys.readouterr().out)["warnings"]
    assert len(warnings) >= 1
    assert any("G5" in text and "99" in text for text in warnings)


def test_from_phantom_to_dataset(small_workbook, tmp_path, capsys):
    volume, run = tmp_path / "derenzo.nii.gz", tmp_path / "new" / "run.h5"
    phantom = ["--voxels", "24", "--spacing", "4", "--euler", "10", "20", "30", "--position", "1", "2", "3"]
    assert main(["phantom", "derenzo", *phantom, "-o", str(volume)]) == 0
    options = ["--volume", str(volume), *SMALL[4:], "--modules", "1-5", "--mosaic", str(tmp_path / "m.png")]
    assert main(["project", str(small_workbook), *options, "-o", str(run)]) == 0
    assert main(["export", str(run), "-o", str(tmp_path / "run.npz")]) == 0
    capsys.readouterr()

    back = mph.read_run(tmp_path / "run.npz")
    assert back.projections.shape == (5, 12, 16)
    assert list(back.system.numbers) == [1, 2, 3, 4, 5]
    expected = mph.Projector(back.volume.grid, back.views)(mph.read_volume(volume))
    assert np.allclose(back.projections, expected)
    assert back.workbook == "first-24-modules.xlsx"
    assert len(back.workbook_sha256) == 64
    assert (tmp_path / "m.png").stat().st_size > 0


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ([], None),
        (["--magnification", "2"], "raise the magnification"),
        (["--position", "200", "0", "0"], "the isocentre, at which the modules aim, lies outside"),
        (["--spacing", "0.5"], "of the Derenzo phantom lies outside the grid"),
    ],
)
def test_what_would_not_be_seen_is_said(options, said, small_workbook, tmp_path, capsys):
    words = [*("--voxels", "24"), *SMALL[4:], *options, "-o", str(tmp_path / "run.h5")]
    assert main(["project", str(small_workbook), *words]) == 0
    error = capsys.readouterr().err
    assert said in error if said else not error


def test_runs_record_what_the_phantom_was(small_workbook, tmp_path):
    options = [*SMALL, "--radius", "30", "--euler", "10", "20", "30", "-o", str(tmp_path / "run.npz")]
    assert main(["project", str(small_workbook), *options]) == 0
    recipe = mph.read_run(tmp_path / "run.npz").recipe
    assert (recipe["phantom.kind"], recipe["phantom.radius"], recipe["phantom.activity"]) == ("derenzo", 30, 100)
    assert recipe["phantom.euler_degrees"] == pytest.approx((10, 20, 30))
    np.testing.assert_allclose(recipe["phantom.matrix"], mph.euler_pose(*np.deg2rad([10, 20, 30])))


def test_counts_with_attenuation_and_noise(small_workbook, tmp_path, capsys):
    grid = mph.Grid.centered(8, 20.0)
    mph.write_volume(mph.Volume(np.full((8, 8, 8), 0.0154), grid, "mu"), tmp_path / "mu.nii")
    options = [*SMALL, "--modules", "3-4", "--emission", "--time", "600", "--mu", str(tmp_path / "mu.nii")]
    options += ["--aperture-points", "3"]
    for name, more in (("mean", []), ("drawn", ["--noise", "5"])):
        assert main(["project", str(small_workbook), *options, *more, "-o", str(tmp_path / f"{name}.h5")]) == 0
        assert "counts" in capsys.readouterr().out
    mean, drawn = (mph.read_run(tmp_path / f"{name}.h5") for name in ("mean", "drawn"))
    assert mean.unit == drawn.unit == "counts" and (mean.seed, drawn.seed) == (None, 5)
    assert mean.settings["model"] == "emission" and mean.settings["time"] == 600
    mu = mph.Volume(np.full((8, 8, 8), 0.0154), grid, "mu")
    model = mph.Emission(mean.system, mu, time=600, aperture_points=3)
    expected = mph.Projector(mean.volume.grid, mean.views, model)(mean.volume)
    np.testing.assert_allclose(mean.projections, expected, rtol=1e-5)
    np.testing.assert_array_equal(drawn.projections, mph.sample_counts(mean.projections, 5))


@pytest.mark.long
def test_every_part_of_the_emission_model_is_an_option(small_workbook, tmp_path):
    """Options reach the model and the record; for omitted ones the model's defaults hold."""
    run_file = tmp_path / "run.h5"
    options = (
        "--emission --isotope Tl-201 --window 60 80 --time 300 --aperture-points 3 --aperture-mu lead --opening-angle 80 "
        "--edge path --within-cone --within-walls --within-crystal --crystal-mu 0.3 --depth-layers 2 --intrinsic-fwhm 3"
    )
    words = [*SMALL, "--modules", "3-4", *options.split(), "-o", str(run_file)]
    assert main(["project", str(small_workbook), *words]) == 0
    run = mph.read_run(run_file)
    model = mph.Emission(
        run.system, isotope="Tl-201", window=(60, 80), time=300, aperture_points=3, aperture_mu="lead",
        opening_angle=np.deg2rad(80), edge="path", within_cone=True, within_walls=True, within_crystal=True,
        crystal_mu=0.3, depth_layers=2, intrinsic_fwhm=3, hole="rays",  # as points of the hole are asked for
    )  # fmt: skip
    expected = mph.Projector(run.volume.grid, run.views, model)(run.volume)
    assert expected.any()
    np.testing.assert_allclose(run.projections, expected, rtol=1e-5, atol=1e-6 * expected.max())
    assert {name: run.settings[name] for name in model.record()} == model.record()
    assert (run.recipe["model.aperture_mu"], run.recipe["model.crystal_mu"]) == ("lead", 0.3)  # as requested


def test_radiographs_of_mu_and_the_inverse_square_sum(small_workbook, tmp_path):
    grid = mph.Grid.centered(8, 10.0)
    mph.write_volume(mph.Volume(np.full((8, 8, 8), 0.0154), grid, "mu"), tmp_path / "mu.nii")
    words = [*SMALL[-3:], "--modules", "3-4", "--volume", str(tmp_path / "mu.nii"), "-o", str(tmp_path / "run.h5")]
    assert main(["project", str(small_workbook), *words, "--photons", "1000", "--noise", "2"]) == 0
    run = mph.read_run(tmp_path / "run.h5")
    lines = mph.Projector(grid, run.views)(run.volume)
    assert lines.any() and (run.unit, run.seed, run.settings["photons"]) == ("photons", 2, 1000)
    np.testing.assert_array_equal(run.projections, mph.sample_counts(mph.intensity(lines, 1000), 2))
    assert main(["project", str(small_workbook), *words, "--inverse-square"]) == 0
    run = mph.read_run(tmp_path / "run.h5")
    assert run.settings["model"] == "inverse square sum"
    expected = mph.Projector(grid, run.views, mph.InverseSquareSum(run.system))(run.volume)
    np.testing.assert_allclose(run.projections, expected, rtol=1e-5)


NO_EFFECT = [
    ("--volume X --voxels 8", "phantom.voxels (--voxels) does not go with volume.file (--volume)"),
    ("--volume X --radius 40", "phantom.radius does not go with volume.file (--volume)"),  # the default, but typed
    ("--states X Y --euler 0 0 0", "phantom.euler_degrees (--euler) does not go with volume.states (--states)"),
    (
        "--volume X --emission --phantom-mu",
        "attenuation.of_phantom (--phantom-mu) does not go with volume.file (--volume)",
    ),
    ("--phantom X --rods 8", "phantom.rod_diameters does not go with phantom.file (--phantom)"),
    ("--phantom X --center", "volume.center (--center) needs volume.file (--volume) or volume.states (--states)"),
    ("--series 3", "volume.series (--series) needs volume.file (--volume)"),
    ("--phantom-mu", "attenuation.of_phantom (--phantom-mu) needs model.kind = emission (--emission)"),
    ("--mu X", "attenuation.file (--mu) needs model.kind = emission (--emission)"),
    ("--emission --mu-series 3", "attenuation.series (--mu-series) needs attenuation.file (--mu)"),
    ("--emission --energy 80 --phantom-mu", "attenuation.energy (--mu-energy) needs attenuation.file (--mu)"),
    ("--emission --edge paix", "model.edge (--edge) needs model.aperture_mu (--aperture-mu)"),
    (
        "--emission --opening-angle 80",
        "model.opening_angle_degrees (--opening-angle) needs model.aperture_mu (--aperture-mu) or model.within_cone "
        "(--within-cone)",
    ),
    ("--backend torch --threads 2", "compute.threads (--threads) does not go with compute.backend = torch"),
]


@pytest.mark.parametrize(("options", "said"), NO_EFFECT)
def test_options_without_effect_are_refused(options, said, tmp_path, capsys):
    """Before anything is read: neither the workbook nor X is there."""
    assert main(["project", "none.xlsx", *options.split(), "-o", str(tmp_path / "run.h5")]) == 1
    assert capsys.readouterr().err == f"mphdrr: {said}\n"


@pytest.mark.parametrize(
    ("command", "said"),
    [
        (["geometry", "show", "none.xlsx"], "none.xlsx"),
        (["geometry", "show", "WORKBOOK", "--modules", "90"], "there are 1 to 24"),
        (["geometry", "show", "WORKBOOK", "--modules", "a-b"], "expected numbers such as"),
        (["geometry", "show", "WORKBOOK", "--modules", "20-1"], "ends before it begins"),
        (["phantom", "derenzo", "-o", "FOLDER/a.stl"], "expected a name ending in"),
        (["phantom", "derenzo", "--radius", "-1", "-o", "FOLDER/a.npz"], "Derenzo radius"),
        (["phantom", "derenzo", "--voxels", "99999", "-o", "FOLDER/a.npz"], "of memory"),
        (["phantom", "derenzo", "--voxels", "9", "9", "-o", "FOLDER/a.npz"], "--voxels"),
        (["project", "WORKBOOK", "-o", "FOLDER/a.txt"], "expected a name ending in"),
        (["project", "WORKBOOK", *SMALL, "--backend", "magic", "-o", "FOLDER/a.h5"], "auto, cpu, torch"),
        (["project", "WORKBOOK", *SMALL, "--magnification", "0", "-o", "FOLDER/a.h5"], "magnification"),
        (
            ["project", "WORKBOOK", *SMALL, "--noise", "1", "-o", "FOLDER/a.h5"],
            "(--noise) needs model.photons (--photons) or model.kind = emission (--emission)",
        ),
        (
            ["project", "WORKBOOK", *SMALL, "--edge", "path", "-o", "FOLDER/a.h5"],
            "(--edge) needs model.kind = emission (--emission)",
        ),
        (["project", "WORKBOOK", *SMALL, "--photons", "9", "-o", "FOLDER/a.h5"], "a volume of mu"),
        (["project", "WORKBOOK", *SMALL, "--emission", "--isotope", "Tc", "-o", "FOLDER/a.h5"], "Tc-99m"),
        (["project", "WORKBOOK", *SMALL, "--emission", "--time", "0", "-o", "FOLDER/a.h5"], "time"),
        (["project", "WORKBOOK", "--volume", "none.nii", "-o", "FOLDER/a.h5"], "none.nii: no such file"),
        (["project", "WORKBOOK", *SMALL[:4], "--size", "900000", "900000", "-o", "FOLDER/a.h5"], "of memory"),
        (["project", "WORKBOOK", *SMALL, "-o", "WORKBOOK/a.h5"], "cannot be written"),
        (["project", "WORKBOOK", *SMALL, "-o", "FOLDER/a.h5", "--mosaic", "FOLDER"], "is a folder"),
        (["project", "WORKBOOK", "-o", "FOLDER/sub/a.txt"], "expected a name ending in"),
        (["export", "none.h5", "-o", "FOLDER/a.npz"], "none.h5: no such file"),
        (["export", "WORKBOOK", "-o", "FOLDER/a.npz"], "expected a name ending in"),
    ],
)
def test_users_errors_are_one_line_with_status_1_and_leave_nothing(command, said, small_workbook, tmp_path, capsys):
    words = [word.replace("WORKBOOK", str(small_workbook)).replace("FOLDER", str(tmp_path)) for word in command]
    assert main(words) == 1
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_export_checks_every_name_before_it_writes(small_workbook, tmp_path, capsys):
    run, first = str(tmp_path / "run.npz"), tmp_path / "first.npz"
    assert main(["project", str(small_workbook), *SMALL, "-o", run]) == 0
    assert main(["export", run, "-o", str(first), "-o", str(tmp_path / "second.stl")]) == 1
    assert "second.stl: expected a name ending in" in capsys.readouterr().err
    assert not first.exists()


def test_usage_errors_have_status_2(capsys):
    assert main(["geometry"]) == 2
    assert main(["project", "--size", "x"]) == 2
    assert main(["project", "a.xlsx", "-o", "a.h5", "--emission", "--photons", "1"]) == 2
    assert main(["fly"]) == 2
    assert all(line.startswith("mphdrr") for line in capsys.readouterr().err.splitlines())


@pytest.mark.parametrize(
    "command",
    [[], ["geometry"], ["geometry", "check"], ["phantom", "derenzo"], ["project"], ["export"], ["scene"], ["demo"]],
)
def test_every_help_has_an_example(command, capsys):
    assert main([*command, "--help"]) == 0
    assert "example: mphdrr" in capsys.readouterr().out


def test_an_interrupt_leaves_nothing(small_workbook, tmp_path, monkeypatch, capsys):
    from mphdrr.core.runs import run_recipe

    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(run_recipe, "project_run", interrupted)
    assert main(["project", str(small_workbook), *SMALL, "-o", str(tmp_path / "run.h5")]) == 130
    assert "cancelled" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_the_package_is_imported_without_its_heavy_parts():
    code = (
        "import sys, mphdrr.core, mphdrr.addon.cli; "
        "heavy = {'torch', 'h5py', 'openpyxl', 'PIL', 'trimesh', 'nibabel', 'bpy'} & set(sys.modules); "
        "sys.exit(f'imported: {heavy}' if heavy else 0)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_geometry_performance_adds_up(small_workbook, capsys):
    options = ["--aperture-mu", "3.6", "--crystal-mu", "0.404", "--intrinsic-fwhm", "3", "--isotope", "Tc-99m"]
    assert main(["geometry", "performance", str(small_workbook), *options, "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    expected = mph.sensitivity(
        mph.read_system(small_workbook), [[0, 0, 0]], aperture_mu=3.6, crystal_mu=0.404, photons_per_decay=0.891
    )
    assert [m["sensitivity"] for m in printed["modules"]] == pytest.approx(1e6 * expected[0])
    assert printed["total"]["sensitivity"] == pytest.approx(1e6 * expected.sum())
    assert printed["total"]["modules_holding_roi"] == 24
    assert all(m["roi_radius_seen"] == pytest.approx(75, abs=1e-3) for m in printed["modules"])
    named = ["--aperture-mu", "tungsten", "--crystal-mu", "CZT", "--isotope", "Tc-99m", "--json"]
    assert main(["geometry", "performance", str(small_workbook), *named]) == 0
    total = json.loads(capsys.readouterr().out)["total"]["sensitivity"]
    assert total == pytest.approx(1e6 * expected.sum(), rel=1e-3)
    assert main(["geometry", "performance", str(small_workbook), *named[2:4]]) == 1
    assert "crystal_mu 'CZT': at which energy" in capsys.readouterr().err
    assert main(["geometry", "performance", str(small_workbook), "--opening-angle", "200"]) == 1
    assert "--opening-angle: expected less than 180 degrees, got 200" in capsys.readouterr().err
    assert main(["geometry", "performance", str(small_workbook), "--point", "0", "0", "900"]) == 0
    assert "from 0 of 24 modules" in capsys.readouterr().out


@pytest.mark.parametrize("quantity", ["sensitivity", "modules", "resolution", "completeness"])
def test_geometry_map_writes_a_volume(small_workbook, tmp_path, capsys, quantity):
    path = tmp_path / "new" / f"{quantity}.nii.gz"
    grid = ["--voxels", "6", "5", "4", "--spacing", "20", "--center", "10", "0", "0"]
    assert main(["geometry", "map", str(small_workbook), "--quantity", quantity, *grid, "-o", str(path)]) == 0
    volume = mph.read_volume(path)
    assert volume.quantity == quantity
    assert volume.grid == mph.Grid.centered((6, 5, 4), 20.0, (10, 0, 0))
    system = mph.read_system(small_workbook)
    make = {"sensitivity": mph.sensitivity_map, "modules": mph.modules_map, "resolution": mph.resolution_map}
    assert np.array_equal(volume.array, make.get(quantity, mph.completeness_map)(system, volume.grid).array)
    assert quantity in capsys.readouterr().out
    if quantity in ("modules", "completeness"):
        with_material = ["--quantity", quantity, "--crystal-mu", "CZT", "-o", str(path)]
        assert main(["geometry", "map", str(small_workbook), *with_material]) == 1
        assert f"--crystal-mu has no effect on --quantity {quantity}" in capsys.readouterr().err


def test_geometry_of_a_fit_is_generated_again(small_workbook, tmp_path, capsys):
    """The workbook made from the printed parameters follows the same ellipse."""
    assert main(["geometry", "fit", str(small_workbook), "--json"]) == 0
    ring = json.loads(capsys.readouterr().out)["rings"][0]
    assert ring["curve_deviation"] < 0.001
    path = tmp_path / "again.xlsx"
    numbers = {
        "--semi-axes": ring["semi_axes"],
        "--center": ring["center"],
        "--rotation": [ring["rotation"]],
        "--start": ring["azimuths"][:1],
        "--end": ring["azimuths"][-1:],
        "--z": [-71, -24],
    }
    typed = [word for option, values in numbers.items() for word in (option, *map(str, values))]
    command = ["geometry", "generate", "ellipse", *typed, "--spacing", ring["spacing"], "--mirrored", "-o", str(path)]
    assert main(command) == 0
    made = mph.fit_rings(mph.read_system(path))
    assert [len(fit.numbers) for fit in made] == [20] * 4
    assert np.allclose(made[0].semi_axes, ring["semi_axes"], atol=1e-6)
    assert made[0].even_deviation < 1e-6


@pytest.mark.filterwarnings("ignore:.*the sheet's is used")
def test_geometry_of_plates_is_generated(tmp_path, capsys):
    path = tmp_path / "plates.xlsx"
    size = ["--polygon", "5", "--apothem", "220", "--modules", "4", "--l", "60", "--d", "3"]
    assert main(["geometry", "generate", "plates", *size, "--z", "-30", "30", "-o", str(path)]) == 0
    system = mph.read_system(path)
    assert len(system) == 40
    assert np.allclose(system.collimator_length, 60)
    expected = mph.plate_rings(
        4, mph.regular_polygon(5, 220.0), (-30, 30),
        pinhole_diameter=3.0, detector_side=50.0, detector_thickness=10.0, roi_radius=75.0,
    )  # fmt: skip
    assert np.allclose(system.centers, expected.centers, atol=1e-9)
    corners = ["--vertices", "-200", "-100", "200", "-100", "200", "100", "--open"]
    assert main(["geometry", "generate", "plates", *corners, "--z", "0", "--R", "60", "-o", str(path)]) == 0
    assert len(mph.read_system(path)) == 8
    capsys.readouterr()
    for wrong in (["--polygon", "5"], ["--vertices", "1", "2", "3"]):
        assert main(["geometry", "generate", "plates", *wrong, "--z", "0", "-o", str(path)]) == 1
        assert "expected" in capsys.readouterr().err


def test_demo_without_blender_leaves_out_the_scene(tmp_path, monkeypatch, capsys):
    find_spec = importlib.util.find_spec
    without = lambda name, *more: None if name == "bpy" else find_spec(name, *more)  # noqa: E731
    monkeypatch.setattr(importlib.util, "find_spec", without)
    assert main(["demo", "--voxels", "16", "--size", "8", "--output", str(tmp_path)]) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mosaic.png", "run.h5"]
    assert "need Blender" in capsys.readouterr().err
