"""Action ``mphdrr geometry generate SHAPE -o FILE``: workbooks of scanners from a few parameters."""

import argparse
from collections.abc import Callable
from typing import Any

import numpy as np

from .... import core as mph
from ..options import add_command, add_run, output_path

# Option -> field of the scanner, default value, mm, and help text.
_SIZES = {
    "--d": ("pinhole_diameter", 2.3, "pinhole diameter"),
    "--Ld": ("detector_side", 50.0, "side of the crystal"),
    "--Td": ("detector_thickness", 10.0, "thickness of the crystal"),
    "--R": ("roi_radius", 75.0, "ROI radius"),
    "--l": ("collimator_length", None, "collimator length; default: the module just sees the ROI"),
}


def add_parser(actions) -> None:  # type: ignore[no-untyped-def]
    """Add the action ``geometry generate`` with its shapes."""
    example = "mphdrr geometry generate ellipse --semi-axes 273 220.5 --z -71 -24 --mirrored -o scanner.xlsx"
    generate = add_command(actions, "generate", "make the workbook of a scanner from a few parameters", example)
    shapes = generate.add_subparsers(metavar="SHAPE", required=True)
    parser = add_run(shapes, "ellipse", _ellipse)
    add = parser.add_argument
    add("--modules", type=int, default=20, metavar="M", help="modules of each ring")
    add("--semi-axes", type=float, nargs="+", required=True, metavar="MM", help="along x and y, or a circle's radius")
    add("--center", type=float, nargs=2, default=[0, 0], metavar="MM", help="centre of the ellipse, x y")
    add("--rotation", type=float, default=0.0, metavar="DEG", help="rotation of the ellipse about its centre")
    add("--start", type=float, default=0.0, metavar="DEG", help="azimuth of a ring's first module")
    add("--end", type=float, default=360.0, metavar="DEG", help="azimuth of its last; a full turn gives a closed ring")
    add("--spacing", choices=("angle", "arc"), default="angle", help="equal steps in angle, or in arc")
    _add_modules(parser)
    parser = add_run(shapes, "plates", _plates)
    add = parser.add_argument
    add("--modules", type=int, nargs="+", default=[4], metavar="N", help="modules of a plate in a ring, or one for all")
    plates = parser.add_mutually_exclusive_group(required=True)
    plates.add_argument("--polygon", type=int, metavar="SIDES", help="plates of a regular polygon, with --apothem")
    plates.add_argument("--vertices", type=float, nargs="+", metavar="MM", help="x y x y ... of the plates' edges")
    add("--apothem", type=float, metavar="MM", help="distance of the polygon's plates")
    add("--rotation", type=float, default=0.0, metavar="DEG", help="azimuth of its first plate")
    add("--open", action="store_true", help="no plate joins the last vertex to the first")
    _add_modules(parser)
    for name, run, arrangement in (("xray-arc", _xray_arc, mph.xray_arc), ("xray-ring", _xray_ring, mph.xray_ring)):
        _add_xray(add_run(shapes, name, run), arrangement)


def _add_xray(parser: argparse.ArgumentParser, arrangement: Callable[..., mph.XraySystem]) -> None:
    """Add the options of an arrangement of X-ray sources; an option that is not typed keeps the arrangement's default."""
    parser.set_defaults(arrangement=arrangement)
    add = parser.add_argument
    add("--sources", dest="n", type=int, metavar="N", help="number of sources (default: 24)")
    if arrangement is mph.xray_arc:
        add("--end", type=float, metavar="DEG", help="azimuth of the last source")
    add("--start", type=float, metavar="DEG", help="azimuth of the first source")
    add("--z", type=float, metavar="MM", help="z of the sources")
    add("--source-radius", type=float, metavar="MM", help="distance of the sources from the isocentre")
    add("--panel-radius", type=float, metavar="MM", help="distance of the panels' centres from the isocentre")
    add("--panel-size", type=float, nargs=2, metavar="MM", help="width and height of a panel")
    add("--size", dest="shape", type=int, nargs=2, metavar=("ROWS", "COLUMNS"), help="pixels of a panel")
    add("--kvp", type=float, metavar="KV", help="tube voltage")
    add("--mas", type=float, metavar="MAS", help="charge of an exposure")
    add("--filters", metavar="TEXT", help='filters of the tubes, mm of each material, such as "Al 2.5 + Cu 0.1"')
    add("--into", metavar="FILE", help="workbook, such as the pinholes', to a copy of which a sheet is added")
    add("-o", "--output", required=True, metavar="FILE", help=".xlsx")


