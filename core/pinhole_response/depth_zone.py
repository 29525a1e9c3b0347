"""A view's response to voxels in a zone of depth, and its derivatives by the view's numbers.

What is counted in whole numbers (planes, cells, parts of a voxel) and where the planes lie is the zone's lattice, which
small changes of the view leave as it is: the response is a smooth function of the numbers.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..physics.crystal import share_inside
from .depth_response import DepthResponse, Index
from .oblique_kernels import NodesGradient, Passage, Slanted, node_kernels, node_places, slanted
from .pixel_kernels import KernelNumbers, kernels, kernels_gradient

# Steps of central differences, relative: their errors are 1e-9 or less of what is differentiated so.
_STEP = 1e-5


class ViewNumbers(NamedTuple):
    """What a view's response depends on, besides the photons' law; derivatives by them have the same fields."""

    to_camera: Array
    """(3, 4): of a voxel's indices (x, y, z, 1), to where it is along the module's u, v and k from the pinhole, mm."""
    length: float
    """From the hole's plane to the image's, mm: the collimator's, and the mean depth in the crystal."""
    diameter: float
    """The hole's, mm, effective."""
    first: Array
    """(2,): the first pixel's place on the crystal, mm along v and u, point-inverted."""
    pitch: Array
    """(2,): from pixel to pixel there."""

    @classmethod
    def zero(cls) -> Self:
        """Nothing."""
        return cls(np.zeros((3, 4)), 0.0, 0.0, np.zeros(2), np.zeros(2))

    def plus(self, other: Self) -> Self:
        """The sums, number by number."""
        return type(self)(*(a + b for a, b in zip(self, other, strict=True)))  # type: ignore[operator]


class Sums(NamedTuple):
    """Derivatives of a sum over the pixels by what a part's response consists of."""

    matrix: Array
    """(3, 4): by `DepthResponse.matrix`, also through the line,"""
    line: Array
    """(3,): and by `DepthResponse.line`."""
    before: Array
    """(rows, columns): by the logarithm of `DepthResponse.before`,"""
    after: Array
    """(n_v, n_u): and of `after`."""
    kernel: Array
    """(planes, [nodes,] taps, taps): by `DepthResponse.kernel`."""


