"""Every format of cameras, read back by its own documentation, sees points where the views see them."""

import json
import re
import xml.etree.ElementTree as ET

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.cli import main
from mphdrr.core.exchange import FORMATS

from .conftest import refused, refused_command


def arrays(path):
    if path.suffix == ".json":
        return {name: np.asarray(value) for name, value in json.loads(path.read_text()).items()}
    with np.load(path) as file:
        return dict(file)


def homogeneous(points):
    return np.concatenate([points, np.ones((*points.shape[:-1], 1))], axis=-1)


def divide(seen):
    return seen[..., :2] / seen[..., 2:]


def project(views, points):
    """Project points (M, N, 3) to (M, N, 2): column and row."""
    return divide(np.einsum("mij,mnj->mni", views.projection_matrices(), homogeneous(points)))


def on_panel(source, center, u, v, shape, points):
    """Return columns and rows where rays from `source` through `points` meet the plane of pixels, solved ray by ray."""
    # source + t (point - source) = center + a u + b v
    rays = points - source[:, None]
    planes = np.stack([np.broadcast_to(-step[:, None], rays.shape) for step in (u, v)], axis=-1)
    matrices = np.concatenate([rays[..., None], planes], axis=-1)
    solution = np.linalg.solve(matrices, np.broadcast_to((center - source)[:, None, :, None], (*rays.shape, 1)))
    return solution[..., 1:, 0] + (np.array(shape[::-1]) - 1) / 2


# Readers: a file and points (M, N, 3) to columns and rows (M, N, 2) of the array, 0 at the centre of pixel 0.


def read_astra(path, points):
    a = arrays(path)
    source, center, u, v = a["vectors"].reshape(-1, 4, 3).transpose(1, 0, 2)
    return on_panel(source, center, u, v, (int(a["det_row_count"]), int(a["det_col_count"])), points)


def rotation(i, j, degrees):
    """Return the rotation (4, 4) in the plane of axes i and j."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    matrix = np.eye(4)
    matrix[np.ix_([i, j], [i, j])] = [[c, -s], [s, c]]
    return matrix


def read_rtk(path, points):
    """Follow RTK's page "3D projection geometry": the matrix from the nine parameters must be that of the file."""
    text = path.read_text()
    spacing, origin = detector_of(text)
    root = ET.fromstring(text)
    assert (root.tag, root.get("version")) == ("RTKThreeDCircularGeometry", "3")
    pixels = []
    for projection, own_points in zip(root.findall("Projection"), points, strict=True):
        value = {element.tag: float(element.text) for element in projection if element.tag != "Matrix"}
        to_source, shift = np.eye(4), np.eye(3)
        to_source[:2, 3] = -value["SourceOffsetX"], -value["SourceOffsetY"]
        sdd, sid = value["SourceToDetectorDistance"], value["SourceToIsocenterDistance"]
        magnify = np.array([[-sdd, 0, 0, 0], [0, -sdd, 0, 0], [0, 0, 1, -sid]])
        shift[:2, 2] = [value[f"SourceOffset{axis}"] - value[f"ProjectionOffset{axis}"] for axis in "XY"]
        in_plane, out_of_plane = rotation(0, 1, -value["InPlaneAngle"]), rotation(1, 2, -value["OutOfPlaneAngle"])
        matrix = shift @ magnify @ to_source @ in_plane @ out_of_plane @ rotation(0, 2, value["GantryAngle"])
        written = np.array(projection.find("Matrix").text.split(), float).reshape(3, 4)
        assert np.allclose(matrix, written, rtol=1e-12, atol=1e-6)  # RTK refuses files that are 1e-3 off
        pixels.append((divide(homogeneous(own_points) @ written.T) - origin) / spacing)
    return np.array(pixels)


def detector_of(text):
    """Return spacing and origin of the projections, from the comment in a file of RTK."""
    return [np.array(re.search(rf"{word} (\S+) (\S+) [01]\b", text).groups(), float) for word in ("spacing", "origin")]


