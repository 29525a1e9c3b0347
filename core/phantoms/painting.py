"""Painting of shapes one over the other: voxel means, values at points and line integrals of the result.

A layer changes the values of the layers beneath it only inside its own shape. The mean over a voxel is therefore the sum,
over all layers, of the mean of that change, and each shape is sampled as finely as its own size requires.
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

# Points per call of a shape's `distance`: few enough that its temporaries stay in the processor's cache.
_BLOCK = 1 << 15
# Sample points per voxel, or per cell of a voxel, that a surface cuts.
_MIN_SAMPLES, _MAX_SAMPLES = 128, 1 << 13
# Cells per voxel of a long voxel, unless fewer are already about cubes.
_CELLS = 64
# Points in the sequence from which voxels take their samples, each voxel another stretch, so that their errors cancel.
_SEQUENCE = 1 << 16
# Sample points of a layer over several values: where few voxels are cut, each gets more samples, about this many in all.
_SAMPLES_OF_MIXED = 1 << 21
# A shape that fills no voxel and touches at most `_FEW` voxels is sampled in its own box instead of in voxels.
_FEW = 1 << 11
_SAMPLES_OF_FEW = 1 << 10  # points in the box of such a shape, per touched voxel
_BOX_BLOCK = 1 << 13  # points of one block in a shape's box
_SAMPLES_OF_OVERLAP = 1 << 18  # points in a shape's box at which its overlap with other shapes is measured
_ROUNDING = 1e-6  # distance, in voxels, by which a shape in the grid may extend beyond it
# Lines integrated at a time; fewer for shapes of more than `_PARTS` parts.
_RAYS, _PARTS = 1 << 14, 256


@dataclass(frozen=True, eq=False)
class Layer:
    """Shape of a painting with its pose world-from-shape (4, 4), mm, and its value, an activity or a mu."""

    shape: Shape
    pose: Floats
    value: float

    @property
    def adds(self) -> bool:
        """Whether the value is added to the values beneath instead of replacing them."""
        return self.shape.mode == "add"

    @cached_property
    def from_world(self) -> Floats:
        """Inverse of the pose, shape-from-world (4, 4)."""
        return np.linalg.inv(self.pose)

    @cached_property
    def volume(self) -> float:
        """Volume of the shape in the world, mm^3."""
        return self.shape.volume * abs(float(np.linalg.det(self.pose[:3, :3])))

    def contains(self, points: Points) -> Bools:
        """Return whether each of the world `points` (3, N), mm, lies inside the shape, (N,)."""
        return self.shape.distance(_transform(self.from_world, points)) < 0

    def paint_over(self, values: Array) -> Array:
        """Return the `values` at points inside the shape after this layer is painted over them."""
        value = values.dtype.type(self.value)
        return values + value if self.adds else np.full_like(values, value)

    def relation(self, layer: "Layer") -> int:
        """Return 1 if this shape certainly contains the `layer`'s, -1 if the two certainly do not touch, else 0."""
        from_layer = self.from_world @ layer.pose
        radius = layer.shape.ball_radius * float(np.linalg.norm(from_layer[:3, :3], 2))
        distance = float(self.shape.distance(from_layer[:3, 3:])[0])
        return 1 if distance < -radius else -1 if distance > radius else 0


def values_at(layers: Sequence[Layer], points: Points) -> Points:
    """Return the painting's values (N,) at world `points` (3, N), mm; `layers` run from bottom to top."""
    values = np.zeros(points.shape[1])
    for layer in layers:
        values = np.where(layer.contains(points), layer.paint_over(values), values)
    return values


def points_inside(layer: Layer) -> Iterator[Points]:
    """Yield world points (3, n), mm, that fill a layer's shape evenly, block by block."""
    for first in range(0, _SAMPLES_OF_OVERLAP, _BOX_BLOCK):
        yield _transform(layer.pose, _shape_points(layer.shape, first))


