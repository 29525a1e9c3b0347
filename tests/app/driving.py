"""What the scripts in the window share: its editors, keys and mouse, pictures, and the steps that they take.

A script's arguments stand after ``--``: the folder for its files, then its own, `ARGUMENTS`. `seen` is what its test gets.
"""

import itertools
import json
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from types import ModuleType

import bpy
from bpy_extras.view3d_utils import location_3d_to_region_2d
from mathutils import Euler

folder, *ARGUMENTS = map(Path, sys.argv[sys.argv.index("--") + 1 :])
WORKBOOK = Path(bpy.utils.user_resource("EXTENSIONS")) / "user_default/mphdrr/examples/dc-spect-80.xlsx"
seen: dict = {"ok": False}
bpy.context.preferences.view.show_splash = False


def ours(name: str) -> ModuleType:
    """Return a module of the extension, such as ``"addon.runs.runs"``."""
    return import_module(f"bl_ext.user_default.mphdrr.{name}")


def editor(kind: str = "VIEW_3D"):
    """Return window, area and region of the largest editor of a kind."""
    window = bpy.context.window_manager.windows[0]
    area = max((a for a in window.screen.areas if a.type == kind), key=lambda a: a.width * a.height)
    return window, area, next(r for r in area.regions if r.type == "WINDOW")


def within(kind: str = "VIEW_3D"):
    """Return a context manager for the context of the largest editor of a kind."""
    window, area, region = editor(kind)
    return bpy.context.temp_override(window=window, area=area, region=region)


def press(operator: Callable, how: str = "INVOKE_DEFAULT", kind: str = "VIEW_3D", **settings: object) -> set[str]:
    """Call an operator as a button of an editor's sidebar does; INVOKE_DEFAULT starts a job."""
    with within(kind):
        return operator(how, True, **settings)


def sidebar(kind: str = "VIEW_3D"):
    """Return the region of an editor's sidebar."""
    return next(region for region in editor(kind)[1].regions if region.type == "UI")


def open_tab(kind: str = "VIEW_3D") -> None:
    """Show our tab, of a sidebar that has been drawn."""
    sidebar(kind).active_panel_category = "mphDRR"


def panels() -> list:
    """Return our panels' classes, each after the one that it is in."""
    found = [getattr(bpy.types, name) for name in dir(bpy.types) if name.startswith("MPHDRR_PT_")]
    return sorted(found, key=lambda cls: hasattr(cls, "bl_parent_id"))


def only(*names: str) -> None:
    """Remove all panels but these, and open these, so that all of them is on the screen."""
    for cls in reversed(panels()):
        if cls.__name__ not in names and "INSTANCED" not in getattr(cls, "bl_options", ()):
            bpy.utils.unregister_class(cls)
    opened(*names)


def opened(*names: str, but_closed: tuple[str, ...] = ()) -> None:
    """Have panels open from the start, with those that they are in, and others closed."""
    known = panels()
    to_open = {*names, *(getattr(cls, "bl_parent_id", "") for cls in known if cls.__name__ in names)}
    for cls in reversed(known):
        bpy.utils.unregister_class(cls)
    for cls in known:  # all of them: a panel that is registered again forgets those in it
        if cls.__name__ in (*to_open, *but_closed) and "INSTANCED" not in getattr(cls, "bl_options", ()):
            cls.bl_options = {"DEFAULT_CLOSED"} if cls.__name__ in but_closed else set()
        bpy.utils.register_class(cls)


def xdotool(*what: object) -> None:
    """Move the mouse or type, by xdotool's command line."""
    subprocess.run(["xdotool", *map(str, what)], check=True)


def proposed() -> str:
    """Return the text of the button at the top of the tab."""
    return ours("addon.next_step").next_step(bpy.context).text


def click_proposed(first: int = 44) -> None:
    """Click on the button at the tab's top; `first`: pixels from the sidebar's top to that button in an empty scene."""
    region, window = sidebar(), editor()[0]
    down = first if proposed() == "Load Example" else 160
    xdotool("mousemove", round(region.x + 0.4 * region.width), window.height - region.y - region.height + down)
    xdotool("click", 1)


def on_screen(x: float, y: float, kind: str = "VIEW_3D") -> tuple[int, int]:
    """Return the position on the screen of a place of an editor's region."""
    window, _, region = editor(kind)
    return round(region.x + x), round(window.height - 1 - region.y - y)


def frame(kind: str = "VIEW_3D") -> list[int]:
    """Return left, top, right and bottom of an editor's region on the screen."""
    region = editor(kind)[2]
    return [*on_screen(0, region.height, kind), *on_screen(region.width, 0, kind)]


