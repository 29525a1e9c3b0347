"""Event sets as a `Dataset` of torch. Only this module imports torch with itself: `torch_dataset` imports it when called."""

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import Dataset

from .event_set import Event, EventSet
from .exports.slots import Slots
from .noise_choice import mixed_seed, noisy_images

_PLACE, _LEVEL, _NOISE = range(3)
"""Of random numbers, what for: so that one does not depend on whether there are others."""


class TorchEvents(Dataset):
    """The events of a set as dicts of tensors; made by `torch_dataset`."""

    def __init__(
        self,
        events: EventSet,
        fields: tuple[str, ...],
        crops: Mapping[tuple[str, ...], tuple[int | None, ...]],
        random_crops: bool,
        noise: Literal["own", "epoch"] | None,
        levels: Sequence[float],
        seed: int,
        slots: Slots | None,
    ) -> None:
        self.events, self.fields, self.crops, self.random_crops = events, fields, dict(crops), random_crops
        self.noise, self.levels, self.seed, self.slots = noise, tuple(levels), seed, slots
        # In shared memory, so that the workers that a DataLoader keeps from epoch to epoch see its change.
        self._epoch = torch.zeros((), dtype=torch.int64).share_memory_()

    @property
    def epoch(self) -> int:
        """On which noise of "epoch", random crops and levels depend besides seed and event."""
        return int(self._epoch)

    def set_epoch(self, epoch: int) -> None:
        """Say which epoch begins, a whole number of at least 0; before the loader's iterator is made."""
        self._epoch.fill_(epoch)

    def __len__(self) -> int:
        return len(self.events)

    def __getitem__(self, index: int) -> dict[str, Any]:
        event, epoch = self.events[index], self.epoch
        level = float(self._random(event, epoch if self.noise == "epoch" else 0, _LEVEL).choice(self.levels))
        arrays = {name: self._array(event, epoch, level, name) for name in self.fields}
        item: dict[str, Any] = {"number": torch.tensor(event.number)}
        if self.noise is not None:
            item["level"] = torch.tensor(level, dtype=torch.float32)
        for count, (names, size) in enumerate(self.crops.items()):
            start = self._start(event, epoch, count, arrays[names[0]].shape, size)
            for name in names:
                arrays[name] = arrays[name][tuple(map(_slice, start, size))]
                item[f"{name}_start"] = torch.tensor(start)
            if "truth" in names and "affine" in arrays:
                arrays["affine"] = arrays["affine"].copy()
                arrays["affine"][:3, 3] += arrays["affine"][:3, :3] @ start
        return item | {name: torch.from_numpy(_float32(array)) for name, array in arrays.items()}

    def _array(self, event: Event, epoch: int, level: float, name: str) -> NDArray[Any]:
        if name == "truth":
            return event.truth.array
        if name == "affine":
            return event.recipe.grid.affine
        if name in ("pose", "position", "euler_degrees"):
            return np.asarray(getattr(event, name))
        if name.startswith("radon"):  # no model is called so
            return event.radon(int(name.removeprefix("radon")))
        model, _, arranged = name.partition("/")
        images = noisy_images(event, model, self._noise_seed(event, epoch), level)
        return self.slots.arranged(images) if arranged and self.slots is not None else images

    def _noise_seed(self, event: Event, epoch: int) -> int | None:
        if self.noise is None or self.noise == "own":
            return None if self.noise is None else event.noise_seed
        return mixed_seed(event.noise_seed, self.seed, epoch, _NOISE)

    def _start(
        self, event: Event, epoch: int, count: int, shape: tuple[int, ...], size: tuple[int | None, ...]
    ) -> list[int]:
        """Where a crop begins along each axis."""
        spare = [0 if n is None else length - n for length, n in zip(shape, size, strict=True)]
        if not self.random_crops:
            return [n // 2 for n in spare]
        generator = self._random(event, epoch, _PLACE, count)
        return [int(generator.integers(n + 1)) for n in spare]

    def _random(self, event: Event, epoch: int, *what: int) -> np.random.Generator:
        return np.random.default_rng(mixed_seed(event.noise_seed, self.seed, epoch, *what))


def _slice(start: int, size: int | None) -> slice:
    return slice(None) if size is None else slice(start, start + size)


def _float32(array: NDArray[Any]) -> NDArray[np.float32]:
    """A copy that torch may keep: of one piece, writable."""
    return np.array(array, np.float32, order="C")