def mean_changes(layers: Sequence[Layer]) -> list[float]:
    """Return each layer's mean change of value over its own volume when painted over the layers beneath it.

    The overlap of two layers is measured at points of the smaller one. Errors are therefore small compared with the content
    of either, and the content of a layer that is covered completely vanishes completely.
    """
    changes = [layer.value for layer in layers]
    for number, (layer, neighbors) in enumerate(zip(layers, _neighbors(layers), strict=True)):
        for k, fraction in _overlaps(layers, number, neighbors).items():
            upper, lower = max(number, k), min(number, k)
            changes[upper] -= fraction * layer.volume * layers[lower].value / layers[upper].volume
    return changes


def _neighbors(layers: Sequence[Layer]) -> Iterator[list[int]]:
    """Yield for each layer the numbers, ascending, of the other layers whose enclosing balls overlap its own."""
    centers = np.array([layer.pose[:3, 3] for layer in layers]).reshape(-1, 3)
    radii = np.array([layer.shape.ball_radius * np.linalg.norm(layer.pose[:3, :3], 2) for layer in layers])
    for i in range(len(layers)):
        overlap = np.linalg.norm(centers - centers[i], axis=1) < radii + radii[i]
        yield [k for k in np.flatnonzero(overlap).tolist() if k != i]


def _overlaps(layers: Sequence[Layer], number: int, neighbors: Sequence[int]) -> dict[int, float]:
    """Return fractions of the volume of layer `number`, by the numbers of the larger layers that it overlaps.

    `neighbors` are the numbers of the layers that it may overlap. For a layer above, it is the fraction in which that layer
    is the first to replace this one; for a layer beneath, the fraction in which that layer's value is visible before this
    one is painted. Overlaps of a lower value 0 are left out.
    """
    layer = layers[number]
    relations = {k: layers[k].relation(layer) for k in neighbors}
    above = [k for k, relation in relations.items() if k > number and relation >= 0 and not layers[k].adds]
    beneath = [k for k, relation in relations.items() if k < number and relation >= 0 and not layer.adds][::-1]
    larger = [k for k in (*above, *beneath) if (layers[k].volume, k) > (layer.volume, number)]
    n_overlapping = {k: 0 for k in larger if layers[min(k, number)].value}
    if not n_overlapping:
        return {}
    is_partial = any(relations[k] == 0 for k in (*above, *beneath))
    n_points = 0
    for points in points_inside(layer):
        n_points += points.shape[1]
        for order in (above, beneath):
            uncovered = points
            for k in order:
                inside = np.ones(uncovered.shape[1], bool) if relations[k] else layers[k].contains(uncovered)
                if k in n_overlapping:
                    n_overlapping[k] += int(np.count_nonzero(inside))
                if not layers[k].adds:
                    uncovered = uncovered[:, ~inside]
        if n_points and not is_partial:  # all layers contain this one: every point gives the same answer
            break
    return {k: n / max(n_points, 1) for k, n in n_overlapping.items()}


def _visible_layers(layers: Sequence[Layer]) -> Iterator[list[Layer]]:
    """Yield for each layer the layers beneath it that may be visible inside its shape; none for a layer that adds."""
    for i, (layer, neighbors) in enumerate(zip(layers, _neighbors(layers), strict=True)):
        visible: list[Layer] = []
        for j in [k for k in neighbors if k < i and not layer.adds]:
            relation = layers[j].relation(layer)
            if relation == 1 and not layers[j].adds:
                visible = []
            if relation >= 0:
                visible.append(layers[j])
        yield visible


