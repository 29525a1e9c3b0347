"""X-ray systems: geometry, workbook, arrangements, checks, and what follows from the table of kinds of scanners."""

import math
import warnings

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.cli import main
from mphdrr.core.exchange import FORMATS
from mphdrr.core.xray.checks import RAYS
from mphdrr.core.xray.system import filter_text, filter_thicknesses

from .conftest import refused, refused_command
from .workbooks import edited

pytestmark = pytest.mark.filterwarnings("error")


def one(**changes) -> mph.XraySystem:
    """Return a source below the isocentre, and above it a panel of 200 x 300 mm, neither square nor in the middle."""
    settings = {
        "sources": [[5.0, -300.0, 2.0]], "panel_centers": [[20.0, 200.0, -30.0]], "panel_u": [[2.0, 0.0, 0.0]],
        "panel_v": [[0.0, 0.0, -3.0]], "shape": (100, 100), "kvp": 80, "mas": 0.5, "filters": {"Al": 2.5},
    }  # fmt: skip
    return mph.XraySystem(**{**settings, **changes})


@pytest.fixture(scope="module")
def arc():
    return mph.xray_arc(6, filters=[{"Al": 2.5}, "", *["Cu 0.1 + Al 1"] * 4], mas=[1, 2, 3, 4, 5, 6])


@pytest.fixture(scope="module")
def both(workbook, arc, tmp_path_factory):
    return mph.write_system(arc, tmp_path_factory.mktemp("xray") / "both.xlsx", workbook).path


def assert_same(system, expected) -> None:
    assert type(system) is type(expected) and system.numbers.tolist() == expected.numbers.tolist()
    for name, values in system.values().items():
        np.testing.assert_array_equal(values, expected.values()[name], err_msg=name)


def test_views_are_the_panels_own_pixels_or_all_of_the_panel_in_others():
    system = one()
    views = system.views()
    assert views.shape == system.pixels == (100, 100)
    np.testing.assert_array_equal(views.u_steps, system.panel_u)
    np.testing.assert_allclose(views.rays(0)[1][0], [20 - 99, 200, -30 + 1.5 * 99])
    coarse = system.views((25, 50))
    for name, n in (("u_steps", 2), ("v_steps", 4)):
        np.testing.assert_allclose(getattr(coarse, name), n * getattr(views, name))
    np.testing.assert_allclose(np.linalg.norm(system.views(pitch=(1, 0.5)).v_steps, axis=1), 0.5)
    np.testing.assert_allclose(system.views(offset=(4, 6)).detector_centers[0], [24, 200, -36])
    words = "detector 'real': a panel stands in front of its source, expected 'virtual'"
    refused(lambda: system.views(detector="real"), words)


def test_sources_and_panels_move_as_rigid_bodies(arc):
    motion = mph.euler_pose(0.3, -0.4, 1.1, (5, -6, 7))
    moved = arc.at_poses(motion @ arc.poses())
    for name in ("sources", "panel_centers"):
        expected = getattr(arc, name) @ motion[:3, :3].T + motion[:3, 3]
        np.testing.assert_allclose(getattr(moved, name), expected, atol=1e-9)
    np.testing.assert_allclose(moved.panel_v, arc.panel_v @ motion[:3, :3].T, atol=1e-12)
    np.testing.assert_allclose(moved.poses(), motion @ arc.poses(), atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(arc.frames()), 1)
    np.testing.assert_allclose(moved.fields(), arc.fields(), atol=1e-9)
    shift = np.eye(4)
    shift[2, 3] = 5.0
    assert np.array_equal(arc.at_poses(shift @ arc.poses()).panel_u, arc.panel_u)


