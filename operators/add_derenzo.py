"""Add > Volume > Derenzo Phantom, and remaking one with other numbers."""

from __future__ import annotations

import bpy
import numpy as np
from bpy.props import FloatProperty, FloatVectorProperty, StringProperty

from ..addon import ids, volume_materials, volumes
from ..addon.phantom_properties import DerenzoSettings
from ..addon.reports import warnings_reported
from ..core.errors import InputError
from ..core.frames import euler_pose
from ..core.grid import Grid
from ..core.volume import Volume


class MPHDRR_OT_add_derenzo(DerenzoSettings, bpy.types.Operator):
    bl_idname = ids.ADD_DERENZO
    bl_label = "Add Derenzo Phantom"
    bl_description = "Add a phantom of hot rods in six sectors as a volume"
    bl_options = {"REGISTER", "UNDO"}

    name: StringProperty(name="Name", description="The object's name", default=ids.DERENZO)
    location: FloatVectorProperty(
        name="Location", description="Middle of the phantom, world mm", size=3, default=(0.0, 0.0, 0.0)
    )
    phi: FloatProperty(name="Phi", description="Turn about world z, done last", subtype="ANGLE", default=0.0)
    theta: FloatProperty(name="Theta", description="Turn about world y, after psi", subtype="ANGLE", default=0.0)
    psi: FloatProperty(
        name="Psi", description="Turn about the phantom's own axis, done first", subtype="ANGLE", default=0.0
    )

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        return context.window_manager.invoke_props_dialog(self, width=320, title=self.bl_label, confirm_text="Add")

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.use_property_split = True
        layout.use_property_decorate = False
        self.draw_settings(layout)
        column = layout.column(align=True)
        column.prop(self, "location")
        column = layout.column(align=True)
        for angle in ("phi", "theta", "psi"):
            column.prop(self, angle)

    def execute(self, context: bpy.types.Context) -> set[str]:
        if context.mode != "OBJECT":
            bpy.ops.object.mode_set(mode="OBJECT")
        try:
            with warnings_reported(self):
                item = add_derenzo(context, self, euler_pose(self.phi, self.theta, self.psi, self.location), self.name)
        except (InputError, MemoryError) as error:
            self.report({"ERROR"}, str(error) or "not enough memory for this grid: choose fewer voxels")
            return {"CANCELLED"}
        self.report({"INFO"}, f"Added {item.name!r}: {self.voxels}^3 voxels of {self.grid().spacing[0]:.3g} mm")
        return {"FINISHED"}


class MPHDRR_OT_update_derenzo(bpy.types.Operator):
    bl_idname = ids.UPDATE_DERENZO
    bl_label = "Update Phantom"
    bl_description = "Make the active phantom's voxels anew from the numbers above; its place stays"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return volumes.is_volume(context.object) and getattr(context.object, ids.OBJECT_VOLUME).kind == "DERENZO"

    def execute(self, context: bpy.types.Context) -> set[str]:
        item = context.object
        settings = getattr(item, ids.OBJECT_VOLUME).derenzo
        try:
            pose = volumes.pose_of_object(item)
            with warnings_reported(self):
                volumes.replace_volume(item, _voxels(settings, pose), pose, settings.recipe())
        except (InputError, MemoryError) as error:
            self.report({"ERROR"}, str(error) or "not enough memory for this grid: choose fewer voxels")
            return {"CANCELLED"}
        return {"FINISHED"}


def add_derenzo(
    context: bpy.types.Context, settings: DerenzoSettings, pose: np.ndarray, name: str = ids.DERENZO
) -> bpy.types.Object:
    """Add a Derenzo phantom at a world-from-phantom `pose` (4, 4), mm, and make it the active object."""
    item = volumes.add_volume(_voxels(settings, pose), name, pose, settings.recipe(), context.collection)
    properties = getattr(item, ids.OBJECT_VOLUME)
    properties.kind = "DERENZO"
    properties.derenzo.copy_settings(settings)
    volume_materials.show_in_eevee(context.scene)
    for other in context.selected_objects:
        other.select_set(False)
    item.select_set(True)
    context.view_layer.objects.active = item
    return item


def draw_menu(self: bpy.types.Menu, context: bpy.types.Context) -> None:
    self.layout.operator_context = "INVOKE_DEFAULT"
    self.layout.operator(ids.ADD_DERENZO, text="Derenzo Phantom", icon="OUTLINER_DATA_VOLUME")


def _voxels(settings: DerenzoSettings, pose: np.ndarray) -> Volume:
    """The phantom on a grid that turns with it, in world mm."""
    own = settings.phantom().voxelize(settings.grid())
    return Volume(own.array, Grid(own.grid.shape, pose @ own.grid.affine), own.quantity)