def paint_voxels(
    grid: Grid, layers: Sequence[Layer], changes: Sequence[float], progress: Progress | None = None
) -> Floats32:
    """Return the mean of the painting over each voxel, a float32 array of the grid's shape.

    `layers` run from bottom to top; `changes` are their `mean_changes`; `progress` is called with (done, total).

    A voxel farther from a surface than its own half diagonal lies completely inside or outside. For all other voxels, the
    fraction that a shape covers is estimated at points of a low-discrepancy sequence, in long voxels cell by cell. The
    fractions are then corrected so that the layer's total change equals its mean change times its volume. For a shape that
    is small compared with the voxels, the points fill the shape instead.
    """
    require(5.0 * grid.n_voxels, "a volume of {} x {} x {} voxels".format(*grid.shape))
    image = np.zeros(grid.shape, np.float32)
    limits = _value_limits(layers)
    painted = zip(layers, _visible_layers(layers), changes, strict=True)
    strokes = [stroke for arguments in painted if (stroke := _Stroke(grid, *arguments, limits)).blocks]
    total, done = sum(len(stroke.blocks) for stroke in strokes), 0
    with ThreadPoolExecutor(cores()) as pool:
        for stroke in strokes:
            box = image[tuple(map(slice, stroke.start, stroke.stop))]
            for _ in (stroke.paint_points if stroke.is_small else stroke.paint_cells)(box, pool):
                done += 1
                tell(progress, done, total)
    return np.clip(image, *limits, out=image)


def _value_limits(layers: Sequence[Layer]) -> tuple[float, float]:
    """Return the smallest and the largest value that a painting of these layers can have."""
    values = [0.0, *(layer.value for layer in layers)]
    if min(values) < 0:
        return -np.inf, np.inf
    return 0.0, np.inf if any(layer.adds for layer in layers) else max(values)


