"""Event sets as a `Dataset` of torch. Only this module imports torch with itself: `torch_dataset` imports it when called."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from torch.utils.data import Dataset, default_collate, get_worker_info
from torch.utils.data._utils.collate import default_collate_fn_map

from ..arrays import Floats32
from ..errors import InputError, warn
from .event_set import Event, EventSet
from .exports.slots import Slots
from .noise_choice import chosen_seed, mixed_seed, noisy_images

_New = Callable[[str, Sequence[int]], torch.Tensor]
"""Gives zeros of a shape for a field."""
_PLACE, _LEVEL, _NOISE = range(3)
"""What random numbers are drawn for: so that one does not depend on whether there are others."""


@dataclass(eq=False)
class TorchEvents(Dataset):
    """The events of a set as dicts of tensors; made by `torch_dataset`."""

    events: EventSet
    fields: Mapping[str, tuple[int, ...]]  # shapes
    crops: Mapping[tuple[str, ...], tuple[int | None, ...]]
    random_crops: bool
    noise: Literal["own", "epoch"] | None
    levels: Sequence[float]
    seed: int
    slots: Slots | None
    skip_damaged: bool

    def __post_init__(self) -> None:
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
        return self._read(index, lambda name, shape: _zeros(shape))

    def __getitems__(self, indices: Sequence[int]) -> list["_Item"]:
        """The items of a loader's batch, whose arrays are parts of the batch's already: nothing is copied to join them."""
        joined: dict[str, torch.Tensor] = {}

        def part(count: int) -> _New:
            def new(name: str, shape: Sequence[int]) -> torch.Tensor:
                if name not in joined:
                    joined[name] = _zeros((len(indices), *shape))
                return joined[name][count]

            return new

        return [_Item(self._read(index, part(count)), joined) for count, index in enumerate(indices)]

    def _read(self, index: int, new: "_New") -> dict[str, Any]:
        for place in range(index, index + len(self)):
            event = self.events[place % len(self)]
            taken: list[torch.Tensor] = []

            def zeros(name: str, shape: Sequence[int], taken: list[torch.Tensor] = taken) -> torch.Tensor:
                taken.append(new(name, shape))
                return taken[-1]

            try:
                with event.held() as held:
                    return self._item(held, zeros)
            except InputError as error:
                if not self.skip_damaged:
                    raise
                warn(f"{error}: left out; the next event of the set takes its place")
                for tensor in taken:
                    tensor.zero_()
        raise InputError("no event of the set can be read")

    def _item(self, event: Event, new: "_New") -> dict[str, Any]:
        epoch = self.epoch
        level = float(self._random(event, epoch if self.noise == "epoch" else 0, _LEVEL).choice(self.levels))
        item: dict[str, Any] = {"number": torch.tensor(event.number)}
        if self.noise is not None:
            item["level"] = torch.tensor(level, dtype=torch.float32)
        parts = {name: tuple(slice(0, n) for n in shape) for name, shape in self.fields.items()}
        for count, (names, size) in enumerate(self.crops.items()):
            shape = self.fields[names[0]]
            start = self._start(event, epoch, count, shape, size)
            for name in names:
                cuts = zip(start, size, shape, strict=True)
                parts[name] = tuple(slice(a, length if n is None else a + n) for a, n, length in cuts)
                item[f"{name}_start"] = torch.tensor(start)
        for name, part in parts.items():
            item[name] = new(name, [cut.stop - cut.start for cut in part])
            self._fill(item[name].numpy(), event, epoch, level, name, part, parts.get("truth", ()))
        return item

    def _fill(
        self, out: Floats32, event: Event, epoch: int, level: float, name: str, part: tuple[slice, ...],
        truth: tuple[slice, ...],
    ) -> None:  # fmt: skip
        """Read a field, or a part of it, into zeros."""
        whole = out.shape == self.fields[name]
        model, _, arranged = name.partition("/")
        if name == "truth":
            event.truth_part(part, out)
        elif name == "affine":
            out[...] = event.recipe.grid.affine
            out[:3, 3] += out[:3, :3] @ [cut.start for cut in truth] if truth else 0
        elif name in ("pose", "position", "euler_degrees"):
            out[...] = getattr(event, name)
        elif name.startswith("radon"):  # no model is called so
            out[...] = event.radon(int(name.removeprefix("radon")))[part]
        else:
            into = out if whole and not arranged else None
            images = noisy_images(event, model, self._noise_seed(event, epoch), level, into)
            if into is None:
                out[...] = (self.slots.arranged(images) if arranged and self.slots is not None else images)[part]

    def _noise_seed(self, event: Event, epoch: int) -> int | None:
        if self.noise == "epoch":
            return mixed_seed(event.noise_seed, self.seed, epoch, _NOISE)
        return chosen_seed(event.noise_seed, self.noise)

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


def _zeros(shape: Sequence[int]) -> torch.Tensor:
    """Zeros; of a loader's worker in memory that the loader shares, so that they are not copied there."""
    if get_worker_info() is None:
        return torch.zeros(*shape)
    storage = torch.UntypedStorage._new_shared(4 * math.prod(shape))
    return torch.empty(0, dtype=torch.float32).set_(storage, 0, tuple(shape))


class _Item(dict[str, Any]):
    """An item whose arrays are parts of a batch's."""

    def __init__(self, item: dict[str, Any], joined: dict[str, torch.Tensor]) -> None:
        super().__init__(item)
        self.joined = joined


def _batch(items: list[_Item], *, collate_fn_map: Any = None) -> dict[str, Any]:
    """What a loader makes of the items of `__getitems__`: the arrays are joined, the rest is put together as always."""
    joined = items[0].joined
    rest = default_collate([{name: value for name, value in item.items() if name not in joined} for item in items])
    return {name: joined[name] if name in joined else rest[name] for name in items[0]}


default_collate_fn_map[_Item] = _batch
