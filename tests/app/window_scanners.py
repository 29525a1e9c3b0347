"""Two scanners in the window: a crystal clicked and grabbed by keys and mouse, each with one undo; it is left dragged."""

import bpy
import numpy as np
from bpy_extras.view3d_utils import location_3d_to_region_2d
from driving import WORKBOOK, drawn, editor, empty_scene, module, open_tab, press, run, seen, within
from mathutils import Matrix, Vector
from pointing import keys, on_screen, xdotool


def mouse(x: float, y: float, *then: str) -> None:
    """Move the mouse to a place of the 3D view; `then` are further commands of xdotool."""
    xdotool("mousemove", *on_screen(x, y), *then)


def part(name: str, number: int, kind: str):
    return next(o for o in module(number, bpy.data.collections[name]).children if o.mphdrr_module.part == kind)


def state() -> dict[str, object]:
    """Return places of module 30 of A and its crystal, the panels' scanner, and the listed and the active module."""
    camera, crystal = module(30, bpy.data.collections["A"]), part("A", 30, "CRYSTAL")
    geometry = bpy.context.scene.mphdrr_geometry
    on_camera = np.abs(np.array(camera.matrix_world) - np.array(crystal.matrix_world)).max()
    return {
        "place": list(camera.location),
        "turned": list(camera.rotation_euler),
        "aimed": camera.mphdrr_module.aimed,
        "distance": camera.mphdrr_module.pinhole_distance - camera.location.length,
        "off": float(on_camera),
        "panel": geometry.scanner.name,
        "listed": geometry.scanner.all_objects[geometry.active_index].mphdrr_module.number,
        "active": bpy.context.view_layer.objects.active.name,
    }


def moved(x: float, y: float, z: float):
    """Return a function: whether module 30 of A is that far from where it was at first, and at rest."""
    start = seen["before"]["place"]

    def is_there() -> bool:
        now = module(30, bpy.data.collections["A"]).location
        return all(abs(a - b - d) < 1e-3 for a, b, d in zip(now, start, (x, y, z), strict=True))

    return is_there


def look_at_back(name: str, number: int) -> None:
    """Look at a module's crystal from behind."""
    area = editor()[1]
    area.spaces.active.show_region_ui = True
    view, camera = area.spaces.active.region_3d, module(number, bpy.data.collections[name])
    view.view_rotation = (camera.matrix_world @ Matrix.Rotation(0.5, 4, "X")).to_quaternion()
    view.view_location, view.view_distance, view.view_perspective = camera.location, 500, "PERSP"


def view() -> list[float]:
    """Return the 3D view's clipping distances, its distance and its location."""
    space = editor()[1].spaces.active
    return [space.clip_start, space.clip_end, space.region_3d.view_distance, *space.region_3d.view_location]


def free_place(point: Vector) -> list[float]:
    """Return a point's place, from 0 to 1, in the part of the 3D view that toolbar and sidebar leave free."""
    _, area, region = editor()
    x, y = location_3d_to_region_2d(region, area.spaces.active.region_3d, point)
    tools, sidebar = (next(r for r in area.regions if r.type == kind).width for kind in ("TOOLS", "UI"))
    return [(x - tools) / (region.width - tools - sidebar), y / region.height]


def counts() -> dict[str, int]:
    return {kind: len(getattr(bpy.data, kind)) for kind in ("objects", "meshes", "cameras", "materials", "collections")}


def click_on(item) -> None:
    _, area, region = editor()
    middle = item.matrix_world @ (sum((Vector(v.co) for v in item.data.vertices), Vector()) / len(item.data.vertices))
    place = location_3d_to_region_2d(region, area.spaces.active.region_3d, middle)
    mouse(*place, "click", "1")


