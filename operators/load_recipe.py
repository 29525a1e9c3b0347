"""Set the Projections panel as a recipe or a run says."""

from __future__ import annotations

from pathlib import Path

import bpy
from bpy.props import StringProperty
from bpy_extras.io_utils import ImportHelper

from ..addon import ids, rendering, storage
from ..core.errors import InputError


class MPHDRR_OT_load_recipe(ImportHelper, bpy.types.Operator):
    bl_idname = ids.LOAD_RECIPE
    bl_label = "Load Recipe"
    bl_description = (
        "Set the panel as a recipe (.toml) or a run (.h5, .npz, .pt) says: model, detector, noise, modules and, where the "
        "scene has objects of their names, volumes. By default the recipe of the last run"
    )
    bl_options = {"REGISTER", "UNDO"}

    filter_glob: StringProperty(default="*.toml;*.h5;*.hdf5;*.npz;*.pt", options={"HIDDEN"})

    def execute(self, context: bpy.types.Context) -> set[str]:
        last = getattr(context.scene, ids.SCENE_PROJECTIONS).run_file
        try:
            if not (self.filepath or last):
                raise InputError("no file given: set filepath to a recipe (.toml) or a run (.h5, .npz, .pt)")
            rendering.load_recipe(context.scene, Path(storage.absolute(self.filepath or last)))
        except InputError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        return {"FINISHED"}
