"""``mphdrr figure KIND FILE … -o PICTURE``; only the figures that are rendered, and a .blend, need Blender."""

from __future__ import annotations

import argparse
import contextlib
from pathlib import Path
from typing import Any

import numpy as np

from ... import core as mph
from ...core.cli.options import add_command, output_path, progress_bar, refuse
from ...core.figures.kinds import FILMS, KINDS, PAPERS, SAMPLES, FigureKind, Rendering, figure_kind
from ...core.figures.page import SUFFIXES, Page
from ...core.figures.subject import NEEDS, FigureSubject, require
from ...core.phantoms.kinds import KINDS as PHANTOMS
from ...core.runs.formats import FORMATS
from ...core.toml import read_toml
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
    text = "what it is of: a workbook, a phantom (its kind or a .toml), a volume, a recipe, a run, or a .blend alone"
    add("files", nargs="*", metavar="FILE", help=text)
    text = f"{', '.join(SUFFIXES)}, {', '.join(FILMS)} of animations; in .svg the labels are text; may be repeated"
    add("-o", "--output", action="append", default=[], metavar="FILE", help=text)
    add("--list", action="store_true", help="list the kinds of figures")
    add("--size", type=_size, metavar="WIDTHxHEIGHT", help="pixels; the kind's own by default")
    text = "such as 1-40 or 1-20,41; default: all, but a picture's rays are of a ring, and c-arm shows the first"
    add("--modules", metavar="RANGE", help=text)
    add(
        "--position", type=float, nargs=3, default=[0.0, 0.0, 0.0], metavar="MM", help="of a phantom: its middle, x y z"
    )
    text = "of a phantom: phi theta psi, psi about its own axis, then theta about world y, then phi about world z"
    add("--euler-degrees", type=float, nargs=3, default=[0.0, 0.0, 0.0], metavar="DEG", help=text)
    add("--voxels", type=int, default=200, metavar="N", help="of a phantom, along each side")
    add("--no-labels", action="store_true", help="without title and axes, where the figure is rendered")
    add("--samples", type=int, default=SAMPLES, metavar="N", help="rays per pixel, where the figure is rendered")
    add("--style", choices=list(PAPERS), default="dark", help="of figures that are rendered")
    add("--seconds", type=float, default=Rendering().seconds, metavar="S", help="how long an animation is")
    add("--fps", type=int, default=Rendering().fps, metavar="N", help="pictures of an animation per second")
    parser.set_defaults(run=_run)


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.lower().partition("x")
    try:
        return int(width), int(height)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r}: expected pixels such as 1600x900") from None


def _run(arguments: argparse.Namespace) -> None:
    if arguments.list:
        width = max(map(len, KINDS))
        print(
            "\n".join(f"{kind.name:{width}}  {kind.summary} (of {' and '.join(kind.needs)})" for kind in KINDS.values())
        )
        return
    if arguments.kind is None:
        raise mph.InputError("figure: name a kind; --list shows them")
    kind = figure_kind(arguments.kind)
    if not arguments.output:
        raise mph.InputError("nothing to write: give --output FILE")
    paths = [output_path(name, kind.suffixes) for name in arguments.output]
    how = Rendering(*(not arguments.no_labels, *(getattr(arguments, name) for name in Rendering._fields[1:])))
    page = kind.page(arguments.size, how)
    blends = [file for file in arguments.files if file.lower().endswith(".blend")]
    if blends:
        if len(arguments.files) > 1:
            raise mph.InputError(f"{blends[0]}: a .blend holds all that is shown; give no other file")
        refuse(arguments, _POSED, "is for phantoms that are named on the command line, not for a .blend")
        _of_scene(arguments, kind, Path(blends[0]), paths, how)
    else:
        subject = _subject(arguments)
        have = [need for need in NEEDS if getattr(subject, need) is not None]
        require(kind.needs, have, kind.name, _MISSING)
        if kind.draw is None:
            _render(kind, page, subject, paths, how)
        else:
            kind.draw(page, subject)
            for path in paths:
                page.write(path)
    for path in paths:
        print(path)


