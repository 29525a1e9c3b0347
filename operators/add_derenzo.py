"""Add > Volume > Derenzo Phantom, and remaking one with other numbers."""

from __future__ import annotations

from collections.abc import Callable, Generator
from typing import Any

import bpy
import numpy as np
from bpy.props import FloatProperty, FloatVectorProperty, StringProperty
from numpy.typing import NDArray

from ..addon import ids, jobs, storage, volumes
from ..addon.phantom_properties import DerenzoSettings
from ..core.errors import InputError
from ..core.frames import euler_pose
from ..core.grid import Grid
from ..core.progress import Progress
from ..core.volume import Volume


class MPHDRR_OT_add_derenzo(DerenzoSettings, jobs.JobOperator, bpy.types.Operator):
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

    def ask(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str] | None:
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

    def job(self, context: bpy.types.Context) -> jobs.Job:
        if context.mode != "OBJECT":
            bpy.ops.object.mode_set(mode="OBJECT")
        voxels, name = self.voxels, self.name
        chosen = {key: _value(self, key) for key in DerenzoSettings.__annotations__}

        def finish(stored: volumes.StoredVolume) -> Generator[None, None, str]:
            yield
            item = volumes.add_stored(stored, name, bpy.context.collection)
            properties = getattr(item, ids.OBJECT_VOLUME)
            properties.kind = "DERENZO"
            for key, value in chosen.items():
                setattr(properties.derenzo, key, value)
            volumes.make_active(bpy.context, item)
            return f"Added {item.name!r}: {voxels}^3 voxels of {stored.volume.grid.spacing[0]:.3g} mm"

        pose = euler_pose(self.phi, self.theta, self.psi, self.location)
        return jobs.Job("Making a phantom", _work(self, pose), finish)


class MPHDRR_OT_update_derenzo(jobs.JobOperator, bpy.types.Operator):
    bl_idname = ids.UPDATE_DERENZO
    bl_label = "Update Phantom"
    bl_description = "Make the active phantom's voxels anew from the numbers above; its place stays"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return volumes.is_volume(context.object) and getattr(context.object, ids.OBJECT_VOLUME).kind == "DERENZO"

    def job(self, context: bpy.types.Context) -> jobs.Job:
        name = context.object.name
        settings = getattr(context.object, ids.OBJECT_VOLUME).derenzo

        def finish(stored: volumes.StoredVolume) -> Generator[None, None, str]:
            yield
            item = bpy.data.objects.get(name)
            if not volumes.is_volume(item):
                raise InputError(f"the phantom {name!r} is gone")
            volumes.replace_stored(item, stored)
            return f"Made {name!r} anew"

        return jobs.Job("Making a phantom", _work(settings, volumes.pose_of_object(context.object)), finish)


def draw_menu(self: bpy.types.Menu, context: bpy.types.Context) -> None:
    self.layout.operator_context = "INVOKE_DEFAULT"
    self.layout.operator(ids.ADD_DERENZO, text="Derenzo Phantom", icon="OUTLINER_DATA_VOLUME")


def _work(settings: DerenzoSettings, pose: NDArray[np.float64]) -> Callable[[Progress], volumes.StoredVolume]:
    """What makes the phantom at a world-from-phantom `pose` (4, 4), mm, on a grid that turns with it; leaves bpy alone."""
    phantom, grid, recipe, folder = settings.phantom(), settings.grid(), settings.recipe(), storage.folder()

    def work(progress: Progress) -> volumes.StoredVolume:
        own = phantom.voxelize(grid, progress=progress)
        return volumes.store_volume(
            Volume(own.array, Grid(grid.shape, pose @ grid.affine), own.quantity), folder, pose, recipe
        )

    return work


def _value(settings: DerenzoSettings, name: str) -> Any:
    value = getattr(settings, name)
    return tuple(value) if isinstance(value, bpy.types.bpy_prop_array) else value
