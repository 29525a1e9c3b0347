"""Components that flat figures share: heading, axes in mm, colour bar, arrangement of panels."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..runs import letters
from ..runs.display import Display, unit_text
from ..runs.display import number_text as number
from .page import Page, Point, box

INK, FAINT = "#20262d", "#6b7480"
"""Colours on white paper: of text and lines, and of notes."""
PLANES = ((2, 0, 1), (1, 0, 2), (0, 1, 2))
"""Axes of three views of a volume: the one across the plane, to the right, upward; seen from head, front and left."""


def heading(page: Page, title: str, lines: Sequence[str] = (), ink: str = INK, faint: str = FAINT) -> int:
    """Write a title and lines of text below it; return the first free row."""
    em = page.em
    row, width = 0.9 * em, page.width - 2 * em
    texts = (title, 1.25 * em, 1.2 * em, ink), *((line, em, 1.45 * em, faint) for line in lines)
    for text, size, step, color in texts:
        row += step
        # Lines that are too long are written smaller.
        page.text(text, em, row, size * min(1.0, width / max(letters.width(text, size), 1.0)), color)
    return heading_height(page, len(lines))


def heading_height(page: Page, lines: int) -> int:
    """Return the number of rows of a heading with `lines` lines of text below its title."""
    return round((3.1 + 1.45 * lines) * page.em)


class Axes(NamedTuple):
    """A frame (left, top, width, height) on a page, whose axes span `x` to the right and `y` upward."""

    page: Page
    frame: tuple[float, float, float, float]
    x: tuple[float, float]
    y: tuple[float, float]
    em: float
    ink: str = INK

    def point(self, x: float, y: float) -> Point:
        """Return the point on the page, pixels, for a pair of values."""
        left, top, width, height = self.frame
        (first, last), (low, high) = self.x, self.y
        return left + width * (x - first) / (last - first), top + height * (high - y) / (high - low)

    def curve(self, xs: ArrayLike, ys: ArrayLike, color: str, width: float) -> None:
        """Draw a line through pairs of values; its width is in units of the text's size."""
        self.page.line(list(map(self.point, np.asarray(xs).tolist(), np.asarray(ys).tolist())), color, width * self.em)

    def draw(self, xs: Iterable[float], ys: Iterable[float], title: str = "", below: str = "", digits: int = 4) -> None:
        """Draw the frame with tick marks and numbers at the values `xs` and `ys`, a title above and a text below it."""
        page, em, (left, top, width, height) = self.page, self.em, self.frame
        page.line([*box(*self.frame), (left, top)], self.ink, 0.06 * em)
        for value in xs:
            x, bottom = self.point(value, self.y[0])
            page.line([(x, bottom), (x, bottom + 0.3 * em)], self.ink, 0.06 * em)
            page.text(number(value), x, bottom + 1.3 * em, 0.8 * em, page.ink, "middle")
        for value in ys:
            y = self.point(self.x[0], value)[1]
            page.line([(left - 0.3 * em, y), (left, y)], self.ink, 0.06 * em)
            page.text(number(value, digits), left - 0.5 * em, y + 0.3 * em, 0.8 * em, page.ink, "end")
        for text, size, y in ((title, em, top - 0.6 * em), (below, 0.85 * em, top + height + 2.6 * em)):
            if text:
                page.text(text, left + width / 2, y, size, page.ink, "middle")


def arrange(
    sizes: Sequence[tuple[float, float]],
    margins: tuple[float, float, float, float],
    room: tuple[float, float, float, float],
    *arrangements: Sequence[Sequence[int]],
) -> tuple[float, list[Point]]:
    """Arrange rectangles of `sizes` (width, height), mm, in rows; return the scale, pixels per mm, and top left corners.

    Each of the `arrangements` is a list of rows of rectangles' indices; the one with the largest scale is chosen. It is
    centred in the `room` (left, top, width, height). `margins` around each rectangle stay free: left, top, right, bottom.
    """
    left, top, width, height = room
    margin_x, margin_y = margins[0] + margins[2], margins[1] + margins[3]

    def scale(rows: Sequence[Sequence[int]]) -> float:
        """Return the largest scale, pixels per mm, at which these rows fit into the room."""
        scale_x = min((width - len(row) * margin_x) / sum(sizes[i][0] for i in row) for row in rows)
        return min(scale_x, (height - len(rows) * margin_y) / sum(max(sizes[i][1] for i in row) for row in rows))

    rows = max(arrangements, key=scale)
    best_scale = max(scale(rows), 1e-9)
    row_heights = [max(sizes[i][1] for i in row) * best_scale + margin_y for row in rows]
    corners, y = dict[int, Point](), top + max(0.0, (height - sum(row_heights)) / 2)
    for row, row_height in zip(rows, row_heights, strict=True):
        x = left + max(0.0, (width - sum(sizes[i][0] * best_scale + margin_x for i in row)) / 2)
        for i in row:
            corners[i] = x + margins[0], y + row_height - margins[3] - sizes[i][1] * best_scale
            x += sizes[i][0] * best_scale + margin_x
        y += row_height
    return best_scale, [corners[i] for i in range(len(sizes))]


def color_bar(
    page: Page, display: Display, window: tuple[float, float], unit: str, left: int, top: int, height: int
) -> None:
    """Draw a colour bar with its unit above and numbers to its right."""
    em = page.em
    width = round(1.1 * em)
    values = [display.value_at(share, window) for share in np.linspace(1.0, 0.0, max(2, height))]
    page.image(display.colored(values, window)[:, None], left, top, width, height)
    page.text(unit_text(unit), left, top - 0.9 * em, 0.9 * em, page.ink)
    for value in display.marks(window):
        row = top + height * (1 - float(display.shares(value, window)))
        page.line([(left + width, row), (left + width + 0.3 * em, row)], page.ink, 0.06 * em)
        page.text(number(value), left + width + 0.5 * em, row + 0.33 * em, 0.9 * em, page.ink)


def bar_width(page: Page, display: Display, window: tuple[float, float], unit: str) -> int:
    """Return the width, pixels, of a colour bar with its numbers."""
    numbers_width = 1.6 * page.em + max(letters.width(number(v), 0.9 * page.em) for v in display.marks(window))
    return round(max(numbers_width, letters.width(unit_text(unit), 0.9 * page.em)))
