"""Rays of images (bundles), and the batches of them that a backend traces in one call."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..arrays import ArrayOrTensor, Floats, cast_like, is_tensor
from ..geometry.grid import Grid
from .lattices import Lattices
from .ray_geometry import Attenuation, Ends, Fan, Rays, index_fans, index_rays

STORED_BYTES = 2**27
"""Largest memory of the rays and weights that a projector stores from call to call."""


@dataclass(frozen=True, eq=False)
class Beam:
    """Rays for every pixel of an image, one for each shift of a fan, whose weighted integrals add up."""

    rays: Fan
    """Fan of the rays from their source to the pixels: n_v rows of n_u rays."""
    weights: Callable[[slice, slice, slice], Floats] | None = None
    """Function of slices of rows, columns and shifts that returns the weights (shifts, rows, columns); None: 1 everywhere.

    The array may have 1 row or column where all weights along it are the same."""

    def transposed(self) -> Beam:
        """Return the same rays with rows and columns exchanged."""
        weights, rays = self.weights, self.rays.transposed()
        if weights is None:
            return Beam(rays)
        return Beam(rays, lambda rows, columns, shifts: np.swapaxes(weights(columns, rows, shifts), -1, -2))


@dataclass(frozen=True, eq=False)
class RayBundle:
    """All rays of one image."""

    beams: tuple[Beam, ...] = ()
    """Beams of one shape; none with `ends`."""
    ends: Ends | None = None
    """Rays from point to point, each with a value in the image (N, 1)."""
    transposed: bool = False
    """Whether rows of rays are columns of the image."""

    @classmethod
    def along(cls, grid: Grid, *beams: Beam) -> RayBundle:
        """Return the bundle of `beams`, transposed if columns follow the voxels' contiguous axis better than rows."""
        transposed = beams[0].rays.lies_across(grid)
        return cls(tuple(beam.transposed() for beam in beams) if transposed else beams, transposed=transposed)

    @property
    def shape(self) -> tuple[int, int]:
        """Number of rows and columns of rays."""
        return self.beams[0].rays.shape if self.ends is None else self.ends.shape

    @property
    def kind(self) -> tuple[bool, float]:
        """Orientation, and `Fan.parallel`: images whose rays are traced in one batch agree in both."""
        return self.transposed, self.beams[0].rays.parallel if self.ends is None else 0.0

    @property
    def rays_of_a_pixel(self) -> int:
        """Number of rays of each pixel."""
        return sum(len(beam.rays.shifts) for beam in self.beams) if self.ends is None else 1

    def n_rays(self, block: tuple[slice, slice] | None = None) -> int:
        """Return the number of rays, or of those in a block of rows and columns."""
        rows, columns = self.shape if block is None else (part.stop - part.start for part in block)
        return rows * columns * self.rays_of_a_pixel


