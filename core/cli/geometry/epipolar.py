"""``mphdrr geometry epipolar FILE --pixel MODULE:COLUMN,ROW``."""

import argparse
import math
from typing import Any

import numpy as np

from .... import core as mph
from ...arrays import Array, table_rows
from ...errors import expecting
from ...geometry.scanner import Scanner
from ..options import print_answer
from ..scanners import chosen_modules, read_any
from .arguments import add_action, add_views, views_of

# A module is named as one that does not fit if the chance of its misfit is below this, counted for all modules.
_CHANCE = 0.01


def add_parser(actions) -> None:  # type: ignore[no-untyped-def]
    """Add the action."""
    parser = add_action(actions, "epipolar", _run)
    add = parser.add_argument
    pixel = "module number, column and row of its image, counted from 0; several: of one point, whose place is sought"
    add("--pixel", action="append", required=True, metavar="MODULE:COLUMN,ROW", help=pixel)
    depth = "of one pixel: where its ray begins and ends, or a single depth, mm from the pinhole; default: at the ROI"
    add("--depth", type=float, nargs="+", metavar="MM", help=depth)
    add("--sigma", type=float, metavar="PX", help="of several: standard deviation of columns and rows (default: 1)")
    add("--modules", metavar="RANGE", help="those to list, such as 1-40 or 1-20,41; default: all")
    add_views(parser, "pixels of the images")


def _run(arguments: argparse.Namespace) -> None:
    """Say where all modules see what a pixel of one sees; or where a point is, by its pixels in several.

    mphdrr geometry epipolar scanner.xlsx --pixel 7:120,130
    mphdrr geometry epipolar scanner.xlsx --pixel 7:120,130 --pixel 31:99.4,140.2 --pixel 52:131,88 --sigma 0.5
    """
    system = read_any(arguments)
    pixels = [_pixel(system, text) for text in arguments.pixel]
    views = views_of(system, arguments)
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
    near, far = _depths(arguments.depth, system, m)
    segments = mph.epipolar_segments(views, m, pixel, near, far)
    ends = mph.points_at_depths(views, m, pixel, np.array([near, far]))
    n_v, n_u = views.shape
    rows: list[dict[str, Any]] = []
    listed = np.isin(system.numbers, chosen_modules(system, arguments.modules).numbers)
    for n in map(int, np.flatnonzero(listed)):
        rows.append({"number": int(system.numbers[n]), "from": _listed(segments[n, 0]), "to": _listed(segments[n, 1])})
        if n == m:
            rows[-1] |= {"line": None, "epipole": None}
            continue
        at = mph.epipole(views, m, n)
        place = at[:2] / at[2] if at[2] > 0 else np.full(2, np.nan)
        inside = (place >= -0.5).all() and (place <= [n_u - 0.5, n_v - 0.5]).all()
        line = _listed(mph.epipolar_lines(views, m, n, pixel))
        rows[-1] |= {"line": line, "epipole": _listed(place) if inside else None}
    number = int(system.numbers[m])
    record = {"module": number, "pixel": pixel, "depths": [near, far], "points": ends.tolist(), "modules": rows}
    text = f"module {number}, pixel ({pixel[0]:g}, {pixel[1]:g})"
    start, end = (" ".join(f"{x:.2f}" for x in point) for point in ends)
    if near == far:
        lines = [f"{text} at a depth of {near:.2f} mm: ({start}) mm", " module     column, row      epipole"]
    else:
        lines = [f"{text} from a depth of {near:.2f} to {far:.2f} mm: from ({start}) to ({end}) mm"]
        lines += [" module  from column, row    to column, row       epipole"]
    shown = ("from", "epipole") if near == far else ("from", "to", "epipole")
    for row in rows:
        pixels = "".join(f"{_text(row[name]):>18}" for name in shown)
        lines.append(f"{row['number']:7d}{pixels.rstrip()}")
    seeing = sum(row["from"] is not None for row in rows)
    lines += [f"{seeing} of {len(rows)} modules have it in their image; the epipole is where a module has the pinhole"]
    print_answer(arguments, {**record, "units": "pixels, mm"}, lines)


