"""An object's place is the one that Blender evaluates, whatever moves it: workbooks, projections, volumes, meshes take it.

https://github.com/KhronosGroup/glTF-Blender-IO/issues/447 (children elsewhere in exports),
https://github.com/X-Plane/XPlane2Blender/issues/199 (children of bones).
"""

from __future__ import annotations

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")

from mathutils import Matrix  # noqa: E402

import mphdrr.core as mph  # noqa: E402
from mphdrr.addon.blender import jobs, storage  # noqa: E402
from mphdrr.addon.scanner import scanner  # noqa: E402
from mphdrr.addon.volumes import meshes, volumes  # noqa: E402
from mphdrr.core.runs.files import read_run  # noqa: E402

from ..blender.conftest import move, registered, scene, select, update  # noqa: E402

__all__ = ["registered", "scene"]  # fixtures

# Columns of a module's axes in its camera's matrix: (u, v, k) = (-x, y, -z).
MODULE_AXES = np.diag([-1.0, 1.0, -1.0])


def moved(item):
    item.location, item.rotation_euler, item.scale = (3.0, -4.0, 5.0), (0.1, 0.2, 0.3), (1.0, 1.0, 1.0)
    return item


def curve(with_path: bool):
    bpy.ops.curve.primitive_bezier_circle_add(radius=100)
    item = moved(bpy.context.object)
    item.data.use_path = with_path
    return item, "OBJECT", ""


def bone():
    bpy.ops.object.armature_add()
    return moved(bpy.context.object), "BONE", bpy.context.object.data.bones[0].name


def mesh(kind: str):
    bpy.ops.mesh.primitive_cube_add(size=30.0)
    return moved(bpy.context.object), kind, ""


def other(type: str):
    bpy.ops.object.add(type=type)
    return moved(bpy.context.object), type, ""


PARENTS = {
    "object": lambda: mesh("OBJECT"), "vertex": lambda: mesh("VERTEX"), "three vertices": lambda: mesh("VERTEX_3"),
    "bone": bone, "armature": lambda: other("ARMATURE"), "lattice": lambda: other("LATTICE"),
    "curve": lambda: curve(False), "curve with path": lambda: curve(True),
}  # fmt: skip


def parent(item, name: str) -> None:
    """Give an object a parent of some kind that has been moved."""
    item.parent, item.parent_type, item.parent_bone = PARENTS[name]()
    if item.parent_type == "VERTEX_3":
        item.parent_vertices = (0, 1, 2)
    else:
        item.parent.delta_location = (0.5, 0.25, 0.125)


def constrain(item, kind: str) -> None:
    constraint = item.constraints.new(kind)
    if kind == "LIMIT_LOCATION":
        constraint.use_min_x, constraint.min_x = True, 7.0
    else:
        constraint.target = curve(True)[0]
        constraint.target.location.x = 150.0


def delta(item) -> None:
    item.delta_location, item.delta_rotation_euler = (1.5, -2.0, 0.75), (0.05, -0.1, 0.2)


def quaternion(item) -> None:
    item.rotation_mode = "QUATERNION"
    item.delta_rotation_quaternion = (0.9, 0.1, -0.3, 0.2)


def animate(item, frame: int = 7) -> None:
    item.keyframe_insert("location", frame=1)
    item.location.y += 20.0
    item.keyframe_insert("location", frame=10)
    bpy.context.scene.frame_set(frame)


def drive(item) -> None:
    item.driver_add("location", 1).driver.expression = "3.5 * frame + 100"
    bpy.context.scene.frame_set(5)


def animate_parent(item) -> None:
    parent(item, "object")
    animate(item.parent)


def follow_curve(item) -> None:
    """Parent an object to a curve along which it moves from frame to frame."""
    parent(item, "curve with path")
    data = item.parent.data
    data.path_duration, data.use_path_follow = 40, True
    for frame in (1, 41):
        data.eval_time = frame - 1
        data.keyframe_insert("eval_time", frame=frame)
    bpy.context.scene.frame_set(17)


def chain(item) -> None:
    parent(item, "bone")
    parent(item.parent, "three vertices")
    constrain(item.parent.parent, "LIMIT_LOCATION")


def mirror_parent(item) -> None:
    parent(item, "object")
    item.parent.scale = (1.0, -1.0, 1.0)


PLACES = {
    **{f"parent: {name}": lambda item, name=name: parent(item, name) for name in PARENTS},
    **{kind: lambda item, kind=kind: constrain(item, kind) for kind in ("COPY_LOCATION", "FOLLOW_PATH", "LIMIT_LOCATION")},
    "delta": delta, "quaternions": quaternion, "animation": animate, "driver": drive, "animated parent": animate_parent,
    "along a curve": follow_curve, "chain": chain, "mirrored parent": mirror_parent,
}  # fmt: skip
places = pytest.mark.parametrize("place", PLACES.values(), ids=list(PLACES))


