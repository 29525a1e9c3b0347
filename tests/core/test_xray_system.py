"""X-ray systems: geometry, workbook, arrangements, checks, and what follows from the table of kinds of scanners."""

from __future__ import annotations

import math
import warnings

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.cli import main
from mphdrr.core.exchange import FORMATS
from mphdrr.core.geometry.frames import euler_pose
from mphdrr.core.xray.checks import RAYS
from mphdrr.core.xray.system import filter_text, filter_thicknesses

from .workbooks import edited

pytestmark = pytest.mark.filterwarnings("error")


def one(**changes) -> mph.XraySystem:
    """A source below the isocentre, and above it a panel of 200 x 300 mm that is neither square nor in the middle."""
    given = {
        "sources": [[5.0, -300.0, 2.0]], "panel_centers": [[20.0, 200.0, -30.0]], "panel_u": [[2.0, 0.0, 0.0]],
        "panel_v": [[0.0, 0.0, -3.0]], "shape": (100, 100), "kvp": 80, "mas": 0.5, "filters": {"Al": 2.5},
    }  # fmt: skip
    return mph.XraySystem(**{**given, **changes})


@pytest.fixture(scope="module")
def pinholes(workbook):
    return mph.read_system(workbook)


@pytest.fixture(scope="module")
def arc():
    return mph.xray_arc(6, filters=[{"Al": 2.5}, "", *["Cu 0.1 + Al 1"] * 4], mas=[1, 2, 3, 4, 5, 6])


@pytest.fixture(scope="module")
def both(workbook, arc, tmp_path_factory):
    return mph.write_system(arc, tmp_path_factory.mktemp("xray") / "both.xlsx", workbook).path


def assert_same(one, other) -> None:
    assert type(one) is type(other) and one.numbers.tolist() == other.numbers.tolist()
    for name, values in one.values().items():
        np.testing.assert_array_equal(values, other.values()[name], err_msg=name)


def test_views_are_the_panels_own_pixels_or_all_of_the_panel_in_others():
    system = one()
    views = system.views()
    assert views.shape == system.pixels == (100, 100)
    np.testing.assert_array_equal(views.u_steps, system.panel_u)
    first = views.rays(0)[1][0]
    np.testing.assert_allclose(first, [20 - 99, 200, -30 + 1.5 * 99])
    coarse = system.views((25, 50))
    for name, n in (("u_steps", 2), ("v_steps", 4)):
        np.testing.assert_allclose(getattr(coarse, name), n * getattr(views, name))
    np.testing.assert_allclose(np.linalg.norm(system.views(pitch=(1, 0.5)).v_steps, axis=1), 0.5)
    np.testing.assert_allclose(system.views(offset=(4, 6)).detector_centers[0], [24, 200, -36])
    with pytest.raises(
        mph.InputError, match="detector 'real': a panel stands in front of its source, expected 'virtual'"
    ):
        system.views(detector="real")


def test_sources_and_panels_move_as_rigid_bodies(arc):
    motion = euler_pose(0.3, -0.4, 1.1, (5, -6, 7))
    moved = arc.at_poses(motion @ arc.poses())
    for name in ("sources", "panel_centers"):
        np.testing.assert_allclose(
            getattr(moved, name), getattr(arc, name) @ motion[:3, :3].T + motion[:3, 3], atol=1e-9
        )
    np.testing.assert_allclose(moved.panel_v, arc.panel_v @ motion[:3, :3].T, atol=1e-12)
    np.testing.assert_allclose(moved.poses(), motion @ arc.poses(), atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(arc.frames()), 1)
    np.testing.assert_allclose(moved.fields(), arc.fields(), atol=1e-9)
    shift = np.eye(4)
    shift[2, 3] = 5.0
    assert np.array_equal(arc.at_poses(shift @ arc.poses()).panel_u, arc.panel_u)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"panel_v": [[0.0, 0.0, 3.0]]},
            "module 1: panel_u, panel_v and the way from source to panel must be right-handed",
        ),
        ({"panel_v": [[1.0, 0.0, -3.0]]}, "module 1: panel_u and panel_v must be at right angles"),
        ({"panel_centers": [[20.0, -300.0, -30.0]]}, "right-handed"),
        ({"panel_u": [[0.0, 0.0, 0.0]]}, "right-handed"),
        ({"shape": (100, 0)}, "shape"),
        ({"shape": None}, "shape"),
        ({"kvp": 0}, "kvp must be more than 0, got 0|kvp must be more than 0"),
        ({"focal_spot": -1}, "focal_spot must be 0 mm or more, got -1"),
        ({"filters": "2.5 mm"}, "filters '2.5 mm': expected materials with their mm, such as Al 2.5"),
        ({"filters": {"Al": -1}}, "filter Al: expected"),
        ({"filters": 3}, "filters: expected material and mm"),
    ],
)
def test_what_is_no_system_is_refused(changes, message):
    with pytest.raises(mph.InputError, match=message):
        one(**changes)


