"""Command ``mphdrr phantom KIND -o FILE``, and the parsers of kinds of phantoms for other commands."""

import argparse
import dataclasses
import json
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from ... import core as mph
from ..arrays import Floats
from ..phantoms.kinds import KINDS
from ..phantoms.phantom import QUANTITIES
from ..validation import seed_number, shape_text, whole_shape
from ..volumes.volume import UNITS
from ..volumes.volume_files import VOLUME_FORMATS
from .options import add_actions, add_command, expand_to_three, numbered_path, output_path, progress_bar, refuse

_PREFIX = "of_phantom_"  # tells a phantom's setting from an option of the same name, such as the voxels' spacing

Make = Callable[[argparse.Namespace], mph.Phantom]
"""Function that makes a phantom from the parsed arguments."""

# Single shapes: class, number of values (mm) of each dimension as `nargs` of argparse, and an example.
_SHAPES = (
    (mph.Cylinder, {"radius": "+", "height": None}, "--radius 100 --height 200 --activity 5 --mu 0.0154"),
    (mph.Sphere, {"radius": None}, "--radius 20 --activity 40"),
    (mph.Ellipsoid, {"radii": 3}, "--radii 30 20 50 --activity 40"),
    (mph.Box, {"size": 3}, "--size 30 20 50 --activity 40"),
)


def add_parser(subparsers) -> None:  # type: ignore[no-untyped-def]
    """Add the command ``mphdrr phantom`` with a subcommand for each kind of phantom."""
    kinds = add_actions(subparsers, "phantom", "mphdrr phantom derenzo -o derenzo.nii.gz", "KIND")

    def finish(parser: argparse.ArgumentParser, make: Make, beats: bool) -> None:
        """Add the options of the output, and --frames for a phantom that beats."""
        if beats:
            states = "number of states of the heart's cycle, as FILE-1, FILE-2 …, instead of one --phase"
            parser.add_argument("--frames", type=int, default=argparse.SUPPRESS, metavar="N", help=states)
        _add_output(parser, make)

    add_kinds(kinds, "make", "mphdrr phantom {} -o {}.nii.gz", finish)


def add_kinds(
    kinds: Any, verb: str, example: str, finish: Callable[[argparse.ArgumentParser, Make, bool], None]
) -> None:
    """Add a parser for every kind of phantom, every single shape and a phantom's file, with the options that describe it.

    `finish` adds what the command does with the phantom; it is called with the parser, the function that makes the phantom
    from the parsed arguments, and whether the phantom beats. `example` is a template of the kind with its options, and of
    its name.
    """

    def add(name: str, summary: str, options: str) -> argparse.ArgumentParser:
        """Add a subcommand whose example has these options."""
        return add_command(kinds, name, summary, example.format(f"{name} {options}", name))

    for kind in KINDS:
        parser = add(kind.name, f"{verb} {kind.summary}", kind.example)
        if kind.phantom is mph.DerenzoPhantom:  # its rods and water have options of their own
            _add_derenzo(parser)
            finish(parser, _make_derenzo, False)
            continue
        _add_settings(parser, kind.phantom)
        finish(parser, partial(_make_phantom, kind.phantom), hasattr(kind.phantom, "beating"))
    for shape, dimensions, options in _SHAPES:
        parser = add(shape.KIND, f"{verb} one {shape.KIND}", options)
        for dimension, count in dimensions.items():
            parser.add_argument(f"--{dimension}", type=float, nargs=count, required=True, metavar="MM")
        parser.add_argument("--activity", type=float, default=100.0, metavar="kBq/mL", help="concentration")
        parser.add_argument("--mu", type=float, default=0.0, metavar="1/mm", help="attenuation coefficient")
        finish(parser, partial(_make_shape_phantom, shape, list(dimensions)), False)
    options = example.format("file thorax.toml", "thorax")
    file = add_command(kinds, "file", f"{verb} the phantom that a TOML file describes", options)
    file.add_argument("file", metavar="TOML", help="shapes in the order of painting, see docs/phantoms.md")
    finish(file, lambda arguments: mph.read_phantom(arguments.file), False)


