"""Figure of one module's geometry to scale: the true pinhole, and a virtual C-arm with its source 5 l from the isocentre.

The C-arm is how projections are often made with a renderer of radiographs: from source to detector 10 l, from source to the
isocentre 5 l ("sdr"), whatever the pinhole's distance b is. It is drawn on the module's side. DiffDRR, given the
workbook's azimuth and elevation, has it at the module's mirror image in z, at the same distances (`c_arm_views`).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..errors import InputError
from ..geometry.presets import c_arm_views
from ..geometry.system import PinholeSystem
from ..geometry.views import Views
from ..runs import letters
from ..runs.display import number_text as number
from .page import Anchor, Page, Point, box, circle
from .parts import FAINT, INK, arrange, heading
from .subject import FigureSubject

_CRYSTAL, _METAL, _ROI, _FAN = "#f0a030", "#8a929c", "#4f9bd6", "#d0502a"
_MARGINS = (3.8, 4.4, 3.8, 8.0)
"""Margins for texts left of a drawing, above it, right of it and below it, in units of the text's size."""


class _AxialDrawing(NamedTuple):
    """A drawing on a page whose coordinates are millimetres from the pinhole: along the principal ray and across it."""

    page: Page
    scale: float  # scale, pixels per mm
    origin: Point  # pinhole on the page

    def point(self, along: float, across: float = 0.0) -> Point:
        """Return the point on the page, pixels, for a point of the drawing, mm."""
        return self.origin[0] + along * self.scale, self.origin[1] - across * self.scale

    def line(self, points: Sequence[Point], color: str, width: float, dash: float = 0.0) -> None:
        """Draw a line through points; width and dash are in units of the text's size."""
        self.page.line([self.point(*p) for p in points], color, width * self.page.em, dash * self.page.em)

    def area(self, points: Sequence[Point], color: str, opacity: float = 1.0) -> None:
        """Fill a convex polygon."""
        self.page.area([self.point(*p) for p in points], color, opacity)

    def circle(self, along: float, radius: float, color: str, opacity: float) -> None:
        """Fill a circle of this `radius`, mm, around a point of the principal ray, and draw its edge."""
        points = circle(along, 0.0, radius, 96)
        self.area(points, color, opacity)
        self.line([*points, points[0]], color, 0.09)

    def dot(self, along: float, radius: float, color: str) -> None:
        """Draw a dot on the principal ray, with a radius in units of the text's size."""
        self.area(circle(along, 0.0, radius * self.page.em / self.scale), color)

    def text(self, text: str, along: float, across: float, down: float, anchor: Anchor = "middle") -> None:
        """Write text at a point, or lower by `down` times the size of the page's text."""
        x, y = self.point(along, across)
        self.page.text(text, x, y + down * self.page.em, 0.85 * self.page.em, INK, anchor)

    def title(self, corner: Point, text: str, line: str) -> None:
        """Write a title and a line below it, above the upper left corner of a drawing."""
        em = self.page.em
        left, top = self.point(*corner)
        self.page.text(text, left, top - 3.0 * em, em, INK)
        self.page.text(line, left, top - 1.6 * em, 0.85 * em, FAINT)

    def distance(self, start: float, end: float, text: str, bottom: float, row: int) -> None:
        """Draw a dimension line with arrows from `start` to `end`, in a row below the drawing, with text on or beside it."""
        em = self.page.em
        y = self.point(0.0, bottom)[1] + (1.1 + 1.6 * row) * em
        left, right = self.point(min(start, end))[0], self.point(max(start, end))[0]
        for x in (left, right):
            self.page.line([(x, self.point(0.0)[1]), (x, y + 0.4 * em)], FAINT, 0.03 * em, 0.25 * em)
        self.page.line([(left, y), (right, y)], INK, 0.06 * em)
        tip = min(0.5 * em, 0.45 * (right - left))
        for x, direction in ((left, 1), (right, -1)):
            self.page.area([(x, y), (x + direction * tip, y - 0.18 * em), (x + direction * tip, y + 0.18 * em)], INK)
        size = 0.85 * em
        if letters.width(text, size) + 2.5 * em < right - left:
            half_width = letters.width(text, size) / 2 + 0.3 * em
            center = (left + right) / 2
            self.page.area(box(center - half_width, y - 0.6 * em, 2 * half_width, 1.2 * em), "#ffffff")
            self.page.text(text, center, y + 0.3 * em, size, INK, "middle")
        else:
            self.page.text(text, right + 0.5 * em, y + 0.3 * em, size, INK)


