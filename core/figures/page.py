"""Pages on which figures are drawn, both as pixels and as SVG: pictures, lines, areas and text."""

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
from ..runs.display import resize_picture
from ..runs.mosaic import png_bytes, write_png

SUFFIXES = (".png", ".svg")
SMALLEST, LARGEST = 120, 16384
"""Limits of a page's sides, pixels."""
DARK = "#14161a"
"""Paper colour of pages that are shown on a screen, beside dark editors."""

Point = tuple[float, float]
Anchor = Literal["start", "middle", "end"]
_STARTS: dict[Anchor, float] = {"start": 0.0, "middle": 0.5, "end": 1.0}
_FONTS = "DejaVu Sans, Verdana, Arial, sans-serif"


class Page:
    """A page of `width` x `height` pixels, drawn as pixels and as SVG at once.

    Positions are in pixels from the top left corner, colours are texts like "#20262d". `em` is the size of normal text; by
    default it follows from the page's size. `ink` and `faint` are the colours that suit the paper: the first for text and
    lines, the second for notes.
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
        """Colours (height, width, 3) of the page's pixels, 8-bit sRGB."""
        return np.rint(self._pixels).clip(0, 255).astype(np.uint8)

    def image(self, picture: Bytes, left: int, top: int, width: int, height: int) -> None:
        """Put a picture (h, w, 3) into a rectangle; enlarged pixels stay squares."""
        rows, columns = max(1, height), max(1, width)
        pixels = picture if picture.shape[:2] == (rows, columns) else resize_picture(picture, rows, columns)
        self._pixels[top : top + rows, left : left + columns] = pixels
        encoded = base64.b64encode(png_bytes(picture)).decode()
        style = ' style="image-rendering:pixelated"' if picture.shape[1] < columns else ""
        self._marks.append(
            f'<image x="{left}" y="{top}" width="{columns}" height="{rows}" preserveAspectRatio="none"{style} '
            f'href="data:image/png;base64,{encoded}"/>'
        )

    def line(self, points: Sequence[Point], color: str, width: float = 1.5, dash: float = 0.0) -> None:
        """Draw a line through points; it is dashed if `dash`, the length of a dash and of a gap in pixels, is not 0."""
        self._blend(self._line_coverage(list(_dashes(points, dash)) if dash else [points], width / 2), color)
        dash_style = f' stroke-dasharray="{dash:.2f} {dash:.2f}"' if dash else ""
        self._marks.append(
            f'<polyline points="{_svg_points(points)}" fill="none" stroke="{color}" stroke-width="{width:.2f}" '
            f'stroke-linejoin="round"{dash_style}/>'
        )

    def area(self, points: Sequence[Point], color: str, opacity: float = 1.0) -> None:
        """Fill a convex polygon."""
        corners = np.asarray(points, float)
        top, left, x, y = self._region(corners, 1.0)
        next_corners = np.roll(corners, -1, axis=0)
        orientation = np.sign(np.sum(corners[:, 0] * next_corners[:, 1] - next_corners[:, 0] * corners[:, 1]))
        distance = np.full(x.shape, -np.inf)  # of pixels from the polygon, negative inside
        for (x0, y0), (dx, dy) in zip(corners, next_corners - corners, strict=True):
            length = float(np.hypot(dx, dy)) or 1.0
            distance = np.maximum(distance, orientation * ((x - x0) * dy - (y - y0) * dx) / length)
        self._blend((top, left, opacity * np.clip(0.5 - distance, 0.0, 1.0)), color)
        self._marks.append(f'<polygon points="{_svg_points(points)}" fill="{color}" fill-opacity="{opacity:g}"/>')

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
        """Write a line of text that starts, is centred or ends at (x, y) on its baseline; `upward` turns it by 90°."""
        coverage, baseline = letters.text_ink(text, size)
        offset = _STARTS[anchor] * coverage.shape[1]
        if upward:
            coverage, left, top = np.rot90(coverage), x - baseline, y - coverage.shape[1] + offset
        else:
            left, top = x - offset, y - baseline
        self._blend((round(top), round(left), coverage), color)
        rotation = f' transform="rotate(-90 {x:.2f} {y:.2f})"' if upward else ""
        self._marks.append(
            f'<text x="{x:.2f}" y="{y:.2f}" font-size="{size:.2f}" fill="{color}" text-anchor="{anchor}"{rotation}>'
            f"{escape(text)}</text>"
        )

    def write(self, path: AnyPath) -> None:
        """Write the page in the format of the file's ending, .png or .svg."""
        if require_ending(path, SUFFIXES) == ".png":
            write_png(self.picture, path)
            return
        size = f'width="{self.width}" height="{self.height}" viewBox="0 0 {self.width} {self.height}"'
        head = f'<svg xmlns="http://www.w3.org/2000/svg" {size} font-family="{_FONTS}" xml:space="preserve">'
        write_bytes(path, "\n".join([head, *self._marks, "</svg>\n"]).encode())

    def _region(self, points: Floats, margin: float) -> tuple[int, int, Array, Array]:
        """Return the part of the page around `points` with a margin: first row, first column, and its pixels' x and y."""
        low = np.maximum(np.floor(points.min(axis=0) - margin), 0).astype(int)
        high = np.minimum(np.ceil(points.max(axis=0) + margin), [self.width, self.height]).astype(int)
        x, y = np.arange(low[0], max(high[0], low[0])) + 0.5, np.arange(low[1], max(high[1], low[1])) + 0.5
        columns, rows = np.meshgrid(x, y)
        return int(low[1]), int(low[0]), columns, rows

    def _line_coverage(self, lines: Sequence[Sequence[Point]], half: float) -> tuple[int, int, Array]:
        """Return the fraction of each pixel covered by lines of half-width `half`, for anti-aliasing.

        The result is the first row and column of the covered region, and the fractions (rows, columns) there.
        """
        points = np.array([point for line in lines for point in line], float).reshape(-1, 2)
        top, left, x, y = self._region(points, half + 1.0)
        coverage = np.zeros(x.shape)
        for start, end in (np.array(ends, float) for line in lines for ends in pairwise(line)):
            low = np.maximum(np.floor(np.minimum(start, end) - half - 1.0).astype(int) - [left, top], 0)
            high = np.maximum(np.ceil(np.maximum(start, end) + half + 1.0).astype(int) - [left, top], 0)
            region = slice(low[1], high[1]), slice(low[0], high[0])
            step = end - start
            dx, dy = x[region] - start[0], y[region] - start[1]
            t = np.clip((dx * step[0] + dy * step[1]) / max(float(step @ step), 1e-12), 0.0, 1.0)
            distance = np.hypot(dx - t * step[0], dy - t * step[1])
            coverage[region] = np.maximum(coverage[region], np.clip(half + 0.5 - distance, 0.0, min(1.0, 2 * half)))
        return top, left, coverage

    def _blend(self, coverage: tuple[int, int, Array], color: str) -> None:
        """Blend a colour into pixels, as far as they are on the page.

        `coverage` holds the first row, the first column and the fractions (rows, columns) of a region.
        """
        top, left, fractions = coverage
        fractions = fractions[max(-top, 0) :, max(-left, 0) :]
        top, left = max(top, 0), max(left, 0)
        pixels = self._pixels[top : top + fractions.shape[0], left : left + fractions.shape[1]]
        fractions = fractions[: pixels.shape[0], : pixels.shape[1], None]
        pixels += fractions * (_rgb(color) - pixels)


