"""``mphdrr demo``: the main job on the example workbook, from the geometry to a dataset for training."""

from __future__ import annotations

import argparse
import contextlib
import importlib.util
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ... import core as mph
from ...core import files
from ...core.cli.options import add_command, progress_bar
from ...core.cli.scanners import add_workbook, read_pinhole_system
from ...core.errors import warn
from ...core.example import EULER_DEGREES, EXAMPLE
from ...core.runs.mosaic import write_sheet
from . import COMMANDS
from .scene import INSTALL_BLENDER, new_scene, quiet, save_scene

_FIGURES = {"phantom": "picture", "cut-away": "cut-away", "sums": "sums"}
"""Kinds of the figures by name, besides those of the modules' ranges."""
_SIZE = dict.fromkeys(("scanner", "picture", "cut-away"), (720, 420))
"""Sizes of figures, pixels; smaller than usual, since figures take most of the demo's time."""


def add_parser(subparsers) -> None:  # type: ignore[no-untyped-def]
    """Add the command."""
    parser = add_command(subparsers, "demo", COMMANDS[__name__], "mphdrr demo --output out")
    parser.add_argument("--output", default="out", metavar="FOLDER", help="folder for the results")
    add_workbook(parser, "--workbook", str(EXAMPLE))
    parser.add_argument("--voxels", type=int, default=256, metavar="N", help="voxels along each side of the volume")
    parser.add_argument("--size", type=int, default=256, metavar="N", help="pixels along each side of an image")
    parser.set_defaults(run=_run)


def _run(arguments: argparse.Namespace) -> None:
    """Run the demo."""
    out = files.ensure_folder(arguments.output)
    has_blender = importlib.util.find_spec("bpy") is not None
    scene = new_scene() if has_blender else None  # before the long work, so that problems with Blender show at once
    with _step("geometry"):
        system = read_pinhole_system(arguments)
    with _step("projections"):
        recipe = mph.Recipe({
            "system.file": arguments.workbook,
            "phantom.kind": "derenzo",
            "phantom.euler_degrees": EULER_DEGREES,
            "phantom.voxels": arguments.voxels,
            "phantom.spacing": 102.4 / arguments.voxels,
            "detector.rows": arguments.size,
            "detector.columns": arguments.size,
        })  # fmt: skip
        (run,) = mph.run_recipe(recipe, system, stages=progress_bar)
    with _step("dataset"):
        mph.write_run(run, out / "run.h5")
        write_sheet(run, out / "mosaic.png")
    if scene is None:
        warn(f"no scene and no pictures of it, which need Blender: {INSTALL_BLENDER}")
    else:
        _make_scene(scene, run, out)
    print(f"{out}: {', '.join(sorted(p.name for p in out.iterdir() if p.suffix in ('.blend', '.h5', '.png')))}")


def _make_scene(scene: Any, run: mph.ProjectionRun, out: Path) -> None:
    """Write the scene of a run, and pictures of it."""
    import bpy

    from ..blender import jobs
    from ..figures import figures
    from ..runs import rendering
    from ..scanner import scanner
    from ..volumes import volumes

    with _step("scene"):
        scanner.build_scanner(scene, run.system)
        pose, phantom = run.recipe["phantom.matrix"], run.recipe.tables()["phantom"]
        assert run.volume is not None
        item = volumes.add_volume(run.volume, "Derenzo phantom", pose, phantom)
        rendering.show_run(scene, run, out / "run.h5", item)
        save_scene(out / "scanner.blend")
    with _step("pictures"), quiet():
        ranges = scanner.quick_ranges(run.system.numbers, run.system.rings())
        range_figures = [(f"modules-{modules}", "scanner", modules) for modules in ranges]
        for name, figure, modules in (*range_figures, *((name, kind, None) for name, kind in _FIGURES.items())):
            path = out / f"{name}.png"
            jobs.run(figures.figure_job(bpy.context, figure, [path], _SIZE.get(figure), modules, samples=8))


@contextlib.contextmanager
def _step(name: str) -> Iterator[None]:
    """Print the name and the duration, s, of a step."""
    started = time.monotonic()
    yield
    print(f"{name:12s} {time.monotonic() - started:5.1f} s", flush=True)