def read_opencv(path, points):
    a = arrays(path)
    camera = np.einsum("mij,mnj->mni", a["R"], points) + a["t"][:, None]
    assert np.allclose(np.linalg.det(a["R"]), 1)
    assert np.all(camera[..., 2] > 0)
    assert not a["K"][:, [0, 1], [1, 0]].any() and np.all(a["K"][:, 2] == [0, 0, 1])
    return divide(np.einsum("mij,mnj->mni", a["K"], camera))


def read_kornia(path, points):
    a = arrays(path)
    return divide(np.einsum("mij,mjk,mnk->mni", a["intrinsics"], a["extrinsics"], homogeneous(points))[..., :3])


def read_pytorch3d(path, points):
    """Follow PyTorch3D's page "Cameras": row vectors, +X left, +Y up; screen from NDC by its own formulas."""
    a = arrays(path)
    view = points @ a["R"] + a["T"][:, None]
    assert np.allclose(np.linalg.det(a["R"]), 1)
    assert np.all(view[..., 2] > 0)
    size, f, p = a["image_size"][:, None, ::-1], a["focal_length"][:, None], a["principal_point"][:, None]
    short = size.min(axis=-1, keepdims=True)
    if not a["in_ndc"]:
        f, p = f * 2.0 / short, -(p - size / 2.0) * 2.0 / short
    ndc = f * view[..., :2] / view[..., 2:] + p
    return size / 2.0 - ndc * short / 2.0 - 0.5  # (0, 0) of the screen is the corner of the first pixel


def read_nerf(path, points):
    """Follow nerfstudio's page "Data conventions": +X right, +Y up, -Z forward; for pictures turned by `as_seen`."""
    document = json.loads(path.read_text())
    pixels = []
    for frame, own_points in zip(document["frames"], points, strict=True):
        one = document | frame
        camera = homogeneous(own_points) @ np.linalg.inv(one["transform_matrix"]).T
        assert np.all(camera[:, 2] < 0)
        assert np.isclose(np.linalg.det(one["transform_matrix"]), 1)
        assert np.isclose(one["fl_x"], 0.5 * one["w"] / np.tan(0.5 * one["camera_angle_x"]))
        x = one["cx"] + one["fl_x"] * camera[:, 0] / -camera[:, 2]
        y = one["cy"] - one["fl_y"] * camera[:, 1] / -camera[:, 2]
        pixels.append(np.stack([one["w"] - 1 - (x - 0.5), one["h"] - 1 - (y - 0.5)], axis=-1))
    return np.array(pixels)


def read_leap(path, points):
    """Follow LEAP's set_modularbeam: s(x) and t(x) of its documentation, along colVectors and rowVectors."""
    a = arrays(path)
    y, c, v, u = (a[n].astype(float)[:, None] for n in ("sourcePositions", "moduleCenters", "rowVectors", "colVectors"))
    n = np.cross(u, v)
    depth = ((c - y) * n).sum(-1) / ((points - y) * n).sum(-1)
    s, t = (((depth[..., None] * (points - y) - (c - y)) * step).sum(-1) for step in (u, v))
    column = s / a["pixelWidth"] + (a["numCols"] - 1) / 2
    return np.stack([column, t / a["pixelHeight"] + (a["numRows"] - 1) / 2], axis=-1)


READERS = {"astra": read_astra, "rtk": read_rtk, "opencv": read_opencv, "kornia": read_kornia,
           "pytorch3d": read_pytorch3d, "nerf": read_nerf, "leap": read_leap}  # fmt: skip
ARRAYS = ("sources", "detector_centers", "u_steps", "v_steps")


def with_arrays(views, **changes):
    """Return the views with other arrays."""
    return mph.Views(**{name: getattr(views, name) for name in ARRAYS} | changes, shape=views.shape)


def path_for(format, folder):
    """Return a path with an ending of this format."""
    return folder / f"geometry{FORMATS[format].suffixes[0]}"


