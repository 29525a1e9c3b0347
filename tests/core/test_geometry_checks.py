"""Laws of the checks: planted faults are found with their depth, and nothing else is."""

import json

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.cli import main
from mphdrr.core.geometry.checks.field_of_view import cone_directions, hits, unseen_share
from mphdrr.core.geometry.checks.hulls import Hulls
from mphdrr.core.geometry.checks.overlaps import penetration_depths
from mphdrr.core.geometry.collimator import Collimator, Construction
from mphdrr.core.geometry.module_parts import surface_fault

from .conftest import refused


def system_of(centers, d=2.0, length=60.0, side=50.0, thickness=10.0, radius=40.0, **more) -> mph.PinholeSystem:
    return mph.PinholeSystem(np.asarray(centers, dtype=float), d, length, side, thickness, radius, **more)


def crowd(rng, n: int = 30) -> mph.PinholeSystem:
    """Return modules of all sizes, so close together that many overlap."""
    direction = rng.normal(size=(n, 3)) * [0.2, 0.5, 0.3] + [1, 0, 0]
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    return system_of(
        direction * rng.uniform(120, 200, n)[:, None],
        rng.uniform(1, 5, n),
        rng.uniform(30, 90, n),
        rng.uniform(20, 60, n),
        rng.uniform(3, 15, n),
    )


def test_the_real_scanner_can_be_built_unless_its_walls_are_thick(scanner):
    """Independent: with walls of 8 mm, 188 pairs of collimators have a common volume by manifold3d, with 5 mm none."""
    report = mph.check_geometry(scanner)
    assert report.ok and report.messages() == [] and report.n_modules == 80
    assert mph.check_geometry(scanner, wall_thickness=5.0).ok
    report = mph.check_geometry(scanner, wall_thickness=8.0)
    assert len(report.overlaps) == len(report.findings) == 188
    assert {o.first_part for o in report.overlaps} == {o.second_part for o in report.overlaps} == {"collimator"}


@pytest.mark.parametrize("depth", [3e-6, 0.5, 1.75, 0.0, 5e-7, -1.0])
def test_a_front_in_the_crystal_behind_is_as_deep_as_planted_and_touching_is_no_overlap(rng, depth):
    """Two modules on one axis: the first ends at b + l + Td, the second's front, 1 mm before its pinhole, `depth` before."""
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    report = mph.check_geometry(system_of([200 * axis, (271 - depth) * axis], numbers=[7, 31]))
    if depth < 1e-6:
        assert report.overlaps == ()
        return
    (overlap,) = report.overlaps
    assert (overlap.first, overlap.first_part, overlap.second, overlap.second_part) == (7, "crystal", 31, "collimator")
    assert overlap.depth == pytest.approx(depth, abs=1e-9)
    assert np.allclose(overlap.point, (270 - depth / 2) * axis, atol=1e-6)
    assert not report.ok
    assert any("modules 7 and 31" in line and "crystal" in line for line in report.messages())
    assert report.messages(7) and report.messages(8) == []


@pytest.mark.parametrize("depth", [1e-5, 0.3])
def test_side_walls_in_each_other_are_as_deep_as_planted(depth):
    """Two collimators mirrored in a plane parallel to their side walls, each depth/2 beyond it."""
    d, length, side, wall = 2.0, 60.0, 50.0, 2.0
    front = Collimator(d, length, side, Construction(2.0, wall)).front_half_width
    angle = np.arctan((side / 2 + wall - front) / (length + 1))  # from the plate's front, 1 mm before the pinhole
    half_front = front + np.tan(angle)
    b = (half_front * np.cos(angle) - depth / 2) / np.sin(angle)
    centers = b * np.array([[np.cos(angle), s * np.sin(angle), 0] for s in (1, -1)])
    (overlap,) = mph.check_geometry(system_of(centers, d, length, side, radius=5.0), wall_thickness=wall).overlaps
    assert (overlap.first_part, overlap.second_part) == ("collimator", "collimator")
    assert overlap.depth == pytest.approx(depth, abs=1e-9)
    assert abs(overlap.point[1]) < depth / 2


