"""The column map dialog in the window: opened by a workbook that is refused, filled in, confirmed.

Arguments after ``--``: the workbook, the file for what was seen, three pictures: the dialog as it
opens, the dialog with a map that is complete, and what comes after it over a scanner that has changed.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
import traceback
from pathlib import Path

import bpy

workbook, result_file, *pictures = (Path(word) for word in sys.argv[sys.argv.index("--") + 1 :][:5])
bpy.context.preferences.view.show_splash = False
seen: dict[str, object] = {"ok": False}
_PATIENCE = 20.0  # s


def form():
    return bpy.context.window_manager.mphdrr_columns


def scanners():
    return [c for c in bpy.data.collections if c.mphdrr_scanner.is_scanner]


def module(number: int):
    found = (o for o in scanners()[0].all_objects if o.mphdrr_module.is_module)
    return next(o for o in found if o.mphdrr_module.number == number)


def press(key: str) -> None:
    subprocess.run(["xdotool", "key", "--delay", "60", key], check=True)


def picture(path: Path) -> None:
    subprocess.run(["import", "-window", "root", str(path)], check=True)


def steps():
    """Yields what to wait for: seconds, or a function that says when it has happened."""
    window = bpy.context.window_manager.windows[0]
    area = max((a for a in window.screen.areas if a.type == "VIEW_3D"), key=lambda a: a.width)
    region = next(r for r in area.regions if r.type == "WINDOW")
    subprocess.run(["xdotool", "mousemove", str(region.x + region.width // 2), str(window.height // 2)], check=True)
    yield 1
    with bpy.context.temp_override(window=window, area=area, region=region):
        bpy.ops.mphdrr.import_geometry("INVOKE_DEFAULT", filepath=str(workbook))
    yield lambda: form().workbook
    yield 2
    seen["opened"] = {"refusal": form().refusal, "doubts": form().doubts}
    picture(pictures[0])

    press("Return")  # a map that is not complete is not taken: the dialog opens again
    yield 2
    seen["asked_again"] = {"refusal": form().refusal, "scanners": len(scanners())}
    form().unit = "mm"
    for name, column in zip(("x1", "y1", "z1"), "BCD", strict=True):
        quantity = next(quantity for quantity in form().quantities if quantity.name == name)
        quantity.table, quantity.column, quantity.unit = 1, column, "cm"
    yield 1
    seen["settled"] = {"refusal": form().refusal, "preview": form().preview}
    press("Return")
    yield scanners
    yield 1
    seen["source"] = json.loads(scanners()[0].mphdrr_scanner.source)["columns"]
    seen["emptied"] = form().workbook == ""

    # Again, over a module that has been moved: the question whether to drop that comes after the columns.
    place, module(1).location.x = module(1).location.x, 300.0
    columns = result_file.with_name("columns.toml")
    columns.write_text(seen["source"])
    with bpy.context.temp_override(window=window, area=area, region=region):
        bpy.ops.mphdrr.import_geometry(
            "INVOKE_DEFAULT", filepath=str(workbook), columns=str(columns), choose_columns=True
        )
    yield lambda: form().preview
    yield 2
    picture(pictures[1])
    press("Return")
    yield 3
    picture(pictures[2])
    seen["kept"] = module(1).location.x == 300.0
    press("Return")
    yield lambda: scanners() and module(1).location.x != 300.0
    seen["moved_back"] = abs(module(1).location.x - place) < 1e-4
    seen["ok"] = True


def tick() -> float | None:
    """A step when what the last one waits for has happened."""
    global wanted, waiting_since
    try:
        if callable(wanted) and not wanted():
            if time.monotonic() - waiting_since < _PATIENCE:
                return 0.3
            raise TimeoutError(f"waited for line {running.gi_frame.f_lineno}")
        wanted, waiting_since = next(running), time.monotonic()
        return 0.3 if callable(wanted) else wanted
    except StopIteration:
        pass
    except Exception:
        seen["error"] = traceback.format_exc()
    result_file.write_text(json.dumps(seen))
    return None


running, wanted, waiting_since = steps(), 0.0, 0.0
bpy.app.timers.register(tick, first_interval=2.0)