class _ModuleSizes(NamedTuple):
    """Distances and sizes of a module, mm: b, l, detector side and thickness, ROI radius."""

    b: float
    l: float
    side: float
    thickness: float
    radius: float


class _ViewFan(NamedTuple):
    """Rays of a view: source and detector, mm along the principal ray from the pinhole, and half the detector's side."""

    source: float
    detector: float
    half: float

    @property
    def length(self) -> float:
        """Distance from source to detector, mm."""
        return self.detector - self.source


def _fan(views: Views, module: PinholeSystem) -> _ViewFan:
    """Return the rays of a module's only view."""
    source, detector = (
        float((point - module.centers[0]) @ module.principal_rays[0])
        for point in (views.sources[0], views.detector_centers[0])
    )
    return _ViewFan(source, detector, float(np.linalg.norm(views.u_steps[0])) * views.shape[1] / 2)


def draw(page: Page, subject: FigureSubject) -> None:
    """Draw the first of the chosen modules in a plane through its principal ray, as pinhole and as C-arm."""
    if not isinstance(subject.scanner, PinholeSystem):
        raise InputError("figure c-arm: expected a scanner with pinholes")
    module = subject.select_modules(subject.scanner)[:1]
    lengths = ("pinhole_distance", "collimator_length", "detector_side", "detector_thickness", "roi_radius")
    m = _ModuleSizes(*(float(getattr(module, name)[0]) for name in lengths))
    pinhole, c_arm = _fan(module.views(), module), _fan(c_arm_views(module), module)
    em = page.em
    title = f"Module {int(module.numbers[0])}: the true pinhole, and a virtual C-arm in its place"
    note = "DiffDRR, given the workbook's azimuth and elevation, has the C-arm at the module's mirror image in z"
    top = heading(page, title, ["To scale, in a plane through the principal ray", note])
    ranges = [
        (-m.l - m.thickness, max(pinhole.detector, m.b + m.radius)),
        (min(c_arm.source, 0.0), max(c_arm.detector, m.b + m.radius)),
    ]
    half = max(pinhole.half, c_arm.half, m.radius)
    extents = [(high - low, 2 * half) for low, high in ranges]
    room, margins = (em, float(top), page.width - 2 * em, page.height - top - em), np.array(_MARGINS) * em
    scale, corners = arrange(extents, tuple(margins), room, ((0, 1),), ((0,), (1,)))
    views = (pinhole, _draw_pinhole), (c_arm, _draw_c_arm)
    for (x, y), (low, _), (fan, draw_details) in zip(corners, ranges, views, strict=True):
        drawing = _AxialDrawing(page, scale, (x - low * scale, y + half * scale))
        _draw_fan(drawing, m, fan)
        draw_details(drawing, m, fan, (low, half))


def _draw_fan(drawing: _AxialDrawing, m: _ModuleSizes, fan: _ViewFan) -> None:
    """Draw the rays of a view, the ROI and the detector's plane."""
    drawing.area([(fan.source, 0.0), (fan.detector, fan.half), (fan.detector, -fan.half)], _FAN, 0.12)
    drawing.circle(m.b, m.radius, _ROI, 0.22)
    for end in (fan.half, -fan.half):
        drawing.line([(fan.source, 0.0), (fan.detector, end)], _FAN, 0.06)
    drawing.line([(fan.detector, fan.half), (fan.detector, -fan.half)], INK, 0.18)
    drawing.text(f" ROI, R = {number(m.radius)} mm", m.b + m.radius, 0.0, 1.4, "start")


