"""Priors: penalties of differences between neighbouring voxels, for reconstructions with noise."""

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

# Voxels that are worked on at once: their numbers and some arrays as large stay in a core's cache.
_SLAB_VOXELS = 2**14


@dataclass(frozen=True)
class Pairs:
    """Neighbours in a slab, all the same step apart: their places in it, and the weights of their differences."""

    first: tuple[slice, slice, slice]
    second: tuple[slice, slice, slice]
    closeness: float  # the smallest distance of two voxels by that of these
    share: Bytes | None  # how many of the two have chosen the other by anatomy

    @property
    def weight(self) -> Any:
        """Weight of psi: one number for all, or an array."""
        return self._shared(self.closeness)

    @property
    def squared(self) -> Any:
        """Weight of squares of differences."""
        return self._shared(self.closeness**2)

    def _shared(self, weight: float) -> Any:
        return weight if self.share is None else self.share * np.float32(weight / 2)


@argument("weight", float, "How much the penalty counts beside the data", above=0, slider=1)
@argument("anatomy", str, "Volume across whose edges differences are not penalised, such as a CT", is_path=True)
@dataclass(frozen=True, eq=False)
class Prior:
    """A penalty ``weight * sum over pairs of neighbours of w_jk psi(x_j, x_k)``; `psi` is the subclass's.

    The w_jk are the smallest distance of two voxels divided by that of these two, so that all are 1 or less, and voxels
    that are longer in one direction count less there. Reconstructions count the pairs of voxels that are both in their mask
    and seen.

    Attributes
    ----------
    weight : float
        How much it counts beside the log-likelihood, 0 or more.
    anatomy : Volume, optional
        A volume on the reconstruction's grid, such as a CT or its segments: differences across its edges are not penalised.
        Only those `similar` of each voxel's neighbours count whose anatomical values are closest to its own, and all that
        are as close as the last of these (Bowsher 2004); a pair where only one chose the other counts half.
    similar : int, optional
        By default about a quarter of the neighbours.
    neighbors : int
        6 (those that share a face), or 26: smoother, and four times the work.

    Raises
    ------
    InputError
        A number is negative or not finite, or `anatomy` is no volume.

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
            raise InputError("prior: similar needs anatomy, of which it is")
        if self.similar is not None and whole_number(self.similar, "prior: similar") > self.neighbors:
            raise InputError(f"prior: similar: expected at most the {self.neighbors} neighbors, got {self.similar}")

    def on(self, grid: Grid, inside: Bools | None = None) -> "Penalty":
        """Return the penalty of pairs of voxels `inside` on a grid; raise InputError where `anatomy` has another grid."""
        return Penalty(self, grid, inside)

    def record(self) -> dict[str, Any]:
        """Return the entries of a reconstruction's settings."""
        names = [field.name for field in fields(self) if field.name not in ("anatomy", "similar")]
        known = {"prior": type(self).__name__, **{name: getattr(self, name) for name in names}}
        if self.anatomy is not None:
            known |= {"anatomy": self.anatomy.quantity, "similar": self._similar}
        return known

    @property
    def _similar(self) -> int:
        return self.similar or -(-self.neighbors // 4)

    # `psi` of pairs of neighbours, its derivatives and its second derivatives, by a and by b:

    def _psi(self, a: Array, b: Array) -> Array:
        raise NotImplementedError

    def _slopes(self, a: Array, b: Array) -> tuple[Array, Array]:
        raise NotImplementedError

    def _bends(self, a: Array, b: Array) -> tuple[Any, Any]:
        raise NotImplementedError

    # The penalty of a slab's values, and what adds its gradient and curvature to `out`:

    def _value(self, x: Array, pairs: list[Pairs]) -> float:
        return sum(float(np.sum(p.weight * self._psi(x[p.first], x[p.second]), dtype=float)) for p in pairs)

    def _add_gradient(self, x: Array, pairs: list[Pairs], out: Array) -> None:
        _add(self._slopes, x, pairs, out)

    def _add_curvature(self, x: Array, pairs: list[Pairs], out: Array) -> None:
        _add(self._bends, x, pairs, out)


def _add(of: Callable[[Array, Array], tuple[Any, Any]], x: Array, pairs: list[Pairs], out: Array) -> None:
    for p in pairs:
        by_first, by_second = of(x[p.first], x[p.second])
        out[p.first] += p.weight * by_first
        out[p.second] += p.weight * by_second


@dataclass(frozen=True, eq=False)
class Quadratic(Prior):
    """Penalises squares of differences, ``psi = (x_j - x_k)^2 / 2``: smooth everywhere, and blurs edges."""

    def _psi(self, a: Array, b: Array) -> Array:
        return np.square(a - b) / 2

    def _slopes(self, a: Array, b: Array) -> tuple[Array, Array]:
        difference = a - b
        return difference, -difference

    def _bends(self, a: Array, b: Array) -> tuple[Any, Any]:
        return np.ones_like(a), np.ones_like(a)


@argument("gamma", float, "How much large differences are spared", least=0, slider=10)
@argument("edge", float, "Value below which differences count as noise", "what suits the penalty", above=0, slider=10)
@dataclass(frozen=True, eq=False)
class RelativeDifference(Prior):
    """Penalises differences relative to the values: ``psi = (x_j - x_k)^2 / (x_j + x_k + gamma |x_j - x_k| + edge)``.

    Noise grows with the activity, and so may differences. For values of 0 or more.

    Attributes
    ----------
    gamma : float
        How much large differences are spared: those far above the values divided by `gamma` count linearly. 2 by default, as
        scanners use it; 0 spares none.
    edge : float
        kBq/mL, more than 0: values far below count as if they were this large, so that the penalty is smooth at 0.

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

    def _parts(self, a: Array, b: Array) -> tuple[Array, Array]:
        """Return the difference, and its divisor."""
        difference = a - b
        size = np.abs(difference)
        size *= self.gamma
        size += a
        size += b
        size += self.edge
        return difference, size

    def _psi(self, a: Array, b: Array) -> Array:
        difference, size = self._parts(a, b)
        return difference * difference / size

    def _slopes(self, a: Array, b: Array) -> tuple[Array, Array]:
        difference, size = self._parts(a, b)
        ratio = difference / size
        # (a - b) (size + 2 b + edge) / size^2, and the same with a and b exchanged
        by_a = (2 * b + self.edge) / size
        by_b = (2 * a + self.edge) / size
        by_a += 1
        by_b += 1
        by_a *= ratio
        by_b *= ratio
        return by_a, np.negative(by_b, out=by_b)

    def _bends(self, a: Array, b: Array) -> tuple[Any, Any]:
        cube = self._parts(a, b)[1] ** 3
        return 2 * np.square(2 * b + self.edge) / cube, 2 * np.square(2 * a + self.edge) / cube


@dataclass(frozen=True, eq=False)
class TotalVariation(Prior):
    """Penalises the gradient's size: in each voxel ``sqrt(sum of (w_jk (x_j - x_k))^2 + edge^2) - edge``.

    The sum is over the neighbours on one side, half of all: with 6 neighbours the differences along the three axes. It makes
    areas of one value with sharp edges.

    Attributes
    ----------
    edge : float
        kBq/mL, more than 0: differences far below are penalised as by `Quadratic`, so that the penalty is smooth.

    References
    ----------
    L. I. Rudin, S. Osher, E. Fatemi, "Nonlinear total variation based noise removal algorithms", Physica D 60 (1992)
    259-268.
    """

    edge: float = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "edge", positive(self.edge, "prior: edge", "kBq/mL"))

    def _sizes(self, x: Array, pairs: list[Pairs]) -> Array:
        """Return the lengths of the gradient in the slab's voxels."""
        squares = np.full(x.shape, self.edge**2, x.dtype)
        for p in pairs:
            squares[p.first] += p.squared * np.square(x[p.first] - x[p.second])
        return np.sqrt(squares, out=squares)

    def _value(self, x: Array, pairs: list[Pairs]) -> float:
        return float(np.sum(self._sizes(x, pairs) - self.edge, dtype=float))

    def _add_gradient(self, x: Array, pairs: list[Pairs], out: Array) -> None:
        sizes = self._sizes(x, pairs)
        for p in pairs:
            slope = p.squared * (x[p.first] - x[p.second]) / sizes[p.first]
            out[p.first] += slope
            out[p.second] -= slope

    def _add_curvature(self, x: Array, pairs: list[Pairs], out: Array) -> None:
        sizes = self._sizes(x, pairs)
        for p in pairs:
            bend = p.squared / sizes[p.first]
            out[p.first] += bend
            out[p.second] += bend


class Penalty:
    """A prior on a grid: its value, gradient and curvature for volumes (arrays of the grid's shape).

    Results are of the array's type, float32 or float64; the value is a float. Only pairs count of which both voxels are
    `inside`, as if the grid ended there: what is beyond, such as the zeros outside a mask, pulls at nothing.
    """

    def __init__(self, prior: Prior, grid: Grid, inside: Bools | None = None) -> None:
        self._prior, self._shape, self._threads = prior, grid.shape, thread_count(None)
        self._inside = None if inside is None or inside.all() else inside
        steps = _half_of_neighbors(prior.neighbors)
        lengths = [float(np.linalg.norm(grid.affine[:3, :3] @ step)) for step in steps]
        self._closeness = [min(lengths) / length for length in lengths]
        self._steps = steps
        self._shares = None if prior.anatomy is None else self._similarity(prior.anatomy, grid)

    def value(self, x: Array) -> float:
        """Return the penalty of a volume."""
        found = np.zeros(len(self._slabs()))

        def work(slab: tuple[int, int, int]) -> None:
            number, first, end = slab
            found[number] = self._prior._value(x[first : end + 1], self._pairs(first, end))

        run_all(work, self._slabs(), self._threads)
        return self._prior.weight * float(found.sum())

    def gradient(self, x: Array) -> Array:
        """Return the penalty's derivatives by the voxels' values."""
        return self._summed(self._prior._add_gradient, x)

    def curvature(self, x: Array) -> Array:
        """Return the penalty's second derivatives by each voxel's value; for total variation an upper bound."""
        return self._summed(self._prior._add_curvature, x)

    def _summed(self, add: Callable[[Array, list[Pairs], Array], None], x: Array) -> Array:
        out = np.zeros(x.shape, x.dtype)

        def work(slab: tuple[int, int, int]) -> None:
            _, first, end = slab
            add(x[first : end + 1], self._pairs(first, end), out[first : end + 1])

        # A slab adds to the next one's first plane, too: so no two neighbours at the same time.
        for parity in (0, 1):
            run_all(work, self._slabs()[parity::2], self._threads)
        out *= self._prior.weight
        return out

    def _slabs(self) -> list[tuple[int, int, int]]:
        """Yield number, first plane along x and the plane after the last."""
        n = self._shape[0]
        planes = max(1, _SLAB_VOXELS // (self._shape[1] * self._shape[2]))
        return [(number, first, min(first + planes, n)) for number, first in enumerate(range(0, n, planes))]

    def _pairs(self, first: int, end: int) -> list[Pairs]:
        """Return the pairs whose first voxel is in the planes from `first` to `end`."""
        found = []
        for number, step in enumerate(self._steps):
            planes = min(end, self._shape[0] - step[0]) - first
            ranges = [(slice(0, planes), slice(step[0], step[0] + planes)), *map(_shifted, step[1:])]
            one, other = zip(*ranges, strict=True)
            share = None if self._shares is None else self._shares[number][first : first + planes][:, one[1], one[2]]
            if self._inside is not None:
                slab = self._inside[first : end + 1]
                share = (slab[one] & slab[other]) * (np.uint8(2) if share is None else share)
            found.append(Pairs(one, other, self._closeness[number], share))
        return found

    def _similarity(self, anatomy: Volume, grid: Grid) -> list[Bytes]:
        """Return Bowsher weights per step and voxel: 0, 1 or 2 of the voxel and its neighbour have selected the other."""
        if not same_lattice(anatomy.grid, grid):
            raise InputError("prior: anatomy's grid is not the reconstruction's: resample it (resample(volume, grid))")
        require((len(self._steps) + 8) * grid.n_voxels, "the prior's anatomy")
        known = anatomy.array if self._inside is None else np.where(self._inside, anatomy.array, np.float32(np.inf))
        padded = np.pad(known, 1, constant_values=np.inf)
        limits = np.empty(grid.shape, np.float32)
        both = [sign * np.array(step) for step in self._steps for sign in (1, -1)]
        for _, first, end in self._slabs():
            own = anatomy.array[first:end]
            box = (slice(first, end), slice(0, grid.shape[1]), slice(0, grid.shape[2]))
            differences = np.stack([np.abs(padded[_moved(box, step + 1)] - own) for step in both])
            limits[first:end] = np.partition(differences, self._prior._similar - 1, axis=0)[self._prior._similar - 1]
        shares = []
        for step in self._steps:
            share = np.zeros(grid.shape, np.uint8)
            one, other = zip(*map(_shifted, step), strict=True)
            difference = np.abs(anatomy.array[one] - anatomy.array[other])
            share[one] = (difference <= limits[one]).astype(np.uint8) + (difference <= limits[other])
            shares.append(share)
        return shares


PRIORS: Mapping[str, Choice] = {
    "quadratic": Choice("Quadratic", "Smooth everywhere, edges too", Quadratic),
    "relative-difference": Choice("Relative Difference", "Smooth, but large differences are spared", RelativeDifference),
    "total-variation": Choice("Total Variation", "Areas of one value with sharp edges", TotalVariation),
}  # fmt: skip
"""The priors by their names in recipes and on the command line."""


@argument("prior", str, "Penalty on noise", "none", unset="None", words={
    name: (prior.label, prior.text) for name, prior in PRIORS.items()
})  # fmt: skip
def penalty_of(prior: Prior | None, grid: Grid, inside: Bools) -> Penalty | None:
    """Return the penalty of pairs of voxels inside; None without a prior or weight.

    Raises InputError where it is no prior, or not for the grid.
    """
    if prior is None:
        return None
    if not isinstance(prior, Prior):
        *names, last = (choice.function.__name__ for choice in PRIORS.values())
        raise InputError(f"prior: expected {', '.join(names)} or {last}, got {type(prior).__name__}")
    penalty = prior.on(grid, inside)
    return penalty if prior.weight else None


def _half_of_neighbors(n: int) -> list[tuple[int, int, int]]:
    """Return the steps to one neighbour of each opposite pair; along x 0 or 1."""
    steps = [step for step in product((0, 1), (-1, 0, 1), (-1, 0, 1)) if step > (0, 0, 0)]
    return [step for step in steps if n == 26 or sum(map(abs, step)) == 1]


def _shifted(step: int) -> tuple[slice, slice]:
    """Return the places along an axis that have a neighbour `step` on, and the places of these neighbours."""
    if step < 0:
        return slice(-step, None), slice(None, step)
    return slice(None, -step or None), slice(step, None)


def _moved(box: tuple[slice, slice, slice], step: Any) -> tuple[slice, ...]:
    return tuple(slice(part.start + int(n), part.stop + int(n)) for part, n in zip(box, step, strict=True))
