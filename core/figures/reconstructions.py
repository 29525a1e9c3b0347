"""A reconstruction as a picture: slices beside those of the truth where it is known, the error, scores and the objective."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..arrays import ArrayLike, Floats32
from ..runs import letters
from ..runs.display import DARK_DIVERGING, Display
from ..volumes.resampling import resample
from ..volumes.sights import bright_value, full_slices
from ..volumes.volume import Volume
from .page import Page, circle
from .parts import PLANES, Axes, arranged, bar_width, color_bar, number, ticks

SIZE, SIZE_BESIDE_TRUTH = (1600, 500), (1600, 850)
"""Width and height, pixels, that suit a reconstruction alone, and one beside the truth."""
LIGHTS = {"green": "#4fb35a", "amber": "#e8a13a", "red": "#d9534a"}
"""Colours of the dots that say whether rods are resolved."""

_CURVE = "#e0604a"
_SEEN, _MARGIN = 0.05, 0.06  # of the last colour's value, and of the volume's sides: what slices show, and around it
_TEXTS = 25.0  # of the size of text: the width of what is written beside the slices
_LEGIBLE = 11.0  # of the size of text: a slice's larger side, at least, where three or two of each volume are drawn


def draw(
    page: Page,
    volume: Volume,
    objective: Sequence[float] = (),
    truth: Volume | None = None,
    title: str = "Reconstruction",
    lines: Sequence[str] = (),
    objective_name: str = "log-likelihood",
    rods: Sequence[tuple[str, str, str, str]] = (),
) -> None:
    """Draw slices of a volume, beside those of `truth` and of the error, and what is known of it: scores, objective.

    Slices lie where there is much of the truth, or of the volume; as many as are legible, that which shows most first. The
    truth is drawn on the reconstruction's voxels, as the mean over each. The volume's axes are along the world's. `rods` are
    the `cells` of a Derenzo score's sectors.
    """
    em, grid, rows = page.em, volume.grid, _rows(volume, truth)
    first = rows[0].values
    bars = [row for row in rows if row.unit]
    widths = [bar_width(page, row.display, row.window, row.unit) + round(0.8 * em) for row in bars]
    left = page.width - min(_TEXTS * em, 0.42 * page.width)
    room = 0.6 * em, 0.4 * em, left - sum(widths) - 1.6 * em, page.height - 0.8 * em
    box = _box(first, rows[0].window[1])
    extent = [float(grid.spacing[axis]) * (box[axis].stop - box[axis].start) for axis in range(3)]
    # Along rods a volume changes least: across them it shows them all.
    best = sorted(PLANES, key=lambda plane: float(np.abs(np.diff(first, axis=plane[0])).sum()))
    for count in (3, 2, 1):
        shown = [(plane, row) for plane in best[:count] for row in rows]
        sizes = [(extent[across], extent[up]) for (_, across, up), _ in shown]
        n, kinds = len(shown), len(rows)
        ways = [range(n)], [range(i, i + kinds) for i in range(0, n, kinds)], [range(k, n, kinds) for k in range(kinds)]
        pixels, places = arranged(sizes, (0.2 * em, 1.5 * em, 0.2 * em, 0.2 * em), room, *ways)
        if max(extent) * pixels >= _LEGIBLE * em:
            break
    at = np.clip(full_slices(first), [part.start for part in box], [part.stop - 1 for part in box])
    for i, ((x, y), (width, height), ((axis, _, _), row)) in enumerate(zip(places, sizes, shown, strict=True)):
        place = grid.center[axis] + (at[axis] - (grid.shape[axis] - 1) / 2) * grid.spacing[axis]
        where = "" if i % kinds else f"{'xyz'[axis]} = {number(round(float(place), 2) + 0.0)} mm"
        text = ", ".join(filter(None, (row.name if i < kinds else "", where)))  # once is enough
        size = 0.9 * em * min(1.0, width * pixels / letters.width(text or " ", 0.9 * em))
        page.text(text, x, y - 0.4 * em, size, page.ink)
        picture = row.values[box].take(at[axis] - box[axis].start, axis).T[::-1]
        frame = round(x), round(y), round(width * pixels), round(height * pixels)
        page.image(row.display.colored(picture, row.window), *frame)
    (x, y), (width, height) = places[0], sizes[0]
    _scale_bar(page, pixels, width, x + 0.6 * em, y + height * pixels - 0.6 * em)
    x = max(x + width * pixels for (x, _), (width, _) in zip(places, sizes, strict=True)) + em
    for row, step in zip(bars, widths, strict=True):
        color_bar(page, row.display, row.window, row.unit, round(x), round(y), max(2, round(height * pixels)))
        x += step
    _draw_texts(page, left, title, lines, rods, objective, objective_name)


class _Row(NamedTuple):
    """A volume of which slices are drawn."""

    name: str
    values: Floats32
    display: Display
    window: tuple[float, float]
    unit: str  # above its colour bar, which it shares with the one before if there is none


def _rows(volume: Volume, truth: Volume | None) -> list[_Row]:
    """The truth, the volume and the error; the volume alone where the truth is not known."""
    display = Display(colors="inferno" if volume.quantity == "activity" else "grey")
    if truth is None:
        low, high = display.window(volume.array)
        return [_Row("Reconstruction", volume.array, display, (low, bright_value(volume.array) or high), volume.unit)]
    true = truth.array if truth.grid is volume.grid else resample(truth, volume.grid, "mean").array
    # A hot voxel of the reconstruction must not darken all others: the truth says how bright things are.
    low, high = window = display.window(true)
    errors = _Row("Error", volume.array - true, Display(colors=DARK_DIVERGING), (low - high, high - low), "error")
    row = _Row("Truth", true, display, window, volume.unit)
    return [row, _Row("Reconstruction", volume.array, display, window, ""), errors]


def _draw_texts(
    page: Page, left: float, title: str, lines: Sequence[str], rods: Sequence[tuple[str, str, str, str]],
    objective: Sequence[float], objective_name: str,
) -> None:  # fmt: skip
    """Write what is known of a reconstruction beside its slices, and draw the objective where there is room for it."""
    em, width = page.em, page.width - left - page.em
    row = 0.3 * em

    def write(text: str, size: float, color: str) -> None:
        nonlocal row
        for line in letters.wrapped(text, lambda piece: letters.width(piece, size) <= width):
            row += 1.35 * size
            page.text(line, left, row, size, color)

    write(title, 1.1 * em, page.ink)
    for line in filter(None, lines[:1]):
        write(line, 0.9 * em, page.faint)
    table = [("rods", "", "valley/peak", "contrast"), *rods] if rods else []
    columns = left + 1.2 * em, left + min(0.38 * width, 8 * em), left + min(0.74 * width, 15 * em)
    row += 0.4 * em
    step = min(1.4 * em, (page.height - row - 0.4 * em) / max(len(table), 1))
    for size, light, *score in table:
        row += step
        if light:
            page.area(circle(left + 0.5 * em, row - 0.32 * em, 0.36 * em), LIGHTS[light])
        for x, cell in zip(columns, (size, *score), strict=True):
            fits = min(1.0, (page.width - x - 0.3 * em) / letters.width(cell or " ", 0.9 * em))
            page.text(cell, x, row, 0.9 * em * fits, page.ink if light else page.faint)
    row += 0.4 * em
    for line in lines[1:]:
        if row + 1.5 * em * (2 + len(line) // 45) < page.height:
            write(line, 0.9 * em, page.faint)
    room = page.height - row - 6.2 * em
    if len(objective) and room > 4 * em:
        place = left + 5.5 * em, row + 2.8 * em, width - 5.5 * em, min(room, 0.8 * width)
        draw_objective(page, objective, place, objective_name)


def _box(values: ArrayLike, high: float) -> tuple[slice, slice, slice]:
    """The part of values (n_x, n_y, n_z) that slices show: where there is something, and a margin around it."""
    box = []
    for axis in range(3):
        seen = np.flatnonzero(np.max(np.abs(values), axis=tuple({0, 1, 2} - {axis})) > _SEEN * abs(high))
        size = np.shape(values)[axis]
        margin = round(_MARGIN * size)
        start, stop = (seen[0], seen[-1] + 1) if len(seen) else (0, size)
        box.append(slice(max(int(start) - margin, 0), min(int(stop) + margin, size)))
    return box[0], box[1], box[2]


def draw_objective(
    page: Page,
    objective: ArrayLike,
    place: tuple[float, float, float, float],
    name: str = "",
    color: str = _CURVE,
    ink: str = "",
    em: float | None = None,
) -> None:
    """Draw the objective by iteration into (left, top, width, height), with axes where it has a name.

    `em` is the size of its text, which lines are in proportion to.
    """
    values = np.asarray(objective, float)
    em = em or page.em
    low, high = float(values.min()), float(values.max())
    spread = (high - low) or abs(high) or 1.0
    low, high = low - 0.06 * spread, high + 0.06 * spread
    axes = Axes(page, place, (1, max(len(values), 2)), (low, high), em, ink or page.ink)
    marks = ticks(low, high, 5) if name else []
    # The objective changes little beside its size: as many digits as tell the numbers from each other.
    digits = max(4, math.ceil(math.log10(max(abs(low), abs(high)) / (marks[1] - marks[0]))) + 1) if marks[1:] else 4
    whole = [n for n in ticks(*axes.x, 6) if n == round(n)] if name else []
    axes.draw(whole, marks, name[:1].upper() + name[1:], "iteration" if name else "", digits)
    iterations = np.arange(1, len(values) + 1)
    if len(values) > 1:
        axes.curve(iterations, values, color, 0.16)
    for i in iterations if len(values) <= 30 else iterations[-1:]:
        (x, y), r = axes.to(i, values[i - 1]), 0.22 * em
        page.area([(x - r, y), (x, y - r), (x + r, y), (x, y + r)], color)


def _scale_bar(page: Page, pixels: float, extent: float, left: float, bottom: float) -> None:
    """A bar of a round length, about a quarter of a slice, over its lower left corner."""
    length = [step for step in (1, 2, 5, 10, 20, 50, 100, 200, 500) if step <= max(1.0, extent / 4)][-1]
    page.line([(left, bottom), (left + length * pixels, bottom)], "#ffffff", 0.16 * page.em)
    page.text(f"{length} mm", left, bottom - 0.4 * page.em, 0.85 * page.em, "#ffffff")
