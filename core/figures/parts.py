"""Parts that flat figures share: their heading, axes in mm and colour bars."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..runs import letters
from ..runs.display import Display, unit_text
from .page import Page, Point, box

INK, FAINT = "#20262d", "#6b7480"
"""Colours of text and lines, and of notes."""
PLANES = ((2, 0, 1), (1, 0, 2), (0, 1, 2))
"""The axis across, and those to the right and upward, of what is seen from the head, from the front and from the left."""
_STEPS = (1.0, 2.0, 2.5, 5.0, 10.0)


def heading(page: Page, title: str, lines: Sequence[str] = (), ink: str = INK, faint: str = FAINT) -> int:
    """Write a title and lines below it; returns the first row that is free."""
    em = page.em
    row, room = 0.9 * em, page.width - 2 * em
    for text, size, step, color in (
        (title, 1.25 * em, 1.2 * em, ink),
        *((line, em, 1.45 * em, faint) for line in lines),
    ):
        row += step
        # A line that is too long is written smaller.
        page.text(text, em, row, size * min(1.0, room / max(letters.width(text, size), 1.0)), color)
    return heading_height(page, len(lines))


def heading_height(page: Page, lines: int) -> int:
    """Rows that a heading with so many lines below its title takes."""
    return round((3.1 + 1.45 * lines) * page.em)


def ticks(low: float, high: float, most: int) -> list[float]:
    """Round numbers from `low` to `high`, `most` steps at most."""
    raw = (high - low) / max(1, most)
    power = 10.0 ** np.floor(np.log10(raw))
    step = power * next(s for s in _STEPS if s * power >= raw * (1 - 1e-9))
    first = np.ceil(low / step - 1e-9)
    return [float(step * n) for n in np.arange(first, np.floor(high / step + 1e-9) + 1)]


class Axes(NamedTuple):
    """A frame (left, top, width, height) on a page, with values `x` from its left to its right and `y` upward."""

    page: Page
    frame: tuple[float, float, float, float]
    x: tuple[float, float]
    y: tuple[float, float]
    em: float
    ink: str = INK

    def to(self, x: float, y: float) -> Point:
        """Where on the page a pair of values is."""
        left, top, width, height = self.frame
        (first, last), (low, high) = self.x, self.y
        return left + width * (x - first) / (last - first), top + height * (high - y) / (high - low)

    def curve(self, xs: ArrayLike, ys: ArrayLike, color: str, width: float) -> None:
        """Draw a line through pairs of values, `width` times the size of text wide."""
        self.page.line(list(map(self.to, np.asarray(xs).tolist(), np.asarray(ys).tolist())), color, width * self.em)

    def draw(self, xs: Iterable[float], ys: Iterable[float], title: str = "", below: str = "", digits: int = 4) -> None:
        """Draw the frame with marks and numbers at the values `xs` and `ys`, a title above it and a text below."""
        page, em, (left, top, width, height) = self.page, self.em, self.frame
        page.line([*box(*self.frame), (left, top)], self.ink, 0.06 * em)
        for value in xs:
            x, bottom = self.to(value, self.y[0])
            page.line([(x, bottom), (x, bottom + 0.3 * em)], self.ink, 0.06 * em)
            page.text(number(value), x, bottom + 1.3 * em, 0.8 * em, page.ink, "middle")
        for value in ys:
            y = self.to(self.x[0], value)[1]
            page.line([(left - 0.3 * em, y), (left, y)], self.ink, 0.06 * em)
            page.text(number(value, digits), left - 0.5 * em, y + 0.3 * em, 0.8 * em, page.ink, "end")
        for text, size, y in ((title, em, top - 0.6 * em), (below, 0.85 * em, top + height + 2.6 * em)):
            if text:
                page.text(text, left + width / 2, y, size, page.ink, "middle")


def arranged(
    sizes: Sequence[tuple[float, float]],
    margins: tuple[float, float, float, float],
    room: tuple[float, float, float, float],
    *ways: Sequence[Sequence[int]],
) -> tuple[float, list[Point]]:
    """Arrange rectangles of `sizes`, mm, in rows: pixels per mm, and each one's left top corner.

    Of the `ways`, rows of the rectangles' indices, the one is taken that shows them largest; it is centred in the `room`
    (left, top, width, height). `margins` are free around each rectangle: left, top, right, bottom.
    """
    left, top, width, height = room
    beside, beyond = margins[0] + margins[2], margins[1] + margins[3]

    def scale(rows: Sequence[Sequence[int]]) -> float:
        across = min((width - len(row) * beside) / sum(sizes[i][0] for i in row) for row in rows)
        return min(across, (height - len(rows) * beyond) / sum(max(sizes[i][1] for i in row) for row in rows))

    rows = max(ways, key=scale)
    pixels = max(scale(rows), 1e-9)
    talls = [max(sizes[i][1] for i in row) * pixels + beyond for row in rows]
    corners, y = dict[int, Point](), top + max(0.0, (height - sum(talls)) / 2)
    for row, tall in zip(rows, talls, strict=True):
        x = left + max(0.0, (width - sum(sizes[i][0] * pixels + beside for i in row)) / 2)
        for i in row:
            corners[i] = x + margins[0], y + tall - margins[3] - sizes[i][1] * pixels
            x += sizes[i][0] * pixels + beside
        y += tall
    return pixels, [corners[i] for i in range(len(sizes))]


def number(value: float, digits: int = 4) -> str:
    """A number with a proper minus sign."""
    return f"{value + 0.0:.{digits}g}".replace("-", "−")  # -0 is 0


def color_bar(
    page: Page, display: Display, window: tuple[float, float], unit: str, left: int, top: int, height: int
) -> None:
    """A colour bar with its numbers on its right, and its unit above."""
    em = page.em
    width = round(1.1 * em)
    ramp = [display.value_at(share, window) for share in np.linspace(1.0, 0.0, max(2, height))]
    page.image(display.colored(ramp, window)[:, None], left, top, width, height)
    page.text(unit_text(unit), left, top - 0.9 * em, 0.9 * em, page.ink)
    for share in (0.0, 0.25, 0.5, 0.75, 1.0):
        row = top + height * (1 - share)
        page.line([(left + width, row), (left + width + 0.3 * em, row)], page.ink, 0.06 * em)
        page.text(number(display.value_at(share, window)), left + width + 0.5 * em, row + 0.33 * em, 0.9 * em, page.ink)


def bar_width(page: Page, display: Display, window: tuple[float, float], unit: str) -> int:
    """Columns that a colour bar takes."""
    texts = [number(display.value_at(share, window)) for share in (0.0, 0.25, 0.5, 0.75, 1.0)]
    numbers = 1.6 * page.em + max(letters.width(text, 0.9 * page.em) for text in texts)
    return round(max(numbers, letters.width(unit_text(unit), 0.9 * page.em)))
