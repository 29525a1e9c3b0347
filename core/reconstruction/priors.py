"""Priors: penalties on differences between neighbouring voxels, for reconstructions from noisy data."""

from collections.abc import Callable, Mapping
from dataclasses import KW_ONLY, dataclass, fields
from itertools import product
from typing import Any, Literal

import numpy as np

from ..arrays import Array, Bools, Bytes
from ..errors import InputError
from ..geometry.grid import Grid
from ..memory import require
from ..rays.lattices import same_lattice
from ..rays.parallel import run_all, thread_count
from ..validation import at_least_0, instance, one_of, positive, whole_number
from ..volumes.volume import Volume
from .arguments import Choice, argument

# Voxels of a slab of the volume: the slab's values and some arrays of the same size stay in a core's cache.
_SLAB_VOXELS = 2**14

_Derivative = Callable[[Array, Array], tuple[Any, Any]]
"""Function of the values of pairs of voxels that returns derivatives of psi with respect to both."""


@dataclass(frozen=True)
class Pairs:
    """Pairs of neighbouring voxels in a slab, all with the same step between them, and the weights of their differences."""

    first: tuple[slice, slice, slice]
    """Slices of the slab with the pairs' first voxels."""
    second: tuple[slice, slice, slice]
    """Slices of the slab with the pairs' second voxels."""
    closeness: float
    """Smallest distance of two neighbouring voxels divided by the distance of these neighbours."""
    selections: Bytes | None
    """Number of voxels of each pair, 0 to 2, that select the other by anatomy; None if all pairs have full weight."""

    @property
    def weight(self) -> Any:
        """Weight of psi: a number for all pairs, or an array with one weight for each pair."""
        return self._selected(self.closeness)

    @property
    def squared_weight(self) -> Any:
        """Weight of squared differences: a number for all pairs, or an array with one weight for each pair."""
        return self._selected(self.closeness**2)

    def _selected(self, weight: float) -> Any:
        """Return `weight` times half the number of selections of each pair."""
        return weight if self.selections is None else self.selections * np.float32(weight / 2)


