"""``mphdrr project WORKBOOK --volume FILE -o run.h5``."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from ..geometry.system import PinholeSystem
from ..physics.ct_numbers import hu_to_mu
from ..physics.isotopes import ISOTOPES
from ..physics.materials import APERTURES, CRYSTALS
from ..projector import Emission, InverseSquareSum, Model, Transmission
from ..runs.files import FORMATS, write_run
from ..runs.mosaic import mosaic, write_png
from ..runs.projecting import project_run, warn_of_energy
from ..volumes.rearranging import centered
from ..volumes.volume import LINE_INTEGRALS, Volume
from ..volumes.volume_files import read_volume, read_volume_of
from .options import (
    DERENZO_OPTIONS,
    PLACING_OPTIONS,
    add_command,
    add_phantom_options,
    add_view_options,
    add_workbook,
    chosen_modules,
    number_or_name,
    numbered_path,
    output_path,
    photon_energy,
    progress_bar,
    read_workbook,
    refuse,
)
from .phantom import chosen_phantom, placed_volume

_MOST_MU = 500.0
"""1/mm: more than any material of the tables attenuates photons of 10 keV or more."""
_RAYS = [field.name for field in fields(Transmission)]
"""How many rays a pixel gets, of radiographs and of counts."""
_EMISSION = [field.name for field in fields(Emission) if field.name not in _RAYS]
Source = tuple[Volume, Volume | None, dict[str, Any]]
"""What is projected, what attenuates it, and what to record of them."""


def add_parser(subparsers) -> None:  # type: ignore[no-untyped-def]
    """Add the command."""
    parser = add_command(
        subparsers,
        "project",
        "project a volume, or a phantom, into every module",
        "mphdrr project scanner.xlsx --volume ct.nii.gz --energy 60 --size 250 250 -o run.h5\n"
        "example: mphdrr project scanner.xlsx --volume heart.nii.gz --mu ct-mu.nii.gz --emission --isotope Tc-99m "
        "--time 600 --aperture-points 7 --aperture-mu tungsten --crystal-mu CZT --noise 1 -o counts.h5\n"
        "example: mphdrr project scanner.xlsx --phantom thorax.toml --phantom-mu --emission --isotope Tc-99m -o counts.h5",
    )
    add_workbook(parser)
    source = parser.add_mutually_exclusive_group()
    source.add_argument(
        "--volume", metavar="FILE", help="volume or folder of a DICOM series; without it, a Derenzo phantom is made"
    )
    source.add_argument(
        "--states", nargs="+", metavar="FILE",
        help="volumes of what changes, such as a beating heart: a run of each, as OUTPUT-1, OUTPUT-2 …",
    )  # fmt: skip
    source.add_argument("--phantom", metavar="FILE", help="a phantom's shapes (.toml), put on the grid given below")
    parser.add_argument(
        "--series", metavar="NAME", help="of several DICOM series in --volume, by number, description or UID"
    )
    parser.add_argument(
        "--quantity", choices=LINE_INTEGRALS,
        help="what the values of --volume or --states are; default: what the file says; one that says nothing holds "
        "activity with --emission, mu with --photons, and is else taken for CT numbers",
    )  # fmt: skip
    parser.add_argument(
        "--energy", metavar="KEV",
        help="CT numbers of --volume, --states or --mu become attenuation (1/mm) at this energy, or at an isotope's "
        "strongest line",
    )  # fmt: skip
    parser.add_argument(
        "--center",
        action="store_true",
        help="move the volume's middle to the isocentre, other --states and --mu as far",
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
    models.add_argument(
        "--noise",
        type=int,
        metavar="SEED",
        help="draw Poisson counts instead of their means; of --states, with SEED, SEED + 1 …",
    )
    add_ray_options(parser)
    add_emission_options(parser)
    add_phantom_options(parser.add_argument_group("Derenzo phantom, without --volume, or place of --phantom"))  # type: ignore[arg-type]
    parser.add_argument("-o", "--output", required=True, metavar="FILE", help=", ".join(FORMATS))
    parser.add_argument("--mosaic", metavar="PNG", help="also write all images in one picture")
    parser.set_defaults(run=_run)


def add_ray_options(parser: argparse.ArgumentParser) -> None:
    """How many rays a pixel gets, in the namespace only if it is given."""
    group = parser.add_argument_group("rays of a pixel")
    group.add_argument(
        "--pixel-points", type=_points, metavar="N", default=argparse.SUPPRESS,
        help="points of each pixel's area, for each of the hole; auto: as many as --tolerance asks for "
        "(default: auto for --emission, 1 otherwise: the pixels' centres)",
    )  # fmt: skip
    group.add_argument(
        "--tolerance", type=float, metavar="SHARE", default=argparse.SUPPRESS,
        help="how far off the total of a single voxel may be, in any module (default: 0.02)",
    )  # fmt: skip


def _points(text: str) -> int | None:
    return None if text == "auto" else int(text)


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
    attenuation = source.add_mutually_exclusive_group()
    option(
        attenuation, "--mu", metavar="FILE",
        help="attenuation coefficients, 1/mm, on any grid, or with --energy CT numbers (a DICOM folder, too); "
        "without it, none",
    )  # fmt: skip
    attenuation.add_argument(
        "--phantom-mu", action="store_true", help="the phantom's own attenuation coefficients, on its activity's grid"
    )
    source.add_argument("--mu-series", metavar="NAME", help="of several DICOM series in --mu, as --series")
    aperture = parser.add_argument_group("--emission: the pinhole")
    option(aperture, "--aperture-points", type=int, metavar="N", help="points of the hole that rays pass (default: 1)")
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
    """The model that `arguments` ask for; `mu` is what attenuates."""
    rays = {name: getattr(arguments, name) for name in _RAYS if hasattr(arguments, name)}
    if arguments.inverse_square:
        return InverseSquareSum(system)
    if not arguments.emission:
        return Transmission(**rays)
    given = {name: getattr(arguments, name) for name in _EMISSION if hasattr(arguments, name)} | rays | {"mu": mu}
    if "opening_angle" in given:
        given["opening_angle"] = math.radians(given["opening_angle"])
    return Emission(system, **given)


def _require_fitting(arguments: argparse.Namespace) -> None:
    """Refuse options that would have no effect beside the others."""
    if arguments.inverse_square:
        refuse(arguments, _RAYS, "is not for --inverse-square")
    if not arguments.emission:
        refuse(arguments, (*_EMISSION, "phantom_mu", "mu_series"), "needs --emission")
        if arguments.photons is None:
            refuse(arguments, ("noise",), "needs --emission or --photons")
    if arguments.volume or arguments.states:
        source = "--volume" if arguments.volume else "--states"
        refuse(arguments, (*DERENZO_OPTIONS, *PLACING_OPTIONS, "phantom_mu"), f"is for a phantom, not for {source}")
    else:
        refuse(arguments, ("center",), "needs --volume or --states")
        if arguments.phantom:
            refuse(arguments, DERENZO_OPTIONS, "is for the Derenzo phantom, not for --phantom")
    if not arguments.volume:
        refuse(arguments, ("series",), "needs --volume")
        if not arguments.states:
            refuse(arguments, ("quantity",), "needs --volume or --states")
    if arguments.energy is not None and not arguments.emission:
        refuse(arguments, ("quantity",), "has no effect beside --energy, which takes CT numbers")
    if "mu" not in arguments:
        refuse(arguments, ("mu_series",), "needs --mu")
        if arguments.emission or not (arguments.volume or arguments.states):
            refuse(arguments, ("energy",), "needs a --volume of CT numbers, or with --emission a --mu of them")
    if "aperture_mu" not in arguments:
        refuse(arguments, ("edge",), "needs --aperture-mu")
        if "within_cone" not in arguments:
            refuse(arguments, ("opening_angle",), "needs --aperture-mu or --within-cone")
    if arguments.backend in ("cuda", "torch"):
        refuse(arguments, ("threads",), f"is for cpu and numpy: {arguments.backend} has threads of its own")


def _attenuation(path: str, energy: str | None, series: str | None) -> Volume:
    """The volume of mu in a file: as it is, or from CT numbers at `energy`."""
    progress = progress_bar("reading")
    if energy is not None:
        volume = read_volume(path, series=series, progress=progress)
        if volume.quantity != "hu":
            raise InputError(f"{path}: it holds {volume.quantity}; --energy is for CT numbers (hu)")
        return hu_to_mu(volume, photon_energy(energy))
    advice = "; of CT numbers, give --energy to convert them"
    volume = read_volume_of(path, "mu", advice, series=series, progress=progress)
    lowest, highest = float(volume.array.min()), float(volume.array.max())
    if lowest < -1 or highest > _MOST_MU:  # interpolation may leave values a little below 0
        raise InputError(
            f"{path}: {lowest if lowest < -1 else highest:g} is no attenuation in 1/mm; if it holds CT numbers, give "
            "--energy to convert them"
        )
    return volume


def _volume(path: str, arguments: argparse.Namespace) -> Volume:
    """What a file of --volume or --states holds; what the chosen model has no meaning for is refused."""
    if arguments.quantity is not None:
        return read_volume(path, arguments.quantity, series=arguments.series, progress=progress_bar("reading"))
    if arguments.emission:
        volume = read_volume_of(path, "activity", series=arguments.series, progress=progress_bar("reading"))
        lowest, highest = float(volume.array.min()), float(volume.array.max())
        if lowest < -0.1 * highest:  # interpolation leaves less
            raise InputError(
                f"{path}: values of {lowest:g} to {highest:g}, as of a CT, are no activity; --quantity activity takes them "
                "as such"
            )
        return volume
    if arguments.photons is not None or arguments.energy is not None:
        return _attenuation(path, arguments.energy, arguments.series)
    volume = read_volume(path, series=arguments.series, progress=progress_bar("reading"))
    if volume.quantity == "hu":
        raise InputError(
            f"{path}: it holds CT numbers (hu), or says nothing and is taken for them; give --energy KEV to convert them "
            "to attenuation, or --quantity mu or activity if that is what the values are"
        )
    return volume


def _of_files(files: Sequence[str], mu: Volume | None, arguments: argparse.Namespace) -> Iterator[Source]:
    """The volumes of --volume or --states, one at a time; with --center all are moved as the first, mu too."""
    middle = None
    for file in files:
        volume = _volume(file, arguments)
        settings: dict[str, Any] = {"volume": Path(file).name}
        if arguments.center:
            if middle is None:
                middle = volume.grid.center
                mu = None if mu is None else centered(mu, mu.grid.center - middle)
            volume = centered(volume, volume.grid.center - middle)
            settings["centered"] = True
        yield volume, mu, settings


def _of_phantom(mu: Volume | None, model: Model, arguments: argparse.Namespace) -> Iterator[Source]:
    """The phantom, attenuated by itself with --phantom-mu."""
    phantom, settings = chosen_phantom(arguments, arguments.phantom)
    settings = {"volume": Path(arguments.phantom or "Derenzo phantom").name, **settings}
    if arguments.phantom_mu:
        if all(shape.mu is None for shape in phantom.shapes):
            raise InputError(f"--phantom-mu: no shape of the {phantom.title} has a mu")
        warn_of_energy(model, phantom.mu_energy, f"the mu of the {phantom.title}")
        mu = placed_volume(phantom, arguments, "mu")
        settings["mu_of_phantom_at_kev"] = phantom.mu_energy
    quantity = "mu" if arguments.phantom and arguments.photons is not None else "activity"
    yield placed_volume(phantom, arguments, quantity), mu, settings


def _run(arguments: argparse.Namespace) -> None:
    path = output_path(arguments.output, FORMATS)
    picture = output_path(arguments.mosaic) if arguments.mosaic else None
    _require_fitting(arguments)
    system = chosen_modules(read_workbook(arguments), arguments.modules)
    model = chosen_model(arguments, system, None)  # before the long work: it says what cannot be
    files = arguments.states or ([arguments.volume] if arguments.volume else [])
    count = max(1, len(files))
    outputs = {numbered_path(path, number, count).resolve() for number in range(1, count + 1)}
    for file in (*files, *([arguments.mu] if "mu" in arguments else [])):
        if Path(file).resolve() in outputs:
            raise InputError(f"{file}: the projections would replace what they are made from; choose another --output")
    mu = _attenuation(arguments.mu, arguments.energy, arguments.mu_series) if "mu" in arguments else None
    if mu is not None and arguments.energy is not None:
        warn_of_energy(model, photon_energy(arguments.energy), f"the mu of {Path(arguments.mu).name}")
    sources = _of_files(files, mu, arguments) if files else _of_phantom(mu, model, arguments)
    for number, (volume, mu_of_it, settings) in enumerate(sources, 1):
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
                **settings,
                **({"mu_file": Path(arguments.mu).name} if "mu" in arguments else {}),
                **({"ct_converted_at_kev": photon_energy(arguments.energy)} if arguments.energy is not None else {}),
            },
            model=chosen_model(arguments, system, mu_of_it),
            photons=arguments.photons,
            # Noise of its own for each state.
            noise_seed=None if arguments.noise is None else arguments.noise + number - 1,
            progress=progress_bar("projecting"),
        )
        file = numbered_path(path, number, count)
        write_run(run, file)
        if picture is not None:
            write_png(mosaic(run.projections), numbered_path(picture, number, count))
        n_v, n_u = run.views.shape
        views, largest = len(run.views), float(np.max(run.projections))
        print(
            f"{file}: {views} projection{'s' * (views > 1)} of {n_v} x {n_u} pixels, largest {largest:.4g} {run.unit}"
        )