REFUSALS = [
    (lambda: one(panel_v=[[0, 0, 3.0]]), "module 1: panel_u, panel_v and the way from source to panel must be right-"),
    (lambda: one(panel_v=[[1.0, 0.0, -3.0]]), "module 1: panel_u and panel_v must be at right angles"),
    (lambda: one(panel_centers=[[20.0, -300.0, -30.0]]), "right-handed"),
    (lambda: one(panel_u=[[0.0, 0.0, 0.0]]), "right-handed"),
    (lambda: one(shape=(100, 0)), "shape"),
    (lambda: one(shape=None), "shape"),
    (lambda: one(kvp=0), "kvp must be more than 0"),
    (lambda: one(focal_spot=-1), "focal_spot must be 0 mm or more, got -1"),
    (lambda: one(filters="2.5 mm"), "filters '2.5 mm': expected materials with their mm, such as Al 2.5"),
    (lambda: one(filters={"Al": -1}), "filter Al: expected"),
    (lambda: one(filters=3), "filters: expected material and mm"),
    (lambda: mph.xray_arc(z=400), "z: expected less than"),
    (lambda: mph.xray_arc(n=0), "number of sources: expected"),
    (lambda: mph.xray_arc(panel_size=-1), "panel_size: expected more"),
    (lambda: mph.xray_arc(start=0.0, end=7.0), "at most a full turn apart"),
]


@pytest.mark.parametrize("refusal", REFUSALS)
def test_what_is_no_system_is_refused(refusal):
    with warnings.catch_warnings(action="ignore"):
        refused(*refusal)


def test_filters_are_texts_that_say_each_thickness():
    assert filter_thicknesses(filter_text({"Al": 2.5, "Cu": 0.1})) == {"Al": 2.5, "Cu": 0.1}
    assert filter_thicknesses("") == {}
    assert one(filters={"Al": 0.1 + 0.2}).filters.tolist() == ["Al 0.30000000000000004"]


def test_a_workbook_with_both_sheets_is_the_same_byte_for_byte_when_nothing_changed(both, arc, scanner, tmp_path):
    assert mph.kinds_in(both) == ("pinhole", "x-ray")
    read = mph.read_scanner(both, "x-ray")
    assert_same(read, arc)
    np.testing.assert_array_equal(mph.read_system(both).centers, scanner.centers)
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
        ("S3", "Al", "X-ray!S3 holds the text 'Al', expected filter of module 1, materials with their mm, such as"),
        ("B4", None, "X-ray!B4 is blank, expected xs of module 2"),
    ],
)
def test_cells_that_cannot_be_are_named(cell, value, message, both, tmp_path):
    path = tmp_path / "bad.xlsx"
    path.write_bytes(both.read_bytes())
    with edited(path) as book:
        book["X-ray"][cell] = value
    refused(lambda: mph.read_scanner(path, "x-ray"), message)


@pytest.mark.parametrize("system", [mph.xray_arc(), mph.xray_ring()], ids=["arc", "ring"])
def test_presets_have_24_sources_that_see_the_isocentre_in_the_middle(system):
    assert len(system) == 24
    isocentres = system.views().projection_matrices() @ [0, 0, 0, 1]
    np.testing.assert_allclose(isocentres[:, :2] / isocentres[:, 2:], 63.5, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(system.panel_centers, axis=1), 400)
    azimuths = np.degrees(np.arctan2(*system.sources.T[1::-1]))
    if np.ptp(system.sources[:, 0]) < 400:  # the arc
        assert azimuths.min() > 255.6 - 360 and azimuths.max() < 14.3
        quarter = mph.xray_arc(2, start=0.0, end=math.pi / 2, z=0.0)  # azimuths are in radians
        assert quarter.sources[1, 1] == pytest.approx(300)


def disc(distance: float, half: float, module: int = 1) -> mph.PinholeSystem:
    """Return a pinhole module on +y above the source of `one`, so small that its collimator is a known obstacle."""
    return mph.PinholeSystem([[0.0, distance, 0.0]], 1.0, 20.0, 2 * half, 1.0, 10.0, numbers=[module])