def _add_modules(parser: argparse.ArgumentParser) -> None:
    """Add the options of the rings' positions and of the modules."""
    parser.add_argument("--z", type=float, nargs="+", required=True, metavar="MM", help="z of each ring")
    parser.add_argument("--mirrored", action="store_true", help="add the rings' mirror images at z = 0")
    group = parser.add_argument_group("the modules")
    for name, (field, default, text) in _SIZES.items():
        group.add_argument(name, dest=field, type=float, default=default, metavar="MM", help=text)
    parser.add_argument("-o", "--output", required=True, metavar="FILE", help=".xlsx")


def _write(arguments: argparse.Namespace, make: Callable[..., mph.PinholeSystem], *shape: Any, **options: Any) -> None:
    """Write the workbook of the scanner that `make` returns for a shape and the options of `_add_modules`."""
    path = output_path(arguments.output, (".xlsx",))
    modules = {name: getattr(arguments, name) for name in ("z", "mirrored", *(size for size, _, _ in _SIZES.values()))}
    system = make(*shape, **options, **modules)
    mph.write_system(system, path)
    b, l = system.pinhole_distance, system.collimator_length
    print(f"{path}: {len(system)} modules, b {b.min():.2f} to {b.max():.2f} mm, l {l.min():.2f} to {l.max():.2f} mm")


def _ellipse(arguments: argparse.Namespace) -> None:
    """Arrange rings of modules on an ellipse.

    mphdrr geometry generate ellipse --modules 20 --semi-axes 273 220.5 --center 42.43 -42.43 --start 14.25 --end 255.6
        --spacing arc --z -71 -24 --mirrored -o scanner.xlsx
    """
    semi_axes = arguments.semi_axes[0] if len(arguments.semi_axes) == 1 else arguments.semi_axes
    start, end, rotation = np.deg2rad([arguments.start, arguments.end, arguments.rotation])
    arc_options = {"start": start, "end": end, "spacing": arguments.spacing}
    ellipse_options = {"center": arguments.center, "rotation": rotation}
    _write(arguments, mph.ellipse_rings, arguments.modules, semi_axes, **arc_options, **ellipse_options)


def _plates(arguments: argparse.Namespace) -> None:
    """Arrange rings of modules on flat plates.

    mphdrr geometry generate plates --polygon 5 --apothem 220 --modules 4 --z -71 -24 --mirrored -o scanner.xlsx
    """
    if (arguments.polygon is None) != (arguments.apothem is None):
        raise mph.InputError("--polygon and --apothem: expected both, or --vertices")
    if arguments.polygon is not None:
        vertices = mph.regular_polygon(arguments.polygon, arguments.apothem, float(np.deg2rad(arguments.rotation)))
    elif len(arguments.vertices) % 2:
        raise mph.InputError(f"--vertices: expected x and y of each vertex, got {len(arguments.vertices)} numbers")
    else:
        vertices = np.reshape(arguments.vertices, (-1, 2))
    counts = arguments.modules[0] if len(arguments.modules) == 1 else arguments.modules
    _write(arguments, mph.plate_rings, counts, vertices, closed=not arguments.open)


def _xray_arc(arguments: argparse.Namespace) -> None:
    """Arrange X-ray sources on an arc, each with its panel opposite.

    mphdrr geometry generate xray-arc --sources 24 --start -98 --end 8 --into scanner.xlsx -o both.xlsx
    """
    _write_xray(arguments)


def _xray_ring(arguments: argparse.Namespace) -> None:
    """Arrange a ring of X-ray sources above the modules, each with its tilted panel below.

    mphdrr geometry generate xray-ring --sources 24 --z 310 --into scanner.xlsx -o both.xlsx
    """
    _write_xray(arguments)


def _write_xray(arguments: argparse.Namespace) -> None:
    """Write the workbook of the arrangement of X-ray sources that the options describe."""
    names = ("n", "start", "end", "z", "source_radius", "panel_radius", "panel_size", "shape", "kvp", "mas", "filters")
    parameters = {name: value for name in names if (value := getattr(arguments, name, None)) is not None}
    parameters |= {name: float(np.deg2rad(parameters[name])) for name in ("start", "end") if name in parameters}
    path = output_path(arguments.output, (".xlsx", ".xlsm"))
    system = arguments.arrangement(**parameters)
    mph.write_system(system, path, arguments.into)
    distances = np.linalg.norm(system.panel_centers - system.sources, axis=1)
    print(f"{path}: {len(system)} sources, {distances.min():.2f} to {distances.max():.2f} mm from their panels")
