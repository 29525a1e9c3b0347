"""Mouse, keys, views and pictures of the screen, for the scripts in the window."""

import subprocess
from collections.abc import Iterator
from pathlib import Path

import bpy
from bpy_extras.view3d_utils import location_3d_to_region_2d
from driving import editor, folder, ours, seen, sidebar
from mathutils import Euler


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


def escape_asks() -> Iterator[float]:
    """Press Escape, which asks whether to keep the job's result while the job goes on; close the question unanswered."""
    keys("Escape")
    yield 1.0
    seen["asked"] = ours("addon.blender.jobs").is_running()
    keys("Escape")
