"""Frames of one scan: of a dynamic study, one after another, or of a gated one; each has its own activity and times."""

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
    """Linear map from the volumes (F, n_x, n_y, n_z) of F frames to their images (F, M, n_v, n_u), and its adjoint.

    Parameters
    ----------
    A : Projector
        Projector of `Emission` for one frame; the model of each frame is its model with other times.
    times
        Durations, s: (F,), or (F, M) where modules measure for different times. Each gate of a heart's beat has its share of
        the scan's time.
    starts
        Starts of the frames, s after the reference time of the activity, of the same shapes; gates all start with the scan.
        None: each frame starts when the frame before ends, the first with the model's `start`.

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
        self.times = _frame_numbers(times, "frames: times", len(A.views))
        """Durations (F, M), s."""
        if starts is None:
            starts = self._model.start + np.cumsum(self.times, axis=0) - self.times
        self.starts = _frame_numbers(starts, "frames: starts", len(A.views), len(self))
        """Starts (F, M), s after the reference time."""
        time = np.asarray(self._model.effective_time)
        ratios = [self._frame_model(f).effective_time / time for f in range(len(self))]
        self._count_ratios = np.array(ratios)[..., None, None]

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
        """Return the projector of one frame, for its reconstruction by itself: ``osem(frames.frame(f), counts[f])``."""
        return Projector(self._A.grid, self._A.views, self._frame_model(f), **self._A._settings)

    def _frame_model(self, f: int) -> Any:
        """Return the model of frame f."""
        return replace(self._model, time=self.times[f], start=self.starts[f])

    def _run_one(self, x: ArrayOrTensor, progress: Progress | None = None, mu: ArrayOrTensor = None) -> ArrayOrTensor:
        """Return the images (F, M, n_v, n_u) of the frames' volumes (F, n_x, n_y, n_z)."""
        images = self._A._run(x, progress, mu)
        return images * cast_like(self._count_ratios, images)

    def _run_back(self, y: ArrayOrTensor, progress: Progress | None = None, mu: ArrayOrTensor = None) -> ArrayOrTensor:
        """Return the adjoint (F, n_x, n_y, n_z) of the frames' images (F, M, n_v, n_u)."""
        return self._A.T._run(y * cast_like(self._count_ratios, y), progress, mu)


def _frame_numbers(values: ArrayLike, name: str, views: int, frames: int | None = None) -> Array:
    """Return numbers of frames, (F,) or (F, M), as (F, M), read-only; raise `InputError` for another shape."""
    array = real_array(values, name, None)
    count = frames or max((1, *array.shape[:1]))
    if array.shape not in ((count,), (count, views)):
        n = "F" if frames is None else frames
        raise InputError(f"{name}: expected shape ({n},) or ({n}, {views}), got {shape_text(array.shape)}")
    return freeze(np.tile(array, (views, 1)).T if array.ndim == 1 else array)
