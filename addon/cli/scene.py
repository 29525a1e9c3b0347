"""``mphdrr scene WORKBOOK -o FILE.blend``."""

from __future__ import annotations

import argparse
from pathlib import Path

from ...core.cli.options import add_command, add_workbook, chosen_modules, output_path, read_workbook
from ...core.errors import InputError
from ...core.runs.files import read_run
from ...core.volumes.volume_files import read_volume, read_volume_of


def add_parser(subparsers) -> None:  # type: ignore[no-untyped-def]
    """Add the command."""
    parser = add_command(
        subparsers,
        "scene",
        "make a Blender scene of the scanner, with a volume and projections",
        "mphdrr scene scanner.xlsx --run run.h5 -o scanner.blend",
    )
    add_workbook(parser)
    parser.add_argument("--modules", metavar="RANGE", help="such as 1-40 or 1-20,41; default: all")
    parser.add_argument("--volume", metavar="FILE", help="also put in this volume: .nii, .nii.gz, .npz")
    parser.add_argument(
        "--mu", metavar="FILE", help="and this volume of attenuation coefficients (1/mm), for SPECT counts"
    )
    parser.add_argument("--run", metavar="FILE", dest="run_file", help="also put in this run's volume and projections")
    parser.add_argument("-o", "--output", required=True, metavar="FILE", help="the .blend to write")
    parser.set_defaults(run=_run)


def _run(arguments: argparse.Namespace) -> None:
    path = output_path(arguments.output)
    if path.suffix.lower() != ".blend":
        raise InputError(f"{path}: expected a name ending in .blend")
    system = chosen_modules(read_workbook(arguments), arguments.modules)
    volume = read_volume(arguments.volume) if arguments.volume else None
    mu = read_volume_of(arguments.mu, "mu") if arguments.mu else None
    run = read_run(arguments.run_file) if arguments.run_file else None

    from .session import new_scene, save_scene

    blender_scene = new_scene()
    from .. import rendering, scanner, volumes

    scanner.build_scanner(blender_scene, system)
    if volume is not None:
        volumes.add_volume(volume, Path(arguments.volume).name)
    if mu is not None:
        blender_scene.mphdrr_projections.mu = volumes.add_volume(mu, Path(arguments.mu).name)
    if run is not None:
        volumes.add_volume(run.volume, "Projected volume")
        rendering.show_run(blender_scene, run, Path(arguments.run_file))
    save_scene(path)
    print(path)
