"""``mphdrr figure KIND FILE … -o PICTURE``; only rendered figures and .blend files need Blender."""

from __future__ import annotations

import argparse
import contextlib
from pathlib import Path
from typing import Any

import numpy as np

from ... import core as mph
from ...core.cli.options import add_command, add_photons, output_path, progress_bar, refuse
from ...core.figures.kinds import FILMS, KINDS, PAPERS, SAMPLES, FigureKind, Rendering, figure_kind
from ...core.figures.page import SUFFIXES, Page
from ...core.figures.subject import NEEDS, FigureSubject, require
from ...core.phantoms.kinds import KINDS as PHANTOMS
from ...core.recipes.toml import read_toml
from ...core.runs import FORMATS
from . import COMMANDS
from .scene import new_scene, quiet

_WORKBOOKS = (".xlsx", ".xlsm")
_MISSING = {
    "scanner": "needs a scanner: give a workbook, a run or a .blend",
    "volume": "needs a volume: give a volume file, a phantom, a run or a .blend",
    "run": "needs projections: give a run, a recipe, or a .blend with projections",
}
_POSED = ("position", "euler_degrees", "voxels")


def add_parser(subparsers) -> None:  # type: ignore[no-untyped-def]
    """Add the command."""
    parser = add_command(
        subparsers,
        "figure",
        COMMANDS[__name__],
        "mphdrr figure cut-away scanner.xlsx derenzo -o figure.png --size 1600x900\n"
        "example: mphdrr figure scanner scanner.xlsx --modules 1-40 -o modules.svg\n"
        "example: mphdrr figure light-up scanner.xlsx derenzo -o modules.mp4 --seconds 8 --size 640x400\n"
        "example: mphdrr figure mosaic run.h5 -o mosaic.png -o mosaic.svg",
    )
    add = parser.add_argument
    add("kind", nargs="?", metavar="KIND", help=f"one of {', '.join(KINDS)}; --list explains them")
    text = "subject of the figure: workbook, phantom (its kind or a .toml), volume, recipe, run, or a .blend alone"
    add("files", nargs="*", metavar="FILE", help=text)
    text = f"{', '.join(SUFFIXES)}, {', '.join(FILMS)} of animations; in .svg the labels are text; may be repeated"
    add("-o", "--output", action="append", default=[], metavar="FILE", help=text)
    add("--list", action="store_true", help="list the kinds of figures")
    add("--size", type=_size, metavar="WIDTHxHEIGHT", help="pixels; the kind's own by default")
    text = "such as 1-40 or 1-20,41; default: all, but picture draws the rays of one ring, and c-arm shows the first"
    add("--modules", metavar="RANGE", help=text)
    add("--position", type=float, nargs=3, default=[0.0] * 3, metavar="MM", help="of a phantom: its centre, x y z")
    text = "of a phantom: phi theta psi, psi about its own axis, then theta about world y, then phi about world z"
    add("--euler-degrees", type=float, nargs=3, default=[0.0, 0.0, 0.0], metavar="DEG", help=text)
    add("--voxels", type=int, default=200, metavar="N", help="of a phantom, along each side")
    add("--no-labels", action="store_true", help="without title and axes, where the figure is rendered")
    add("--samples", type=int, default=SAMPLES, metavar="N", help="rays per pixel, where the figure is rendered")
    add("--style", choices=list(PAPERS), default="dark", help="of figures that are rendered")
    add("--seconds", type=float, default=Rendering().seconds, metavar="S", help="how long an animation is")
    add("--fps", type=int, default=Rendering().fps, metavar="N", help="pictures of an animation per second")
    add_photons(parser)
    parser.set_defaults(run=_run)


def _size(text: str) -> tuple[int, int]:
    """Parse an image size such as 1600x900."""
    width, _, height = text.lower().partition("x")
    try:
        return int(width), int(height)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r}: expected pixels such as 1600x900") from None


def _run(arguments: argparse.Namespace) -> None:
    """Draw or list figures."""
    if arguments.list:
        width = max(map(len, KINDS))
        for kind in KINDS.values():
            print(f"{kind.name:{width}}  {kind.summary} (of {' and '.join(kind.needs)})")
        return
    if arguments.kind is None:
        raise mph.InputError("figure: name a kind; --list shows them")
    kind = figure_kind(arguments.kind)
    if not arguments.output:
        raise mph.InputError("nothing to write: give --output FILE")
    paths = [output_path(name, kind.suffixes) for name in arguments.output]
    style = Rendering(*(not arguments.no_labels, *(getattr(arguments, name) for name in Rendering._fields[1:])))
    page = kind.page(arguments.size, style)
    if blends := [file for file in arguments.files if file.lower().endswith(".blend")]:
        if len(arguments.files) > 1:
            raise mph.InputError(f"{blends[0]}: a .blend holds all that is shown; give no other file")
        refuse(arguments, _POSED, "is for phantoms that are named on the command line, not for a .blend")
        _draw_scene(arguments, kind, Path(blends[0]), paths, style)
    else:
        subject = _read_subject(arguments)
        available = [need for need in NEEDS if getattr(subject, need) is not None]
        require(kind.needs, available, kind.name, _MISSING)
        if kind.draw is None:
            _render_figure(kind, page, subject, paths, style)
        else:
            kind.draw(page, subject)
            for path in paths:
                page.write(path)
    for path in paths:
        print(path)