def _add_derenzo(parser: argparse.ArgumentParser) -> None:
    """Add the options of a Derenzo phantom."""
    add = parser.add_argument
    add("--radius", type=float, default=40.0, metavar="MM", help="radius of the phantom")
    add("--rods", type=float, nargs="+", default=[8, 6, 5, 4, 3, 2], metavar="MM", help="rod diameters")
    add("--sectors", type=int, default=6, metavar="N", help="number of sectors, each with rods of one diameter")
    add("--height", type=float, default=40.0, metavar="MM", help="length of the rods")
    add("--activity", type=float, default=100.0, metavar="kBq/mL", help="concentration in the rods; 0 for cold rods")
    water = "cylinder of water around the rods, mm; default: none"
    add("--water", type=float, nargs=2, default=[0, 0], metavar=("RADIUS", "HEIGHT"), help=water)
    add("--background", type=float, default=0.0, metavar="kBq/mL", help="concentration in the water")
    add("--altered", type=int, default=0, metavar="N", help="N omits rod N, -N adds one to sector N, before its rows")


def _make_derenzo(arguments: argparse.Namespace) -> mph.Phantom:
    """Return the Derenzo phantom that the options describe."""
    radius, height = arguments.water
    return mph.DerenzoPhantom(arguments.radius, tuple(arguments.rods), arguments.height, arguments.activity,
                              arguments.sectors, cylinder_radius=radius, cylinder_height=height,
                              background=arguments.background, altered=arguments.altered)  # fmt: skip


def _make_shape_phantom(shape: Any, names: list[str], arguments: argparse.Namespace) -> mph.Phantom:
    """Return the phantom of one shape; `names` are the options that hold its dimensions."""
    dimensions = {name: getattr(arguments, name) for name in names}
    if isinstance(dimensions.get("radius"), list) and len(dimensions["radius"]) == 1:
        (dimensions["radius"],) = dimensions["radius"]
    return mph.ShapePhantom([shape(**dimensions, activity=arguments.activity, mu=arguments.mu)], name=shape.KIND)


def _make_phantom(kind: Any, arguments: argparse.Namespace) -> mph.Phantom:
    """Return the phantom of a kind, with the fields that the options of `_add_settings` hold."""
    return kind(**{field.name: getattr(arguments, _PREFIX + field.name) for field in dataclasses.fields(kind)})


def _add_settings(parser: argparse.ArgumentParser, kind: Any) -> None:
    """Add an option for every field of a kind of phantom."""
    fields: tuple[Any, ...] = dataclasses.fields(kind)
    for field in fields:
        metadata, is_tuple = field.metadata, isinstance(field.default, tuple)
        option: dict[str, Any] = {"dest": _PREFIX + field.name, "help": metadata["text"]}
        option["default"] = list(field.default) if is_tuple else field.default
        option |= {"nargs": len(field.default)} if is_tuple else {}
        if "choices" in metadata:
            option["choices"] = metadata["choices"]
        elif "unit" not in metadata:
            option |= {"type": int, "metavar": "N"}
        elif metadata["unit"].startswith("of "):
            option |= {"type": float, "metavar": "FRACTION", "help": f"fraction {metadata['unit']}, {metadata['text']}"}
        else:
            option |= {"type": float, "metavar": "MM" if metadata["unit"] == "mm" else metadata["unit"]}
        parser.add_argument("--" + (metadata.get("option") or field.name.replace("_", "-")), **option)


def add_pose(parser: argparse.ArgumentParser, default: Any = (0, 0, 0)) -> None:
    """Add the options of a phantom's position and angles, for `read_pose`."""
    add, default = parser.add_argument, list(default) if isinstance(default, tuple) else default
    add("--position", type=float, nargs=3, default=default, metavar="MM", help="centre of the phantom, x y z")
    euler = "phi theta psi: psi about its own axis, theta about y, phi about z"
    add("--euler", type=float, nargs=3, default=default, metavar="DEG", help=euler)


def read_pose(arguments: argparse.Namespace) -> Floats:
    """Return the phantom's pose (4, 4), world from phantom, mm, that the options of `add_pose` ask for."""
    phi, theta, psi = np.deg2rad(arguments.euler)
    return mph.euler_pose(phi, theta, psi, arguments.position)


