"""The collimators' shapes, checked by trimesh, and their meshes in Blender."""

from __future__ import annotations

import bpy
import numpy as np
import pytest

from mphdrr.core.errors import InputError
from mphdrr.core.geometry.collimator import Collimator, Construction
from mphdrr.core.geometry.module_parts import check_watertight, collimator_solid, crystal_solid

trimesh = pytest.importorskip("trimesh")

SIZES = [  # d, l, Ld, plate, wall, opening angle, edge
    (2.3, 50.0, 50.0, 2.0, 2.0, 1.57, "middle"),
    (2.3, 89.07, 50.0, 5.0, 0.3, 1.2, "front"),
    (0.1, 0.8, 0.5, 0.05, 0.1, 1.57, "back"),
    (49.0, 20.0, 50.0, 19.9, 30.0, 0.04, "front"),
    (2.3, 20.0, 50.0, 8.0, 1.0, 2.0, "middle"),
    (30.0, 20.0, 50.0, 2.0, 1.0, 0.2, "back"),
]


def body(d, length, side, *construction) -> Collimator:
    return Collimator(d, length, side, Construction(*construction))


def as_trimesh(vertices: np.ndarray, faces: np.ndarray):
    return trimesh.Trimesh(vertices, trimesh.geometry.triangulate_quads(faces), process=False)


def frustum(a: float, b: float, height: float) -> float:
    """Return the volume between two parallel squares of sides a and b."""
    return height * (a * a + a * b + b * b) / 3


@pytest.mark.parametrize("size", SIZES)
def test_collimator_is_watertight_with_one_hole_and_has_the_volume_of_its_walls(size):
    solid = collimator_solid(body(*size))
    check_watertight(solid)
    mesh = as_trimesh(*solid)
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert mesh.euler_number == 0  # genus 1: the hole goes through
    d, length, side, plate, wall, angle, place = size
    front, back = {"middle": (plate / 2, plate / 2), "front": (0.0, plate), "back": (plate, 0.0)}[place]
    polygon = 64 / 2 * np.sin(2 * np.pi / 64)  # the hole is a polygon of 64 sides

    def cone(height: float) -> float:
        a, b = d / 2, d / 2 + height * np.tan(angle / 2)
        return polygon * height * (a * a + a * b + b * b) / 3

    corners = np.unique(solid[0].round(9), axis=0)
    half = {s: np.abs(corners[np.isclose(corners[:, 2], s), :2]).max() for s in (-front, back, length)}
    # The channel is never narrower than the pyramid from the hole to the crystal, the wall never thinner than requested.
    assert half[length] == pytest.approx(side / 2 + wall)
    channel = body(*size).channel_half_width
    assert channel >= d / 2 + (side - d) / 2 * back / length - 1e-9
    outside_at_back = np.interp(back, [-front, length], [half[-front], half[length]])
    assert outside_at_back - channel >= wall - 1e-9
    expected = (
        frustum(2 * half[-front], side + 2 * wall, length + front)
        - frustum(2 * channel, side, length - back)
        - cone(front)
        - cone(back)
    )
    assert mesh.volume == pytest.approx(expected)


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
        ((2.3, 50.0, 50.0, 48.0, 2.0), "thinner plate or a smaller angle"),
        ((2.3, 50.0, 50.0, 2.0, 0.0), "collimator wall"),
        ((2.3, 50.0, 50.0, 2.0, 2.0, 3.2), "opening_angle"),
        ((2.3, 50.0, 50.0, 2.0, 2.0, 1.0, "top"), "edge_at 'top'"),
        ((50.0, 50.0, 50.0, 2.0, 2.0), "pinhole diameter"),
    ],
)
def test_impossible_collimators_are_refused(size, what):
    with pytest.raises(InputError, match=what):
        body(*size)


def test_open_and_inverted_surfaces_are_refused():
    vertices, faces = collimator_solid(body(*SIZES[0]))
    with pytest.raises(InputError, match="not closed"):
        check_watertight((vertices, faces[1:]))
    with pytest.raises(InputError, match="volume"):
        check_watertight((vertices, faces[:, ::-1]))


def test_meshes_in_blender_are_closed_and_look_outwards_in_materials_for_every_view(ring):
    meshes = {o.data for o in ring.all_objects if o.mphdrr_module.part in {"COLLIMATOR", "CRYSTAL"}}
    for mesh in meshes:
        assert not mesh.validate(), "Blender had nothing to correct"
        vertices = np.array([v.co for v in mesh.vertices])
        faces = np.array([list(p.vertices) for p in mesh.polygons])
        shape = as_trimesh(vertices, faces)
        assert shape.is_watertight and shape.volume > 0
        assert len(mesh.materials) == 1 and mesh.materials[0] is not None
    for material in bpy.data.materials:
        if material.name.startswith("mphDRR"):
            shader = next(n for n in material.node_tree.nodes if n.type == "BSDF_PRINCIPLED")
            base = shader.inputs["Base Color"].default_value
            assert tuple(material.diffuse_color)[:3] == pytest.approx(tuple(base)[:3])
