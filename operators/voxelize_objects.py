"""Closed mesh objects become a volume of activity or attenuation, and volumes become meshes."""

from __future__ import annotations

from collections.abc import Generator
from typing import Any

import bpy
import numpy as np
from bpy.props import EnumProperty, FloatProperty, IntProperty, StringProperty

from ..addon import choices, ids, jobs, meshes, storage, volumes
from ..addon.decimals import typed
from ..core.errors import InputError
from ..core.geometry.grid import Grid
from ..core.memory import require
from ..core.progress import Progress
from ..core.volumes.meshes.mesh import Mesh
from ..core.volumes.meshes.surface import volume_to_mesh
from ..core.volumes.meshes.voxelization import voxelize_mesh
from ..core.volumes.volume import UNITS

_BYTES = 40.0  # a voxel, while the volume is made and put into the scene


class MPHDRR_OT_voxelize_objects(jobs.JobOperator, bpy.types.Operator):
    """``bpy.ops.mphdrr.voxelize_objects(value=100)``."""

    bl_idname = ids.VOXELIZE_OBJECTS
    bl_label = "Voxelize Meshes"
    bl_description = (
        "Make a volume of the selected closed meshes, modifiers included: a voxel holds the share that they cover. "
        "An object's custom property 'activity' or 'mu' counts instead of the value; later names cover earlier ones"
    )
    bl_options = {"REGISTER", "UNDO"}

    quantity: EnumProperty(
        name="Quantity",
        description="What the volume holds",
        items=choices.items(choices.QUANTITIES, (("activity", "Activity", "kBq/mL"), ("mu", "Attenuation", "1/mm"))),
    )
    value: FloatProperty(
        name="Value", description="Inside the meshes, in kBq/mL or 1/mm", default=100.0, min=0.0, precision=4
    )
    voxels: IntProperty(
        name="Voxels", description="Voxels along the longest side", default=128, min=2, soft_max=512, max=4096
    )
    voxel_size: FloatProperty(
        name="Voxel Size (mm)", description="Side of a voxel in mm; 0 takes it from the number of voxels", default=0.0,
        min=0.0, soft_max=10.0, precision=3,
    )  # fmt: skip
    name: StringProperty(name="Name", description="The volume's name; empty: the mesh's")

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not _chosen(context):
            cls.poll_message_set("Select closed mesh objects first")
            return False
        return True

    def ask(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str] | None:
        return context.window_manager.invoke_props_dialog(self, width=320, title=self.bl_label, confirm_text="Voxelize")

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.use_property_split = True
        layout.use_property_decorate = False
        layout.prop(self, "quantity")
        layout.prop(self, "value", text="kBq/mL" if self.quantity == "activity" else "1/mm")
        layout.prop(self, "voxels")
        layout.prop(self, "voxel_size")
        layout.prop(self, "name")

    def job(self, context: bpy.types.Context) -> jobs.Job:
        items = _chosen(context)
        if not items:
            raise InputError("no mesh object is selected: select closed meshes first")
        scene, quantity, folder = context.scene, self.quantity, storage.folder()
        values = [float(item.get(quantity, typed(self.value))) for item in items]
        solids = meshes.meshes_of(items, context.evaluated_depsgraph_get())
        grid = _fitted(solids, self.voxels, typed(self.voxel_size))
        require(_BYTES * grid.n_voxels, "a volume of {} x {} x {} voxels".format(*grid.shape))
        name = self.name or f"{items[0].name} {quantity}"
        recipe: dict[str, Any] = {"meshes": [item.name for item in items], "values": values}

        def work(progress: Progress) -> volumes.StoredVolume:
            return volumes.store_volume(
                voxelize_mesh(solids, grid, values, quantity, progress), folder, provenance=recipe
            )

        def finish(stored: volumes.StoredVolume) -> Generator[None, None, str]:
            yield
            volumes.make_active(bpy.context, volumes.add_stored(stored, name, scene.collection))
            content = float(stored.volume.array.sum(dtype=np.float64)) * grid.voxel_volume
            total = f"{content * 1e-3:.4g} kBq" if quantity == "activity" else f"{content:.4g} {UNITS[quantity]} mm^3"
            shape = " x ".join(map(str, grid.shape))
            return f"Added {name!r}: {shape} voxels of {grid.spacing[0]:.3g} mm, {total} in all"

        return jobs.Job("Voxelizing meshes", work, finish)


class MPHDRR_OT_mesh_from_volume(jobs.JobOperator, bpy.types.Operator):
    """``bpy.ops.mphdrr.mesh_from_volume(level=50)``."""

    bl_idname = ids.MESH_FROM_VOLUME
    bl_label = "Mesh from Volume"
    bl_description = "Make a closed mesh of the active volume's surface of one value, for display and print"
    bl_options = {"REGISTER", "UNDO"}

    level: FloatProperty(
        name="Level", description="The surface's value, in the volume's unit; 0: half of the maximum", default=0.0
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return volumes.poll_volume(cls, context)

    def ask(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str] | None:
        return context.window_manager.invoke_props_dialog(self, title=self.bl_label, confirm_text="Make")

    def job(self, context: bpy.types.Context) -> jobs.Job:
        item = context.object
        read, pose, name = volumes.reader(item), volumes.pose_of_object(item), f"{item.name} surface"
        level, collection = typed(self.level) or None, context.collection

        def work(progress: Progress) -> Mesh:
            return volume_to_mesh(read(), level, progress)

        def finish(mesh: Mesh) -> Generator[None, None, str]:
            yield
            meshes.add_mesh(mesh, name, pose, collection)
            return f"Added {name!r}: {len(mesh.faces)} triangles around {abs(mesh.volume):.4g} mm^3"

        return jobs.Job("Mesh from volume", work, finish)


def draw_menu(self: bpy.types.Menu, context: bpy.types.Context) -> None:
    """The entries of Object > Convert."""
    self.layout.separator()
    self.layout.operator_context = "INVOKE_DEFAULT"
    self.layout.operator(ids.VOXELIZE_OBJECTS, icon="OUTLINER_DATA_VOLUME")
    self.layout.operator(ids.MESH_FROM_VOLUME, icon="OUTLINER_DATA_MESH")


def _chosen(context: bpy.types.Context) -> list[bpy.types.Object]:
    """The selected mesh objects by name; the scanner's own are none of them."""
    found = [o for o in context.selected_objects if o.type == "MESH" and o.mphdrr_module.part == "NONE"]
    return sorted(found, key=lambda o: o.name)


def _fitted(solids: list[Mesh], voxels: int, voxel_size: float) -> Grid:
    """A grid along the world's axes around meshes, with a voxel to spare on every side."""
    low = np.min([solid.vertices.min(axis=0) for solid in solids], axis=0)
    high = np.max([solid.vertices.max(axis=0) for solid in solids], axis=0)
    spacing = voxel_size or float((high - low).max()) / max(1, voxels - 2)
    shape = tuple(int(n) for n in np.ceil((high - low) / spacing) + 2)
    return Grid.centered(shape, spacing, (low + high) / 2)
