"""What is done to a phantom in the scene: made anew, its pose applied, its outline shown."""

from __future__ import annotations

from collections.abc import Generator

import bpy

from ..addon import ids, jobs, phantoms, volumes
from ..core.errors import InputError


class _EditPhantom(jobs.JobOperator):
    """Mix into an operator that makes the active phantom's voxels."""

    bake = False
    done = "Made {} anew"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """A phantom is active."""
        return phantoms.poll_phantom(cls, context)

    def job(self, context: bpy.types.Context) -> jobs.Job:
        bake, done, name = self.bake, self.done, context.object.name
        work, made_of = phantoms.remaking(context.object, bake), phantoms.settings_of(context.object).values()

        def finish(stored: list[volumes.StoredVolume]) -> Generator[None, None, str]:
            yield
            item = bpy.data.objects.get(name)
            settings = phantoms.settings_of(item)
            if item is None or settings is None:
                raise InputError(f"the phantom {name!r} is gone")
            has_changed = settings.values() != made_of
            phantoms.replace(item, stored, bake)
            if not has_changed or bake:
                return done.format(repr(name))
            getattr(item, ids.OBJECT_VOLUME).outdated = True
            return f"{done.format(repr(name))}; its settings have changed in the meantime"

        return jobs.Job("Making a phantom", work, finish)


class MPHDRR_OT_update_phantom(_EditPhantom, bpy.types.Operator):
    bl_idname = ids.UPDATE_PHANTOM
    bl_label = "Update Phantom"
    bl_description = "Make the active phantom's voxels anew from its settings; its place stays"
    bl_options = {"REGISTER", "UNDO"}


class MPHDRR_OT_update_derenzo(_EditPhantom, bpy.types.Operator):
    """The name that `MPHDRR_OT_update_phantom` has in older scripts."""

    bl_idname = ids.UPDATE_DERENZO
    bl_label = "Update Phantom"
    bl_description = "Make the active phantom's voxels anew from its settings; its place stays"
    bl_options = {"INTERNAL", "UNDO"}


class MPHDRR_OT_apply_phantom_pose(_EditPhantom, bpy.types.Operator):
    bl_idname = ids.APPLY_PHANTOM_POSE
    bl_label = "Apply Pose"
    bl_description = (
        "Make the active phantom's voxels anew where it stands, on a grid along the world's axes. It becomes a volume "
        "like any other: its settings are given up"
    )
    bl_options = {"REGISTER", "UNDO"}

    bake = True
    done = "Applied the pose of {}"


class MPHDRR_OT_show_phantom_outline(bpy.types.Operator):
    bl_idname = ids.SHOW_PHANTOM_OUTLINE
    bl_label = "Outline"
    bl_description = "Show or hide the surfaces of the active phantom's shapes as wires that go with it"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return phantoms.poll_phantom(cls, context)

    def execute(self, context: bpy.types.Context) -> set[str]:
        item = context.object
        if phantoms.outline_of(item) is not None:
            phantoms.remove_outline(item)
            return {"FINISHED"}
        try:
            phantoms.show_outline(item)
        except InputError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        return {"FINISHED"}