def deviation(format, views, points, path, system, **options):
    """Return the largest distance, pixels, between points seen through a written file and through the views."""
    mph.write_geometry(system, path, format, views=views, **options)
    return np.abs(READERS[format](path, points) - project(views, points)).max()


def fiducials(views, rng, count=20):
    """Return points (M, count, 3) that the views see: anywhere on rays of pixels, between source and detector."""
    n_v, n_u = views.shape
    a = (rng.uniform(-0.5, n_u - 0.5, (len(views), count, 1)) - (n_u - 1) / 2) * views.u_steps[:, None]
    b = (rng.uniform(-0.5, n_v - 0.5, (len(views), count, 1)) - (n_v - 1) / 2) * views.v_steps[:, None]
    t = rng.uniform(0.1, 0.9, (len(views), count, 1))
    return views.sources[:, None] + t * (views.detector_centers[:, None] + a + b - views.sources[:, None])


def general_views(rng, mirrored=False, count=15):
    """Return views of any pose, with pixels of one proportion and many sizes, far off centre."""
    poses = np.array([mph.euler_pose(*rng.uniform(-4, 4, 3))[:3, :3] for _ in range(count)])
    poses[0] = mph.euler_pose(0, np.pi / 2, 0)[:3, :3]  # axes along the world's
    poses[1] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]  # RTK's gantry and in-plane angles are one here
    x, y, z = poses.transpose(1, 0, 2)
    size = rng.uniform(0.2, 3, (count, 1))
    sources = rng.uniform(-300, 300, (count, 3))
    centers = sources + rng.uniform(200, 900, (count, 1)) * z + rng.uniform(-60, 60, (count, 1)) * (x + 0.5 * y)
    return mph.Views(sources, centers, (-size if mirrored else size) * x, 0.7 * size * y, (37, 64))


@pytest.mark.parametrize("format", READERS)
def test_scanner_is_seen_alike_through_every_format(format, scanner, rng, tmp_path):
    """All 80 modules, both detectors, images and pixels that are not square, shifted."""
    in_roi = rng.normal(size=(80, 20, 3))
    in_roi *= 75 * rng.uniform(0, 1, (80, 20, 1)) ** (1 / 3) / np.linalg.norm(in_roi, axis=-1, keepdims=True)
    for settings in (
        {},
        {"shape": (31, 48), "magnification": 7.0, "pitch": (2.5, 3.5), "offset": (13.0, -7.0)},
        {"shape": (65, 32), "detector": "real", "pitch": (0.9, 1.3), "offset": (3.0, -7.0)},
    ):
        views = scanner.views(**settings)
        for suffix in FORMATS[format].suffixes:
            assert deviation(format, views, in_roi, tmp_path / f"geometry{suffix}", scanner) < 1e-4


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("format", READERS)
def test_views_of_any_pose_are_seen_alike(format, mirrored, scanner, rng, tmp_path):
    views, path = general_views(rng, mirrored), path_for(format, tmp_path)
    if mirrored and format == "nerf":
        words = "view 0: format nerf cannot hold a mirror image"
        refused(lambda: mph.write_geometry(scanner, path, format, views=views), words)
        assert not path.exists()
        return
    assert deviation(format, views, fiducials(views, rng), path, scanner) < (1e-3 if format == "leap" else 1e-6)


def test_astra_takes_oblique_pixels_and_pytorch3d_writes_screen_space(system, rng, tmp_path):
    views = system.views(shape=(20, 33))
    assert deviation("pytorch3d", views, fiducials(views, rng), tmp_path / "a.npz", system, in_ndc=False) < 1e-9
    assert arrays(tmp_path / "a.npz")["principal_point"][0] == pytest.approx([33 / 2, 20 / 2])
    oblique = with_arrays(views, v_steps=views.v_steps + 0.3 * views.u_steps)
    assert deviation("astra", oblique, fiducials(oblique, rng), tmp_path / "b.npz", system) < 1e-9


