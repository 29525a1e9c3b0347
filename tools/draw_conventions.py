"""Draw the pictures of docs/conventions.md, perspective.md and architecture.md: ``python tools/draw_conventions.py``."""

# ruff: noqa: RUF005 (arrays plus lists are sums here)

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from xml.sax.saxutils import escape

import numpy as np

import mphdrr.core as mph
from mphdrr.core.geometry.frames import module_frames

FOLDER = Path(__file__).resolve().parents[1] / "docs" / "images"

# Each picture has a ground of its own, so that it can be read on pages of any colour; it is dark where the reader's are.
STYLE = """
svg { --ground: #fbfcfe; --line: #24323f; --soft: #65758a; --u: #b3411e; --v: #1b7a4b; --k: #1f5fa8; --fill: #e6edf5 }
@media (prefers-color-scheme: dark) {
  svg { --ground: #1b2229; --line: #dfe7ef; --soft: #93a4b5; --u: #ff9470; --v: #5fd39a; --k: #7ab5ff; --fill: #2c3945 } }
text { font: 15px "Segoe UI", "Helvetica Neue", Helvetica, Arial, sans-serif; fill: var(--line); stroke: none }
path { fill: none; stroke: var(--line); stroke-width: 1.6; stroke-linejoin: round }
.ground { fill: var(--ground); stroke: none } .soft { stroke: var(--soft) } text.soft { fill: var(--soft); stroke: none }
.dashed { stroke-dasharray: 5 4; stroke: var(--soft) } .area { fill: var(--fill) }
.u { stroke: var(--u) } .v { stroke: var(--v) }
.k { stroke: var(--k) } .thick { stroke-width: 2.6 }
text.u { fill: var(--u); stroke: none } text.v { fill: var(--v); stroke: none }
text.k { fill: var(--k); stroke: none } circle { fill: var(--line) }
.mono { font-family: Menlo, Consolas, monospace; font-size: 14px }
"""

Point = Sequence[float]


class Picture:
    """An SVG drawing in its own pixels."""

    def __init__(self, title: str, width: int, height: int) -> None:
        self.size, self.parts = (width, height), [f"<title>{escape(title)}</title>", f"<style>{STYLE}</style>"]
        self.parts.append(f'<rect class="ground" width="{width}" height="{height}" rx="12"/>')

    def path(self, points: Sequence[Point], look: str = "", closed: bool = False) -> None:
        """Draw lines through `points`."""
        steps = " L".join(f"{x:.1f} {y:.1f}" for x, y in points)
        self.parts.append(f'<path class="{look}" d="M{steps}{" Z" * closed}"/>')

    def arrow(self, start: Point, end: Point, look: str = "", both: bool = False) -> None:
        """Draw a line with a head at its end, or at both."""
        self.path([start, end], look)
        for tip, tail in [(end, start)] + [(start, end)] * both:
            along = np.subtract(tail, tip) / max(np.linalg.norm(np.subtract(tail, tip)), 1e-9)
            across = np.array([-along[1], along[0]])
            self.path([tip + 10 * along + 4 * across, tip, tip + 10 * along - 4 * across], look)

    def text(self, at: Point, words: str, look: str = "", anchor: str = "middle") -> None:
        """Write `words`; `anchor` is start, middle or end."""
        x, y = at
        self.parts.append(f'<text class="{look}" x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(words)}</text>')

    def dot(self, at: Point, radius: float = 4) -> None:
        """Draw a point."""
        self.parts.append(f'<circle cx="{at[0]:.1f}" cy="{at[1]:.1f}" r="{radius}"/>')

    def circle(self, at: Point, radius: float, look: str = "") -> None:
        """Draw a circle as a path, which looks as lines do."""
        turn = np.linspace(0, 2 * np.pi, 73)
        self.path(np.asarray(at) + radius * np.stack([np.cos(turn), np.sin(turn)], 1), look, closed=True)

    def write(self, name: str) -> None:
        """Write docs/images/`name`."""
        width, height = self.size
        head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" role="img">'
        (FOLDER / name).write_text("\n".join([head, *self.parts, "</svg>", ""]), encoding="utf-8")


