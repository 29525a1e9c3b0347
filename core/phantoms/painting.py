"""Shapes painted one over the other: the mean over each voxel, the values at points, the integrals along lines.

Each shape changes what the shapes before it left only inside itself. A voxel's mean is therefore the sum, over the
shapes, of the mean of that change, and each shape is sampled as finely as its own size asks.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..geometry.grid import Grid
from ..memory import require
from ..progress import Progress
from .shapes import Shape

Points = NDArray[np.float64]
Floats = NDArray[np.float32]

# Points of one call of a shape's `distance`: few enough that its temporaries stay in the processor's cache.
_BLOCK = 1 << 15
_MIN_SAMPLES, _MAX_SAMPLES = 128, 1 << 13  # of a voxel that a surface cuts
_SEQUENCE = 1 << 16  # points that voxels take their samples from, each another stretch, so that their errors cancel
# Over several values beneath, few voxels get more samples: about so many altogether.
_SAMPLES_OF_MIXED = 1 << 21
# A shape with parts smaller than a voxel that touches at most `_FEW` voxels is sampled in its own box.
_FEW = 1 << 11
_SAMPLES_OF_FEW = 1 << 10  # per voxel
_BOX_BLOCK = 1 << 13  # points at a time
_SAMPLES_OF_OVERLAP = 1 << 18
_RAYS, _PARTS = 1 << 14, 256  # at a time; fewer rays where a shape has more parts


@dataclass(frozen=True, eq=False)
class Layer:
    """One shape of a painting, its world-from-shape `pose` (4, 4), mm, and the `value` it holds."""

    shape: Shape
    pose: Points
    value: float

    @property
    def adds(self) -> bool:
        """Whether the value is added to what is beneath instead of replacing it."""
        return self.shape.mode == "add"

    @cached_property
    def from_world(self) -> Points:
        """Shape-from-world (4, 4)."""
        return np.linalg.inv(self.pose)

    @cached_property
    def volume(self) -> float:
        """mm^3 in the world."""
        return self.shape.volume * abs(float(np.linalg.det(self.pose[:3, :3])))

    def contains(self, points: Points) -> NDArray[np.bool_]:
        """Which of the world `points` (3, N), mm, lie inside."""
        return self.shape.distance(_moved(self.from_world, points)) < 0

    def over(self, values: NDArray[Any]) -> NDArray[Any]:
        """The values after painting this layer over `values`."""
        value = values.dtype.type(self.value)
        return values + value if self.adds else np.full_like(values, value)

    def relation(self, other: Layer) -> int:
        """1 if the shape certainly contains the other's, -1 if they certainly do not touch, 0 otherwise."""
        from_other = self.from_world @ other.pose
        radius = other.shape.ball_radius * float(np.linalg.norm(from_other[:3, :3], 2))
        distance = float(self.shape.distance(from_other[:3, 3:])[0])
        return 1 if distance < -radius else -1 if distance > radius else 0


def values_at(layers: Sequence[Layer], points: Points) -> Points:
    """The painting's values (N,) at world `points` (3, N), mm."""
    values = np.zeros(points.shape[1])
    for layer in layers:
        values = np.where(layer.contains(points), layer.over(values), values)
    return values


def points_inside(layer: Layer) -> Iterator[Points]:
    """World points (3, n) that fill a layer's shape evenly, block by block."""
    for first in range(0, _SAMPLES_OF_OVERLAP, _BOX_BLOCK):
        yield _moved(layer.pose, _shape_points(layer.shape, first))


def mean_changes(layers: Sequence[Layer]) -> list[float]:
    """By how much painting each layer changes, on average over its shape, what the layers beneath it left there.

    The overlap of two layers is counted at points of the smaller one. Errors are therefore small beside the content of
    either, and nothing remains of a layer that is covered completely.
    """
    changes = [layer.value for layer in layers]
    for number, layer in enumerate(layers):
        for other, share in _overlaps(layers, number).items():
            upper, lower = max(number, other), min(number, other)
            changes[upper] -= share * layer.volume * layers[lower].value / layers[upper].volume
    return changes


