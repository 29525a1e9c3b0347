"""A CT in the scene becomes a volume of attenuation, which can be projected."""

from __future__ import annotations

import bpy
from bpy.props import FloatProperty

from ..addon import ids, jobs, volume_import, volumes
from ..addon.decimals import typed


class MPHDRR_OT_ct_to_attenuation(jobs.JobOperator, bpy.types.Operator):
    """``bpy.ops.mphdrr.ct_to_attenuation(energy=140.5)``."""

    bl_idname = ids.CT_TO_ATTENUATION
    bl_label = "CT to Attenuation"
    bl_description = (
        "Make a volume of attenuation coefficients (1/mm) from the active volume of CT numbers, for radiographs and SPECT "
        "counts; the CT stays"
    )
    bl_options = {"REGISTER", "UNDO"}

    energy: FloatProperty(
        name="Energy (keV)", description="Of the photons that are attenuated, in keV: 140.5 is Tc-99m's, about 70 those of "
        "a CT of 120 kV", default=140.5, min=10.0, max=1000.0,
    )  # fmt: skip

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not volumes.is_volume(context.object) or volumes.quantity_of(context.object) != "hu":
            cls.poll_message_set("No CT is active: select a volume of CT numbers (hu)")
            return False
        return True

    def ask(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str] | None:
        return self.ask_in_dialog(context, "Convert")

    def job(self, context: bpy.types.Context) -> jobs.Job:
        return volume_import.converting(context.object, typed(self.energy))