@argument("weight", float, "Weight of the penalty relative to the data", above=0, slider=1)
@argument("anatomy", str, "Volume across whose edges differences are not penalised, such as a CT", is_path=True)
@dataclass(frozen=True, eq=False)
class Prior:
    """Penalty ``weight * sum over pairs of neighbours of w_jk psi(x_j, x_k)``; subclasses define `psi`.

    The weight w_jk is the smallest distance of two voxels divided by the distance of voxels j and k, at most 1: differences
    along the longer edges of voxels have less weight. Reconstructions penalise the pairs of voxels that are both in their
    mask and visible to a pixel.

    Attributes
    ----------
    weight : float
        Weight of the penalty relative to the log-likelihood, 0 or more.
    anatomy : Volume, optional
        Volume on the reconstruction's grid, such as a CT or its segments, across whose edges differences are not penalised.
        Each voxel selects the `similar` neighbours whose anatomical values are closest to its own value, and all that are as
        close as the last of these (Bowsher 2004). A pair has its full weight if both voxels select each other, half the
        weight if one selects the other, otherwise none.
    similar : int, optional
        Number of neighbours that a voxel selects; by default about a quarter of the neighbours.
    neighbors : int
        Number of neighbours of a voxel: 6 (with a common face), or 26, which is smoother and takes four times as long.

    Raises
    ------
    InputError
        A number is negative or not finite, or `anatomy` is not a volume.

    References
    ----------
    J. E. Bowsher et al., "Utilizing MRI information to estimate F18-FDG distributions in rat flank tumors", IEEE Nuclear
    Science Symposium Conference Record (2004) 2488-2492.
    """

    weight: float
    _: KW_ONLY
    anatomy: Volume | None = None
    similar: int | None = None
    neighbors: Literal[6, 26] = 6

    def __post_init__(self) -> None:
        object.__setattr__(self, "weight", at_least_0(self.weight, "prior: weight"))
        one_of(self.neighbors, (6, 26), "prior: neighbors")
        if self.anatomy is not None:
            instance(self.anatomy, Volume, "prior: anatomy")
        elif self.similar is not None:
            raise InputError("prior: similar needs anatomy, got none")
        if self.similar is not None and whole_number(self.similar, "prior: similar") > self.neighbors:
            raise InputError(f"prior: similar: expected at most the {self.neighbors} neighbors, got {self.similar}")

    def on(self, grid: Grid, inside: Bools | None = None) -> "Penalty":
        """Return the penalty for volumes on a grid, of pairs of voxels `inside`; by default of all pairs.

        Raise `InputError` if `anatomy` has another grid.
        """
        return Penalty(self, grid, inside)

    def record(self) -> dict[str, Any]:
        """Return the prior's name and numbers as entries of a reconstruction's settings."""
        names = [field.name for field in fields(self) if field.name not in ("anatomy", "similar")]
        settings = {"prior": type(self).__name__, **{name: getattr(self, name) for name in names}}
        if self.anatomy is not None:
            settings |= {"anatomy": self.anatomy.quantity, "similar": self._similar}
        return settings

    @property
    def _similar(self) -> int:
        """Number of neighbours that a voxel selects by anatomy."""
        return self.similar or -(-self.neighbors // 4)

    def _psi(self, a: Array, b: Array) -> Array:
        """Return psi(a, b) for pairs of neighbouring values."""
        raise NotImplementedError

    def _first_derivatives(self, a: Array, b: Array) -> tuple[Array, Array]:
        """Return the derivatives of psi(a, b) with respect to a and to b."""
        raise NotImplementedError

    def _second_derivatives(self, a: Array, b: Array) -> tuple[Any, Any]:
        """Return the second derivatives of psi(a, b) with respect to a and to b."""
        raise NotImplementedError

    def _value(self, x: Array, pairs: list[Pairs]) -> float:
        """Return the unweighted penalty of the pairs in the slab x."""
        return sum(float(np.sum(p.weight * self._psi(x[p.first], x[p.second]), dtype=float)) for p in pairs)

    def _add_gradient(self, x: Array, pairs: list[Pairs], out: Array) -> None:
        """Add the gradient of `_value` to `out`, an array of the shape of the slab x."""
        _add_derivatives(self._first_derivatives, x, pairs, out)

    def _add_curvature(self, x: Array, pairs: list[Pairs], out: Array) -> None:
        """Add the second derivatives of `_value` with respect to each voxel to `out`, an array of the slab's shape."""
        _add_derivatives(self._second_derivatives, x, pairs, out)


def _add_derivatives(derive: _Derivative, x: Array, pairs: list[Pairs], out: Array) -> None:
    """Add the weighted derivatives ``derive(a, b)`` of psi, by both voxels of each pair in the slab x, to `out`."""
    for p in pairs:
        d_first, d_second = derive(x[p.first], x[p.second])
        out[p.first] += p.weight * d_first
        out[p.second] += p.weight * d_second


@dataclass(frozen=True, eq=False)
class Quadratic(Prior):
    """Quadratic penalty on differences, ``psi = (x_j - x_k)^2 / 2``, which smooths noise and edges alike."""

    def _psi(self, a: Array, b: Array) -> Array:
        """Return psi = (a - b)^2 / 2 of neighbouring values."""
        return np.square(a - b) / 2

    def _first_derivatives(self, a: Array, b: Array) -> tuple[Array, Array]:
        """Return d psi / da and d psi / db."""
        difference = a - b
        return difference, -difference

    def _second_derivatives(self, a: Array, b: Array) -> tuple[Any, Any]:
        """Return d^2 psi / da^2 and d^2 psi / db^2."""
        return np.ones_like(a), np.ones_like(a)


@argument("gamma", float, "Edge preservation: larger values penalise large differences less", least=0, slider=10)
@argument("edge", float, "Value below which differences are treated as noise", "what suits the penalty",
          above=0, slider=10)  # fmt: skip
@dataclass(frozen=True, eq=False)
class RelativeDifference(Prior):
    """Penalty on differences relative to the values: ``psi = (x_j - x_k)^2 / (x_j + x_k + gamma |x_j - x_k| + edge)``.

    As noise grows with the activity, larger differences are allowed at larger values. Values must be 0 or more.

    Attributes
    ----------
    gamma : float
        Edge preservation: differences far above the values divided by `gamma` are penalised linearly instead of
        quadratically. By default 2, as in clinical scanners; 0 preserves no edges.
    edge : float
        Smallest scale of values, kBq/mL, more than 0, which makes the penalty smooth where both values are near 0.

    References
    ----------
    J. Nuyts, D. Beque, P. Dupont, L. Mortelmans, "A concave prior penalizing relative differences for
    maximum-a-posteriori reconstruction in emission tomography", IEEE Transactions on Nuclear Science 49 (2002) 56-60.
    """

    gamma: float = 2.0
    edge: float = 0.1

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "gamma", at_least_0(self.gamma, "prior: gamma"))
        object.__setattr__(self, "edge", positive(self.edge, "prior: edge", "kBq/mL"))

    def _fraction(self, a: Array, b: Array) -> tuple[Array, Array]:
        """Return the difference a - b and psi's denominator, a + b + gamma |a - b| + edge."""
        difference = a - b
        denominator = np.abs(difference)
        denominator *= self.gamma
        denominator += a
        denominator += b
        denominator += self.edge
        return difference, denominator

    def _psi(self, a: Array, b: Array) -> Array:
        """Return psi of neighbouring values a and b."""
        difference, denominator = self._fraction(a, b)
        return difference * difference / denominator

    def _first_derivatives(self, a: Array, b: Array) -> tuple[Array, Array]:
        """Return d psi / da and d psi / db."""
        difference, denominator = self._fraction(a, b)
        ratio = difference / denominator
        # With D the denominator, d psi/da = (a - b) (D + 2 b + edge) / D^2; d psi/db is its negative with a and b exchanged.
        d_a = (2 * b + self.edge) / denominator
        d_b = (2 * a + self.edge) / denominator
        d_a += 1
        d_b += 1
        d_a *= ratio
        d_b *= ratio
        return d_a, np.negative(d_b, out=d_b)

    def _second_derivatives(self, a: Array, b: Array) -> tuple[Any, Any]:
        """Return d^2 psi / da^2 and d^2 psi / db^2."""
        cube = self._fraction(a, b)[1] ** 3
        return 2 * np.square(2 * b + self.edge) / cube, 2 * np.square(2 * a + self.edge) / cube


