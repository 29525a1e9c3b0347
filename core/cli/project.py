"""``mphdrr project WORKBOOK --volume FILE -o run.h5``."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from ..export import FORMATS, write_run
from ..mosaic import mosaic, write_png
from ..project import project_run
from ..projector import Emission
from ..system import PinholeSystem
from ..volume_io import read_volume
from ..workbook import read_system
from .options import add_command, add_phantom_options, add_view_options, chosen_modules, output_path, progress_bar
from .phantom import derenzo_volume


def add_parser(subparsers) -> None:  # type: ignore[no-untyped-def]
    """Add the command."""
    parser = add_command(
        subparsers,
        "project",
        "project a volume, or a Derenzo phantom, into every module",
        "mphdrr project scanner.xlsx --volume ct.nii.gz --size 250 250 -o run.h5",
    )
    parser.add_argument("workbook", metavar="WORKBOOK", help="geometry workbook (.xlsx, .xlsm)")
    parser.add_argument("--volume", metavar="FILE", help=".nii, .nii.gz or .npz; without it, a Derenzo phantom is made")
    add_view_options(parser)
    add_emission_options(parser.add_argument_group("SPECT counts"))
    add_phantom_options(parser.add_argument_group("Derenzo phantom, without --volume"))  # type: ignore[arg-type]
    parser.add_argument("-o", "--output", required=True, metavar="FILE", help=", ".join(FORMATS))
    parser.add_argument("--mosaic", metavar="PNG", help="also write all images in one picture")
    parser.set_defaults(run=_run)


def add_emission_options(group: argparse._ArgumentGroup) -> None:
    """What `emission` needs."""
    group.add_argument("--emission", action="store_true", help="expected counts instead of line integrals")
    group.add_argument("--time", type=float, default=1.0, metavar="S", help="acquisition time")
    group.add_argument("--mu", metavar="FILE", help="attenuation coefficients, 1/mm, on any grid; without it, none")
    group.add_argument(
        "--aperture-points", type=int, default=1, metavar="N", help="rays through the hole of each pixel"
    )
    group.add_argument("--noise", type=int, metavar="SEED", help="draw Poisson counts instead of their means")


def emission(arguments: argparse.Namespace, system: PinholeSystem) -> Emission | None:
    """The model that `arguments` ask for; None for line integrals."""
    if not arguments.emission:
        asked = [name for name in ("mu", "noise") if getattr(arguments, name) is not None]
        if asked:
            raise InputError(f"--{asked[0]} needs --emission")
        return None
    mu = read_volume(arguments.mu, "mu") if arguments.mu else None
    return Emission(system, mu, time=arguments.time, aperture_points=arguments.aperture_points)


def _run(arguments: argparse.Namespace) -> None:
    path = output_path(arguments.output, FORMATS)
    picture = output_path(arguments.mosaic) if arguments.mosaic else None
    system = chosen_modules(read_system(arguments.workbook), arguments.modules)
    model = emission(arguments, system)
    recipe: dict[str, Any] = {}
    if arguments.volume:
        volume = read_volume(arguments.volume, "activity" if model else None)
    else:
        volume, recipe = derenzo_volume(arguments)
    run = project_run(
        system,
        volume,
        shape=tuple(arguments.size),
        detector=arguments.detector,
        magnification=arguments.magnification,
        pitch=arguments.pitch,
        backend=arguments.backend,
        threads=arguments.threads,
        settings={
            "volume": Path(arguments.volume).name if arguments.volume else "Derenzo phantom",
            **recipe,
            **({"mu_file": Path(arguments.mu).name} if arguments.mu else {}),
        },
        model=model,
        noise_seed=arguments.noise,
        progress=progress_bar("projecting"),
    )
    write_run(run, path)
    if picture is not None:
        write_png(mosaic(run.projections), picture)
    n_v, n_u = run.views.shape
    count, largest = len(run.views), float(np.max(run.projections))
    print(f"{path}: {count} projection{'s' * (count > 1)} of {n_v} x {n_u} pixels, largest {largest:.4g} {run.unit}")
