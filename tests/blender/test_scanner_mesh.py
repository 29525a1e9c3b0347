"""The collimators' shapes, by trimesh, and as they arrive in Blender."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from mathutils import Vector
from mathutils.bvhtree import BVHTree

from mphdrr.addon import scanner
from mphdrr.core.collimator_mesh import check_watertight, collimator_solid, crystal_solid, signed_volume
from mphdrr.core.errors import InputError

trimesh = pytest.importorskip("trimesh")

SIZES = [  # d, l, Ld, plate, wall
    (2.3, 50.0, 50.0, 2.0, 2.0),
    (2.3, 89.07, 50.0, 5.0, 0.3),
    (0.1, 0.8, 0.5, 0.05, 0.1),
    (49.0, 20.0, 50.0, 19.9, 30.0),
]


def as_trimesh(vertices: np.ndarray, faces: np.ndarray):
    return trimesh.Trimesh(vertices, trimesh.geometry.triangulate_quads(faces), process=False)


def frustum(a: float, b: float, height: float) -> float:
    """Volume between two parallel squares of sides a and b."""
    return height * (a * a + a * b + b * b) / 3


@pytest.mark.parametrize("size", SIZES)
def test_collimator_is_watertight_with_one_hole(size):
    solid = collimator_solid(*size)
    check_watertight(solid)
    mesh = as_trimesh(*solid)
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert mesh.euler_number == 0  # genus 1: the hole goes through
    assert mesh.volume > 0 and mesh.volume == pytest.approx(signed_volume(solid))


def test_collimator_has_the_volume_of_its_walls():
    d, length, side, plate, wall = 2.3, 60.0, 50.0, 2.0, 3.0
    inner_at_plate = d + (side - d) * plate / length
    circle = 32 / 2 * np.sin(2 * np.pi / 32) * (d / 2) ** 2  # the hole is a polygon of 32 sides
    expected = (
        frustum(d + 2 * wall, side + 2 * wall, length) - frustum(inner_at_plate, side, length - plate) - circle * plate
    )
    assert signed_volume(collimator_solid(d, length, side, plate, wall)) == pytest.approx(expected)


def test_every_ray_from_the_hole_to_the_crystal_is_free_and_the_plate_is_not():
    d, length, side, plate, wall = 2.3, 60.0, 50.0, 2.0, 2.0
    vertices, faces = collimator_solid(d, length, side, plate, wall)
    tree = BVHTree.FromPolygons(vertices.tolist(), faces.tolist())

    def is_hit(origin, direction) -> bool:
        return tree.ray_cast(Vector(origin), Vector(direction))[0] is not None

    assert not is_hit([0, 0, -50], [0, 0, 1])
    assert not is_hit([0.9, -0.9 / 2, -50], [0, 0, 1]), "beside the axis, but in the hole"
    assert is_hit([d / 2 + 0.5, 0, -50], [0, 0, 1]), "through the plate"
    for corner in ((1, 1), (-1, 1), (0.3, -1)):
        target = np.array([0.98 * corner[0] * side / 2, 0.98 * corner[1] * side / 2, length])
        middle_of_hole = np.array([0.0, 0.0, plate])
        assert not is_hit(middle_of_hole, target - middle_of_hole), "from the hole to the crystal's edge"


def test_crystal_is_a_box_behind_the_collimator():
    solid = crystal_solid(60.0, 50.0, 10.0)
    check_watertight(solid)
    mesh = as_trimesh(*solid)
    assert mesh.is_watertight and mesh.volume == pytest.approx(25000.0)
    assert mesh.bounds.tolist() == [[-25, -25, 60], [25, 25, 70]]


@pytest.mark.parametrize(
    ("size", "what"),
    [
        ((2.3, 50.0, 50.0, 50.0, 2.0), "aperture plate"),
        ((2.3, 50.0, 50.0, 0.0, 2.0), "aperture plate"),
        ((2.3, 50.0, 50.0, 2.0, 0.0), "collimator wall"),
        ((50.0, 50.0, 50.0, 2.0, 2.0), "pinhole diameter"),
    ],
)
def test_impossible_collimators_are_refused(size, what):
    with pytest.raises(InputError, match=what):
        collimator_solid(*size)


def test_open_and_inverted_surfaces_are_refused():
    vertices, faces = collimator_solid(*SIZES[0])
    with pytest.raises(InputError, match="not closed"):
        check_watertight((vertices, faces[1:]))
    with pytest.raises(InputError, match="volume"):
        check_watertight((vertices, faces[:, ::-1]))


def test_meshes_in_blender_are_closed_and_look_outwards(scene, dc_spect):
    collection = scanner.build_scanner(scene, dc_spect)
    meshes = {o.data for o in collection.all_objects if o.mphdrr_module.part in {"COLLIMATOR", "CRYSTAL"}}
    for mesh in meshes:
        assert not mesh.validate(), "Blender had nothing to correct"
        vertices = np.array([v.co for v in mesh.vertices])
        faces = np.array([list(p.vertices) for p in mesh.polygons])
        shape = as_trimesh(vertices, faces)
        assert shape.is_watertight and shape.volume > 0
        assert len(mesh.materials) == 1 and mesh.materials[0] is not None


def test_parts_have_materials_for_solid_and_rendered_view(scene, ring_system):
    scanner.build_scanner(scene, ring_system)
    for material in bpy.data.materials:
        if material.name.startswith("mphDRR"):
            shader = next(n for n in material.node_tree.nodes if n.type == "BSDF_PRINCIPLED")
            assert tuple(material.diffuse_color)[:3] == pytest.approx(
                tuple(shader.inputs["Base Color"].default_value)[:3]
            )
