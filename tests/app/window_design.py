"""Design in the window: keys and undo as a user's; leaves the window while a module is being moved."""

import bpy
from driving import WORKBOOK, drawn, editor, empty_scene, module, open_tab, opened, press, run, scanner, seen, within
from mathutils import Euler
from pointing import keys


def state(number: int) -> dict[str, object]:
    camera = module(number)
    crystal = next(c for c in camera.children if c.mphdrr_module.part == "CRYSTAL")
    values = {name: getattr(camera.mphdrr_module, name) for name in ("pinhole_distance", "collimator_length", "aimed")}
    return {
        "place": list(camera.location),
        **values,
        "sensitivity": camera.mphdrr_module.sensitivity,
        "crystal": min(v.co.z for v in crystal.data.vertices),
        "lens": camera.data.lens / camera.data.sensor_width,
        "total": scanner().mphdrr_scanner.sensitivity,
    }


def select(number: int) -> None:
    with within():
        bpy.ops.object.select_all(action="DESELECT")
        camera = module(number)
        camera.select_set(True)
        bpy.context.view_layer.objects.active = camera
        bpy.ops.ed.undo_push(message="Select")


def numbers() -> list[int]:
    return sorted(o.mphdrr_module.number for o in scanner().all_objects if o.mphdrr_module.is_module)


def meshes() -> int:
    return sum(o.mphdrr_module.part in {"COLLIMATOR", "CRYSTAL"} for o in scanner().all_objects)


def moved(number: int, by: tuple[float, float, float]):
    """Return a function: whether a module has moved by `by` from where it was at first, and its readouts with it."""
    start = seen["before"]["place"]

    def is_there() -> bool:
        camera = module(number)
        arrived = all(abs(x - x0 - d) < 1e-3 for x, x0, d in zip(camera.location, start, by, strict=True))
        return arrived and abs(camera.mphdrr_module.pinhole_distance - camera.location.length) < 1e-3

    return is_there


def steps():
    """Yield what to wait for: seconds, or a function that says when it has happened."""
    empty_scene()
    bpy.ops.mphdrr.import_geometry("EXEC_DEFAULT", True, filepath=str(WORKBOOK))
    opened("MPHDRR_PT_design")
    space = editor()[1].spaces.active
    space.show_region_ui = True
    view = space.region_3d
    view.view_distance, view.view_location = 620, (110, 40, 0)
    view.view_rotation = Euler((1.05, 0, 0.95)).to_quaternion()
    yield from drawn()
    open_tab()
    select(3)
    yield 1
    seen["before"] = state(3)

    keys("g", "x", "3", "0", "Return")
    yield moved(3, (30, 0, 0))
    seen["moved"] = state(3)
    keys("ctrl+z")
    yield moved(3, (0, 0, 0))
    seen["undone"] = state(3)
    keys("ctrl+shift+z")
    yield moved(3, (30, 0, 0))
    seen["redone"] = state(3)
    keys("ctrl+z")
    yield moved(3, (0, 0, 0))

    # A number typed in the panel or a script's operator: the undo step is taken before Blender evaluates the scene.
    press(bpy.ops.transform.translate, "EXEC_DEFAULT", value=(0, 0, 25))
    yield moved(3, (0, 0, 25))
    seen["translated"] = state(3)
    keys("ctrl+z")
    yield moved(3, (0, 0, 0))
    seen["translated_undone"] = state(3)

    keys("shift+d", "z", "4", "0", "Return")
    yield lambda: max(numbers()) == 81 and meshes() == 162
    seen["copied"] = {"numbers": numbers(), "parts": meshes(), "state": state(max(numbers()))}
    keys("ctrl+z")
    yield lambda: max(numbers()) == 80
    seen["adoption_undone"] = {"numbers": numbers(), "untidy": scanner().mphdrr_scanner.untidy}
    keys("ctrl+z")
    yield lambda: len(numbers()) == 80
    seen["copy_undone"] = {"numbers": numbers(), "parts": meshes(), "untidy": scanner().mphdrr_scanner.untidy}

    select(5)
    yield 1
    keys("Delete")
    yield lambda: len(numbers()) == 79 and meshes() == 158
    seen["deleted"] = {"numbers": numbers(), "parts": meshes()}
    keys("ctrl+z")
    yield lambda: meshes() == 160
    keys("ctrl+z")
    yield lambda: len(numbers()) == 80
    seen["delete_undone"] = {"numbers": numbers(), "parts": meshes(), "state": state(5)}

    select(3)
    bpy.context.scene.mphdrr_geometry.active_index = scanner().all_objects.find(module(3).name)
    yield 1
    keys("g", "x", "4", "0")  # still moving when the picture is taken
    yield moved(3, (40, 0, 0))
    seen["moving"] = state(3)


run(steps(), settle=0.7)
