"""`mphdrr phantom` and `mphdrr project --phantom`, as a user types them."""

from __future__ import annotations

import json

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.cli import main

THORAX = """
name = "thorax"
[[shape]]
kind = "cylinder"
radius = [60, 40]
height = 100
activity = 5
mu = 0.0154
[[shape]]
kind = "sphere"
radius = 10
activity = 40
"""


@pytest.mark.parametrize(
    ("kind", "phantom"),
    [
        (["nema", "--background", "2"], mph.NemaBody(background=2)),
        (
            ["jaszczak", "--rod-diameters", "5", "6", "7", "8", "9", "0"],
            mph.JaszczakPhantom(rod_diameters=(5, 6, 7, 8, 9, 0)),
        ),
        (["defrise", "--disks", "3", "--spacing-of-disks", "30"], mph.DefrisePhantom(3, spacing=30)),
        (["shepp-logan", "--contrast", "original"], mph.SheppLogan(contrast="original")),
        (
            ["points", "--counts", "1", "2", "3", "--spacing-of-points", "9", "8", "7"],
            mph.PointGrid((1, 2, 3), (9, 8, 7)),
        ),
        (["torso", "--phase", "0.35", "--defect-severity", "1"], mph.CardiacTorso(phase=0.35, defect_severity=1)),
        (
            ["derenzo", "--rods", "8", "5", "4", "--sectors", "3", "--water", "45", "50", "--background", "3"],
            mph.DerenzoPhantom(40, (8, 5, 4), 40, 100, 3, 45, 50, 3),
        ),
        (
            ["cylinder", "--radius", "30", "20", "--height", "9"],
            mph.ShapePhantom([mph.Cylinder(radius=(30, 20), height=9, activity=100, mu=0)], "cylinder"),
        ),
        (["sphere", "--radius", "3"], mph.ShapePhantom([mph.Sphere(radius=3, activity=100, mu=0)], "sphere")),
        (
            ["ellipsoid", "--radii", "3", "4", "5"],
            mph.ShapePhantom([mph.Ellipsoid(radii=(3, 4, 5), activity=100, mu=0)]),
        ),
        (["box", "--size", "3", "4", "5"], mph.ShapePhantom([mph.Box(size=(3, 4, 5), activity=100, mu=0)])),
    ],
    ids=lambda value: value[0] if isinstance(value, list) else "",
)
def test_every_kind_is_made_as_asked(kind, phantom, tmp_path, capsys):
    assert main(["phantom", *kind, "-o", str(tmp_path / "p.toml")]) == 0
    assert mph.read_phantom(tmp_path / "p.toml").shapes == tuple(phantom.shapes)
    if kind[0] in ("sphere", "torso"):
        placed = ["--voxels", "30", "--euler", "10", "20", "30", "--position", "1", "2", "3"]
        for quantity in ("activity", "mu"):
            assert main(["phantom", *kind, *placed, "--quantity", quantity, "-o", str(tmp_path / "p.npz")]) == 0
            volume = mph.read_volume(tmp_path / "p.npz")
            pose = mph.euler_pose(*np.deg2rad([10, 20, 30]), (1, 2, 3))
            assert volume.quantity == quantity
            np.testing.assert_array_equal(volume.array, phantom.voxelize(volume.grid, pose, quantity=quantity).array)


def test_random_instances_are_written_with_their_poses(tmp_path, capsys):
    (tmp_path / "thorax.toml").write_text(THORAX)
    options = ["--voxels", "20", "--random", "7", "--count", "3", "--box", "20", "10", "0", "--json"]
    words = ["phantom", "file", str(tmp_path / "thorax.toml"), *options, "-o", str(tmp_path / "a.nii.gz")]
    assert main(words) == 0
    written = json.loads(capsys.readouterr().out)
    assert [entry["file"] for entry in written] == [str(tmp_path / f"a-{i}.nii.gz") for i in (1, 2, 3)]
    rng = np.random.default_rng(7)
    phantom = mph.read_phantom(tmp_path / "thorax.toml")
    for entry in written:
        np.testing.assert_allclose(entry["pose"], mph.random_pose(rng, (20, 10, 0)))
        assert entry["total_kBq"] == pytest.approx(phantom.total_activity, rel=1e-3)


def test_a_phantom_of_shapes_is_projected(workbook, tmp_path, capsys):
    path = tmp_path / "thorax.toml"
    path.write_text(THORAX)
    words = [
        "project",
        str(workbook),
        "--phantom",
        str(path),
        "--voxels",
        "40",
        "--size",
        "12",
        "12",
        "--modules",
        "1-2",
    ]
    assert main([*words, "-o", str(tmp_path / "run.npz")]) == 0
    run = mph.read_run(tmp_path / "run.npz")
    assert run.settings["volume"] == "thorax.toml" and run.settings["phantom"]["name"] == "thorax"
    exact = mph.read_phantom(path).project(run.views)
    assert np.sqrt(np.mean((run.projections - exact) ** 2)) < 0.05 * exact.max()
    assert main([*words, "--photons", "1e4", "-o", str(tmp_path / "photons.npz")]) == 0
    assert mph.read_run(tmp_path / "photons.npz").unit == "photons"


@pytest.mark.parametrize(
    ("words", "status", "said"),
    [
        (["nema", "--length", "-1"], 1, "NEMA body phantom: length: expected more than 0 mm, got -1"),
        (["sphere"], 2, "--radius"),
        (["blob"], 2, "invalid choice"),
        (["file", "nowhere.toml"], 1, "nowhere.toml: No such file"),
        (
            ["derenzo", "--rods", "8", "6"],
            1,
            "Derenzo rod diameters: expected one for each of 6 sectors (0: empty), got 2",
        ),
        (["sphere", "--radius", "3", "--count", "2"], 1, "--count and --box need --random"),
        (["sphere", "--radius", "3", "--random", "-1"], 1, "--random: expected a seed"),
        (["sphere", "--radius", "3", "--random", "1", "--count", "0"], 1, "--count: expected at least 1"),
    ],
)
def test_wrong_words_get_one_line(words, status, said, tmp_path, capsys):
    assert main(["phantom", *words, "-o", str(tmp_path / "p.npz")]) == status
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1
    assert not list(tmp_path.iterdir())
