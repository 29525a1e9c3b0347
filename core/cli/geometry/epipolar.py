"""Action ``mphdrr geometry epipolar FILE --pixel MODULE:COLUMN,ROW``: a pixel's ray in all views, or a point from pixels."""

import argparse
import math
from typing import Any

import numpy as np

from .... import core as mph
from ...arrays import Array, table_rows
from ...errors import expecting
from ...geometry.scanner import Scanner
from ..options import print_answer
from ..scanners import chosen_modules, read_any_scanner
from .arguments import add_action, add_views, chosen_views

_SIGNIFICANCE = 0.01
"""Probability of the worst misfit by chance, over all modules, below which the module is said not to fit."""


def add_parser(actions) -> None:  # type: ignore[no-untyped-def]
    """Add the action ``geometry epipolar``."""
    parser = add_action(actions, "epipolar", _run)
    add = parser.add_argument
    pixel = "module number, column and row of its image, from 0; several: pixels of one point, whose position is sought"
    add("--pixel", action="append", required=True, metavar="MODULE:COLUMN,ROW", help=pixel)
    depth = "for one pixel: depths of its ray's ends, or a single depth, mm from the pinhole; default: across the ROI"
    add("--depth", type=float, nargs="+", metavar="MM", help=depth)
    add("--sigma", type=float, metavar="PX", help="for several: standard deviation of columns and rows (default: 1)")
    add("--modules", metavar="RANGE", help="modules to list, such as 1-40 or 1-20,41; default: all")
    add_views(parser, "pixels of the images")


def _run(arguments: argparse.Namespace) -> None:
    """Show where all modules see the ray of one module's pixel; or find a point from its pixels in several modules.

    mphdrr geometry epipolar scanner.xlsx --pixel 7:120,130
    mphdrr geometry epipolar scanner.xlsx --pixel 7:120,130 --pixel 31:99.4,140.2 --pixel 52:131,88 --sigma 0.5
    """
    system = read_any_scanner(arguments)
    pixels = [_parse_pixel(system, text) for text in arguments.pixel]
    views = chosen_views(system, arguments)
    if len(pixels) == 1:
        if arguments.sigma is not None:
            raise mph.InputError("--sigma: expected several --pixel, whose point is sought")
        _print_ray(arguments, system, views, *pixels[0])
        return
    for name in ("depth", "modules"):
        if getattr(arguments, name) is not None:
            raise mph.InputError(f"--{name}: expected one --pixel; the place sought is the same for several")
    _print_point(arguments, system, views, pixels)


def _print_ray(arguments: argparse.Namespace, system: Scanner, views: mph.Views, m: int, pixel: list[float]) -> None:
    """Print the image, in every view, of the ray of one pixel (column, row) of module index `m`, and the epipoles."""
    near, far = _depth_range(arguments.depth, system, m)
    segments = mph.epipolar_segments(views, m, pixel, near, far)
    ends = mph.points_at_depths(views, m, pixel, np.array([near, far]))
    n_v, n_u = views.shape
    rows: list[dict[str, Any]] = []
    is_listed = np.isin(system.numbers, chosen_modules(system, arguments.modules).numbers)
    for n in map(int, np.flatnonzero(is_listed)):
        near_end, far_end = map(_to_list, segments[n])
        rows.append({"number": int(system.numbers[n]), "from": near_end, "to": far_end})
        if n == m:
            rows[-1] |= {"line": None, "epipole": None}
            continue
        epipole = mph.epipole(views, m, n)
        epipole_pixel = epipole[:2] / epipole[2] if epipole[2] > 0 else np.full(2, np.nan)
        is_inside = (epipole_pixel >= -0.5).all() and (epipole_pixel <= [n_u - 0.5, n_v - 0.5]).all()
        line = _to_list(mph.epipolar_lines(views, m, n, pixel))
        rows[-1] |= {"line": line, "epipole": _to_list(epipole_pixel) if is_inside else None}
    module_number = int(system.numbers[m])
    record = {"module": module_number, "pixel": pixel, "depths": [near, far], "points": ends.tolist(), "modules": rows}
    text = f"module {module_number}, pixel ({pixel[0]:g}, {pixel[1]:g})"
    start, end = (" ".join(f"{x:.2f}" for x in point) for point in ends)
    if near == far:
        lines = [f"{text} at a depth of {near:.2f} mm: ({start}) mm", " module     column, row      epipole"]
    else:
        lines = [f"{text} from a depth of {near:.2f} to {far:.2f} mm: from ({start}) to ({end}) mm"]
        lines += [" module  from column, row    to column, row       epipole"]
    shown_names = ("from", "epipole") if near == far else ("from", "to", "epipole")
    for row in rows:
        pixels = "".join(f"{_pixel_text(row[name]):>18}" for name in shown_names)
        lines.append(f"{row['number']:7d}{pixels.rstrip()}")
    seeing = sum(row["from"] is not None for row in rows)
    lines += [f"{seeing} of {len(rows)} modules have it in their image; the epipole is where a module has the pinhole"]
    print_answer(arguments, {**record, "units": "pixels, mm"}, lines)


