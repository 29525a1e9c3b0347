"""The arrays that every event of a set has, by the names that exports and training call them."""

import math
from collections.abc import Iterable

from ..errors import InputError
from .event_set import EventSet

Shapes = dict[str, tuple[int, ...]]


def field_shapes(events: EventSet) -> Shapes:
    """The shapes of "truth", of each model's images by its name, and of "radon96" for each number of angles.

    `InputError` for no events, and for joined sets whose arrays are not of the same shapes.
    """
    if not len(events):
        raise InputError("the set has no events; make some, or choose another split")
    found: Shapes = {}
    for event in {id(event.recipe): event for event in events}.values():
        recipe, shapes = event.recipe, Shapes()
        shapes["truth"] = recipe.grid.shape
        shapes |= {model: (len(event.views), *event.views.shape) for model in recipe.models}
        if recipe.radon is not None:
            shapes |= {f"radon{n}": (n, *recipe.radon.shape) for n in recipe.radon.counts}
        if found and shapes != found:
            differing = sorted(name for name in found | shapes if found.get(name) != shapes.get(name))
            raise InputError(f"joined sets: expected events of the same arrays, but {', '.join(differing)} differ")
        found = shapes
    return found


def float32_bytes(shapes: Iterable[tuple[int, ...]]) -> int:
    """Bytes of arrays of float32 of these shapes."""
    return 4 * sum(map(math.prod, shapes))