class _Stroke:
    """Painting of one layer into voxels, over the layers beneath it.

    Attributes
    ----------
    start, stop : (3,)
        First index, and last index + 1, of the box of voxels that contains the shape.
    blocks : range
        First numbers of the blocks of work: voxels of the box, or points if the shape is small.
    is_small : bool
        Whether `paint_points` is to be used instead of `paint_cells`.
    is_in_grid : bool
        Whether the whole shape lies in the grid.
    volume : float
        Volume of the shape, in voxels.
    levels : list of (3,)
        Numbers of cells of a voxel along its axes, from the whole voxel to the finest division.
    n_samples : int
        Sample points per cell of the finest division.
    """

    def __init__(
        self, grid: Grid, layer: Layer, beneath: Sequence[Layer], mean_change: float, limits: tuple[float, float]
    ) -> None:
        """Choose the voxels, the method and the numbers of samples.

        `beneath` are the visible layers beneath, `mean_change` is the layer's of `mean_changes`, `limits` are the smallest
        and the largest value that a voxel can have.
        """
        self.grid, self.layer, self.beneath, self.mean_change, self.limits = grid, layer, beneath, mean_change, limits
        shape, shape_from_index = layer.shape, layer.from_world @ grid.affine
        # Bounds of the shape's voxel indices: the tighter ones of its box and its ball.
        index_from_shape = np.linalg.inv(shape_from_index)
        linear, center = index_from_shape[:3, :3], index_from_shape[:3, 3]
        half = np.minimum(np.abs(linear) @ shape.half_box, np.linalg.norm(linear, axis=1) * shape.ball_radius)
        low, high = center - half, center + half
        # Clipped as floats: a far-away box must not overflow the integers.
        self.start = np.clip(np.floor(low + 0.5), 0, grid.shape).astype(np.int64)
        self.stop = np.clip(np.floor(high + 0.5) + 1, self.start, grid.shape).astype(np.int64)
        n_voxels = int(np.prod(self.stop - self.start))
        self.is_in_grid = bool(np.all(np.maximum(-0.5 - low, high + 0.5 - grid.shape) < _ROUNDING))
        self.volume = shape.volume / abs(float(np.linalg.det(shape_from_index[:3, :3])))
        voxel_width = 1 / float(np.linalg.norm(linear, axis=1).max())  # mm, the smallest one
        # Voxels in the shape's box of indices or, if the voxels lie obliquely to it, cubes of that width in its own box.
        n_touched = float(min(np.prod(2 * half + 1), np.prod(2 * np.array(shape.half_box) / voxel_width + 1)))
        fills_no_voxel = self.volume < 1 or 2 * min(shape.half_box) < voxel_width
        self.is_small = fills_no_voxel and n_touched < _FEW
        # The values beneath are mixed unless one layer certainly lies beneath all of the shape.
        is_mixed = len(beneath) > 1 or (len(beneath) == 1 and beneath[0].relation(layer) != 1)
        if self.is_small:
            n_points = _SAMPLES_OF_FEW * max(n_touched, 8.0)
            if is_mixed or not self.is_in_grid:
                n_points = max(n_points, min(8 * n_points, _SAMPLES_OF_MIXED))
            self.blocks = range(0, int(n_points) if n_voxels else 0, _BOX_BLOCK)
            return
        self.blocks = range(0, n_voxels, min(max(n_voxels >> 6, 1 << 10), _BLOCK))
        # A long voxel is halved repeatedly until its cells are about cubes, or numerous and finer than the shape.
        edges, self.levels = np.linalg.norm(shape_from_index[:3, :3], axis=0), [np.ones(3, np.int64)]
        while (cell := edges / (divisions := self.levels[-1])).max() > 2 * cell.min() and (
            cell.max() > shape.finest / 2 or divisions.prod() < _CELLS
        ):
            self.levels.append(divisions * np.where(cell > cell.max() / 2, 2, 1))
        n_cells, ratio = int(divisions.prod()), float(cell.max()) / shape.finest
        # The errors of a voxel's cells cancel.
        n_samples = _MIN_SAMPLES * max(1.0, 4 * ratio) / min(n_cells, 4 * _CELLS) ** 0.5
        if is_mixed or n_cells > 1:
            n_samples = max(n_samples, _SAMPLES_OF_MIXED / (n_touched * n_cells))
        if not self.is_in_grid:
            # No total is known that could correct the covered fractions. With n samples their errors are about
            # n^(-2/3) / 2. A surface of area below 6 V / s (volume V, smallest part s) cuts about 9 V h / (s v) cells of
            # volume v and length h: this n keeps the sum of their random errors below 1/5000 of V.
            n_samples = max(n_samples, (7500 * float(np.sqrt(ratio / (self.volume * n_cells)))) ** 1.5)
        self.n_samples = int(min(n_samples, _MAX_SAMPLES))

    def paint_points(self, box: Floats32, pool: ThreadPoolExecutor) -> Iterator[None]:
        """Add points of the shape, each an equal share of its volume, to the voxels of `box` that contain them.

        The values that they replace are scaled so that the shape's total change is its mean change times its volume.
        Yields after each block.
        """
        n_inside, replaced = np.zeros((2, *box.shape))
        n_points, replaced_sum = 0, 0.0
        index_from_shape = np.linalg.inv(self.grid.affine) @ self.layer.pose

        def sample(first: int) -> tuple[Indices, Points]:
            """Return the voxel indices (3, n) of a block's points, and the values (n,) beneath."""
            points = _shape_points(self.layer.shape, first)
            values_beneath = values_at(self.beneath, _transform(self.layer.pose, points))
            return np.rint(_transform(index_from_shape, points)).astype(np.int64), values_beneath

        for index, values_beneath in pool.map(sample, self.blocks):
            n_points += len(values_beneath)
            replaced_sum += float(values_beneath.sum())
            index -= self.start[:, None]
            in_box = np.all((index >= 0) & (index < np.array(box.shape)[:, None]), axis=0)
            voxels = tuple(index[:, in_box])
            np.add.at(n_inside, voxels, 1)
            np.add.at(replaced, voxels, values_beneath[in_box])
            yield
        true_sum = (self.layer.value - self.mean_change) * n_points
        scale = true_sum / replaced_sum if replaced_sum else 1.0
        box += (self.layer.value * n_inside - scale * replaced) * (self.volume / max(n_points, 1))

    def paint_cells(self, box: Floats32, pool: ThreadPoolExecutor) -> Iterator[None]:
        """Fill the voxels of `box` that lie inside the shape, and sample those that its surface may cut.

        Yields after each block.
        """
        n_stretches = max(1, _SEQUENCE // self.n_samples)
        offsets = (_r3_sequence(n_stretches * self.n_samples) - 0.5).reshape(3, n_stretches, self.n_samples)
        samplers = [_Sampler(layer, self.grid, self.levels, offsets) for layer in (self.layer, *self.beneath)]

        def fill(first: int) -> tuple[Indices, Floats32]:
            """Fill a block's voxels inside the shape; return the numbers (n,) and changes (2, n) of those that are cut."""
            number = np.arange(first, min(first + self.blocks.step, box.size))
            index_in_box = np.stack(np.unravel_index(number, box.shape))
            index = index_in_box + self.start[:, None]
            side = samplers[0].classify(index, 0)
            inside, cut = tuple(index_in_box[:, side > 0]), np.flatnonzero(side == 0)
            box[inside] = self.layer.paint_over(box[inside])
            changes = np.zeros((2, len(cut)), np.float32)
            _add_changes(changes, np.arange(len(cut)), index[:, cut], 0, samplers)
            return number[cut], changes

        missing, blocks = self.mean_change * self.volume + float(box.sum(dtype=np.float64)), []
        for block in pool.map(fill, self.blocks):
            blocks.append(block)
            yield
        number, (change, uncertainty) = (np.concatenate(arrays, axis=-1) for arrays in zip(*blocks, strict=True))
        cut_voxels = np.unravel_index(number, box.shape)
        # Layers sampled at different points may replace a little more than there was: a value clipped to the limits is
        # certain.
        values = box[cut_voxels] + change
        change = np.clip(values, *self.limits) - box[cut_voxels]
        uncertainty[(values < self.limits[0]) | (values > self.limits[1])] = 0
        if self.is_in_grid:
            # The missing change is distributed in proportion to the uncertainty c (1 - c) of each covered fraction c,
            # which keeps the fractions between 0 and 1.
            missing -= float(box.sum(dtype=np.float64) + change.sum(dtype=np.float64))
            uncertainty_sum = max(float(uncertainty.sum(dtype=np.float64)), 1e-300)
            change += np.float32(np.clip(missing / uncertainty_sum, -1, 1)) * uncertainty
        box[cut_voxels] += change


class _Sampler:
    """Sampling of one layer's shape in cells of voxels, which are divided more finely from level to level."""

    def __init__(self, layer: Layer, grid: Grid, levels: Sequence[Indices], offsets: Points) -> None:
        """Prepare the cells' geometry in the shape's frame.

        `levels` are the numbers of cells (3,) along a voxel's axes. Cells of the last level are sampled at `offsets`
        (3, n_stretches, n_samples), in units of a cell, from their centres.
        """
        shape_from_index = layer.from_world @ grid.affine
        linear, origin = shape_from_index[:3, :3], shape_from_index[:3, 3:]
        self.layer, self.levels, self.n_samples = layer, levels, offsets.shape[2]
        self._offsets = np.tensordot(linear / levels[-1], offsets, 1).astype(np.float32)
        # Of each level, the cells' edge vectors and the centre of cell (0, 0, 0).
        self._cells = [(linear / n, origin + linear @ (0.5 / n - 0.5)[:, None]) for n in levels]
        # Largest distance from a cell's centre to its corners: the maximum over a parallelepiped's four half diagonals.
        corners = 0.5 * (1 + 1e-5) * np.array([[1, 1, 1, -1], [1, 1, -1, 1], [1, -1, 1, 1]])
        self._half_diagonals = [np.linalg.norm(edges @ corners, axis=0).max() for edges, _ in self._cells]

    def classify(self, index: Indices, level: int) -> NDArray[np.int8]:
        """Return for cells `index` (3, n) of a level: 1 if inside, -1 if outside, 0 if the surface may cut it, (n,)."""
        distance, half = self.layer.shape.distance(self._centers(index, level)), self._half_diagonals[level]
        return np.subtract(distance < -half, distance > half, dtype=np.int8)

    def sample(self, index: Indices) -> Bools:
        """Return whether each sample point of the last level's cells `index` (3, n) is inside, (n, n_samples)."""
        # The factors are primes that seldom divide the number of stretches: neighbours along any axis take different ones.
        stretch = (np.array([1, 53, 211]) @ index) % self._offsets.shape[1]
        points = self._centers(index, -1)[:, :, None] + self._offsets[:, stretch]
        return (self.layer.shape.distance(points.reshape(3, -1)) < 0).reshape(points.shape[1:])

    def paint(self, values: Floats32, index: Indices, level: int) -> None:
        """Paint the layer over the `values` (n, points) of cells `index` (3, n), in place.

        The surface may cut cells only in the last level, where the points are the samples.
        """
        side = self.classify(index, level)
        inside, cut = side > 0, np.flatnonzero(side == 0)
        values[inside] = self.layer.paint_over(values[inside])
        if len(cut):
            values[cut] = np.where(self.sample(index[:, cut]), self.layer.paint_over(values[cut]), values[cut])

    def _centers(self, index: Indices, level: int) -> Floats32:
        """Return the centres (3, n) of cells `index` (3, n) of a level, mm, in the shape's frame."""
        edges, first = self._cells[level]
        return (edges @ index + first).astype(np.float32)


def _add_changes(changes: Floats32, voxels: Indices, index: Indices, level: int, samplers: Sequence[_Sampler]) -> None:
    """Add to `changes` (2, N) the change by painting the first sampler's layer over the others, in cells of a level.

    `index` (3, n) are the cells, which surfaces may cut, and `voxels` (n,) the columns of `changes` for their voxels. The
    rows of `changes` are the change of a voxel's mean, and its uncertainty: the change times 1 - c, c being the covered
    fraction.
    """
    sampler, *lower_samplers = samplers
    next_level = min(level + 1, len(sampler.levels) - 1)
    factor = sampler.levels[next_level] // sampler.levels[level]
    children = np.indices(tuple(factor.tolist())).reshape(3, 1, -1)
    step = max(1, _BLOCK // (sampler.n_samples if next_level == level else children.shape[2]))
    for first in range(0, len(voxels), step):
        cells, columns = index[:, first : first + step], voxels[first : first + step]
        if next_level == level:
            inside = sampler.sample(cells)
        else:
            cells = (cells[:, :, None] * factor[:, None, None] + children).reshape(3, -1)
            columns = np.repeat(columns, children.shape[2])
            sides = np.stack([s.classify(cells, next_level) for s in samplers])
            is_uncut = sides.all(axis=0)
            to_divide, to_fill = ~is_uncut & (sides[0] >= 0), is_uncut & (sides[0] > 0)
            _add_changes(changes, columns[to_divide], cells[:, to_divide], next_level, samplers)
            cells, columns, inside = cells[:, to_fill], columns[to_fill], np.ones((np.count_nonzero(to_fill), 1), bool)
        values_beneath = np.zeros(inside.shape, np.float32)
        for lower_sampler in lower_samplers:
            lower_sampler.paint(values_beneath, cells, next_level)
        change = np.where(inside, np.float32(sampler.layer.value) - values_beneath, 0).mean(axis=1)
        change /= np.float32(sampler.levels[next_level].prod())
        np.add.at(changes[0], columns, change)
        # The change is proportional to c: its uncertainty is that of a covered fraction, c (1 - c).
        np.add.at(changes[1], columns, np.abs(change) * (1 - inside.mean(axis=1, dtype=np.float32)))


def line_integrals(layers: Sequence[Layer], starts: Points, ends: Points) -> Points:
    """Return exact integrals (N,) of the painting, value x mm, along lines from `starts` to `ends`, (N, 3), world mm."""
    step = max(1, _RAYS * _PARTS // max(_PARTS, *(layer.shape.n_parts for layer in layers), 1))
    blocks = (slice(first, first + step) for first in range(0, len(starts), step))
    integrals = (_integrate_block(layers, starts[block].T, ends[block].T) for block in blocks)
    return np.concatenate([np.empty(0), *integrals])


def _integrate_block(layers: Sequence[Layer], starts: Points, ends: Points) -> Points:
    """Return integrals (N,) of the painting, value x mm, along lines from `starts` to `ends`, (3, N), world mm.

    Each line is split at all surfaces that it crosses, and its pieces are painted in the layers' order.
    """
    directions = ends - starts
    sections: list[tuple[Any, ...]] = []
    for layer in layers:
        linear = layer.from_world[:3, :3]
        enter, leave = layer.shape.intervals(_transform(layer.from_world, starts), linear @ directions)
        enter, leave = np.maximum(enter, 0.0).T, np.minimum(leave, 1.0).T
        ray, part = np.nonzero(enter < leave)
        value_and_mode = (np.full(len(ray), constant) for constant in (layer.value, layer.adds))
        sections.append((ray, enter[ray, part], leave[ray, part], *value_and_mode))
    if not sections:
        return np.zeros(starts.shape[1])
    columns = [np.concatenate(column) for column in zip(*sections, strict=True)]
    order = np.argsort(columns[0], kind="stable")  # keeps the layers' order in each ray
    rays, enters, leaves, value, adds = (column[order] for column in columns)
    counts = np.bincount(rays, minlength=starts.shape[1])
    firsts = np.cumsum(counts) - counts
    integrals = np.zeros(starts.shape[1])
    # Rays of about as many sections are integrated together, padded with empty sections up to a power of 2.
    padded = np.where(counts > 0, 1 << np.ceil(np.log2(np.maximum(counts, 1))).astype(np.int64), 0)
    for n_sections in np.unique(padded[padded > 0]):
        ray_group = np.flatnonzero(padded == n_sections)
        number = np.arange(n_sections)
        exists = number < counts[ray_group, None]
        index = np.where(exists, firsts[ray_group, None] + number, 0)
        low, high = np.where(exists, enters[index], 0.0), np.where(exists, leaves[index], 0.0)
        edges = np.sort(np.concatenate([low, high], axis=1), axis=1)
        middles = (edges[:, :-1] + edges[:, 1:]) / 2
        values = np.zeros_like(middles)
        for k in range(n_sections):
            inside = (low[:, k, None] < middles) & (middles < high[:, k, None])
            painted = np.where(adds[index[:, k], None], values, 0.0) + value[index[:, k], None]
            values = np.where(inside, painted, values)
        integrals[ray_group] = np.einsum("rs,rs->r", values, np.diff(edges, axis=1))
    return integrals * np.sqrt(np.einsum("in,in->n", directions, directions))


def _shape_points(shape: Shape, first: int) -> Points:
    """Return the points (3, n), mm, of one block of the R3 sequence that lie inside a shape, in its frame.

    The block of `_BOX_BLOCK` points begins with number `first` and fills the shape's box.
    """
    points = (_r3_sequence(_BOX_BLOCK, first) - 0.5) * (2 * np.array(shape.half_box)[:, None])
    return points[:, shape.distance(points) < 0]


def _r3_sequence(n: int, first: int = 0) -> Points:
    """Return `n` points (3, n) of M. Roberts' R3 sequence in the unit cube, from number `first` on.

    R3 is the low-discrepancy (Kronecker) sequence of the generalised golden ratio: any stretch of it is the first one,
    shifted, and two consecutive stretches fill the cube as evenly as one of twice the length.
    """
    ratio = 1.2207440846057596  # the real root of x^4 = x + 1
    steps = ratio ** -np.arange(1.0, 4.0)
    points = 0.5 + np.outer(steps, np.arange(first + 1, first + n + 1))
    return points - np.floor(points)  # the remainder, several times faster than %


def _transform(pose: Floats, points: Points) -> Points:
    """Return `points` (3, N) transformed by a pose (4, 4)."""
    return pose[:3, :3] @ points + pose[:3, 3:]