def test_depth_is_the_distance_to_the_minkowski_difference(rng):
    """The shortest translation that separates two bodies, by the convex hull of all differences of their corners."""
    spatial = pytest.importorskip("scipy.spatial")
    system = crowd(rng)
    parts = system.parts()
    hulls = Hulls.from_parts(parts)
    for p, part in enumerate(parts):
        assert spatial.ConvexHull(part.vertices).volume == pytest.approx(spatial.ConvexHull(hulls.vertices[p]).volume)
    i, j = np.triu_indices(len(parts), 1)
    depths = penetration_depths(hulls, i, j)
    differences = (hulls.vertices[i][:, :, None] - hulls.vertices[j][:, None]).reshape(len(i), -1, 3)
    expected = np.array([-spatial.ConvexHull(points).equations[:, 3].max() for points in differences])
    inside, different = expected > 0, hulls.numbers[i] != hulls.numbers[j]
    assert np.count_nonzero(inside & different) > 20
    assert np.allclose(depths[inside], expected[inside], atol=1e-6)
    assert np.all(depths[~inside] <= 1e-9)

    index = {(part.number, part.kind): p for p, part in enumerate(parts)}
    pairs = set()
    for o in mph.check_geometry(system).overlaps:
        pairs.add(pair := (index[o.first, o.first_part], index[o.second, o.second_part]))
        for p in pair:
            assert np.all(hulls.normals[p] @ o.point < hulls.offsets[p])
    overlapping = inside & (depths > 1e-6) & different
    assert pairs == set(zip(i[overlapping], j[overlapping], strict=True))


def test_field_of_view_beside_the_roi(rng):
    centers = [[200.0, 10, 5], [0, -180, 30], [1, 2, 250]]
    b, short = np.linalg.norm(centers, axis=1), np.array([0.0, 0.5, 60.0])
    length = mph.collimator_length(b, 2.0, 50.0, 75.0 - short)
    report = mph.check_geometry(system_of(centers, length=length, radius=75.0))
    assert [u.module for u in report.uncovered] == [2, 3]
    assert np.allclose([u.shortage for u in report.uncovered], short[1:], atol=1e-9)
    # Four caps of height 0.5 that do not meet; then a field of view that is a small part of the sphere.
    cap, sphere = np.pi * 0.5**2 * (3 * 75 - 0.5) / 3, 4 / 3 * np.pi * 75**3
    assert report.uncovered[0].unseen_share == pytest.approx(4 * cap / sphere, rel=1e-9)
    points = rng.uniform(-75, 75, (400_000, 3))
    points = points[np.linalg.norm(points, axis=1) < 75]
    slope = (50 - 2) / (2 * length[2])
    outside = np.abs(points[:, :2]).max(axis=1) > (b[2] + points[:, 2]) * slope - 1.0
    assert report.uncovered[1].unseen_share == pytest.approx(outside.mean(), abs=4e-3)
    # A pyramid whose apex is beyond the ROI sees nothing.
    assert unseen_share([0.0, 0.0, 100.0], d=20.0, slope=0.05, radius=50.0) == pytest.approx(1.0, rel=1e-9)


def test_a_module_in_front_blocks_the_rays_that_meet_it_and_one_behind_the_roi_none():
    """On one axis: the silhouette is a square, of the solid angle 4 asin(q^2 / (1 + q^2))."""
    near = system_of([[100.0, 0, 0], [200, 0, 0]], length=30.0, side=12.0, radius=60.0)
    q = max(6 / 60, 8 / 70)  # the crystal's back, the collimator's outer end
    cone = 2 * np.pi * (1 - np.sqrt(1 - 0.3**2))
    (blocked,) = mph.check_geometry(near).blocked
    assert (blocked.module, blocked.by) == (2, 1)
    assert blocked.share == pytest.approx(4 * np.arcsin(q**2 / (1 + q**2)) / cone, rel=0.02)
    opposite = system_of([[200.0, 0, 0], [-100, 0, 0], [0, 200, 0]], length=mph.collimator_length(200, 2, 50, 75))
    assert mph.check_geometry(opposite).blocked == ()