@dataclass(frozen=True, eq=False)
class Zone:
    """The response to a zone of depth."""

    numbers: ViewNumbers
    pixels: tuple[int, int]
    weigh: Callable[[Array, Array], Array]
    """What a mm^2 of the crystal counts, times l^2, along lines to these places (v, u) on the crystal, mm. It goes with the
    square of the hole's diameter, with 1 / l^2, and else depends on the lines' slopes alone."""
    side: float
    """That of the square on the crystal in which pixels count, mm."""
    volume: float
    """A voxel's, mm^3."""
    counts: NDArray[np.intp]
    """(3,): pieces along a voxel's edges."""
    near: float
    far: float
    inverses: Array
    """1 / h of the planes, 1 / mm, evenly."""
    steps: tuple[int, int]
    """Cells of a pixel, along v and u."""
    limits: tuple[float, float, float]
    """Those of `DepthResponse`: of_point, of_pair, parts_per_cell."""
    share: float
    """A photon's direction, on which its counts depend, lies between that of the voxel and that of the pixel as seen from
    the hole's middle, so much of the way: the factors of either are powers that are 1 together."""
    passage: Passage | None = None
    """What makes kernels depend on the direction,"""
    apart: int = 1
    """and pixels from node to node where they do."""

    @property
    def _sizes(self) -> Array:
        """The cells', mm along v and u."""
        return self.numbers.pitch / self.steps

    @property
    def _edges(self) -> Array:
        """A piece's edges as columns, mm along u, v and k."""
        return self.numbers.to_camera[:, :3] / self.counts

    @functools.cached_property
    def _across(self) -> Array:
        """What remains of the edges beside the line on which a piece lies by its depth, mm along v and u, (2, 3)."""
        edges = self._edges
        return (edges - np.outer(edges @ edges[2] / (edges[2] @ edges[2]), edges[2]))[1::-1]

    @property
    def _bend(self) -> float:
        return 1.5 * self.share * (1 - self.share)

    @property
    def kernel_numbers(self) -> KernelNumbers:
        """Those of the kernels of pixels."""
        n, sizes = self.numbers, self._sizes
        bend = self._bend * (sizes / n.length) ** 2
        return KernelNumbers(n.diameter / np.abs(sizes), n.length * self.inverses, self._across / sizes[:, None], bend)

    def _second(self, d: float, l: float, blur: float) -> Array:
        """What is missing of each plane, (planes,), `blur` being the sum of the squares of the edges across, mm^2.

        In all, a voxel counts (1 + t^2)^(-3/2) / h^2, t being its slope. The mean of this over the hole, and to second order
        that over the voxel, differ from what the powers make of it, by this share times (1 + t^2)^-2.
        """
        share, inverses = self.share, self.inverses
        holes = (np.arange(16)[:, None] + 0.5) / 16 * (d / 2) ** 2  # squared distances from its middle, of equal areas
        shadow = holes * (1 / l + inverses) ** 2
        made = np.average((1 + shadow) ** (-1.5 * share), 0, 1 + self._bend * shadow)
        of_voxel = -(1 - share) / 8 * blur * inverses**2
        return np.asarray(((1 + holes * inverses**2) ** -1.5).mean(axis=0) / made - 1 + of_voxel)

    def _second_numbers(self) -> Array:
        return np.array([self.numbers.diameter, self.numbers.length, np.square(self._across).sum()])

    def _places(self, first: list[int], counts: tuple[int, ...], step: Array) -> tuple[Array, Array]:
        """Places on the crystal of rows (n, 1) and columns (n,), from numbers `first` on, mm."""
        v, u = (self.numbers.first[i] + step[i] * (first[i] + np.arange(float(counts[i]))) for i in range(2))
        return v[:, None], u

    def response(self, kind: type) -> DepthResponse:
        """The response, with numbers of this kind."""
        n, second = self.numbers, self._second(*self._second_numbers())
        kernel = self._kernels()
        kernel *= (1 + second - second.mean()).reshape(-1, *[1] * (kernel.ndim - 1))
        margin, sizes = self._margin(kernel), self._sizes
        matrix = n.to_camera.copy()
        for row, i in ((0, 1), (1, 0)):  # columns follow u, rows v
            matrix[row] = n.length / sizes[i] * n.to_camera[row] + (margin[i] - n.first[i] / sizes[i]) * n.to_camera[2]
        n_cells = [self.steps[i] * (self.pixels[i] - 1 - (-kernel.shape[i - 2] - i) // self.steps[i]) for i in range(2)]
        v, u = self._places([-each for each in margin], tuple(n_cells), sizes)
        secant = 1 + (v**2 + u**2) / n.length**2
        before = self.volume / self.counts.prod() * n.length**2 * self.weigh(v, u) ** (1 - self.share)
        before *= 1 + second.mean() / secant**2
        v, u = self._places([0, 0], self.pixels, n.pitch)
        after = self.weigh(v, u) ** self.share * np.outer(*self._inside())
        depth = self._edges[2]
        along = depth / self.counts / np.linalg.norm(depth)
        pieces = (np.indices(tuple(self.counts)).reshape(3, -1).T + 0.5) / self.counts - 0.5
        apart = (len(self.inverses) - 1) / (self.inverses[-1] - self.inverses[0])
        rows = [(0, 0)] * (kernel.ndim - 2) + [(self.steps[0],) * 2, (0, 0)]
        padded: Array = np.pad(kernel.astype(kind), rows)
        zone = self.near, self.far, float(self.inverses[0]), float(apart)
        places = None
        if self.passage is not None:
            places = np.arange(self.pixels[0]) / self.apart, np.arange(self.pixels[1]) / self.apart
        return DepthResponse(
            matrix, pieces, along, *self.limits, *zone, before.astype(kind), padded, self.steps, after, places
        )

    def _kernels(self) -> Array:
        """Those of the pixels, or of the nodes."""
        if self.passage is None:
            return kernels(self.kernel_numbers, self.steps)
        each, shape = self._nodes(self.passage)
        return node_kernels(self.kernel_numbers, self.steps, each, shape)

    def _nodes(self, passage: Passage) -> tuple[list[Slanted], tuple[int, int]]:
        """What the kernels of nodes are made of, row by row, and how many there are along v and u."""
        n = self.numbers
        v, u = (n.first[i] + n.pitch[i] * node_places(self.pixels[i], self.apart) for i in range(2))
        common = passage, n.diameter, n.length, self._sizes
        more = self.share, np.array(self.steps), self.apart
        return [slanted(*common, np.array([a, b]), *more) for a in v for b in u], (len(v), len(u))

    @staticmethod
    def _margin(kernel: Array) -> tuple[int, int]:
        return kernel.shape[-2] // 2, kernel.shape[-1] // 2

    def _inside(self, first: float = 0.0, pitch: float = 0.0) -> list[Array]:
        """Shares of the rows and columns that are within `side`, all moved and made larger, mm."""
        n = self.numbers
        return [
            share_inside(n.first[i] + first + (n.pitch[i] + pitch) * np.arange(m), abs(n.pitch[i] + pitch), self.side)
            for i, m in enumerate(self.pixels)
        ]

    def gradient(self, of: DepthResponse, pixels: tuple[slice, slice], origin: Index, sums: Sums) -> ViewNumbers:
        """Derivatives of a sum over the pixels by the numbers, from those by a part's response.

        `of`, `pixels` and `origin` are those of the part, as `DepthResponse.of_part` gives and takes them.
        """
        kernel, by_kernel, by_second, by_nodes = self._kernel_sums(of, sums.kernel)
        margin = self._margin(kernel)
        firsts = [each.start or 0 for each in pixels]
        starts = [self.steps[i] * firsts[i] - margin[i] for i in range(2)]
        by, by_sizes = self._by_matrix(of, origin, starts, sums)
        by_places, by_mean, sizes = self._by_before(starts, sums.before)
        by, by_sizes = by.plus(by_places), by_sizes + sizes
        by = by.plus(self._by_after(pixels, firsts, sums.after))
        by_second += by_mean / len(by_second) - by_second.mean()
        by_shape, sizes = self._by_shape(by_kernel, by_second)
        by = by.plus(by_nodes)
        return by.plus(by_shape)._replace(pitch=by.pitch + by_shape.pitch + (by_sizes + sizes) / self.steps)

    def _kernel_sums(self, of: DepthResponse, by_part: Array) -> tuple[Array, KernelNumbers, Array, ViewNumbers]:
        """The kernels; derivatives by their numbers; by `_second` less its mean; and by the view's numbers, of nodes."""
        first = round((of.first_plane - self.inverses[0]) * of.planes_per_inverse)
        by = np.zeros((len(self.inverses), *by_part.shape[1:]))
        by[first : first + len(by_part)] = by_part
        second = self._second(*self._second_numbers())
        factors = (1 + second - second.mean()).reshape(-1, *[1] * (by.ndim - 1))
        if self.passage is None:
            kernel, by_numbers = kernels_gradient(self.kernel_numbers, self.steps, by * factors)
            return kernel, by_numbers, (by * kernel).sum(axis=(1, 2)), ViewNumbers.zero()
        kernel, none = self._kernels(), KernelNumbers(*(0 * each for each in self.kernel_numbers))
        return kernel, none, (by * kernel).sum(axis=(1, 2, 3, 4)), self._by_nodes(self.passage, by * factors)

    def _by_nodes(self, passage: Passage, by: Array) -> ViewNumbers:
        """Derivatives through the nodes' kernels by the view's numbers, from those by the kernels."""
        n = self.numbers
        form = NodesGradient(self.kernel_numbers, self.steps, *self._nodes(passage), by)

        def difference(name: str, at: Index, scale: float) -> float:
            values = []
            for sign in (1, -1):
                step = np.zeros_like(getattr(n, name))
                step[at] = sign * _STEP * scale
                zone = replace(self, numbers=n.plus(ViewNumbers.zero()._replace(**{name: step})))
                if name == "to_camera":
                    values.append(form.of_edges(zone.kernel_numbers))
                else:
                    each = zone._nodes(passage.of_hole(zone.numbers.diameter))
                    values.append(form(zone.kernel_numbers, *each))
            return (values[0] - values[1]) / (2 * _STEP * scale)

        edge, result = float(np.abs(n.to_camera[:, :3]).max()), ViewNumbers.zero()
        for at in np.ndindex(3, 3):
            result.to_camera[at] = difference("to_camera", at, edge)
        for i in range(2):
            result.first[i] = difference("first", (i,), n.length)
            result.pitch[i] = difference("pitch", (i,), abs(n.pitch[i]))
        length, diameter = (difference(name, (), getattr(n, name)) for name in ("length", "diameter"))
        return result._replace(length=length, diameter=diameter)

    def _by_matrix(self, of: DepthResponse, origin: Index, starts: list[int], sums: Sums) -> tuple[ViewNumbers, Array]:
        """Derivatives through the voxels' places, and by the cells' sizes."""
        n, sizes, by_sizes = self.numbers, self._sizes, np.zeros(2)
        by = ViewNumbers.zero()
        of_part = n.to_camera.copy()
        of_part[:, 3] += of_part[:, :3] @ origin
        by.to_camera[2] += sums.matrix[2]
        length = 0.0
        for row, i in ((0, 1), (1, 0)):
            own = sums.matrix[row]
            across, deep = own @ of_part[row], own @ of_part[2]
            by.to_camera[row] += n.length / sizes[i] * own
            by.to_camera[2] += (-starts[i] - n.first[i] / sizes[i]) * own
            length += across / sizes[i]
            by.first[i] -= deep / sizes[i]
            by_sizes[i] += (n.first[i] * deep - n.length * across) / sizes[i] ** 2
        by.to_camera[:, :3] += np.outer(by.to_camera[:, 3], origin)
        depth, by_depth = self._edges[2], sums.line @ of.matrix[:, :3] / self.counts
        by_depth = (by_depth - depth * (depth @ by_depth) / (depth @ depth)) / np.linalg.norm(depth)
        by.to_camera[2, :3] += by_depth / self.counts
        return by._replace(length=length), by_sizes

    def _by_before(self, starts: list[int], by: Array) -> tuple[ViewNumbers, float, Array]:
        """Derivatives through what cells count; by the mean of `_second`; and by the cells' sizes."""
        n, mean = self.numbers, self._second(*self._second_numbers()).mean()
        v, u = self._places(starts, by.shape, self._sizes)
        slope = (v**2 + u**2) / n.length**2
        secant = (1 + slope) ** 2 + mean
        rise = (1 - self.share) * self._rise(v, u) - 4 * mean * slope / (1 + slope) / secant
        moved, sizes = self._by_places(v, u, by * rise, starts)
        length = (by * (2 * self.share - rise)).sum() / n.length
        diameter = 2 * (1 - self.share) * by.sum() / n.diameter
        return ViewNumbers.zero()._replace(length=length, diameter=diameter, first=moved), (by / secant).sum(), sizes

    def _by_after(self, pixels: tuple[slice, slice], starts: list[int], by: Array) -> ViewNumbers:
        """Derivatives through the pixels' factors."""
        n = self.numbers
        v, u = self._places(starts, by.shape, n.pitch)
        rise = self.share * self._rise(v, u)
        first, pitch = self._by_places(v, u, by * rise, starts)
        if np.isfinite(self.side):
            for i, (own, part) in enumerate(zip(self._inside(), pixels, strict=True)):
                total = np.divide(by.sum(axis=1 - i), own[part], out=np.zeros(by.shape[i]), where=own[part] > 0)
                step = _STEP * abs(n.pitch[i])
                for result, change in ((first, (step, 0.0)), (pitch, (0.0, step))):
                    more, less = self._inside(*change)[i], self._inside(-change[0], -change[1])[i]
                    result[i] += total @ (more - less)[part] / (2 * step)
        length = (by * (-2 * self.share - rise)).sum() / n.length
        diameter = 2 * self.share * by.sum() / n.diameter
        return ViewNumbers.zero()._replace(length=length, diameter=diameter, first=first, pitch=pitch)

    def _rise(self, v: Array, u: Array) -> Array:
        """The logarithmic derivative of `weigh` by the distance from the crystal's middle."""
        more, less = (self.weigh(scale * v, scale * u) for scale in (1 + _STEP, 1 - _STEP))
        return np.divide(more - less, (more + less) * _STEP, out=np.zeros_like(more), where=(more > 0) & (less > 0))

    @staticmethod
    def _by_places(v: Array, u: Array, by: Array, starts: list[int]) -> tuple[Array, Array]:
        """Derivatives by the first place and the step, (2,) each, from those by the logarithm of the distance."""
        squared = v**2 + u**2
        by = np.divide(by, squared, out=np.zeros_like(by), where=squared > 0)
        each = (by * v).sum(axis=1), (by * u).sum(axis=0)
        steps = [own @ (start + np.arange(len(own))) for own, start in zip(each, starts, strict=True)]
        return np.array([own.sum() for own in each]), np.array(steps)

    def _by_shape(self, by: KernelNumbers, by_second: Array) -> tuple[ViewNumbers, Array]:
        """Derivatives through the kernels' shapes and `_second`; and by the cells' sizes."""
        n, sizes, numbers = self.numbers, self._sizes, self.kernel_numbers
        own = self._second_numbers()
        by_own = np.empty(3)
        for i, step in enumerate(_STEP * np.eye(3) * own):
            by_own[i] = by_second @ (self._second(*(own + step)) - self._second(*(own - step))) / (2 * step[i])
        diameter = by_own[0] + (by.hole / np.abs(sizes)).sum()
        length = by_own[1] + by.slopes @ self.inverses - 2 / n.length * (by.bend @ numbers.bend)
        of_edges = (by.edges * numbers.edges).sum(axis=1)
        by_sizes = (2 * by.bend * numbers.bend - by.hole * numbers.hole - of_edges) / sizes
        across = by.edges / sizes[:, None] + 2 * by_own[2] * self._across
        edges, result = self._edges, ViewNumbers.zero()
        depth, squared = edges[2], edges[2] @ edges[2]
        for row, given in ((0, across[1]), (1, across[0])):
            along, on = edges[row] @ depth / squared, given @ depth / squared
            result.to_camera[row, :3] += (given - on * depth) / self.counts
            result.to_camera[2, :3] += (2 * along * on * depth - along * given - on * edges[row]) / self.counts
        return result._replace(diameter=diameter, length=length), by_sizes
