"""Laws of shapes, of phantoms made of them, and of the kinds of phantoms."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import trimesh

import mphdrr.core as mph
from mphdrr.core.phantoms import kinds

from .conftest import WORKBOOK, general_grid

EXAMPLES = WORKBOOK.parent / "phantoms"
CUT = [(1, 0.3, 0.2, 1.5), (0, -1, 0.5, 2)]
SHAPES = [
    mph.Sphere(radius=7, activity=1),
    mph.Ellipsoid(radii=(3, 10, 6), activity=1),
    mph.Cylinder(radius=(4, 9), height=7, activity=1),
    mph.Cone(radius=8, top_radius=3, height=9, activity=1),
    mph.Cone(radius=0, top_radius=5, height=12, activity=1),
    mph.Capsule(radius=3, height=8, activity=1),
    mph.Box(size=(5, 9, 14), activity=1),
    mph.DerenzoRods(radius=10, rod_diameters=(1, 2, 1.5, 1.2, 0.8, 0.7, 0.9, 1.1), sectors=8, height=6, activity=1),
    mph.DerenzoRods(radius=10, rod_diameters=(1, 2), sectors=2, height=6, activity=1),
]
SHAPES += [dataclasses.replace(shape, cut=CUT) for shape in SHAPES[1:7]]
PAINTING = mph.ShapePhantom(
    [
        mph.Cylinder(radius=(30, 22), height=40, activity=2, mu=0.015, name="water"),
        mph.Sphere(radius=9, position=(12, 3, -4), activity=10),
        mph.Ellipsoid(radii=(4, 12, 6), position=(10, 0, 0), euler=(0.3, 0.5, 0), activity=0, mu=0.004),
        mph.Box(size=(8, 8, 60), position=(-14, 5, 0), axis=(1, 1, 3), activity=3, mu=0.03, mode="add"),
        mph.DerenzoRods(radius=12, rod_diameters=(3, 2.5, 2, 1.5, 3, 2), height=16, activity=6, position=(-4, -6, 5)),
    ]
)
KINDS = [
    mph.DerenzoPhantom(30, (6, 5, 4, 3.5, 3, 2.5), 24, activity=120),
    mph.DerenzoPhantom(30, (6, 5, 4, 3), 24, 0.0, 4, cylinder_radius=34, cylinder_height=30, background=7),
    mph.NemaBody(),
    mph.JaszczakPhantom(),
    mph.DefrisePhantom(),
    mph.SheppLogan(),
    mph.PointGrid((3, 2, 4), (15, 20, 25), 1.5),
    mph.MixturePhantom(seed=3, number=6, radius=35),
    mph.CardiacTorso(phase=0.2, defect_severity=0.7, defect_width_degrees=200),
    PAINTING,
]


def title(phantom: mph.Phantom) -> str:
    return phantom.title


def total(volume: mph.Volume) -> float:
    """Return the sum over the volume, kBq, or the same of mu."""
    return float(volume.array.sum(dtype=np.float64) * volume.grid.voxel_volume * 1e-3)


def lines(rng: np.random.Generator, n: int, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Return ends of lines (3, n), some along axes and planes, some of length zero."""
    starts, ends = rng.uniform(-reach, reach, (2, 3, n))
    ends[:2, : n // 8] = starts[:2, : n // 8]
    ends[1:, n // 8 : n // 4] = starts[1:, n // 8 : n // 4]
    ends[2, n // 4 : n // 3] = starts[2, n // 4 : n // 3]
    ends[:, :5] = starts[:, :5]
    return starts, ends


@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: shape.KIND + ("-cut" if shape.cut else ""))
def test_a_shape_is_the_same_to_points_lines_and_as_a_mesh(shape, rng):
    starts, ends = lines(rng, 600, 15)
    enter, leave = shape.intervals(starts, ends - starts)
    along = (np.arange(1000) + 0.5) / 1000
    inside = np.stack([shape.distance(starts + t * (ends - starts)) < 0 for t in along])
    within = np.maximum(np.minimum(leave, 1) - np.maximum(enter, 0), 0).sum(axis=0)
    assert np.abs(inside.mean(axis=0) - within).max() < 4e-3
    # The distance is a bound: within it nothing changes.
    points = rng.uniform(-13, 13, (3, 3000))
    distance = shape.distance(points)
    step = rng.normal(size=points.shape)
    step *= 0.999 * np.abs(distance) / np.linalg.norm(step, axis=0)
    for share in (0.3, 0.7, 1.0):
        assert np.array_equal(shape.distance(points + share * step) < 0, distance < 0)
    assert shape.distance(points.astype(np.float32)).dtype == np.float32
    vertices, faces = shape.surface()
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert mesh.volume == pytest.approx(shape.volume, rel=0.013)
    assert np.all(np.abs(vertices).max(axis=0) < np.array(shape.half_box) * (1 + 1e-9))
    assert np.linalg.norm(vertices, axis=1).max() < shape.ball_radius * (1 + 1e-9)
    box = np.array(shape.half_box)[:, None]
    points = rng.uniform(-1, 1, (3, 200_000)) * box
    assert np.mean(shape.distance(points) < 0) * np.prod(2 * box) == pytest.approx(shape.volume, rel=0.05)


def test_volumes_of_what_planes_leave():
    half = mph.Ellipsoid(radii=(30, 20, 50), cut=[(0, 0, -1, 0)], activity=1)
    assert half.volume == pytest.approx(2 / 3 * np.pi * 30 * 20 * 50, rel=2e-5)
    wedge = mph.Box(size=(30, 20, 50), cut=[(3, 3, 0, 0), (1, 0, 0, 5)], activity=1)  # any length of the normal
    assert wedge.volume == pytest.approx(50 * (300 - 12.5), rel=2e-5)


@pytest.mark.parametrize("quantity", ["activity", "mu"])
@pytest.mark.parametrize("phantom", [PAINTING, *KINDS[1:5], KINDS[7]], ids=title)
def test_line_integrals_are_those_of_the_values(phantom, quantity, rng):
    pose = mph.euler_pose(0.4, 0.7, -1.1, (1, 2, -3))
    n, steps = 40, 4000
    starts = rng.normal(size=(n, 3))
    starts *= phantom.extent / 2 / np.linalg.norm(starts, axis=1)[:, None]
    ends = -starts + rng.uniform(-0.1, 0.1, (n, 3)) * phantom.extent
    along = (np.arange(steps) + 0.5)[:, None] / steps
    sums = [
        phantom.values(start + along * (end - start), pose, quantity).mean() * np.linalg.norm(end - start)
        for start, end in zip(starts, ends, strict=True)
    ]
    exact = phantom.line_integrals(starts, ends, pose, quantity)
    assert exact.max() > 0
    assert np.abs(exact - sums).max() < 6e-3 * exact.max()
    # From the other end; from a point inside; one source for all.
    np.testing.assert_allclose(phantom.line_integrals(ends, starts, pose, quantity), exact)
    middle = (starts + ends) / 2
    parts = [phantom.line_integrals(*both, pose, quantity) for both in ((starts, middle), (middle, ends))]
    np.testing.assert_allclose(sum(parts), exact, rtol=1e-9, atol=1e-9 * exact.max())
    assert phantom.line_integrals(starts[0], ends, pose, quantity).shape == (n,)
    assert phantom.line_integrals(starts[0], np.empty((0, 3)), pose, quantity).shape == (0,)


@pytest.mark.parametrize(
    "shape",
    [mph.Ellipsoid(radii=(30, 20, 25), activity=3), mph.Cylinder(radius=24, height=40, activity=3)],
    ids=lambda shape: shape.KIND,
)
def test_projections_of_voxels_converge_to_the_closed_form(shape, rng):
    """A voxel's mean does not depend on where in it the ray runs: h for single rays, h^2 for the mean over many rays."""
    phantom, pose = mph.ShapePhantom([shape]), mph.euler_pose(0.4, 0.7, -1.1, (1, 2, -3))
    starts = rng.normal(size=(20_000, 3))
    starts *= 200 / np.linalg.norm(starts, axis=1)[:, None]
    ends = -starts + rng.uniform(-60, 60, starts.shape)
    exact = phantom.line_integrals(starts, ends, pose)
    through = exact > 20 * shape.activity
    single, mean = [], []
    for h in (8.0, 4.0, 2.0, 1.0):
        volume = phantom.voxelize(mph.Grid.centered(int(80 / h), h), pose)
        error = (mph.trace_rays(volume, starts, ends) - exact) / exact.max()
        single.append(np.sqrt(np.mean(error**2)))
        mean.append(abs(error[through].mean()))
    orders = [np.log2(np.array(errors[:-1]) / errors[1:]) for errors in (single, mean)]
    assert single[-1] < 0.01 and np.all((orders[0] > 0.8) & (orders[0] < 1.3))
    assert mean[-1] < 1e-3 and np.all((orders[1] > 1.5) & (orders[1] < 2.7))


def test_projectors_agree_with_exact_projections(system):
    phantom, views = KINDS[0], system[:2].views(shape=(20, 20), magnification=8)
    images = mph.Projector(grid := mph.Grid.centered(128, 0.6), views)(phantom.voxelize(grid))
    exact = phantom.project(views)
    assert exact.shape == (2, 20, 20) and exact.dtype == np.float32
    assert np.sqrt(np.mean((images - exact) ** 2)) < 0.02 * exact.max()


@pytest.mark.long
@pytest.mark.parametrize("phantom", KINDS, ids=title)
def test_total_activity_does_not_depend_on_grid_or_pose(phantom, rng):
    """To 0.01 %, also where voxels are larger than the parts."""
    for voxels in (28, 6):
        spacing = phantom.extent / (voxels - 3)
        grid = mph.Grid.centered(voxels, spacing)
        turned = mph.euler_pose(*rng.uniform(-3, 3, 3), translation=rng.uniform(-1, 1, 3) * spacing)
        for pose in (None, turned) if voxels == 6 else (turned,):
            volume = phantom.voxelize(grid, pose)
            assert total(volume) == pytest.approx(phantom.total_activity, rel=1e-4)
            assert volume.array.min() >= -1e-5 * volume.array.max()


QUICK = (KINDS[1], KINDS[5], PAINTING)


@pytest.mark.parametrize(
    "phantom", [*QUICK, *(pytest.param(p, marks=pytest.mark.long) for p in KINDS if p not in QUICK)], ids=title
)
def test_total_mu_is_that_of_many_parallel_lines(phantom, rng):
    spacing = phantom.extent / 3
    turned = mph.euler_pose(*rng.uniform(-3, 3, 3), translation=rng.uniform(-1, 1, 3) * spacing)
    volume = phantom.voxelize(mph.Grid.centered(6, spacing), turned, quantity="mu")
    assert volume.quantity == "mu"
    side = np.linspace(-0.5, 0.5, 201)[1:] - 0.5 / 200
    v, w = (phantom.extent + 2 * spacing) * np.stack(np.meshgrid(side, side)).reshape(2, -1)
    far = np.full_like(v, phantom.extent)
    sums = phantom.line_integrals(np.stack([-far, v, w], 1), np.stack([far, v, w], 1), turned, "mu").mean()
    assert total(volume) == pytest.approx(sums * (phantom.extent + 2 * spacing) ** 2 * 1e-3, rel=5e-3)


def test_scaled_and_sheared_poses_and_grids_hold_what_they_should(rng):
    grid = general_grid(rng, (36, 56, 30))
    grid = mph.Grid(grid.shape, np.diag([2.0, 2, 2, 1]) @ grid.affine)
    assert total(PAINTING.voxelize(grid)) == pytest.approx(PAINTING.total_activity, rel=1e-3)
    pose = mph.euler_pose(0.1, 0.2, 0.3)
    pose[:3, :3] = pose[:3, :3] @ np.array([[0.8, 0.1, 0], [0, -1.1, 0.2], [0, 0, 0.7]])
    held = total(PAINTING.voxelize(mph.Grid.centered(45, 2.0), pose))
    assert held == pytest.approx(PAINTING.total_activity * 0.8 * 1.1 * 0.7, rel=1e-3)


@pytest.mark.parametrize(("phantom", "spacing", "most", "mean"), [
    (PAINTING, (3.0, 2.5, 3.0), 1.2, 0.02),
    (mph.DerenzoPhantom(25.0, (6, 5, 4, 3, 2, 0), 10.0, activity=10.0), (1.7, 2.0, 1.5), 1.5, 0.02),
])  # fmt: skip
def test_voxels_hold_the_mean_of_what_was_painted(phantom, spacing, most, mean, rng):
    """Against brute force, whose own noise is 0.25 of 10: many random points of each voxel, painted one by one."""
    grid, pose = mph.Grid.centered((24, 22, 20), spacing, center=(4, 1, 0)), mph.euler_pose(0.4, 0.7, -1.1, (1, 2, -3))
    values = phantom.voxelize(grid, pose).array
    index = np.stack(np.unravel_index(rng.choice(values.size, 1500, replace=False), values.shape), axis=1)
    points = (index[:, None] + rng.uniform(-0.5, 0.5, (1500, 400, 3))).reshape(-1, 3)
    world = points @ grid.affine[:3, :3].T + grid.affine[:3, 3]
    difference = values[tuple(index.T)] - phantom.values(world, pose).reshape(1500, 400).mean(axis=1)
    assert np.abs(difference).max() < most
    assert abs(difference.mean()) < mean


def test_later_shapes_replace_and_none_leaves():
    water, hot = PAINTING.shapes[:2]
    phantom = mph.ShapePhantom([water, hot])
    inside = [[12.0, 3.0, -4.0], [-20.0, 0.0, 0.0], [100.0, 0.0, 0.0]]
    assert phantom.values(inside).tolist() == [10, 2, 0]
    assert phantom.values(inside, quantity="mu").tolist() == [0.015, 0.015, 0]
    assert mph.ShapePhantom([hot, water]).values(inside).tolist() == [2, 2, 0]
    names = [mesh.name for mesh in phantom.meshes()]
    assert names == ["water", "sphere 2"]
    np.testing.assert_allclose(phantom.meshes()[1].vertices.mean(axis=0), (12, 3, -4), atol=1e-9)


def test_an_axis_turns_the_shape():
    rod = mph.ShapePhantom([mph.Cylinder(radius=1, height=40, axis=(3, 0, 4), position=(5, 0, 0), activity=1)])
    assert rod.values([[5 + 0.6 * 19, 0, 0.8 * 19], [5 + 0.6 * 21, 0, 0.8 * 21], [5, 0, 19]]).tolist() == [1, 0, 0]


NAMED = mph.ShapePhantom([mph.Sphere(radius=1 / 3, activity=1e-9, name='a "b" \\ \n\x7f\x00 µ 😀')], name="é")


@pytest.mark.parametrize("phantom", [*KINDS, NAMED], ids=title)
def test_phantoms_survive_as_text(phantom, tmp_path):
    path = tmp_path / "phantom.toml"
    mph.write_phantom(phantom, path)
    back = mph.read_phantom(path)
    assert back.shapes == tuple(phantom.shapes)
    assert (back.title, back.mu_energy) == (phantom.title, phantom.mu_energy)


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.toml")), ids=lambda path: path.stem)
def test_the_examples_are_phantoms(path):
    phantom = mph.read_phantom(path)
    assert phantom.total_activity > 0 and phantom.name
    assert len(phantom.shapes) == path.read_text().count("[[shape]]")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"expected one \[\[shape\]\] or more"),
        ("shape = 3", r"expected one \[\[shape\]\] or more"),
        ("shape = [1]", r"expected one \[\[shape\]\] or more"),
        ("[[shape]", "not TOML: .*line 1"),
        ("colour = 1\n[[shape]]\nkind = 'sphere'", "colour: no such key; expected name, mu_energy, shape"),
        ("[[shape]]\nradius = 1", "shape 1: kind: expected one of box, capsule, .*, got None"),
        ("[[shape]]\nkind = ['box']", "shape 1: kind: expected one of"),
        ("[[shape]]\nkind = 'blob'", "got 'blob'"),
        ("[[shape]]\nkind = 'sphere'\nname = 'left lung'\nactivity = 1", "shape 1 'left lung': radius: missing"),
        ("[[shape]]\nkind = 'sphere'\nradius = -1\nactivity = 1", "radius: expected more than 0 mm, got -1"),
        ("[[shape]]\nkind = 'sphere'\nradius = nan\nactivity = 1", "radius: nan is not a finite number"),
        ("[[shape]]\nkind = 'sphere'\nradius = '1'\nactivity = 1", "radius: expected real numbers"),
        ("[[shape]]\nkind = 'sphere'\nradius = 1", "activity, mu: expected at least one"),
        ("[[shape]]\nkind = 'sphere'\nradius = 1\nactivity = -2", "activity: expected 0 or more kBq/mL, got -2"),
        ("[[shape]]\nkind = 'sphere'\nradius = 1\nmu = -2", "mu: expected 0 or more 1/mm, got -2"),
        ("[[shape]]\nkind = 'sphere'\nradius = 1\nmu = 1\nmode = 'mix'", "mode: expected one of paint, add"),
        ("[[shape]]\nkind = 'sphere'\nradius = 1\nmu = 1\nradii = [1, 1, 1]", "radii: no such key"),
        ("[[shape]]\nkind = 'sphere'\nradius = 1\nmu = 1\nposition = [1, 2]", "position: expected shape 3, got 2"),
        ("[[shape]]\nkind = 'sphere'\nradius = 1\nmu = 1\naxis = [0, 0, 0]", "axis: expected a direction"),
        ("[[shape]]\nkind = 'sphere'\nradius = 1\nmu = 1\neuler_degrees = 5", "euler_degrees: expected 3 numbers"),
        ("[[shape]]\nkind = 'sphere'\nradius = 1\nmu = 1\neuler_degrees = [1]", "euler: expected shape 3, got 1"),
        ("[[shape]]\nkind = 'sphere'\nradius = 1\nmu = 1\naxis = [1, 0, 0]\neuler_degrees = [1, 0, 0]", "got both"),
        ("[[shape]]\nkind = 'sphere'\nradius = 1\nmu = 1\ncut = [[0, 0, 0, 1]]", "cut: .* normal is 0 0 0"),
        ("[[shape]]\nkind = 'sphere'\nradius = 1\nmu = 1\ncut = [[0, 0, 1, -2]]", "cut: nothing of the shape is left"),
        ("[[shape]]\nkind = 'sphere'\nradius = 1\nmu = 1\nname = 4", "name: expected a text"),
        ("[[shape]]\nkind = 'cylinder'\nradius = [1, 2, 3]\nheight = 1\nmu = 1", "radius: expected shape 2, got 3"),
        ("[[shape]]\nkind = 'cone'\nradius = 0\nheight = 1\nmu = 1", "radius: expected more than 0 mm"),
        ("mu_energy = 0\n[[shape]]\nkind = 'sphere'\nradius = 1\nmu = 1", "mu_energy: expected more than 0 keV"),
        ("[[shape]]\nkind = 'sphere'\nradius = true\nmu = 1", "radius: expected numbers or a text, got true or false"),
        ("[[shape]]\nkind = 'sphere'\nradius = 1\nmu = 1\nposition = [1, false, 1]", "position: .* got true or false"),
        (f"name = {'[' * 5000}{']' * 5000}", "its lists are nested too deeply"),
        ("name = 3\n[[shape]]\nkind = 'sphere'\nradius = 1\nmu = 1", "phantom name: expected a text"),
    ],
)
def test_texts_that_are_no_phantom_are_refused_in_one_line(text, message, tmp_path):
    path = tmp_path / "thorax.toml"
    path.write_text(text)
    with pytest.raises(mph.InputError, match=message) as error:
        mph.read_phantom(path)
    assert str(error.value).startswith(f"{path}: ") and "\n" not in str(error.value)


