"""Operator that deletes the cache of the preferences."""

import bpy

from ..addon import preferences
from ..addon.blender.reports import Reported, needs


class MPHDRR_OT_clean_cache(Reported, bpy.types.Operator):
    """Delete compiled code; it is made again when it is needed."""

    bl_options = {"INTERNAL"}

    poll = needs((lambda context: preferences.cache_size() > 0, "The cache is empty"))

    def act(self, context: bpy.types.Context) -> str:
        return preferences.clean_cache()
