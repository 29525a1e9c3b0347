"""The rays of images, and what of them a backend is given at once."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..arrays import ArrayOrTensor, Floats, cast_like, is_tensor
from ..geometry.grid import Grid
from .lattices import Lattices
from .ray_geometry import Attenuation, Ends, Fan, Rays, index_fans, index_rays

KEPT_BYTES = 2**27
"""What a projector keeps of its rays and their weights from call to call takes at most this much memory."""


@dataclass(frozen=True, eq=False)
class Beam:
    """Rays for every pixel of an image, as many as its fan has shifts, whose weighted integrals add up."""

    rays: Fan  # from the rays' source to the pixels: n_v rows of n_u rays
    # weights of the integrals: of slices of rows, columns and shifts, an array (shifts, rows, columns), with 1 row or
    # column where all are the same. None: 1 everywhere.
    weigh: Callable[[slice, slice, slice], Floats] | None = None

    def transposed(self) -> Beam:
        """The same rays with rows and columns exchanged."""
        weigh, rays = self.weigh, self.rays.transposed()
        if weigh is None:
            return Beam(rays)
        return Beam(rays, lambda rows, columns, shifts: np.swapaxes(weigh(columns, rows, shifts), -1, -2))


@dataclass(frozen=True, eq=False)
class Bundle:
    """All rays of one image."""

    beams: tuple[Beam, ...] = ()  # of one shape, unless there are `ends`
    ends: Ends | None = None  # rays from point to point, of which the image (N, 1) has a value each
    transposed: bool = False  # whether rows of rays are columns of the image

    @classmethod
    def along(cls, grid: Grid, *beams: Beam) -> Bundle:
        """The bundle of `beams` whose rows follow the voxels' contiguous axis as well as they can."""
        across = beams[0].rays.lies_across(grid)
        return cls(tuple(beam.transposed() for beam in beams) if across else beams, transposed=across)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of rays."""
        return self.beams[0].rays.shape if self.ends is None else self.ends.shape

    @property
    def kind(self) -> tuple[bool, float]:
        """What images whose rays make one part have in common: their orientation, and how far sources move."""
        return self.transposed, self.beams[0].rays.parallel if self.ends is None else 0.0

    @property
    def rays_of_a_pixel(self) -> int:
        """How many rays each pixel has."""
        return sum(len(beam.rays.shifts) for beam in self.beams) if self.ends is None else 1

    def n_rays(self, block: tuple[slice, slice] | None = None) -> int:
        """How many rays there are, or how many of them in some rows and columns."""
        rows, columns = self.shape if block is None else (which.stop - which.start for which in block)
        return rows * columns * self.rays_of_a_pixel


@dataclass(frozen=True, eq=False)
class Part:
    """Rays that a backend is given in one call."""

    # numbers of the images to which the fans belong, and how many fans of each follow one another
    images: list[tuple[int, int]]
    rays: Floats | Ends  # (F, 4, 3), the fans' vectors (`Fan.vectors`); or rays from point to point
    rows: slice  # the part of an image that each fan covers, of the transposed image if `transposed`
    columns: slice
    transposed: bool = False
    # (F, rows, columns), weights of the integrals, with 1 row or column where all are the same; None: 1 everywhere
    weights: Floats | None = None
    parallel: float = 0.0  # that of `Fan`; fans of one part are all alike in this

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of every fan."""
        return self.rows.stop - self.rows.start, self.columns.stop - self.columns.start

    def in_index_space(self, lattices: Lattices) -> tuple[Rays, Attenuation | None]:
        """The rays as a backend takes them, and what attenuates them."""
        if isinstance(self.rays, Ends):
            return lattices.mapped(index_rays, self.rays.starts, self.rays.ends)
        return lattices.mapped(index_fans, self.rays, self.shape, self.parallel)

    def pixels(self, image: ArrayOrTensor) -> ArrayOrTensor:
        """The part of an image that the rays belong to, (rows, columns), as a view."""
        return (image.T if self.transposed else image)[self.rows, self.columns]

    def add_to(self, images: ArrayOrTensor, first: int, integrals: ArrayOrTensor) -> None:
        """Add the rays' weighted integrals to `images`, whose first has the number `first`."""
        integrals = integrals.reshape(-1, *self.shape)
        if self.weights is not None:
            integrals = cast_like(self.weights, integrals) * integrals
        start = 0
        for number, n in self.images:
            pixels, own = self.pixels(images[number - first]), integrals[start : start + n]
            if is_tensor(pixels):
                pixels += own.sum(0)
            else:  # one by one: the rounding does not depend on how many fans a part has, and so on the threads
                for fan in own:
                    pixels += fan
            start += n

    def values(self, images: ArrayOrTensor) -> ArrayOrTensor:
        """What the rays carry back from `images`: weights times pixels, (rays,)."""
        numbers = [number for number, n in self.images for _ in range(n)]
        if len(self.images) == 1:
            pixels = self.pixels(images[numbers[0]])[None]
        else:
            pixels = (images.swapaxes(1, 2) if self.transposed else images)[numbers][:, self.rows, self.columns]
        if self.weights is not None:
            pixels = cast_like(self.weights, pixels) * pixels
        elif len(pixels) < len(numbers):
            pixels = cast_like(np.ones((len(numbers), 1, 1)), pixels) * pixels
        return pixels.reshape(-1)