def _print_point(
    arguments: argparse.Namespace, system: Scanner, views: mph.Views, pixels: list[tuple[int, list[float]]]
) -> None:
    """Print the point that fits the pixels best, its uncertainty and the residuals; `pixels` has (module index, pixel)."""
    module_indices = np.array([m for m, _ in pixels])
    numbers = system.numbers[module_indices].tolist()
    if repeated := [number for number in numbers if numbers.count(number) > 1]:
        raise mph.InputError(f"--pixel: expected one pixel of each module, got several of module {repeated[0]}")
    sigma = 1.0 if arguments.sigma is None else arguments.sigma
    fit = mph.fit_marker(views, module_indices, [pixel for _, pixel in pixels], sigma)
    worst, level = fit.worst, _SIGNIFICANCE / len(numbers)
    worst = worst if worst is not None and fit.misfit_p_values[worst] < level else None
    columns = {"number": system.numbers[module_indices], "column": fit.residuals[:, 0], "row": fit.residuals[:, 1]}
    rows = table_rows({**columns, "misfit": fit.misfits, "p_value": fit.misfit_p_values})
    modules = [{name: None if x != x else x for name, x in row.items()} for row in rows]  # no NaN in JSON
    names = ("point", "standard_deviations", "covariance", "chi2", "degrees", "p_value")
    record = {name: np.asarray(getattr(fit, name)).tolist() for name in names} | {"sigma": sigma, "modules": modules}
    record |= {"misfitting": None if worst is None else numbers[worst], "units": "mm, mm^2, pixels"}
    axes = zip("xyz", fit.point, fit.standard_deviations, strict=True)
    lines = ["point " + "   ".join(f"{axis} {x:.3f} +- {sd:.3f}" for axis, x, sd in axes) + " mm"]
    lines += [" module  residual column       row    misfit     chance"]
    for row in rows:
        has_misfit = row["misfit"] == row["misfit"]
        misfit = " {misfit:9.2f} {p_value:10.2g}" if has_misfit else "         -          -"
        lines.append(f"{{number:7d}} {{column:16.3f}} {{row:9.3f}}{misfit}".format(**row))
    chance_text = f"a chance of {fit.p_value:.2g} if sigma is {sigma:g} px"
    lines += [f"chi2 {fit.chi2:.2f} of {fit.degrees} degrees of freedom, {chance_text}"]
    if worst is not None:
        lines += [f"module {numbers[worst]} does not fit: without it chi2 falls by {fit.misfits[worst]:.2f}"]
    elif fit.p_value < _SIGNIFICANCE:
        lines += ["they do not fit together, and nothing says which is wrong"]
    else:
        lines += ["they fit together"]
    print_answer(arguments, record, lines)


def _parse_pixel(system: Scanner, text: str) -> tuple[int, list[float]]:
    """Return the module's index, and its column and row, from a text ``MODULE:COLUMN,ROW``."""
    module, _, position_text = text.partition(":")
    with expecting(f"--pixel {text!r}: expected MODULE:COLUMN,ROW, such as 7:120,130.5"):
        number, (column, row) = int(module), map(float, position_text.split(","))
        if not (math.isfinite(column) and math.isfinite(row)):
            raise ValueError
    if not len(index := np.flatnonzero(system.numbers == number)):
        lowest, highest = system.numbers.min(), system.numbers.max()
        raise mph.InputError(f"--pixel {text!r}: no module {number}; there are {lowest} to {highest}")
    return int(index[0]), [column, row]


def _depth_range(depths: list[float] | None, system: Scanner, m: int) -> tuple[float, float]:
    """Return the depths, mm from the pinhole, between which a ray is shown: as typed, else across the ROI of module `m`."""
    if depths is None:
        distance = float(np.linalg.norm(system.poses()[m, :3, 3]))
        radius = float(system.roi_radii()[m])
        return max(distance - radius, 0.0), distance + radius
    if len(depths) > 2:
        raise mph.InputError(f"--depth: expected one depth or two, got {len(depths)}")
    near, far = depths[0], depths[-1]
    if not 0 <= near <= far < math.inf:
        got = " ".join(f"{depth:g}" for depth in depths)
        raise mph.InputError(f"--depth: expected one depth of 0 mm or more, or two in ascending order, got {got}")
    return near, far


def _to_list(values: Array) -> list[float] | None:
    """Return numbers as a list for JSON; None if one is NaN, which JSON lacks."""
    return None if np.isnan(values).any() else values.tolist()


def _pixel_text(pixel: list[float] | None) -> str:
    """Return a pixel as "column, row", or "-" for none."""
    return "-" if pixel is None else f"{pixel[0]:.2f}, {pixel[1]:.2f}"
