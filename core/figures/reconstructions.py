"""Picture of a reconstruction: slices, beside those of truth and error if known, with scores and the objective."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..arrays import ArrayLike, Floats32
from ..runs import letters
from ..runs.display import DARK_DIVERGING, Display, ticks
from ..runs.display import number_text as number
from ..volumes.resampling import resample
from ..volumes.sights import bright_value, full_slices
from ..volumes.volume import Volume
from .page import Page, circle
from .parts import PLANES, Axes, arrange, bar_width, color_bar

SIZE, SIZE_BESIDE_TRUTH = (1600, 500), (1600, 850)
"""Default width and height, pixels, of the picture of a reconstruction alone, and beside the truth."""
LIGHTS = {"green": "#4fb35a", "amber": "#e8a13a", "red": "#d9534a"}
"""Colours of the dots that tell whether rods are resolved, seen, or neither."""

_CURVE = "#e0604a"
# Slices are cut to values above this share of the last colour's, with a margin of this share of the volume's sides.
_VISIBLE, _MARGIN = 0.05, 0.06
_TEXT_WIDTH = 25.0  # width of the text beside the slices, in units of the text's size
_LEGIBLE = 11.0  # smallest longer side of a slice if two or three of each volume are drawn, in units of the text's size


def draw(
    page: Page,
    volume: Volume,
    objective: Sequence[float] = (),
    truth: Volume | None = None,
    title: str = "Reconstruction",
    lines: Sequence[str] = (),
    objective_name: str = "log-likelihood",
    rods: Sequence[tuple[str, str, str, str]] = (),
) -> tuple[float, float]:
    """Draw slices of a volume, beside those of `truth` and of the error, and write its scores and objective.

    As many slices as are legible are drawn, the most varied plane first, each through a well-filled part of the truth, or
    else of the volume. The truth is drawn on the reconstruction's voxels, as the mean over each. The axes of the slices are
    the world's. `rods` are the `cells` of a Derenzo score's sectors; `lines` are texts, the first one below the title.
    Returns the values of the slices' first and last colours.
    """
    em, grid, rows = page.em, volume.grid, _rows(volume, truth)
    values = rows[0].values
    bars = [row for row in rows if row.unit]
    widths = [bar_width(page, row.display, row.window, row.unit) + round(0.8 * em) for row in bars]
    left = page.width - min(_TEXT_WIDTH * em, 0.42 * page.width)
    room = 0.6 * em, 0.4 * em, left - sum(widths) - 1.6 * em, page.height - 0.8 * em
    box = _visible_box(values, rows[0].window[1])
    extent = [float(grid.spacing[axis]) * (box[axis].stop - box[axis].start) for axis in range(3)]
    # A volume varies least along its rods, and the slice across them shows all of them.
    planes = sorted(PLANES, key=lambda plane: float(np.abs(np.diff(values, axis=plane[0])).sum()))
    for n_planes in (3, 2, 1):
        panels = [(plane, row) for plane in planes[:n_planes] for row in rows]
        sizes = [(extent[right], extent[up]) for (_, right, up), _ in panels]
        n, r = len(panels), len(rows)  # r rows of slices: truth, reconstruction, error
        arrangements = [range(n)], [range(i, i + r) for i in range(0, n, r)], [range(k, n, r) for k in range(r)]
        scale, corners = arrange(sizes, (0.2 * em, 1.5 * em, 0.2 * em, 0.2 * em), room, *arrangements)
        if max(extent) * scale >= _LEGIBLE * em:
            break
    indices = np.clip(full_slices(values), [s.start for s in box], [s.stop - 1 for s in box])
    for i, ((x, y), (width, height), ((axis, _, _), row)) in enumerate(zip(corners, sizes, panels, strict=True)):
        coordinate = grid.center[axis] + (indices[axis] - (grid.shape[axis] - 1) / 2) * grid.spacing[axis]
        position = "" if i % r else f"{'xyz'[axis]} = {number(round(float(coordinate), 2) + 0.0)} mm"
        text = ", ".join(filter(None, (row.name if i < r else "", position)))
        size = 0.9 * em * min(1.0, width * scale / letters.width(text or " ", 0.9 * em))
        page.text(text, x, y - 0.4 * em, size, page.ink)
        picture = row.values[box].take(indices[axis] - box[axis].start, axis).T[::-1]
        frame = round(x), round(y), round(width * scale), round(height * scale)
        page.image(row.display.colored(picture, row.window), *frame)
    (x, y), (width, height) = corners[0], sizes[0]
    _scale_bar(page, scale, width, x + 0.6 * em, y + height * scale - 0.6 * em)
    x = max(x + width * scale for (x, _), (width, _) in zip(corners, sizes, strict=True)) + em
    for row, step in zip(bars, widths, strict=True):
        color_bar(page, row.display, row.window, row.unit, round(x), round(y), max(2, round(height * scale)))
        x += step
    _draw_texts(page, left, title, lines, rods, objective, objective_name)
    return rows[0].window


class _Row(NamedTuple):
    """A volume whose slices are drawn, with its colours."""

    name: str
    values: Floats32
    display: Display
    window: tuple[float, float]
    unit: str  # text above its colour bar; empty if it shares the bar of the row before


def _rows(volume: Volume, truth: Volume | None) -> list[_Row]:
    """Return the rows of slices: truth, reconstruction and error, or the reconstruction alone if the truth is unknown."""
    display = Display(colors="inferno" if volume.quantity == "activity" else "grey")
    if truth is None:
        low, high = display.window(volume.array)
        return [_Row("Reconstruction", volume.array, display, (low, bright_value(volume.array) or high), volume.unit)]
    true_array = truth.array if truth.grid is volume.grid else resample(truth, volume.grid, "mean").array
    # The window follows the truth, so that a hot voxel of the reconstruction does not darken all others.
    low, high = window = display.window(true_array)
    errors = _Row("Error", volume.array - true_array, Display(colors=DARK_DIVERGING), (low - high, high - low), "error")
    row = _Row("Truth", true_array, display, window, volume.unit)
    return [row, _Row("Reconstruction", volume.array, display, window, ""), errors]


def _draw_texts(
    page: Page, left: float, title: str, lines: Sequence[str], rods: Sequence[tuple[str, str, str, str]],
    objective: Sequence[float], objective_name: str,
) -> None:  # fmt: skip
    """Write title, scores and rods beside the slices, and draw the objective below if there is room."""
    em, width = page.em, page.width - left - page.em
    row = 0.3 * em

    def write(text: str, size: float, color: str) -> None:
        """Write a text, wrapped to the column's width, below the last row."""
        nonlocal row
        for line in letters.wrap_text(text, lambda piece: letters.width(piece, size) <= width):
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
            shrink = min(1.0, (page.width - x - 0.3 * em) / letters.width(cell or " ", 0.9 * em))
            page.text(cell, x, row, 0.9 * em * shrink, page.ink if light else page.faint)
    row += 0.4 * em
    for line in lines[1:]:
        if row + 1.5 * em * (2 + len(line) // 45) < page.height:
            write(line, 0.9 * em, page.faint)
    room = page.height - row - 6.2 * em
    if len(objective) and room > 4 * em:
        frame = left + 5.5 * em, row + 2.8 * em, width - 5.5 * em, min(room, 0.8 * width)
        draw_objective(page, objective, frame, objective_name)


def _visible_box(values: ArrayLike, high: float) -> tuple[slice, slice, slice]:
    """Return the slices of the box of values (n_x, n_y, n_z) above a share of `high`, with a margin around it."""
    box = []
    for axis in range(3):
        filled = np.flatnonzero(np.max(np.abs(values), axis=tuple({0, 1, 2} - {axis})) > _VISIBLE * abs(high))
        size = np.shape(values)[axis]
        margin = round(_MARGIN * size)
        start, stop = (filled[0], filled[-1] + 1) if len(filled) else (0, size)
        box.append(slice(max(int(start) - margin, 0), min(int(stop) + margin, size)))
    return box[0], box[1], box[2]


def draw_objective(
    page: Page,
    objective: ArrayLike,
    frame: tuple[float, float, float, float],
    name: str = "",
    color: str = _CURVE,
    ink: str = "",
    em: float | None = None,
) -> None:
    """Draw the objective by iteration into the frame (left, top, width, height); without a `name` there are no tick marks.

    `em` is the size of its text, to which line widths are proportional.
    """
    values = np.asarray(objective, float)
    em = em or page.em
    low, high = float(values.min()), float(values.max())
    spread = (high - low) or abs(high) or 1.0
    low, high = low - 0.06 * spread, high + 0.06 * spread
    axes = Axes(page, frame, (1, max(len(values), 2)), (low, high), em, ink or page.ink)
    marks = ticks(low, high, 5) if name else []
    # The objective changes little compared with its size, so its numbers get as many digits as tell them apart.
    digits = max(4, math.ceil(math.log10(max(abs(low), abs(high)) / (marks[1] - marks[0]))) + 1) if marks[1:] else 4
    iteration_marks = [n for n in ticks(*axes.x, 6) if n == round(n)] if name else []
    axes.draw(iteration_marks, marks, name[:1].upper() + name[1:], "iteration" if name else "", digits)
    iterations = np.arange(1, len(values) + 1)
    if len(values) > 1:
        axes.curve(iterations, values, color, 0.16)
    for i in iterations if len(values) <= 30 else iterations[-1:]:
        (x, y), r = axes.point(i, values[i - 1]), 0.22 * em
        page.area([(x - r, y), (x, y - r), (x + r, y), (x, y + r)], color)


def _scale_bar(page: Page, scale: float, extent: float, left: float, bottom: float) -> None:
    """Draw a bar of a round length, about a quarter of a slice, at the slice's lower left corner.

    `scale` is in pixels per mm, `extent` the slice's width, mm.
    """
    length = [step for step in (1, 2, 5, 10, 20, 50, 100, 200, 500) if step <= max(1.0, extent / 4)][-1]
    page.line([(left, bottom), (left + length * scale, bottom)], "#ffffff", 0.16 * page.em)
    page.text(f"{length} mm", left, bottom - 0.4 * page.em, 0.85 * page.em, "#ffffff")
