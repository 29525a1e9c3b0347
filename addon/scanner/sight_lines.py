"""Sight lines of modules, drawn in the 3D views and never rendered: principal rays, fields of view, virtual detectors.

The active module's collimator and crystal are tinted.
"""

import bpy
import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader
from numpy.typing import NDArray

from ...core.geometry.system import PinholeSystem
from ..blender import objects, windows
from . import cameras, following, module_values, scanner, selection

# Colour of the lines, and pairs of indices into the points of `lines` that they join, by setting.
_LINES = {
    "show_rays": ((1.0, 0.75, 0.2, 0.9), [(0, 5)]),
    "show_frustums": ((0.45, 0.8, 1.0, 0.35), [(0, 1), (0, 2), (0, 3), (0, 4)]),
    "show_detectors": ((0.45, 0.8, 1.0, 0.9), [(1, 2), (2, 3), (3, 4), (4, 1)]),
}
_TINT, _ENLARGED = (1.0, 0.55, 0.1, 0.3), 1.004  # colour of the active module's parts, and how much larger it is drawn
_WIDTH = 1.5  # of the lines, pixels
_CORNERS = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])


def lines(context: bpy.types.Context) -> dict[str, NDArray[np.float64]]:
    """Return the ends (N, 2, 3) of the lines, world mm, by setting that is on.

    A ray ends at the virtual detector of the panel's magnification; a frustum's edges lead to its corners.
    """
    scene = context.scene
    state, collection = scene.mphdrr_geometry, scanner.active_scanner(scene)
    names = [name for name in _LINES if getattr(state, name)]
    if collection is None or not names:
        return {}
    active = selection.active_module(context)
    candidates = following.modules(collection) if state.sight_all else [active] if active else []
    visible = [camera for camera in candidates if camera.visible_get()]
    # A pinhole's virtual detector is drawn magnified; another kind's detector is drawn where it stands.
    scale = scene.mphdrr_projections.magnification if module_values.kind_of(collection) is PinholeSystem else 1.0
    fields = scale * np.array([cameras.field_of(o.data) for o in visible]).reshape(-1, 5)
    local = np.zeros((len(visible), 6, 3))  # source, four corners of the detector, its centre
    local[:, 1:] = (fields[:, :3] * [1, 1, -1])[:, None]
    local[:, 1:5, :2] += _CORNERS * fields[:, None, 3:] / 2
    matrices = objects.world_matrices(visible)
    points = local @ matrices[:, :3, :3].transpose(0, 2, 1) + matrices[:, None, :3, 3]
    return {name: points[:, _LINES[name][1]].reshape(-1, 2, 3) for name in names}


def active_faces(context: bpy.types.Context) -> NDArray[np.float64]:
    """Return the triangles (N, 3, 3), world mm, of the active module's visible collimator and crystal."""
    camera = selection.active_module(context)
    triangles = [np.empty((0, 3, 3))]
    for part in camera.children if camera is not None else ():
        if part.mphdrr_module.part not in ("COLLIMATOR", "CRYSTAL") or not part.visible_get():
            continue
        mesh, matrix = part.data, np.array(part.matrix_world)
        points = np.empty((len(mesh.vertices), 3), np.float32)
        corners = np.empty((len(mesh.loop_triangles), 3), np.int32)
        mesh.vertices.foreach_get("co", points.reshape(-1))
        mesh.loop_triangles.foreach_get("vertices", corners.reshape(-1))
        center = points.mean(axis=0)
        points = center + _ENLARGED * (points - center)
        triangles.append((points @ matrix[:3, :3].T + matrix[:3, 3])[corners])
    return np.concatenate(triangles)


def draw() -> None:
    """Draw the sight lines and the active module's tint; Blender calls this for every 3D view."""
    context = bpy.context
    if not context.space_data.overlay.show_overlays:
        return
    gpu.state.blend_set("ALPHA")
    gpu.state.depth_test_set("LESS_EQUAL")
    if len(faces := active_faces(context)):
        shader = gpu.shader.from_builtin("UNIFORM_COLOR")
        shader.uniform_float("color", _TINT)
        gpu.state.face_culling_set("BACK")  # else parts that are seen through would be tinted twice
        batch_for_shader(shader, "TRIS", {"pos": faces.reshape(-1, 3).astype(np.float32)}).draw(shader)
        gpu.state.face_culling_set("NONE")
    for name, ends in lines(context).items():
        windows.draw_lines(ends.reshape(-1, 3).astype(np.float32), _LINES[name][0], _WIDTH)
    gpu.state.depth_test_set("NONE")
    gpu.state.blend_set("NONE")


def redraw(*_: object) -> None:
    """Have the 3D views drawn again after a setting was changed, perhaps by a script."""
    windows.redraw("VIEW_3D")
