"""Add > mphDRR: an operator for every kind of phantom, and one for phantoms described by a TOML file."""

from __future__ import annotations

from collections.abc import Generator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import bpy
from bpy.props import BoolProperty, FloatProperty, FloatVectorProperty, StringProperty

from ..addon import ids, jobs, phantoms, storage, volumes
from ..addon.phantom_properties import FILE, KindSettings, PhantomSettings, identifier, kind_settings, sampling
from ..core.errors import InputError
from ..core.geometry.frames import euler_pose
from ..core.phantoms.kinds import KINDS, Kind
from ..core.phantoms.language import read_phantom
from ..core.phantoms.phantom import Phantom
from ..core.progress import Progress


class AddPhantom(PhantomSettings, jobs.JobOperator):
    """Mix into an operator with a name and a phantom's settings."""

    attenuation: BoolProperty(
        name="With Attenuation",
        description="Add the volume of attenuation coefficients too, as a child that goes with the activity",
        default=False,
    )
    location: FloatVectorProperty(
        name="Location", description="Origin of the phantom's frame, world mm", size=3, default=(0.0, 0.0, 0.0)
    )
    phi: FloatProperty(name="Phi", description="Turn about world z, done last", subtype="ANGLE", default=0.0)
    theta: FloatProperty(name="Theta", description="Turn about world y, after psi", subtype="ANGLE", default=0.0)
    psi: FloatProperty(
        name="Psi", description="Turn about the phantom's own axis, done first", subtype="ANGLE", default=0.0
    )

    settings_kind = ""  # of VolumeProperties

    if TYPE_CHECKING:  # of every phantom's settings, and of Blender
        quantity: str
        name: str
        layout: bpy.types.UILayout

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.use_property_split = True
        layout.use_property_decorate = False
        self.draw_settings(layout)
        row = layout.row()
        row.enabled = self.quantity == "activity"
        row.prop(self, "attenuation")
        column = layout.column(align=True)
        column.prop(self, "location")
        column = layout.column(align=True)
        for angle in ("phi", "theta", "psi"):
            column.prop(self, angle)

    def adding(self, name: str) -> jobs.Job:
        """The job that adds the phantom under a name."""
        if bpy.context.mode != "OBJECT":
            bpy.ops.object.mode_set(mode="OBJECT")
        recipe, folder = phantoms.recipe_of(self), storage.folder()
        kind, kept = self.settings_kind, self.values()
        pose = euler_pose(self.phi, self.theta, self.psi, self.location)
        quantities = ["activity", "mu"] if self.attenuation and self.quantity == "activity" else [self.quantity]

        def work(progress: Progress) -> list[volumes.StoredVolume]:
            return recipe.voxelize(quantities, [pose] * len(quantities), folder, progress)

        def finish(stored: list[volumes.StoredVolume]) -> Generator[None, None, str]:
            yield
            if kind == FILE.upper():
                kept["text"] = bpy.data.texts.new(recipe.settings["file"])
                kept["text"].from_string(recipe.settings["text"])
            item = phantoms.add(stored, name, kind, kept, bpy.context.collection)
            volumes.make_active(bpy.context, item)
            grid = recipe.grid
            return f"Added {item.name!r}: {grid.shape[0]}^3 voxels of {grid.spacing[0]:.3g} mm"

        return jobs.Job("Making a phantom", work, finish)


class AddKind(KindSettings, AddPhantom):
    """What the operators of all kinds do."""

    def ask(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str] | None:
        return context.window_manager.invoke_props_dialog(self, width=340, title=self.bl_label, confirm_text="Add")

    def job(self, context: bpy.types.Context) -> jobs.Job:
        return self.adding(self.name)


def _operator(kind: Kind) -> Any:
    """The operator that adds one kind: its settings are its arguments."""
    own = {
        "name": StringProperty(name="Name", description="The object's name", default=kind.label),
        **kind_settings(kind),
    }
    name = identifier(kind)
    return type(
        f"MPHDRR_OT_add_{name}",
        (AddKind, bpy.types.Operator),
        {
            "__annotations__": own,
            "__doc__": f"``bpy.ops.mphdrr.add_{name}(voxels=64)``.",
            "bl_idname": ids.ADD_PHANTOM + name,
            "bl_label": f"Add {kind.label}",
            "bl_description": f"Add {kind.summary}, as a volume",
            "bl_options": {"REGISTER", "UNDO"},
            "kind": kind,
            "settings_kind": name.upper(),
        },
    )


ADD_KINDS = tuple(_operator(kind) for kind in KINDS)


class MPHDRR_OT_import_phantom(AddPhantom, bpy.types.Operator):
    """``bpy.ops.mphdrr.import_phantom(filepath="thorax.toml")``."""

    bl_idname = ids.IMPORT_PHANTOM
    bl_label = "Import Phantom"
    bl_description = "Add the phantom that a TOML file describes as a volume; its text becomes one of the .blend"
    bl_options = {"REGISTER", "UNDO"}

    __annotations__ = {
        "filepath": StringProperty(
            name="File", description="Phantom to read", subtype="FILE_PATH", options={"SKIP_SAVE"}
        ),
        "filter_glob": StringProperty(default="*.toml", options={"HIDDEN"}),
        "name": StringProperty(name="Name", description="Of the object; empty: the phantom's", options={"SKIP_SAVE"}),
        **sampling(),
    }

    settings_kind = FILE.upper()

    def ask(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str] | None:
        if self.filepath:
            return None
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def job(self, context: bpy.types.Context) -> jobs.Job:
        if not self.filepath:
            raise InputError("no file given: set filepath to a phantom's TOML file")
        return self.adding(self.name or read_phantom(self._path()).name or self._path().stem)

    def phantom(self) -> Phantom:
        return read_phantom(self._path())

    def recipe(self) -> dict[str, Any]:
        path = self._path()
        return {"phantom": FILE, "file": path.name, "text": path.read_text(encoding="utf-8-sig")}

    def _path(self) -> Path:
        return Path(bpy.path.abspath(self.filepath))


class MPHDRR_FH_phantom(bpy.types.FileHandler):
    """A phantom's file dropped on the viewport is added."""

    bl_idname = ids.FILE_HANDLER_PHANTOM
    bl_label = "Phantom"
    bl_import_operator = ids.IMPORT_PHANTOM
    bl_file_extensions = ".toml"

    @classmethod
    def poll_drop(cls, context: bpy.types.Context) -> bool:
        return context.area is not None and context.area.type == "VIEW_3D"
