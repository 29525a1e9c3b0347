"""Measured counts with an additive background: Poisson log-likelihood, checks, and the iteration loop of count methods."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..arrays import Array, ArrayLike, Integers
from ..errors import InputError, warn
from ..geometry.frames import affine_matrix
from ..geometry.grid import Grid
from ..memory import require
from ..progress import Progress, part_of
from ..projector import Projector
from ..validation import instance, real_array, shape_text
from .body_scatter import estimate_scatter, scatter_body
from .loop import Loop, Step, numpy_if_tensor
from .priors import Prior, make_penalty
from .result import Reconstruction

NEGLIGIBLE = np.float32(1e-30)
"""Divisor at or below which a quotient is left out, because float32 could not hold it."""

_UNSEEN = 1e-3  # share of the brightest pixel's counts up to which a pixel sees nothing
_SETTLED = 0.01  # change of the modules' scatter, as a share of it, below which its estimate is final
_CERTAIN_GAIN, _CERTAIN_SHARE = 30.0, 0.015
"""Gain of log-likelihood that chance cannot explain, and the share of the counts that a coarse model cannot explain."""


@dataclass(frozen=True, eq=False)
class CountData:
    """Measured counts, and the background, the part of their expected value that does not come from the volume."""

    counts: Array
    """Measured counts (M, n_v, n_u)."""
    background: Array
    """Expected background counts (M, n_v, n_u)."""

    @classmethod
    def checked(cls, method: str, A: Projector, counts: ArrayLike, background: ArrayLike = 0.0) -> "CountData":
        """Return count data with 0 in dead pixels; raise `InputError` unless they fit the emission projector `A`.

        `counts` are images (M, n_v, n_u) of 0 or more. `background`, 0 or more, is one number, one for each module (M,), or
        images; the background of the projector's model is added to it. `method` names the caller in messages.
        """
        instance(A, Projector, method)
        if A.model.takes != ("activity",):
            raise InputError(f"{method}: expected a projector of emission, got one of {A.model.name}")
        measured = real_array(numpy_if_tensor(counts), "counts", A.shape_out, np.float32)
        _require_nonnegative(measured, "counts")
        extra = real_array(numpy_if_tensor(background), "background", None, np.float32)
        _require_nonnegative(extra, "background")
        if extra.shape == A.shape_out[:1]:
            extra = extra[:, None, None]
        elif extra.shape not in ((), A.shape_out):
            shapes = f"one number, {A.shape_out[0]} numbers or images of {shape_text(A.shape_out)}"
            raise InputError(f"background: expected {shapes}, got {shape_text(extra.shape)}")
        modelled = A.background.astype(np.float32)
        if extra.any() and modelled.any():
            means = f"{extra.mean():.3g} counts per pixel, besides {modelled.mean():.3g} of the projector's model"
            warn(f"background: {means}: the sum is expected; leave one out if both are the same", 4)
        data = cls(measured, extra + modelled).without_dead_pixels(A)
        if A.model.has_times and len(A.views) > 3:  # two or three views say too little
            _warn_if_reversed(A, data)
        return data

    def without_dead_pixels(self, A: Projector) -> "CountData":
        """Return these data with 0 in the pixels that are dead in the model of `A`, where they do not affect the volume."""
        return CountData(*(np.where(A.living, data, np.float32(0)) for data in (self.counts, self.background)))

    def __getitem__(self, modules: Integers) -> "CountData":
        return CountData(self.counts[modules], self.background[modules])

    def ratio(self, images: Array) -> Array:
        """Return ``counts / (images + background)`` (M, n_v, n_u) for a volume with the expected counts `images`.

        The ratio is 0 in pixels without expected counts: counts that neither the volume nor the background can have caused
        say nothing about the volume.
        """
        expected = images + self.background
        return np.divide(self.counts, expected, out=np.zeros_like(expected), where=expected > NEGLIGIBLE)

    def log_likelihood(self, images: Array) -> float:
        """Return ``sum(counts log(e) - e)``, e = images + background: the Poisson log-likelihood but for a constant.

        Counts in pixels without expected counts are left out, as in `ratio`.
        """
        expected = images.astype(np.float64) + self.background
        logs = np.log(expected, out=np.zeros_like(expected), where=expected > NEGLIGIBLE)
        return float(np.sum(self.counts * logs) - expected.sum())


class CountLoop(Loop):
    """Loop of a method for counts: a `Loop` with the counts of each subset of the views and the prior's penalty.

    Parameters
    ----------
    method, A, counts, iterations, prior, background
        See `mlem`.
    subsets : int, optional
        Number of subsets; by default about a fifth of the number of views.
    scatter : str
        Scatter that is estimated, see `mlem`. Volumes change fast at first, therefore the estimates are due after 1, 2, 4,
        8 and so on iterations. They do not depend on where a reconstruction was resumed.
    options, named
        See `IterativeOptions`.

    Attributes
    ----------
    data : CountData
        Counts and background of all views.
    subsets : list of tuples
        Projector and count data of each subset.
    sensitivities : list of arrays (n_x, n_y, n_z)
        Sensitivity ``A_s.T(1)`` of each subset: its counts per unit of activity in each voxel.
    sensitivity : array (n_x, n_y, n_z)
        Sum of the sensitivities.
    visible : array of bool
        Voxels in the mask that some pixel sees.
    penalty : Penalty or None
        Penalty of the prior for pairs of visible voxels; None without a prior.
    last_objective : float
        Value that `objective` returned last; -inf before its first call.
    """

    def __init__(
        self,
        method: str,
        A: Projector,
        counts: ArrayLike,
        iterations: int,
        subsets: int | None,
        prior: Prior | None,
        background: ArrayLike,
        *options: Any,
        scatter: str = "none",
        **named: Any,
    ) -> None:
        super().__init__(method, A, iterations, *options, **named)
        self.data = self._given = CountData.checked(method, A, counts, background)
        self._body = scatter_body(scatter, A)
        if self._resumed and (was := self._resumed.get("scatter", "none")) != scatter:
            advice = "give its volume (--start) to begin with that"
            raise InputError(f"start: this reconstruction is with scatter {was}, now {scatter}: {advice}")
        projectors = A.subsets(max(1, len(A.views) // 5) if subsets is None else subsets)
        self.subsets = [(projector, self.data[projector.which]) for projector in projectors]
        if self._body is not None:
            if 3 in (np.ndim(numpy_if_tensor(background)), np.ndim(A.model.background)):
                warn("scatter: the background holds images, too: leave it out if these are scatter", 3)
            self._add_scatter()
        require(4 * A.grid.n_voxels * len(projectors), f"the sensitivities of {len(projectors)} subsets")
        ones = ((projector, np.ones(projector.shape_out, np.float32)) for projector in projectors)
        self.sensitivities = [np.asarray(projector.T(image, self.preparing()), np.float32) for projector, image in ones]
        self.sensitivity: Array = sum(self.sensitivities[1:], self.sensitivities[0])
        if not self._resumed:
            # Zeros of the start stay in all methods but BSREM.
            self._warn_of_unexplained(self.mask if method == "BSREM" else self.values > 0)
        self.visible = self.mask & (self.sensitivity > NEGLIGIBLE)
        self.prior, self.penalty = prior, make_penalty(prior, A.grid, self.visible)
        self._images: Array | None = None  # of the volume in the last call of `objective`
        self.last_objective = -np.inf

    def _warn_of_unexplained(self, support: Array) -> None:
        """Warn of counts in pixels that do not see the `support`, the voxels that mask and start leave above 0."""
        if support.all() or not support.any():
            return
        sums_seen = np.asarray(self._A(support.astype(np.float32), self.preparing()))
        unseen, excesses = sums_seen <= _UNSEEN * sums_seen.max(), self.data.counts - self.data.background
        excess = excesses[unseen].sum(dtype=float)
        share = excess / max(1.0, excesses.sum(dtype=float))
        if share > 0.01 and excess > 3 * np.sqrt(self.data.counts[unseen].sum(dtype=float)):  # more than chance
            text = f"{100 * share:.3g} % of the counts are in pixels that see no voxel of them above 0"
            warn(f"mask, start: {text}: activity outside, or a background that is not given?", 5)

    def images(self, s: int, values: Array, progress: Progress | None) -> Array:
        """Return the images of a volume in subset `s`; those of the last iteration's volume are not computed again."""
        projector, _ = self.subsets[s]
        if values is self.values and self._images is not None:
            return self._images[projector.which]
        return np.asarray(projector(values, progress))

    def objective(self, values: Array, progress: Progress | None) -> float:
        """Return the log-likelihood of a volume minus the prior's penalty."""
        self._images = self._A(values, progress)
        return self._objective_of(values, self._images)

    def _objective_of(self, values: Array, images: Array) -> float:
        """Return the objective of a volume with these images, and keep it as `last_objective`."""
        likelihood = self.data.log_likelihood(images)
        self.last_objective = likelihood if self.penalty is None else likelihood - self.penalty.value(values)
        return self.last_objective

    def run(self, step: Step, **settings: Any) -> Reconstruction:
        """Do the iterations and return the reconstruction, see `Loop.run`; scatter is estimated before some of them."""
        if self._body is None:
            return super().run(step, **settings)

        def step_with_scatter(number: int, values: Array, progress: Progress | None) -> tuple[Array, float]:
            """Estimate the scatter if it is due, and do the iteration."""
            if number and number & (number - 1) == 0 and self._change >= _SETTLED:
                self._estimate_scatter(values, part_of(progress, 0, 2))
                progress = part_of(progress, 1, 2)
            return step(number, values, progress)

        result = super().run(step_with_scatter, **settings, scatter="body")
        if self._change >= _SETTLED:
            state = f"still changed by {self._change:.1%}" if np.isfinite(self._change) else "was not estimated yet"
            warn(f"scatter: it {state}: do more iterations, or resume", 4)
        return result

    @property
    def _change(self) -> float:
        """Change of the modules' scatter by its last estimate, as a share of it; infinite before the second."""
        return float(self.state.get("scatter_change", np.inf))

    def _estimate_scatter(self, values: Array, progress: Progress | None) -> None:
        """Replace the scatter in the background by that of a volume, whose images the last call of `objective` made."""
        assert self._body is not None and self._images is not None
        expected = float((self._given.counts - self._given.background).sum(dtype=float))
        scatter = estimate_scatter(self._A, *self._body, values, expected, progress)
        if "scatter" in self.state:
            sums, old = (images.sum(axis=(1, 2), dtype=float) for images in (scatter, self.state["scatter"]))
            self.state["scatter_change"] = np.array(np.abs(sums - old).sum() / max(sums.sum(), 1e-30))
        self.state["scatter"] = scatter
        self._add_scatter()
        self._objective_of(values, self._images)

    def _add_scatter(self) -> None:
        """Set the background of all subsets to that which is given and the scatter in the state."""
        scatter = self.state.get("scatter", np.float32(0))
        self.data = replace(self._given, background=self._given.background + scatter).without_dead_pixels(self._A)
        self.subsets = [(projector, self.data[projector.which]) for projector, _ in self.subsets]

    def record(self) -> dict[str, Any]:
        """Return the number of subsets, the sums of counts, background and sensitivity, and the prior's settings."""
        arrays = {"counts": self._given.counts, "background": self._given.background, "sensitivity": self.sensitivity}
        sums = {name: float(numbers.sum(dtype=float)) for name, numbers in arrays.items()}
        return {"subsets": len(self.subsets), **sums} | ({"prior": None} if self.prior is None else self.prior.record())