def evaluated(item) -> np.ndarray:
    """Return the matrix at which Blender has the object."""
    return np.array(item.evaluated_get(bpy.context.evaluated_depsgraph_get()).matrix_world)


@pytest.fixture
def pair(scene):
    system = mph.PinholeSystem(np.array([[200.0, 0, 0], [0, 210.0, 5.0]]), 2.0, 60.0, 40.0, 9.0, 75.0)
    return scanner.build_scanner(scene, system, "Pair")


@pytest.fixture
def box():
    return volumes.add_volume(mph.Volume(np.ones((3, 4, 5), np.float32), mph.Grid.centered((3, 4, 5), 2.0)), "Box")


@places
def test_workbooks_and_projections_have_modules_where_blender_has_them(pair, box, tmp_path, place):
    camera = scanner.module(pair, 1)
    place(camera)
    update()
    before = evaluated(camera)
    path = tmp_path / "w.xlsx"
    assert bpy.ops.mphdrr.export_geometry(filepath=str(path)) == {"FINISHED"}
    select(box)
    assert bpy.ops.mphdrr.render_projections(width=8, height=6) == {"FINISHED"}
    run = read_run(storage.absolute(bpy.context.scene.mphdrr_projections.run_file))
    after = evaluated(camera)
    np.testing.assert_allclose(after, before, atol=1e-5, err_msg="exports move nothing")
    axes = after[:3, :3] @ MODULE_AXES
    axes[:, 0] *= np.sign(np.linalg.det(axes))  # a mirrored module is itself with +u to the other side
    for system in (mph.read_system(path), run.system):
        np.testing.assert_allclose(system.centers[0], after[:3, 3], atol=2e-5)
        np.testing.assert_allclose(system.frames()[0], axes.T, atol=1e-5)
        np.testing.assert_allclose(system.centers[1], (0, 210, 5), atol=1e-9)


@places
def test_volumes_and_meshes_are_where_blender_has_them(box, place):
    local = volumes.volume_from_object(box).grid.affine
    place(box)
    np.testing.assert_allclose(volumes.volume_from_object(box).grid.affine, evaluated(box) @ local, atol=2e-5)
    bpy.ops.mesh.primitive_cube_add(size=10.0)
    cube = bpy.context.object
    place(cube)
    ((_, [surface]),) = meshes.evaluated_meshes([cube], bpy.context.evaluated_depsgraph_get())
    corners = np.array([vertex.co for vertex in cube.data.vertices])
    expected = corners @ evaluated(cube)[:3, :3].T + evaluated(cube)[:3, 3]
    np.testing.assert_allclose(surface.vertices, expected, atol=2e-5)
    assert surface.volume == pytest.approx(1000.0, rel=1e-5)


@pytest.mark.parametrize("place", [delta, quaternion, mirror_parent, lambda item: parent(item, "object")])
def test_keep_aimed_turns_a_module_that_is_moved_and_changes_nothing_else(pair, place):
    camera = scanner.module(pair, 1)
    place(camera)
    camera.scale = (1.0, 1.0, 1.25)
    update()
    location, scale, offset = (getattr(camera, x).copy() for x in ("location", "scale", "delta_rotation_euler"))
    location.z += 13.7
    move(camera, z=13.7)
    assert camera.mphdrr_module.aimed and scanner.unaimed_numbers(pair, [camera]) == []
    assert (camera.location, camera.scale, camera.delta_rotation_euler) == (location, scale, offset)
    assert evaluated(camera)[:3, :3] @ [0, 0, 1] / 1.25 == pytest.approx(
        evaluated(camera)[:3, 3] / np.linalg.norm(evaluated(camera)[:3, 3]), abs=1e-5
    )


@pytest.mark.parametrize("name", sorted(set(PARENTS) - {"object", "curve"}))
def test_keep_aimed_leaves_what_its_parent_carries(pair, name):
    camera = scanner.module(pair, 1)
    rotation = camera.rotation_euler.copy()
    parent(camera, name)
    for _ in range(3):
        update()
        move(camera.parent, x=4.0)
    scanner.read_scanner(pair)
    assert camera.rotation_euler == rotation and not camera.mphdrr_module.aimed
    scanner.aim_modules(pair)  # asked for
    scanner.aim_modules(pair)
    update()
    assert camera.mphdrr_module.aimed and camera.location[:] == (200.0, 0.0, 0.0)


