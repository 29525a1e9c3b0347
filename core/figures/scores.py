"""Figure of a score: three slices of the reconstruction beside those of the truth, and profiles."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..arrays import Floats, Floats32
from ..geometry.frames import moved
from ..reconstruction.scores.derenzo import DerenzoSector
from ..reconstruction.scores.summary import VolumeScore
from ..runs import letters
from ..runs.display import Display, ticks
from ..runs.display import number_text as number
from ..volumes.resampling import values_at
from ..volumes.sights import full_slices
from ..volumes.volume import Volume
from .page import Page
from .parts import FAINT, INK, Axes, bar_width, color_bar, heading

SIZE = (1800, 950)
"""Default width and height, pixels, of the page."""

_RESULT, _TRUTH, _PAIR = "#b8433a", "#20262d", "#e3b9b4"  # colours of curves
_ON_SLICE = "#56c7f2"  # colour of profile lines on slices
_PLANES = ((0, 1), (0, 2), (1, 2))  # axes to the right and upward
_MARGIN = 1.1  # side of the visible box by that of the phantom's box
_COARSE = 65  # points along an axis at which the truth is sampled to place the slices
_MAX_PIXELS = 512  # pixels along the sides of a slice, at most


class _Curve(NamedTuple):
    """A curve of a profile plot."""

    x: Floats
    y: Floats
    color: str
    width: float  # line width in units of the text's size


class _Plot(NamedTuple):
    """A plot of profiles with its title."""

    title: str
    curves: Sequence[_Curve]


def draw(page: Page, score: VolumeScore, name: str = "") -> None:
    """Draw slices of the volume beside those of the truth, in the truth's colour window, and profiles to their right.

    The axes of slices are the phantom's if it is known, else the world's. Each slice passes through a well-filled part of
    the truth.
    """
    em = page.em
    top = heading(page, f"Score{': ' if name else ''}{name}", [*score.lines[:1], *score.notes])
    display = Display("inferno" if score.volume.quantity == "activity" else "grey")
    window = display.window(score.truth.array)
    low, high = _visible_box(score)
    point = _slice_point(score, low, high)
    sizes = [(high[right] - low[right], high[up] - low[up]) for right, up in _PLANES]
    bar = bar_width(page, display, window, score.volume.unit)
    left, gap, title_height = round(2.5 * em), round(1.0 * em), 1.7 * em
    width, height = round(0.5 * page.width) - left - bar - 2 * gap, page.height - top - round(em)
    max_width, total_height = max(size[0] for size in sizes), sum(size[1] for size in sizes)
    scale = min((width - gap) / 2 / max_width, (height - 3 * title_height) / total_height)
    step = round(max_width * scale) + gap
    y = top
    for (right, up), size in zip(_PLANES, sizes, strict=True):
        n_columns, n_rows = max(1, round(size[0] * scale)), max(1, round(size[1] * scale))
        y += round(title_height)
        axis = 3 - right - up
        position = f"{'xyz'[right]} and {'xyz'[up]}, {'xyz'[axis]} {number(round(float(point[axis]), 1))} mm"
        page.text(position, left - 0.5 * em, y + n_rows / 2, 0.75 * em, FAINT, "middle", upward=True)
        for column, (volume, title) in enumerate(((score.volume, "reconstruction"), (score.truth, "truth"))):
            x = left + column * step
            values = _slice(volume, score.pose, (right, up), low, high, point)
            page.image(display.colored(values.T[::-1], window), x, y, n_columns, n_rows)
            if (right, up) == _PLANES[0]:
                page.text(title, x, y - 0.5 * em, 0.9 * em, INK)
                if column and score.derenzo is not None:
                    _draw_profile_lines(page, score, low, scale, (x, y + n_rows))
        y += n_rows
    bar_top = top + round(title_height)
    color_bar(page, display, window, score.volume.unit, left + 2 * step, bar_top, round(0.6 * (y - bar_top)))
    start = left + 2 * step + bar + gap
    _draw_plots(page, _plots(score, point), (start, top, page.width - start - round(em), height), score)


def _slice_point(score: VolumeScore, low: Floats, high: Floats) -> Floats:
    """Return the point, mm, in the axes of `score.pose`, through which the three slices pass.

    It is the centre of the largest NEMA sphere; without spheres, each slice is a well-filled one of the truth near its
    centre.
    """
    if score.nema is not None:
        largest = score.nema[int(score.nema.diameter.argmax())].center
        return moved(np.linalg.inv(score.pose), largest)
    shares = (np.arange(_COARSE) + 0.5) / _COARSE
    points = low + np.stack(np.meshgrid(shares, shares, shares, indexing="ij"), axis=-1).reshape(-1, 3) * (high - low)
    values = values_at(score.truth, moved(score.pose, points), "nearest").reshape((_COARSE,) * 3).astype(float)
    return low + shares[full_slices(values)] * (high - low)


def _visible_box(score: VolumeScore) -> tuple[Floats, Floats]:
    """Return opposite corners, mm, in the axes of `score.pose`, of the box that slices show."""
    corners = moved(np.linalg.inv(score.pose), score.volume.grid.corners())
    low, high = corners.min(axis=0), corners.max(axis=0)
    if score.phantom is not None:
        start, end = score.phantom.box
        center, half = (start + end) / 2, _MARGIN * (end - start) / 2
        box_low, box_high = np.maximum(low, center - half), np.minimum(high, center + half)
        if (box_low < box_high).all():
            return box_low, box_high
    return low, high


def _slice(volume: Volume, pose: Floats, plane: tuple[int, int], low: Floats, high: Floats, point: Floats) -> Floats32:
    """Return the values (right, up) of the voxels in a plane through `point`, between the corners `low` and `high`."""
    n_pixels = np.clip(np.rint((high - low) / volume.grid.spacing.min()), 1, _MAX_PIXELS).astype(int)
    positions = [low[a] + (np.arange(n_pixels[a]) + 0.5) * (high[a] - low[a]) / n_pixels[a] for a in range(3)]
    points = np.empty((n_pixels[plane[0]], n_pixels[plane[1]], 3))
    points[:] = point
    points[..., plane[0]], points[..., plane[1]] = positions[plane[0]][:, None], positions[plane[1]]
    return values_at(volume, moved(pose, points.reshape(-1, 3)), "nearest").reshape(points.shape[:2])


def _draw_profile_lines(page: Page, score: VolumeScore, low: Floats, scale: float, corner: tuple[float, float]) -> None:
    """Draw the lines of the profiles on a slice with its lower left corner at `corner`."""
    to_axes = np.linalg.inv(score.pose)
    for sector in score.derenzo or ():
        for profile in sector.profiles:
            ends = moved(to_axes, profile.points[[0, -1]])
            line = [(corner[0] + (x - low[0]) * scale, corner[1] - (y - low[1]) * scale) for x, y, _ in ends.tolist()]
            page.line(line, _ON_SLICE, 0.06 * page.em)


def _plots(score: VolumeScore, point: Floats) -> list[_Plot]:
    """Return plots of the profiles of each sector of rods; without sectors, those along the axes through `point`."""
    if score.derenzo is not None and any(sector.profiles for sector in score.derenzo):
        return [_sector_plot(score, sector) for sector in score.derenzo if sector.profiles]
    plots = []
    low, high = _visible_box(score)
    for axis in range(3):
        points = np.tile(point, (_MAX_PIXELS, 1))
        points[:, axis] = np.linspace(low[axis], high[axis], _MAX_PIXELS)
        world = moved(score.pose, points)
        truth, result = (values_at(volume, world).astype(float) for volume in (score.truth, score.volume))
        curves = (_Curve(points[:, axis], result, _RESULT, 0.16), _Curve(points[:, axis], truth, _TRUTH, 0.07))
        plots.append(_Plot(f"Along {'xyz'[axis]}, mm", curves))
    return plots


def _sector_plot(score: VolumeScore, sector: DerenzoSector) -> _Plot:
    """Return a plot of all pairs' profiles of a sector and their mean, beside the phantom's."""
    assert score.phantom is not None
    points = sector.profiles[0].points
    x = np.linspace(0.0, float(np.linalg.norm(points[-1] - points[0])), len(points))
    curves = [_Curve(x, profile.values, _PAIR, 0.06) for profile in sector.profiles]
    fractions = np.linspace(0.0, 1.0, 401)
    line = points[0] + fractions[:, None] * (points[-1] - points[0])
    truth = score.phantom.values(line, score.pose, score.volume.quantity)
    curves.append(_Curve(fractions * x[-1], truth, _TRUTH, 0.1))
    curves.append(_Curve(x, np.mean([profile.values for profile in sector.profiles], axis=0), _RESULT, 0.16))
    return _Plot(f"{sector.rod_diameter:g} mm: {sector.words}", curves)


def _draw_plots(page: Page, plots: Sequence[_Plot], room: tuple[int, int, int, int], score: VolumeScore) -> None:
    """Draw plots in one column, more than three in two, with a common range of values, into `room`.

    `room` is (left, top, width, height) on the page.
    """
    em, (left, top, width, height) = page.em, room
    columns = 1 if len(plots) <= 3 else 2
    rows = -(-len(plots) // columns)
    values = np.concatenate([curve.y for plot in plots for curve in plot.curves])
    low, high = min(0.0, float(values.min())), float(values.max())
    high += 0.05 * ((high - low) or 1.0)
    x, y = left + 3.5 * em, top - 0.2 * em
    page.text("reconstruction", x, y, 0.85 * em, _RESULT)
    page.text("truth", x + 7.2 * em, y, 0.85 * em, _TRUTH)
    page.text(score.volume.unit, left + 3.0 * em, y, 0.85 * em, FAINT, "end")
    if score.derenzo is not None:
        page.text("mm from rod to rod", left + width, y, 0.85 * em, FAINT, "end")
    for index, plot in enumerate(plots):
        row, column = divmod(index, columns)
        plot_width, plot_height = width / columns, height / rows
        x, y = left + column * plot_width + 3.5 * em, top + row * plot_height + 1.7 * em
        _draw_plot(page, plot, (x, y, plot_width - 4.3 * em, plot_height - 3.6 * em), (low, high))


def _draw_plot(page: Page, plot: _Plot, frame: tuple[float, float, float, float], span: tuple[float, float]) -> None:
    """Draw one plot into `frame` (left, top, width, height), with the values in `span` upward."""
    em, (left, top, width, height), xs = page.em, frame, plot.curves[0].x
    axes = Axes(page, frame, (float(xs[0]), float(xs[-1])), span, em, FAINT)
    axes.draw(ticks(*axes.x, max(2, int(width / (4 * em)))), ticks(*span, max(2, int(height / (2.5 * em)))))
    size = 0.8 * em * min(1.0, width / letters.width(plot.title, 0.8 * em))  # smaller where the title is too long
    page.text(plot.title, left, top - 0.5 * em, size, INK)
    for curve in plot.curves:
        axes.curve(*curve)