def _overlaps(layers: Sequence[Layer], number: int) -> dict[int, float]:
    """Shares of one layer's volume: for each larger layer above, what it is the first to cover; for each larger layer
    beneath, what this layer covers of it as the first.
    """
    layer = layers[number]
    relations = {k: other.relation(layer) for k, other in enumerate(layers) if k != number}
    above = [k for k, relation in relations.items() if k > number and relation >= 0 and not layers[k].adds]
    beneath = [k for k, relation in relations.items() if k < number and relation >= 0 and not layer.adds][::-1]
    larger = [k for k in (*above, *beneath) if (layers[k].volume, k) > (layer.volume, number)]
    counted = {k: 0 for k in larger if layers[min(k, number)].value}
    if not counted:
        return {}
    sampled = any(relations[k] == 0 for k in (*above, *beneath))
    hits = 0
    for points in points_inside(layer):
        hits += points.shape[1]
        for order in (above, beneath):
            free = points
            for k in order:
                inside = np.ones(free.shape[1], bool) if relations[k] else layers[k].contains(free)
                if k in counted:
                    counted[k] += int(np.count_nonzero(inside))
                if not layers[k].adds:
                    free = free[:, ~inside]
        if hits and not sampled:  # any points tell
            break
    return {k: count / max(hits, 1) for k, count in counted.items()}


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


def paint_voxels(
    grid: Grid, layers: Sequence[Layer], changes: Sequence[float], progress: Progress | None = None
) -> Floats:
    """The mean of the painting over each voxel, float32 array of the grid's shape.

    A voxel farther from a surface than its own half diagonal lies inside or outside as a whole. Of the others, the share
    that a shape covers is counted at points of a low-discrepancy sequence; the shares are then corrected so that the total
    change is the known one. For a shape that is small beside the voxels, the points fill the shape instead.

    `layers` run from bottom to top; `changes` are those of `mean_changes`; `progress` is called with (done, total).
    """
    require(5.0 * grid.n_voxels, "a volume of {} x {} x {} voxels".format(*grid.shape))
    image = np.zeros(grid.shape, np.float32)
    strokes = [_Stroke(grid, *each) for each in zip(layers, _seen_beneath(layers), changes, strict=True)]
    total, done = sum(stroke.steps for stroke in strokes), 0
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for stroke in strokes:
            for _ in stroke.paint(image, pool):
                done += 1
                if progress is not None:
                    progress(done, total)
    # Where layers were sampled at different points, one may replace a little more than there was.
    values = [layer.value for layer in layers]
    if min(values, default=0.0) >= 0:
        highest = None if any(layer.adds for layer in layers) else max(values, default=0.0)
        np.clip(image, 0.0, highest, out=image)
    return image


