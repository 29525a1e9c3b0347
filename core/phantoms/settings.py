"""Settings of a kind of phantom: the fields of its dataclass with their units, help and checks."""

import dataclasses
import itertools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..errors import InputError
from ..validation import real_array, whole_number, whole_shape


def setting(
    default: float | tuple[float, ...], unit: str, text: str, least: float | None = None, option: str = ""
) -> Any:
    """A field of a phantom's dataclass: one number, or as many as `default` has.

    A fraction's `unit` says what it is a fraction of (``"of the wall"``). `text` is one line of help, `least` the smallest
    value (None for anything above 0), `option` its name on the command line and in recipes where that is not the field's,
    which the grid's settings have.
    """
    return dataclasses.field(default=default, metadata={"unit": unit, "text": text, "least": least, "option": option})


def count(default: int | tuple[int, ...], text: str, least: int = 1) -> Any:
    """A field of a phantom's dataclass: a whole number of at least 1, or several.

    A class that allows other ones checks them itself; `least` is then the smallest that panels offer.
    """
    return dataclasses.field(default=default, metadata={"text": text, "least": least})


def choice(default: str, choices: tuple[str, ...], text: str) -> Any:
    """A field of a phantom's dataclass: one of several words."""
    return dataclasses.field(default=default, metadata={"choices": choices, "text": text})


def setting_names(cls: Any) -> dict[str, str]:
    """The arguments of a dataclass by their names in recipes: ``{"spacing_of_disks": "spacing", "disks": "disks"}``."""
    fields = [field for field in dataclasses.fields(cls) if field.init]
    return {field.metadata.get("option", "").replace("-", "_") or field.name: field.name for field in fields}


def check_settings(phantom: Any, title: str) -> None:
    """Check all settings of a phantom, and turn numbers into floats, whole numbers or tuples of them."""
    fields: tuple[Any, ...] = dataclasses.fields(phantom)
    for field in fields:
        if field.metadata:
            name = f"{title}: {field.name.replace('_', ' ')}"
            object.__setattr__(phantom, field.name, _checked(getattr(phantom, field.name), field, name))


def _checked(value: Any, field: Any, name: str) -> Any:
    known, shape = field.metadata, np.shape(field.default)
    if "choices" in known:
        if value not in known["choices"]:
            raise InputError(f"{name}: expected one of {', '.join(known['choices'])}, got {value!r}")
        return value
    if "unit" not in known:
        return whole_shape(value, name, *shape) if shape else whole_number(value, name)
    least, numbers = known["least"], real_array(value, name, shape)
    if np.any(numbers < least) if least is not None else np.any(numbers <= 0):
        expected = "more than 0" if least is None else f"{least:g} or more"
        raise InputError(f"{name}: expected {expected} {known['unit']}, got {numbers.min():g}")
    return tuple(numbers.tolist()) if shape else float(numbers)


def require_at_most(value: float, most: float, name: str, where: str) -> None:
    """Refuse a `value` that exceeds `most`, mm, by more than rounding; `where` says what sets the limit."""
    if value > most + 1e-9 * abs(most):
        raise InputError(f"{name}: expected at most {max(most, 0):.6g} mm {where}, got {value:.6g}")


def require_apart(diameters: Sequence[float], ring_radius: float, name: str) -> None:
    """Refuse spheres that overlap, mm, whose centres divide a circle evenly; a diameter of 0 is no sphere."""
    for (i, first), (j, second) in itertools.combinations(enumerate(diameters), 2):
        apart = 2 * ring_radius * math.sin(math.pi * (j - i) / len(diameters))
        if first and second and first + second > 2 * apart * (1 + 1e-9):
            both = f"spheres of {first:g} and {second:g} mm overlap"
            raise InputError(f"{name}: {both}: their centres are {apart:.6g} mm apart")
