"""Typed columns of all kinds of scanners as Blender properties, on each module and, for all modules, on the scanner."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from bpy.props import EnumProperty, FloatProperty, IntProperty, StringProperty

from ...core.geometry.columns import Column
from ...core.scanner_kinds import SCANNERS
from ..blender import choices, decimals

_BLANK = "BLANK"  # identifier of the blank choice in an enumeration
_UNITS = {"length": ", in mm"}
_SHORT_WORDS = {"pinhole_diameter": "Hole", "detector_thickness": "Depth", "roi_radius": "ROI"}


def all_columns() -> dict[str, Column]:
    """Return the columns of all kinds of scanners that are no coordinates, by attribute; the first kind's of equal names."""
    result: dict[str, Column] = {}
    for kind in SCANNERS.values():
        result = kind.columns.scalars | result
    return result


def make_properties(make_update: Callable[[str], Any], suffix: str = "") -> dict[str, Any]:
    """Return the Blender properties of all columns by attribute; `make_update` returns the update callback of a name."""
    return {name: _make_property(column, make_update(name), suffix) for name, column in all_columns().items()}


def _make_property(column: Column, update: Any, suffix: str) -> Any:
    """Return the Blender property of a column, with its callback `update`; `suffix` ends the tooltip."""
    description = f"{column.help or column.title}{_UNITS.get(column.kind, '')}{suffix}"
    common = {"name": column.title.title().replace("Roi", "ROI"), "description": description, "update": update}
    default: Any = column.blank if column.has_constant_blank else None
    if column.kind == "text":
        return StringProperty(**common, default=default or "")
    if column.kind == "choice":
        words = column.choices if default is None or default in column.choices else (default, *column.choices)
        items = choices.items({}, ((word or _BLANK, word or "None", "") for word in map(str, words)))
        return EnumProperty(**common, items=items, default=str(words[0] if default is None else default) or _BLANK)
    low, high = column.plausible
    limits = {"min": 0.0} if low > 0 else {}  # also 0, while another number is typed: the module shows the problem
    limits |= {name: limit for name, limit in (("soft_min", low), ("soft_max", high)) if math.isfinite(limit)}
    if column.kind == "whole":
        return IntProperty(**common, default=int(default or 0), **{name: int(limit) for name, limit in limits.items()})
    display_options = {"subtype": "ANGLE"} if column.kind == "angle" else {"step": 10, "precision": 3}
    return FloatProperty(**common, default=default or 0.0, **limits, **display_options)


def short_label(column: Column) -> str:
    """Return the label of a column in the sidebar: "Hole d"; for a column without a symbol "Crystal Material"."""
    if len(column.name) > 2:
        return column.title.title()
    return f"{_SHORT_WORDS.get(column.field) or column.field.split('_')[-1].capitalize()} {column.name}"


def property_value(column: Column, value: Any) -> Any:
    """Return a column's value as its Blender property holds it."""
    return value or _BLANK if column.kind == "choice" else value


def column_value(column: Column, value: Any, exact: Any) -> Any:
    """Return the value of a column's property: the `exact` one if the property is its rounding, else the typed decimal."""
    if column.kind == "choice":
        return "" if value == _BLANK else value
    if column.kind in ("text", "whole"):
        return value
    if exact is not None and np.float32(exact) == value:
        return exact
    return math.radians(decimals.typed(math.degrees(value))) if column.kind == "angle" else decimals.typed(value)
