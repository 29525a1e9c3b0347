"""Table of the kinds of figures, from which command line and Blender take their choices.

A new kind is a line in `KINDS`: a drawn one has a function of a page and a subject, a rendered one has a `Studio`, which
`addon.figures.stage` builds.
"""

import math
from collections.abc import Callable
from typing import Literal, NamedTuple

from ..errors import InputError
from ..validation import one_of
from . import mosaics, sums, virtual_c_arm
from .page import DARK, SUFFIXES, Page
from .subject import FigureSubject

PAPERS = {"dark": DARK, "light": "#ffffff"}
"""Paper colours of rendered figures, by their style."""


FILMS = (".mp4",)
SAMPLES = 16
"""Rays per pixel of rendered figures; the remaining noise is smoothed."""


class Rendering(NamedTuple):
    """Settings of rendered figures."""

    labels: bool = True
    samples: int = SAMPLES
    style: str = "dark"  # a key of `PAPERS`
    seconds: float = 8.0  # duration of an animation
    fps: int = 24  # pictures of an animation per second

    @property
    def frames(self) -> int:
        """Number of pictures of an animation."""
        return max(1, round(self.seconds * self.fps))


class Studio(NamedTuple):
    """Contents of a rendered figure besides the scanner's modules, and its camera."""

    volume: bool = False  # whether the volume is shown
    rays: bool = False  # whether the modules' principal rays are shown
    cut: bool = False  # whether the modules between the isocentre and the viewer fade
    near: float = 0.0  # distance from the isocentre to the picture's edge, ROI radii; 0: the whole scanner fits
    lens: float = 50.0  # focal length, mm, for a film 36 mm wide; a short one shows near objects large
    lit: bool = False  # whether only the chosen modules are lit and have rays, while the others stay visible


class FigureKind(NamedTuple):
    """A kind of figure: its names, its needs, and how it is drawn or rendered."""

    name: str  # name on the command line
    label: str  # name in menus
    summary: str  # one line of help
    needs: tuple[str, ...]  # names among `subject.NEEDS`
    size: tuple[int, int]  # default width and height, pixels
    draw: Callable[[Page, FigureSubject], None] | None = None  # function that draws a flat figure
    studio: Studio | None = None  # contents and camera of a figure that Blender renders
    one_module: bool = False  # whether it shows only the first of the chosen modules
    motion: Literal["turn", "light"] | None = None  # course of an animation: once around, or module by module

    @property
    def suffixes(self) -> tuple[str, ...]:
        """File endings of its formats."""
        return FILMS if self.motion else SUFFIXES

    def page(self, size: tuple[int, int] | None, options: Rendering) -> Page:
        """Return an empty page for a figure of this kind; `size` is width and height, pixels, None for the default.

        Raises `InputError` for an animation with odd sides, no duration or no pictures.
        """
        page = Page(*(size or self.size), PAPERS["light" if self.studio is None else options.style])
        if self.motion and (page.width % 2 or page.height % 2):
            raise InputError(f"size {page.width}x{page.height}: both must be even for an animation")
        if not (0 < options.seconds < math.inf and options.fps > 0):
            raise InputError(f"{options.seconds:g} s of {options.fps} pictures each: expected more than 0 for both")
        return page


_PICTURE = Studio(volume=True, rays=True, cut=True, near=1.25, lens=30.0, lit=True)
KINDS = {
    kind.name: kind
    for kind in (
        FigureKind("scanner", "Scanner", "the scanner's modules, or some of them alone, in place", ("scanner",),
                   (1600, 1000), studio=Studio()),
        FigureKind("cut-away", "Cut-Away with Rays",
                   "a volume and the principal rays, the modules in front of it cut away", ("scanner", "volume"),
                   (1600, 1000), studio=Studio(volume=True, rays=True, cut=True)),
        FigureKind("inside", "Volume in the Scanner", "a volume seen from near by, between the modules",
                   ("scanner", "volume"), (1600, 1000), studio=Studio(volume=True, near=1.7)),
        FigureKind("picture", "Picture",
                   "a volume with its scale and colour bar, and the rays of chosen modules or of a ring",
                   ("scanner", "volume"), (2400, 1500), studio=_PICTURE),
        FigureKind("turntable", "Turntable", "the picture, once around: an animation", ("scanner", "volume"),
                   (1280, 800), studio=_PICTURE._replace(near=1.7), motion="turn"),
        FigureKind("light-up", "Modules Light Up", "the picture, one module after the other with its ray: an animation",
                   ("scanner", "volume"), (1280, 800), studio=_PICTURE._replace(near=2.2), motion="light"),
        FigureKind("sums", "Orthogonal Sums",
                   "a volume's sums along x, y and z, value x mm, with its translation T and rotation R", ("volume",),
                   (1600, 680), sums.draw),
        FigureKind("mosaic", "Mosaic, FOV", "all projections ring by ring, the central half of each image", ("run",),
                   (1800, 480), mosaics.draw_fov),
        FigureKind("mosaic-wide", "Mosaic, Wide FOV", "all projections ring by ring, whole images", ("run",),
                   (1800, 480), mosaics.draw_wide_fov),
        FigureKind("c-arm", "Virtual C-Arm",
                   "a module's distances, as the true pinhole and as a C-arm with its source 5 l away", ("scanner",),
                   (1600, 800), virtual_c_arm.draw, one_module=True),
    )
}  # fmt: skip


def figure_kind(name: str) -> FigureKind:
    """Return the kind of this name; raise `InputError` if there is none."""
    one_of(name, KINDS, "figure")
    return KINDS[name]