def steps():
    """Yield what to wait for: seconds, or a function that says when it has happened."""
    empty_scene()
    yield 1
    area = editor()[1]
    with within():
        bpy.ops.ed.undo_push(message="Start")
    area.spaces.active.show_region_ui = True
    yield 1
    open_tab()
    seen["views"] = [view()]
    bpy.ops.mphdrr.import_geometry("EXEC_DEFAULT", True, filepath=str(WORKBOOK), name="A")
    yield 1
    seen["views"].append(view())
    keys("ctrl+z")
    yield lambda: "A" not in bpy.data.collections
    seen["views"].append(view())
    keys("ctrl+shift+z")
    yield lambda: "A" in bpy.data.collections
    seen["views"].append(view())
    seen["middle"] = free_place(Vector())
    for name, first in (("A", 30), ("B", 60)):
        bpy.ops.mphdrr.import_geometry("EXEC_DEFAULT", True, filepath=str(WORKBOOK), name=name, replace=True)
        bpy.ops.mphdrr.show_modules(modules=str(first), mode="ONLY")
    yield from drawn()
    seen["imported"] = state()
    look_at_back("A", 30)
    yield from drawn()
    click_on(part("A", 30, "CRYSTAL"))
    yield lambda: state()["panel"] == "A" and state()["listed"] == 30
    seen["clicked"] = seen["before"] = state()

    keys("g", "x", "3", "0", "Return")
    yield moved(30, 0, 0)
    seen["moved"] = state()
    keys("ctrl+z")
    yield moved(0, 0, 0)
    seen["undone"] = state()
    keys("ctrl+shift+z")
    yield moved(30, 0, 0)
    seen["redone"] = state()
    keys("ctrl+z")
    yield moved(0, 0, 0)

    keys("g", "y", "2", "0")
    yield moved(0, 20, 0)
    seen["dragged"] = state()
    keys("Escape")
    yield moved(0, 0, 0)
    seen["cancelled"] = state()

    keys("r", "z", "3", "0", "Return")
    yield lambda: not module(30, bpy.data.collections["A"]).mphdrr_module.aimed
    seen["turned"] = state()
    keys("ctrl+z")
    yield lambda: module(30, bpy.data.collections["A"]).mphdrr_module.aimed
    seen["turned_back"] = state()

    keys("g", "z")  # the mouse, and its button before the last motion has been drawn
    region = editor()[2]
    for x in range(10, 130, 10):
        mouse(region.width // 2 + x, region.height // 2 + 2 * x)
    mouse(region.width // 2 + 150, region.height // 2 + 250, "click", "1")
    yield 2
    seen["by_mouse"] = state()
    keys("ctrl+z")
    yield moved(0, 0, 0)
    seen["by_mouse_undone"] = state()
    keys("ctrl+shift+z")
    yield 2
    seen["by_mouse_redone"] = state()
    keys("ctrl+z")
    yield moved(0, 0, 0)

    # A script: the undo step is taken before Blender evaluates the scene.
    press(bpy.ops.transform.translate, "EXEC_DEFAULT", value=(0, 0, 25))
    yield moved(0, 0, 25)
    seen["scripted"] = state()
    for _ in range(2):
        keys("ctrl+z")
        yield moved(0, 0, 0)
    seen["scripted_undone"] = state()

    with within():
        bpy.ops.object.select_all(action="DESELECT")
        item = part("B", 60, "COLLIMATOR")
        item.select_set(True)
        bpy.context.view_layer.objects.active = item
        bpy.ops.ed.undo_push(message="Select")
    yield lambda: state()["panel"] == "B" and state()["listed"] == 60
    seen["other"] = state()
    seen["counts"] = [counts()]
    bpy.ops.mphdrr.remove_scanner("EXEC_DEFAULT", True)
    yield 1
    seen["counts"].append(counts())
    keys("ctrl+z")
    yield lambda: "B" in bpy.data.collections and state()["panel"] == "B"
    seen["counts"].append(counts())
    seen["back"] = state()
    geometry = bpy.context.scene.mphdrr_geometry
    geometry.show_rays = geometry.show_frustums = geometry.show_detectors = True
    look_at_back("B", 60)
    start = module(60, bpy.data.collections["B"]).location.copy()
    keys("g", "x", "4", "0")  # still moving when the picture is taken
    yield lambda: (module(60, bpy.data.collections["B"]).location - start - Vector((40, 0, 0))).length < 1e-3
    editor()[1].spaces.active.region_3d.view_distance = 1500
    seen["moving"] = state()


run(steps(), settle=0.7)
