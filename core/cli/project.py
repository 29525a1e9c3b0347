"""``mphdrr project WORKBOOK --volume FILE -o run.h5``."""

from __future__ import annotations

import argparse
import math
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from ..export import FORMATS, write_run
from ..hounsfield import hu_to_mu
from ..isotopes import ISOTOPES
from ..materials import APERTURES, CRYSTALS
from ..mosaic import mosaic, write_png
from ..project import project_run
from ..projector import Emission, InverseSquareSum, Model, Transmission
from ..rearranging import centered
from ..system import PinholeSystem
from ..volume import Volume
from ..volume_io import read_volume, read_volume_of
from ..workbook import read_system
from .options import (
    add_command,
    add_phantom_options,
    add_view_options,
    chosen_modules,
    number_or_name,
    output_path,
    photon_energy,
    progress_bar,
)
from .phantom import derenzo_volume, file_volume

_EMISSION = [field.name for field in fields(Emission)]


def add_parser(subparsers) -> None:  # type: ignore[no-untyped-def]
    """Add the command."""
    parser = add_command(
        subparsers,
        "project",
        "project a volume, or a phantom, into every module",
        "mphdrr project scanner.xlsx --volume ct.nii.gz --size 250 250 -o run.h5\n"
        "example: mphdrr project scanner.xlsx --volume heart.nii.gz --mu ct-mu.nii.gz --emission --isotope Tc-99m "
        "--time 600 --aperture-points 7 --aperture-mu tungsten --crystal-mu CZT --noise 1 -o counts.h5",
    )
    parser.add_argument("workbook", metavar="WORKBOOK", help="geometry workbook (.xlsx, .xlsm)")
    source = parser.add_mutually_exclusive_group()
    source.add_argument(
        "--volume", metavar="FILE", help="volume or folder of a DICOM series; without it, a Derenzo phantom is made"
    )
    source.add_argument("--phantom", metavar="FILE", help="a phantom's shapes (.toml), put on the grid given below")
    parser.add_argument(
        "--energy", metavar="KEV",
        help="CT numbers of --volume or --mu become attenuation (1/mm) at this energy, or at an isotope's strongest line",
    )  # fmt: skip
    parser.add_argument(
        "--center", action="store_true", help="move the volume's middle to the isocentre, and --mu as far"
    )
    add_view_options(parser)
    models = parser.add_argument_group("what pixels hold; without an option, line integrals")
    one = models.add_mutually_exclusive_group()
    one.add_argument("--emission", action="store_true", help="SPECT counts of a volume of activity")
    one.add_argument(
        "--photons", type=float, metavar="N", help="of N X-ray photons per pixel, those that pass: mu in 1/mm"
    )
    one.add_argument(
        "--inverse-square", action="store_true",
        help="line integrals with each segment times a point source's sensitivity, as 1/h^2: no counts, for comparison",
    )  # fmt: skip
    models.add_argument("--noise", type=int, metavar="SEED", help="draw Poisson counts instead of their means")
    add_emission_options(parser)
    add_phantom_options(parser.add_argument_group("Derenzo phantom, without --volume, or place of --phantom"))  # type: ignore[arg-type]
    parser.add_argument("-o", "--output", required=True, metavar="FILE", help=", ".join(FORMATS))
    parser.add_argument("--mosaic", metavar="PNG", help="also write all images in one picture")
    parser.set_defaults(run=_run)


def add_emission_options(parser: argparse.ArgumentParser) -> None:
    """The arguments of `Emission`, in the namespace only if they are given."""

    def option(group: argparse._ArgumentGroup, name: str, **details: Any) -> None:
        group.add_argument(name, default=argparse.SUPPRESS, **details)

    source = parser.add_argument_group("--emission: the source")
    option(source, "--time", type=float, metavar="S", help="acquisition time, s (default: 1)")
    option(source, "--isotope", metavar="NAME", help=f"{', '.join(ISOTOPES)}; without it, one photon per decay")
    option(
        source, "--window", type=float, nargs=2, metavar=("LOW", "HIGH"),
        help="energies that are counted, keV (default: 10 %% around the isotope's strongest line)",
    )  # fmt: skip
    option(
        source, "--mu", metavar="FILE",
        help="attenuation coefficients, 1/mm, on any grid, or with --energy CT numbers; without it, none",
    )  # fmt: skip
    aperture = parser.add_argument_group("--emission: the pinhole")
    option(
        aperture, "--aperture-points", type=int, metavar="N", help="rays through the hole of each pixel (default: 1)"
    )
    option(
        aperture, "--aperture-tolerance", type=float, metavar="SHARE",
        help="as many as bring a voxel's image this close, such as 0.1, to that of the whole hole",
    )  # fmt: skip
    option(
        aperture, "--aperture-mu", type=number_or_name, metavar="MATERIAL",
        help=f"{', '.join(APERTURES)} at the isotope's photons, or the coefficient, 1/mm; without it, nothing penetrates",
    )  # fmt: skip
    option(aperture, "--opening-angle", type=float, metavar="DEG", help="full angle of the knife edge (default: 90)")
    option(
        aperture, "--edge", choices=("paix", "path"),
        help="penetration by an effective diameter, or by the path through the edge (default: paix)",
    )  # fmt: skip
    option(aperture, "--within-cone", action="store_true", help="nothing passes steeper than the knife edge's cone")
    crystal = parser.add_argument_group("--emission: collimator and crystal")
    option(crystal, "--within-walls", action="store_true", help="the collimator's walls stop what misses the front")
    option(crystal, "--within-crystal", action="store_true", help="pixels beyond the crystal's side count nothing")
    option(
        crystal, "--crystal-mu", type=number_or_name, metavar="MATERIAL",
        help=f"{', '.join(CRYSTALS)} at the isotope's photons, or the coefficient, 1/mm; without it, all photons count",
    )  # fmt: skip
    option(
        crystal, "--depth-layers", type=int, metavar="N", help="depths of interaction, for the parallax (default: 1)"
    )
    option(crystal, "--intrinsic-fwhm", type=float, metavar="MM", help="blur of the detector, mm (default: 0)")