def _warn_if_reversed(A: Projector, data: CountData) -> None:
    """Warn if the counts are far likelier with the modules in reversed order.

    The log-likelihoods of both orders are compared after one MLEM step with at most 16 modules and 20^3 large voxels.
    """
    # The choice of modules is symmetric, so that it is the same in reversed order.
    modules = np.unique(np.rint(np.linspace(0, len(A.views) - 1, min(len(A.views), 16))).astype(int))
    shape = np.minimum(A.grid.shape, 20)
    step = A.grid.shape / shape
    grid = Grid(tuple(shape), A.grid.affine @ affine_matrix(np.diag(step), (step - 1) / 2))
    B = Projector(grid, A.views[modules], A.model.of_views(modules).coarse(), A.backend, A.threads)
    subset, sensitivity = data[modules], np.maximum(B.T(np.ones(B.shape_out, np.float32)), NEGLIGIBLE)
    n_counts, likelihoods = float(subset.counts.sum(dtype=float)), []
    uniform = np.full(shape, n_counts / sensitivity.sum(dtype=float), np.float32)
    # A small background keeps pixels without expected counts in the likelihood.
    background = subset.background + np.float32(0.01 * n_counts / subset.counts.size)
    for data in (CountData(subset.counts, background), CountData(subset.counts[::-1], background)):
        likelihoods.append(data.log_likelihood(B(uniform / sensitivity * B.T(data.ratio(B(uniform))))))
    if (gain := likelihoods[1] - likelihoods[0]) > max(_CERTAIN_GAIN, _CERTAIN_SHARE * n_counts):
        numbers = f"(log-likelihood {gain:.4g} higher, {n_counts:.4g} counts of {len(modules)} modules)"
        warn(f"counts: likelier with the modules in reversed order {numbers}: are both in the same order?", 5)


def _require_nonnegative(numbers: Array, name: str) -> None:
    """Raise `InputError` with the smallest number and its index unless all numbers are 0 or more."""
    if numbers.min(initial=0.0) < 0:
        index = np.unravel_index(numbers.argmin(), numbers.shape)
        position = f" at index {tuple(int(i) for i in index)}" if index else ""
        raise InputError(f"{name}: expected 0 or more, got {numbers.min():g}{position}")
