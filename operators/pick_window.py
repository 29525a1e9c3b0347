"""The eyedropper for the window of the pictures: the number under the mouse becomes one of its ends."""

import bpy
from bpy.props import EnumProperty

from ..addon import choices, ids, images, tiles
from ..addon.reports import polled
from ..core.errors import InputError


class MPHDRR_OT_pick_window(bpy.types.Operator):
    """Click on a picture of the projections: the exact number there becomes the window's low or high end. The number under
    the mouse stands in the status bar; Esc or a right click leaves all as it was
    """

    bl_idname = ids.PICK_WINDOW
    bl_label = "Pick Window"
    bl_options = {"REGISTER", "UNDO"}

    end: EnumProperty(
        name="End", description="Which end of the window the number becomes",
        items=choices.items({}, (("LOW", "Low", "The number that has the first colour"),
                                 ("HIGH", "High", "The number that has the last colour"))),
        default="HIGH", options={"SKIP_SAVE"},
    )  # fmt: skip

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        shown = bool(context.window) and any(area.type == "IMAGE_EDITOR" for area in context.window.screen.areas)
        has_run = images.tiles(bpy.data.images.get(ids.MOSAIC)) is not None
        return polled(cls, has_run, "No projections yet: render them first") and polled(
            cls, shown, "No Image Editor is open: press Show Mosaic"
        )

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        context.window.cursor_modal_set("EYEDROPPER")
        context.window_manager.modal_handler_add(self)
        self._say(context, event)
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if event.type in {"ESC", "RIGHTMOUSE"}:
            return self._end(context, "CANCELLED")
        if event.type == "LEFTMOUSE" and event.value == "PRESS":
            return self._pick(context, event)
        if event.type == "MOUSEMOVE":
            self._say(context, event)
        return (
            {"PASS_THROUGH"} if event.type in {"MIDDLEMOUSE", "WHEELUPMOUSE", "WHEELDOWNMOUSE"} else {"RUNNING_MODAL"}
        )

    def cancel(self, context: bpy.types.Context) -> None:
        """Blender ends the operator: another file is loaded, or the window is closed."""
        self._end(context, "CANCELLED")

    def _pick(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        found = _under(context, event)
        if found is None:
            self.report({"WARNING"}, "Click on a picture of the projections, or press Esc")
            return {"RUNNING_MODAL"}
        shown = images.tiles(bpy.data.images[ids.MOSAIC]) or {}
        settings = context.scene.mphdrr_display
        window = shown.get("window", (settings.low, settings.high))
        try:
            tiles.set_window(settings, self.end.lower(), found[1], window)
        except InputError as error:
            self.report({"WARNING"}, str(error))
            return {"RUNNING_MODAL"}
        self.report({"INFO"}, f"Window {self.end.lower()} is {found[1]:g} {shown['unit']}: {found[0]}")
        return self._end(context, "FINISHED")

    def _say(self, context: bpy.types.Context, event: bpy.types.Event) -> None:
        """Show the number under the mouse in the status bar."""
        found = _under(context, event)
        unit = (images.tiles(bpy.data.images.get(ids.MOSAIC)) or {}).get("unit", "")
        text = f"{found[0]}: {found[1]:g} {unit}" if found else "Click on a picture of the projections"
        context.workspace.status_text_set(f"{text}   (click: window {self.end.lower()}; Esc: cancel)")

    def _end(self, context: bpy.types.Context, result: str) -> set[str]:
        context.window.cursor_modal_restore()
        context.workspace.status_text_set(None)
        return {result}


def _under(context: bpy.types.Context, event: bpy.types.Event) -> tuple[str, float] | None:
    """The exact number under the mouse, and what it is; None where there is none."""
    for area in context.window.screen.areas:
        region = next((region for region in area.regions if region.type == "WINDOW"), None)
        if area.type != "IMAGE_EDITOR" or region is None:
            continue
        x, y = event.mouse_x - region.x, event.mouse_y - region.y
        if 0 <= x < region.width and 0 <= y < region.height:
            return tiles.value_at(area.spaces.active.image, *region.view2d.region_to_view(x, y))
    return None
