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


def one(shape: mph.Shape) -> mph.ShapePhantom:
    return mph.ShapePhantom([shape])


NUMPY = ["--size", "9", "9", "--backend", "numpy"]


@pytest.mark.parametrize(
    ("kind", "phantom"),
    [
        ("nema --background 2", mph.NemaBody(background=2)),
        ("jaszczak --rod-diameters 5 6 7 8 9 0", mph.JaszczakPhantom(rod_diameters=(5, 6, 7, 8, 9, 0))),
        ("defrise --disks 3 --spacing-of-disks 30", mph.DefrisePhantom(3, spacing=30)),
        ("shepp-logan --contrast original", mph.SheppLogan(contrast="original")),
        ("mixture --seed 4 --number 3 --look lumps", mph.MixturePhantom(seed=4, number=3, look="lumps")),
        ("points --counts 1 2 3 --spacing-of-points 9 8 7", mph.PointGrid((1, 2, 3), (9, 8, 7))),
        ("torso --phase 0.35 --defect-severity 1", mph.CardiacTorso(phase=0.35, defect_severity=1)),
        (
            "derenzo --rods 8 5 4 --sectors 3 --water 45 50 --background 3",
            mph.DerenzoPhantom(40, (8, 5, 4), 40, 100, 3, 45, 50, 3),
        ),
        ("derenzo --altered -3", mph.DerenzoPhantom(activity=100, altered=-3)),
        ("cylinder --radius 30 20 --height 9", one(mph.Cylinder(radius=(30, 20), height=9, activity=100, mu=0))),
        ("sphere --radius 3", one(mph.Sphere(radius=3, activity=100, mu=0))),
        ("ellipsoid --radii 3 4 5", one(mph.Ellipsoid(radii=(3, 4, 5), activity=100, mu=0))),
        ("box --size 3 4 5", one(mph.Box(size=(3, 4, 5), activity=100, mu=0))),
    ],
    ids=lambda value: value.split()[0] if isinstance(value, str) else "",
)
def test_every_kind_is_made_as_asked(kind, phantom, tmp_path, capsys):
    kind = kind.split()
    assert main(["phantom", *kind, "-o", str(tmp_path / "p.toml")]) == 0
    assert mph.read_phantom(tmp_path / "p.toml").shapes == tuple(phantom.shapes)
    if kind[0] == "sphere":
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


def test_a_phantom_of_shapes_is_projected(small_workbook, tmp_path, capsys):
    path = tmp_path / "thorax.toml"
    path.write_text(THORAX)
    options = ["--voxels", "40", "--size", "12", "12", "--modules", "1-2"]
    words = ["project", str(small_workbook), "--phantom", str(path), *options]
    assert main([*words, "-o", str(tmp_path / "run.npz")]) == 0
    run = mph.read_run(tmp_path / "run.npz")
    assert run.settings["volume"] == "thorax.toml" and run.recipe["phantom.file"] == str(path)
    exact = mph.read_phantom(path).project(run.views)
    assert np.sqrt(np.mean((run.projections - exact) ** 2)) < 0.05 * exact.max()
    assert main([*words, "--photons", "1e4", "-o", str(tmp_path / "photons.npz")]) == 0
    assert mph.read_run(tmp_path / "photons.npz").unit == "photons"


@pytest.mark.long
@pytest.mark.parametrize("is_file", [True, False], ids=["file", "Derenzo"])
def test_a_phantoms_own_mu_attenuates_as_its_volume_would(is_file, small_workbook, tmp_path, capsys):
    (tmp_path / "thorax.toml").write_text(THORAX)
    place = ["--voxels", "22", "21", "22", "--spacing", "7.5", "--euler", "10", "20", "30", "--position", "3", "2", "1"]
    water = ["--rods", "9", "9", "8", "8", "9", "9", "--water", "45", "50", "--background", "20"]
    make = ["file", str(tmp_path / "thorax.toml"), *place] if is_file else ["derenzo", *water, *place]
    for quantity in ("activity", "mu"):
        words = ["phantom", *make, "--quantity", quantity, "-o", str(tmp_path / f"{quantity}.npz")]
        assert main(words) == 0
    project = ["project", str(small_workbook), *NUMPY, "--modules", "1", "--emission", "--isotope", "Tc-99m"]
    files = ["--volume", str(tmp_path / "activity.npz"), "--mu", str(tmp_path / "mu.npz")]
    source = ["--phantom", str(tmp_path / "thorax.toml"), *place] if is_file else [*water, *place]
    counts = []
    for name, more in (("files", files), ("own", [*source, "--phantom-mu"]), ("none", source)):
        assert main([*project, *more, "-o", str(tmp_path / f"{name}.npz")]) == 0
        counts.append(mph.read_run(tmp_path / f"{name}.npz").projections)
    assert capsys.readouterr().err == ""
    np.testing.assert_array_equal(counts[1], counts[0])
    assert 0.1 * counts[2].sum() < counts[1].sum() < 0.9 * counts[2].sum()
    assert mph.read_run(tmp_path / "own.npz").recipe["attenuation.of_phantom"]


