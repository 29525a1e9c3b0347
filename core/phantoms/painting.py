"""Shapes painted one over the other: the mean over each voxel, the values at points, the integrals along lines.

Each shape changes what the shapes before it left only inside itself. A voxel's mean is therefore the sum, over the
shapes, of the mean of that change, and each shape is sampled as finely as its own size asks.
"""

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array, Bools, Floats, Floats32, Integers
from ..geometry.grid import Grid
from ..memory import cores, require
from ..progress import Progress, tell
from .shapes import Shape

Points = Floats
Indices = Integers

# Points of one call of a shape's `distance`: few enough that its temporaries stay in the processor's cache.
_BLOCK = 1 << 15
_MIN_SAMPLES, _MAX_SAMPLES = 128, 1 << 13  # of a voxel that a surface cuts
_CELLS = 64  # of a voxel that is longer than wide, unless fewer are about cubes
_SEQUENCE = 1 << 16  # points that voxels take their samples from, each another stretch, so that their errors cancel
# Over several values beneath, few voxels get more samples: about so many altogether.
_SAMPLES_OF_MIXED = 1 << 21
# A shape that fills no voxel and touches at most `_FEW` of them is sampled in its own box.
_FEW = 1 << 11
_SAMPLES_OF_FEW = 1 << 10  # per voxel
_BOX_BLOCK = 1 << 13  # points at a time
_SAMPLES_OF_OVERLAP = 1 << 18
_ROUNDING = 1e-6  # of a voxel
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

    def contains(self, points: Points) -> Bools:
        """Which of the world `points` (3, N), mm, lie inside."""
        return self.shape.distance(_moved(self.from_world, points)) < 0

    def over(self, values: Array) -> Array:
        """The values after painting this layer over `values`."""
        value = values.dtype.type(self.value)
        return values + value if self.adds else np.full_like(values, value)

    def relation(self, other: "Layer") -> int:
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
) -> Floats32:
    """The mean of the painting over each voxel, float32 array of the grid's shape.

    A voxel farther from a surface than its own half diagonal lies inside or outside as a whole. Of the others, the share
    that a shape covers is counted at points of a low-discrepancy sequence, in long voxels cell by cell; the shares are then
    corrected so that the total change is the known one. For a shape that is small beside the voxels, the points fill the
    shape instead.

    `layers` run from bottom to top; `changes` are those of `mean_changes`; `progress` is called with (done, total).
    """
    require(5.0 * grid.n_voxels, "a volume of {} x {} x {} voxels".format(*grid.shape))
    image = np.zeros(grid.shape, np.float32)
    limits = _limits(layers)
    painted = zip(layers, _seen_beneath(layers), changes, strict=True)
    strokes = [stroke for each in painted if (stroke := _Stroke(grid, *each, limits)).blocks]
    total, done = sum(len(stroke.blocks) for stroke in strokes), 0
    with ThreadPoolExecutor(cores()) as pool:
        for stroke in strokes:
            box = image[tuple(map(slice, stroke.start, stroke.stop))]
            for _ in (stroke.paint_points if stroke.is_small else stroke.paint_cells)(box, pool):
                done += 1
                tell(progress, done, total)
    return np.clip(image, *limits, out=image)


def _limits(layers: Sequence[Layer]) -> tuple[float, float]:
    """The smallest and the largest value that painting these layers can leave."""
    values = [0.0, *(layer.value for layer in layers)]
    if min(values) < 0:
        return -np.inf, np.inf
    return 0.0, np.inf if any(layer.adds for layer in layers) else max(values)