@dataclass(frozen=True, eq=False)
class TotalVariation(Prior):
    """Penalty on the gradient's length: the sum over voxels of ``sqrt(sum of (w_jk (x_j - x_k))^2 + edge^2) - edge``.

    The sum in the root is over one neighbour of each opposite pair: with 6 neighbours the differences along the three axes.
    The penalty favours uniform areas with sharp edges.

    Attributes
    ----------
    edge : float
        Scale of differences, kBq/mL, more than 0: far below it the penalty is quadratic, and thus smooth.

    References
    ----------
    L. I. Rudin, S. Osher, E. Fatemi, "Nonlinear total variation based noise removal algorithms", Physica D 60 (1992)
    259-268.
    """

    edge: float = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "edge", positive(self.edge, "prior: edge", "kBq/mL"))

    def _gradient_lengths(self, x: Array, pairs: list[Pairs]) -> Array:
        """Return ``sqrt(sum of (w_jk (x_j - x_k))^2 + edge^2)`` in the voxels of the slab x."""
        squares = np.full(x.shape, self.edge**2, x.dtype)
        for p in pairs:
            squares[p.first] += p.squared_weight * np.square(x[p.first] - x[p.second])
        return np.sqrt(squares, out=squares)

    def _value(self, x: Array, pairs: list[Pairs]) -> float:
        return float(np.sum(self._gradient_lengths(x, pairs) - self.edge, dtype=float))

    def _add_gradient(self, x: Array, pairs: list[Pairs], out: Array) -> None:
        lengths = self._gradient_lengths(x, pairs)
        for p in pairs:
            derivative = p.squared_weight * (x[p.first] - x[p.second]) / lengths[p.first]
            out[p.first] += derivative
            out[p.second] -= derivative

    def _add_curvature(self, x: Array, pairs: list[Pairs], out: Array) -> None:
        lengths = self._gradient_lengths(x, pairs)
        for p in pairs:
            curvature = p.squared_weight / lengths[p.first]
            out[p.first] += curvature
            out[p.second] += curvature


