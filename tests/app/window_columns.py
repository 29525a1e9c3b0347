"""The column map dialog in the window: opened by a workbook that is refused, filled in, confirmed."""

import json

import bpy
from driving import ARGUMENTS, drawn, editor, folder, module, press, run, seen
from pointing import on_screen, picture, xdotool

(workbook,) = ARGUMENTS


def form():
    return bpy.context.window_manager.mphdrr_columns


def scanners():
    return [c for c in bpy.data.collections if c.mphdrr_scanner.is_scanner]


def steps():
    """Yield what to wait for: seconds, or a function that says when it has happened."""
    region = editor()[2]
    xdotool("mousemove", *on_screen(region.width // 2, region.height // 2))
    yield 1
    press(bpy.ops.mphdrr.import_geometry, filepath=str(workbook))
    yield lambda: form().workbook
    yield from drawn()
    seen["opened"] = {"refusal": form().refusal, "doubts": form().doubts}
    picture("opened")

    xdotool("key", "Return")  # a map that is not complete is not taken: the dialog opens again
    yield from drawn()
    seen["asked_again"] = {"refusal": form().refusal, "scanners": len(scanners())}
    form().unit = "mm"
    for name, column in zip(("x1", "y1", "z1"), "BCD", strict=True):
        quantity = next(quantity for quantity in form().quantities if quantity.name == name)
        quantity.table, quantity.column, quantity.unit = 1, column, "cm"
    yield 1
    seen["settled"] = {"refusal": form().refusal, "preview": form().preview}
    xdotool("key", "Return")
    yield scanners
    yield 1
    seen["source"] = json.loads(scanners()[0].mphdrr_scanner.source)["columns"]
    seen["emptied"] = form().workbook == ""

    # Again, over a module that has been moved: the question whether to drop that comes after the columns.
    place, module(1).location.x = module(1).location.x, 300.0
    columns = folder / "columns.toml"
    columns.write_text(seen["source"])
    press(bpy.ops.mphdrr.import_geometry, filepath=str(workbook), columns=str(columns), choose_columns=True)
    yield lambda: form().preview
    yield from drawn()
    picture("complete")
    xdotool("key", "Return")
    yield 1
    yield from drawn()
    picture("replace")
    seen["kept"] = module(1).location.x == 300.0
    xdotool("key", "Return")
    yield lambda: scanners() and module(1).location.x != 300.0
    seen["moved_back"] = abs(module(1).location.x - place) < 1e-4


run(steps())