def test_files_that_are_no_text_are_refused(tmp_path):
    (tmp_path / "b.toml").write_bytes(b"\xff\xfe\x00")
    for call, message in (
        (lambda: mph.read_phantom(tmp_path / "none.toml"), "no such file"),
        (lambda: mph.read_phantom(tmp_path), "is a folder"),
        (lambda: mph.read_phantom(tmp_path / "b.toml"), "UTF-8"),
        (lambda: mph.write_phantom(PAINTING, tmp_path / "a.yaml"), r"ending in \.toml"),
        (lambda: mph.write_phantom(3, tmp_path / "a.toml"), "expected a Phantom, got int"),
    ):
        with pytest.raises(mph.InputError, match=message):
            call()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: mph.ShapePhantom([]), "expected one shape or more"),
        (lambda: mph.ShapePhantom(3), "expected a list of shapes, got int"),
        (lambda: mph.ShapePhantom([SHAPES[0], "x"]), "expected shapes, got str as number 2"),
        (lambda: mph.NemaBody(sphere_diameters=(1, 2)), "NEMA body phantom: sphere diameters: expected shape 6, got 2"),
        (lambda: mph.NemaBody(background=-1), "NEMA body phantom: background: expected 0 or more kBq/mL, got -1"),
        (lambda: mph.JaszczakPhantom(radius=0), "Jaszczak phantom: radius: expected more than 0 mm"),
        (lambda: mph.JaszczakPhantom(rod_diameters=(300,) * 6), "Jaszczak phantom: Derenzo phantom: no rod"),
        (lambda: mph.DefrisePhantom(disks=2.5), "disks: expected a whole number of at least 1, got 2.5"),
        (lambda: mph.SheppLogan(contrast="high"), "contrast: expected one of modified, original, got 'high'"),
        (lambda: mph.PointGrid(counts=(1000, 1000, 1000)), "at most 10000 points"),
        (lambda: mph.CardiacTorso(phase=1), "phase: expected less than 1, got 1"),
        (lambda: mph.CardiacTorso(defect_from=0.9), "defect from: expected less than 0.8, got 0.9"),
        (lambda: mph.CardiacTorso(defect_severity=7), "defect severity: expected at most 1, got 7"),
        (lambda: mph.CardiacTorso(end_systolic_volume=200), "end systolic volume: expected at most 120, got 200"),
        (lambda: mph.CardiacTorso().beating(0), "frames of the cycle"),
        (lambda: mph.NemaBody(sphere_diameters=(500,) * 6), "phantom: sphere diameters: .* in the body, got 500"),
        (lambda: mph.NemaBody(sphere_diameters=(10, 13, 17, 22, 55, 60)), "of 55 and 60 mm overlap: .* 57.2 mm apart"),
        (lambda: mph.NemaBody(sphere_diameters=(0, 0, 150, 0, 0, 0)), "at most 140 mm beneath the lid, got 150"),
        (lambda: mph.NemaBody(lung_diameter=80), "diameters: expected at most 34.4 mm beside a lung insert of 80"),
        (lambda: mph.NemaBody(lung_diameter=300), "lung diameter: expected at most 224 mm in the body, got 300"),
        (lambda: mph.NemaBody(length=80), "length: expected at least 81 mm around a sphere of 22 mm, got 80"),
        (lambda: mph.JaszczakPhantom(sphere_ring_radius=120), "sphere ring radius: expected at most 108 mm"),
        (lambda: mph.JaszczakPhantom(sphere_height=300), "sphere height: expected at most 186 mm in the cylinder"),
        (lambda: mph.JaszczakPhantom(sphere_height=180), "at most 12 mm at 6 mm below the top, got 31.8"),
        (lambda: mph.JaszczakPhantom(sphere_height=10), "at most 20 mm at 10 mm above the base, got 31.8"),
        (lambda: mph.JaszczakPhantom(sphere_ring_radius=20), "spheres of 9.5 and 31.8 mm overlap: .* 20 mm apart"),
        (lambda: mph.JaszczakPhantom(rod_height=190), "rod height: expected at most 186 mm in the cylinder, got 190"),
        (lambda: mph.DefrisePhantom(spacing=5), "disk thickness: expected at most 5 mm from disk to disk, got 8"),
        (lambda: mph.PointGrid((2, 1, 1), (3, 1, 1), 4), "diameter: expected at most 3 mm from point to point, got 4"),
        (lambda: mph.CardiacTorso(body_radii=(100, 80)), "body radii of 100 and 80 mm: the right lung reaches out"),
        (lambda: mph.CardiacTorso(ventricle_length=400), "ventricle length of 400 mm, .* reaches out of the body"),
        (
            lambda: mph.ShapePhantom([SHAPES[0], mph.Sphere(radius=9, activity=-1, mode="add", name="hole")]),
            "shape 2 'hole': activity: -1 kBq/mL added leaves -1 at .* mm; expected 0 or more",
        ),
        (lambda: mph.DerenzoPhantom(40, (8, 6, 5), 30, sectors=1), "Derenzo sectors: expected a whole number"),
        (lambda: mph.DerenzoPhantom(40, (8,) * 6, 30, 0), "or 0 in a cylinder with a background"),
        (lambda: mph.DerenzoPhantom(40, (8,) * 6, 30, background=1), "Derenzo cylinder radius"),
        (lambda: mph.DerenzoPhantom(40, (8,) * 6, 30, cylinder_radius=30), "radius of 40 mm and a height of 30 mm"),
        (lambda: PAINTING.values(np.zeros((1, 3)), quantity="hu"), "quantity 'hu': expected one of activity, mu"),
        (lambda: PAINTING.values(np.zeros((1, 3)), np.zeros((4, 4))), "phantom pose"),
        (lambda: PAINTING.line_integrals(np.zeros((2, 3)), np.zeros((3, 3))), "2 sources but 3 targets"),
        (lambda: PAINTING.line_integrals(np.zeros((2, 2)), np.zeros((2, 3))), "sources: expected shape"),
        (lambda: PAINTING.line_integrals([[0, 0, 0], [0]], np.zeros((2, 3))), "sources: expected real numbers"),
        (lambda: PAINTING.project(None), "project: expected a Views, got NoneType"),
        (lambda: PAINTING.voxelize((8, 8, 8)), "voxelize: expected a Grid, got tuple"),
        (lambda: PAINTING.voxelize(mph.Grid.centered(10**5, 1e-3)), "100000 x 100000 voxels needs .* GiB of memory"),
        (lambda: mph.Cylinder(radius=[[1], [2, 3]], height=1, mu=1), "radius: expected real numbers"),
        (lambda: mph.Sphere(radius=1, mu=1, cut=[[1, 0, 0], [0]]), "cut: expected real numbers"),
        (lambda: mph.random_pose(1, box=[[1], [2, 3]]), "box of random poses: expected real numbers"),
        (lambda: mph.random_pose("x"), "seed: expected a whole number"),
        (lambda: mph.random_pose(1, box=(1, -2, 3)), "box of random poses: expected 0 or more mm, got -2"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(make, message):
    with pytest.raises(mph.InputError, match=message) as error:
        make()
    assert "\n" not in str(error.value)


@pytest.mark.long
def test_what_just_fits_is_made_and_holds_its_parts():
    body, ball = np.pi * (147**2 + 77**2) / 2 + 140 * 77, np.pi / 6  # mm^2; times the diameter's cube
    cylinder, none = np.pi * 108**2 * 186, (0,) * 6
    large = mph.NemaBody(sphere_diameters=(0, 0, 140, 0, 0, 0), lung_diameter=0, length=140)
    touching = mph.NemaBody(sphere_diameters=(57.2,) * 6, lung_diameter=57.2)
    spheres = mph.JaszczakPhantom(sphere_diameters=(54,) * 6, sphere_height=159, rod_height=132)
    single = {"sphere_diameters": (*none[1:], 186), "sphere_ring_radius": 0, "sphere_height": 93}
    for phantom, content in (
        (large, 5.3 * 140 * body + 15.9 * ball * 140**3),
        (mph.NemaBody(sphere_diameters=none, lung_diameter=224, length=1), 5.3 * (body - np.pi * 112**2)),
        (touching, 5.3 * 180 * (body - np.pi * 28.6**2) + 6 * 15.9 * ball * 57.2**3),
        (spheres, 50 * (cylinder - spheres.shapes[1].volume - 6 * ball * 54**3)),
        (mph.JaszczakPhantom(**single, rod_diameters=none), 50 * (cylinder - ball * 186**3)),
        (mph.DefrisePhantom(4, spacing=8), 100 * 4 * np.pi * 50**2 * 8),
        (mph.PointGrid((2, 1, 3), (5, 0.1, 5), 5), 6 * 100e3),
        (mph.ShapePhantom([SHAPES[0], mph.Sphere(radius=7, activity=-1, mode="add")]), 0),
    ):
        assert phantom.total_activity == pytest.approx(content * 1e-3, rel=3e-4, abs=1e-9), phantom
    assert mph.CardiacTorso(body_radii=(155, 105)).shapes[0].radius == (155, 105)
    assert mph.JaszczakPhantom(rod_height=186, sphere_diameters=none, sphere_height=999).shapes[1].height == 186


def test_totals_are_what_the_layers_over_a_shape_leave_of_it():
    """In closed form: the lens of two balls; and 0 for a shape that is completely covered, however small it is."""
    r, big, apart = 3.0, 100.0, 101.0
    lens = np.pi * (big + r - apart) ** 2 * (apart**2 + 2 * apart * (r + big) - 3 * (r - big) ** 2) / (12 * apart)
    small = mph.Sphere(radius=r, activity=7, position=(1, 2, 3))
    direction = np.array([2.0, -1, 2]) / 3
    cover = mph.Sphere(radius=big, activity=0, position=direction * apart + small.position)
    left = mph.ShapePhantom([small, cover]).total_activity
    assert left == pytest.approx(7e-3 * (4 / 3 * np.pi * r**3 - lens), rel=2e-3)
    outer = dataclasses.replace(cover, position=(20, 0, 0))
    assert mph.ShapePhantom([small, outer]).total_activity == 0
    # The other way around: the small one replaces its part of the big one.
    both = mph.ShapePhantom([dataclasses.replace(cover, activity=1), small])
    expected = 4 / 3 * np.pi * (big**3 + 7 * r**3) - lens
    assert 1e3 * both.total_activity == pytest.approx(expected, abs=2e-3 * r**3)
    many = [dataclasses.replace(small, position=(x, 0, 0)) for x in range(-6, 7, 2)]
    hot = dataclasses.replace(outer, activity=2)
    alone = mph.ShapePhantom([hot]).total_activity
    assert mph.ShapePhantom([*many, hot]).total_activity == pytest.approx(alone, rel=1e-6)


def test_a_phantom_beyond_the_grid_is_said():
    with pytest.warns(mph.InputWarning, match="of the Shepp-Logan phantom lies outside the grid"):
        mph.SheppLogan().voxelize(mph.Grid.centered(16, 4.0))


def test_random_poses_are_uniform_and_reproducible():
    rng = np.random.default_rng(5)
    poses = np.array([mph.random_pose(rng, (10, 20, 0), center=(1, 2, 3)) for _ in range(4000)])
    first = np.random.default_rng(5)
    assert np.array_equal(mph.random_pose(first, (10, 20, 0), (1, 2, 3)), poses[0])
    assert np.array_equal(mph.random_pose(5, (10, 20, 0), (1, 2, 3)), poses[0])
    for side in (4, 4.0, np.int64(4), np.float32(4)):
        assert np.array_equal(mph.random_pose(1, box=side), mph.random_pose(1, box=(4, 4, 4)))
    moved = poses[:, :3, 3] - [1, 2, 3]
    assert np.all(np.abs(moved) <= [5, 10, 0]) and np.all(moved.std(axis=0) == pytest.approx([2.89, 5.77, 0], rel=0.05))
    # theta uniform, so that the axis' z component is an arcsine: its square has mean 1/2, not 1/3.
    assert np.mean(poses[:, 2, 2] ** 2) == pytest.approx(0.5, abs=0.02)
    np.testing.assert_allclose(np.linalg.det(poses[:, :3, :3]), 1)


def test_nema_body_is_as_the_standard_says():
    phantom = mph.NemaBody()
    area = np.pi * 147**2 / 2 + np.pi * 77**2 / 2 + 140 * 77
    inserts = np.pi * 25**2 * 180 * 1e-3
    spheres = np.pi / 6 * np.sum(np.array([10, 13, 17, 22, 28, 37.0]) ** 3) * 1e-3
    expected = 5.3 * (area * 0.18 - inserts - spheres) + 21.2 * spheres
    assert phantom.total_activity == pytest.approx(expected, rel=3e-4)
    assert phantom.values([[57.2, 0, 0], [57.2, 0, 9], [0, 0, 0], [0, 0, 71]]).tolist() == [21.2, 5.3, 0, 0]


def test_jaszczak_rods_are_cold_and_two_diameters_apart():
    phantom = mph.JaszczakPhantom()
    rods = next(shape for shape in phantom.shapes if isinstance(shape, mph.DerenzoRods)).rods
    for sector, diameter in enumerate(phantom.rod_diameters):
        mine = rods[rods[:, 0] == sector, 1:3]
        gaps = np.linalg.norm(mine[:, None] - mine[None], axis=2)
        assert np.min(gaps[gaps > 0]) == pytest.approx(2 * diameter)
    assert np.all(np.hypot(rods[:, 1], rods[:, 2]) + rods[:, 3] / 2 < 108)
    x, y = rods[0, 1:3]
    assert phantom.values([[x, y, -50], [x, y, 0], [0, -54, 34]]).tolist() == [0, 50, 0]


def test_shepp_logan_adds_up():
    points = np.array([[0, 0.9, 0], [0, -0.5, 0], [0.22, 0, 0], [0, 0.4, -0.15], [0, 0.1, 0.25]]) * 75
    assert mph.SheppLogan().values(points) == pytest.approx([100, 20, 0, 30, 30], abs=1e-9)
    assert mph.SheppLogan().values(points, quantity="mu") / 0.0154 == pytest.approx([2, 1.02, 1, 1.03, 1.03])


def test_points_hold_their_activity_on_any_voxels():
    phantom = mph.PointGrid((3, 1, 2), (16, 1, 24), 0.5, point_activity=7)
    volume = phantom.voxelize(mph.Grid.centered((11, 3, 11), 4.0))
    assert np.count_nonzero(volume.array) >= 6
    assert total(volume) == pytest.approx(6 * 7, rel=1e-6)


def test_the_heart_beats_with_its_muscle_and_apex_kept():
    frames = mph.CardiacTorso(defect_severity=0.4).beating(20)
    volumes = [frame.ventricle_volume for frame in frames]
    assert volumes[0] == 120 and volumes[7] == pytest.approx(45) and np.argmin(volumes) == 7
    muscles, apexes = [], []
    for frame in (*frames[::4], frames[7]):
        parts = {shape.name: shape for shape in frame.shapes}
        assert parts["left ventricle"].volume == pytest.approx(frame.ventricle_volume * 1e3, rel=1e-4)
        muscles.append(parts["myocardium"].volume - parts["left ventricle"].volume)
        pose = parts["myocardium"].pose
        apexes.append(pose[:3, 3] + pose[:3, 2] * parts["myocardium"].radii[2])
    np.testing.assert_allclose(muscles, muscles[0], rtol=1e-4)
    np.testing.assert_allclose(apexes, np.broadcast_to(apexes[0], (6, 3)), atol=1e-9)
    assert muscles[0] * 1.05e-3 == pytest.approx(133, abs=1)  # g


@pytest.mark.parametrize("width", [60, 170, 250, 360])
def test_defects_lie_where_they_are_placed(width):
    torso = mph.CardiacTorso(
        defect_severity=0.75, defect_angle_degrees=90, defect_width_degrees=width, defect_from=0.2, defect_to=0.6,
        defect_transmural=0.5,
    )  # fmt: skip
    heart = next(shape for shape in torso.shapes if shape.name == "myocardium").pose
    angle = np.deg2rad(np.arange(0.5, 360))
    z = 0.4 * 89.5
    inner, outer = (r * np.sqrt(1 - (z / length) ** 2) for r, length in ((26.76, 80.0), (36.26, 89.5)))
    for share, reached in ((0.2, True), (0.8, False)):
        ring = inner + share * (outer - inner)
        points = np.stack([ring * np.sin(angle), ring * np.cos(angle), np.full_like(angle, z)])
        values = torso.values((heart[:3, :3] @ points + heart[:3, 3:]).T)
        turned = np.abs((np.rad2deg(angle) - 90 + 180) % 360 - 180)
        assert np.array_equal(values, np.where((turned < width / 2) & reached, 22.5, 90.0))


def test_the_torso_fits_into_the_scanner(scanner):
    torso = mph.CardiacTorso()
    assert not torso.values(scanner.centers, quantity="mu").any()
    ventricle = next(mesh for mesh in torso.meshes() if mesh.name == "myocardium")
    assert np.linalg.norm(ventricle.vertices, axis=1).max() < 75
    # The patient's left and front, -x and +y, face the modules.
    assert scanner.centers[:, 1].mean() > 0 > scanner.centers[:, 0].mean()


@pytest.mark.parametrize("kind", kinds.KINDS, ids=lambda kind: kind.name)
def test_box_of_every_kind_holds_its_shapes_closely(kind):
    phantom = kind.phantom(**kind.usual)
    points = np.concatenate([mesh.vertices for mesh in phantom.meshes()])
    low, high = phantom.box
    assert np.all(points >= low - 1e-9) and np.all(points <= high + 1e-9)
    side = (high - low).max()
    assert np.ptp(points, axis=0).max() > 0.75 * side
