"""A page on which figures are drawn, once as pixels and once as SVG: pictures, lines, areas and text."""

import base64
from collections.abc import Iterator, Sequence
from html import escape
from itertools import pairwise
from typing import Literal

import numpy as np

from ..arrays import Array, ArrayLike, Bytes, Floats, Floats32
from ..errors import InputError
from ..files import AnyPath, require_ending, write_bytes
from ..runs import letters
from ..runs.mosaic import png, write_png
from ..runs.resizing import resized

SUFFIXES = (".png", ".svg")
SMALLEST, LARGEST = 120, 16384
"""Limits of a page's sides, pixels."""
DARK = "#14161a"
"""The paper of pages that are looked at on a screen, beside dark editors."""

Point = tuple[float, float]
Anchor = Literal["start", "middle", "end"]
_STARTS: dict[Anchor, float] = {"start": 0.0, "middle": 0.5, "end": 1.0}
_FONTS = "DejaVu Sans, Verdana, Arial, sans-serif"


class Page:
    """A page of `width` x `height` pixels; places are in pixels from its top left corner, colours like "#20262d".

    `em` is the size of its text, by default one that suits the page. `ink` and `faint` are the colours that suit its paper:
    of text and lines, and of notes.
    """

    def __init__(self, width: int, height: int, paper: str = "#ffffff", em: float = 0.0) -> None:
        for side in (width, height):
            if not SMALLEST <= side <= LARGEST:
                raise InputError(f"size {width}x{height}: expected {SMALLEST} to {LARGEST} pixels along each side")
        self.width, self.height, self.paper = width, height, paper
        self.em = em or max(7.0, min(width, 1.8 * height) / 72)
        self.ink, self.faint = ("#20262d", "#6b7480") if _rgb(paper).mean() > 127 else ("#eceef2", "#98a2b0")
        self._pixels = np.empty((height, width, 3), np.float32)
        self._pixels[:] = _rgb(paper)
        self._marks = [f'<rect width="{width}" height="{height}" fill="{paper}"/>']

    @property
    def picture(self) -> Bytes:
        """Colours (height, width, 3)."""
        return np.rint(self._pixels).clip(0, 255).astype(np.uint8)

    def image(self, picture: Bytes, left: int, top: int, width: int, height: int) -> None:
        """Put colours (h, w, 3) into a rectangle; enlarged pixels stay squares."""
        rows, columns = max(1, height), max(1, width)
        self._pixels[top : top + rows, left : left + columns] = (
            picture if picture.shape[:2] == (rows, columns) else resized(picture, rows, columns)
        )
        data = base64.b64encode(png(picture)).decode()
        look = ' style="image-rendering:pixelated"' if picture.shape[1] < columns else ""
        self._marks.append(
            f'<image x="{left}" y="{top}" width="{columns}" height="{rows}" preserveAspectRatio="none"{look} '
            f'href="data:image/png;base64,{data}"/>'
        )

    def line(self, points: Sequence[Point], color: str, width: float = 1.5, dash: float = 0.0) -> None:
        """Draw a line through points, or one of dashes that are `dash` long."""
        self._ink(self._covered_by_lines(list(_dashes(points, dash)) if dash else [points], width / 2), color)
        dashes = f' stroke-dasharray="{dash:.2f} {dash:.2f}"' if dash else ""
        self._marks.append(
            f'<polyline points="{_listed(points)}" fill="none" stroke="{color}" stroke-width="{width:.2f}" '
            f'stroke-linejoin="round"{dashes}/>'
        )

    def area(self, points: Sequence[Point], color: str, opacity: float = 1.0) -> None:
        """Fill a convex polygon."""
        corners = np.asarray(points, float)
        top, left, x, y = self._around(corners, 1.0)
        after = np.roll(corners, -1, axis=0)
        turn = np.sign(np.sum(corners[:, 0] * after[:, 1] - after[:, 0] * corners[:, 1]))
        outside = np.full(x.shape, -np.inf)
        for (x0, y0), (dx, dy) in zip(corners, after - corners, strict=True):
            length = float(np.hypot(dx, dy)) or 1.0
            outside = np.maximum(outside, turn * ((x - x0) * dy - (y - y0) * dx) / length)
        self._ink((top, left, opacity * np.clip(0.5 - outside, 0.0, 1.0)), color)
        self._marks.append(f'<polygon points="{_listed(points)}" fill="{color}" fill-opacity="{opacity:g}"/>')

    def text(
        self,
        text: str,
        x: float,
        y: float,
        size: float,
        color: str = "#000000",
        anchor: Anchor = "start",
        upward: bool = False,
    ) -> None:
        """Write a line of text that stands on (x, y), and begins, has its middle or ends there; `upward` turns it."""
        ink, baseline = letters.lettered(text, size)
        before = _STARTS[anchor] * ink.shape[1]
        if upward:
            ink, left, top = np.rot90(ink), x - baseline, y - ink.shape[1] + before
        else:
            left, top = x - before, y - baseline
        self._ink((round(top), round(left), ink), color)
        turn = f' transform="rotate(-90 {x:.2f} {y:.2f})"' if upward else ""
        self._marks.append(
            f'<text x="{x:.2f}" y="{y:.2f}" font-size="{size:.2f}" fill="{color}" text-anchor="{anchor}"{turn}>'
            f"{escape(text)}</text>"
        )

    def write(self, path: AnyPath) -> None:
        """Write the page in the format that its name says, .png or .svg."""
        if require_ending(path, SUFFIXES) == ".png":
            write_png(self.picture, path)
            return
        size = f'width="{self.width}" height="{self.height}" viewBox="0 0 {self.width} {self.height}"'
        head = f'<svg xmlns="http://www.w3.org/2000/svg" {size} font-family="{_FONTS}" xml:space="preserve">'
        write_bytes(path, "\n".join([head, *self._marks, "</svg>\n"]).encode())

    def _around(self, points: Floats, margin: float) -> tuple[int, int, Array, Array]:
        """The part of the page that holds points: its first row and column, and its pixels' x and y."""
        low = np.maximum(np.floor(points.min(axis=0) - margin), 0).astype(int)
        high = np.minimum(np.ceil(points.max(axis=0) + margin), [self.width, self.height]).astype(int)
        x, y = np.arange(low[0], max(high[0], low[0])) + 0.5, np.arange(low[1], max(high[1], low[1])) + 0.5
        across, down = np.meshgrid(x, y)
        return int(low[1]), int(low[0]), across, down

    def _covered_by_lines(self, lines: Sequence[Sequence[Point]], half: float) -> tuple[int, int, Array]:
        """How much of each pixel lines of half a width cover."""
        every = np.array([point for line in lines for point in line], float).reshape(-1, 2)
        top, left, x, y = self._around(every, half + 1.0)
        covered = np.zeros(x.shape)
        for start, end in (np.array(ends, float) for line in lines for ends in pairwise(line)):
            low = np.maximum(np.floor(np.minimum(start, end) - half - 1.0).astype(int) - [left, top], 0)
            high = np.maximum(np.ceil(np.maximum(start, end) + half + 1.0).astype(int) - [left, top], 0)
            part = slice(low[1], high[1]), slice(low[0], high[0])
            along = end - start
            dx, dy = x[part] - start[0], y[part] - start[1]
            share = np.clip((dx * along[0] + dy * along[1]) / max(float(along @ along), 1e-12), 0.0, 1.0)
            away = np.hypot(dx - share * along[0], dy - share * along[1])
            covered[part] = np.maximum(covered[part], np.clip(half + 0.5 - away, 0.0, min(1.0, 2 * half)))
        return top, left, covered

    def _ink(self, covered: tuple[int, int, Array], color: str) -> None:
        """Paint where `covered` (first row, first column, shares of pixels); what lies beside the page is left out."""
        top, left, share = covered
        share = share[max(-top, 0) :, max(-left, 0) :]
        top, left = max(top, 0), max(left, 0)
        place = self._pixels[top : top + share.shape[0], left : left + share.shape[1]]
        share = share[: place.shape[0], : place.shape[1], None]
        place += share * (_rgb(color) - place)


