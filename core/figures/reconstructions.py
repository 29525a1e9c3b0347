"""A reconstruction as a picture: three slices, beside those of the truth where it is known, and the objective."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import Floats32
from ..geometry.grid import Grid
from ..runs.display import Display
from ..volumes.resampling import resample
from ..volumes.volume import Volume
from .page import Page
from .parts import FAINT, INK, Axes, arranged, bar_width, color_bar, heading, number, ticks

SIZE, SIZE_BESIDE_TRUTH = (1600, 500), (1600, 850)
"""Width and height, pixels, that suit a reconstruction alone, and one beside the truth."""

# The axis across a slice, and those to the right and upward: seen from the head, from the front and from the left.
_SLICES = ((2, 0, 1), (1, 0, 2), (0, 1, 2))
_NAMES = "xyz"
_CURVE = "#c8442b"
_PLOT = 0.27  # of the page's width


def draw(
    page: Page,
    volume: Volume,
    objective: Sequence[float] = (),
    truth: Volume | None = None,
    title: str = "Reconstruction",
    lines: Sequence[str] = (),
    objective_name: str = "log-likelihood",
) -> None:
    """Draw slices through the middle of a volume, in the same colours those of `truth`, and the objective by iteration.

    The truth is drawn on the reconstruction's voxels, as the mean over each. The volume's axes are along the world's.
    """
    em = page.em
    top = heading(page, title, lines) + round(0.6 * em)
    rows = [("Reconstruction", volume)] + ([] if truth is None else [("Truth", truth)])
    pictures = [[_slice(each, volume.grid, axis) for axis, _, _ in _SLICES] for _, each in rows]
    display = Display(colors="inferno" if volume.quantity == "activity" else "grey")
    # A hot voxel of the reconstruction must not darken all others: the truth says how bright things are.
    window = display.window(np.concatenate([picture.ravel() for picture in pictures[-1]]))
    grid, bar = volume.grid, bar_width(page, display, window, volume.unit)
    extent = (grid.spacing * grid.shape).tolist()
    sizes = [(extent[across], extent[up]) for _ in rows for _, across, up in _SLICES]
    right = page.width * (1 - _PLOT if len(objective) else 1) - bar - 2.6 * em
    room = 2.2 * em, float(top), right - 2.2 * em, page.height - top - 0.6 * em
    in_rows = [range(i, i + 3) for i in range(0, len(sizes), 3)]
    pixels, places = arranged(sizes, (0.4 * em, 1.5 * em, 0.4 * em, 0.4 * em), room, in_rows)
    for i, ((x, y), (width, height)) in enumerate(zip(places, sizes, strict=True)):
        (name, _), (axis, across, up), n = rows[i // 3], _SLICES[i % 3], grid.shape[_SLICES[i % 3][0]]
        if i % 3 == 0:
            page.text(name, x - 1.1 * em, y + height * pixels / 2, em, INK, "middle", upward=True)
        at = grid.center[axis] + (n // 2 - (n - 1) / 2) * grid.spacing[axis]
        text = f"{_NAMES[across]} {_NAMES[up]},  {_NAMES[axis]} = {number(round(float(at), 2) + 0.0)} mm"
        page.text(text, x + width * pixels / 2, y - 0.4 * em, 0.9 * em, FAINT, "middle")
        picture = display.colored(pictures[i // 3][i % 3].T[::-1], window)
        page.image(picture, round(x), round(y), round(width * pixels), round(height * pixels))
    x, y = x + width * pixels + 1.2 * em, y + height * pixels
    first = round(min(place[1] for place in places))
    _scale_bar(page, pixels, extent[0], places[-3][0] + 0.6 * em, y - 0.6 * em)
    color_bar(page, display, window, volume.unit, round(x), first, max(2, round(y) - first))
    if len(objective):
        x, height = x + bar + 7.1 * em, min(0.9 * page.width * _PLOT, y - first - 3 * em)
        draw_objective(page, objective, (x, first, page.width - x - 1.5 * em, height), objective_name)


def draw_objective(
    page: Page,
    objective: ArrayLike,
    place: tuple[float, float, float, float],
    name: str = "",
    color: str = _CURVE,
    ink: str = INK,
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
    axes = Axes(page, place, (1, max(len(values), 2)), (low, high), em, ink)
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


def _slice(volume: Volume, grid: Grid, axis: int) -> Floats32:
    """The middle slice of a grid across one of its axes, of a volume on any grid."""
    index = grid.shape[axis] // 2
    shape = [*grid.shape]
    shape[axis] = 1
    plane = grid.box(index * np.eye(3)[axis], tuple(shape))
    values = volume.array.take([index], axis) if volume.grid is grid else resample(volume, plane, "mean").array
    return np.asarray(values.squeeze(axis), np.float32)


def _scale_bar(page: Page, pixels: float, extent: float, left: float, bottom: float) -> None:
    """A bar of a round length, about a quarter of a slice, over its lower left corner."""
    length = [step for step in (1, 2, 5, 10, 20, 50, 100, 200, 500) if step <= max(1.0, extent / 4)][-1]
    page.line([(left, bottom), (left + length * pixels, bottom)], "#ffffff", 0.16 * page.em)
    page.text(f"{length} mm", left, bottom - 0.4 * page.em, 0.85 * page.em, "#ffffff")
