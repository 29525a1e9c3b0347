"""What a design gains: reconstructions of independent noise by the scanner that it began with, and by itself."""

from typing import NamedTuple

import numpy as np

from ..arrays import Floats
from ..errors import InputError
from ..geometry.system import PinholeSystem
from ..physics.noise import sample_counts
from ..progress import Progress, tell
from ..reconstruction.expectation import osem
from ..reconstruction.scores.images import nrmse
from ..recording import recorded_warnings
from .recipe import DesignRecipe

_RESAMPLES = 4000


class Gain(NamedTuple):
    """Scores of both scanners, and by which share the second is better, with its 95 % interval."""

    score: str
    """``"NRMSE"``, less is better, or ``"lesion SNR"``, more is better."""
    start: float
    found: float
    gain: float
    low: float
    high: float


def evaluate(
    recipe: DesignRecipe, start: PinholeSystem, found: PinholeSystem, progress: Progress | None = None
) -> Gain:
    """How much better a scanner is than another in the recipe's ``[evaluation]``, at equal scan time.

    Each draw of noise is reconstructed by OSEM for both. The score is the voxels' NRMSE; or, of a lesion, the SNR of what a
    template of it reads from volumes with and without it: the difference of the means by the root mean variance. The
    interval is by bootstrap over the draws, in pairs (Efron, Tibshirani 1993, chapter 13).
    """
    if recipe["evaluation.body"] is None:
        raise InputError("evaluation.body: missing; name a phantom")
    (body,), lesion = recipe.volumes(recipe["evaluation.body"]), recipe["evaluation.lesion"]
    scenes = [body] if lesion is None else [body, body + recipe.volumes(lesion)[0]]
    draws, seed = recipe["evaluation.draws"], recipe["evaluation.seed"]
    updates = recipe["evaluation.iterations"], recipe["evaluation.subsets"]
    readings = np.empty((2, len(scenes), draws))
    for done, (s, i, n) in enumerate(np.ndindex(readings.shape)):
        if n == 0:
            with recorded_warnings():
                A = recipe.projector((start, found)[s])
            mean = A(scenes[i]) + A.background
        counts = sample_counts(mean, seed + done)  # each scanner and each scene has noise of its own
        volume = osem(A, counts, *updates, background=A.background).volume.array
        readings[s, i, n] = nrmse(volume, body) if lesion is None else (volume * (scenes[1] - body)).sum()
        tell(progress, done + 1, readings.size)
    return _gain("NRMSE" if lesion is None else "lesion SNR", readings, seed)


def _gain(name: str, readings: Floats, seed: int) -> Gain:
    """The gain told by readings (2, scenes, draws) of both scanners."""

    def scores(some: Floats) -> Floats:
        if some.shape[1] == 1:
            return some[:, 0].mean(axis=1)
        spread = np.sqrt(some.var(axis=2, ddof=1).mean(axis=1))
        return (some[:, 1].mean(axis=1) - some[:, 0].mean(axis=1)) / np.where(spread > 0, spread, np.nan)

    def better(some: Floats) -> float:
        first, second = scores(some)
        return float(1 - second / first if some.shape[1] == 1 else second / first - 1)

    draw, n = np.random.default_rng(seed), readings.shape[2]
    found = [better(readings[:, :, draw.integers(n, size=n)]) for _ in range(_RESAMPLES)]
    low, high = np.nanpercentile(found, [2.5, 97.5])
    first, second = scores(readings).tolist()
    return Gain(name, first, second, better(readings), float(low), float(high))
