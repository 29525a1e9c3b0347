"""Choice of the noise with which the images of an event are read."""

from collections.abc import Collection
from typing import Literal

import numpy as np

from ..arrays import Floats32
from ..errors import InputError
from ..validation import seed_number
from .event_set import COUNTED, Event, EventSet

NoiseChoice = int | Literal["own"] | None
"""Noise of the images: None for expected means, "own" for the seed stored in each event, or another seed."""


def checked_noise(noise: object) -> NoiseChoice:
    """Return `noise` if it is a valid `NoiseChoice`, or raise `InputError`."""
    if noise is None or noise == "own":
        return noise  # type: ignore[return-value]
    return seed_number(noise, f"noise {noise!r:.40}", "own, or a seed: ")


def chosen_seed(event_seed: int, noise: NoiseChoice) -> int | None:
    """Return the noise seed of an event whose stored seed is `event_seed`; None for no noise."""
    if noise is None or noise == "own":
        return event_seed if noise == "own" else None
    return mixed_seed(event_seed, noise)


def mixed_seed(event_seed: int, *numbers: int) -> int:
    """Return a seed mixed from an event's stored seed and other numbers, such as a seed and an epoch.

    Events therefore have independent noise although the other numbers are the same for all.
    """
    return int(np.random.SeedSequence((event_seed, *numbers)).generate_state(1, np.uint64)[0])


def noisy_images(event: Event, model: str, seed: int | None, level: float, out: Floats32 | None = None) -> Floats32:
    """Return a model's images (M, n_v, n_u): counts and photons at a level, with noise of a seed; others as stored."""
    if event.unit(model) not in COUNTED:
        return event.images(model, out=out)
    return event.images(model, noise_seed=seed, level=level, out=out)


def require_counted(events: EventSet, models: Collection[str]) -> None:
    """Raise `InputError` unless at least one of these models has images of counts or photons, which have noise."""
    if not any(events[0].unit(model) in COUNTED for model in models):
        raise InputError(f"noise: only counts and photons have it, and {', '.join(models) or 'no model'} gives none")
