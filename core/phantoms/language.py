"""Phantoms as text: a TOML file of shapes, in the order of painting.

::

    name = "hot sphere in water"
    mu_energy = 140.5                  # keV at which mu holds; the default

    [[shape]]                          # painted first
    kind = "cylinder"
    name = "water"
    radius = 100                       # mm; [165, 115] for an elliptic one
    height = 200
    activity = 5                       # kBq/mL
    mu = 0.0154                        # 1/mm

    [[shape]]                          # replaces what it covers; without a mu, the water's stays
    kind = "sphere"
    radius = 10
    position = [50, 0, 0]              # mm
    activity = 40

Keys are the attributes of the shapes; angles are degrees, ``euler_degrees = [phi, theta, psi]``.
"""

from __future__ import annotations

import dataclasses
import json
import math
import os
import tomllib
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from ..files import replacing
from .derenzo import DerenzoRods
from .phantom import Phantom, ShapePhantom
from .shapes import Box, Capsule, Cone, Cylinder, Ellipsoid, Shape, Sphere

SHAPES: dict[str, type[Shape]] = {
    shape.KIND: shape for shape in (Box, Capsule, Cone, Cylinder, DerenzoRods, Ellipsoid, Sphere)
}
"""The shapes by the names of their kinds."""

_TOP = ("name", "mu_energy", "shape")
_EULER = "euler_degrees"


def read_phantom(path: str | os.PathLike[str]) -> ShapePhantom:
    """The phantom that a TOML file describes; for an example see `core.phantoms.language`.

    Raises
    ------
    InputError
        The file cannot be read, is not TOML or has wrong entries; the message names file, shape and key.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(f"{path}: expected TOML, a text in UTF-8") from None
    except (OSError, ValueError) as error:  # an impossible path is a ValueError
        raise InputError(f"{path}: {getattr(error, 'strerror', None) or error}") from None
    return parse_phantom(text, str(path))


def parse_phantom(text: str, name: str = "phantom") -> ShapePhantom:
    """The phantom that a text in TOML describes, see `read_phantom`; messages call the text `name`."""
    try:
        return _phantom(tomllib.loads(text))
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{name}: not TOML: {error}") from None
    except RecursionError:
        raise InputError(f"{name}: its lists are nested too deeply") from None
    except InputError as error:
        raise InputError(f"{name}: {error}") from None


def write_phantom(phantom: Phantom, path: str | os.PathLike[str]) -> None:
    """Write the shapes of any phantom as a .toml file; `read_phantom` gives the same shapes back."""
    if not isinstance(phantom, Phantom):
        raise InputError(f"write_phantom: expected a phantom, got {type(phantom).__name__}")
    path = Path(path)
    if path.suffix.lower() != ".toml":
        raise InputError(f"{path}: expected a name ending in .toml")
    lines = [f"name = {_text(phantom.title)}", f"mu_energy = {_text(phantom.mu_energy)}"]
    for shape in phantom.shapes:
        lines += ["", "[[shape]]", f"kind = {_text(shape.KIND)}"]
        lines += [f"{key} = {_text(value)}" for key, value in _entries(shape).items()]
    with replacing(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _phantom(table: dict[str, Any]) -> ShapePhantom:
    _refuse_unknown(table, _TOP)
    shapes = table.get("shape", [])
    if not isinstance(shapes, list) or not shapes or not all(isinstance(shape, dict) for shape in shapes):
        raise InputError("expected one [[shape]] or more")
    return ShapePhantom(
        [_shape(i, entries) for i, entries in enumerate(shapes, 1)],
        name=table.get("name", ""),
        mu_energy=table.get("mu_energy", ShapePhantom.mu_energy),
    )


def _shape(number: int, given: dict[str, Any]) -> Shape:
    try:
        entries = dict(given)
        kind = entries.pop("kind", None)
        if not isinstance(kind, str) or kind not in SHAPES:
            raise InputError(f"kind: expected one of {', '.join(SHAPES)}, got {kind!r}")
        fields = [field for field in dataclasses.fields(SHAPES[kind]) if field.init]
        _refuse_unknown(entries, [_EULER if field.name == "euler" else field.name for field in fields])
        for field in fields:
            if field.default is dataclasses.MISSING and field.name not in entries:
                raise InputError(f"{field.name}: missing; a {kind} needs one")
        if _EULER in entries:
            angles = entries.pop(_EULER)
            if not isinstance(angles, list) or not all(type(angle) in (int, float) for angle in angles):
                raise InputError(f"{_EULER}: expected 3 numbers, got {angles!r}")
            entries["euler"] = [math.radians(angle) for angle in angles]
        return SHAPES[kind](**entries)
    except InputError as error:
        name = given.get("name", "")
        raise InputError(f"shape {number}{f' {name!r}' if name else ''}: {error}") from None


def _refuse_unknown(table: dict[str, Any], known: Any) -> None:
    for key, value in table.items():
        if key not in known:
            raise InputError(f"{key}: no such key; expected {', '.join(known)}")
        if _has_boolean(value):  # to numpy they are numbers
            raise InputError(f"{key}: expected numbers or a text, got true or false")


def _has_boolean(value: Any) -> bool:
    return isinstance(value, bool) or (isinstance(value, list) and any(map(_has_boolean, value)))


def _entries(shape: Shape) -> dict[str, Any]:
    """The attributes that were given to make the shape and differ from the defaults."""
    entries = {}
    for field in dataclasses.fields(shape):
        value = getattr(shape, field.name)
        if field.init and value != field.default:
            entries[field.name] = value
    if "euler" in entries:
        entries[_EULER] = tuple(map(_degrees, entries.pop("euler")))
    return entries


def _degrees(angle: float) -> float:
    """Degrees that convert back to exactly `angle`, radians; plain conversion may change the last digit."""
    degrees = math.degrees(angle)
    for candidate in (degrees, np.nextafter(degrees, np.inf), np.nextafter(degrees, -np.inf)):
        if math.radians(candidate) == angle:
            return float(candidate)
    return degrees


def _text(value: Any) -> str:
    """A value as TOML."""
    if isinstance(value, str):
        # TOML's basic strings have JSON's escapes, but DEL must be escaped, too.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, tuple):
        return f"[{', '.join(map(_text, value))}]"
    return repr(value)
