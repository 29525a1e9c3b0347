"""What the window's main thread takes to follow: modules that move, undo, a change of frame, the example's file.

In a Blender with the extension, ``blender --python benchmarks/window.py`` (with ``--background``, without a window); in the
bpy wheel, ``python benchmarks/window.py``. Prints processor time, ms: the least of ten, and that of Blender by itself,
without the extension's handlers.
"""

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bpy

_TIMES = 10
_AIMS = {
    "move all 80 modules": 40, "move a module": 4, "undo a move of 80": 60, "undo": 100, "change the frame": 0.5,
    "open the example": 150,
}  # fmt: skip


def least(act: Callable[[int], object], prepare: Callable[[int], object] = lambda n: None) -> float:
    """Return the least processor time of some calls, ms, each after its preparation."""
    times = []
    for n in range(_TIMES):
        prepare(n)
        start = time.process_time()
        act(n)
        times.append(1e3 * (time.process_time() - start))
    return min(times)


def move(count: int) -> Callable[[int], None]:
    """Return a function that moves the first `count` modules to and fro."""

    def moving(n: int) -> None:
        cameras = [item for item in bpy.context.scene.objects if item.mphdrr_module.is_module]
        for camera in cameras[:count]:
            camera.location.x += 0.5 if n % 2 else -0.5

    return moving


def follow(n: int = 0) -> None:
    """Have Blender evaluate the scene, and once more after the changes by handlers."""
    bpy.context.view_layer.update()
    bpy.context.view_layer.update()


def push(change: Callable[[int], object]) -> Callable[[int], None]:
    """Return a function that makes a change, evaluates the scene and stores an undo step."""

    def pushing(n: int) -> None:
        change(n)
        follow()
        bpy.ops.ed.undo_push(message="benchmark")

    return pushing


def rename(n: int) -> None:
    """Change a name that no handler depends on."""
    bpy.context.scene.name = f"Scene {n}"


def undo(n: int) -> None:
    """Take a step back."""
    bpy.ops.ed.undo()
    follow()


def measured(file: str) -> dict[str, float]:
    """Return the milliseconds of each task, in the order of `_AIMS`."""
    bpy.ops.wm.open_mainfile(filepath=file)
    found = [least(follow, move(count)) for count in (80, 1)]
    window = bpy.context.window_manager.windows[:1]
    with bpy.context.temp_override(**({"window": window[0]} if window else {})):
        bpy.ops.ed.undo_push(message="start")
        found += [least(undo, push(change)) for change in (move(80), rename)]
    found.append(least(lambda n: bpy.context.scene.frame_set(n + 2)))
    found.append(least(lambda n: bpy.ops.wm.open_mainfile(filepath=file)))
    return dict(zip(_AIMS, found, strict=True))


def main() -> None:
    """Print the table."""
    if bpy.app.module:
        from mphdrr.addon import registration

        registration.register()
    with tempfile.TemporaryDirectory(dir=Path.cwd()) as folder:
        file = str(Path(folder, "example.blend"))
        bpy.ops.mphdrr.load_example()
        bpy.ops.wm.save_as_mainfile(filepath=file)
        ours = measured(file)
        for name in dir(bpy.app.handlers):
            known: Any = getattr(bpy.app.handlers, name)
            for handler in list(known) if isinstance(known, list) else ():
                if ".addon." in handler.__module__:
                    known.remove(handler)
        alone = measured(file)
    print("|  | ms | of these Blender itself | aim |\n| --- | --- | --- | --- |")
    for name, aim in _AIMS.items():
        print(f"| {name} | {ours[name]:.2f} | {alone[name]:.2f} | at most {aim} |")


main()
