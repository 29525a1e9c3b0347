"""``mphdrr demo``: the main job on the example workbook, from the geometry to a file to train on."""

import argparse
import contextlib
import time
from collections.abc import Iterator
from pathlib import Path

from ...core.cli.options import add_command, add_workbook, progress_bar, read_workbook
from ...core.files import ensure_folder
from ...core.runs.files import write_run
from ...core.runs.recipe import Recipe
from ...core.runs.run_recipe import run_recipe
from .scene import new_scene, quiet, save_scene

EXAMPLE = Path(__file__).parents[2] / "examples" / "dc-spect-80.xlsx"
EULER_DEGREES = (30.0, 55.0, 0.0)  # tilted, so that modules see along and across the rods
# Besides the modules' ranges: name, kind and modules.
_FIGURES = (
    ("phantom", "inside", None),
    ("cut-away", "cut-away", None),
    ("sums", "sums", None),
    ("mosaic", "mosaic", None),
)
_SIZE = dict.fromkeys(("scanner", "inside", "cut-away"), (960, 560))
"""Smaller than usual: they take most of the demo's time."""


def add_parser(subparsers) -> None:  # type: ignore[no-untyped-def]
    """Add the command."""
    parser = add_command(
        subparsers,
        "demo",
        "run the main job: workbook, phantom, 80 projections, scene, pictures and dataset",
        "mphdrr demo --output out",
    )
    parser.add_argument("--output", default="out", metavar="FOLDER", help="where the results go")
    add_workbook(parser, "--workbook", str(EXAMPLE))
    parser.add_argument("--voxels", type=int, default=256, metavar="N", help="voxels along each side of the volume")
    parser.add_argument("--size", type=int, default=256, metavar="N", help="pixels along each side of an image")
    parser.set_defaults(run=_run)


def _run(arguments: argparse.Namespace) -> None:
    out = ensure_folder(arguments.output)
    scene = new_scene()  # before the long work: without Blender the demo stops here
    import bpy

    from .. import figures, jobs, rendering, scanner, volumes

    with _step("geometry"):
        system = read_workbook(arguments)
        scanner.build_scanner(scene, system)
    with _step("projections"):
        recipe = Recipe({
            "system.file": arguments.workbook,
            "phantom.kind": "derenzo",
            "phantom.euler_degrees": EULER_DEGREES,
            "phantom.voxels": arguments.voxels,
            "phantom.spacing": 102.4 / arguments.voxels,
            "detector.rows": arguments.size,
            "detector.columns": arguments.size,
        })  # fmt: skip
        (run,) = run_recipe(recipe, system, stages=progress_bar)
        pose, phantom = run.recipe["phantom.matrix"], run.recipe.tables()["phantom"]
        item = volumes.add_volume(run.volume, "Derenzo phantom", pose, phantom)
    with _step("dataset"):
        write_run(run, out / "run.h5")
    with _step("scene"):
        rendering.show_run(scene, run, out / "run.h5", item)
        save_scene(out / "scanner.blend")
    with _step("pictures"), quiet():
        ranges = {f"modules-{first}-{last}": f"{first}-{last}" for first, last in scanner.quick_ranges(system)}
        for name, figure, modules in (*((name, "scanner", text) for name, text in ranges.items()), *_FIGURES):
            path = out / f"{name}.png"
            jobs.run(figures.figure_job(bpy.context, figure, [path], _SIZE.get(figure), modules))
    print(f"{out}: {', '.join(sorted(p.name for p in out.iterdir() if p.suffix in ('.blend', '.h5', '.png')))}")


@contextlib.contextmanager
def _step(name: str) -> Iterator[None]:
    started = time.monotonic()
    yield
    print(f"{name:12s} {time.monotonic() - started:5.1f} s", flush=True)