def test_filters_are_texts_that_say_each_thickness():
    assert filter_thicknesses(filter_text({"Al": 2.5, "Cu": 0.1})) == {"Al": 2.5, "Cu": 0.1}
    assert filter_thicknesses("") == {}
    assert one(filters={"Al": 0.1 + 0.2}).filters.tolist() == ["Al 0.30000000000000004"]


def test_a_workbook_with_both_sheets_is_the_same_byte_for_byte_when_nothing_changed(both, arc, pinholes, tmp_path):
    assert mph.kinds_in(both) == ("pinhole", "x-ray")
    read = mph.read_scanner(both, "x-ray")
    assert_same(read, arc)
    np.testing.assert_array_equal(mph.read_system(both).centers, pinholes.centers)
    for system in (read, mph.read_system(both)):
        written = mph.write_system(system, tmp_path / "again.xlsx", both)
        assert written.changed == () and (tmp_path / "again.xlsx").read_bytes() == both.read_bytes()
    changed = read.replace(kvp=[*read.kvp[:5], 120.0], filters=["Cu 0.2", *read.filters[1:]])
    written = mph.write_system(changed, tmp_path / "changed.xlsx", both)
    assert written.changed == ("X-ray!S3", "X-ray!P8")
    assert_same(mph.read_scanner(written.path, "x-ray"), changed)
    alone = mph.write_system(arc, tmp_path / "alone.xlsx").path
    assert mph.kinds_in(alone) == ("x-ray",)
    assert_same(mph.read_scanner(alone, "x-ray"), arc)


@pytest.mark.parametrize(
    ("cell", "value", "message"),
    [
        ("P4", -80, "X-ray!P4 has kVp = -80, expected more than 0"),
        ("N5", 12.5, "X-ray!N5 is 12.5, expected nv of module 3, a whole number"),
        ("H4", 100, "X-ray!H4 to X-ray!M4: the steps u and v of module 2 must be at right angles"),
        (
            "S3",
            "Al",
            "X-ray!S3 holds the text 'Al', expected filter of module 1, materials with their mm, such as Al 2.5",
        ),
        ("B4", None, "X-ray!B4 is blank, expected xs of module 2"),
    ],
)
def test_cells_that_cannot_be_are_named(cell, value, message, both, tmp_path):
    path = tmp_path / "bad.xlsx"
    path.write_bytes(both.read_bytes())
    with edited(path) as book:
        book["X-ray"][cell] = value
    with pytest.raises(mph.InputError) as refusal:
        mph.read_scanner(path, "x-ray")
    assert message in str(refusal.value)


@pytest.mark.parametrize("system", [mph.xray_arc(), mph.xray_ring()], ids=["arc", "ring"])
def test_presets_have_24_sources_that_see_the_isocentre_in_the_middle(system):
    assert len(system) == 24
    seen = system.views().projection_matrices() @ [0, 0, 0, 1]
    np.testing.assert_allclose(seen[:, :2] / seen[:, 2:], 63.5, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(system.panel_centers, axis=1), 400)
    azimuths = np.degrees(np.arctan2(*system.sources.T[1::-1]))
    if np.ptp(system.sources[:, 0]) < 400:  # the arc
        assert azimuths.min() > 255.6 - 360 and azimuths.max() < 14.3


def test_arrangements_that_cannot_be_are_refused():
    for settings in ({"z": 400}, {"n": 0}, {"panel_size": -1}, {"start": 0.0, "end": 7.0}):
        with pytest.raises(mph.InputError), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            mph.xray_arc(**settings)