def _print_point(
    arguments: argparse.Namespace, system: Scanner, views: mph.Views, pixels: list[tuple[int, list[float]]]
) -> None:
    index = np.array([m for m, _ in pixels])
    numbers = system.numbers[index].tolist()
    twice = [number for number in numbers if numbers.count(number) > 1]
    if twice:
        raise mph.InputError(f"--pixel: expected one pixel of each module, got several of module {twice[0]}")
    sigma = 1.0 if arguments.sigma is None else arguments.sigma
    fit = mph.fit_marker(views, index, [pixel for _, pixel in pixels], sigma)
    odd = fit.worst if fit.worst is not None and fit.misfit_p_values[fit.worst] < _CHANCE / len(numbers) else None
    columns = {"number": system.numbers[index], "column": fit.residuals[:, 0], "row": fit.residuals[:, 1]}
    rows = table_rows({**columns, "misfit": fit.misfits, "p_value": fit.misfit_p_values})
    modules = [{name: None if x != x else x for name, x in row.items()} for row in rows]  # no NaN in JSON
    names = ("point", "standard_deviations", "covariance", "chi2", "degrees", "p_value")
    record = {name: np.asarray(getattr(fit, name)).tolist() for name in names} | {"sigma": sigma, "modules": modules}
    record |= {"misfitting": None if odd is None else numbers[odd], "units": "mm, mm^2, pixels"}
    axes = zip("xyz", fit.point, fit.standard_deviations, strict=True)
    lines = ["point " + "   ".join(f"{axis} {x:.3f} +- {sd:.3f}" for axis, x, sd in axes) + " mm"]
    lines += [" module  residual column       row    misfit     chance"]
    for row in rows:
        known = row["misfit"] == row["misfit"]
        misfit = " {misfit:9.2f} {p_value:10.2g}" if known else "         -          -"
        lines.append(f"{{number:7d}} {{column:16.3f}} {{row:9.3f}}{misfit}".format(**row))
    chance = f"a chance of {fit.p_value:.2g} if sigma is {sigma:g} px"
    lines += [f"chi2 {fit.chi2:.2f} of {fit.degrees} degrees of freedom, {chance}"]
    if odd is not None:
        lines += [f"module {numbers[odd]} does not fit: without it chi2 falls by {fit.misfits[odd]:.2f}"]
    elif fit.p_value < _CHANCE:
        lines += ["they do not fit together, and nothing says which is wrong"]
    else:
        lines += ["they fit together"]
    print_answer(arguments, record, lines)


def _pixel(system: Scanner, text: str) -> tuple[int, list[float]]:
    """Index of the module, and its column and row, of a ``MODULE:COLUMN,ROW``."""
    module, _, place = text.partition(":")
    with expecting(f"--pixel {text!r}: expected MODULE:COLUMN,ROW, such as 7:120,130.5"):
        number, (column, row) = int(module), map(float, place.split(","))
        if not (math.isfinite(column) and math.isfinite(row)):
            raise ValueError
    index = np.flatnonzero(system.numbers == number)
    if not len(index):
        lowest, highest = system.numbers.min(), system.numbers.max()
        raise mph.InputError(f"--pixel {text!r}: no module {number}; there are {lowest} to {highest}")
    return int(index[0]), [column, row]


def _depths(given: list[float] | None, system: Scanner, m: int) -> tuple[float, float]:
    if given is None:
        distance = float(np.linalg.norm(system.poses()[m, :3, 3]))
        radius = float(system.roi_radius[m]) if isinstance(system, mph.PinholeSystem) else system.region_radius()
        return max(distance - radius, 0.0), distance + radius
    if len(given) > 2:
        raise mph.InputError(f"--depth: expected one depth or two, got {len(given)}")
    near, far = given[0], given[-1]
    if not 0 <= near <= far < math.inf:
        got = " ".join(f"{depth:g}" for depth in given)
        raise mph.InputError(f"--depth: expected one depth of 0 mm or more, or two in ascending order, got {got}")
    return near, far


def _listed(values: Array) -> list[float] | None:
    """Numbers for JSON, which has no NaN."""
    return None if np.isnan(values).any() else values.tolist()


def _text(pixel: list[float] | None) -> str:
    return "-" if pixel is None else f"{pixel[0]:.2f}, {pixel[1]:.2f}"
