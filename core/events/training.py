"""Training with torch: event sets as a torch `Dataset`."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

from ..errors import InputError, needing
from ..files import AnyPath
from ..validation import instance, one_of, positive, seed_number, strict_whole
from .event_set import EventSet
from .exports.slots import read_slots, row_slots
from .fields import Shapes, field_shapes
from .noise_choice import require_counted

if TYPE_CHECKING:
    from torch.utils.data import Dataset

_PLACEMENT_SHAPES: Shapes = {"affine": (4, 4), "pose": (4, 4), "position": (3,), "euler_degrees": (3,)}
"""Shapes of the fields of an event besides its arrays (`field_shapes`)."""
_SLOTS = "/slots"

Size = int | Sequence[int | None]
Crop = Size | Mapping[str | tuple[str, ...], Size] | None


def torch_dataset(
    events: EventSet,
    fields: Sequence[str] = ("truth",),
    *,
    crop: Crop = None,
    crop_at: Literal["random", "center"] = "random",
    noise: Literal["own", "epoch"] | None = None,
    levels: float | Sequence[float] | None = None,
    seed: int = 0,
    slots: AnyPath | None = None,
    skip_damaged: bool = False,
) -> "Dataset[dict[str, Any]]":
    """Return the events as a torch `Dataset` of dicts of float32 tensors, for a `DataLoader` with any number of workers.

    An item depends on the set, the event, the epoch and `seed` alone, not on workers or order. No file stays open, so
    workers may fork or spawn.

    Parameters
    ----------
    events : EventSet
        For instance ``set.split("train")``.
    fields
        Tensors of an item: "truth" (n_x, n_y, n_z), "affine" (4, 4) of its voxels, "pose" (4, 4), "position" (3,), mm,
        "euler_degrees" (3,), "radon96" (96, n_v, n_u), the name of a model for its images (M, n_v, n_u), and "NAME/slots"
        for these images in the order of the users' layout (S, n_v, n_u). Each item also has its event's "number" and, with
        noise, its "level".
    crop
        Size of the part of the truth to read, voxels: one number or three; or sizes by field, such as
        ``{"truth": 64, ("counts/slots", "radon96"): (None, 128, 128)}``. Fields named together are cropped at the same
        position; an axis of None is not cropped. The item holds the first index of a part, as "truth_start", and "affine"
        is that of the part.
    crop_at
        "random": at another position in each epoch. "center": at the centre.
    noise
        None: mean images. "own": noise of each event's own seed. "epoch": new noise in each epoch
        (``dataset.set_epoch(epoch)``).
    levels
        With noise, one or several fractions of the acquisition time; default: those of the recipe. One is drawn for each
        event, and with the noise "epoch" in each epoch again.
    seed
        Seed of random crops, levels and the noise "epoch": a whole number of at least 0.
    slots
        Table of slots (`read_slots`) for "NAME/slots"; default: a ring of images in a row, followed by mirrored ones.
    skip_damaged
        Whether to replace an event whose file is damaged or missing by the next one, with an `InputWarning`. Otherwise
        `InputError` is raised, also in a loader's workers.

    Returns
    -------
    Dataset
        Dataset of torch with a method ``set_epoch(epoch)``, to be called before each epoch. It also reaches the workers
        that a loader keeps (``persistent_workers=True``).

    Raises
    ------
    InputError
        The set does not have a field, a crop is larger than its field, or torch is missing.

    Examples
    --------
    >>> dataset = events.torch_dataset(set.split("train"), ("counts", "truth"), noise="epoch", levels=(1.0, 0.25))
    >>> loader = torch.utils.data.DataLoader(dataset, batch_size=4, shuffle=True, num_workers=2)
    >>> for epoch in range(100):
    ...     dataset.set_epoch(epoch)
    ...     for batch in loader:
    ...         batch["counts"], batch["truth"]  # (4, 80, 256, 256), (4, 256, 256, 256)
    """
    with needing(feature="torch_dataset"):
        from .torch_events import TorchEvents

    instance(events, EventSet, "torch_dataset")
    array_shapes = field_shapes(events)
    one_of(crop_at, ("random", "center"), "crop_at")
    one_of(noise, (None, "own", "epoch"), "noise")
    seed_number(seed)
    if levels is None:
        levels = (1.0,) if noise is None else events.recipe.levels
    elif noise is None:
        raise InputError("levels: need noise; choose noise as well, or leave them out")
    chosen_levels = [positive(level, "levels") for level in (levels if isinstance(levels, Sequence) else (levels,))]
    if not chosen_levels:
        raise InputError("levels: expected one or more, got none")
    known_shapes, chosen_slots = array_shapes | _PLACEMENT_SHAPES, None
    models = tuple(events.recipe.models)
    names = (fields,) if isinstance(fields, str) else tuple(dict.fromkeys(fields))
    if any(name.endswith(_SLOTS) for name in names):
        chosen_slots = row_slots(events.system) if slots is None else read_slots(slots, events.system)
        known_shapes |= {f"{model}{_SLOTS}": (len(chosen_slots), *known_shapes[model][1:]) for model in models}
    possible = dict.fromkeys([*known_shapes, *(f"{model}{_SLOTS}" for model in models)])
    for name in names:
        one_of(name, possible, "field")
    if noise is not None:
        require_counted(events, [name for name in models if name in names or f"{name}{_SLOTS}" in names])
    shapes = {name: known_shapes[name] for name in names}
    crops, is_random = _checked_crops(crop, shapes), crop_at == "random"
    return TorchEvents(events, shapes, crops, is_random, noise, chosen_levels, seed, chosen_slots, skip_damaged)


def _checked_crops(crop: Crop, shapes: Mapping[str, tuple[int, ...]]) -> dict[tuple[str, ...], tuple[int | None, ...]]:
    """Return the sizes of crops by the fields that are cropped together; `InputError` where a crop is impossible."""
    if crop is None:
        return {}
    crops: dict[tuple[str, ...], tuple[int | None, ...]] = {}
    for key, size in (crop if isinstance(crop, Mapping) else {"truth": crop}).items():
        names = (key,) if isinstance(key, str) else tuple(key)
        for name in names:
            if name not in shapes or len(shapes[name]) != 3 or any(name in fields for fields in crops):
                raise InputError(f"crop: {name!r}: expected one of the fields of three axes that are read, each once")
            if shapes[name] != shapes[names[0]]:
                raise InputError(f"crop: {', '.join(names)}: expected fields of one shape")
        sizes = (size,) * 3 if isinstance(size, int) else tuple(size)
        if len(sizes) != 3:
            raise InputError(f"crop: {', '.join(names)}: expected one number or three, got {size}")
        for n, length in zip(sizes, shapes[names[0]], strict=True):
            if n is not None and strict_whole(n, "crop", "whole numbers of at least 1, or None") > length:
                raise InputError(f"crop: {', '.join(names)}: a part of {n} along an axis of {length}")
        crops[names] = sizes
    return crops