def box(left: float, top: float, width: float, height: float) -> list[Point]:
    """A rectangle's corners."""
    return [(left, top), (left + width, top), (left + width, top + height), (left, top + height)]


def circle(x: float, y: float, radius: float, corners: int = 24) -> list[Point]:
    """The corners of a polygon that stands for a circle around (x, y)."""
    turns = np.linspace(0, 2 * np.pi, corners, endpoint=False)
    return [(x + radius * np.cos(turn), y + radius * np.sin(turn)) for turn in turns]


def _dashes(points: Sequence[Point], dash: float) -> Iterator[list[Point]]:
    """The dashes of a line."""
    corners = np.asarray(points, float)
    at = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(corners, axis=0).T))])
    for start in np.arange(0.0, at[-1], 2 * dash):
        ends = np.clip([start, start + dash], 0.0, at[-1])
        inner = at[(at > ends[0]) & (at < ends[1])]
        places = np.concatenate([ends[:1], inner, ends[1:]])
        yield [(float(np.interp(a, at, corners[:, 0])), float(np.interp(a, at, corners[:, 1]))) for a in places]


def _rgb(color: str) -> Floats32:
    return np.array(list(bytes.fromhex(color.removeprefix("#"))), np.float32)


def _listed(points: ArrayLike) -> str:
    return " ".join(f"{x:.2f},{y:.2f}" for x, y in np.asarray(points, float))