def box(left: float, top: float, width: float, height: float) -> list[Point]:
    """Return the four corners of a rectangle."""
    return [(left, top), (left + width, top), (left + width, top + height), (left, top + height)]


def circle(x: float, y: float, radius: float, corners: int = 24) -> list[Point]:
    """Return the corners of a regular polygon that stands for a circle around (x, y)."""
    angles = np.linspace(0, 2 * np.pi, corners, endpoint=False)
    return [(x + radius * np.cos(angle), y + radius * np.sin(angle)) for angle in angles]


def _dashes(points: Sequence[Point], dash: float) -> Iterator[list[Point]]:
    """Yield the dashes of a line through points, as lists of points; dashes and gaps are `dash` long."""
    corners = np.asarray(points, float)
    arc = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(corners, axis=0).T))])
    for start in np.arange(0.0, arc[-1], 2 * dash):
        ends = np.clip([start, start + dash], 0.0, arc[-1])
        inner = arc[(arc > ends[0]) & (arc < ends[1])]
        stops = np.concatenate([ends[:1], inner, ends[1:]])
        yield [(float(np.interp(s, arc, corners[:, 0])), float(np.interp(s, arc, corners[:, 1]))) for s in stops]


def _rgb(color: str) -> Floats32:
    """Return red, green and blue (3,), 0 to 255, of a colour like "#20262d"."""
    return np.array(list(bytes.fromhex(color.removeprefix("#"))), np.float32)


def _svg_points(points: ArrayLike) -> str:
    """Return points as text for SVG."""
    return " ".join(f"{x:.2f},{y:.2f}" for x, y in np.asarray(points, float))
