"""OpenVDB files: ours bit for bit, other programs' by OpenVDB's conventions, bad ones refused in one line."""

from __future__ import annotations

import warnings

import bpy
import numpy as np
import pytest

from mphdrr.addon.blender import compat
from mphdrr.addon.volumes import volumes
from mphdrr.addon.volumes.vdb import openvdb, read_vdb, write_vdb
from mphdrr.core.errors import InputError
from mphdrr.core.geometry.frames import euler_pose
from mphdrr.core.geometry.grid import Grid
from mphdrr.core.volumes.volume import Volume
from mphdrr.core.volumes.volume_files import read_volume

from .conftest import centroid, refused, update

vdb = openvdb()

SHEAR = np.array([[1.0, 0.3, 0.1, 0.0], [0.0, 1.0, -0.2, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
LINEAR = euler_pose(0.4, 0.7, -0.3, (5.0, 1 / 3, 7.0)) @ SHEAR @ np.diag([2.0, 1.5, 0.1, 1.0])


def _write_together(volumes, path, provenance):
    grids = []
    for volume in volumes:
        write_vdb(volume, path, provenance)
        grids.append(vdb.read(str(path), volume.quantity))
    vdb.write(str(path), grids=grids)


def test_several_volumes_share_a_file(tmp_path):
    rng = np.random.default_rng(0)
    activity = Volume(rng.random((4, 5, 6), np.float32), Grid((4, 5, 6), LINEAR), "activity")
    mu = Volume(rng.random((7, 3, 2), np.float32), Grid.centered((7, 3, 2), 2.5), "mu")
    _write_together([activity, mu], tmp_path / "both.vdb", {"made by": "test"})
    for volume in (activity, mu):
        for choice in ({"quantity": volume.quantity}, {"grid": volume.quantity}):
            back = read_vdb(tmp_path / "both.vdb", **choice)
            assert np.array_equal(back.array, volume.array) and back.quantity == volume.quantity
            assert np.array_equal(back.grid.affine, volume.grid.affine)
    with pytest.raises(InputError, match=r"several grids.*'activity'.*'mu'"):
        read_vdb(tmp_path / "both.vdb")
    grid = vdb.readAllGridMetadata(str(tmp_path / "both.vdb"))[0]
    assert grid.metadata["mphdrr_unit"] == "kBq/mL" and "made by" in grid.metadata["mphdrr_provenance"]


# A shift of -0.5: all files of version 0.1.0 under Blender 4.5.
@pytest.mark.parametrize(
    ("extreme", "mirror", "shift"),
    [(0.0, 1, 0.0), (-0.0, -1, -0.5), (1e-45, 1, -0.5), (-3.4e38, -1, 0.0), (1 / 3, 1, 0.0)],
)
def test_every_float_comes_back(tmp_path, extreme, mirror, shift):
    array = np.zeros((3, 4, 5), np.float32)
    array[1, 2, 3] = extreme
    volume = Volume(array, Grid(array.shape, LINEAR @ np.diag([mirror, 1.0, 1.0, 1.0])), "hu")
    write_vdb(volume, tmp_path / "a.vdb", center_shift=shift)
    back = read_vdb(tmp_path / "a.vdb")
    assert np.array_equal(back.array, array) and np.array_equal(back.grid.affine, volume.grid.affine)


def test_empty_space_takes_no_room(tmp_path):
    array = np.zeros((256, 256, 256), np.float32)
    array[200:204, 100:104, 50:54] = 1.0
    write_vdb(Volume(array, Grid.centered((256, 256, 256), 1.0)), tmp_path / "a.vdb")
    assert (tmp_path / "a.vdb").stat().st_size < 20_000
    assert np.array_equal(read_vdb(tmp_path / "a.vdb").array, array)


def _foreign(cls, values, first=(0, 0, 0), name="density", affine=LINEAR):
    grid = cls()
    grid.copyFromArray(np.ascontiguousarray(values), ijk=first)
    grid.name = name
    grid.transform = vdb.createLinearTransform(affine.T.tolist())
    return grid


@pytest.mark.parametrize(
    ("cls", "dtype"),
    [
        (vdb.FloatGrid, np.float32),
        (vdb.DoubleGrid, np.float64),
        (vdb.Int32Grid, np.int32),
        (vdb.Int64Grid, np.int64),
        (vdb.BoolGrid, bool),
    ],
)
def test_grids_of_other_programs_lie_where_their_transform_says(tmp_path, cls, dtype):
    values = np.arange(1, 61).reshape(3, 4, 5).astype(dtype)
    first = (-7, 11, 3)
    vdb.write(str(tmp_path / "a.vdb"), grids=[_foreign(cls, values, first)])
    volume = read_vdb(tmp_path / "a.vdb", "mu")
    assert volume.quantity == "mu" and np.array_equal(volume.array, values.astype(np.float32))
    for index in ((0, 0, 0), (2, 3, 4), (1, 0, 3)):
        world = LINEAR @ [*(np.array(index) + first), 1.0]
        np.testing.assert_allclose(volume.grid.affine @ [*index, 1.0], world, rtol=0, atol=1e-13)
    metres = read_vdb(tmp_path / "a.vdb", unit=1000.0)
    np.testing.assert_allclose(metres.grid.affine[:3], 1000 * volume.grid.affine[:3], rtol=1e-15)


def test_half_floats_and_inactive_voxels(tmp_path):
    grid = vdb.FloatGrid()
    grid.fill((0, 0, 0), (15, 15, 15), 0.5, True)  # whole tiles
    grid.fill((4, 4, 4), (5, 5, 5), 0.25, False)  # inactive, but a value
    grid.saveFloatAsHalf = True
    grid.name = "density"
    vdb.write(str(tmp_path / "a.vdb"), grids=[grid])
    volume = read_vdb(tmp_path / "a.vdb")
    assert volume.grid.shape == (16, 16, 16) and volume.quantity == "activity"
    assert volume.array.sum() == 0.5 * 16**3 - 0.25 * 8


def test_level_set_becomes_the_share_inside(tmp_path):
    sphere = vdb.createLevelSetSphere(radius=20.0, center=(3.0, 4.0, 5.0), voxelSize=1.5)
    vdb.write(str(tmp_path / "a.vdb"), grids=[sphere])
    volume = read_vdb(tmp_path / "a.vdb", "mu")
    assert volume.array.min() == 0.0 and volume.array.max() == 1.0
    content = volume.array.sum(dtype=float) * volume.grid.voxel_volume
    assert content == pytest.approx(4 / 3 * np.pi * 20**3, rel=2e-3)
    np.testing.assert_allclose(centroid(volume), [3.0, 4.0, 5.0], atol=5e-3)


def test_grids_are_chosen_by_name(tmp_path):
    values = np.ones((2, 2, 2), np.float32)
    vectors = _foreign(vdb.Vec3SGrid, np.ones((2, 2, 2, 3), np.float32), name="velocity")
    grids = [_foreign(vdb.FloatGrid, values * k, name=name) for k, name in enumerate(["", "heat", "heat"], 1)]
    path = tmp_path / "a.vdb"
    vdb.write(str(path), grids=[*grids, vectors])
    assert read_vdb(path, grid="").array.max() == 1
    assert {read_vdb(path, grid=f"heat[{k}]").array.max() for k in (0, 1)} == {2, 3}
    for name, message in (
        (None, r"several grids.*'heat\[1\]'.*velocity"),
        ("smoke", r"no grid of numbers 'smoke'.*'heat\[0\]'"),
        ("velocity", "vec3s"),
    ):
        with pytest.raises(InputError, match=message):
            read_vdb(path, grid=name)
    vdb.write(str(path), grids=[grids[1], vectors])
    assert read_vdb(path).array.max() == 2  # the only one with numbers


@pytest.mark.parametrize(("shift", "mirror"), [(0.0, -1), (-0.5, 1)])
def test_what_others_do_to_our_grids_counts(tmp_path, shift, mirror):
    """Houdini and the like keep the metadata when they move a grid, also one that was written for Blender 4.5's drawing."""
    volume = Volume(np.ones((3, 3, 3), np.float32), Grid((3, 3, 3), LINEAR @ np.diag([mirror, 1.0, 1.0, 1.0])), "mu")
    write_vdb(volume, tmp_path / "a.vdb", center_shift=shift)
    grid = vdb.read(str(tmp_path / "a.vdb"), "mu")
    grid.transform.postTranslate((10.0, 0.0, 0.0))
    vdb.write(str(tmp_path / "b.vdb"), grids=[grid])
    moved = read_vdb(tmp_path / "b.vdb")
    assert moved.quantity == "mu"
    np.testing.assert_allclose(moved.grid.center, volume.grid.center + np.array([10.0, 0.0, 0.0]), atol=1e-9)
    grid.transform = vdb.createLinearTransform((np.diag([2.0, 2.0, 2.0, 1.0]) @ LINEAR).T.tolist())  # as if resampled
    vdb.write(str(tmp_path / "c.vdb"), grids=[grid])
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        read_vdb(tmp_path / "c.vdb")
    assert ["it may lie that much off" in str(w.message) for w in caught] == ([True] if shift else [])


def _centroid(path, name, spread=0.0):
    """Return the centre of a grid's content by OpenVDB's transform of integer indices, which all programs use."""
    grid = vdb.read(str(path), name)
    first, last = grid.evalActiveVoxelBoundingBox()
    shape = tuple(b - a + 1 for a, b in zip(first, last, strict=True))
    values = np.zeros(shape, np.float32)
    grid.copyToArray(values, ijk=first)
    points = [(np.add(ijk, first) + spread, values[ijk]) for ijk in np.ndindex(shape) if values[ijk]]
    world = np.array([grid.transform.indexToWorld(tuple(map(float, point))) for point, _ in points])
    return np.average(world, axis=0, weights=[value for _, value in points])


@pytest.mark.parametrize("mirror", [1, -1])
def test_other_programs_find_voxels_where_they_are(tmp_path, mirror):
    rng = np.random.default_rng(7)
    volume = Volume(rng.random((5, 4, 6), np.float32), Grid((5, 4, 6), LINEAR @ np.diag([mirror, 1.0, 1.0, 1.0])), "mu")
    write_vdb(volume, tmp_path / "a.vdb")
    np.testing.assert_allclose(_centroid(tmp_path / "a.vdb", "mu"), centroid(volume), atol=1e-5)
    assert "mphdrr_note" not in vdb.read(str(tmp_path / "a.vdb"), "mu").metadata
    # Files for drawing are for the running Blender, and say so if they are not for other programs.
    item = volumes.add_volume(volume, "Body", pose=euler_pose(0.2, 0.1, 0.4, (9.0, 8.0, 7.0)))
    shown = item.data.filepath
    update()
    drawn = np.array(item.matrix_world) @ [*_centroid(shown, "mu", -compat.VDB_CENTER_SHIFT), 1.0]
    np.testing.assert_allclose(drawn[:3], centroid(volume), atol=1e-4)
    note = vdb.read(shown, "mu").metadata.get("mphdrr_note", "")
    assert ("where this transform carries i +0.5" in note) == bool(compat.VDB_CENTER_SHIFT)


@pytest.mark.parametrize("ending", [".vdb", ".nii.gz", ".npz", ".nrrd"])
def test_export_writes_a_moved_volume_for_other_programs(tmp_path, ending):
    rng = np.random.default_rng(8)
    volume = Volume(rng.random((5, 4, 6), np.float32), Grid((5, 4, 6), LINEAR), "activity")
    item = volumes.add_volume(volume, "Heart")
    item.location.x += 11.0
    item.rotation_euler.y = 0.25
    update()
    volumes.make_active(bpy.context, item)
    path = tmp_path / f"heart{ending}"
    assert bpy.ops.mphdrr.export_volume(filepath=str(path)) == {"FINISHED"}
    stands = volumes.volume_from_object(item)
    back = (read_vdb if ending == ".vdb" else read_volume)(path)
    assert back.quantity == "activity" and np.array_equal(back.array, stands.array)
    np.testing.assert_allclose(back.grid.affine, stands.grid.affine, atol=1e-5)
    if ending == ".vdb":
        np.testing.assert_allclose(_centroid(path, "activity"), centroid(stands), atol=1e-5)


def test_export_writes_dicom_with_the_tags_of_a_template(tmp_path):
    pydicom = pytest.importorskip("pydicom")
    volume = Volume(np.arange(120.0).reshape(5, 4, 6), Grid.centered((5, 4, 6), (2.0, 2.5, 3.0)), "activity")
    item = volumes.add_volume(volume, "Heart")
    item.rotation_euler, item.location.x = (0.1, 0.25, -0.4), 11.0
    update()
    volumes.make_active(bpy.context, item)
    template, path = tmp_path / "template.dcm", tmp_path / "heart.dcm"
    assert bpy.ops.mphdrr.export_volume(filepath=str(template), tags="PatientID=7; StudyID=a=b") == {"FINISHED"}
    arguments = {"template": str(template), "tags": "PatientName=Doe^Jo"}
    assert bpy.ops.mphdrr.export_volume(filepath=str(path), **arguments) == {"FINISHED"}
    tags = pydicom.dcmread(path)
    assert (tags.PatientID, tags.StudyID, str(tags.PatientName)) == ("7", "a=b", "Doe^Jo")
    stands, back = volumes.volume_from_object(item), read_volume(path)
    np.testing.assert_array_equal(back.array, stands.array)
    np.testing.assert_allclose(back.grid.affine, stands.grid.affine, atol=1e-5)
    refused(bpy.ops.mphdrr.export_volume, "expected KEYWORD=VALUE", filepath=str(path), tags="PatientID")


def test_export_refuses_other_endings_and_the_scenes_own_file(tmp_path):
    item = volumes.add_volume(Volume(np.ones((2, 2, 2)), Grid.centered(2, 3.0)), "Cube")
    volumes.make_active(bpy.context, item)
    for path, message in (
        (tmp_path / "a.txt", r"expected a name ending in \.vdb"),
        (volumes.file_of(item), "scene's own"),
    ):
        refused(bpy.ops.mphdrr.export_volume, message, filepath=str(path))


def _bad(path, kind):
    good = _foreign(vdb.FloatGrid, np.ones((40, 40, 40), np.float32) * np.arange(40, dtype=np.float32))
    if kind == "frustum":
        good.transform = vdb.createFrustumTransform((0, 0, 0), (10, 10, 10), 0.5, 3.0, 1.0)
    elif kind == "far voxel":
        good.fill((10**6,) * 3, (10**6,) * 3, 1.0, True)
    elif kind == "infinite":
        good.fill((0, 0, 0), (0, 0, 0), float("inf"), True)
    grids = {
        "vectors": [_foreign(vdb.Vec3SGrid, np.ones((2, 2, 2, 3), np.float32))],
        "points": [vdb.PointDataGrid()],
        "empty": [vdb.FloatGrid()],
        "no grids": [],
    }.get(kind, [good])
    vdb.write(str(path), grids=grids)
    whole = path.read_bytes()
    if kind in ("cut in the voxels", "cut in the header"):
        path.write_bytes(whole[: len(whole) * 2 // 3 if kind == "cut in the voxels" else 60])
    elif kind == "text":
        path.write_text("not a volume\n")
    elif kind == "nothing":
        path.write_bytes(b"")
    elif kind == "no file":
        path.unlink()


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("frustum", "frustum"),
        ("vectors", "vec3s"),
        ("points", "no grid of numbers"),
        ("empty", "no active voxels"),
        ("no grids", "holds no grid"),
        ("far voxel", "memory"),
        ("infinite", "not a finite number"),
        ("cut in the voxels", "is cut off, "),
        ("cut in the header", "holds no grid"),
        ("text", "cannot be read"),
        ("nothing", "cannot be read"),
        ("no file", "no such file"),
    ],
)
def test_bad_files_are_refused_in_one_line(tmp_path, kind, message):
    path = tmp_path / "bad.vdb"
    _bad(path, kind)
    with pytest.raises(InputError, match=message) as refusal:
        read_vdb(path)
    assert "\n" not in str(refusal.value) and str(path) in str(refusal.value)


def test_arguments_are_checked(tmp_path):
    vdb.write(str(tmp_path / "a.vdb"), grids=[_foreign(vdb.FloatGrid, np.ones((2, 2, 2), np.float32))])
    for arguments, message in (
        ({"quantity": "warmth"}, "activity, mu"),
        ({"unit": 0.0}, "mm"),
        ({"grid": "x"}, "density"),
    ):
        with pytest.raises(InputError, match=message):
            read_vdb(tmp_path / "a.vdb", **arguments)


@pytest.mark.parametrize("several", [False, True])
def test_every_cut_off_file_is_refused(tmp_path, several):
    rng = np.random.default_rng(3)
    grid = Grid.centered((13, 11, 17), 2.0)
    volumes = [Volume(rng.random(grid.shape, dtype=np.float32), grid, name) for name in ("activity", "mu")]
    path = tmp_path / "whole.vdb"
    _write_together(volumes if several else volumes[:1], path, {"from": "a test"})
    whole = path.read_bytes()
    assert np.array_equal(read_vdb(path, "activity").array, volumes[0].array)
    cut = tmp_path / "cut.vdb"
    for length in {*range(len(whole) - 40, len(whole)), *rng.integers(0, len(whole), 100).tolist()}:
        cut.write_bytes(whole[:length])
        with pytest.raises(InputError, match=r"cut\.vdb: ") as refused:
            read_vdb(cut, "activity")
        assert "\n" not in str(refused.value)
