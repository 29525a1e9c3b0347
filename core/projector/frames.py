"""Frames of one scan: a dynamic study's, one after another, or a gated one's, each with its own activity and times."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import Array, ArrayOrTensor, cast_like
from ..errors import InputError
from ..progress import Progress
from ..rays.linear_operator import LinearOperator
from ..validation import freeze, instance, real_array, shape_text
from .operator import Projector


class FrameProjector(LinearOperator):
    """Images (F, M, n_v, n_u) of the volumes (F, n_x, n_y, n_z) of F frames, and the adjoint.

    Parameters
    ----------
    A : Projector
        A projector of `Emission`, of one frame; the frames have its model, but for the times.
    times
        Durations, s: (F,), or (F, M) where modules measure for different times. Gates of a heart's beat have each its
        share of the whole time.
    starts
        When the frames start, s after the reference time of the activity, of the same shapes; gates all start with the scan.
        None: each with the end of the one before, the first with the model's `start`.

    Raises
    ------
    InputError
        The projector is of another model; times or starts have other shapes, or are not positive.
    """

    _names = ("volumes", "images")

    def __init__(self, A: Projector, times: ArrayLike, starts: ArrayLike | None = None) -> None:
        instance(A, Projector, "frames")
        if not A.model.has_times:
            raise InputError(f"frames: expected a projector of Emission, got one of {A.model.name}")
        model: Any = A.model
        self._A, self._model = A, model
        self.times = _of_frames(times, "frames: times", len(A.views))
        """(F, M), s."""
        if starts is None:
            starts = self._model.start + np.cumsum(self.times, axis=0) - self.times
        self.starts = _of_frames(starts, "frames: starts", len(A.views), len(self))
        """(F, M), s after the reference time."""
        each = [self._of_frame(f).effective_time / np.asarray(self._model.effective_time) for f in range(len(self))]
        self._shares = np.array(each)[..., None, None]

    def __len__(self) -> int:
        return len(self.times)

    @property
    def shape_in(self) -> tuple[int, ...]:
        """Shape of the volumes, (F, n_x, n_y, n_z)."""
        return len(self), *self._A.shape_in

    @property
    def shape_out(self) -> tuple[int, ...]:
        """Shape of the images, (F, M, n_v, n_u)."""
        return len(self), *self._A.shape_out

    def frame(self, f: int) -> Projector:
        """The projector of one frame, for its reconstruction by itself: ``osem(frames.frame(f), counts[f])``."""
        return Projector(self._A.grid, self._A.views, self._of_frame(f), **self._A._settings)

    def _of_frame(self, f: int) -> Any:
        return replace(self._model, time=self.times[f], start=self.starts[f])

    def _run_one(self, x: ArrayOrTensor, progress: Progress | None = None, mu: ArrayOrTensor = None) -> ArrayOrTensor:
        images = self._A._run(x, progress, mu)
        return images * cast_like(self._shares, images)

    def _run_back(self, y: ArrayOrTensor, progress: Progress | None = None, mu: ArrayOrTensor = None) -> ArrayOrTensor:
        return self._A.T._run(y * cast_like(self._shares, y), progress, mu)


def _of_frames(values: ArrayLike, name: str, views: int, frames: int | None = None) -> Array:
    """Numbers of frames, (F,) or (F, M), as (F, M), read-only."""
    given = real_array(values, name, None)
    count = frames or max((1, *given.shape[:1]))
    if given.shape not in ((count,), (count, views)):
        n = "F" if frames is None else frames
        raise InputError(f"{name}: expected shape ({n},) or ({n}, {views}), got {shape_text(given.shape)}")
    return freeze(np.tile(given, (views, 1)).T if given.ndim == 1 else given)
