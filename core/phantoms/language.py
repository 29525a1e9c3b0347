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
"""The shapes by the names of their kinds."""

_EULER = "euler_degrees"


def read_phantom(path: AnyPath) -> ShapePhantom:
    """The phantom that a TOML file describes, see `core.phantoms.language`; messages name file, shape and key."""
    return _phantom(read_toml(path), str(path))


def parse_phantom(text: str, name: str = "phantom") -> ShapePhantom:
    """The phantom that a text in TOML describes, see `read_phantom`; messages call the text `name`."""
    return _phantom(parse_toml(text, name), name)


def write_phantom(phantom: Phantom, path: AnyPath) -> None:
    """Write the shapes of any phantom as a .toml file; `read_phantom` gives the same shapes back."""
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


def _phantom(table: dict[str, Any], name: str) -> ShapePhantom:
    with naming(name):
        _refuse_unknown(table, ("name", "mu_energy", "shape"))
        shapes = table.get("shape", [])
        if not isinstance(shapes, list) or not shapes or not all(isinstance(shape, dict) for shape in shapes):
            raise InputError("expected one [[shape]] or more")
        made = [_shape(i, entries) for i, entries in enumerate(shapes, 1)]
        return ShapePhantom(made, table.get("name", ""), table.get("mu_energy", ShapePhantom.mu_energy))


def _shape(number: int, given: dict[str, Any]) -> Shape:
    name = given.get("name", "")
    with naming(f"shape {number}{f' {name!r}' if name else ''}"):
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


def _refuse_unknown(table: dict[str, Any], known: Iterable[str]) -> None:
    for key, value in table.items():
        if key not in known:
            raise InputError(f"{key}: no such key; expected {', '.join(known)}")
        if _has_boolean(value):  # to numpy they are numbers
            raise InputError(f"{key}: expected numbers or a text, got true or false")


def _has_boolean(value: Any) -> bool:
    return isinstance(value, bool) or (isinstance(value, list) and any(map(_has_boolean, value)))


def _degrees(angle: float) -> float:
    """Degrees that convert back to exactly `angle`, radians; plain conversion may change the last digit."""
    degrees = math.degrees(angle)
    candidates = (degrees, float(np.nextafter(degrees, np.inf)), float(np.nextafter(degrees, -np.inf)))
    return next((candidate for candidate in candidates if math.radians(candidate) == angle), degrees)