def test_the_share_of_a_cone_that_a_module_blocks_is_that_of_its_shadow():
    """A box in the middle of a wide panel: its crystal's front, nearest to the source, throws the largest shadow."""
    system = mph.XraySystem([[0, 1000, 0]], [[0, -1000, 0]], [[-4, 0, 0]], [[0, 0, -4]], (100, 100), 80, 1)
    (finding,) = mph.find_in_room(system, [disc(400.0, 30.0)])
    # The back of the crystal, 60 mm wide, is 579 mm from the source; the front of the walls, 64 mm wide, at 580.
    shadow = 64 * 2000 / 580
    assert math.sqrt(finding.share) == pytest.approx(shadow / 400, abs=1 / RAYS)
    assert "source 1" in str(finding) and "module 1's collimator" in str(finding)
    assert not mph.find_in_room(system[[0]], [disc(400.0, 30.0).replace(centers=[[800.0, 0.0, 0.0]])])


def findings(system, kind=None, **options) -> list:
    """Return the findings of an X-ray system in a room, all or those of a kind."""
    modules = [disc(options.pop("distance"), 30.0)] if "distance" in options else []
    return [x for x in mph.find_in_room(system, modules, **options) if kind in (None, type(x).__name__)]


def test_panels_in_modules_in_each_other_in_view_and_in_the_bore():
    system = one(sources=[[0, -300, 0]], panel_centers=[[0, 120, 0]], panel_u=[[2, 0, 0]], panel_v=[[0, 0, -2]])
    kinds = {type(finding).__name__: finding for finding in findings(system, distance=150.0, bore=130.0)}
    assert set(kinds) == {"PanelInView", "InBore"}, "the module stands behind the panel"
    assert kinds["PanelInView"].share == 1 and kinds["InBore"].distance == pytest.approx(120)
    (overlap,) = findings(system, "PanelOverlap", distance=125.0)
    assert overlap.depth > 5 and "module 1's collimator" in str(overlap)
    twice = mph.XraySystem(
        [[0, -300, 0], [50, -300, 0]], [[0, 120, 0]] * 2, [[2, 0, 0]] * 2, [[0, 0, -2]] * 2, (100, 100), 80, 1
    )
    assert not findings(twice), "two sources of one panel"
    apart = twice.replace(panel_centers=[[0, 120, 0], [30, 122, 0]])
    assert [finding.modules for finding in findings(apart)] == [(1,), (2,)]
    inside = twice.replace(sources=[[0, 0, 0], [0, 165, 0]], panel_centers=[[0, 120, 0], [0, 300, 0]])
    assert findings(inside, "SwallowedSource", distance=150.0)


def test_the_examples_modules_leave_most_of_the_presets_cones_free(scanner):
    shares = []
    for system in (mph.xray_ring(4), mph.xray_arc(4), mph.xray_arc(4, z=0.0)):
        in_room = mph.find_in_room(system, [scanner])
        shares.append(sum(x.share for x in in_room if type(x).__name__ == "ShadowedCone") / 4)
        overlaps = [x for x in in_room if type(x).__name__ == "PanelOverlap"]
        assert not any("module" in body for overlap in overlaps for body in overlap.bodies)
    ring, arc, low = shares
    assert ring < 0.05 < arc < 0.3 < low