def _draw_scene(
    arguments: argparse.Namespace, kind: FigureKind, blend: Path, paths: list[Path], style: Rendering
) -> None:
    """Draw a figure of the scene in a .blend, as the window draws it."""
    new_scene()
    import bpy

    from ..figures import figures

    with quiet():
        try:
            bpy.ops.wm.open_mainfile(filepath=str(blend.absolute()))
        except RuntimeError as error:
            raise mph.InputError(f"{blend}: cannot be opened ({str(error).strip().splitlines()[0]})") from None
        job = figures.figure_job(bpy.context, kind.name, paths, arguments.size, arguments.modules, **style._asdict())
        _run_steps(job.finish(job.work(lambda done, total: None)))


def _render_figure(kind: FigureKind, page: Page, subject: FigureSubject, paths: list[Path], style: Rendering) -> None:
    """Draw a figure that Blender renders."""
    new_scene()
    from ..figures import figures, surfaces
    from ..volumes import volumes

    assert kind.studio is not None
    surface = None
    if kind.studio.volume and subject.volume is not None:
        item = volumes.add_volume(subject.volume, subject.name or "Volume")
        surface = surfaces.surface_maker(item)(subject.volume, progress_bar("reading"))
    with quiet():
        _run_steps(figures.draw_figure(page, subject, surface, kind, paths, style, figures.Reel()))


def _run_steps(steps: Any) -> None:
    """Run the generator of a drawing to its end, and show the progress that it yields."""
    report = progress_bar("rendering")
    for step in filter(None, steps):
        report(*step[1:])


def _read_subject(arguments: argparse.Namespace) -> FigureSubject:
    """Read all files of the command line into one `FigureSubject`; later files override earlier ones."""
    values: dict[str, Any] = {"modules": arguments.modules}
    is_posed = False
    for file in arguments.files:
        file_values = _read_file(arguments, file, values.get("scanner"))
        is_posed = is_posed or file_values.pop("posed", False)
        values |= file_values
    if not is_posed:
        refuse(arguments, _POSED, "is for a phantom: name its kind, or its .toml")
    return FigureSubject(**values)


def _read_file(arguments: argparse.Namespace, file: str, scanner: Any) -> dict[str, Any]:
    """Return the values of `FigureSubject`'s fields that a file, or a kind of phantom, holds."""
    suffix = Path(file).suffix.lower()
    if suffix in _WORKBOOKS:
        return {"scanner": mph.read_scanner(file, next(iter(mph.kinds_in(file)), "pinhole"))}
    if suffix == ".toml" and "shape" not in read_toml(file):
        (run,) = mph.run_recipe(mph.read_recipe(file), scanner, stages=progress_bar)
        return _run_values(run.of_photons(arguments.photons))
    kinds = [kind for kind in PHANTOMS if kind.name == file]
    if kinds or suffix == ".toml":
        phantom: Any = kinds[0].phantom(**kinds[0].usual) if kinds else mph.read_phantom(file)
        phi, theta, psi = np.deg2rad(arguments.euler_degrees)
        pose = mph.euler_pose(phi, theta, psi, arguments.position)
        # The grid holds the phantom in any rotation, with a margin of one voxel.
        spacing = phantom.extent / max(1, arguments.voxels - 2)
        grid = mph.Grid.centered(arguments.voxels, spacing, arguments.position)
        volume = phantom.voxelize(grid, pose, progress_bar("voxelizing"))
        return {"volume": volume, "pose": pose, "name": phantom.title, "posed": True}
    if suffix in FORMATS:
        try:
            run = mph.read_run(file)
        except mph.InputError:
            if suffix == ".pt" or not Path(file).is_file():
                raise
        else:
            return _run_values(run.of_photons(arguments.photons))
    return {"volume": mph.read_volume(file), "pose": None, "name": Path(file).name}


def _run_values(run: mph.ProjectionRun) -> dict[str, Any]:
    """Return the values of `FigureSubject`'s fields that a run holds."""
    values: dict[str, Any] = {
        "scanner": run.system,
        "volume": run.volume,
        "run": run,
        "name": str(run.settings.get("volume", "")),
    }
    with contextlib.suppress(mph.InputError):  # runs of version 0.1.0 have no recipe
        if any(key.startswith("phantom.") for key in run.recipe.given):
            from ...core.runs.run_recipe import phantom_pose

            values["pose"] = phantom_pose(run.recipe)
    return {"pose": None, **values}