class _Stroke:
    """Painting one layer over those beneath it."""

    def __init__(self, grid: Grid, layer: Layer, beneath: Sequence[Layer], mean_change: float) -> None:
        self.grid, self.layer, self.beneath, self.mean_change = grid, layer, beneath, mean_change
        shape, shape_from_index = layer.shape, layer.from_world @ grid.affine
        # Bounds of the indices of the shape's points: the tighter of its box and its ball.
        index_from_shape = np.linalg.inv(shape_from_index)
        linear, middle = index_from_shape[:3, :3], index_from_shape[:3, 3]
        of_box = np.abs(linear) @ np.array(shape.half_box)
        half = np.minimum(of_box, np.linalg.norm(linear, axis=1) * shape.ball_radius)
        low, high = middle - half, middle + half
        # Clipped as floats: a far-away box must not overflow the integers.
        self.start = np.clip(np.floor(low + 0.5), 0, grid.shape).astype(np.int64)
        self.stop = np.clip(np.floor(high + 0.5) + 1, self.start, grid.shape).astype(np.int64)
        self.in_grid = bool(np.all(low >= -0.5) and np.all(high <= np.array(grid.shape) - 0.5))
        self.in_voxels = shape.volume / abs(float(np.linalg.det(shape_from_index[:3, :3])))  # the shape's volume
        edge = float(np.linalg.norm(shape_from_index[:3, :3], axis=0).max())
        touched = float(np.prod(2 * np.array(shape.half_box) / edge + 1))
        self.is_small = shape.finest < edge and touched < _FEW
        # What the shape covers is mixed unless one layer surely lies beneath all of it.
        is_mixed = len(beneath) > 1 or (len(beneath) == 1 and beneath[0].relation(layer) != 1)
        if self.is_small:
            points = _SAMPLES_OF_FEW * max(touched, 8.0)
            if is_mixed:
                points = max(points, min(8 * points, _SAMPLES_OF_MIXED))
            self.n_blocks = int(np.ceil(points / _BOX_BLOCK))
        else:
            samples = 4 * _MIN_SAMPLES * edge / shape.finest
            if is_mixed:
                samples = max(samples, _SAMPLES_OF_MIXED / touched)
            if not self.in_grid:
                # No known total corrects the shares c. With n samples their errors are about n^(-2/3) / 2. A surface below
                # 6 V / s, s being the smallest part, cuts some 9 V / (s h^2) voxels of h^3: this n keeps the sum of
                # their random errors below 1/5000 of V.
                samples = max(samples, (7500 * edge**2 / float(np.sqrt(shape.finest * shape.volume))) ** 1.5)
            self.n_samples = int(np.clip(samples, _MIN_SAMPLES, _MAX_SAMPLES))

    @property
    def steps(self) -> int:
        """How many times `paint` yields."""
        if np.any(self.stop <= self.start):
            return 0
        return self.n_blocks if self.is_small else int(self.stop[0] - self.start[0])

    def paint(self, image: Floats, pool: ThreadPoolExecutor) -> Iterator[None]:
        """Change `image`, step by step."""
        if not self.steps:
            return iter(())
        box = image[tuple(map(slice, self.start, self.stop))]
        return self._paint_small(box, pool) if self.is_small else self._paint_voxels(box, pool)

    def _paint_small(self, box: Floats, pool: ThreadPoolExecutor) -> Iterator[None]:
        """Points of the shape, each with an equal share of its volume, are added to the voxels that they fall into."""
        total, hits = np.zeros(box.shape), 0
        index_from_shape = np.linalg.inv(self.grid.affine) @ self.layer.pose

        def sample(block: int) -> tuple[NDArray[np.int64], Points]:
            points = _shape_points(self.layer.shape, block * _BOX_BLOCK)
            change = self.layer.value - values_at(self.beneath, _moved(self.layer.pose, points))
            return np.rint(_moved(index_from_shape, points)).astype(np.int64), change

        for index, change in pool.map(sample, range(self.n_blocks)):
            hits += len(change)
            index -= self.start[:, None]
            held = np.all((index >= 0) & (index < np.array(total.shape)[:, None]), axis=0)
            np.add.at(total, tuple(index[:, held]), change[held])
            yield
        box += total * (self.in_voxels / max(hits, 1))

    def _paint_voxels(self, box: Floats, pool: ThreadPoolExecutor) -> Iterator[None]:
        """Voxels inside the shape are filled; those that its surface cuts are sampled."""
        stretches = max(1, _SEQUENCE // self.n_samples)
        offsets = (_r3_sequence(stretches * self.n_samples) - 0.5).reshape(3, stretches, self.n_samples)
        own, *lower = (_Sampled(layer, self.grid, offsets) for layer in (self.layer, *self.beneath))

        def fill(slab: int) -> tuple[float, list[tuple[NDArray[np.int64], Floats, Floats]]]:
            of_whole, cuts, values = 0.0, [], box[slab].ravel()
            for first in range(0, values.size, _BLOCK):
                number = slab * values.size + np.arange(first, min(first + _BLOCK, values.size))
                index = np.stack(np.unravel_index(number, box.shape)) + self.start[:, None]
                whole, cut = own.sort(index)
                block = values[first : first + _BLOCK]
                painted = self.layer.over(block[whole])
                of_whole += float(np.sum(painted - block[whole], dtype=np.float64))
                block[whole] = painted
                cuts.append((number[cut], *_coverage(index[:, cut], own, lower)))
            box[slab] = values.reshape(box[slab].shape)
            return of_whole, cuts

        missing, cuts = self.mean_change * self.in_voxels, []
        for of_whole, of_slab in pool.map(fill, range(len(box))):
            missing -= of_whole
            cuts += of_slab
            yield
        cut, coverage, change = map(np.concatenate, zip(*cuts, strict=True))
        if self.in_grid:
            # What is missing goes to where the shares c are uncertain, as c (1 - c): so they stay between 0 and 1.
            missing -= float(change.sum(dtype=np.float64))
            uncertain = float(np.sum(np.abs(change) * (1 - coverage), dtype=np.float64))
            factor = 1 + np.float32(missing / uncertain if uncertain else 0.0) * np.sign(change) * (1 - coverage)
            change *= np.clip(factor, 0, 1 / np.maximum(coverage, np.float32(1e-6)))
        box[np.unravel_index(cut, box.shape)] += change


class _Sampled:
    """A layer's shape and sample points of voxels."""

    def __init__(self, layer: Layer, grid: Grid, offsets: Points) -> None:
        """Of points at `offsets` (3, stretches, n), in voxels, from the voxels' centres."""
        shape_from_index = layer.from_world @ grid.affine
        self.layer = layer
        self._linear, self._origin = shape_from_index[:3, :3], shape_from_index[:3, 3:]
        self.n_samples = offsets.shape[2]
        self._offsets = np.tensordot(self._linear, offsets, 1).astype(np.float32)
        # The distance of a voxel's farthest corner from its centre, over the four diagonals of a parallelepiped.
        signs = np.array([[1, 1, 1], [1, 1, -1], [1, -1, 1], [-1, 1, 1]])
        self._half_diagonal = 0.5 * np.linalg.norm(signs @ self._linear.T, axis=1).max() * (1 + 1e-5)

    def sort(self, index: NDArray[np.int64]) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
        """Which voxels (3, n) are inside, (n,), and the numbers of those that the surface may cut."""
        distance = self.layer.shape.distance(self._centers(index))
        return distance < -self._half_diagonal, np.flatnonzero(np.abs(distance) <= self._half_diagonal)

    def inside(self, index: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which points of voxels (3, n) are inside, (n, samples)."""
        # The factors are primes that seldom divide the number of stretches: neighbours along any axis take different ones.
        stretch = (np.array([1, 53, 211]) @ index) % self._offsets.shape[1]
        points = self._centers(index)[:, :, None] + self._offsets[:, stretch]
        return (self.layer.shape.distance(points.reshape(3, -1)) < 0).reshape(points.shape[1:])

    def _centers(self, index: NDArray[np.int64]) -> Floats:
        return (self._linear @ index + self._origin).astype(np.float32)


def _coverage(index: NDArray[np.int64], own: _Sampled, lower: Sequence[_Sampled]) -> tuple[Floats, Floats]:
    """For voxels (3, n): the share that the shape covers, and the change of the mean that painting it makes."""
    coverage, change = np.empty((2, index.shape[1]), np.float32)
    step = max(1, _BLOCK // own.n_samples)
    for first in range(0, index.shape[1], step):
        some = slice(first, first + step)
        inside = own.inside(index[:, some])
        beneath = np.zeros(inside.shape, np.float32)
        for layer in lower:
            filled, crossed = layer.sort(index[:, some])
            beneath[filled] = layer.layer.over(beneath[filled])
            if len(crossed):
                within = layer.inside(index[:, some][:, crossed])
                beneath[crossed] = np.where(within, layer.layer.over(beneath[crossed]), beneath[crossed])
        coverage[some] = inside.mean(axis=1)
        change[some] = np.where(inside, np.float32(own.layer.value) - beneath, 0).mean(axis=1)
    return coverage, change


def line_integrals(layers: Sequence[Layer], starts: Points, ends: Points) -> Points:
    """Integrals (N,) of the painting, value x mm, along the lines from `starts` to `ends`, (N, 3) world mm: exact."""
    step = max(1, _RAYS * _PARTS // max(_PARTS, *(layer.shape.n_parts for layer in layers), 1))
    blocks = (slice(first, first + step) for first in range(0, len(starts), step))
    parts = (_integrals_of_block(layers, starts[block].T, ends[block].T) for block in blocks)
    return np.concatenate([np.empty(0), *parts])


def _integrals_of_block(layers: Sequence[Layer], starts: Points, ends: Points) -> Points:
    """Of lines (3, N). Each line's pieces between the surfaces that it crosses are painted in the layers' order."""
    directions = ends - starts
    pieces: list[tuple[Any, ...]] = []
    for layer in layers:
        linear = layer.from_world[:3, :3]
        enter, leave = layer.shape.intervals(_moved(layer.from_world, starts), linear @ directions)
        enter, leave = np.maximum(enter, 0.0).T, np.minimum(leave, 1.0).T
        ray, part = np.nonzero(enter < leave)
        content = (np.full(len(ray), held) for held in (layer.value, layer.adds))
        pieces.append((ray, enter[ray, part], leave[ray, part], *content))
    if not pieces:
        return np.zeros(starts.shape[1])
    columns = [np.concatenate(column) for column in zip(*pieces, strict=True)]
    order = np.argsort(columns[0], kind="stable")  # keeps the layers' order in each ray
    rays, enters, leaves, value, add = (column[order] for column in columns)
    counts = np.bincount(rays, minlength=starts.shape[1])
    firsts = np.cumsum(counts) - counts
    integrals = np.zeros(starts.shape[1])
    # Lines of about as many parts together, up to a power of 2, padded with empty ones.
    padded = np.where(counts > 0, 1 << np.ceil(np.log2(np.maximum(counts, 1))).astype(np.int64), 0)
    for most in np.unique(padded[padded > 0]):
        some = np.flatnonzero(padded == most)
        number = np.arange(most)
        there = number < counts[some, None]
        index = np.where(there, firsts[some, None] + number, 0)
        low, high = np.where(there, enters[index], 0.0), np.where(there, leaves[index], 0.0)
        edges = np.sort(np.concatenate([low, high], axis=1), axis=1)
        middles = (edges[:, :-1] + edges[:, 1:]) / 2
        painted = np.zeros_like(middles)
        for k in range(most):
            inside = (low[:, k, None] < middles) & (middles < high[:, k, None])
            paint = np.where(add[index[:, k], None], painted, 0.0) + value[index[:, k], None]
            painted = np.where(inside, paint, painted)
        integrals[some] = np.einsum("rs,rs->r", painted, np.diff(edges, axis=1))
    return integrals * np.sqrt(np.einsum("in,in->n", directions, directions))


def _shape_points(shape: Shape, first: int) -> Points:
    """Points (3, n) of a shape, in its frame: those of a block that fills its box, from number `first` on."""
    points = (_r3_sequence(_BOX_BLOCK, first) - 0.5) * (2 * np.array(shape.half_box)[:, None])
    return points[:, shape.distance(points) < 0]


def _r3_sequence(n: int, first: int = 0) -> Points:
    """`n` points of the unit cube from number `first` on, (3, n).

    M. Roberts' R3, a low-discrepancy (Kronecker) sequence of the generalised golden ratio: any stretch of it is the
    first one, shifted, and two consecutive stretches fill the cube as evenly as one of twice the length.
    """
    ratio = 1.2207440846057596  # the real root of x^4 = x + 1
    steps = ratio ** -np.arange(1.0, 4.0)
    points = 0.5 + np.outer(steps, np.arange(first + 1, first + n + 1))
    return points - np.floor(points)  # the remainder, several times faster than %


def _moved(pose: Points, points: Points) -> Points:
    """`points` (3, N) transformed by a pose (4, 4)."""
    return pose[:3, :3] @ points + pose[:3, 3:]
