"""Operators that add phantoms: one for every kind, and one for phantoms that a TOML file describes."""

from typing import Any

import bpy
from bpy.props import BoolProperty, FloatProperty, FloatVectorProperty, StringProperty

from ..addon.blender import file_properties, jobs, layouts, storage
from ..addon.phantoms import phantoms
from ..addon.phantoms.phantom_properties import AUTO_SIZE, FILE, PhantomSettings, identifier, sampling, settings_class
from ..addon.runs import projection_properties
from ..addon.scanner import scanner
from ..core import Phantom, euler_pose, read_phantom
from ..core.phantoms.kinds import KINDS


class AddPhantom(jobs.JobOperator):
    """Base class of operators with the settings of a phantom, which they add to the scene."""

    attenuation: BoolProperty(
        name="With Attenuation",
        description="Add the volume of attenuation coefficients too, as a child of the activity",
    )
    location: FloatVectorProperty(name="Location", description="Origin of the phantom's frame, world mm")
    phi: FloatProperty(name="Phi", description="Turn about world z, done last", subtype="ANGLE")
    theta: FloatProperty(name="Theta", description="Turn about world y, after psi", subtype="ANGLE")
    psi: FloatProperty(name="Psi", description="Turn about the phantom's own axis, done first", subtype="ANGLE")

    def invoke(self: Any, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Choose attenuation for a scanner that sees nothing else, or a model that suits the phantom, and run the job."""
        sees_activity = scanner.sees_activity(scanner.active_scanner(context.scene))
        if not self.properties.is_property_set("attenuation"):
            self.attenuation = not sees_activity
        if self.confirmed and sees_activity:
            projection_properties.fit_model(context.scene.mphdrr_projections, self.quantity)
        return super().invoke(context, event)

    def draw(self: Any, context: bpy.types.Context) -> None:
        layout = layouts.labelled(self.layout)
        self.draw_settings(layout)
        row = layout.row()
        row.enabled = self.quantity == "activity"
        row.prop(self, "attenuation")
        layout.column(align=True).prop(self, "location")
        layouts.draw_all(layout.column(align=True), self, "phi", "theta", "psi")

    def adding(self: Any, name: str) -> jobs.Job:
        pose = euler_pose(self.phi, self.theta, self.psi, self.location)
        return phantoms.add_phantom_job(self, name, pose, self.attenuation)


class AddKind(AddPhantom):
    """Base class of the operators that add one kind of phantom."""

    dialog = {"confirm_text": "Add", "width": 340}

    def job(self: Any, context: bpy.types.Context) -> jobs.Job:
        return self.adding(self.name)


# Operators that add one kind each; the settings of the kind are the operator's arguments.
ADD_KINDS = tuple(
    settings_class(
        kind,
        f"MPHDRR_OT_add_{identifier(kind)}",
        (AddKind, bpy.types.Operator),
        __annotations__={"name": StringProperty(name="Name", description="The object's name", default=kind.label)},
        __doc__=f"Add {kind.summary}, as a volume",
        bl_label=f"Add {kind.label}",
    )
    for kind in KINDS
)


class MPHDRR_OT_import_phantom(PhantomSettings, AddPhantom, bpy.types.Operator):
    """Add the phantom that a TOML file describes as a volume; its text is kept in the .blend."""

    __annotations__ = {
        "filepath": file_properties.file_property("Phantom to read"),
        "filter_glob": file_properties.shown_files((".toml",)),
        "name": StringProperty(name="Name", description="Object's name; empty: phantom's", options={"SKIP_SAVE"}),
        **sampling(),
        **AUTO_SIZE,
    }
    identifier = FILE
    asks_for = "filepath"

    def job(self, context: bpy.types.Context) -> jobs.Job:
        path = self.required_file("set filepath to a phantom's TOML file")
        return self.adding(self.name or read_phantom(path).name or path.stem)

    def phantom(self) -> Phantom:
        return read_phantom(storage.absolute(self.filepath))

    def recipe(self) -> dict[str, Any]:
        path = storage.absolute(self.filepath)
        return {"phantom": FILE, "file": path.name, "text": path.read_text(encoding="utf-8-sig")}