@dataclass(frozen=True, eq=False)
class Batch:
    """Rays that a backend traces in one call."""

    images: list[tuple[int, int]]
    """Numbers of the images to which the fans belong, in order, with the number of fans of each."""
    rays: Floats | Ends
    """(F, 4, 3), vectors of the fans (`Fan.vectors`), or rays from point to point."""
    rows: slice
    """Rows of the image that each fan covers, of the transposed image if `transposed`."""
    columns: slice
    """Columns of the image that each fan covers, of the transposed image if `transposed`."""
    transposed: bool = False
    """Whether rows of rays are columns of the image."""
    weights: Floats | None = None
    """(F, rows, columns), weights of the integrals, with 1 row or column where all are the same; None: 1 everywhere."""
    parallel: float = 0.0
    """`Fan.parallel` of all fans."""

    @property
    def shape(self) -> tuple[int, int]:
        """Number of rows and columns of every fan."""
        return self.rows.stop - self.rows.start, self.columns.stop - self.columns.start

    def in_index_space(self, lattices: Lattices) -> tuple[Rays, Attenuation | None]:
        """Return the rays in index space, as a backend takes them, and their attenuation."""
        if isinstance(self.rays, Ends):
            return lattices.mapped(index_rays, self.rays.starts, self.rays.ends)
        return lattices.mapped(index_fans, self.rays, self.shape, self.parallel)

    def pixels(self, image: ArrayOrTensor) -> ArrayOrTensor:
        """Return the part of an image that the rays belong to, (rows, columns), as a view of its memory."""
        return (image.T if self.transposed else image)[self.rows, self.columns]

    def add_to(self, images: ArrayOrTensor, first: int, integrals: ArrayOrTensor) -> None:
        """Add the rays' weighted integrals to `images`, the first of which has the number `first`."""
        integrals = integrals.reshape(-1, *self.shape)
        if self.weights is not None:
            integrals = cast_like(self.weights, integrals) * integrals
        start = 0
        for number, n in self.images:
            pixels, of_image = self.pixels(images[number - first]), integrals[start : start + n]
            if is_tensor(pixels):
                pixels += of_image.sum(0)
            else:  # one by one, so that the rounding does not depend on the number of fans of a batch, and so on the threads
                for fan in of_image:
                    pixels += fan
            start += n

    def values(self, images: ArrayOrTensor) -> ArrayOrTensor:
        """Return the values (rays,) that the rays back-project of `images`: weights times pixels."""
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
    """Rays of several images of one shape, made when they are needed and stored while there is room.

    Parameters
    ----------
    n : int
        Number of images.
    make : function
        Function of an image's number that returns its `RayBundle`.
    """

    def __init__(self, n: int, make: Callable[[int], RayBundle]) -> None:
        self._n, self._make = n, make
        self._bundles: dict[int, RayBundle] = {}
        self._batches: dict[tuple[Any, ...], list[Batch]] = {}
        self._free_bytes = STORED_BYTES

    def __len__(self) -> int:
        return self._n

    @property
    def image_shape(self) -> tuple[int, int]:
        """Number of rows and columns of an image."""
        if not self._n:
            return 0, 0
        return self[0].shape[::-1] if self[0].transposed else self[0].shape

    def __getitem__(self, number: int) -> RayBundle:
        """Return the rays of an image."""
        if number not in self._bundles:
            bundle = self._make(number)
            if not self._has_room(256 * bundle.rays_of_a_pixel):
                return bundle
            self._bundles[number] = bundle
        return self._bundles[number]

    def __getstate__(self) -> dict[str, Any]:  # stored bundles hold functions that cannot be pickled
        return self.__dict__ | {"_bundles": {}, "_batches": {}, "_free_bytes": STORED_BYTES}

    def batches(self, images: range, block: tuple[slice, slice] | None, limit: int) -> Iterable[Batch]:
        """Return all rays of several images, or of a block of one image, in batches.

        A batch has at most `limit` rays, unless a fan alone has more.
        """
        bounds = () if block is None else tuple((part.start, part.stop) for part in block)
        key = images.start, images.stop, bounds, limit
        if key not in self._batches:
            bundles = [(number, self[number]) for number in images]
            batches = _in_batches(bundles, block, limit)
            n_bytes = sum(8 * bundle.n_rays(block) for _, bundle in bundles if bundle.ends is None)
            if not n_bytes or not self._has_room(n_bytes):
                return batches
            self._batches[key] = list(batches)
        return self._batches[key]

    def _has_room(self, n_bytes: int) -> bool:
        """Return whether so many bytes can be stored, and reserve them."""
        if n_bytes > self._free_bytes:
            return False
        self._free_bytes -= n_bytes
        return True


def _in_batches(bundles: list[tuple[int, RayBundle]], block: tuple[slice, slice] | None, limit: int) -> Iterator[Batch]:
    """Yield the batches of numbered bundles, kind by kind."""
    for kind in sorted({bundle.kind for _, bundle in bundles}):
        alike = [(number, bundle) for number, bundle in bundles if bundle.kind == kind]
        rows, columns = block or map(slice, alike[0][1].shape)
        yield from _batches(alike, slice(rows.start or 0, rows.stop), slice(columns.start or 0, columns.stop), limit)


def _batches(bundles: list[tuple[int, RayBundle]], rows: slice, columns: slice, limit: int) -> Iterator[Batch]:
    """Yield the batches of some rows and columns of bundles of one kind, of at most `limit` rays unless a fan has more."""
    pixels = (rows.stop - rows.start) * (columns.stop - columns.start)
    if not pixels:
        return
    if bundles[0][1].ends is not None:
        number, bundle = bundles[0]
        ends: Any = bundle.ends
        yield Batch([(number, 1)], Ends(ends.starts[rows], ends.ends[rows]), rows, columns)
        return
    fans_at_once = max(1, limit // pixels)
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
                    yield _batch(pieces, rows, columns, bundle.transposed)
                    pieces, n = [], 0
    if pieces:
        yield _batch(pieces, rows, columns, bundles[0][1].transposed)


def _batch(pieces: list[tuple[int, Beam, slice]], rows: slice, columns: slice, transposed: bool) -> Batch:
    """Return the batch of pieces of beams: each the number of an image, a beam and a slice of its shifts."""
    images: list[tuple[int, int]] = []
    for number, _, shifts in pieces:
        n = shifts.stop - shifts.start
        if images and images[-1][0] == number:
            n += images.pop()[1]
        images.append((number, n))
    vectors = np.concatenate([beam.rays.part(rows, columns, shifts).vectors() for _, beam, shifts in pieces])
    weights = None
    if any(beam.weights for _, beam, _ in pieces):
        shape, arrays = (rows.stop - rows.start, columns.stop - columns.start), []
        for _, beam, shifts in pieces:
            array = np.ones(1) if beam.weights is None else beam.weights(rows, columns, shifts)
            arrays.append(np.broadcast_to(array, (shifts.stop - shifts.start, *shape)))
        weights = arrays[0] if len(arrays) == 1 else np.concatenate(arrays)
    return Batch(images, vectors, rows, columns, transposed, weights, pieces[0][1].rays.parallel)
