"""Which noise the images of an event are read with."""

from collections.abc import Collection
from typing import Literal

import numpy as np

from ..arrays import Floats32
from ..errors import InputError
from ..validation import seed_number
from .event_set import COUNTED, Event, EventSet

NoiseChoice = int | Literal["own"] | None
"""None: none, the mean images. "own": the noise that the set gives each event. A number: noise of another seed."""


def checked_noise(noise: object) -> NoiseChoice:
    """`noise` where it is one of a `NoiseChoice`, or `InputError`."""
    if noise is None or noise == "own":
        return noise  # type: ignore[return-value]
    return seed_number(noise, f"noise {noise!r:.40}", "own, or a seed: ")


def chosen_seed(own: int, noise: NoiseChoice) -> int | None:
    """The seed of the noise of an event whose `own` seed is that; None: no noise."""
    if noise is None or noise == "own":
        return own if noise == "own" else None
    return mixed_seed(own, noise)


def mixed_seed(own: int, *others: int) -> int:
    """A seed made of an event's own and others, such as an epoch: events of one seed still have noise each of its own."""
    return int(np.random.SeedSequence((own, *others)).generate_state(1, np.uint64)[0])


def noisy_images(event: Event, model: str, seed: int | None, level: float, out: Floats32 | None = None) -> Floats32:
    """A model's images (M, n_v, n_u): of counts and photons with noise of a seed and a level, others as they are."""
    if event.unit(model) not in COUNTED:
        return event.images(model, out=out)
    return event.images(model, noise_seed=seed, level=level, out=out)


def require_counted(events: EventSet, models: Collection[str]) -> None:
    """Raise `InputError` unless noise changes the images of at least one of these models."""
    if not any(events[0].unit(model) in COUNTED for model in models):
        raise InputError(f"noise: only counts and photons have it, and {', '.join(models) or 'no model'} gives none")