class _Stroke:
    """Painting one layer over those beneath it."""

    def __init__(
        self, grid: Grid, layer: Layer, beneath: Sequence[Layer], mean_change: float, limits: tuple[float, float]
    ) -> None:
        self.grid, self.layer, self.beneath, self.mean_change, self.limits = grid, layer, beneath, mean_change, limits
        shape, shape_from_index = layer.shape, layer.from_world @ grid.affine
        # Bounds of the indices of the shape's points: the tighter of its box and its ball.
        index_from_shape = np.linalg.inv(shape_from_index)
        linear, middle = index_from_shape[:3, :3], index_from_shape[:3, 3]
        half = np.minimum(np.abs(linear) @ shape.half_box, np.linalg.norm(linear, axis=1) * shape.ball_radius)
        low, high = middle - half, middle + half
        # Clipped as floats: a far-away box must not overflow the integers.
        self.start = np.clip(np.floor(low + 0.5), 0, grid.shape).astype(np.int64)
        self.stop = np.clip(np.floor(high + 0.5) + 1, self.start, grid.shape).astype(np.int64)
        n_voxels = int(np.prod(self.stop - self.start))
        self.in_grid = bool(np.all(np.maximum(-0.5 - low, high + 0.5 - grid.shape) < _ROUNDING))
        self.in_voxels = shape.volume / abs(float(np.linalg.det(shape_from_index[:3, :3])))  # the shape's volume
        narrowest = 1 / float(np.linalg.norm(linear, axis=1).max())  # of the voxels' widths
        # The voxels in the shape's box or, where it lies across them, cubes of that width in it.
        touched = float(min(np.prod(2 * half + 1), np.prod(2 * np.array(shape.half_box) / narrowest + 1)))
        fills_none = self.in_voxels < 1 or 2 * min(shape.half_box) < narrowest
        self.is_small = fills_none and touched < _FEW
        # What the shape covers is mixed unless one layer surely lies beneath all of it.
        is_mixed = len(beneath) > 1 or (len(beneath) == 1 and beneath[0].relation(layer) != 1)
        if self.is_small:
            points = _SAMPLES_OF_FEW * max(touched, 8.0)
            if is_mixed or not self.in_grid:
                points = max(points, min(8 * points, _SAMPLES_OF_MIXED))
            self.blocks = range(0, int(points) if n_voxels else 0, _BOX_BLOCK)
            return
        self.blocks = range(0, n_voxels, min(max(n_voxels >> 6, 1 << 10), _BLOCK))
        # A long voxel is halved and halved again, until its cells are about cubes, or many and finer than the shape.
        edges, self.levels = np.linalg.norm(shape_from_index[:3, :3], axis=0), [np.ones(3, np.int64)]
        while (cell := edges / (parts := self.levels[-1])).max() > 2 * cell.min() and (
            cell.max() > shape.finest / 2 or parts.prod() < _CELLS
        ):
            self.levels.append(parts * np.where(cell > cell.max() / 2, 2, 1))
        n_cells, ratio = int(parts.prod()), float(cell.max()) / shape.finest
        # The errors of a voxel's cells cancel.
        samples = _MIN_SAMPLES * max(1.0, 4 * ratio) / min(n_cells, 4 * _CELLS) ** 0.5
        if is_mixed or n_cells > 1:
            samples = max(samples, _SAMPLES_OF_MIXED / (touched * n_cells))
        if not self.in_grid:
            # No known total corrects the shares c. With n samples their errors are about n^(-2/3) / 2. A surface below
            # 6 V / s, s being the smallest part, cuts some 9 V h / (s v) cells of the volume v and the length h: this n
            # keeps the sum of their random errors below 1/5000 of V.
            samples = max(samples, (7500 * float(np.sqrt(ratio / (self.in_voxels * n_cells)))) ** 1.5)
        self.n_samples = int(min(samples, _MAX_SAMPLES))

    def paint_points(self, box: Floats32, pool: ThreadPoolExecutor) -> Iterator[None]:
        """Points of the shape, each with an equal share of its volume, are added to the voxels that they fall into.

        What they replace is scaled so that the shape's total change is the known one.
        """
        inside, replaced = np.zeros((2, *box.shape))
        hits, replaced_in_all = 0, 0.0
        index_from_shape = np.linalg.inv(self.grid.affine) @ self.layer.pose

        def sample(first: int) -> tuple[Indices, Points]:
            points = _shape_points(self.layer.shape, first)
            beneath = values_at(self.beneath, _moved(self.layer.pose, points))
            return np.rint(_moved(index_from_shape, points)).astype(np.int64), beneath

        for index, beneath in pool.map(sample, self.blocks):
            hits += len(beneath)
            replaced_in_all += float(beneath.sum())
            index -= self.start[:, None]
            held = np.all((index >= 0) & (index < np.array(box.shape)[:, None]), axis=0)
            place = tuple(index[:, held])
            np.add.at(inside, place, 1)
            np.add.at(replaced, place, beneath[held])
            yield
        known = (self.layer.value - self.mean_change) * hits
        scale = known / replaced_in_all if replaced_in_all else 1.0
        box += (self.layer.value * inside - scale * replaced) * (self.in_voxels / max(hits, 1))

    def paint_cells(self, box: Floats32, pool: ThreadPoolExecutor) -> Iterator[None]:
        """Voxels inside the shape are filled; those that its surface cuts are sampled."""
        stretches = max(1, _SEQUENCE // self.n_samples)
        offsets = (_r3_sequence(stretches * self.n_samples) - 0.5).reshape(3, stretches, self.n_samples)
        layers = [_Sampled(layer, self.grid, self.levels, offsets) for layer in (self.layer, *self.beneath)]

        def fill(first: int) -> tuple[Indices, Floats32]:
            number = np.arange(first, min(first + self.blocks.step, box.size))
            place = np.stack(np.unravel_index(number, box.shape))
            index = place + self.start[:, None]
            side = layers[0].sort(index, 0)
            whole, cut = tuple(place[:, side > 0]), np.flatnonzero(side == 0)
            box[whole] = self.layer.over(box[whole])
            changes = np.zeros((2, len(cut)), np.float32)
            _add_changes(changes, np.arange(len(cut)), index[:, cut], 0, layers)
            return number[cut], changes

        missing, cuts = self.mean_change * self.in_voxels + float(box.sum(dtype=np.float64)), []
        for of_block in pool.map(fill, self.blocks):
            cuts.append(of_block)
            yield
        cut, (change, uncertain) = (np.concatenate(parts, axis=-1) for parts in zip(*cuts, strict=True))
        place = np.unravel_index(cut, box.shape)
        # Layers sampled at different points may replace a little more than there was: what is left is then certain.
        left = box[place] + change
        change = np.clip(left, *self.limits) - box[place]
        uncertain[(left < self.limits[0]) | (left > self.limits[1])] = 0
        if self.in_grid:
            # What is missing goes to where the shares c are uncertain, as c (1 - c): so they stay between 0 and 1.
            missing -= float(box.sum(dtype=np.float64) + change.sum(dtype=np.float64))
            spread = max(float(uncertain.sum(dtype=np.float64)), 1e-300)
            change += np.float32(np.clip(missing / spread, -1, 1)) * uncertain
        box[place] += change


class _Sampled:
    """A layer's shape, and voxels cut into cells, so many (3,) along each axis at each of the `levels`."""

    def __init__(self, layer: Layer, grid: Grid, levels: Sequence[Indices], offsets: Points) -> None:
        """The last level's cells are sampled at `offsets` (3, stretches, n), in cells, from their centres."""
        shape_from_index = layer.from_world @ grid.affine
        linear, origin = shape_from_index[:3, :3], shape_from_index[:3, 3:]
        self.layer, self.levels, self.n_samples = layer, levels, offsets.shape[2]
        self._offsets = np.tensordot(linear / levels[-1], offsets, 1).astype(np.float32)
        self._cells = [(linear / parts, origin + linear @ (0.5 / parts - 0.5)[:, None]) for parts in levels]
        # The distance of a cell's farthest corner from its centre, over the four diagonals of a parallelepiped.
        corners = 0.5 * (1 + 1e-5) * np.array([[1, 1, 1, -1], [1, 1, -1, 1], [1, -1, 1, 1]])
        self._half_diagonals = [np.linalg.norm(edges @ corners, axis=0).max() for edges, _ in self._cells]

    def sort(self, index: Indices, level: int) -> NDArray[np.int8]:
        """1 for the cells (3, n) inside, -1 for those outside, 0 for those that the surface may cut, (n,)."""
        distance, half = self.layer.shape.distance(self._centers(index, level)), self._half_diagonals[level]
        return np.subtract(distance < -half, distance > half, dtype=np.int8)

    def inside(self, index: Indices) -> Bools:
        """Which points of the last level's cells (3, n) are inside, (n, samples)."""
        # The factors are primes that seldom divide the number of stretches: neighbours along any axis take different ones.
        stretch = (np.array([1, 53, 211]) @ index) % self._offsets.shape[1]
        points = self._centers(index, -1)[:, :, None] + self._offsets[:, stretch]
        return (self.layer.shape.distance(points.reshape(3, -1)) < 0).reshape(points.shape[1:])

    def paint(self, values: Floats32, index: Indices, level: int) -> None:
        """Paint the layer over the `values` (n, points) of cells; its surface may cut those of the last level only."""
        side = self.sort(index, level)
        whole, cut = side > 0, np.flatnonzero(side == 0)
        values[whole] = self.layer.over(values[whole])
        if len(cut):
            values[cut] = np.where(self.inside(index[:, cut]), self.layer.over(values[cut]), values[cut])

    def _centers(self, index: Indices, level: int) -> Floats32:
        edges, first = self._cells[level]
        return (edges @ index + first).astype(np.float32)


def _add_changes(changes: Floats32, voxel: Indices, index: Indices, level: int, layers: Sequence[_Sampled]) -> None:
    """Add what painting the first layer over the others changes in cells (3, n) of a level that their surfaces may cut.

    `voxel` (n,) are the columns of `changes` to add to: the change of the voxel's mean, and how much of it is uncertain.
    """
    own, *lower = layers
    finer = min(level + 1, len(own.levels) - 1)
    factor = own.levels[finer] // own.levels[level]
    places = np.indices(tuple(factor.tolist())).reshape(3, 1, -1)
    step = max(1, _BLOCK // (own.n_samples if finer == level else places.shape[2]))
    for first in range(0, len(voxel), step):
        cells, of = index[:, first : first + step], voxel[first : first + step]
        if finer == level:
            inside = own.inside(cells)
        else:
            cells = (cells[:, :, None] * factor[:, None, None] + places).reshape(3, -1)
            of = np.repeat(of, places.shape[2])
            sides = np.stack([layer.sort(cells, finer) for layer in layers])
            whole = sides.all(axis=0)
            cut, whole = ~whole & (sides[0] >= 0), whole & (sides[0] > 0)
            _add_changes(changes, of[cut], cells[:, cut], finer, layers)
            cells, of, inside = cells[:, whole], of[whole], np.ones((np.count_nonzero(whole), 1), bool)
        beneath = np.zeros(inside.shape, np.float32)
        for layer in lower:
            layer.paint(beneath, cells, finer)
        change = np.where(inside, np.float32(own.layer.value) - beneath, 0).mean(axis=1)
        change /= np.float32(own.levels[finer].prod())
        np.add.at(changes[0], of, change)
        # A share c is uncertain as c (1 - c).
        np.add.at(changes[1], of, np.abs(change) * (1 - inside.mean(axis=1, dtype=np.float32)))


def line_integrals(layers: Sequence[Layer], starts: Points, ends: Points) -> Points:
    """Integrals (N,) of the painting, value x mm, along the lines from `starts` to `ends`, (N, 3) world mm: exact."""
    step = max(1, _RAYS * _PARTS // max(_PARTS, *(layer.shape.n_parts for layer in layers), 1))
    blocks = (slice(first, first + step) for first in range(0, len(starts), step))
    parts = (_integrals_of_block(layers, starts[block].T, ends[block].T) for block in blocks)
    return np.concatenate([np.empty(0), *parts])


def _integrals_of_block(layers: Sequence[Layer], starts: Points, ends: Points) -> Points:
    """Integrals (N,) along lines (3, N), whose pieces between the surfaces they cross are painted in the layers' order."""
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
