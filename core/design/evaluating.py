"""Evaluation of a design: reconstructions from independent noise, for the scanner at the start and the one found."""

from typing import NamedTuple, cast

import numpy as np

from ..arrays import Floats
from ..errors import InputError
from ..geometry.system import PinholeSystem
from ..models.emission import Emission
from ..physics.noise import sample_counts
from ..progress import Progress, tell
from ..reconstruction.expectation import osem
from ..reconstruction.scores.images import nrmse
from ..recording import recorded_warnings
from ..scatter.images import scatter_images
from ..volumes.volume import Volume
from .recipe import DesignRecipe

_RESAMPLES = 4000  # of the bootstrap
_PRECISION = 0.01  # of each module's total of scattered photons


class Gain(NamedTuple):
    """Scores of two scanners, and the relative improvement from the first to the second."""

    score: str
    """Name of the score: ``"NRMSE"``, where less is better, or ``"lesion SNR"``, where more is better."""
    start: float
    """Score of the scanner at the start."""
    found: float
    """Score of the scanner that was found."""
    gain: float
    """Relative improvement, such as 0.5 for an SNR that is half as high again."""
    low: float
    """Lower end of the gain's 95 % interval."""
    high: float
    """Upper end of the gain's 95 % interval."""


def evaluate(
    recipe: DesignRecipe, start: PinholeSystem, found: PinholeSystem, progress: Progress | None = None
) -> Gain:
    """Return how much better the scanner `found` is than `start` in the recipe's ``[evaluation]``, at equal scan time.

    Each draw of noise is reconstructed by OSEM for both scanners. The score is the NRMSE of the voxels or, with a lesion,
    the SNR of a template: the lesion's volume, multiplied with the reconstructions with and without lesion and summed. The
    SNR is the difference of the means divided by the root mean variance. The interval is by bootstrap over pairs of draws
    (Efron, Tibshirani 1993, chapter 13). With ``scatter = "body"`` photons are attenuated and scattered by the body's own
    mu, which reconstructions are told. `progress` is called with (reconstructions done, total).
    """
    if recipe["evaluation.body"] is None:
        raise InputError("evaluation.body: missing; name a phantom")
    (body,), lesion = recipe.volumes(recipe["evaluation.body"]), recipe["evaluation.lesion"]
    scenes = [body] if lesion is None else [body, body + recipe.volumes(lesion)[0]]
    mu = None
    if recipe["evaluation.scatter"] == "body":
        (values,) = recipe.volumes(recipe["evaluation.body"], quantity="mu")
        if not values.any():
            raise InputError("evaluation.scatter: the body scatters nothing; give its shapes a mu, or say none")
        mu = Volume(values, recipe.grid(), "mu")
    draws, seed = recipe["evaluation.draws"], recipe["evaluation.seed"]
    osem_settings = recipe["evaluation.iterations"], recipe["evaluation.subsets"]
    readings = np.empty((2, len(scenes), draws))
    for number, (s, i, n) in enumerate(np.ndindex(readings.shape)):
        if n == 0:
            with recorded_warnings():
                A = recipe.projector((start, found)[s], mu=mu)
            background = A.background
            if mu is not None:
                activity, model = Volume(scenes[i], A.grid, "activity"), cast(Emission, A.model)
                background = background + scatter_images(activity, mu, A.views, model, precision=_PRECISION).images[0]
            mean = A(scenes[i]) + background
        counts = sample_counts(mean, seed + number)  # independent noise for each scanner and scene
        volume = osem(A, counts, *osem_settings, background=background).volume.array
        readings[s, i, n] = nrmse(volume, body) if lesion is None else (volume * (scenes[1] - body)).sum()
        tell(progress, number + 1, readings.size)
    return _gain("NRMSE" if lesion is None else "lesion SNR", readings, seed)


def _gain(name: str, readings: Floats, seed: int) -> Gain:
    """Return the gain computed from readings (2, scenes, draws): NRMSE of one scene, or template sums of two scenes."""

    def scores(readings: Floats) -> Floats:
        """Return the score (2,) of each scanner."""
        if readings.shape[1] == 1:
            return readings[:, 0].mean(axis=1)
        deviation = np.sqrt(readings.var(axis=2, ddof=1).mean(axis=1))
        return (readings[:, 1].mean(axis=1) - readings[:, 0].mean(axis=1)) / np.where(deviation > 0, deviation, np.nan)

    def improvement(readings: Floats) -> float:
        """Return the relative improvement from the first to the second scanner."""
        first, second = scores(readings)
        return float(1 - second / first if readings.shape[1] == 1 else second / first - 1)

    rng, n = np.random.default_rng(seed), readings.shape[2]
    resampled = [improvement(readings[:, :, rng.integers(n, size=n)]) for _ in range(_RESAMPLES)]
    low, high = np.nanpercentile(resampled, [2.5, 97.5])
    first, second = scores(readings).tolist()
    return Gain(name, first, second, improvement(readings), float(low), float(high))
