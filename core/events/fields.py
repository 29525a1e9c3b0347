"""Shapes of the arrays of an event, by their names in exports and training."""

import math
from collections.abc import Iterable

from ..errors import InputError
from .event_set import EventSet

Shapes = dict[str, tuple[int, ...]]


def field_shapes(events: EventSet) -> Shapes:
    """Return the shapes of an event's arrays: "truth", images by model name, and "radon96" for 96 angles and so on.

    `InputError` where there are no events, or where joined sets have arrays of different shapes.
    """
    if not len(events):
        raise InputError("the set has no events; make some, or choose another split")
    common: Shapes = {}
    for event in {id(event.recipe): event for event in events}.values():
        recipe, shapes = event.recipe, Shapes()
        shapes["truth"] = recipe.grid.shape
        shapes |= {model: (len(event.views), *event.views.shape) for model in recipe.models}
        if recipe.radon is not None:
            shapes |= {f"radon{n}": (n, *recipe.radon.shape) for n in recipe.radon.counts}
        if common and shapes != common:
            differing = sorted(name for name in common | shapes if common.get(name) != shapes.get(name))
            raise InputError(f"joined sets: expected arrays of the same shapes, but {', '.join(differing)} differ")
        common = shapes
    return common


def float32_bytes(shapes: Iterable[tuple[int, ...]]) -> int:
    """Return the bytes that float32 arrays of these shapes take together."""
    return 4 * sum(map(math.prod, shapes))
