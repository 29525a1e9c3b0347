"""Shapes painted one over the other: the mean over each voxel, the values at points, the integrals along lines.

Painting layer i changes what layers 0 to i - 1 have left only inside its shape. So a voxel's mean is the sum over the
layers of the mean of that change, and each layer can be sampled as finely as its own size asks.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..geometry.grid import Grid
from ..memory import require
from ..progress import Progress
from .sequences import r3_sequence
from .shapes import Shape

Points = NDArray[np.float64]
Floats = NDArray[np.float32]

# Points of one call of a shape's `distance`: small enough that its temporaries stay in the processor's cache.
_BLOCK = 1 << 15
_MIN_SAMPLES, _MAX_SAMPLES = 128, 1 << 13  # of a voxel that a surface cuts
_SEQUENCE = 1 << 16  # points of which voxels take stretches by turns, so that their errors differ and cancel
# Over what is not uniform, few voxels get more samples: about so many altogether.
_SAMPLES_OF_MIXED = 1 << 21
# In boxes of up to so many voxels a shape's samples are weighed so that they make up exactly what it changes.
_WEIGHED = 1 << 22
# Shapes whose smallest part is below a voxel, and that touch `_FEW` or fewer, are sampled in their own box.
_FEW = 1 << 11
_SAMPLES_OF_FEW = 1 << 10  # per voxel
_BOX_BLOCK = 1 << 13  # of them at a time
_SAMPLES_BENEATH = 1 << 18
_RAYS, _PARTS = 1 << 14, 256  # at a time; fewer rays where a shape has more parts


@dataclass(frozen=True, eq=False)
class Layer:
    """One shape of a painting.

    Attributes
    ----------
    shape : Shape
        What is painted.
    pose : array (4, 4)
        World-from-shape, mm.
    value : float
        What it holds.
    """

    shape: Shape
    pose: Points
    value: float

    @property
    def adds(self) -> bool:
        """Whether the value is added to what is beneath, and does not replace it."""
        return self.shape.mode == "add"

    @cached_property
    def from_world(self) -> Points:
        """Shape-from-world (4, 4)."""
        return np.linalg.inv(self.pose)

    @cached_property
    def volume(self) -> float:
        """mm^3 in the world."""
        return self.shape.volume * abs(float(np.linalg.det(self.pose[:3, :3])))

    def over(self, values: NDArray[Any]) -> NDArray[Any]:
        """What the shape makes of the values beneath it."""
        value = values.dtype.type(self.value)
        return values + value if self.adds else np.full_like(values, value)

    def relation(self, other: Layer) -> int:
        """1 where the shape surely covers all of the other's, -1 where they surely do not touch, 0 else."""
        from_other = self.from_world @ other.pose
        reach = other.shape.ball_radius * float(np.linalg.norm(from_other[:3, :3], 2))
        distance = float(self.shape.distance(from_other[:3, 3:])[0])
        return 1 if distance < -reach else -1 if distance > reach else 0


def _seen_beneath(layers: Sequence[Layer]) -> list[list[Layer]]:
    """For each layer, those below it that may show in its shape, if it replaces what is beneath it."""
    centers = np.array([layer.pose[:3, 3] for layer in layers]).reshape(-1, 3)
    radii = np.array([layer.shape.ball_radius * np.linalg.norm(layer.pose[:3, :3], 2) for layer in layers])
    result = []
    for i, layer in enumerate(layers):
        near = np.linalg.norm(centers[:i] - centers[i], axis=1) < radii[:i] + radii[i]
        seen: list[Layer] = []
        for j in np.flatnonzero(near).tolist() if not layer.adds else ():
            relation = layers[j].relation(layer)
            if relation == 1 and not layers[j].adds:
                seen = []
            if relation >= 0:
                seen.append(layers[j])
        result.append(seen)
    return result


def values_at(layers: Sequence[Layer], points: Points) -> Points:
    """What was painted at world `points` (3, N), mm: (N,)."""
    values = np.zeros(points.shape[1])
    for layer in layers:
        inside = layer.shape.distance(_moved(layer.from_world, points)) < 0
        values = np.where(inside, layer.over(values), values)
    return values


def integral(layers: Sequence[Layer], replaced: Sequence[float]) -> float:
    """Value times mm^3 of the whole painting; `replaced` as of `means_beneath`."""
    return sum(layer.volume * (layer.value - mean) for layer, mean in zip(layers, replaced, strict=True))