def _add_output(parser: argparse.ArgumentParser, make: Make) -> None:
    """Add the options of the phantom's pose, the grid and the files to write; `make` builds the phantom of the options."""
    add_pose(parser)
    add = parser.add_argument
    add("--voxels", type=int, nargs="+", default=[256], metavar="N", help="voxels along x y z, or one number for all")
    add("--spacing", type=float, nargs="+", metavar="MM", help="voxel size, one or three; default: fits the phantom")
    add("--quantity", choices=QUANTITIES, default="activity", help="quantity of the voxels' values")
    add("--random", type=int, metavar="SEED", help="draw position and Euler angles at random")
    box = "with --random: sides of the box around --position in which the centre is drawn"
    add("--box", type=float, nargs="+", default=[0], metavar="MM", help=box)
    add("--count", type=int, default=1, metavar="N", help="with --random: number of phantoms, as FILE-1, FILE-2 …")
    add("--json", action="store_true", help="print what was written, with the poses, as JSON")
    add("-o", "--output", required=True, metavar="FILE", help=f"{', '.join(VOLUME_FORMATS)}; .toml writes the shapes")
    parser.set_defaults(run=_run, make=make)


def _refuse_contradictions(arguments: argparse.Namespace, is_text: bool) -> None:
    """Raise `InputError` for options that contradict each other or would have no effect."""
    if arguments.count < 1:
        raise mph.InputError(f"--count: expected at least 1, got {arguments.count}")
    if arguments.random is None:
        if arguments.count > 1 or any(arguments.box):
            raise mph.InputError("--count and --box need --random")
    else:
        seed_number(arguments.random, "--random", "a seed, ")
        refuse(arguments, ("euler",), "has no effect with --random, which draws the angles")
    if "frames" in arguments:
        refuse(arguments, (f"{_PREFIX}phase",), "has no effect with --frames, which takes phases evenly over the cycle")
    if is_text:
        reason = f"is of voxels, but a .toml holds only the shapes; expected {', '.join(VOLUME_FORMATS)}"
        refuse(arguments, ("position", "euler", "voxels", "spacing", "quantity", "random", "frames", "json"), reason)


def _run(arguments: argparse.Namespace) -> None:
    """Write the phantom as volumes, or its shapes as TOML."""
    path = output_path(arguments.output, (*VOLUME_FORMATS, ".toml"))
    is_text = path.suffix.lower() == ".toml"
    _refuse_contradictions(arguments, is_text)
    phantom = arguments.make(arguments)
    if is_text:
        mph.write_phantom(phantom, path)
        print(f"{path}: {len(phantom.shapes)} shapes, {phantom.total_activity:.4g} kBq in all")
        return
    states = phantom.beating(arguments.frames) if "frames" in arguments else [phantom]
    box = expand_to_three(arguments.box)
    # By default the grid holds the phantom however it is turned, and moved within the box.
    voxels = whole_shape(expand_to_three(arguments.voxels), "--voxels", 3)
    fitted_spacing = (max(state.extent for state in states) + max(box)) / max(1, min(voxels) - 2)
    grid = mph.Grid.centered(voxels, expand_to_three(arguments.spacing or [fitted_spacing]), arguments.position)
    pose = read_pose(arguments)
    rng = None if arguments.random is None else np.random.default_rng(arguments.random)
    n_files, written = arguments.count * len(states), []
    for index in range(n_files):
        state = states[index % len(states)]
        if rng is not None and state is states[0]:  # the other states take the same pose
            pose = mph.random_pose(rng, box, arguments.position)
        volume = state.voxelize(grid, pose, progress_bar("voxelizing"), quantity=arguments.quantity)
        file = numbered_path(path, index + 1, n_files)
        mph.write_volume(volume, file)
        entry = {"file": str(file), "pose": pose.tolist(), "quantity": volume.quantity}
        if UNITS[volume.quantity] == "kBq/mL":
            total = float(volume.array.sum(dtype=np.float64) * volume.grid.voxel_volume * 1e-3)
            entry["total_kBq"], content_text = total, f"{total:.4g} kBq in all"
        else:
            entry["largest"] = float(volume.array.max())
            content_text = f"mu up to {entry['largest']:.4g} 1/mm"
        written.append({**entry, "phase": state.phase} if len(states) > 1 else entry)
        if not arguments.json:
            print(f"{file}: {shape_text(volume.grid.shape)} voxels, {content_text}")
    if arguments.json:
        print(json.dumps(written, indent=2))