def test_a_sliver_of_a_thousandth_is_found(rng):
    """Small modules that just reach over the silhouette of the ROI, anywhere around it."""
    exact_shares = []
    for angle, beyond in zip(rng.uniform(0, 2 * np.pi, 12), rng.uniform(-1.5, 1.0, 12), strict=True):
        # The cone's half-angle is 30 degrees; at the depth of 60 mm its radius is 34.64 mm.
        offset = (34.64 + beyond) * np.array([np.cos(angle), np.sin(angle)])
        system = system_of([[200.0, 0, 0], [140, *offset]], 0.5, 5.0, [50.0, 2.0], 1.0, 100.0)
        hulls = Hulls.from_parts(system.parts(Construction(0.5, 1.0)))
        directions = cone_directions(200_000, np.sqrt(0.75)) @ system.frames()[0]
        fine = np.zeros(200_000, dtype=bool)
        for p in (2, 3):
            fine |= hits(hulls, p, system.centers[0], directions, np.full(200_000, 100.0))
        report = mph.check_geometry(system, plate_thickness=0.5, wall_thickness=1.0)
        shares = {blocked.module: blocked.share for blocked in report.blocked}
        assert shares.get(1, 0.0) == pytest.approx(fine.mean(), abs=5e-4)
        exact_shares.append(fine.mean())
    assert sum(2e-4 < share < 1.5e-3 for share in exact_shares) > 3  # the slivers were this small


def test_rays_meet_hulls_where_points_along_them_are_inside(rng):
    hulls = Hulls.from_parts(crowd(rng, 4).parts())
    origin = np.array([10.0, -20.0, 5.0])
    directions = cone_directions(1000, -1.0)
    lengths = rng.uniform(100, 250, 1000)
    points = origin + np.linspace(0, 1, 800)[:, None, None] * lengths[:, None] * directions
    for p in range(len(hulls)):
        depth = (hulls.offsets[p] - points @ hulls.normals[p].T).min(axis=2).max(axis=0)
        hit = hits(hulls, p, origin, directions, lengths)
        assert np.all(hit[depth > 0])
        assert not np.any(hit[depth < -0.5])  # the points are less than 0.4 mm apart


def test_pinholes_at_impossible_places():
    axis = np.array([0.6, 0.0, 0.8])
    inside = mph.check_geometry(system_of([200 * axis, 265 * axis]))
    (swallowed,) = inside.swallowed_pinholes
    assert (swallowed.module, swallowed.by, swallowed.part) == (2, 1, "crystal")
    assert swallowed.depth == pytest.approx(5.0)
    assert [(b.module, b.by, b.share) for b in inside.blocked] == [(2, 1, 1.0)]

    (near,) = mph.check_geometry(system_of([200 * axis, 200 * axis + [0, 1.5, 0]])).near_pairs
    assert (near.first, near.second, near.distance) == (1, 2, pytest.approx(1.5))

    # Of the plate's front.
    (intrusion,) = mph.check_geometry(system_of([[100.0, 0, 0], [0, 300, 0]], radius=[90.0, 120.0])).intrusions
    assert (intrusion.module, intrusion.roi_radius, intrusion.depth) == (1, 120.0, pytest.approx(21.0))


def test_open_and_inverted_surfaces_are_found(system):
    for part in system.parts()[:4]:
        vertices, faces = part.solid
        assert surface_fault(part.solid) is None
        assert surface_fault((vertices, faces[1:])).startswith("is not closed")
        assert surface_fault((vertices, faces[:, ::-1])).startswith("has a volume of -")


def test_report_is_json(rng):
    report = mph.check_geometry(crowd(rng))
    answer = json.loads(json.dumps(report.as_dict()))
    assert answer["ok"] is False and answer["n_modules"] == 30
    assert len(answer["overlaps"]) == len(report.overlaps) > 0
    assert len(report.messages()) == len(report.findings)


def test_impossible_walls_are_refused(system):
    for wall, thickness, word in (("plate", 0, "plate"), ("wall", np.nan, "wall"), ("plate", 70, "module 1")):
        walls = {f"{wall}_thickness": thickness}
        refused(lambda walls=walls: mph.check_geometry(system, **walls), word)


def test_command_prints_findings_and_is_strict_on_demand(workbook, capsys):
    assert main(["geometry", "check", str(workbook), "--strict"]) == 0
    capsys.readouterr()
    assert main(["geometry", "check", str(workbook), "--wall", "8"]) == 0
    printed = capsys.readouterr().out
    assert "modules 1 and 2: collimator and collimator overlap" in printed and "188 findings" in printed
    assert main(["geometry", "check", str(workbook), "--wall", "8", "--json", "--strict"]) == 1
    out, err = capsys.readouterr()
    assert len(json.loads(out)["geometry"]["overlaps"]) == len(json.loads(out)["findings"]) == 188
    assert len(err.splitlines()) == 1 and "188 findings" in err