def means_beneath(layers: Sequence[Layer]) -> list[float]:
    """For each layer the mean of what its shape replaces, wherever the painting lies: exact where it is uniform.

    What two layers have in common is counted at points of the smaller: so errors are small beside the content of either,
    and of a layer that is covered whole nothing stays.
    """
    beneath = _seen_beneath(layers)
    over: dict[Layer, list[Layer]] = {layer: [] for layer in layers}
    means = {}
    for layer, seen in zip(layers, beneath, strict=True):
        for lower in seen:
            over[lower].append(layer)
        means[layer] = _mean_inside(
            layer, [_emptied(lower) if lower.volume < layer.volume else lower for lower in seen]
        )
    for lower, later in over.items():
        for layer, share in _shares_covered_by_larger(lower, later).items():
            means[layer] += share * lower.value * lower.volume / layer.volume
    return list(means.values())


def _emptied(layer: Layer) -> Layer:
    return replace(layer, value=0.0)


def _is_uniform(layer: Layer, beneath: Sequence[Layer]) -> bool:
    """Whether all that a layer's shape replaces surely has one value."""
    return not beneath or (len(beneath) == 1 and beneath[0].relation(layer) == 1)


def _mean_inside(layer: Layer, beneath: Sequence[Layer]) -> float:
    """The mean of what is painted beneath a layer's shape."""
    if not any(lower.value for lower in beneath):
        return 0.0
    if _is_uniform(layer, beneath):
        return beneath[0].value
    total, hits = 0.0, 0
    for inside in points_inside(layer):
        total += float(values_at(beneath, inside).sum())
        hits += inside.shape[1]
    return total / max(hits, 1)


def _shares_covered_by_larger(layer: Layer, over: Sequence[Layer]) -> dict[Layer, float]:
    """Of the layers over one, those larger than it, with the share of its shape that they are the first to cover."""
    larger = [other for other in over if other.volume > layer.volume]
    if not larger or not layer.value:
        return {}
    if larger[0] is over[0] and larger[0].relation(layer) == 1:
        return {larger[0]: 1.0}
    covered, hits = dict.fromkeys(over, 0), 0
    for free in points_inside(layer):
        hits += free.shape[1]
        for other in over:
            within = other.shape.distance(_moved(other.from_world, free)) < 0
            covered[other] += int(np.count_nonzero(within))
            free = free[:, ~within]
    return {other: covered[other] / max(hits, 1) for other in larger}


def points_inside(layer: Layer) -> Iterator[Points]:
    """Points of the world (3, n) that fill a layer's shape evenly, in blocks."""
    for first in range(0, _SAMPLES_BENEATH, _BOX_BLOCK):
        points = _box_points(layer.shape, first)
        yield _moved(layer.pose, points[:, layer.shape.distance(points) < 0])


def paint_voxels(
    grid: Grid, layers: Sequence[Layer], replaced: Sequence[float], progress: Progress | None = None
) -> Floats:
    """The mean of the painting over each voxel, float32 array of the grid's shape.

    Voxels farther from a surface than their own half diagonal are all in or all out; the others are sampled at the
    points of a low-discrepancy sequence, which weigh so much that what the shape changes comes out. The points of a
    shape that is small beside the voxels fill the shape instead.

    Parameters
    ----------
    grid
        Where the voxels are.
    layers
        From bottom to top.
    replaced
        As of `means_beneath`.
    progress
        Called as ``progress(done, total)``.
    """
    require(4.2 * grid.n_voxels, "a volume of {} x {} x {} voxels".format(*grid.shape))
    image = np.zeros(grid.shape, np.float32)
    strokes = [
        _Stroke(grid, layer, beneath, layer.value - mean)
        for layer, beneath, mean in zip(layers, _seen_beneath(layers), replaced, strict=True)
    ]
    total, done = sum(stroke.steps for stroke in strokes), 0
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for stroke in strokes:
            for _ in stroke.paint(image, pool):
                done += 1
                if progress is not None:
                    try:
                        progress(done, total)
                    except BaseException:
                        pool.shutdown(wait=False, cancel_futures=True)
                        raise
    # What is painted with different samples may miss by a little what it shall replace.
    values = [layer.value for layer in layers]
    if min(values, default=0.0) >= 0:
        highest = None if any(layer.adds for layer in layers) else max(values, default=0.0)
        np.clip(image, 0.0, highest, out=image)
    return image


