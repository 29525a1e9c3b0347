"""Clicks on pictures and planes: pick a module, a pixel whose ray and epipolar lines are drawn, or an end of the window."""

from contextlib import suppress

import bpy
import numpy as np
from bpy.props import EnumProperty, FloatProperty, IntProperty
from bpy_extras import view3d_utils

from ..addon.blender import choices, decimals, eyedropper, ids, reports
from ..addon.perspective import epipolar, epipolar_drawing
from ..addon.pictures import images, tiles
from ..core.errors import InputError

_COUNTED = "Of the pixel, counted as in the arrays; 0: the centre of pixel 0"


class MPHDRR_OT_pick_pixel(eyedropper.Eyedropper, reports.Reported, bpy.types.Operator):
    """Click on a pixel of a projection, in the Image Editor or on a plane in the scene: its ray is drawn there, and on the
    other modules' projections its epipolar lines. Esc or a right click leaves all as it was
    """

    module: IntProperty(name="Module", description="Number of the module", default=1, options={"SKIP_SAVE"})
    column: FloatProperty(name="Column", description=_COUNTED, options={"SKIP_SAVE"})
    row: FloatProperty(name="Row", description=_COUNTED, options={"SKIP_SAVE"})
    k: FloatProperty(
        name="k", description="Magnification of the marker in this module; 0: as it was, or that of the isocentre", min=0.0,
        options={"SKIP_SAVE"},
    )  # fmt: skip

    target_words = "a pixel of a projection"
    poll = reports.needs(images.PROJECTED)

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        try:
            epipolar.required_views(context.scene)
        except InputError as error:
            self.report({"ERROR"}, reports.in_window(error))
            return {"CANCELLED"}
        return super().invoke(context, event)

    def act(self, context: bpy.types.Context) -> str:
        pixel = (decimals.typed(each) for each in (self.column, self.row, self.k))
        found = epipolar.pick_pixel(context.scene, self.module, *pixel)
        column, row = found.pixel
        return f"Module {self.module}, column {column:g}, row {row:g}: {found.seen_by} modules see the marker"

    def target_under(self, context: bpy.types.Context, event: bpy.types.Event) -> tuple[int, int, int] | None:
        """The module's number, and column and row, of the pixel under the mouse."""
        found, run = eyedropper.region_under(context, event), epipolar.run_views(context.scene)
        if found is None or run is None:
            return None
        area, region, place = found
        if area.type == "IMAGE_EDITOR":
            at = tiles.picture_at(area.spaces.active.image, *region.view2d.region_to_view(*place))
            return None if at is None else (at[0].number, *at[0].pixel_at(at[1], run.views.shape))
        if area.type != "VIEW_3D":
            return None
        origin, direction = (
            np.array(function(region, region.data, place), np.float64)
            for function in (view3d_utils.region_2d_to_origin_3d, view3d_utils.region_2d_to_vector_3d)
        )
        return epipolar_drawing.plane_pixel(context, run, origin, direction)

    def status_text(self, found: tuple[int, int, int] | None) -> str:
        if found is None:
            return f"Click on {self.target_words}, in the Image Editor or on a plane   (Esc: cancel)"
        return "Module {}, column {}, row {}   (click: pick; Esc: cancel)".format(*found)

    def pick(self, context: bpy.types.Context, found: tuple[int, int, int]) -> bool:
        self.module, self.column, self.row = found
        with suppress(InputError):  # a module that is hidden, or not in the scene any more, has its pixel all the same
            tiles.activate(context, self.module)
        return self.execute(context) == {"FINISHED"}


class MPHDRR_OT_clear_pixel(reports.Reported, bpy.types.Operator):
    """Draw no ray and no epipolar lines any more"""

    bl_label = "Clear Picked Pixel"

    poll = reports.needs((lambda context: context.scene.mphdrr_epipolar.views, "No pixel is picked"))

    def act(self, context: bpy.types.Context) -> None:
        epipolar.clear(context.scene)


def _has_image_editor(context: bpy.types.Context) -> bool:
    return bool(context.window) and any(area.type == "IMAGE_EDITOR" for area in context.window.screen.areas)


class MPHDRR_OT_pick_window(eyedropper.Eyedropper, bpy.types.Operator):
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

    target_words = "a picture of the projections"
    poll = reports.needs(
        (lambda context: images.tiles(bpy.data.images.get(ids.MOSAIC)), images.PROJECTED[1]),
        (_has_image_editor, "No Image Editor is open: press Show Mosaic"),
    )

    def target_under(self, context: bpy.types.Context, event: bpy.types.Event) -> tuple[str, float] | None:
        """The exact number under the mouse, and what it is."""
        found = eyedropper.region_under(context, event)
        if found is None or found[0].type != "IMAGE_EDITOR":
            return None
        area, region, place = found
        return tiles.value_at(area.spaces.active.image, *region.view2d.region_to_view(*place))

    def pick(self, context: bpy.types.Context, found: tuple[str, float]) -> bool:
        shown = images.tiles(bpy.data.images[ids.MOSAIC]) or {}
        settings = context.scene.mphdrr_display
        window = shown.get("window", (settings.low, settings.high))
        try:
            tiles.set_window(settings, self.end.lower(), found[1], window)
        except InputError as error:
            self.report({"WARNING"}, reports.in_window(error))
            return False
        self.report({"INFO"}, f"Window {self.end.lower()} is {found[1]:g} {shown['unit']}: {found[0]}")
        return True

    def status_text(self, found: tuple[str, float] | None) -> str:
        unit = (images.tiles(bpy.data.images.get(ids.MOSAIC)) or {}).get("unit", "")
        text = f"{found[0]}: {found[1]:g} {unit}" if found else f"Click on {self.target_words}"
        return f"{text}   (click: window {self.end.lower()}; Esc: cancel)"


def _shows_mosaic(context: bpy.types.Context) -> bool:
    space = context.space_data
    return space is not None and space.type == "IMAGE_EDITOR" and images.tiles(space.image) is not None


class MPHDRR_OT_pick_module(bpy.types.Operator):
    """Make the module active whose image in the mosaic is clicked"""

    bl_options = {"UNDO", "INTERNAL"}

    poll = reports.needs((_shows_mosaic, "Only in an Image Editor that shows the mosaic"))

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        try:
            picked = tiles.pick_module(context, event.mouse_region_x, event.mouse_region_y)
        except InputError as error:
            self.report({"WARNING"}, reports.in_window(error))
            return {"CANCELLED"}
        return {"PASS_THROUGH"} if picked is None else {"FINISHED"}
