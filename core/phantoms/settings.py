"""Settings of a kind of phantom: dataclass fields with a unit, a line of help and limits, and their checks."""

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
    """Return a dataclass field for a real number, or for as many real numbers as the tuple `default` has.

    The `unit` of a fraction begins with "of" and names its whole (``"of the wall"``). `text` is the line of help, `least`
    the smallest allowed value (None: any value above 0). `option` is the setting's name on the command line and in recipes
    where it differs from the field's name, because a setting of the grid has that name.
    """
    return dataclasses.field(default=default, metadata={"unit": unit, "text": text, "least": least, "option": option})


def count(default: int | tuple[int, ...], text: str, least: int = 1) -> Any:
    """Return a dataclass field for a whole number of at least 1, or for as many as the tuple `default` has.

    `text` is the line of help, `least` the smallest number that Blender's panels offer. A class that allows numbers below 1
    checks the field itself.
    """
    return dataclasses.field(default=default, metadata={"text": text, "least": least})


def choice(default: str, choices: tuple[str, ...], text: str) -> Any:
    """Return a dataclass field for one of the words `choices`; `text` is the line of help."""
    return dataclasses.field(default=default, metadata={"choices": choices, "text": text})


def setting_names(cls: Any) -> dict[str, str]:
    """Return a dict from names in recipes to a dataclass's arguments: ``{"spacing_of_disks": "spacing", ...}``."""
    fields = [field for field in dataclasses.fields(cls) if field.init]
    return {field.metadata.get("option", "").replace("-", "_") or field.name: field.name for field in fields}


def check_settings(phantom: Any, title: str) -> None:
    """Check all settings of a phantom and store them as floats, whole numbers or tuples of these.

    Messages of `InputError` begin with `title` and the setting's name.
    """
    fields: tuple[Any, ...] = dataclasses.fields(phantom)
    for field in fields:
        if field.metadata:
            name = f"{title}: {field.name.replace('_', ' ')}"
            object.__setattr__(phantom, field.name, _checked_value(getattr(phantom, field.name), field, name))


def _checked_value(value: Any, field: Any, name: str) -> Any:
    """Return `value` in the type of its `field`: a word, float, int or a tuple; raise `InputError` outside the limits."""
    metadata, shape = field.metadata, np.shape(field.default)
    if "choices" in metadata:
        if value not in metadata["choices"]:
            raise InputError(f"{name}: expected one of {', '.join(metadata['choices'])}, got {value!r}")
        return value
    if "unit" not in metadata:
        return whole_shape(value, name, *shape) if shape else whole_number(value, name)
    least, numbers = metadata["least"], real_array(value, name, shape)
    if np.any(numbers < least) if least is not None else np.any(numbers <= 0):
        expected = "more than 0" if least is None else f"{least:g} or more"
        raise InputError(f"{name}: expected {expected} {metadata['unit']}, got {numbers.min():g}")
    return tuple(numbers.tolist()) if shape else float(numbers)


def require_at_most(value: float, limit: float, name: str, place: str) -> None:
    """Raise `InputError` if `value` exceeds `limit`, mm, by more than rounding.

    `place` follows the limit in the message and says where it comes from, such as "in the cylinder".
    """
    if value > limit + 1e-9 * abs(limit):
        raise InputError(f"{name}: expected at most {max(limit, 0):.6g} mm {place}, got {value:.6g}")


def require_apart(diameters: Sequence[float], ring_radius: float, name: str) -> None:
    """Raise `InputError` if spheres of these `diameters`, mm, evenly spaced on a circle, overlap.

    `ring_radius` is the radius, mm, of the circle through their centres; a diameter of 0 stands for no sphere.
    """
    for (i, first), (j, second) in itertools.combinations(enumerate(diameters), 2):
        distance = 2 * ring_radius * math.sin(math.pi * (j - i) / len(diameters))
        if first and second and first + second > 2 * distance * (1 + 1e-9):
            overlap = f"spheres of {first:g} and {second:g} mm overlap"
            raise InputError(f"{name}: {overlap}: their centres are {distance:.6g} mm apart")