def line_integrals(layers: Sequence[Layer], starts: Points, ends: Points) -> Points:
    """Integrals (N,) of the painting, value x mm, along the lines from `starts` to `ends`, (N, 3) world mm: exact."""
    result = np.empty(len(starts))
    step = max(1, _RAYS * _PARTS // max(_PARTS, *(layer.shape.n_parts for layer in layers), 1))
    for first in range(0, len(starts), step):
        block = slice(first, first + step)
        result[block] = _integrals_of_block(layers, starts[block].T, ends[block].T)
    return result


def _integrals_of_block(layers: Sequence[Layer], starts: Points, ends: Points) -> Points:
    """Of lines (3, N). Each line's pieces between the surfaces that it crosses are painted in the layers' order."""
    directions = ends - starts
    rays, enters, leaves, values, adds = [], [], [], [], []
    for layer in layers:
        linear = layer.from_world[:3, :3]
        enter, leave = layer.shape.intervals(_moved(layer.from_world, starts), linear @ directions)
        enter, leave = np.maximum(enter, 0.0).T, np.minimum(leave, 1.0).T
        ray, part = np.nonzero(enter < leave)
        rays.append(ray)
        enters.append(enter[ray, part])
        leaves.append(leave[ray, part])
        values.append(np.full(len(ray), layer.value))
        adds.append(np.full(len(ray), layer.adds))
    if not rays:
        return np.zeros(starts.shape[1])
    ray, enter, leave = np.concatenate(rays), np.concatenate(enters), np.concatenate(leaves)
    value, add = np.concatenate(values), np.concatenate(adds)
    order = np.argsort(ray, kind="stable")  # keeps the layers' order in each ray
    ray, enter, leave, value, add = ray[order], enter[order], leave[order], value[order], add[order]
    counts = np.bincount(ray, minlength=starts.shape[1])
    firsts = np.cumsum(counts) - counts
    integrals = np.zeros(starts.shape[1])
    # Lines of about as many parts together, padded with empty ones.
    for most in np.unique(_next_power_of_2(counts[counts > 0])):
        some = np.flatnonzero(_next_power_of_2(counts) == most)
        number = np.arange(most)
        there = number < counts[some, None]
        index = np.where(there, firsts[some, None] + number, 0)
        low, high = np.where(there, enter[index], 0.0), np.where(there, leave[index], 0.0)
        edges = np.sort(np.concatenate([low, high], axis=1), axis=1)
        middles = (edges[:, :-1] + edges[:, 1:]) / 2
        painted = np.zeros_like(middles)
        for k in range(most):
            inside = (low[:, k, None] < middles) & (middles < high[:, k, None])
            paint = np.where(add[index[:, k], None], painted, 0.0) + value[index[:, k], None]
            painted = np.where(inside, paint, painted)
        integrals[some] = np.einsum("rs,rs->r", painted, np.diff(edges, axis=1))
    return integrals * np.sqrt(np.einsum("in,in->n", directions, directions))


def _next_power_of_2(counts: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.where(counts > 0, 1 << np.ceil(np.log2(np.maximum(counts, 1))).astype(np.int64), 0)


class _Stroke:
    """What painting a layer over those beneath it does to an image."""

    def __init__(self, grid: Grid, layer: Layer, beneath: Sequence[Layer], mean_change: float) -> None:
        self.grid, self.layer, self.beneath, self.mean_change = grid, layer, beneath, mean_change
        shape_from_index = self.layer.from_world @ grid.affine
        shape = self.layer.shape
        low, high = _index_box(shape_from_index, shape)
        # Clipped as floats: a far-away box must not overflow the integers.
        self.start = np.clip(np.floor(low + 0.5), 0, grid.shape).astype(np.int64)
        self.stop = np.clip(np.floor(high + 0.5) + 1, self.start, grid.shape).astype(np.int64)
        self.voxel_volume = abs(float(np.linalg.det(shape_from_index[:3, :3])))
        self.edge = float(np.linalg.norm(shape_from_index[:3, :3], axis=0).max())
        self.touched = float(np.prod(2 * np.array(shape.half_box) / self.edge + 1))
        self.is_small = shape.finest < self.edge and self.touched < _FEW
        inside = bool(np.all(low >= -0.5) and np.all(high <= np.array(grid.shape) - 0.5))
        # Whether it matters which part of the shape a voxel holds.
        self.is_mixed = not _is_uniform(layer, beneath)
        self.is_weighed = inside and bool(np.prod(self.stop - self.start) <= _WEIGHED)

    @property
    def steps(self) -> int:
        """How many times `paint` yields."""
        if np.any(self.stop <= self.start):
            return 0
        return self._n_blocks if self.is_small else int(self.stop[0] - self.start[0])

    def paint(self, image: Floats, pool: ThreadPoolExecutor) -> Iterator[None]:
        """Change `image`, step by step."""
        if not self.steps:
            return iter(())
        return self._paint_small(image, pool) if self.is_small else self._paint_voxels(image, pool)

    @property
    def _n_blocks(self) -> int:
        """Of points of a small shape."""
        points = _SAMPLES_OF_FEW * max(self.touched, 8.0)
        if self.is_mixed:
            points = max(points, min(8 * points, _SAMPLES_OF_MIXED))
        return math.ceil(points / _BOX_BLOCK)

    def _paint_small(self, image: Floats, pool: ThreadPoolExecutor) -> Iterator[None]:
        """Points of the shape, each weighing an equal share of its volume, into the voxels that they fall in."""
        box = tuple(map(slice, self.start, self.stop))
        total, hits = np.zeros(image[box].shape), 0
        index_from_shape = np.linalg.inv(self.grid.affine) @ self.layer.pose

        def sample(block: int) -> tuple[NDArray[np.int64], Points]:
            points = _box_points(self.layer.shape, block * _BOX_BLOCK)
            inside = points[:, self.layer.shape.distance(points) < 0]
            change = self.layer.value - values_at(self.beneath, _moved(self.layer.pose, inside))
            return np.rint(_moved(index_from_shape, inside)).astype(np.int64), change

        for index, change in pool.map(sample, range(self._n_blocks)):
            hits += len(change)
            index -= self.start[:, None]
            held = np.all((index >= 0) & (index < np.array(total.shape)[:, None]), axis=0)
            np.add.at(total, tuple(index[:, held]), change[held])
            yield
        image[box] += total * (self.layer.shape.volume / self.voxel_volume / max(hits, 1))

    def _paint_voxels(self, image: Floats, pool: ThreadPoolExecutor) -> Iterator[None]:
        """Points of the voxels that the shape's surface cuts, slab by slab."""
        rows, columns = map(slice, self.start[1:], self.stop[1:])
        iy, iz = np.mgrid[rows, columns]
        n_samples = self._n_samples
        stretches = max(1, _SEQUENCE // n_samples)
        offsets = (r3_sequence(stretches * n_samples) - 0.5).reshape(3, stretches, n_samples)
        own, *lower = (_Sampled(layer, self.grid, offsets) for layer in (self.layer, *self.beneath))

        def fill(ix: int) -> tuple[float, NDArray[np.int64], Floats, Floats]:
            slab = image[ix, rows, columns]
            values = slab.ravel()
            index = np.stack([np.full(iy.size, ix), iy.ravel(), iz.ravel()])
            parts, of_whole = [], 0.0
            for first in range(0, len(values), _BLOCK):
                block = slice(first, first + _BLOCK)
                whole, cut, coverage, change = _changes(index[:, block], own, lower)
                painted = np.where(whole, own.layer.over(values[block]), values[block])
                of_whole += float(np.sum(painted - values[block], dtype=np.float64))
                values[block] = painted
                parts.append((first + cut, coverage, change))
            cut, coverage, change = map(np.concatenate, zip(*parts, strict=True))
            if not self.is_weighed:
                values[cut] += change
            slab[...] = values.reshape(slab.shape)
            return of_whole, cut, coverage, change

        kept, missing, unsure = [], self.mean_change * self.layer.shape.volume / self.voxel_volume, 0.0
        for ix, (whole, cut, coverage, change) in enumerate(
            pool.map(fill, range(self.start[0], self.stop[0])), self.start[0]
        ):
            if self.is_weighed:
                kept.append((ix, cut, coverage, change))
                missing -= whole + float(change.sum(dtype=np.float64))
                unsure += float(np.sum(np.abs(change) * (1 - coverage), dtype=np.float64))
            yield
        # What is missing goes to where the shares c are unsure, as c (1 - c): they stay between 0 and 1.
        weight = np.float32(missing / unsure if unsure else 0.0)
        for ix, cut, coverage, change in kept:
            factor = 1 + weight * np.sign(change) * (1 - coverage)
            factor = np.clip(factor, 0, 1 / np.maximum(coverage, np.float32(1e-6)))
            image[ix, iy.ravel()[cut], iz.ravel()[cut]] += change * factor

    @property
    def _n_samples(self) -> int:
        shape = self.layer.shape
        for_each = 4 * _MIN_SAMPLES * self.edge / shape.finest
        if self.is_mixed:
            for_each = max(for_each, _SAMPLES_OF_MIXED / self.touched)
        # Where samples are not weighed: the error of a cut voxel is about n^(-2/3) / 2 of its volume h^3. With a surface
        # below 6 V / s, s being the smallest part, some 9 V / (s h^2) voxels are cut, whose errors add up at random: so
        # many samples keep their sum below 1/5000 of V.
        for_sum = 0.0 if self.is_weighed else (7500 * self.edge**2 / np.sqrt(shape.finest * shape.volume)) ** 1.5
        return int(np.clip(max(for_sum, for_each), _MIN_SAMPLES, _MAX_SAMPLES))


class _Sampled:
    """A layer's shape, asked about voxels and about points in them."""

    def __init__(self, layer: Layer, grid: Grid, offsets: Points) -> None:
        """Of points at `offsets` (3, stretches, n), in voxels, from the voxels' centres."""
        shape_from_index = layer.from_world @ grid.affine
        self.layer = layer
        self._linear, self._origin = shape_from_index[:3, :3], shape_from_index[:3, 3:]
        self.n_samples = offsets.shape[2]
        self._offsets = np.tensordot(self._linear, offsets, 1).astype(np.float32)
        # A voxel's farthest corner from its centre, over the four diagonals of a parallelepiped.
        signs = np.array([[1, 1, 1], [1, 1, -1], [1, -1, 1], [-1, 1, 1]])
        self._half_diagonal = 0.5 * np.linalg.norm(signs @ self._linear.T, axis=1).max() * (1 + 1e-5)

    def sort(self, index: NDArray[np.int64]) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
        """Which voxels (3, n) are inside, (n,), and the numbers of those that the surface may cut."""
        distance = self.layer.shape.distance(self._centers(index))
        return distance < -self._half_diagonal, np.flatnonzero(np.abs(distance) <= self._half_diagonal)

    def inside(self, index: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which points of voxels (3, n) are inside, (n, samples)."""
        # Along each axis the voxels go through all stretches, whose number these primes seldom divide.
        stretch = (np.array([1, 53, 211]) @ index) % self._offsets.shape[1]
        points = self._centers(index)[:, :, None] + self._offsets[:, stretch]
        return (self.layer.shape.distance(points.reshape(3, -1)) < 0).reshape(points.shape[1:])

    def _centers(self, index: NDArray[np.int64]) -> Floats:
        return (self._linear @ index + self._origin).astype(np.float32)


def _changes(
    index: NDArray[np.int64], own: _Sampled, lower: Sequence[_Sampled]
) -> tuple[NDArray[np.bool_], NDArray[np.int64], Floats, Floats]:
    """What painting one layer more does to voxels (3, n).

    Which of them are inside, (n,); the numbers of those that the surface cuts, and of these the share that is inside
    and by how much the mean changes.
    """
    whole, cut = own.sort(index)
    coverage, change = np.empty(len(cut), np.float32), np.empty(len(cut), np.float32)
    step = max(1, _BLOCK // own.n_samples)
    for first in range(0, len(cut), step):
        some = slice(first, first + step)
        at = index[:, cut[some]]
        inside = own.inside(at)
        beneath = np.zeros(inside.shape, np.float32)
        for layer in lower:
            filled, crossed = layer.sort(at)
            beneath[filled] = layer.layer.over(beneath[filled])
            if len(crossed):
                within = layer.inside(at[:, crossed])
                beneath[crossed] = np.where(within, layer.layer.over(beneath[crossed]), beneath[crossed])
        coverage[some] = inside.mean(axis=1)
        change[some] = np.where(inside, np.float32(own.layer.value) - beneath, 0).mean(axis=1)
    return whole, cut, coverage, change


def _box_points(shape: Shape, first: int) -> Points:
    """A block of points (3, n), from number `first` on, that fill the box around a shape, in its frame."""
    return (r3_sequence(_BOX_BLOCK, first) - 0.5) * (2 * np.array(shape.half_box)[:, None])


def _moved(pose: Points, points: Points) -> Points:
    """`points` (3, N) by a pose (4, 4)."""
    return pose[:3, :3] @ points + pose[:3, 3:]


def _index_box(shape_from_index: Points, shape: Shape) -> tuple[Points, Points]:
    """Lowest and highest index (3,) of any of a shape's points, or beyond."""
    index_from_shape = np.linalg.inv(shape_from_index)
    linear, middle = index_from_shape[:3, :3], index_from_shape[:3, 3]
    of_box = np.abs(linear) @ np.array(shape.half_box)
    of_ball = np.linalg.norm(linear, axis=1) * shape.ball_radius
    reach = np.minimum(of_box, of_ball)
    return middle - reach, middle + reach
