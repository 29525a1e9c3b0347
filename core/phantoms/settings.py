"""Settings of a kind of phantom: the fields of its dataclass with their units, help and checks."""

import dataclasses
import itertools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..errors import InputError
from ..validation import real_array


def setting(
    default: float | tuple[float, ...], unit: str, text: str, least: float | None = None, option: str = ""
) -> Any:
    """A field of a phantom's dataclass: one number, or as many as `default` has.

    A fraction's `unit` says what it is a fraction of (``"of the wall"``). `text` is one line of help, `least` the smallest
    value (None for anything above 0), `option` its name on the command line and in recipes where that is not the field's,
    which the grid's settings have.
    """
    return dataclasses.field(default=default, metadata={"unit": unit, "text": text, "least": least, "option": option})


def count(default: int | tuple[int, ...], text: str) -> Any:
    """A field of a phantom's dataclass: a whole number of at least 1, or several; the class checks it."""
    return dataclasses.field(default=default, metadata={"text": text})


def choice(default: str, choices: tuple[str, ...], text: str) -> Any:
    """A field of a phantom's dataclass: one of several words; the class checks it."""
    return dataclasses.field(default=default, metadata={"choices": choices, "text": text})


def setting_names(cls: Any) -> dict[str, str]:
    """The arguments of a dataclass by their names in recipes: ``{"spacing_of_disks": "spacing", "disks": "disks"}``."""
    fields = [field for field in dataclasses.fields(cls) if field.init]
    return {field.metadata.get("option", "").replace("-", "_") or field.name: field.name for field in fields}


def check_settings(phantom: Any, title: str) -> None:
    """Check every `setting` of a phantom and turn it into a float or a tuple of floats."""
    fields: tuple[Any, ...] = dataclasses.fields(phantom)
    for field in fields:
        if "unit" not in field.metadata:
            continue
        name = f"{title}: {field.name.replace('_', ' ')}"
        least, unit = field.metadata["least"], field.metadata["unit"]
        shape = np.shape(field.default)
        numbers = real_array(getattr(phantom, field.name), name, shape)
        if np.any(numbers < least) if least is not None else np.any(numbers <= 0):
            expected = "more than 0" if least is None else f"{least:g} or more"
            raise InputError(f"{name}: expected {expected} {unit}, got {numbers.min():g}")
        object.__setattr__(phantom, field.name, tuple(numbers.tolist()) if shape else float(numbers))


def require_at_most(value: float, most: float, name: str, where: str) -> None:
    """Raise `InputError` if `value` exceeds `most`, mm, by more than rounding; `where` says what sets the limit."""
    if value > most + 1e-9 * abs(most):
        raise InputError(f"{name}: expected at most {max(most, 0):.6g} mm {where}, got {value:.6g}")


def require_apart(diameters: Sequence[float], ring_radius: float, name: str) -> None:
    """Raise `InputError` if spheres, mm, overlap whose centres divide a circle evenly; a diameter of 0 is no sphere."""
    for (i, first), (j, second) in itertools.combinations(enumerate(diameters), 2):
        apart = 2 * ring_radius * math.sin(math.pi * (j - i) / len(diameters))
        if first and second and first + second > 2 * apart * (1 + 1e-9):
            raise InputError(
                f"{name}: spheres of {first:g} and {second:g} mm overlap: their centres are {apart:.6g} mm apart"
            )