def chosen_model(arguments: argparse.Namespace, system: PinholeSystem, mu: Volume | None) -> Model:
    """The model that `arguments` ask for; `mu` is what --mu holds."""
    given = {name: getattr(arguments, name) for name in _EMISSION if hasattr(arguments, name)}
    if arguments.inverse_square:
        return InverseSquareSum(system)
    if not arguments.emission:
        return Transmission()
    if mu is not None:
        given["mu"] = mu
    if "opening_angle" in given:
        given["opening_angle"] = math.radians(given["opening_angle"])
    return Emission(system, **given)


def _require_fitting(arguments: argparse.Namespace) -> None:
    """Refuse options that mean nothing with the others."""
    given = [name for name in _EMISSION if hasattr(arguments, name)]
    if given and not arguments.emission:
        raise InputError(f"--{given[0].replace('_', '-')} needs --emission")
    if arguments.noise is not None and not arguments.emission and arguments.photons is None:
        raise InputError("--noise needs --emission or --photons")
    if arguments.center and not arguments.volume:
        raise InputError("--center needs --volume")
    if arguments.energy is not None and not (hasattr(arguments, "mu") or (arguments.volume and not arguments.emission)):
        raise InputError("--energy needs a --volume of CT numbers, or with --emission a --mu of them")


def _attenuation(path: str, energy: str | None) -> Volume:
    """The volume of mu in a file: as it is, or from CT numbers at `energy`."""
    if energy is not None:
        volume = read_volume(path)
        if volume.quantity != "hu":
            raise InputError(f"{path}: it holds {volume.quantity}; --energy is for CT numbers (hu)")
        return hu_to_mu(volume, photon_energy(energy))
    volume = read_volume_of(path, "mu", "; of CT numbers, give --energy to convert them")
    lowest = float(volume.array.min())
    if lowest < -1:  # interpolation may leave values a little below 0
        raise InputError(
            f"{path}: {lowest:g} is no attenuation in 1/mm; if it holds CT numbers, give --energy to convert them"
        )
    return volume


def _volumes(arguments: argparse.Namespace) -> tuple[Volume, Volume | None, dict[str, Any]]:
    """What is projected, what attenuates it, and what a phantom was made from."""
    recipe: dict[str, Any] = {}
    if arguments.phantom:
        quantity = "mu" if arguments.photons is not None else "activity"
        volume, recipe = file_volume(arguments.phantom, arguments, quantity)
    elif not arguments.volume:
        volume, recipe = derenzo_volume(arguments)
    elif arguments.emission:
        volume = read_volume_of(arguments.volume, "activity")
    elif arguments.photons is not None or arguments.energy is not None:
        volume = _attenuation(arguments.volume, arguments.energy)
    else:
        volume = read_volume(arguments.volume)
    mu = _attenuation(arguments.mu, arguments.energy) if hasattr(arguments, "mu") else None
    if arguments.center:
        if mu is not None:
            mu = centered(mu, mu.grid.center - volume.grid.center)
        volume = centered(volume)
    return volume, mu, recipe


def _run(arguments: argparse.Namespace) -> None:
    path = output_path(arguments.output, FORMATS)
    picture = output_path(arguments.mosaic) if arguments.mosaic else None
    system = chosen_modules(read_system(arguments.workbook), arguments.modules)
    _require_fitting(arguments)
    volume, mu, recipe = _volumes(arguments)
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
            "volume": Path(arguments.volume or arguments.phantom or "Derenzo phantom").name,
            **recipe,
            **({"mu_file": Path(arguments.mu).name} if hasattr(arguments, "mu") else {}),
            **({"ct_converted_at_kev": photon_energy(arguments.energy)} if arguments.energy is not None else {}),
            **({"centered": True} if arguments.center else {}),
        },
        model=chosen_model(arguments, system, mu),
        photons=arguments.photons,
        noise_seed=arguments.noise,
        progress=progress_bar("projecting"),
    )
    write_run(run, path)
    if picture is not None:
        write_png(mosaic(run.projections), picture)
    n_v, n_u = run.views.shape
    count, largest = len(run.views), float(np.max(run.projections))
    print(f"{path}: {count} projection{'s' * (count > 1)} of {n_v} x {n_u} pixels, largest {largest:.4g} {run.unit}")