def test_a_phantoms_own_mu_is_checked(small_workbook, tmp_path, capsys):
    words = ["project", str(small_workbook), *NUMPY, "--modules", "1", "--voxels", "16", "--emission"]
    out = str(tmp_path / "run.npz")
    assert main([*words, "--phantom-mu", "--isotope", "Tl-201", "-o", out]) == 0
    assert (
        "the mu of the Derenzo phantom holds at 140.5 keV, photons of 63.963 to 78.177 keV" in capsys.readouterr().err
    )
    (tmp_path / "hot.toml").write_text('name = "hot"\n[[shape]]\nkind = "sphere"\nradius = 9\nactivity = 1\n')
    assert main([*words, "--phantom", str(tmp_path / "hot.toml"), "--phantom-mu", "-o", out]) == 1
    assert "(--phantom-mu): no shape of the hot has a mu" in capsys.readouterr().err
    assert main([*words, "--phantom-mu", "--mu", "mu.npz", "-o", out]) == 1


def test_a_beating_heart_is_a_run_for_each_state(small_workbook, tmp_path, capsys, monkeypatch):
    def quick(torso, grid, pose, *_, **__):
        np.testing.assert_allclose(pose[:3, 3], (9, 8, 7))
        return mph.Volume(np.full(grid.shape, 1 + torso.phase), grid)

    monkeypatch.setattr(mph.CardiacTorso, "voxelize", quick)
    beat = ["phantom", "torso", "--frames", "2", "--voxels", "9", "--position", "9", "8", "7", "--json"]
    assert main([*beat, "-o", str(tmp_path / "beat.npz")]) == 0
    assert [entry["phase"] for entry in json.loads(capsys.readouterr().out)] == [0, 0.5]
    states = [mph.read_volume(tmp_path / f"beat-{k}.npz") for k in (1, 2)]
    assert [state.array.max() for state in states] == [1, 1.5] and states[0].grid == states[1].grid

    files = [str(tmp_path / f"beat-{k}.npz") for k in (1, 2)]
    project = ["project", str(small_workbook), *NUMPY, "--modules", "20", "--emission", "--hole", "point", "--center"]
    more = ["--noise", "5", "--mosaic", str(tmp_path / "m.png")]
    assert main([*project, "--states", *files, *more, "-o", str(tmp_path / "run.npz")]) == 0
    for k, file in enumerate(files):
        assert main([*project, "--volume", file, "--noise", str(5 + k), "-o", str(tmp_path / "one.npz")]) == 0
        run, one = mph.read_run(tmp_path / f"run-{k + 1}.npz"), mph.read_run(tmp_path / "one.npz")
        np.testing.assert_array_equal(run.projections, one.projections)
        assert run.seed == 5 + k and run.settings["volume"] == f"beat-{k + 1}.npz"
        assert (tmp_path / f"m-{k + 1}.png").is_file()
    capsys.readouterr()
    assert main([*project, "--states", *files, "-o", str(tmp_path / "beat.npz")]) == 1
    assert "is both an input and an output" in capsys.readouterr().err
    mu = str(tmp_path / "mu.npz")
    mph.write_volume(mph.Volume(0.01 * states[0].array, states[0].grid, "mu"), mu)
    assert main([*project, "--volume", files[0], "--mu", mu, "-o", mu]) == 1
    assert "is both an input and an output" in capsys.readouterr().err
    assert np.array_equal(mph.read_volume(files[0]).array, states[0].array)


@pytest.mark.parametrize(
    ("words", "status", "said"),
    [
        ("nema --length -1", 1, "NEMA body phantom: length: expected more than 0 mm, got -1"),
        ("sphere", 2, "--radius"),
        ("blob", 2, "invalid choice"),
        ("file nowhere.toml", 1, "nowhere.toml: no such file"),
        ("derenzo --rods 8 6", 1, "Derenzo rod diameters: expected one for each of 6 sectors (0: empty), got 2"),
        ("sphere --radius 3 --count 2", 1, "--count and --box need --random"),
        ("sphere --radius 3 --random -1", 1, "--random: expected a seed"),
        ("sphere --radius 3 --random 1 --count 0", 1, "--count: expected at least 1"),
        ("torso --random 1 --euler 1 2 3", 1, "--euler has no effect with --random"),
        ("torso --frames 2 --phase 0.1", 1, "--phase has no effect with --frames"),
        ("torso --frames 0", 1, "frames of the cycle: expected"),
        ("sphere --radius 3 --voxels 9 -o p.toml", 1, "--voxels is of voxels, but a .toml holds only"),
    ],
)
def test_wrong_words_get_one_line(words, status, said, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["phantom", *f"{words}{'' if ' -o ' in words else ' -o p.npz'}".split()]) == status
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1
    assert not list(tmp_path.iterdir())