def draw_frames() -> None:
    """Draw world and module frame."""
    p, length, side = np.array([-156.0, 42.0, 55.0]), 65.0, 56.0
    u, v, k = module_frames(p[None])[0]
    right, up = np.array([0.80, -0.60, 0.0]), np.array([0.26, 0.35, 0.90])  # a parallel view from above
    picture = Picture("The world's axes and a module's frame u, v, k", 760, 400)

    def at(point: np.ndarray) -> np.ndarray:
        return np.array([430 + 1.35 * point @ right, 235 - 1.35 * point @ up])

    zero = np.zeros(3)
    picture.circle(at(zero), 1.35 * 60, "soft")
    for axis, name in zip(np.eye(3), "xyz", strict=True):
        picture.arrow(at(zero), at(105 * axis))
        picture.text(at(118 * axis) + [0, 5], name)
    picture.text(at(118 * np.eye(3)[2]) + [12, 5], ", along the patient", "soft", "start")
    corners = [p - length * k + 0.5 * side * (a * u + b * v) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    picture.path([at(c) for c in corners], "area", closed=True)
    for corner in corners:
        picture.path([at(p), at(corner)], "soft")
    picture.path([at(p), at(zero)], "dashed")
    for vector, name in ((u, "u"), (v, "v"), (k, "k")):
        picture.arrow(at(p), at(p + 62 * vector), f"{name} thick")
        picture.text(at(p + 76 * vector) + [0, 5], name, name)
    picture.dot(at(p))
    picture.dot(at(zero))
    picture.text(at(p) + [4, 28], "pinhole p", "", "start")
    picture.text(at(zero) + [10, 24], "isocentre, origin", "", "start")
    picture.text(0.5 * (at(p) + at(zero)) + [16, -8], "b", "soft")
    picture.text(at(corners[0]) + [-4, 26], "crystal, side Ld", "", "middle")
    picture.text(at(zero) + [1.35 * 60 - 6, 62], "ROI, radius R", "soft", "start")
    picture.text((380, 382), "k: from the pinhole to the isocentre;  u = z × k / |z × k|;  v = k × u", "mono")
    picture.write("frames.svg")


def draw_detectors() -> None:
    """Draw real and virtual detector, from the side."""
    picture = Picture("The real detector behind the pinhole and the virtual one in front of it", 760, 400)
    pinhole, length, factor, distance, half = np.array([150.0, 205.0]), 62.0, 8.0, 250.0, 17.0
    far, near = pinhole[0] + factor * length, pinhole[0] - length
    picture.path(
        [(near - 14, 205 - half), (near, 205 - half), (near, 205 + half), (near - 14, 205 + half)], "area", True
    )
    picture.path([(far, 205 - factor * half), (far, 205 + factor * half)], "thick")
    iso = pinhole + [distance, 0]
    for sign in (-1, 1):
        picture.path([(near, 205 - sign * half), (far, 205 + sign * factor * half)], "soft")
        picture.path([pinhole + [0, sign * 4], pinhole + [0, sign * 60]], "thick")
    picture.circle(iso, distance * half / length * 0.985, "soft")
    picture.arrow(pinhole, pinhole + [62, 0], "k thick")
    picture.text(pinhole + [48, 21], "k", "k", "start")
    # An upright object, its upright image on the virtual detector, and its inverted one on the crystal.
    height = 46.0
    picture.arrow(iso + [0, 12], iso - [0, height], "v thick")
    picture.arrow(
        (far, 205 + 12 * factor * length / distance), (far, 205 - height * factor * length / distance), "v thick"
    )
    picture.arrow((near, 205 - 12 * length / distance), (near, 205 + height * length / distance), "v thick")
    picture.path([(near, 205 + height * length / distance), (far, 205 - height * factor * length / distance)], "dashed")
    picture.dot(iso)
    picture.text(iso + [8, 24], "isocentre", "", "start")
    picture.text(iso - [60, 74], "ROI, radius R", "soft")
    picture.text(pinhole + [0, -72], "pinhole")
    picture.text((near - 8, 205 - half - 34), "real detector:")
    picture.text((near - 8, 205 - half - 15), "image inverted")
    picture.text((far - 12, 46), "virtual detector:", "", "end")
    picture.text((far - 12, 65), "image upright", "", "end")
    for (start, end), level, name in (
        ((near, pinhole[0]), 300, "l"),
        ((pinhole[0], iso[0]), 300, "b"),
        ((pinhole[0], far), 352, "magnification · l"),
    ):
        picture.arrow((start, level), (end, level), "soft", both=True)
        picture.text(((start + end) / 2, level - 7), name, "mono")
    words = "The same rays make both images: (u, v) of the virtual one is (-u, -v) / magnification on the crystal."
    picture.text((380, 388), words, "soft")
    picture.write("detectors.svg")


def draw_arrays() -> None:
    """Draw the order of pixels, and voxels' indices."""
    picture = Picture("The order of pixels in arrays and pictures, and the index of a voxel", 760, 330)
    cell, rows, columns = 46, 3, 4
    for left, title, place in (
        (34, "array images[m]", lambda i, j: (j, i)),
        (272, "picture: as the pinhole sees it", lambda i, j: (columns - 1 - j, rows - 1 - i)),
    ):
        picture.text((left + columns * cell / 2, 40), title)
        for i in range(rows):
            for j in range(columns):
                x, y = left + cell * place(i, j)[0], 62 + cell * place(i, j)[1]
                box = [(x, y), (x + cell, y), (x + cell, y + cell), (x, y + cell)]
                picture.path(box, "area" if i == j == 0 else "", closed=True)
                picture.text((x + cell / 2, y + cell / 2 + 5), f"{i},{j}", "mono")
    bottom = 62 + rows * cell
    picture.arrow((34, bottom + 18), (34 + 80, bottom + 18), "u thick")
    picture.text((34 + 90, bottom + 23), "u: column", "u", "start")
    picture.arrow((20, 62), (20, 62 + 80), "v thick")
    picture.text((20, 62 + 98), "v", "v")
    right = 272 + columns * cell
    picture.arrow((right, bottom + 18), (right - 80, bottom + 18), "u thick")
    picture.text((right - 90, bottom + 23), "u", "u", "end")
    picture.arrow((right + 14, bottom), (right + 14, bottom - 80), "v thick")
    picture.text((right + 14, bottom - 88), "v", "v")
    picture.text((34, 268), "Centre of pixel (i, j) on the detector, from its middle:", "", "start")
    picture.text((34, 290), "u = (j + 1/2 - n_u/2) · pitch_u + x0", "mono", "start")
    picture.text((34, 310), "v = (i + 1/2 - n_v/2) · pitch_v + y0", "mono", "start")

    grid = mph.Grid((4, 3, 1), np.array([[38, 13, 0, 0], [-10, 34, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]]))
    zero = np.array([560.0, 190.0])

    def at(*index: float) -> np.ndarray:
        x, y, _ = grid.affine[:3, :3] @ (*index, 0.0)
        return zero + [x, -y]

    for i in range(4):
        for j in range(3):
            box = [at(i + a, j + b) for a, b in ((-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5))]
            picture.path(box, "area" if i == j == 0 else "", closed=True)
            picture.dot(at(i, j), 2.5)
    picture.text((640, 40), "volume[ix, iy, iz]")
    picture.arrow(at(0, 0), at(1, 0), "u thick")
    picture.arrow(at(0, 0), at(0, 1), "v thick")
    picture.text(at(0.75, -1.35), "affine[:3, 0]", "mono u")
    picture.text(at(-0.65, 1.1), "[:3, 1]", "mono v", "end")
    picture.text((622, 290), "world = affine · (ix, iy, iz, 1)", "mono")
    picture.text((622, 310), "an integer index is a voxel's centre", "soft")
    picture.write("arrays.svg")


def draw_perspective() -> None:
    """Draw one view's cells in the world, and in its own coordinates."""
    picture = Picture("The cells of a perspective grid in the world, and in the view's own coordinates", 760, 430)
    pinhole, distance, pitch, columns = np.array([40.0, 205.0]), 320.0, 52.0, 5
    ks = np.linspace(4.0, 1.0, 7)

    def world(column: float, k: float) -> np.ndarray:
        return pinhole + [distance / k, -(column - (columns - 1) / 2) * pitch / k]

    def own(column: float, k: float) -> np.ndarray:
        return np.array([684 - 74 * (k - 1), 205 - (column - (columns - 1) / 2) * pitch])

    borders = np.arange(columns + 1) - 0.5
    for at in (world, own):
        corners = [at(0.5, ks[4]), at(1.5, ks[4]), at(1.5, ks[5]), at(0.5, ks[5])]
        picture.path(corners, "area", closed=True)
        for border in borders:
            picture.path([at(border, ks[0]), at(border, ks[-1])], "soft")
        for k in ks:
            picture.path([at(borders[0], k), at(borders[-1], k)], "thick" if k == 1 else "soft")
        start, end = np.array([0.4, 3.6]), np.array([3.9, 1.25])  # column, k
        # A straight line of the world is one of these coordinates, too.
        picture.path([at(*start), at(*end)], "v thick")
    for border in borders[[0, -1]]:
        picture.path([pinhole, world(border, ks[0])], "dashed")
    picture.dot(pinhole)
    picture.text(pinhole + [-4, 30], "source", "", "start")
    picture.text((200, 34), "world, mm")
    picture.text((573, 34), "the view's column and k")
    for at in (world, own):
        for k in (4, 2, 1):
            picture.text(at(borders[0], k) + [0, 22 if at is own or k < 4 else 34], f"{k}", "mono k")
    picture.arrow(pinhole + [distance + 22, 205 - 150], pinhole + [distance + 22, -60], "u thick")
    picture.text(pinhole + [distance + 32, 0], "column", "u", "start")
    picture.text(world(borders[-1], 1) + [0, -10], "detector")
    picture.arrow((700, 255), (700, 145), "u thick")
    picture.text((712, 134), "column", "u")
    picture.arrow((40, 386), (360, 386), "soft")
    picture.text((200, 378), "depth, D at the detector", "soft")
    picture.arrow((360, 408), (40, 408), "k thick")
    picture.text((200, 425), "k = D / depth", "k")
    picture.arrow((684, 386), (462, 386), "k thick")
    picture.text((573, 404), "k", "k")
    picture.write("perspective.svg")


def draw_architecture() -> None:
    """Draw the flow of data from inputs to results, with the room of core that does each step."""
    picture = Picture("What becomes of what in mphDRR, and the folder that does it", 1000, 560)

    def box(x: float, y: float, name: str, room: str, look: str = "area") -> None:
        picture.path([(x, y), (x + 180, y), (x + 180, y + 56), (x, y + 56)], look, closed=True)
        picture.text((x + 90, y + 24), name)
        picture.text((x + 90, y + 44), room, "soft mono")

    surfaces = ("panels, operators, addon", "the command line: core/cli", "import mphdrr.core as mph")
    for x, name in zip((30, 350, 670), surfaces, strict=True):
        picture.path([(x, 24), (x + 300, 24), (x + 300, 62), (x, 62)], "thick", closed=True)
        picture.text((x + 150, 49), name)
    picture.text((500, 92), "all three give the same settings to the same functions of core", "soft")
    box(30, 130, "workbook .xlsx", "workbook")
    box(30, 240, "phantom .toml, CT", "phantoms, volumes")
    box(30, 350, "isotope, materials", "physics")
    box(280, 130, "Scanner, its Views", "geometry, xray")
    box(280, 240, "Volume on a Grid", "volumes")
    box(280, 350, "model of photons", "models, xray")
    box(530, 240, "Projector", "projector", "area thick")
    box(780, 130, "run .h5: images", "runs")
    box(780, 240, "Volume, scores", "reconstruction")
    box(780, 350, "event set", "events")
    box(530, 460, "four backends", "rays/backends")
    box(530, 130, "other programs", "exchange")
    box(780, 460, "networks, designs", "learning, design")
    for y in (158, 268, 378):
        picture.arrow((210, y), (280, y))
    for y, end in ((172, 252), (268, 268), (378, 284)):
        picture.arrow((460, y), (530, end))
    for start, y in ((252, 158), (284, 378)):
        picture.arrow((710, start), (780, y))
    picture.arrow((870, 186), (870, 240))
    picture.arrow((620, 460), (620, 296), "soft")
    picture.arrow((870, 406), (870, 460))
    picture.arrow((460, 150), (530, 150))
    picture.write("architecture.svg")


if __name__ == "__main__":
    draw_frames()
    draw_detectors()
    draw_arrays()
    draw_perspective()
    draw_architecture()