def test_it_is_projected_recorded_and_read_again(both, arc, tmp_path):
    """A ray through a cube of mu, along z: the run has the panel's own pixels, the recipe and the file its kind."""
    grid = mph.Grid.centered((24, 24, 24), 8.0)
    volume = mph.Volume(np.full(grid.shape, 0.02, np.float32), grid, "mu")
    settings = {"file": str(both), "kind": "x-ray", "modules": "2-4"}
    recipe = mph.Recipe({"model.kind": "transmission", **{f"system.{key}": value for key, value in settings.items()}})
    (run,) = mph.run_recipe(recipe, volume=volume)
    assert run.views.shape == arc.pixels == (128, 128) and run.recipe["detector.rows"] == 128
    expected = mph.Projector(grid, arc[1:4].views(), model=mph.Transmission(), backend="numpy")(volume)
    np.testing.assert_allclose(run.projections, expected, atol=1e-4 * expected.max())
    for name in ("run.h5", "run.npz"):
        mph.write_run(run, tmp_path / name)
        again = mph.read_run(tmp_path / name)
        assert_same(again.system, arc[1:4])
        assert again.recipe["system.kind"] == "x-ray" and mph.mosaic(again.projections).ndim >= 2
    (small,) = mph.run_recipe(recipe.updated({"detector.rows": 8, "detector.columns": 16}), volume=volume)
    assert small.projections.shape == (3, 8, 16)
    emission = recipe.updated({"model.kind": "emission"})
    refused(lambda: next(mph.run_recipe(emission, volume=volume)), "emission: expected a PinholeSystem, got XraySystem")
    (pinholes,) = mph.run_recipe(recipe.updated({"system.kind": "pinhole"}), volume=volume)
    assert mph.Recipe({})["system.kind"] == "pinhole" and type(pinholes.system) is mph.PinholeSystem
    unknown = recipe.updated({"system.kind": "sextant"})
    words = "kind of scanner 'sextant': expected one of pinhole, x-ray"
    refused(lambda: next(mph.run_recipe(unknown, volume=volume)), words)


def test_exports_hold_it_or_say_that_they_cannot(arc, tmp_path):
    for name, format in FORMATS.items():
        path = tmp_path / f"{name}{format.suffixes[0] if format.suffixes else ''}"
        if name.startswith("gate"):
            refused(lambda path=path, name=name: mph.write_geometry(arc, path, name), "GATE")
        else:
            mph.write_geometry(arc, path, name)
    with np.load(tmp_path / "astra.npz") as astra:
        np.testing.assert_array_equal(astra["vectors"][:, :3], arc.sources)
        np.testing.assert_array_equal(astra["vectors"][:, 6:9], arc.panel_u)
    system, views = mph.read_geometry(tmp_path / "mphdrr.json")
    assert_same(system, arc)
    assert np.array_equal(views.v_steps, arc.panel_v)


def test_the_command_line_makes_shows_edits_checks_and_exports_it(workbook, tmp_path, capsys):
    made, edited, kind = str(tmp_path / "made.xlsx"), str(tmp_path / "edited.xlsx"), ["--scanner-kind", "x-ray"]

    def geometry(*words: str) -> str:
        assert main(["geometry", *words]) == 0
        return capsys.readouterr().out

    ring = ["xray-ring", "--sources", "3", "--kvp", "100", "--size", "64", "32", "--filters", "Cu 0.2"]
    geometry("generate", *ring, "--into", str(workbook), "-o", made)
    system = mph.read_scanner(made, "x-ray")
    assert_same(system, mph.xray_ring(3, kvp=100, shape=(64, 32), filters="Cu 0.2"))
    change = ["--modules", "2", "--kvp", "120", "--move", "0", "0", "5"]
    assert "3 cells changed" in geometry("set", made, *kind, *change, "-o", edited)
    moved = mph.read_scanner(edited, "x-ray")
    assert moved.kvp.tolist() == [100, 120, 100] and moved.sources[1, 2] == system.sources[1, 2] + 5
    assert " 120 " in geometry("show", edited, *kind, "--modules", "2")
    assert "of its cone is blocked" in geometry("check", edited, *kind)
    assert "inside the bore of 260 mm" in geometry("check", edited, *kind, "--bore", "260")
    geometry("epipolar", edited, *kind, "--pixel", "1:16,32")
    geometry("export", edited, *kind, "--format", "astra", "-o", str(tmp_path / "a.npz"))
    with np.load(tmp_path / "a.npz") as astra:
        assert int(astra["det_row_count"]) == 64
    for words, said in (
        (["performance", made, *kind], "its scanner is of the kind x-ray, expected one with pinholes"),
        (["set", made, "--kvp", "90", "-o", edited], "--kvp: is no column of a pinhole scanner"),
        (["check", made, "--bore", "200"], "--bore is of X-ray systems"),
        (["set", made, *kind, "--length", "90", "-o", edited], "--length: only pinhole modules have a collimator"),
    ):
        assert said in refused_command(capsys, "geometry", *words)
