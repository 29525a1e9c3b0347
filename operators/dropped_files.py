"""Files dropped on the 3D viewport or the outliner: which operator opens which endings."""

from __future__ import annotations

from typing import Any

import bpy

from ..addon import ids
from ..addon.volume_import import READ_ENDINGS

# Blender compares the last suffix only. Most .hdr files are pictures of surroundings, not Analyze images.
_VOLUMES = sorted({"." + ending.rsplit(".", 1)[1] for ending in READ_ENDINGS} - {".hdr"})

# Class, label, operator, endings.
_DROPPED = (
    (ids.FILE_HANDLER_WORKBOOK, "Pinhole Geometry", ids.IMPORT_GEOMETRY, [".xlsx", ".xlsm"]),
    (ids.FILE_HANDLER_VOLUME, "Volume for Projection", ids.IMPORT_VOLUME, _VOLUMES),
    (ids.FILE_HANDLER_PHANTOM, "Phantom", ids.IMPORT_PHANTOM, [".toml"]),
)


class _Dropped:
    @classmethod
    def poll_drop(cls, context: bpy.types.Context) -> bool:
        return context.area is not None and context.area.type in {"VIEW_3D", "OUTLINER"}


def _handler(name: str, label: str, operator: str, endings: list[str]) -> Any:
    members = {
        "bl_idname": name,
        "bl_label": label,
        "bl_import_operator": operator,
        "bl_file_extensions": ";".join(endings),
    }
    return type(name, (_Dropped, bpy.types.FileHandler), members)


CLASSES = tuple(_handler(*row) for row in _DROPPED)
