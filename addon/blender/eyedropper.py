"""Base class of the operators that wait for a click on a picture or a plane."""

from typing import Any

import bpy


class Eyedropper:
    """Mix-in of an operator that picks what lies under the mouse at a click; Esc or a right click ends it.

    The status bar describes the target under the mouse.
    """

    target_words = ""
    """The kind of target to click on, such as "a picture"."""

    def target_under(self, context: bpy.types.Context, event: bpy.types.Event) -> Any:
        """Return the target under the mouse, of any type; None where there is none."""
        raise NotImplementedError

    def status_text(self, target: Any) -> str:
        """Return the status bar's text for the target under the mouse."""
        raise NotImplementedError

    def pick(self, context: bpy.types.Context, target: Any) -> bool:
        """Pick the target, report what was done, and return whether it could be picked."""
        raise NotImplementedError

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Wait for the click."""
        context.window.cursor_modal_set("EYEDROPPER")
        context.window_manager.modal_handler_add(self)
        context.workspace.status_text_set(self.status_text(self.target_under(context, event)))
        return {"RUNNING_MODAL"}

    def modal(self: Any, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Pick the target that is clicked on; mouse wheel and middle button still move the view."""
        if event.type in {"ESC", "RIGHTMOUSE"}:
            return self._end(context, "CANCELLED")
        if event.type == "LEFTMOUSE" and event.value == "PRESS":
            if (target := self.target_under(context, event)) is None:
                self.report({"WARNING"}, f"Click on {self.target_words}, or press Esc")
            elif self.pick(context, target):
                return self._end(context, "FINISHED")
            return {"RUNNING_MODAL"}
        if event.type == "MOUSEMOVE":
            context.workspace.status_text_set(self.status_text(self.target_under(context, event)))
        moves_view = event.type in {"MIDDLEMOUSE", "WHEELUPMOUSE", "WHEELDOWNMOUSE"}
        return {"PASS_THROUGH"} if moves_view else {"RUNNING_MODAL"}

    def cancel(self, context: bpy.types.Context) -> None:
        """Restore mouse pointer and status bar; Blender calls this where it loads another file or closes the window."""
        self._end(context, "CANCELLED")

    def _end(self, context: bpy.types.Context, result: str) -> set[str]:
        """End the picking: restore the cursor and the status bar, and return `result` for Blender."""
        context.window.cursor_modal_restore()
        context.workspace.status_text_set(None)
        return {result}


def region_under(context: bpy.types.Context, event: bpy.types.Event) -> tuple[Any, Any, tuple[int, int]] | None:
    """Return the editor under the mouse, its main region, and the mouse's position (x, y) in it, pixels; None elsewhere."""
    for area in context.window.screen.areas:
        for region in area.regions:
            x, y = event.mouse_x - region.x, event.mouse_y - region.y
            if region.type == "WINDOW" and 0 <= x < region.width and 0 <= y < region.height:
                return area, region, (x, y)
    return None
