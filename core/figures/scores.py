"""A score as a figure: three slices beside those of the truth, and profiles."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..arrays import Floats, Floats32
from ..geometry.frames import moved
from ..reconstruction.scores.derenzo import DerenzoSector
from ..reconstruction.scores.summary import VolumeScore
from ..runs import letters
from ..runs.display import Display
from ..volumes.resampling import values_at
from ..volumes.sights import full_slices
from ..volumes.volume import Volume
from .page import Page
from .parts import FAINT, INK, Axes, bar_width, color_bar, heading, number, ticks

SIZE = (1800, 950)
"""Width and height, pixels, of a page that suits."""

_FOUND, _TRUE, _PAIR = "#b8433a", "#20262d", "#e3b9b4"  # colours of curves
_ON_SLICE = "#56c7f2"
_PLANES = ((0, 1), (0, 2), (1, 2))  # axes to the right and upward
_MARGIN = 1.1  # of a phantom's box, that slices show
_COARSE = 65  # points along an axis, to choose where slices lie
_MOST = 512  # pixels along the sides of a slice


class _Curve(NamedTuple):
    x: Floats
    y: Floats
    color: str
    width: float  # of the em


class _Plot(NamedTuple):
    title: str
    curves: Sequence[_Curve]


def draw(page: Page, score: VolumeScore, name: str = "") -> None:
    """Slices of the volume beside those of the truth, in one window of colours: the truth's; to the right, profiles.

    Slices and their axes are the phantom's where it is known, else the world's. Each goes through much of the truth.
    """
    em = page.em
    top = heading(page, f"Score{': ' if name else ''}{name}", [*score.lines[:1], *score.notes])
    display = Display("inferno" if score.volume.quantity == "activity" else "grey")
    window = display.window(score.truth.array)
    low, high = _shown(score)
    middle = _middle(score, low, high)
    sizes = [(high[right] - low[right], high[up] - low[up]) for right, up in _PLANES]
    bar = bar_width(page, display, window, score.volume.unit)
    left, gap, names = round(2.5 * em), round(1.0 * em), 1.7 * em
    width, height = round(0.5 * page.width) - left - bar - 2 * gap, page.height - top - round(em)
    widest, tall = max(size[0] for size in sizes), sum(size[1] for size in sizes)
    scale = min((width - gap) / 2 / widest, (height - 3 * names) / tall)
    step = round(widest * scale) + gap
    y = top
    for (right, up), size in zip(_PLANES, sizes, strict=True):
        across, down = max(1, round(size[0] * scale)), max(1, round(size[1] * scale))
        y += round(names)
        axis = 3 - right - up
        words = f"{'xyz'[right]} and {'xyz'[up]}, {'xyz'[axis]} {number(round(float(middle[axis]), 1))} mm"
        page.text(words, left - 0.5 * em, y + down / 2, 0.75 * em, FAINT, "middle", upward=True)
        for column, (volume, title) in enumerate(((score.volume, "reconstruction"), (score.truth, "truth"))):
            x = left + column * step
            values = _slice(volume, score.pose, (right, up), low, high, middle)
            page.image(display.colored(values.T[::-1], window), x, y, across, down)
            if (right, up) == _PLANES[0]:
                page.text(title, x, y - 0.5 * em, 0.9 * em, INK)
                if column and score.derenzo is not None:
                    _lines_of_profiles(page, score, low, scale, (x, y + down))
        y += down
    first = top + round(names)
    color_bar(page, display, window, score.volume.unit, left + 2 * step, first, round(0.6 * (y - first)))
    start = left + 2 * step + bar + gap
    _draw_plots(page, _plots(score, middle), (start, top, page.width - start - round(em), height), score)


def _middle(score: VolumeScore, low: Floats, high: Floats) -> Floats:
    """Where the slices meet: in the largest sphere; else near the middle, but where there is much of the truth."""
    if score.nema is not None:
        largest = score.nema[int(score.nema.diameter.argmax())].center
        return moved(np.linalg.inv(score.pose), largest)
    shares = (np.arange(_COARSE) + 0.5) / _COARSE
    points = low + np.stack(np.meshgrid(shares, shares, shares, indexing="ij"), axis=-1).reshape(-1, 3) * (high - low)
    values = values_at(score.truth, moved(score.pose, points), "nearest").reshape((_COARSE,) * 3).astype(float)
    return low + shares[full_slices(values)] * (high - low)


def _shown(score: VolumeScore) -> tuple[Floats, Floats]:
    """Opposite corners, in the axes of `score.pose`, mm, of the box that slices show."""
    inside = moved(np.linalg.inv(score.pose), score.volume.grid.corners())
    low, high = inside.min(axis=0), inside.max(axis=0)
    if score.phantom is not None:
        start, end = score.phantom.box
        middle, half = (start + end) / 2, _MARGIN * (end - start) / 2
        near, far = np.maximum(low, middle - half), np.minimum(high, middle + half)
        if (near < far).all():
            return near, far
    return low, high


def _slice(volume: Volume, pose: Floats, plane: tuple[int, int], low: Floats, high: Floats, middle: Floats) -> Floats32:
    """Values (across, up) of the voxels in a plane through `middle`."""
    counts = np.clip(np.rint((high - low) / volume.grid.spacing.min()), 1, _MOST).astype(int)
    at = [low[a] + (np.arange(counts[a]) + 0.5) * (high[a] - low[a]) / counts[a] for a in range(3)]
    points = np.empty((counts[plane[0]], counts[plane[1]], 3))
    points[:] = middle
    points[..., plane[0]], points[..., plane[1]] = at[plane[0]][:, None], at[plane[1]]
    return values_at(volume, moved(pose, points.reshape(-1, 3)), "nearest").reshape(points.shape[:2])


def _lines_of_profiles(page: Page, score: VolumeScore, low: Floats, scale: float, corner: tuple[float, float]) -> None:
    """The lines of the profiles, on a slice whose lower left corner is at `corner`."""
    to_axes = np.linalg.inv(score.pose)
    for sector in score.derenzo or ():
        for profile in sector.profiles:
            ends = moved(to_axes, profile.points[[0, -1]])
            line = [(corner[0] + (x - low[0]) * scale, corner[1] - (y - low[1]) * scale) for x, y, _ in ends.tolist()]
            page.line(line, _ON_SLICE, 0.06 * page.em)


def _plots(score: VolumeScore, middle: Floats) -> list[_Plot]:
    """Profiles of each sector of rods; without such, those along the axes through the middle."""
    if score.derenzo is not None and any(sector.profiles for sector in score.derenzo):
        return [_sector_plot(score, sector) for sector in score.derenzo if sector.profiles]
    plots = []
    low, high = _shown(score)
    for axis in range(3):
        points = np.tile(middle, (_MOST, 1))
        points[:, axis] = np.linspace(low[axis], high[axis], _MOST)
        world = moved(score.pose, points)
        true, found = (values_at(volume, world).astype(float) for volume in (score.truth, score.volume))
        curves = (_Curve(points[:, axis], found, _FOUND, 0.16), _Curve(points[:, axis], true, _TRUE, 0.07))
        plots.append(_Plot(f"Along {'xyz'[axis]}, mm", curves))
    return plots


def _sector_plot(score: VolumeScore, sector: DerenzoSector) -> _Plot:
    """All pairs' profiles and their mean, beside the phantom's."""
    assert score.phantom is not None
    first = sector.profiles[0].points
    x = np.linspace(0.0, float(np.linalg.norm(first[-1] - first[0])), len(first))
    curves = [_Curve(x, profile.values, _PAIR, 0.06) for profile in sector.profiles]
    fine = np.linspace(0.0, 1.0, 401)
    line = first[0] + fine[:, None] * (first[-1] - first[0])
    true = score.phantom.values(line, score.pose, score.volume.quantity)
    curves.append(_Curve(fine * x[-1], true, _TRUE, 0.1))
    curves.append(_Curve(x, np.mean([profile.values for profile in sector.profiles], axis=0), _FOUND, 0.16))
    return _Plot(f"{sector.rod_diameter:g} mm: {sector.words}", curves)


def _draw_plots(page: Page, plots: Sequence[_Plot], room: tuple[int, int, int, int], score: VolumeScore) -> None:
    """Plots in two columns, or in one of few, all with the same values upward."""
    em, (left, top, width, height) = page.em, room
    columns = 1 if len(plots) <= 3 else 2
    rows = -(-len(plots) // columns)
    every = np.concatenate([curve.y for plot in plots for curve in plot.curves])
    low, high = min(0.0, float(every.min())), float(every.max())
    high += 0.05 * ((high - low) or 1.0)
    x, y = left + 3.5 * em, top - 0.2 * em
    page.text("reconstruction", x, y, 0.85 * em, _FOUND)
    page.text("truth", x + 7.2 * em, y, 0.85 * em, _TRUE)
    page.text(score.volume.unit, left + 3.0 * em, y, 0.85 * em, FAINT, "end")
    if score.derenzo is not None:
        page.text("mm from rod to rod", left + width, y, 0.85 * em, FAINT, "end")
    for index, plot in enumerate(plots):
        row, column = divmod(index, columns)
        wide, tall = width / columns, height / rows
        x, y = left + column * wide + 3.5 * em, top + row * tall + 1.7 * em
        _draw_plot(page, plot, (x, y, wide - 4.3 * em, tall - 3.6 * em), (low, high))


def _draw_plot(page: Page, plot: _Plot, frame: tuple[float, float, float, float], span: tuple[float, float]) -> None:
    em, (left, top, width, height), xs = page.em, frame, plot.curves[0].x
    axes = Axes(page, frame, (float(xs[0]), float(xs[-1])), span, em, FAINT)
    axes.draw(ticks(*axes.x, max(2, int(width / (4 * em)))), ticks(*span, max(2, int(height / (2.5 * em)))))
    size = 0.8 * em * min(1.0, width / letters.width(plot.title, 0.8 * em))  # smaller where the title is too long
    page.text(plot.title, left, top - 0.5 * em, size, INK)
    for curve in plot.curves:
        axes.curve(*curve)
