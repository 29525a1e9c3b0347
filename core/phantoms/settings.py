"""Numbers that a kind of phantom is made from: their defaults, units and checks, said once."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from ..checks import real_array
from ..errors import InputError


def setting(default: float | tuple[float, ...], unit: str, text: str, least: float | None = None) -> Any:
    """A field of a phantom's dataclass: a number, or as many as `default` has.

    Parameters
    ----------
    default
        The default.
    unit
        For messages and help.
    text
        One line of help.
    least
        The smallest value; None for anything above 0.
    """
    return dataclasses.field(default=default, metadata={"unit": unit, "text": text, "least": least})


def count(default: int | tuple[int, ...], text: str) -> Any:
    """A field of a phantom's dataclass: a whole number of 1 or more, or as many as `default` has; its class checks it."""
    return dataclasses.field(default=default, metadata={"text": text})


def choice(default: str, choices: tuple[str, ...], text: str) -> Any:
    """A field of a phantom's dataclass: one word of several; its class checks it."""
    return dataclasses.field(default=default, metadata={"choices": choices, "text": text})


def check_settings(phantom: Any, title: str) -> None:
    """Check every `setting` of a phantom and turn it into a float, or a tuple of floats.

    Raises
    ------
    InputError
        A setting is not as many finite numbers as its default, or too small.
    """
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