def test_views_rounded_to_float32_are_still_cameras(system, rng, tmp_path):
    views = system.views(shape=(256, 256))
    rounded = with_arrays(views, **{name: getattr(views, name).astype(np.float32) for name in ARRAYS})
    for format in READERS:
        assert deviation(format, rounded, fiducials(views, rng), path_for(format, tmp_path), system) < 5e-3


@pytest.mark.parametrize(
    ("format", "words"),
    [
        *((format, "view 4: format {} needs pixel rows perpendicular to columns") for format in [*READERS][1:]),
        *((format, "view 4: format {} has one pixel size") for format in ("rtk", "leap")),
    ],
)
def test_oblique_pixels_and_those_of_other_proportions_are_refused_by_view(format, words, system, tmp_path):
    views = system.views(shape=(30, 40))
    u_steps, v_steps = views.u_steps.copy(), views.v_steps.copy()
    if "perpendicular" in words:
        v_steps[4] += 0.01 * u_steps[4]
    else:
        u_steps[4] *= 1.01
    views, path = with_arrays(views, u_steps=u_steps, v_steps=v_steps), path_for(format, tmp_path)
    refused(lambda: mph.write_geometry(system, path, format, views=views), words.format(format))
    assert not path.exists()


def test_mphdrr_reads_back_bit_for_bit(system, rng, tmp_path):
    views = general_views(rng)
    mph.write_geometry(system, tmp_path / "a.json", "mphdrr", views=views)
    system_read, views_read = mph.read_geometry(tmp_path / "a.json")
    for name in ("numbers", *system.columns.fields):
        assert np.array_equal(getattr(system_read, name), getattr(system, name))
    for name in (*ARRAYS, "shape"):
        assert np.array_equal(getattr(views_read, name), getattr(views, name))
    written = json.loads((tmp_path / "a.json").read_text())
    matrices = np.array([view["projection_matrix"] for view in written["views"]])
    assert np.array_equal(matrices, views.projection_matrices())


def test_files_of_another_kind_are_refused(tmp_path):
    path = tmp_path / "a.json"
    refused(lambda: mph.read_geometry(path), "no such file")
    for text, words in (
        ("{", "not JSON"),
        ("[]", "not a file of the format mphdrr"),
        ('{"kind": "mphDRR geometry", "version": 9}', "version 9"),
        ('{"kind": "mphDRR geometry", "version": 1, "modules": [{}]}', "incomplete, 'number' is missing"),
    ):
        path.write_text(text)
        refused(lambda: mph.read_geometry(path), words)


def test_astra_volume_is_the_grid_in_script_and_command(system, workbook, tmp_path):
    """Names in capitals are written as they are."""
    grid = mph.Grid.centered((4, 6, 10), (1.0, 2.0, 0.5), center=(3, -2, 1))
    mph.write_geometry(system, tmp_path / "A.NPZ", "astra", grid=grid)
    assert [p.name for p in tmp_path.iterdir()] == ["A.NPZ"]
    mph.write_volume(mph.Volume(np.ones(grid.shape, np.float32), grid, "mu"), tmp_path / "v.nii.gz")
    words = ["--format", "astra", "--set", f"grid={tmp_path / 'v.nii.gz'}"]
    assert main(["geometry", "export", str(workbook), "-o", str(tmp_path / "b.npz"), *words]) == 0
    for a in (arrays(tmp_path / "A.NPZ"), arrays(tmp_path / "b.npz")):
        assert a["volume_counts"].tolist() == [6, 4, 10]
        low, high = a["volume_windows"].reshape(3, 2).T
        # ASTRA's voxel [z, y, x]: centre at min + (i + 1/2) times the step.
        assert np.allclose(low + 2.5 * (high - low) / np.array(grid.shape), (grid.affine @ [2, 2, 2, 1])[:3])


