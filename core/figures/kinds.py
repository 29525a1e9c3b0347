"""The kinds of figures, one line each; command line and Blender follow from this table.

A new kind is a line here: one that is drawn has a function of a page and a subject, one that is rendered says what is put
into the studio (`addon.figures.figures`).
"""

import math
from collections.abc import Callable
from typing import Literal, NamedTuple

from ..errors import InputError
from ..validation import one_of
from . import mosaics, sums, virtual_c_arm
from .page import DARK, SUFFIXES, Page
from .subject import Subject

PAPERS = {"dark": DARK, "light": "#ffffff"}
"""What rendered figures lie on, by their style."""


FILMS = (".mp4",)
SAMPLES = 16
"""Rays per pixel; what noise they leave is smoothed."""


class How(NamedTuple):
    """How figures are rendered."""

    labels: bool = True
    samples: int = SAMPLES
    style: str = "dark"  # of `PAPERS`
    seconds: float = 8.0  # of an animation
    fps: int = 24  # its pictures in a second

    @property
    def frames(self) -> int:
        """The number of an animation's pictures."""
        return max(1, round(self.seconds * self.fps))


class Studio(NamedTuple):
    """What a rendered figure shows besides the scanner's modules."""

    volume: bool = False
    rays: bool = False  # the modules' principal rays
    cut: bool = False  # the modules between the isocentre and the viewer fade
    near: float = 0.0  # ROI radii from the isocentre to the picture's edge; 0: the whole scanner fits
    lens: float = 50.0  # mm, of a camera whose film is 36 mm wide: a short one shows what is near large
    lit: bool = False  # the chosen modules are lit and have rays, and the others stay


class FigureKind(NamedTuple):
    """One kind of figure."""

    name: str  # on the command line
    label: str  # in menus
    summary: str  # one line of help
    needs: tuple[str, ...]  # of `subject.NEEDS`
    size: tuple[int, int]  # width and height, pixels, where none is given
    draw: Callable[[Page, Subject], None] | None = None
    studio: Studio | None = None  # of a figure that Blender renders
    one_module: bool = False  # it shows the first of the chosen modules
    motion: Literal["turn", "light"] | None = None  # of an animation

    @property
    def suffixes(self) -> tuple[str, ...]:
        """How the names of its files end."""
        return FILMS if self.motion else SUFFIXES

    def page(self, size: tuple[int, int] | None, how: How) -> Page:
        """A page for it; only rendered figures have a style. Raises InputError of what no animation can be."""
        page = Page(*(size or self.size), PAPERS["light" if self.studio is None else how.style])
        if self.motion and (page.width % 2 or page.height % 2):
            raise InputError(f"size {page.width}x{page.height}: of an animation both must be even")
        if not (0 < how.seconds < math.inf and how.fps > 0):
            raise InputError(f"{how.seconds:g} s of {how.fps} pictures each: expected more than 0 of both")
        return page


_PICTURE = Studio(volume=True, rays=True, cut=True, near=1.25, lens=30.0, lit=True)
KINDS = {
    kind.name: kind
    for kind in (
        FigureKind(
            "scanner", "Scanner", "the scanner's modules, or some of them alone, in place", ("scanner",), (1600, 1000),
            studio=Studio(),
        ),
        FigureKind(
            "cut-away", "Cut-Away with Rays", "a volume and the principal rays, the modules in front of it cut away",
            ("scanner", "volume"), (1600, 1000), studio=Studio(volume=True, rays=True, cut=True),
        ),
        FigureKind(
            "inside", "Volume in the Scanner", "a volume seen from near by, between the modules", ("scanner", "volume"),
            (1600, 1000), studio=Studio(volume=True, near=1.7),
        ),
        FigureKind(
            "picture", "Picture", "a volume with its scale and colour bar, and the rays of chosen modules or of a ring",
            ("scanner", "volume"), (2400, 1500), studio=_PICTURE,
        ),
        FigureKind(
            "turntable", "Turntable", "the picture, once around: an animation", ("scanner", "volume"), (1280, 800),
            studio=_PICTURE._replace(near=1.7), motion="turn",
        ),
        FigureKind(
            "light-up", "Modules Light Up", "the picture, one module after the other with its ray: an animation",
            ("scanner", "volume"), (1280, 800), studio=_PICTURE._replace(near=2.2), motion="light",
        ),
        FigureKind(
            "sums", "Orthogonal Sums", "a volume's sums along x, y and z, value x mm, with its translation T and rotation R",
            ("volume",), (1600, 680), sums.draw,
        ),
        FigureKind(
            "mosaic", "Mosaic, FOV", "all projections ring by ring, the central half of each image", ("run",), (1800, 480),
            mosaics.draw_fov,
        ),
        FigureKind(
            "mosaic-wide", "Mosaic, Wide FOV", "all projections ring by ring, whole images", ("run",), (1800, 480),
            mosaics.draw_wide_fov,
        ),
        FigureKind(
            "c-arm", "Virtual C-Arm", "a module's distances, as the true pinhole and as a C-arm with its source 5 l away",
            ("scanner",), (1600, 800), virtual_c_arm.draw, one_module=True,
        ),
    )
}  # fmt: skip


def figure_kind(name: str) -> FigureKind:
    """The kind of that name."""
    one_of(name, KINDS, "figure")
    return KINDS[name]
