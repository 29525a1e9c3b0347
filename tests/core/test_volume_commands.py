"""``mphdrr volume`` and the CT options of ``mphdrr project``."""

from __future__ import annotations

import json

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.cli import main
from mphdrr.core.physics.materials import attenuation

from .dicom_files import write_series, write_tomogram
from .test_meshes import box


@pytest.fixture
def ct(tmp_path):
    """Return water in air, off the isocentre, x to the left."""
    affine = np.diag([-2.0, 2, 3, 1])
    affine[:3, 3] = [100, -40, 300]
    array = np.full((20, 22, 16), -1000.0)
    array[4:16, 4:16, 4:12] = 0
    volume = mph.Volume(array, mph.Grid(array.shape, affine), "hu")
    mph.write_volume(volume, tmp_path / "ct.nrrd")
    return volume


def run(*arguments) -> int:
    return main([str(argument) for argument in arguments])


def test_info(tmp_path, ct, capsys):
    assert run("volume", "info", tmp_path / "ct.nrrd", "--json") == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["axes"] == "LAS"
    assert facts["voxels"] == [20, 22, 16]
    assert facts["spacing_mm"] == [2, 2, 3]
    assert facts["center_mm"] == pytest.approx(ct.grid.center.tolist())
    assert (facts["quantity"], facts["smallest"], facts["largest"]) == ("hu", -1000, 0)
    assert run("volume", "info", tmp_path / "ct.nrrd") == 0
    assert "LAS" in capsys.readouterr().out


def test_convert_does_all_steps_in_order(tmp_path, ct, capsys):
    out = tmp_path / "new" / "mu.h5"
    steps = ("--canonical", "--crop", 66, 96, -36, -6, 310, 335, "--pad", 1, "--center", "--spacing", 4, "--to-mu")
    assert run("volume", "convert", tmp_path / "ct.nrrd", *steps, "--energy", "I-123", "-o", out) == 0
    volume = mph.read_volume(out)
    assert volume.quantity == "mu"
    assert np.allclose(volume.grid.affine[:3, :3], np.diag([4, 4, 4]))
    assert np.allclose(volume.grid.center, 0, atol=4)
    assert volume.array.max() == pytest.approx(attenuation("water", 159), rel=1e-5)
    total = volume.array.sum(dtype=np.float64) * volume.grid.voxel_volume
    assert total == pytest.approx(12 * 12 * 8 * 12 * attenuation("water", 159), rel=2e-2)
    assert "1/mm" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("--energy", "80"), "--energy needs --to-mu"),
        (("--method", "nearest"), "--method needs --spacing"),
        (("--to-mu", "--energy", "Xx-1"), "energy 'Xx-1': expected keV, or one of F-18"),
        (("--to-mu", "--quantity", "mu"), "expected a volume of hu, got mu"),
        (("--spacing", "1", "2"), "--spacing: expected one or three numbers"),
        (("--crop", "0", "1", "0", "1", "0", "1"), "the volume is not in it"),
        (("--affine", *["0"] * 16), "affine"),
        (("--series", "2"), "only folders of DICOM files"),
    ],
)
def test_convert_says_what_it_cannot_do(tmp_path, ct, capsys, arguments, expected):
    assert run("volume", "convert", tmp_path / "ct.nrrd", *arguments, "-o", tmp_path / "o.nrrd") == 1
    error = capsys.readouterr().err
    assert expected in error
    assert error.count("\n") == 1
    assert not (tmp_path / "o.nrrd").exists()


def test_meshes_in_and_out(tmp_path, ct, capsys):
    assert run("volume", "to-mesh", tmp_path / "ct.nrrd", "--level", -500, "-o", tmp_path / "m.stl") == 0
    mesh = mph.read_mesh(tmp_path / "m.stl")
    assert mesh.volume == pytest.approx(12 * 12 * 8 * 12, rel=5e-2)
    assert np.allclose((mesh.vertices.max(axis=0) + mesh.vertices.min(axis=0)) / 2, [81, -21, 322.5], atol=1e-3)
    mph.write_mesh(box((1.0, 1, 1), (8.1, -2.1, 32.2)), tmp_path / "core.ply", "mm")
    meshes = (tmp_path / "m.stl", tmp_path / "core.ply")
    assert run("volume", "from-mesh", *meshes, "--value", 1, 3, "--spacing", 3, "-o", tmp_path / "v.npz") == 0
    volume = mph.read_volume(tmp_path / "v.npz")
    total = volume.array.sum(dtype=np.float64) * volume.grid.voxel_volume
    assert total == pytest.approx(mesh.volume + 3, rel=1e-5)
    assert run("volume", "from-mesh", *meshes, "--value", 1, 2, 3, "-o", tmp_path / "v.npz") == 1
    assert "--value: expected one number, or one for each of 2 meshes" in capsys.readouterr().err