@pytest.mark.parametrize("kept_in_place", [False, True])
@pytest.mark.parametrize("place", [(0.0, 0.0, 0.0), (10.3, -7.7, 0.4)])
@pytest.mark.parametrize("typed", [(200.1, 0.1, -0.3), (0.7, 180.9, 33.33), (-3.3, 150.2, 0.0)])
def test_decimals_typed_stay_under_parents(pair, tmp_path, typed, place, kept_in_place):
    camera, bench = scanner.module(pair, 1), bpy.data.objects.new("Bench", None)
    bpy.context.scene.collection.objects.link(bench)
    bench.location = place
    if kept_in_place:
        bench.rotation_euler = (0.3, -1.1, 2.0)
    update()
    camera.parent = bench
    if kept_in_place:  # as Ctrl+P does it
        camera.matrix_parent_inverse = bench.matrix_world.inverted()
        place = (0.0, 0.0, 0.0)
    camera.location = typed
    camera.delta_location.z = 0.2
    update()
    assert bpy.ops.mphdrr.export_geometry(filepath=str(tmp_path / "w.xlsx")) == {"FINISHED"}
    expected = [round(a + b + c, 9) for a, b, c in zip(typed, place, (0, 0, 0.2), strict=True)]
    assert mph.read_system(tmp_path / "w.xlsx").centers[0].tolist() == expected


@pytest.mark.parametrize("name", PARENTS)
def test_decimals_typed_stay_under_parents_of_all_types(pair, name):
    camera = scanner.module(pair, 1)
    parent(camera, name)
    camera.parent.matrix_basis = Matrix()
    camera.parent.delta_location = (0, 0, 0)
    camera.location = (0, 0, 0)
    update()
    offset = np.round(evaluated(camera)[:3, 3], 5)
    camera.location = (200.1, 0.1, -0.3)
    update()
    turn = evaluated(camera)[:3, :3] @ np.linalg.inv(np.array(camera.matrix_basis)[:3, :3])
    if np.allclose(turn, np.rint(turn), atol=1e-6):  # else the decimals are others
        expected = [float(str(np.float32(x))) for x in np.rint(turn) @ (200.1, 0.1, -0.3) + offset]
        assert scanner.read_scanner(pair).centers[0].tolist() == expected


@pytest.mark.parametrize("scale", [(-1, 1, 1), (1, -1, 1), (1, 1, -1), (-1, -1, -1), (-1, -1, 1), (-2.0, 0.5, 1)])
def test_a_mirrored_camera_is_no_tilt(pair, tmp_path, scale):
    camera = scanner.module(pair, 2)
    camera.scale = scale
    update()
    path = tmp_path / "w.xlsx"
    assert bpy.ops.mphdrr.export_geometry(filepath=str(path)) == {"FINISHED"}
    assert not mph.read_system(path).tilt.any() and camera.scale[:] == scale
    move(camera, z=8.0)
    assert camera.mphdrr_module.aimed and not scanner.read_scanner(pair).tilt.any() and camera.scale[:] == scale
    crystal = next(child for child in camera.children if child.mphdrr_module.part == "CRYSTAL")
    move(crystal, x=3.0)
    update()
    assert not scanner.read_scanner(pair).tilt.any() and camera.scale[:] == scale


@pytest.mark.parametrize("place", [drive, animate, chain, lambda item: constrain(item, "COPY_LOCATION")])
def test_hidden_objects_are_where_they_are_shown_or_refused(pair, box, tmp_path, place):
    """Blender does not evaluate all hidden objects."""
    camera, path = scanner.module(pair, 2), tmp_path / "w.xlsx"
    scanner.set_visible(camera, False)
    move(camera, z=4.0)
    assert scanner.read_scanner(pair).centers[1, 2] == 9.0
    box.hide_viewport = True
    place(camera)
    place(box)
    update()
    with pytest.raises(mph.InputError, match="'Box' is hidden"):
        volumes.volume_from_object(box)
    try:
        hidden = scanner.read_scanner(pair)
    except mph.InputError as error:
        assert f"'{camera.name}' is hidden" in str(error)
        hidden = None
    scanner.set_visible(camera, True)
    assert bpy.ops.mphdrr.export_geometry(filepath=str(path)) == {"FINISHED"}
    np.testing.assert_allclose(mph.read_system(path).centers[1], evaluated(camera)[:3, 3], atol=2e-5)
    assert hidden is None or np.allclose(hidden.centers[1], evaluated(camera)[:3, 3], atol=2e-5)


def test_a_mesh_made_from_a_placed_volume_lies_on_it(box):
    parent(box, "bone")
    update()
    jobs.run(meshes.mesh_job(box))
    surface = bpy.data.objects["Box surface"]
    update()
    np.testing.assert_allclose(evaluated(surface), evaluated(box), atol=2e-5)