def disc(distance: float, half: float, module: int = 1) -> mph.PinholeSystem:
    """A pinhole module on +y above the source of `one`, so small that its collimator is a known obstacle."""
    return mph.PinholeSystem([[0.0, distance, 0.0]], 1.0, 20.0, 2 * half, 1.0, 10.0, numbers=[module])


def test_the_share_of_a_cone_that_a_module_blocks_is_that_of_its_shadow():
    """A box in the middle of a wide panel: its crystal's front, nearest to the source, throws the largest shadow."""
    system = mph.XraySystem([[0, 1000, 0]], [[0, -1000, 0]], [[-4, 0, 0]], [[0, 0, -4]], (100, 100), 80, 1)
    (found,) = mph.find_in_room(system, [disc(400.0, 30.0)])
    # The back of the crystal, 60 mm wide, is 579 mm from the source; the front of the walls, 64 mm wide, at 580.
    shadow = 64 * 2000 / 580
    assert math.sqrt(found.share) == pytest.approx(shadow / 400, abs=1 / RAYS)
    assert "source 1" in str(found) and "module 1's collimator" in str(found)
    assert not mph.find_in_room(system[[0]], [disc(400.0, 30.0).replace(centers=[[800.0, 0.0, 0.0]])])


def test_panels_in_modules_in_each_other_in_view_and_in_the_bore():
    system = one(sources=[[0, -300, 0]], panel_centers=[[0, 120, 0]], panel_u=[[2, 0, 0]], panel_v=[[0, 0, -2]])
    found = mph.find_in_room(system, [disc(150.0, 30.0)], bore=130.0)
    kinds = {type(one).__name__: one for one in found}
    assert set(kinds) == {"PanelInView", "InBore"}, "the module stands behind the panel"
    assert kinds["PanelInView"].share == 1 and kinds["InBore"].distance == pytest.approx(120)
    (overlap,) = (one for one in mph.find_in_room(system, [disc(125.0, 30.0)]) if type(one).__name__ == "PanelOverlap")
    assert overlap.depth > 5 and "module 1's collimator" in str(overlap)
    twice = mph.XraySystem(
        [[0, -300, 0], [50, -300, 0]], [[0, 120, 0]] * 2, [[2, 0, 0]] * 2, [[0, 0, -2]] * 2, (100, 100), 80, 1
    )
    assert mph.find_in_room(twice) == (), "two sources of one panel"
    apart = twice.replace(panel_centers=[[0, 120, 0], [30, 122, 0]])
    assert [one.modules for one in mph.find_in_room(apart)] == [(1,), (2,)]
    inside = twice.replace(sources=[[0, 0, 0], [0, 165, 0]], panel_centers=[[0, 120, 0], [0, 300, 0]])
    assert any(type(one).__name__ == "SwallowedSource" for one in mph.find_in_room(inside, [disc(150.0, 30.0)]))


def test_the_examples_modules_leave_most_of_the_presets_cones_free(pinholes):
    shares = {}
    for name, system in (("arc", mph.xray_arc(4)), ("ring", mph.xray_ring(4)), ("low", mph.xray_arc(4, z=0.0))):
        found = mph.find_in_room(system, [pinholes])
        shares[name] = sum(one.share for one in found if type(one).__name__ == "ShadowedCone") / 4
        assert not any("module" in body for one in found if type(one).__name__ == "PanelOverlap" for body in one.bodies)
    assert shares["ring"] < 0.05 < shares["arc"] < 0.3 < shares["low"]


