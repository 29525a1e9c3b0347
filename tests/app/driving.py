"""What the scripts in the window share: its editors and panels, and the steps that they take.

A script's arguments stand after ``--``: the folder for its files, then its own, `ARGUMENTS`. `seen` is what its test gets.
"""

import itertools
import json
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from types import ModuleType

import bpy

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


def drawn(times: int = 2) -> Iterator[float]:
    """Wait until all has been drawn anew, which takes seconds in software: timers run between two drawings."""
    for _ in range(times):
        for window in bpy.context.window_manager.windows:
            for area in window.screen.areas:
                area.tag_redraw()
        yield 0.1


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
