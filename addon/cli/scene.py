"""``mphdrr scene WORKBOOK -o FILE.blend``, and the Blender session in which commands work."""

from __future__ import annotations

import argparse
import contextlib
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from ... import core as mph
from ...core.cli.options import add_command, output_path
from ...core.cli.scanners import add_workbook, chosen_modules, read_any_scanner
from . import COMMANDS

if TYPE_CHECKING:
    import bpy

# Double quotes, because Windows' command prompt knows no others.
INSTALL_BLENDER = 'pip install "mphdrr[blender]", or ".[blender]" in its source; or run blender --command mphdrr'


def add_parser(subparsers) -> None:  # type: ignore[no-untyped-def]
    """Add the command."""
    example = "mphdrr scene scanner.xlsx --run run.h5 -o scanner.blend"
    parser = add_command(subparsers, "scene", COMMANDS[__name__], example)
    add_workbook(parser)
    add = parser.add_argument
    add("--modules", metavar="RANGE", help="such as 1-40 or 1-20,41; default: all")
    add("--volume", metavar="FILE", help="also put in this volume, of any format that volume info reads")
    add("--mu", metavar="FILE", help="and this volume of attenuation coefficients (1/mm), for SPECT counts")
    add("--run", metavar="FILE", dest="run_file", help="also put in this run's volume and projections")
    add("-o", "--output", required=True, metavar="FILE", help="the .blend to write")
    parser.set_defaults(run=_run)


def _run(arguments: argparse.Namespace) -> None:
    """Write the .blend."""
    from ...core.volumes.volume_files import read_volume_of

    path = output_path(arguments.output, (".blend",))
    system = chosen_modules(read_any_scanner(arguments), arguments.modules)
    volume = mph.read_volume(arguments.volume) if arguments.volume else None
    mu = read_volume_of(arguments.mu, "mu") if arguments.mu else None
    run = mph.read_run(arguments.run_file) if arguments.run_file else None

    blender_scene = new_scene()
    from ..figures import studio
    from ..runs import rendering
    from ..scanner import scanner
    from ..volumes import volumes

    scanner.build_scanner(blender_scene, system)
    studio.light(blender_scene)
    if volume is not None:
        volumes.add_volume(volume, Path(arguments.volume).name)
    if mu is not None:
        blender_scene.mphdrr_projections.mu = volumes.add_volume(mu, Path(arguments.mu).name)
    if run is not None:
        projected = None if run.volume is None else volumes.add_volume(run.volume, "Projected volume")
        rendering.show_run(blender_scene, run, Path(arguments.run_file), projected)
    save_scene(path)
    print(path)


def new_scene() -> bpy.types.Scene:
    """Return an empty scene in an empty file, with the extension registered; raise `InputError` where Blender is missing."""
    try:
        import bpy
    except ModuleNotFoundError:
        raise mph.InputError(f"this command needs Blender: {INSTALL_BLENDER}") from None
    except ImportError as error:  # a shared library is missing
        libraries = "libx11-6 libxi6 libxfixes3 libxrender1 libxkbcommon0 libsm6 libgl1"
        remedy = f"on Debian and Ubuntu install {libraries}"
        raise mph.InputError(f"Blender's bpy package does not load ({error}); {remedy}") from None
    from .. import registration

    bpy.ops.wm.read_homefile(use_empty=True)
    if not hasattr(bpy.types.Object, "mphdrr_module"):
        registration.register()
    scene = bpy.context.scene
    if scene.world is None:
        scene.world = bpy.data.worlds.new("World")
    return scene


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Hide what Blender itself prints on standard output: a line for every tile and file."""
    sys.stdout.flush()
    stdout_copy = os.dup(1)
    null = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(null, 1)
        yield
    finally:
        os.dup2(stdout_copy, 1)
        os.close(stdout_copy)
        os.close(null)


_BLEND_END, _PACKED_END = 64, b"\xb1\xea\x92\x8f"
"""Number of last bytes in which a .blend has "ENDB", and the bytes that end a compressed .blend (Zstandard's table)."""


def save_scene(path: Path) -> None:
    """Save the file as `path`; Blender itself writes beside it and renames."""
    import bpy

    try:
        # Prevents a .blend1 beside the result of a command.
        bpy.context.preferences.filepaths.save_version = 0
        with quiet():
            bpy.ops.wm.save_as_mainfile(filepath=os.path.abspath(path), check_existing=False)
    except RuntimeError as error:
        raise mph.InputError(f"{path}: cannot be written ({str(error).strip().splitlines()[0]})") from error
    with open(path, "rb") as file:
        file.seek(max(0, path.stat().st_size - _BLEND_END))
        end = file.read()
    if not end.endswith(_PACKED_END) and b"ENDB" not in end:
        path.unlink()  # Blender 5.2 reports an incomplete file as saved
        raise mph.InputError(f"{path}: cannot be written (Blender left it incomplete: is the disk full?)")