def _of_scene(arguments: argparse.Namespace, kind: FigureKind, blend: Path, paths: list[Path], how: Rendering) -> None:
    """A figure of the scene in a .blend, as the window makes it."""
    new_scene()
    import bpy

    from ..figures import figures

    with quiet():
        try:
            bpy.ops.wm.open_mainfile(filepath=str(blend.absolute()))
        except RuntimeError as error:
            raise mph.InputError(f"{blend}: cannot be opened ({str(error).strip().splitlines()[0]})") from None
        job = figures.figure_job(bpy.context, kind.name, paths, arguments.size, arguments.modules, **how._asdict())
        _follow(job.finish(job.work(lambda done, total: None)))


def _render(kind: FigureKind, page: Page, subject: FigureSubject, paths: list[Path], how: Rendering) -> None:
    """A figure that Blender renders."""
    new_scene()
    from ..figures import figures
    from ..volumes import volumes

    assert kind.studio is not None
    item = None
    if kind.studio.volume and subject.volume is not None:
        item = volumes.add_volume(subject.volume, subject.name or "Volume")
    with quiet():
        _follow(figures.drawing(page, subject, kind, item, paths, how, figures.Reel()))


def _follow(steps: Any) -> None:
    """Take the steps of a drawing, and show how far it is."""
    show = progress_bar("rendering")
    for step in filter(None, steps):
        show(*step[1:])


def _subject(arguments: argparse.Namespace) -> FigureSubject:
    """What the files and names on the command line hold; of two that hold the same, the later counts."""
    found: dict[str, Any] = {"modules": arguments.modules}
    posed = False
    for file in arguments.files:
        made = _read(arguments, file, found.get("scanner"))
        posed = posed or made.pop("posed", False)
        found |= made
    if not posed:
        refuse(arguments, _POSED, "is for a phantom: name its kind, or its .toml")
    return FigureSubject(**found)


def _read(arguments: argparse.Namespace, file: str, scanner: Any) -> dict[str, Any]:
    """What one of the files holds, by the names of `FigureSubject`'s fields."""
    suffix = Path(file).suffix.lower()
    if suffix in _WORKBOOKS:
        return {"scanner": mph.read_scanner(file, next(iter(mph.kinds_in(file)), "pinhole"))}
    if suffix == ".toml" and "shape" not in read_toml(file):
        (run,) = mph.run_recipe(mph.read_recipe(file), scanner, stages=progress_bar)
        return _of_run(run)
    kinds = [kind for kind in PHANTOMS if kind.name == file]
    if kinds or suffix == ".toml":
        phantom: Any = kinds[0].phantom(**kinds[0].usual) if kinds else mph.read_phantom(file)
        phi, theta, psi = np.deg2rad(arguments.euler_degrees)
        pose = mph.euler_pose(phi, theta, psi, arguments.position)
        # As large as the phantom however it is turned, and a voxel free all around.
        spacing = phantom.extent / max(1, arguments.voxels - 2)
        grid = mph.Grid.centered(arguments.voxels, spacing, arguments.position)
        volume = phantom.voxelize(grid, pose, progress_bar("voxelizing"))
        return {"volume": volume, "pose": pose, "name": phantom.title, "posed": True}
    if suffix in FORMATS:
        try:
            return _of_run(mph.read_run(file))
        except mph.InputError:
            if suffix == ".pt" or not Path(file).is_file():
                raise
    return {"volume": mph.read_volume(file), "pose": None, "name": Path(file).name}


def _of_run(run: mph.ProjectionRun) -> dict[str, Any]:
    found: dict[str, Any] = {
        "scanner": run.system,
        "volume": run.volume,
        "run": run,
        "name": str(run.settings.get("volume", "")),
    }
    with contextlib.suppress(mph.InputError):  # of version 0.1.0, which keeps no recipe
        if any(key.startswith("phantom.") for key in run.recipe.given):
            from ...core.runs.run_recipe import phantom_pose

            found["pose"] = phantom_pose(run.recipe)
    return {"pose": None, **found}
