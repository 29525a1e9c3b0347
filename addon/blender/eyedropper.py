"""What the operators have in common that wait for a click on a picture or a plane."""

from typing import Any

import bpy


class Eyedropper:
    """Mix into an operator that takes what is under the mouse with a click; Esc or a right click ends it.

    What is under the mouse stands in the status bar.
    """

    asks = ""
    """What the user is to click on, such as "a picture"."""

    def under(self, context: bpy.types.Context, event: bpy.types.Event) -> Any:
        """What is under the mouse; None where there is nothing to take."""
        raise NotImplementedError

    def says(self, found: Any) -> str:
        """The status bar's text, where that is under the mouse."""
        raise NotImplementedError

    def takes(self, context: bpy.types.Context, found: Any) -> bool:
        """Take what was under the mouse, and report; returns whether it could be taken."""
        raise NotImplementedError

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Wait for the click."""
        context.window.cursor_modal_set("EYEDROPPER")
        context.window_manager.modal_handler_add(self)
        context.workspace.status_text_set(self.says(self.under(context, event)))
        return {"RUNNING_MODAL"}

    def modal(self: Any, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Take what is clicked on; views may be moved meanwhile."""
        if event.type in {"ESC", "RIGHTMOUSE"}:
            return self._end(context, "CANCELLED")
        if event.type == "LEFTMOUSE" and event.value == "PRESS":
            found = self.under(context, event)
            if found is None:
                self.report({"WARNING"}, f"Click on {self.asks}, or press Esc")
            elif self.takes(context, found):
                return self._end(context, "FINISHED")
            return {"RUNNING_MODAL"}
        if event.type == "MOUSEMOVE":
            context.workspace.status_text_set(self.says(self.under(context, event)))
        moves_view = event.type in {"MIDDLEMOUSE", "WHEELUPMOUSE", "WHEELDOWNMOUSE"}
        return {"PASS_THROUGH"} if moves_view else {"RUNNING_MODAL"}

    def cancel(self, context: bpy.types.Context) -> None:
        """Blender ends the operator: another file is loaded, or the window is closed."""
        self._end(context, "CANCELLED")

    def _end(self, context: bpy.types.Context, result: str) -> set[str]:
        context.window.cursor_modal_restore()
        context.workspace.status_text_set(None)
        return {result}


def region_under(context: bpy.types.Context, event: bpy.types.Event) -> tuple[Any, Any, tuple[int, int]] | None:
    """The editor under the mouse, its main region, and the place in that, pixels."""
    for area in context.window.screen.areas:
        for region in area.regions:
            x, y = event.mouse_x - region.x, event.mouse_y - region.y
            if region.type == "WINDOW" and 0 <= x < region.width and 0 <= y < region.height:
                return area, region, (x, y)
    return None
