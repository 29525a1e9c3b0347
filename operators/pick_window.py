"""The eyedropper for the window of the pictures: the number under the mouse becomes one of its ends."""

import bpy
from bpy.props import EnumProperty

from ..addon.blender import choices, ids
from ..addon.blender.eyedropper import Eyedropper, region_under
from ..addon.blender.reports import needs
from ..addon.pictures import images, tiles
from ..core.errors import InputError


def _has_image_editor(context: bpy.types.Context) -> bool:
    return bool(context.window) and any(area.type == "IMAGE_EDITOR" for area in context.window.screen.areas)


class MPHDRR_OT_pick_window(Eyedropper, bpy.types.Operator):
    """Click on a picture of the projections: the exact number there becomes the window's low or high end. The number under
    the mouse stands in the status bar; Esc or a right click leaves all as it was
    """

    bl_options = {"REGISTER", "UNDO"}

    end: EnumProperty(
        name="End", description="Which end of the window the number becomes",
        items=choices.items({}, (("LOW", "Low", "The number that has the first colour"),
                                 ("HIGH", "High", "The number that has the last colour"))),
        default="HIGH", options={"SKIP_SAVE"},
    )  # fmt: skip

    asks = "a picture of the projections"
    poll = needs(
        (lambda context: images.tiles(bpy.data.images.get(ids.MOSAIC)), images.PROJECTED[1]),
        (_has_image_editor, "No Image Editor is open: press Show Mosaic"),
    )

    def under(self, context: bpy.types.Context, event: bpy.types.Event) -> tuple[str, float] | None:
        """The exact number under the mouse, and what it is."""
        found = region_under(context, event)
        if found is None or found[0].type != "IMAGE_EDITOR":
            return None
        area, region, place = found
        return tiles.value_at(area.spaces.active.image, *region.view2d.region_to_view(*place))

    def takes(self, context: bpy.types.Context, found: tuple[str, float]) -> bool:
        shown = images.tiles(bpy.data.images[ids.MOSAIC]) or {}
        settings = context.scene.mphdrr_display
        window = shown.get("window", (settings.low, settings.high))
        try:
            tiles.set_window(settings, self.end.lower(), found[1], window)
        except InputError as error:
            self.report({"WARNING"}, str(error))
            return False
        self.report({"INFO"}, f"Window {self.end.lower()} is {found[1]:g} {shown['unit']}: {found[0]}")
        return True

    def says(self, found: tuple[str, float] | None) -> str:
        unit = (images.tiles(bpy.data.images.get(ids.MOSAIC)) or {}).get("unit", "")
        text = f"{found[0]}: {found[1]:g} {unit}" if found else f"Click on {self.asks}"
        return f"{text}   (click: window {self.end.lower()}; Esc: cancel)"