class Penalty:
    """Penalty of a prior on a grid, with its gradient and curvature, for volumes as arrays of the grid's shape.

    Gradient and curvature have the volume's type, float32 or float64. Only pairs with both voxels `inside` are penalised, as
    if the grid ended there: values beyond, such as the zeros outside a mask, have no influence.
    """

    def __init__(self, prior: Prior, grid: Grid, inside: Bools | None = None) -> None:
        self._prior, self._shape, self._threads = prior, grid.shape, thread_count(None)
        self._inside = None if inside is None or inside.all() else inside
        self._steps = _half_of_neighbors(prior.neighbors)
        lengths = [float(np.linalg.norm(grid.affine[:3, :3] @ step)) for step in self._steps]
        self._closeness = [min(lengths) / length for length in lengths]
        self._selections = None if prior.anatomy is None else self._bowsher_selections(prior.anatomy, grid)

    def value(self, x: Array) -> float:
        """Return the penalty of the volume x."""
        values = np.zeros(len(self._slabs()))

        def work(slab: tuple[int, int, int]) -> None:
            """Add a slab's part of the penalty's value."""
            number, first, end = slab
            values[number] = self._prior._value(x[first : end + 1], self._pairs(first, end))

        run_all(work, self._slabs(), self._threads)
        return self._prior.weight * float(values.sum())

    def gradient(self, x: Array) -> Array:
        """Return the derivatives of the penalty with respect to the voxels of x."""
        return self._sum_over_slabs(self._prior._add_gradient, x)

    def curvature(self, x: Array) -> Array:
        """Return the second derivatives of the penalty with respect to each voxel; upper bounds for total variation."""
        return self._sum_over_slabs(self._prior._add_curvature, x)

    def _sum_over_slabs(self, add: Callable[[Array, list[Pairs], Array], None], x: Array) -> Array:
        """Return the weighted sum of the arrays that ``add(slab, pairs, out)`` adds to `out` for each slab of x."""
        out = np.zeros(x.shape, x.dtype)

        def work(slab: tuple[int, int, int]) -> None:
            """Add a slab's part of the sum."""
            _, first, end = slab
            add(x[first : end + 1], self._pairs(first, end), out[first : end + 1])

        # A slab also adds to the first plane of the next slab, so neighbouring slabs must not run at the same time.
        for parity in (0, 1):
            run_all(work, self._slabs()[parity::2], self._threads)
        out *= self._prior.weight
        return out

    def _slabs(self) -> list[tuple[int, int, int]]:
        """Return index, first plane along x and end plane (exclusive) of each slab."""
        n = self._shape[0]
        planes = max(1, _SLAB_VOXELS // (self._shape[1] * self._shape[2]))
        return [(number, first, min(first + planes, n)) for number, first in enumerate(range(0, n, planes))]

    def _pairs(self, first: int, end: int) -> list[Pairs]:
        """Return the pairs, one `Pairs` for each step, whose first voxel is in the planes from `first` to `end`."""
        all_pairs = []
        for number, step in enumerate(self._steps):
            planes = min(end, self._shape[0] - step[0]) - first
            ranges = [(slice(0, planes), slice(step[0], step[0] + planes)), *map(_neighbor_slices, step[1:])]
            a, b = zip(*ranges, strict=True)
            counts = None if self._selections is None else self._selections[number]
            selections = None if counts is None else counts[first : first + planes][:, a[1], a[2]]
            if self._inside is not None:
                slab = self._inside[first : end + 1]
                selections = (slab[a] & slab[b]) * (np.uint8(2) if selections is None else selections)
            all_pairs.append(Pairs(a, b, self._closeness[number], selections))
        return all_pairs

    def _bowsher_selections(self, anatomy: Volume, grid: Grid) -> list[Bytes]:
        """Return for each step an array (n_x, n_y, n_z): how many of a voxel and its neighbour, 0 to 2, select the other."""
        if not same_lattice(anatomy.grid, grid):
            raise InputError("prior: anatomy's grid is not the reconstruction's: resample it (resample(volume, grid))")
        require((len(self._steps) + 8) * grid.n_voxels, "the prior's anatomy")
        # Voxels outside are infinitely different, so that none selects them.
        values = anatomy.array if self._inside is None else np.where(self._inside, anatomy.array, np.float32(np.inf))
        padded = np.pad(values, 1, constant_values=np.inf)
        limits = np.empty(grid.shape, np.float32)  # largest difference at which a voxel selects a neighbour
        steps = [sign * np.array(step) for step in self._steps for sign in (1, -1)]
        for _, first, end in self._slabs():
            box = (slice(first, end), slice(0, grid.shape[1]), slice(0, grid.shape[2]))
            differences = np.stack([np.abs(padded[_moved(box, s + 1)] - anatomy.array[first:end]) for s in steps])
            limits[first:end] = np.partition(differences, self._prior._similar - 1, axis=0)[self._prior._similar - 1]
        selections = []
        for step in self._steps:
            number = np.zeros(grid.shape, np.uint8)
            a, b = zip(*map(_neighbor_slices, step), strict=True)
            difference = np.abs(anatomy.array[a] - anatomy.array[b])
            number[a] = (difference <= limits[a]).astype(np.uint8) + (difference <= limits[b])
            selections.append(number)
        return selections


PRIORS: Mapping[str, Choice] = {
    "quadratic": Choice("Quadratic", "Smooths noise and edges alike", Quadratic),
    "relative-difference": Choice("Relative Difference", "Smooths noise, preserves large differences", RelativeDifference),
    "total-variation": Choice("Total Variation", "Favours uniform areas with sharp edges", TotalVariation),
}  # fmt: skip
"""Priors by their names in recipes and on the command line."""


@argument("prior", str, "Penalty on noise", "none", unset="None", words={
    name: (prior.label, prior.text) for name, prior in PRIORS.items()
})  # fmt: skip
def make_penalty(prior: Prior | None, grid: Grid, inside: Bools) -> Penalty | None:
    """Return the penalty of the pairs of voxels `inside`; None without a prior or with weight 0.

    Raise `InputError` if `prior` is not a prior, or its anatomy has another grid.
    """
    if prior is None:
        return None
    if not isinstance(prior, Prior):
        *names, last = (choice.function.__name__ for choice in PRIORS.values())
        raise InputError(f"prior: expected {', '.join(names)} or {last}, got {type(prior).__name__}")
    penalty = prior.on(grid, inside)
    return penalty if prior.weight else None


def _half_of_neighbors(n: int) -> list[tuple[int, int, int]]:
    """Return the index steps (x, y, z) to one neighbour of each opposite pair; the step along x is 0 or 1."""
    steps = [step for step in product((0, 1), (-1, 0, 1), (-1, 0, 1)) if step > (0, 0, 0)]
    return [step for step in steps if n == 26 or sum(map(abs, step)) == 1]


def _neighbor_slices(step: int) -> tuple[slice, slice]:
    """Return the slice of an axis with the voxels that have a neighbour `step` voxels on, and that of the neighbours."""
    if step < 0:
        return slice(-step, None), slice(None, step)
    return slice(None, -step or None), slice(step, None)


def _moved(box: tuple[slice, slice, slice], step: Any) -> tuple[slice, ...]:
    """Return the slices `box` moved by `step` (3,) voxels."""
    return tuple(slice(axis.start + int(n), axis.stop + int(n)) for axis, n in zip(box, step, strict=True))
