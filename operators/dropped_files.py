"""File handlers: operators that open files dropped on the 3D viewport or the outliner, by the files' endings."""

import bpy

from ..addon.scanner.scanner_files import WORKBOOK_SUFFIXES
from ..addon.volumes.volume_import import READ_ENDINGS


class _DroppedFile:
    """Mixin of the handlers of files dropped on the 3D viewport or the outliner."""

    @classmethod
    def poll_drop(cls, context: bpy.types.Context) -> bool:
        return context.area is not None and context.area.type in {"VIEW_3D", "OUTLINER"}


class MPHDRR_FH_workbook(_DroppedFile, bpy.types.FileHandler):
    bl_label = "Pinhole Geometry"
    bl_import_operator = "mphdrr.import_geometry"
    bl_file_extensions = ";".join(WORKBOOK_SUFFIXES)


class MPHDRR_FH_phantom(_DroppedFile, bpy.types.FileHandler):
    bl_import_operator = "mphdrr.import_phantom"
    bl_file_extensions = ".toml"


class MPHDRR_FH_volume(_DroppedFile, bpy.types.FileHandler):
    bl_label = "Volume for Projection"
    bl_import_operator = "mphdrr.import_volume"
    # Blender compares the last suffix alone. Files .hdr are left out: most are pictures for lighting, not Analyze images.
    bl_file_extensions = ";".join(sorted({"." + ending.rsplit(".", 1)[1] for ending in READ_ENDINGS} - {".hdr"}))
