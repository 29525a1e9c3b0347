"""Event sets as a `Dataset` of torch. This module alone imports torch on import; `torch_dataset` imports it when called."""

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

_Allocator = Callable[[str, Sequence[int]], torch.Tensor]
"""Function (field, shape) that returns a tensor of zeros."""
_POSITION, _LEVEL, _NOISE = range(3)
"""Purposes of random numbers: the numbers for one purpose do not depend on whether others are drawn."""


@dataclass(eq=False)
class TorchEvents(Dataset):
    """Dataset of the events of a set as dicts of tensors; `torch_dataset` makes it and describes the arguments."""

    events: EventSet
    """Events of the dataset."""
    fields: Mapping[str, tuple[int, ...]]
    """Shapes of the fields, uncropped, by name."""
    crops: Mapping[tuple[str, ...], tuple[int | None, ...]]
    """Sizes of crops, None for a whole axis, by the fields that are cropped together."""
    random_crops: bool
    """Whether crops are at random positions, not at the centre."""
    noise: Literal["own", "epoch"] | None
    """Noise of the images: of each event's own seed, new in each epoch, or none."""
    levels: Sequence[float]
    """Fractions of the acquisition time, of which one is drawn for each event."""
    seed: int
    """Seed of random crops, levels and the noise "epoch"."""
    slots: Slots | None
    """Order of the images in fields "NAME/slots"; None where there is no such field."""
    skip_damaged: bool
    """Whether the next event replaces one that cannot be read."""

    def __post_init__(self) -> None:
        # The epoch is in shared memory, so that workers that a DataLoader keeps between epochs see its change.
        self._epoch = torch.zeros((), dtype=torch.int64).share_memory_()

    @property
    def epoch(self) -> int:
        """The epoch, on which the noise "epoch", random crops and levels depend besides seed and event."""
        return int(self._epoch)

    def set_epoch(self, epoch: int) -> None:
        """Set the epoch, a whole number of at least 0, before the loader's iterator is made."""
        self._epoch.fill_(epoch)

    def __len__(self) -> int:
        return len(self.events)

    def __getitem__(self, index: int) -> dict[str, Any]:
        return self._read_item(index, lambda name, shape: _allocate_zeros(shape))

    def __getitems__(self, indices: Sequence[int]) -> list["_Item"]:
        """Return the items of a loader's batch as views of the batch's arrays, so that nothing is copied to collate them."""
        batch: dict[str, torch.Tensor] = {}

        def item_allocator(position: int) -> _Allocator:
            """Return an allocator that gives views of the batch's arrays at a position in the batch."""

            def allocate(name: str, shape: Sequence[int]) -> torch.Tensor:
                """Return the item's tensor for a field within the batch's array."""
                if name not in batch:
                    batch[name] = _allocate_zeros((len(indices), *shape))
                return batch[name][position]

            return allocate

        return [_Item(self._read_item(index, item_allocator(n)), batch) for n, index in enumerate(indices)]

    def _read_item(self, index: int, allocate: _Allocator) -> dict[str, Any]:
        """Read the item at `index` into allocated tensors, or the next item that can be read with `skip_damaged`."""
        for position in range(index, index + len(self)):
            event = self.events[position % len(self)]
            tensors: list[torch.Tensor] = []

            def new_tensor(name: str, shape: Sequence[int], tensors: list[torch.Tensor] = tensors) -> torch.Tensor:
                """Allocate a tensor and note it, so that it can be zeroed where the event cannot be read."""
                tensors.append(allocate(name, shape))
                return tensors[-1]

            try:
                with event.held() as open_event:
                    return self._item(open_event, new_tensor)
            except InputError as error:
                if not self.skip_damaged:
                    raise
                warn(f"{error}: left out; the next event of the set takes its place")
                for tensor in tensors:
                    tensor.zero_()
        raise InputError("no event of the set can be read")

    def _item(self, event: Event, allocate: _Allocator) -> dict[str, Any]:
        """Return the item of an event: its number, level, crop positions and fields."""
        epoch = self.epoch
        level = float(self._generator(event, epoch if self.noise == "epoch" else 0, _LEVEL).choice(self.levels))
        item: dict[str, Any] = {"number": torch.tensor(event.number)}
        if self.noise is not None:
            item["level"] = torch.tensor(level, dtype=torch.float32)
        regions = {name: tuple(slice(0, n) for n in shape) for name, shape in self.fields.items()}
        for crop_number, (names, size) in enumerate(self.crops.items()):
            shape = self.fields[names[0]]
            start = self._crop_start(event, epoch, crop_number, shape, size)
            for name in names:
                cuts = zip(start, size, shape, strict=True)
                regions[name] = tuple(slice(a, length if n is None else a + n) for a, n, length in cuts)
                item[f"{name}_start"] = torch.tensor(start)
        for name, region in regions.items():
            item[name] = allocate(name, [cut.stop - cut.start for cut in region])
            self._fill(item[name].numpy(), event, epoch, level, name, region, regions.get("truth", ()))
        return item

    def _fill(
        self, out: Floats32, event: Event, epoch: int, level: float, name: str, region: tuple[slice, ...],
        truth_region: tuple[slice, ...],
    ) -> None:  # fmt: skip
        """Read a region of a field into `out`, an array of zeros; `truth_region` is that of the item's truth, or ()."""
        is_whole = out.shape == self.fields[name]
        model, _, slots_word = name.partition("/")
        if name == "truth":
            event.truth_part(region, out)
        elif name == "affine":
            out[...] = event.recipe.grid.affine
            out[:3, 3] += out[:3, :3] @ [cut.start for cut in truth_region] if truth_region else 0
        elif name in ("pose", "position", "euler_degrees"):
            out[...] = getattr(event, name)
        elif name.startswith("radon"):  # no model may have such a name
            out[...] = event.radon(int(name.removeprefix("radon")))[region]
        else:
            target = out if is_whole and not slots_word else None
            images = noisy_images(event, model, self._noise_seed(event, epoch), level, target)
            if target is None:
                out[...] = (self.slots.arrange(images) if slots_word and self.slots is not None else images)[region]

    def _noise_seed(self, event: Event, epoch: int) -> int | None:
        """Return the noise seed of an event in an epoch; None for no noise."""
        if self.noise == "epoch":
            return mixed_seed(event.noise_seed, self.seed, epoch, _NOISE)
        return chosen_seed(event.noise_seed, self.noise)

    def _crop_start(
        self, event: Event, epoch: int, crop_number: int, shape: tuple[int, ...], size: tuple[int | None, ...]
    ) -> list[int]:
        """Return the first index of a crop along each axis, for a field's shape and the crop's size."""
        margins = [0 if n is None else length - n for length, n in zip(shape, size, strict=True)]
        if not self.random_crops:
            return [n // 2 for n in margins]
        generator = self._generator(event, epoch, _POSITION, crop_number)
        return [int(generator.integers(n + 1)) for n in margins]

    def _generator(self, event: Event, epoch: int, *purpose: int) -> np.random.Generator:
        """Return the random numbers of an event in an epoch for a purpose, such as the position of crop 1."""
        return np.random.default_rng(mixed_seed(event.noise_seed, self.seed, epoch, *purpose))


def _allocate_zeros(shape: Sequence[int]) -> torch.Tensor:
    """Return a tensor of zeros; in a loader's worker, one in memory shared with the loader, so that it is not copied."""
    if get_worker_info() is None:
        return torch.zeros(*shape)
    storage = torch.UntypedStorage._new_shared(4 * math.prod(shape))
    return torch.empty(0, dtype=torch.float32).set_(storage, 0, tuple(shape))


class _Item(dict[str, Any]):
    """An item whose arrays are views of a batch's arrays `joined`, by field."""

    def __init__(self, item: dict[str, Any], joined: dict[str, torch.Tensor]) -> None:
        super().__init__(item)
        self.joined = joined


def _collate(items: list[_Item], *, collate_fn_map: Any = None) -> dict[str, Any]:
    """Collate the items of `__getitems__` into a batch: the arrays are joined already, torch collates the rest."""
    arrays = items[0].joined
    rest = default_collate([{name: value for name, value in item.items() if name not in arrays} for item in items])
    return {name: arrays[name] if name in arrays else rest[name] for name in items[0]}


default_collate_fn_map[_Item] = _collate
