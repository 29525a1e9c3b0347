"""Operators that add a system of X-ray sources and panels beside the pinholes, and use its CT for SPECT."""

from __future__ import annotations

import math
from typing import Any

import bpy
from bpy.props import EnumProperty, FloatProperty, IntProperty, StringProperty

from ..addon import spect_ct
from ..addon.blender import choices, jobs, layouts
from ..addon.blender.decimals import typed
from ..addon.blender.reports import Reported, needs
from ..addon.figures import studio
from ..addon.scanner import scanner
from ..core import xray_arc, xray_ring

_DEFAULTS = {
    "ARC": {"start": math.radians(-98.0), "source_radius": 300.0, "panel_size": 350.0, "z": 200.0},
    "RING": {"start": 0.0, "source_radius": 400.0, "panel_size": 300.0, "z": 310.0},
}
"""Defaults in which `xray_arc` and `xray_ring` differ."""


def _set_defaults(self: MPHDRR_OT_add_xray_system, context: bpy.types.Context) -> None:
    """Set the numbers to the defaults of the chosen arrangement."""
    for name, value in _DEFAULTS[self.arrangement].items():
        setattr(self, name, value)


def _length(name: str, description: str, default: float, minimum: float = 1.0) -> object:
    """Return a property for a length in mm."""
    return FloatProperty(name=f"{name} (mm)", description=description, default=default, min=minimum, soft_max=1000.0)


def _angle(name: str, description: str, default: float) -> object:
    """Return a property for an angle, whose `default` is in degrees."""
    limits = {"min": -2 * math.pi, "max": 2 * math.pi}
    return FloatProperty(name=name, description=description, subtype="ANGLE", default=math.radians(default), **limits)


class MPHDRR_OT_add_xray_system(Reported, bpy.types.Operator):
    """Add X-ray sources, each with its panel opposite, as a scanner beside the pinhole modules, and make it active."""

    bl_label = "Add X-ray System"

    name: StringProperty(name="Name", description="The scanner's name; with a number, if it is taken", default="X-ray")
    arrangement: EnumProperty(
        name="Arrangement",
        description="Places of the sources; choosing one sets its usual numbers",
        items=choices.items(
            {},
            (
                ("ARC", "Arc", "In the open side of the modules"),
                ("RING", "Ring", "All around, above or below the modules"),
            ),
        ),
        update=_set_defaults,
    )
    sources: IntProperty(name="Sources", description="Number of sources", default=24, min=1, soft_max=100)
    start: _angle("First Source", "Azimuth of the first source, from +x towards +y", -98.0)
    end: _angle("Last Source", "Azimuth of the last source", 8.0)
    source_radius: _length("Source Radius", "From the isocentre to the sources, mm", 300.0)
    panel_radius: _length("Panel Radius", "From the isocentre to the panels' middles, mm", 400.0)
    panel_size: _length("Panel Size", "Side of the panels, mm", 350.0)
    z: _length("z", "z of the sources, mm; the panels are on the other side of the isocentre", 200.0, -1e4)
    pixels: IntProperty(name="Pixels", description="Along each side of a panel", default=128, min=1, soft_max=1024)
    kvp: FloatProperty(name="kVp", description="Tube voltage, kV", default=80.0, min=10.0, max=500.0)

    def draw(self, context: bpy.types.Context) -> None:
        layout = layouts.labelled(self.layout)
        layouts.draw_all(layout, self, "name", "arrangement", "sources")
        layouts.draw_all(layout, self, *(("start", "end") if self.arrangement == "ARC" else ("start",)))
        layouts.draw_all(layout, self, "source_radius", "panel_radius", "panel_size", "z", "pixels", "kvp")

    def act(self, context: bpy.types.Context) -> str:
        for name, value in _DEFAULTS[self.arrangement].items():
            if not self.properties.is_property_set(name):  # a script may have chosen the arrangement alone
                setattr(self, name, value)
        numbers = ("source_radius", "panel_radius", "panel_size", "z", "kvp")
        settings: dict[str, Any] = {name: typed(getattr(self, name)) for name in numbers}
        # Blender's float32 angles are rounded to the degrees that were typed.
        start, end = (math.radians(round(math.degrees(angle), 4)) for angle in (self.start, self.end))
        settings |= {"shape": (self.pixels, self.pixels), "start": start}
        is_arc = self.arrangement == "ARC"
        system = xray_arc(self.sources, end=end, **settings) if is_arc else xray_ring(self.sources, **settings)
        collection = scanner.build_scanner(context.scene, system, scanner.free_name(context.scene, self.name))
        studio.light(context.scene)
        context.view_layer.update()  # so that scripts find the children's matrix_world in place
        panel, reconstruction = context.scene.mphdrr_projections, context.scene.mphdrr_reconstruction
        panel.model = panel.fitted = "TRANSMISSION"
        if not reconstruction.is_property_set("method"):  # the default method is for counts
            reconstruction.method = reconstruction.fitted = "SIRT"
        return f"Added {len(system)} X-ray sources and panels as '{collection.name}'"


class MPHDRR_OT_use_ct(jobs.JobOperator, bpy.types.Operator):
    """Convert the reconstructed CT to CT numbers, and reconstruct SPECT with them: from now on the panels are about the
    pinholes and the activity. The body that the X rays saw attenuates its photons.
    """

    bl_label = "Use CT for SPECT"

    poll = needs(
        (
            lambda context: spect_ct.spect_inputs(context.scene),
            "Reconstruct X-ray Counts first, beside pinholes and an activity",
        )
    )

    def job(self, context: bpy.types.Context) -> jobs.Job:
        return spect_ct.use_ct_job(context)