class Bundles:
    """The rays of several images of one shape; made when they are asked for and kept while there is room.

    Parameters
    ----------
    n : int
        How many images.
    make : function
        Takes an image's number and returns its `Bundle`.
    """

    def __init__(self, n: int, make: Callable[[int], Bundle]) -> None:
        self._n = n
        self._make = make
        self._bundles: dict[int, Bundle] = {}
        self._parts: dict[tuple[Any, ...], list[Part]] = {}
        self._room = KEPT_BYTES

    def __len__(self) -> int:
        return self._n

    @property
    def image_shape(self) -> tuple[int, int]:
        """Rows and columns of an image."""
        if not self._n:
            return 0, 0
        return self[0].shape[::-1] if self[0].transposed else self[0].shape

    def __getitem__(self, number: int) -> Bundle:
        """The rays of an image."""
        if number not in self._bundles:
            bundle = self._make(number)
            if not self._has_room(256 * bundle.rays_of_a_pixel):
                return bundle
            self._bundles[number] = bundle
        return self._bundles[number]

    def __getstate__(self) -> dict[str, Any]:  # what is kept holds functions that cannot be pickled
        return self.__dict__ | {"_bundles": {}, "_parts": {}, "_room": KEPT_BYTES}

    def parts(self, images: range, block: tuple[slice, slice] | None, most: int) -> Iterable[Part]:
        """All rays of several images, or those of a block of one: at most `most` in a part unless a fan alone has more."""
        bounds = () if block is None else tuple((some.start, some.stop) for some in block)
        key = images.start, images.stop, bounds, most
        if key not in self._parts:
            bundles = [(number, self[number]) for number in images]
            parts = self._made_parts(bundles, block, most)
            kept = sum(8 * bundle.n_rays(block) for _, bundle in bundles if bundle.ends is None)
            if not kept or not self._has_room(kept):
                return parts
            self._parts[key] = list(parts)
        return self._parts[key]

    @staticmethod
    def _made_parts(bundles: list[tuple[int, Bundle]], block: tuple[slice, slice] | None, most: int) -> Iterator[Part]:
        for kind in sorted({bundle.kind for _, bundle in bundles}):
            some = [(number, bundle) for number, bundle in bundles if bundle.kind == kind]
            rows, columns = block or map(slice, some[0][1].shape)
            yield from _parts(some, slice(rows.start or 0, rows.stop), slice(columns.start or 0, columns.stop), most)

    def _has_room(self, n_bytes: int) -> bool:
        """Whether so many bytes may be kept; if so, they are counted."""
        if n_bytes > self._room:
            return False
        self._room -= n_bytes
        return True


def _parts(bundles: list[tuple[int, Bundle]], rows: slice, columns: slice, most: int) -> Iterator[Part]:
    """Some rows and columns of bundles of one orientation, at most `most` rays in a part unless a fan alone has more."""
    pixels = (rows.stop - rows.start) * (columns.stop - columns.start)
    if not pixels:
        return
    if bundles[0][1].ends is not None:
        number, bundle = bundles[0]
        ends: Any = bundle.ends
        yield Part([(number, 1)], Ends(ends.starts[rows], ends.ends[rows]), rows, columns)
        return
    fans_at_once = max(1, most // pixels)
    pieces: list[tuple[int, Beam, slice]] = []
    n = 0
    for number, bundle in bundles:
        for beam in bundle.beams:
            first, last = 0, len(beam.rays.shifts)
            while first < last:
                end = min(last, first + fans_at_once - n)
                pieces.append((number, beam, slice(first, end)))
                n += end - first
                first = end
                if n == fans_at_once:
                    yield _part(pieces, rows, columns, bundle.transposed)
                    pieces, n = [], 0
    if pieces:
        yield _part(pieces, rows, columns, bundles[0][1].transposed)


def _part(pieces: list[tuple[int, Beam, slice]], rows: slice, columns: slice, transposed: bool) -> Part:
    """The part of some shifts of some beams."""
    images: list[tuple[int, int]] = []
    for number, _, shifts in pieces:
        n = shifts.stop - shifts.start
        if images and images[-1][0] == number:
            n += images.pop()[1]
        images.append((number, n))
    vectors = np.concatenate([beam.rays.part(rows, columns, shifts).vectors() for _, beam, shifts in pieces])
    weights = None
    if any(beam.weigh for _, beam, _ in pieces):
        shape, each = (rows.stop - rows.start, columns.stop - columns.start), []
        for _, beam, shifts in pieces:
            own = np.ones(1) if beam.weigh is None else beam.weigh(rows, columns, shifts)
            each.append(np.broadcast_to(own, (shifts.stop - shifts.start, *shape)))
        weights = each[0] if len(each) == 1 else np.concatenate(each)
    return Part(images, vectors, rows, columns, transposed, weights, pieces[0][1].rays.parallel)
