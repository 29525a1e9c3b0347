"""A CT in the scene becomes a volume of attenuation, which can be projected."""

from __future__ import annotations

from collections.abc import Generator
from typing import Any

import bpy
from bpy.props import FloatProperty

from ..addon import ids, jobs, storage, volumes
from ..addon.decimals import typed
from ..core.memory import require
from ..core.physics.ct_numbers import hu_to_mu
from ..core.progress import Progress
from ..core.volumes.volume import UNITS, Volume


class MPHDRR_OT_ct_to_attenuation(jobs.JobOperator, bpy.types.Operator):
    """``bpy.ops.mphdrr.ct_to_attenuation(energy=140.5)``."""

    bl_idname = ids.CT_TO_ATTENUATION
    bl_label = "CT to Attenuation"
    bl_description = (
        "Make a volume of attenuation coefficients (1/mm) of the active volume of CT numbers, for radiographs and for SPECT "
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
        return context.window_manager.invoke_props_dialog(self, title=self.bl_label, confirm_text="Convert")

    def job(self, context: bpy.types.Context) -> jobs.Job:
        item, energy = context.object, typed(self.energy)
        readers, pose, folder = volumes.state_readers(item), volumes.pose_of_object(item), storage.folder()
        name, collection, count = f"{item.name} mu", item.users_collection[0], len(readers)
        n_x, n_y, n_z = getattr(item, ids.OBJECT_VOLUME).shape
        require(8.0 * count * n_x * n_y * n_z, f"the attenuation of {count * n_x * n_y * n_z} voxels")
        recipe: dict[str, Any] = {"ct": item.name, "energy_keV": energy}
        frame_start, sequence_mode = item.data.frame_start, item.data.sequence_mode

        def work(progress: Progress) -> volumes.StoredVolume:
            states: list[Volume] = []
            for read in readers:
                progress(len(states), count + 1)
                states.append(hu_to_mu(read(), energy))
            progress(count, count + 1)
            return volumes.store_volume(states, folder, pose, recipe)

        def finish(stored: volumes.StoredVolume) -> Generator[None, None, str]:
            yield
            made = volumes.add_stored(stored, name, collection)
            made.data.frame_start, made.data.sequence_mode = frame_start, sequence_mode
            volumes.make_active(bpy.context, made)
            return f"Added {made.name!r}: {stored.low:.4g} to {stored.high:.4g} {UNITS['mu']} at {energy:g} keV"

        return jobs.Job("CT to attenuation", work, finish)
