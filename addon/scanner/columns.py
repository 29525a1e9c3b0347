"""The typed columns of all kinds of scanners as Blender's properties: on each module, and on the scanner for all modules."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from bpy.props import EnumProperty, FloatProperty, IntProperty, StringProperty

from ...core.geometry.columns import Column
from ...core.scanner_kinds import SCANNERS
from ..blender import choices, decimals

_BLANK = "BLANK"  # how a choice that may be blank is called in an enumeration
_UNITS = {"length": ", in mm"}
_SHORT = {"pinhole_diameter": "Hole", "detector_thickness": "Depth", "roi_radius": "ROI"}


def known_columns() -> dict[str, Column]:
    """Attribute -> column, of the columns that are no coordinates; of two kinds' columns of one name, the first."""
    found: dict[str, Column] = {}
    for kind in SCANNERS.values():
        found = kind.columns.scalars | found
    return found


def declared(edited: Callable[[str], Any], suffix: str = "") -> dict[str, Any]:
    """Attribute -> property, with the callback that `edited` gives for each name."""
    return {name: _declared(column, edited(name), suffix) for name, column in known_columns().items()}


def _declared(column: Column, update: Any, suffix: str) -> Any:
    about = f"{column.help or column.title}{_UNITS.get(column.kind, '')}{suffix}"
    common = {"name": column.title.title().replace("Roi", "ROI"), "description": about, "update": update}
    default: Any = column.blank if column.has_constant_blank else None
    if column.kind == "text":
        return StringProperty(**common, default=default or "")
    if column.kind == "choice":
        words = column.choices if default is None or default in column.choices else (default, *column.choices)
        items = choices.items({}, ((word or _BLANK, word or "None", "") for word in map(str, words)))
        return EnumProperty(**common, items=items, default=str(words[0] if default is None else default) or _BLANK)
    low, high = column.plausible
    limits = {"min": 0.0} if low > 0 else {}  # 0 while another is typed; the module says what is wrong
    limits |= {name: limit for name, limit in (("soft_min", low), ("soft_max", high)) if math.isfinite(limit)}
    if column.kind == "whole":
        return IntProperty(**common, default=int(default or 0), **{name: int(limit) for name, limit in limits.items()})
    shown = {"subtype": "ANGLE"} if column.kind == "angle" else {"step": 10, "precision": 3}
    return FloatProperty(**common, default=default or 0.0, **limits, **shown)


def short_label(column: Column) -> str:
    """What stands beside a value in the sidebar: "Hole d"; of a column without a symbol, its name: "Crystal Material"."""
    if len(column.name) > 2:
        return column.title.title()
    return f"{_SHORT.get(column.field) or column.field.split('_')[-1].capitalize()} {column.name}"


def shown(column: Column, value: Any) -> Any:
    """A value of a column as its property shows it."""
    return value or _BLANK if column.kind == "choice" else value


def value_of(column: Column, shown: Any, known: Any) -> Any:
    """The value that a property shows: the `known` one if it is its rounding, else the decimal number that was typed."""
    if column.kind == "choice":
        return "" if shown == _BLANK else shown
    if column.kind in ("text", "whole"):
        return shown
    if known is not None and np.float32(known) == shown:
        return known
    return math.radians(decimals.typed(math.degrees(shown))) if column.kind == "angle" else decimals.typed(shown)