def test_nerf_pictures_are_named_after_their_modules(system, tmp_path):
    mph.write_geometry(system, tmp_path / "transforms.json", "nerf", pictures="p/{}.png")
    frames = json.loads((tmp_path / "transforms.json").read_text())["frames"]
    assert [frame["file_path"] for frame in frames] == [f"p/{number}.png" for number in range(101, 113)]


@pytest.mark.parametrize(
    ("name", "format", "options", "words"),
    [
        ("a.npz", "obj", {}, "expected one of astra, rtk"),
        ("a.txt", "astra", {}, "expected a name ending in .npz, .json"),
        ("a.npz", "astra", {"ndc": True}, "no option 'ndc', it has grid"),
        ("a.npz", "astra", {"grid": mph.Grid((4, 4, 4), mph.euler_pose(0.1, 0, 0))}, "along +x, +y, +z"),
        ("a.npz", "astra", {"views": mph.parallel_views([0.0], (4, 4), 1.0)[:0]}, "views: expected one or more"),
        ("a.npz", "opencv", {"ndc": True}, "no option 'ndc', it has none"),
        ("none/a.npz", "opencv", {}, "no such folder"),
        ("a.json", "nerf", {"pictures": "p.png"}, "expected a file name with {}"),
        ("a.stl", "stl", {"part": "plates"}, "collimators, crystals, all"),
        ("a.3mf", "3mf", {"plate_thickness": 99.0}, "module 101: aperture plate"),
        ("a.glb", "glb", {"wall_thickness": 0.0}, "collimator wall"),
        ("a", "stl-parts", {"wall_thickness": "thick"}, "collimator wall"),
        ("a.stl", "glb", {}, ".glb"),
    ],
)
def test_what_cannot_be_written_is_said_at_once(name, format, options, words, system, tmp_path):
    refused(lambda: mph.write_geometry(system, tmp_path / name, format, **options), words)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "words", "format"),
    [
        ("a.xml", [], "rtk"),
        ("new/a.npz", ["--format", "opencv", "--modules", "3-9", "--detector", "real"], "opencv"),
        ("a.json", ["--format", "nerf", "--size", "30", "40", "--pitch", "9", "--set", "pictures=p/{}.png"], "nerf"),
        ("a.npz", ["--format", "pytorch3d", "--set", "in_ndc=no"], "pytorch3d"),
    ],
)
def test_command_line_writes_them(name, words, format, workbook, scanner, rng, tmp_path, capsys):
    assert main(["geometry", "export", str(workbook), "-o", str(tmp_path / name), *words]) == 0
    assert name in capsys.readouterr().out
    part = scanner[2:9] if "--modules" in words else scanner
    shape = (30, 40) if "--size" in words else (256, 256)
    views = part.views(shape, "real" if "real" in words else "virtual", pitch=9.0 if "--pitch" in words else None)
    points = fiducials(views, rng)
    assert np.abs(READERS[format](tmp_path / name, points) - project(views, points)).max() < 1e-6


@pytest.mark.parametrize(
    ("name", "words", "message"),
    [
        ("a.npz", [], "choose one by --format: astra, opencv"),
        ("a", [], "choose one by --format: astra, rtk"),
        ("a.txt", ["--format", "rtk"], "expected a name ending in .xml"),
        ("a.npz", ["--format", "astra", "--set", "in_ndc=no"], "expected NAME=VALUE, format astra has grid"),
        ("a.npz", ["--format", "pytorch3d", "--set", "in_ndc=perhaps"], "expected in_ndc=yes|no"),
        ("a.npz", ["--format", "astra", "--set", "grid=none.nii"], "none.nii"),
    ],
)
def test_command_line_refuses_in_one_line(name, words, message, workbook, tmp_path, capsys):
    assert message in refused_command(capsys, "geometry", "export", workbook, "-o", tmp_path / name, *words)
    assert not list(tmp_path.iterdir())


def test_help_lists_all_formats(capsys):
    assert main(["geometry", "export", "--help"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert all(f"{format.name} {format.title}" in text for format in FORMATS.values())
