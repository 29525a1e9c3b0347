"""Laws of the Derenzo phantom and its voxels."""

from __future__ import annotations

import warnings
from functools import partial

import numpy as np
import pytest
from scipy.ndimage import center_of_mass, label

import mphdrr.core as mph

AS_SHIPPED = True  # voxels of all samples

RODS = (8.0, 6.0, 5.0, 4.0, 3.0, 2.0)


def total(volume: mph.Volume) -> float:
    """kBq."""
    return float(volume.array.sum(dtype=np.float64) * volume.grid.voxel_volume * 1e-3)


def test_rods_follow_the_users_rule():
    phantom = mph.DerenzoPhantom(50.0, (10, 8, 6, 4, 2, 1), 30.0)
    rods = phantom.rods()
    for sector, (w, rows) in enumerate([(10, 2), (8, 2), (6, 3), (4, 5), (2, 10), (1, 22)]):
        mine = rods[rods[:, 0] == sector]
        # Only one 10 mm row fits with the margins, so this sector has none.
        assert len(mine) == rows * (rows + 1) // 2, f"sector of {w} mm rods"
    # Sector 0 runs along -y, its first row at sqrt(3) w (margin dropped) and its second two rods 2 w apart.
    first = rods[rods[:, 0] == 0]
    assert np.allclose(first[0, 1:3], [0, -np.sqrt(3) * 10])
    assert np.allclose(sorted(first[1:, 1]), [-10, 10])
    assert np.allclose(first[1:, 2], -2 * np.sqrt(3) * 10)
    # Sector 2, rotated by 120 degrees counter-clockwise from -y, keeps its margin.
    direction = np.deg2rad(-90 + 120)
    assert np.allclose(
        rods[rods[:, 0] == 2][0, 1:3], (5 + np.sqrt(3) * 6) * np.array([np.cos(direction), np.sin(direction)])
    )


def users_rods(radius: float, diameters: tuple[float, ...]) -> list[tuple[int, float, float, float]]:
    """The users' rule, implemented independently: sector, x, y and diameter of each rod."""
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


def test_rods_on_a_slice_are_the_users_sector_by_sector():
    """Number and area of the rods, on 640 x 640 pixels across the radius of 40 mm."""
    radius, n = 40.0, 640
    axis = (np.arange(n) - (n - 1) / 2) * 2 * radius / n
    grid = mph.Grid.centered((n, n, 1), (2 * radius / n, 2 * radius / n, 1.0))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", mph.InputWarning)  # the slice contains a part of the height
        slice_ = mph.DerenzoPhantom(radius, RODS, 30.0).voxelize(grid).array[:, :, 0]
    theirs = users_rods(radius, RODS)
    x, y = np.meshgrid(axis, axis, indexing="ij")
    sector = np.floor((np.rad2deg(np.arctan2(y, x)) + 90 + 30) / 60).astype(int) % 6
    for k, w in enumerate(RODS):
        rods = [rod for rod in theirs if rod[0] == k]
        labels, count = label(np.where(sector == k, slice_, 0) > 0.5)
        assert count == len(rods), f"rods of {w} mm"
        painted = np.zeros((n, n), bool)
        for _, rod_x, rod_y, _ in rods:
            painted |= (x - rod_x) ** 2 + (y - rod_y) ** 2 <= (w / 2) ** 2
        assert slice_[sector == k].sum() == pytest.approx(painted.sum(), rel=0.01)
        middles = np.array(center_of_mass(labels > 0, labels, range(1, count + 1)))
        found = (middles - (n - 1) / 2) * 2 * radius / n
        for _, rod_x, rod_y, _ in rods:
            assert np.min(np.hypot(found[:, 0] - rod_x, found[:, 1] - rod_y)) < 0.02


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


def test_voxels_hold_the_share_of_their_rods(rng):
    """Against brute force: many random points of each voxel, tested rod by rod."""
    phantom = mph.DerenzoPhantom(25.0, (6, 5, 4, 3, 2, 0), 10.0, activity=3.0)
    pose = mph.euler_pose(0.4, 0.7, -1.1, (1, 2, -3))
    grid = mph.Grid.centered((24, 22, 20), (1.7, 2.0, 1.5), center=(4, 1, 0))
    values = phantom.voxelize(grid, pose).array
    index = np.stack(np.unravel_index(rng.choice(values.size, 1500, replace=False), values.shape), axis=1)
    points = index[:, None] + rng.uniform(-0.5, 0.5, (1500, 400, 3))
    to_phantom = np.linalg.inv(pose) @ grid.affine
    local = points @ to_phantom[:3, :3].T + to_phantom[:3, 3]
    inside = np.zeros(local.shape[:2], bool)
    for _, x, y, w in phantom.rods():
        inside |= np.hypot(local[..., 0] - x, local[..., 1] - y) < w / 2
    inside &= np.abs(local[..., 2]) < phantom.height / 2
    difference = values[tuple(index.T)] / 3.0 - inside.mean(axis=1)
    assert np.abs(difference).max() < 0.15  # the brute force's own noise is 0.025
    assert abs(difference.mean()) < 2e-3


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
        (
            {"altered": -6, "rod_diameters": (8, 6, 5, 4, 3, 0)},
            "expected a sector with rods to add one to, got sector 6",
        ),
        (
            {"altered": -1, "rod_diameters": (12, 1, 1, 1, 1, 1)},
            "there is no room for one more rod of 12 mm in sector 1",
        ),
        ({"altered": 1.5}, "Derenzo altered: expected a whole number, got 1.5"),
        ({"rod_diameters": (8, 6, 5, 4, 3, 1e-9)}, "more than 100000 rods"),
        ({"height": -1}, "Derenzo height"),
        ({"activity": "hot"}, "Derenzo activity"),
    ],
)
def test_derenzo_refuses_what_cannot_be(wrong, message):
    with pytest.raises(mph.InputError, match=message):
        mph.DerenzoPhantom(**{"radius": 40.0, "rod_diameters": RODS, "height": 30.0} | wrong)


def test_a_grid_that_cannot_fit_into_memory_is_refused_in_one_line():
    phantom = mph.DerenzoPhantom(40.0, RODS, 30.0)
    with pytest.raises(
        mph.InputError, match=r"a volume of 100000 x 100000 x 100000 voxels needs .* GiB of memory"
    ) as error:
        phantom.voxelize(mph.Grid.centered(100_000, 0.001))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("shape", [(1, 1, 1), (5, 5, 5), (3, 40, 2)])
def test_coarse_voxels_hold_the_whole_activity(shape):
    phantom = mph.DerenzoPhantom(30.0, (4, 3.5, 3, 2.5, 2, 1.5), 20.0)
    volume = phantom.voxelize(mph.Grid.centered(shape, 120.0 / np.array(shape)))
    assert total(volume) == pytest.approx(phantom.total_activity, rel=1e-3)


def test_phantoms_are_voxelized_on_grids_only():
    with pytest.raises(mph.InputError, match="voxelize: expected a Grid, got tuple"):
        mph.DerenzoPhantom(40.0, RODS, 30.0).voxelize((8, 8, 8))