def _draw_pinhole(drawing: _AxialDrawing, m: _ModuleSizes, fan: _ViewFan, corner: Point) -> None:
    """Draw the crystal, the pinhole and the distances b and l of the true pinhole."""
    half, back = corner[1], -m.l - m.thickness
    drawing.title(corner, "True pinhole", f"Field at the isocentre: {number(m.side * m.b / m.l)} mm")
    drawing.area([(-m.l, m.side / 2), (-m.l, -m.side / 2), (back, -m.side / 2), (back, m.side / 2)], _CRYSTAL)
    for end in (m.side / 2, -m.side / 2):
        drawing.line([(0.0, 0.0), (-m.l, end)], _METAL, 0.16)
    drawing.line([(-m.l, 0.0), (fan.detector, 0.0)], _FAN, 0.08)
    drawing.dot(0.0, 0.3, INK)
    drawing.dot(m.b, 0.22, _ROI)
    drawing.text("Crystal", (back - m.l) / 2, -m.side / 2, 1.2)
    drawing.text("Pinhole", 0.0, 0.0, -1.0)
    drawing.text(f"Virtual detector, {number(2 * fan.half)} mm", fan.detector, half, -0.5, "end")
    # From the lowest row up, since texts must hide the lines that lead to the rows below them.
    drawing.distance(0.0, fan.detector, f"{number(fan.length / m.l)} l = {number(fan.length)} mm", -half, 2)
    drawing.distance(0.0, m.b, f"b = {number(m.b)} mm", -half, 1)
    drawing.distance(-m.l, 0.0, f"l = {number(m.l)} mm", -half, 0)


def _draw_c_arm(drawing: _AxialDrawing, m: _ModuleSizes, fan: _ViewFan, corner: Point) -> None:
    """Draw the source, the fields of view and the distances of the virtual C-arm."""
    half, isocentre_distance, source = corner[1], m.b - fan.source, fan.source
    ratio, field = number(isocentre_distance / m.l), 2 * fan.half * isocentre_distance / fan.length
    text = f"Wide FOV at the isocentre: {number(field)} mm; FOV, its central half: {number(field / 2)} mm"
    drawing.title(corner, f"Virtual C-arm: source {ratio} l from the isocentre", text)
    for end in (fan.half / 2, -fan.half / 2):
        drawing.line([(source, 0.0), (fan.detector, end)], _FAN, 0.05, 0.4)
    drawing.line([(fan.detector, fan.half / 2), (fan.detector, -fan.half / 2)], _FAN, 0.3)
    drawing.line([(source, 0.0), (fan.detector, 0.0)], _FAN, 0.08)
    drawing.dot(source, 0.3, INK)
    drawing.dot(m.b, 0.22, _ROI)
    drawing.dot(0.0, 0.3, _METAL)
    drawing.text("Source ", source, 0.0, -0.5, "end")
    fan_half = max(0.0, -source) / fan.length * fan.half  # half the fan's width at the pinhole
    drawing.text("True pinhole", 0.0, fan_half, -1.4, "end")
    drawing.text(f"Detector, {number(2 * fan.half)} mm", fan.detector, half, -0.5, "end")
    side = "behind" if source < 0 else "in front of"
    drawing.distance(source, 0.0, f"source {number(abs(source))} mm {side} the pinhole", -half, 3)
    drawing.distance(source, fan.detector, f"{number(fan.length / m.l)} l = {number(fan.length)} mm", -half, 2)
    drawing.distance(0.0, m.b, f"b = {number(m.b)} mm", -half, 1)
    drawing.distance(source, m.b, f"{ratio} l = {number(isocentre_distance)} mm", -half, 0)