def place(point) -> tuple[int, int]:
    """Return the position on the screen of a place in the world, in the 3D view."""
    region = editor()[2]
    return on_screen(*location_3d_to_region_2d(region, region.data, point))


def look(distance: float, angles=(0.0, 0.0, 0.0), at=(0.0, 0.0, 0.0)) -> None:
    """Look at a place from these angles, without perspective."""
    view = editor()[2].data
    view.view_perspective, view.view_rotation = "ORTHO", Euler(angles).to_quaternion()
    view.view_location, view.view_distance = at, distance


def keys(*names: str) -> None:
    """Type keys with the mouse in the middle of the 3D view."""
    _, _, region = editor()
    xdotool("mousemove", *on_screen(region.width // 2, region.height // 2))
    for name in names:
        xdotool("key", "--delay", "60", name)


def picture(name: str) -> Path:
    """Capture the screen in the folder."""
    path = folder / f"{name}.png"
    subprocess.run(["import", "-window", "root", str(path)], check=True)
    return path


def empty_scene() -> None:
    """Remove the objects of the start-up file."""
    for name in ("Cube", "Light", "Camera"):
        bpy.data.objects.remove(bpy.data.objects[name])


def scanner():
    """Return the first scanner's collection."""
    return next(c for c in bpy.data.collections if c.mphdrr_scanner.is_scanner)


def module(number: int, within=None):
    """Return the camera of a module, of the first scanner or of the one in `within`."""
    items = (within or scanner()).all_objects
    return next(o for o in items if o.mphdrr_module.is_module and o.mphdrr_module.number == number)


def is_idle() -> bool:
    """Return whether no job is running."""
    has_modal = len(bpy.context.window_manager.windows[0].modal_operators) > 0
    return not has_modal and not ours("addon.blender.jobs").is_running()


def idle() -> Iterator[float]:
    """Wait until no job runs."""
    yield 1.0
    while not is_idle():
        yield 0.3


def escape_asks() -> Iterator[float]:
    """Press Escape, which asks whether to keep the job's result while the job goes on; close the question unanswered."""
    keys("Escape")
    yield 1.0
    seen["asked"] = ours("addon.blender.jobs").is_running()
    keys("Escape")


def drawn(times: int = 2) -> Iterator[float]:
    """Wait until all has been drawn anew, which takes seconds in software: timers run between two drawings."""
    for _ in range(times):
        for window in bpy.context.window_manager.windows:
            for area in window.screen.areas:
                area.tag_redraw()
        yield 0.1


beats: list[float] = []


def own_time() -> float:
    """Return the time, s, without that in which this thread could run but had no processor (Linux counts it)."""
    try:
        waited = int(Path("/proc/thread-self/schedstat").read_text().split()[1])
    except OSError:
        waited = 0
    return time.perf_counter() - waited * 1e-9


def beat() -> float:
    """Note the time, as a timer whose pauses are measured, and the words of the running job."""
    beats.append(own_time())
    current = ours("addon.blender.jobs")._current
    if current is not None and current.text not in seen["words"]:
        seen["words"].append(current.text)
    return 0.02


def longest_pause() -> float:
    """Return the longest pause between two beats, s."""
    return max(b - a for a, b in itertools.pairwise(beats))


def pause_beyond_redraw() -> Iterator[float]:
    """Yield seconds to wait; return the longest pause since the beats were cleared, less that of a redraw."""
    during = longest_pause()
    beats.clear()
    yield from drawn(3)
    return round(during - longest_pause(), 3)


def run(steps: Iterator[float | Callable[[], bool]], patience: float = 120.0, settle: float = 0.0) -> None:
    """Take the steps: each yields what to wait for, seconds or a function that says when it has happened.

    After such an event `settle` seconds more are waited, for what may still come; after `patience` seconds without it the
    script has failed. What was seen is written when all is drawn after the last step.
    """
    all_steps = itertools.chain(steps, drawn())
    wanted: float | Callable[[], bool] = 0.0
    since = 0.0

    def tick() -> float | None:
        nonlocal wanted, since
        try:
            if callable(wanted):
                if not wanted():
                    if time.monotonic() - since > patience:
                        raise TimeoutError(f"waited in vain at line {steps.gi_frame.f_lineno}")
                    return 0.2
                wanted = settle
                if settle:
                    return settle
            wanted, since = next(all_steps), time.monotonic()
            return 0.2 if callable(wanted) else wanted
        except StopIteration:
            seen["ok"] = True
        except Exception:
            seen["error"] = traceback.format_exc()
        (folder / "seen.json").write_text(json.dumps(seen))
        return None

    bpy.app.timers.register(tick, first_interval=1.5)
