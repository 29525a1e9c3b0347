"""Phantoms as text: TOML files that list shapes in the order of painting.

::

    name = "hot sphere in water"
    mu_energy = 140.5                  # keV at which mu holds; the default

    [[shape]]                          # painted first
    kind = "cylinder"
    name = "water"
    radius = 100                       # mm; [165, 115] for an ellipse
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

import dataclasses
import math
from collections.abc import Iterable
from typing import Any

import numpy as np

from ..errors import InputError, naming
from ..files import AnyPath, require_ending, write_bytes
from ..recipes.toml import parse_toml, read_toml, toml_value
from ..validation import instance
from .derenzo import DerenzoRods
from .phantom import Phantom, ShapePhantom
from .shapes import Box, Capsule, Cone, Cylinder, Ellipsoid, Shape, Sphere

SHAPES: dict[str, type[Shape]] = {
    shape.KIND: shape for shape in (Box, Capsule, Cone, Cylinder, DerenzoRods, Ellipsoid, Sphere)
}
"""Classes of shapes by the name of their kind."""

_EULER = "euler_degrees"


def read_phantom(path: AnyPath) -> ShapePhantom:
    """Read a phantom from a TOML file, see `core.phantoms.language`; messages name file, shape and key."""
    return _make_phantom(read_toml(path), str(path))


def parse_phantom(text: str, name: str = "phantom") -> ShapePhantom:
    """Return the phantom that a text in TOML describes, see `read_phantom`; messages call the text `name`."""
    return _make_phantom(parse_toml(text, name), name)


def write_phantom(phantom: Phantom, path: AnyPath) -> None:
    """Write the shapes of any phantom to a .toml file, from which `read_phantom` reads the same shapes."""
    instance(phantom, Phantom, "write_phantom")
    require_ending(path, (".toml",))
    lines = [f"name = {toml_value(phantom.title)}", f"mu_energy = {toml_value(phantom.mu_energy)}"]
    for shape in phantom.shapes:
        lines += ["", "[[shape]]", f"kind = {toml_value(shape.KIND)}"]
        for field in dataclasses.fields(shape):
            value = getattr(shape, field.name)
            if field.name == "euler" and any(value):
                lines.append(f"{_EULER} = {toml_value(map(_degrees, value))}")
            elif field.init and value != field.default:
                lines.append(f"{field.name} = {toml_value(value)}")
    write_bytes(path, "\n".join([*lines, ""]).encode())


def _make_phantom(table: dict[str, Any], name: str) -> ShapePhantom:
    """Return the phantom that a parsed TOML table describes; messages begin with `name`."""
    with naming(name):
        _check_keys(table, ("name", "mu_energy", "shape"))
        tables = table.get("shape", [])
        if not isinstance(tables, list) or not tables or not all(isinstance(entries, dict) for entries in tables):
            raise InputError("expected one [[shape]] or more")
        shapes = [_make_shape(i, entries) for i, entries in enumerate(tables, 1)]
        return ShapePhantom(shapes, table.get("name", ""), table.get("mu_energy", ShapePhantom.mu_energy))


def _make_shape(number: int, table: dict[str, Any]) -> Shape:
    """Return the shape of a [[shape]] table; messages begin with its number, from 1, and its name."""
    name = table.get("name", "")
    with naming(f"shape {number}{f' {name!r}' if name else ''}"):
        entries = dict(table)
        kind = entries.pop("kind", None)
        if not isinstance(kind, str) or kind not in SHAPES:
            raise InputError(f"kind: expected one of {', '.join(SHAPES)}, got {kind!r}")
        fields = [field for field in dataclasses.fields(SHAPES[kind]) if field.init]
        _check_keys(entries, [_EULER if field.name == "euler" else field.name for field in fields])
        for field in fields:
            if field.default is dataclasses.MISSING and field.name not in entries:
                raise InputError(f"{field.name}: missing; a {kind} needs one")
        if _EULER in entries:
            angles = entries.pop(_EULER)
            if not isinstance(angles, list) or not all(type(angle) in (int, float) for angle in angles):
                raise InputError(f"{_EULER}: expected 3 numbers, got {angles!r}")
            entries["euler"] = [math.radians(angle) for angle in angles]
        return SHAPES[kind](**entries)


def _check_keys(table: dict[str, Any], allowed: Iterable[str]) -> None:
    """Raise `InputError` for a key that is not allowed, or a value that contains true or false."""
    for key, value in table.items():
        if key not in allowed:
            raise InputError(f"{key}: no such key; expected {', '.join(allowed)}")
        if _has_boolean(value):  # numpy would take it as a number
            raise InputError(f"{key}: expected numbers or a text, got true or false")


def _has_boolean(value: Any) -> bool:
    """Return whether a value of TOML is, or a list contains, true or false."""
    return isinstance(value, bool) or (isinstance(value, list) and any(map(_has_boolean, value)))


def _degrees(angle: float) -> float:
    """Return the `angle`, rad, in degrees that convert back to exactly it; plain conversion may change the last digit."""
    degrees = math.degrees(angle)
    candidates = (degrees, float(np.nextafter(degrees, np.inf)), float(np.nextafter(degrees, -np.inf)))
    return next((candidate for candidate in candidates if math.radians(candidate) == angle), degrees)