def test_it_is_projected_recorded_and_read_again(both, arc, tmp_path):
    """A ray through a cube of mu, along z: the run has the panel's own pixels, the recipe and the file its kind."""
    grid = mph.Grid.centered((24, 24, 24), 8.0)
    volume = mph.Volume(np.full(grid.shape, 0.02, np.float32), grid, "mu")
    recipe = mph.Recipe(
        {"system.file": str(both), "system.kind": "x-ray", "system.modules": "2-4", "model.kind": "transmission"}
    )
    (run,) = mph.run_recipe(recipe, volume=volume)
    assert run.views.shape == arc.pixels == (128, 128) and run.recipe["detector.rows"] == 128
    expected = mph.Projector(grid, arc[1:4].views(), model=mph.Transmission(), backend="numpy")(volume)
    np.testing.assert_allclose(run.projections, expected, atol=1e-4 * expected.max())
    mph.write_run(run, tmp_path / "run.h5")
    again = mph.read_run(tmp_path / "run.h5")
    assert_same(again.system, arc[1:4])
    assert again.recipe["system.kind"] == "x-ray" and mph.mosaic(again.projections).ndim >= 2
    (small,) = mph.run_recipe(recipe.updated({"detector.rows": 8, "detector.columns": 16}), volume=volume)
    assert small.projections.shape == (3, 8, 16)
    with pytest.raises(mph.InputError, match="emission: expected a PinholeSystem"):
        list(mph.run_recipe(recipe.updated({"model.kind": "emission"}), volume=volume))


def test_exports_hold_it_or_say_that_they_cannot(arc, tmp_path):
    for name, format in FORMATS.items():
        path = tmp_path / f"{name}{format.suffixes[0] if format.suffixes else ''}"
        if name.startswith("gate"):
            with pytest.raises(mph.InputError, match="GATE"):
                mph.write_geometry(arc, path, name)
            continue
        mph.write_geometry(arc, path, name)
    with np.load(tmp_path / "astra.npz") as astra:
        np.testing.assert_array_equal(astra["vectors"][:, :3], arc.sources)
        np.testing.assert_array_equal(astra["vectors"][:, 6:9], arc.panel_u)
    system, views = mph.read_geometry(tmp_path / "mphdrr.json")
    assert_same(system, arc)
    assert np.array_equal(views.v_steps, arc.panel_v)


def test_the_command_line_makes_shows_edits_checks_and_exports_it(workbook, tmp_path, capsys):
    made, edited = str(tmp_path / "made.xlsx"), str(tmp_path / "edited.xlsx")
    ring = ["geometry", "generate", "xray-ring", "--sources", "3", "--kvp", "100", "--size", "64", "32"]
    assert main([*ring, "--filters", "Cu 0.2", "--into", str(workbook), "-o", made]) == 0
    system = mph.read_scanner(made, "x-ray")
    assert_same(system, mph.xray_ring(3, kvp=100, shape=(64, 32), filters="Cu 0.2"))
    kind = ["--scanner-kind", "x-ray"]
    change = ["--modules", "2", "--kvp", "120", "--move", "0", "0", "5"]
    assert main(["geometry", "set", made, *kind, *change, "-o", edited]) == 0
    assert "3 cells changed" in capsys.readouterr().out
    moved = mph.read_scanner(edited, "x-ray")
    assert moved.kvp.tolist() == [100, 120, 100] and moved.sources[1, 2] == system.sources[1, 2] + 5
    assert main(["geometry", "show", edited, *kind, "--modules", "2"]) == 0
    assert " 120 " in capsys.readouterr().out
    assert main(["geometry", "check", edited, *kind]) == 0
    assert "of its cone is blocked" in capsys.readouterr().out
    assert main(["geometry", "check", edited, *kind, "--bore", "260"]) == 0
    assert "inside the bore of 260 mm" in capsys.readouterr().out
    assert main(["geometry", "epipolar", edited, *kind, "--pixel", "1:16,32"]) == 0
    assert main(["geometry", "export", edited, *kind, "--format", "astra", "-o", str(tmp_path / "a.npz")]) == 0
    with np.load(tmp_path / "a.npz") as astra:
        assert int(astra["det_row_count"]) == 64
    capsys.readouterr()
    for command, said in (
        (["performance", made, *kind], "its scanner is of the kind x-ray, expected one with pinholes"),
        (["set", made, "--kvp", "90", "-o", edited], "--kvp: is no column of a pinhole scanner"),
        (["check", made, "--bore", "200"], "--bore is of X-ray systems"),
        (["set", made, *kind, "--length", "90", "-o", edited], "--length: only pinhole modules have a collimator"),
    ):
        assert main(["geometry", *command]) == 1
        assert said in capsys.readouterr().err


def test_an_azimuth_is_in_radians():
    assert mph.xray_arc(2, start=0.0, end=math.pi / 2, z=0.0).sources[1, 1] == pytest.approx(300)