def test_project_converts_and_centers_a_ct(tmp_path, ct, small_workbook, scanner, capsys, monkeypatch):
    common = ("project", small_workbook, "--modules", "1", "--size", 9, 9, "--backend", "numpy")
    ct_file, out = tmp_path / "ct.nrrd", tmp_path / "run.h5"
    assert run(*common, "--volume", ct_file, "--center", "--energy", "Tc-99m", "-o", out) == 0
    assert capsys.readouterr().err == ""
    result = mph.read_run(out)
    assert result.volume.quantity == "mu"
    assert np.allclose(result.volume.grid.center, 0, atol=1e-9)
    assert result.projections.max() == pytest.approx(24 * attenuation("water", 140.5), rel=0.5)
    assert result.settings["ct_converted_at_kev"] == 140.5

    # Activity and CT in one frame stay together, as if both had been centred before.
    activity = mph.Volume(ct.array == 0, ct.grid, "activity")
    mph.write_volume(activity, tmp_path / "a.nrrd")
    emission = ("--emission", "--mu", ct_file, "--energy", 140.5, "--center")
    assert run(*common, "--volume", tmp_path / "a.nrrd", *emission, "-o", out) == 0
    counts = mph.read_run(out).projections
    system = scanner[:1]
    model = mph.Emission(system, mu=mph.hu_to_mu(mph.centered(ct)))
    expected = mph.project_run(system, mph.centered(activity), shape=(9, 9), backend="numpy", model=model).projections
    assert np.allclose(counts, expected, rtol=1e-5)

    monkeypatch.chdir(tmp_path)
    for arguments, message in (
        ("--volume a.nrrd --emission --mu ct.nrrd", "give the energy (--energy) to convert them"),
        ("--volume a.nrrd --energy 80", "it holds activity; an energy (--energy) is for CT numbers"),
        ("--volume ct.nrrd --emission", "ct.nrrd: it holds hu, expected activity in kBq/mL"),
        ("--volume a.nrrd --photons 100", "a.nrrd: it holds activity, expected mu in 1/mm"),
        ("--volume a.nrrd --emission --mu a.nrrd", "it holds activity, expected mu"),
        ("--energy 80", "(--energy) needs volume.file (--volume)"),
        ("--center", "(--center) needs volume.file (--volume)"),
    ):
        assert run(*common, *arguments.split(), "-o", out) == 1
        assert message in capsys.readouterr().err


def test_project_takes_one_series_of_a_dicom_folder(tmp_path, ct, small_workbook, scanner, capsys):
    """Equal to the radiograph of the volume, and the counts with the mu, from which the series was written."""
    affine = np.diag([2.0, 2, 3, 1])
    affine[:3, 3] = ct.grid.affine[:3, 3]
    ct = mph.Volume(ct.array, mph.Grid(ct.grid.shape, affine), "hu")
    write_series(mph.Volume(ct.array + 100, ct.grid, "hu"), tmp_path / "dicom", 3, "Soft")
    write_series(ct, tmp_path / "dicom", 4, "Lung")
    common = ("project", small_workbook, "--modules", "1", "--size", 9, 9, "--backend", "numpy", "--center")
    out, folder = tmp_path / "run.npz", tmp_path / "dicom"
    options = ("--energy", 80)
    assert run(*common, "--volume", folder, *options, "-o", out) == 1
    assert 'it holds 2 series, choose one: 3 "Soft" (16 images); 4 "Lung" (16 images)' in capsys.readouterr().err
    assert run(*common, "--volume", folder, "--series", "Lung", *options, "-o", out) == 0
    system = scanner[:1]
    expected = mph.project_run(system, mph.hu_to_mu(mph.centered(ct), 80), shape=(9, 9), backend="numpy")
    np.testing.assert_allclose(mph.read_run(out).projections, expected.projections, rtol=1e-6)

    activity = mph.Volume(ct.array == 0, ct.grid, "activity")
    mph.write_volume(activity, tmp_path / "a.npz")
    through = ("--emission", "--mu", folder, "--mu-series", "4", "--energy", 140.5)
    assert run(*common, "--volume", tmp_path / "a.npz", *through, "-o", out) == 0
    model = mph.Emission(system, mu=mph.hu_to_mu(mph.centered(ct)))
    expected = mph.project_run(system, mph.centered(activity), shape=(9, 9), backend="numpy", model=model)
    np.testing.assert_allclose(mph.read_run(out).projections, expected.projections, rtol=1e-6)
    assert run(*common, "--volume", tmp_path / "a.npz", "--series", "4", "-o", out) == 1
    assert "only folders of DICOM files hold several series" in capsys.readouterr().err

    # A reconstructed tomogram of one file beside them, as activity.
    tomogram = mph.Volume(2 * activity.array + 1, activity.grid)
    write_tomogram(tomogram, tmp_path / "recon.dcm")
    assert run(*common, "--volume", tmp_path / "recon.dcm", "--emission", "-o", out) == 0
    expected = mph.project_run(
        system, mph.centered(tomogram), shape=(9, 9), backend="numpy", model=mph.Emission(system)
    )
    np.testing.assert_allclose(mph.read_run(out).projections, expected.projections, rtol=1e-6)
