"""Overlaps, blocked holes and an ROI that is not seen, shown on the modules."""

from __future__ import annotations

import json
from dataclasses import asdict

import bpy

from ..addon import design, ids, scanner, selection
from ..addon.reports import warnings_reported
from ..core.errors import InputError


class MPHDRR_OT_check_geometry(bpy.types.Operator):
    """``bpy.ops.mphdrr.check_geometry()``."""

    bl_idname = ids.CHECK_GEOMETRY
    bl_label = "Check Geometry"
    bl_description = (
        "Look for collimators and crystals that overlap, holes that another module blocks, and modules that do not see "
        "their ROI; select the modules concerned"
    )
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return selection.poll_scanner(cls, context)

    def execute(self, context: bpy.types.Context) -> set[str]:
        from ..core.geometry.checks import check_geometry

        collection = scanner.required_scanner(context.scene)
        properties = collection.mphdrr_scanner
        try:
            with warnings_reported(self):
                built = asdict(design.construction(properties))
                report = check_geometry(scanner.read_scanner(collection), **built)
        except InputError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        found = report.messages()
        concerned = []
        with design.writing():
            properties.findings = json.dumps(found)
            for camera in scanner.modules(collection):
                own = report.messages(camera.mphdrr_module.number)
                camera.mphdrr_module.finding = "; ".join(own)
                concerned += [camera] if own else []
        if concerned:
            selection.select(context, concerned)
        self.report(
            {"WARNING"} if found else {"INFO"},
            f"{len(found)} findings at {len(concerned)} modules: see the Design panel" if found else "Nothing found",
        )
        return {"FINISHED"}
