"""Laws of the Derenzo phantom and its voxels."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

import mphdrr.core as mph

from .test_phantoms import total

RODS = (8.0, 6.0, 5.0, 4.0, 3.0, 2.0)


def users_rods(radius: float, diameters: tuple[float, ...]) -> list[tuple[int, float, float, float]]:
    """Return sector, x, y and diameter of each rod by the users' rule, implemented independently.

    The first sector runs along -y. A margin of a tenth of the radius is dropped where fewer than two rows fit with it.
    """
    rods = []
    for sector, w in enumerate(diameters):
        case = radius * 0.1
        row_height = w * np.sqrt(3)
        rows = int(np.floor((radius - 2 * case - w) / row_height))
        if rows <= 1:
            case = 0.0
            rows = int(np.floor((radius - w) / row_height))
        turn = np.deg2rad(60 * sector)
        for row in range(1, rows + 1):
            for column in range(row):
                x, y = -w * (row - 1) + 2 * w * column, -(case + row_height * row)
                rods.append((sector, x * np.cos(turn) - y * np.sin(turn), x * np.sin(turn) + y * np.cos(turn), w))
    return rods


@pytest.mark.parametrize(("radius", "diameters"), [(50.0, (10, 8, 6, 4, 2, 1)), (40.0, RODS)])
def test_rods_are_those_of_the_users_rule(radius, diameters):
    rods = mph.DerenzoPhantom(radius, diameters, 30.0).rods()
    np.testing.assert_allclose(rods, users_rods(radius, diameters), atol=1e-9)


@pytest.mark.parametrize("sectors", [2, 3, 6, 7, 12])
def test_rods_of_any_number_of_sectors_do_not_touch(sectors):
    phantom = mph.DerenzoPhantom(40.0, tuple(np.linspace(5, 2, sectors)), 10.0, sectors=sectors)
    rods = phantom.rods()
    assert set(rods[:, 0]) == set(range(sectors))
    gaps = np.linalg.norm(rods[:, None, 1:3] - rods[None, :, 1:3], axis=2) - (rods[:, None, 3] + rods[None, :, 3]) / 2
    assert gaps[~np.eye(len(rods), dtype=bool)].min() > 0
    at = rods[:, 1:3] @ [1, 1j] * 1j
    assert np.array_equal(np.rint(np.angle(at) / (2 * np.pi) * sectors) % sectors, rods[:, 0])
    assert total(phantom.voxelize(mph.Grid.centered(24, 3.75))) == pytest.approx(phantom.total_activity, rel=1e-3)


def test_rods_in_water():
    phantom = mph.DerenzoPhantom(
        30, (6, 5, 4, 3.5, 3, 2.5), 24, 0, cylinder_radius=34, cylinder_height=30, background=7
    )
    rods = np.pi / 4 * np.sum(phantom.rods()[:, 3] ** 2) * 24
    assert phantom.total_activity == pytest.approx(7e-3 * (np.pi * 34**2 * 30 - rods), rel=1e-3)
    _, x, y, _ = phantom.rods()[0]
    assert phantom.values([[x, y, 0], [0, 0, 0], [x, y, 13]]).tolist() == [0, 7, 7]
    assert phantom.values([[x, y, 0]], quantity="mu") == pytest.approx(0.0154)
    assert [mesh.name for mesh in phantom.meshes()] == ["water", "rods"]


ALTERED = [
    (40.0, RODS, altered) for altered in (1, 2, 3, 8, 30, -1, -2, -6)
] + [
    (34.0, (11.5, 7.5, 6.5, 5.5, 9.5, 10.5), altered) for altered in (1, 2, 5, -1, -2, -3, -4, -6)
] + [
    (40.0, (5.0, 4.5, 4.0, 3.5, 3.0, 0.0, 2.5, 2.0), altered) for altered in (1, 8, 40, -1, -7, -8)
]  # fmt: skip


@pytest.mark.parametrize(("radius", "diameters", "altered"), ALTERED)
def test_one_altered_rod_is_so_in_all_that_the_phantom_gives(radius, diameters, altered, rng):
    make = partial(mph.DerenzoPhantom, radius, diameters, 20.0, activity=3.0, sectors=len(diameters))
    usual, phantom = make(), make(altered=altered)
    rods, site = phantom.rods(), phantom.altered_site()
    sector, x, y, w = site
    before = usual.rods()
    more, fewer = (rods, before) if altered < 0 else (before, rods)
    assert sorted(map(tuple, more)) == sorted([*map(tuple, fewer), tuple(site)])
    if altered > 0:
        np.testing.assert_array_equal(site, before[altered - 1])
    else:
        first = before[before[:, 0] == sector][0]
        rows = 2 if len(diameters) > 6 else 1  # row 1 of narrow sectors has no room for a rod
        assert sector == -altered - 1
        assert first[1:3] - site[1:3] == pytest.approx(first[1:3] / np.hypot(*first[1:3]) * np.sqrt(3) * w * rows)
        apart = np.hypot(before[:, 1] - x, before[:, 2] - y) - (before[:, 3] + w) / 2
        assert apart.min() > 0
    area = np.pi / 4 * w**2 * (1 if altered < 0 else -1)
    assert phantom.total_activity == pytest.approx(usual.total_activity + 3e-3 * area * 20, rel=1e-9)
    assert total(phantom.voxelize(mph.Grid.centered(24, 3.75))) == pytest.approx(phantom.total_activity, rel=1e-3)
    places = np.array([x, y, 0]) + rng.uniform(-3, 3, (4000, 3)) * w
    to_rods = np.hypot(places[:, None, 0] - rods[:, 1], places[:, None, 1] - rods[:, 2]) - rods[:, 3] / 2
    inside = (to_rods.min(axis=1) < 0) & (np.abs(places[:, 2]) < 10)
    np.testing.assert_array_equal(phantom.values(places), 3.0 * inside)
    ends = np.array([x, y, 0]) + np.array([[0.1, 0.2, -40.0], [0.1, 0.2, 40.0]])
    assert phantom.line_integrals(*ends) == pytest.approx(60.0 if altered < 0 else 0.0)
    (mesh,) = phantom.meshes()
    assert len(mesh.vertices) * len(before) == len(usual.meshes()[0].vertices) * len(rods)
    shape = phantom.shapes[0]
    true = np.maximum(to_rods.min(axis=1), np.abs(places[:, 2]) - 10)
    found = shape.distance(places.T)
    assert np.array_equal(found < 0, true < 0) and (np.abs(found) <= np.abs(true) + 1e-9)[true > 0].all()


def test_no_rod_is_altered_by_default_and_files_keep_one_that_is(tmp_path):
    assert mph.DerenzoPhantom().altered_site() is None
    for altered in (0, 4, -3):
        phantom = mph.DerenzoPhantom(altered=altered)
        mph.write_phantom(phantom, tmp_path / "rods.toml")
        assert ("altered" in (tmp_path / "rods.toml").read_text(encoding="utf-8")) == (altered != 0)
        (shape,) = mph.read_phantom(tmp_path / "rods.toml").shapes
        np.testing.assert_array_equal(shape.rods, phantom.rods())


def test_euler_angles_turn_psi_then_theta_then_phi():
    tilt = mph.euler_pose(theta=np.pi / 2)
    assert np.allclose(tilt @ [0, 0, 1, 1], [1, 0, 0, 1])  # the axis tilts towards +x
    assert np.allclose(mph.euler_pose(np.pi / 2, np.pi / 2, 0, (0, 0, 5)) @ [0, 0, 1, 1], [0, 1, 5, 1])
    assert np.allclose(mph.euler_pose(0, np.pi / 2, np.pi / 2) @ [1, 0, 0, 1], [0, 1, 0, 1])


def test_a_sector_whose_rods_do_not_fit_is_named():
    with pytest.warns(mph.InputWarning, match="no rod of 50, 90 mm fits into a radius of 40 mm"):
        mph.DerenzoPhantom(40.0, (50, 90, 5, 4, 3, 0), 30.0)


def test_phantom_outside_the_grid_leaves_it_empty():
    volume = mph.DerenzoPhantom(10.0, (*RODS[3:], 0, 0, 0), 5.0).voxelize(mph.Grid.centered(8, 1.0, center=(500, 0, 0)))
    assert not volume.array.any()


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"radius": 0}, "Derenzo radius: expected more than 0 mm"),
        ({"radius": np.nan}, "Derenzo radius"),
        ({"rod_diameters": (1, 2, 3)}, "Derenzo rod diameters: expected one for each of 6 sectors .0: empty., got 3"),
        ({"rod_diameters": (1, 2, 3, 4, 5, -6)}, "expected 0 or more"),
        ({"rod_diameters": (50,) * 6}, "no rod"),
        ({"altered": 1000}, "Derenzo altered: there is no rod 1000 to leave out of 73"),
        ({"altered": 1, "rod_diameters": (13, 0, 0, 0, 0, 0)}, "there is no rod 1 to leave out of 1"),
        ({"altered": -7}, "Derenzo altered: expected a sector with rods to add one to, got sector 7 of 6"),
        ({"altered": -6, "rod_diameters": (8, 6, 5, 4, 3, 0)}, "a sector with rods to add one to, got sector 6"),
        ({"altered": -1, "rod_diameters": (12, 1, 1, 1, 1, 1)}, "no room for one more rod of 12 mm in sector 1"),
        ({"altered": 1.5}, "Derenzo altered: expected a whole number, got 1.5"),
        ({"rod_diameters": (8, 6, 5, 4, 3, 1e-9)}, "more than 100000 rods"),
        ({"height": -1}, "Derenzo height"),
        ({"activity": "hot"}, "Derenzo activity"),
    ],
)
def test_derenzo_refuses_what_cannot_be(wrong, message):
    with pytest.raises(mph.InputError, match=message):
        mph.DerenzoPhantom(**{"radius": 40.0, "rod_diameters": RODS, "height": 30.0} | wrong)
