"""Operators of clicks on pictures and planes: pick a module, a pixel with its epipolar lines, or an end of the window."""

from contextlib import suppress

import bpy
import numpy as np
from bpy.props import EnumProperty, FloatProperty, IntProperty
from bpy_extras import view3d_utils

from ..addon.blender import choices, decimals, eyedropper, ids, reports
from ..addon.perspective import epipolar, epipolar_drawing
from ..addon.pictures import images, tiles
from ..core.errors import InputError

_INDEX = "Index of the pixel as in the arrays; 0: the centre of pixel 0"


class MPHDRR_OT_pick_pixel(eyedropper.Eyedropper, reports.Reported, bpy.types.Operator):
    """Click on a pixel of a projection, in the Image Editor or on a plane in the scene, to draw its ray, and its epipolar
    lines on the other modules' projections. Esc or a right click changes nothing.
    """

    module: IntProperty(name="Module", description="Number of the module", default=1, options={"SKIP_SAVE"})
    column: FloatProperty(name="Column", description=_INDEX, options={"SKIP_SAVE"})
    row: FloatProperty(name="Row", description=_INDEX, options={"SKIP_SAVE"})
    k: FloatProperty(name="k",
                     description="Magnification of the marker in this module; 0: unchanged, or that of the isocentre",
                     min=0.0, options={"SKIP_SAVE"})  # fmt: skip

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
        coordinates = (decimals.typed(number) for number in (self.column, self.row, self.k))
        picked = epipolar.pick_pixel(context.scene, self.module, *coordinates)
        column, row = picked.pixel
        return f"Module {self.module}, column {column:g}, row {row:g}: seen by {ids.counted(picked.seen_by, 'module')}"

    def target_under(self, context: bpy.types.Context, event: bpy.types.Event) -> tuple[int, int, int] | None:
        """Return the module's number, the column and the row of the pixel under the mouse, or None."""
        mouse, run = eyedropper.region_under(context, event), epipolar.run_views(context.scene)
        if mouse is None or run is None:
            return None
        area, region, place = mouse
        if area.type == "IMAGE_EDITOR":
            hit = tiles.picture_at(area.spaces.active.image, *region.view2d.region_to_view(*place))
            return None if hit is None else (hit[0].number, *hit[0].pixel_at(hit[1], run.views.shape))
        if area.type != "VIEW_3D":
            return None
        origin, direction = (
            np.array(function(region, region.data, place), np.float64)
            for function in (view3d_utils.region_2d_to_origin_3d, view3d_utils.region_2d_to_vector_3d)
        )
        return epipolar_drawing.plane_pixel(context, run, origin, direction)

    def status_text(self, pixel: tuple[int, int, int] | None) -> str:
        """Return the status bar's text for the pixel under the mouse, if any."""
        if pixel is None:
            return f"Click on {self.target_words}, in the Image Editor or on a plane   (Esc: cancel)"
        return "Module {}, column {}, row {}   (click: pick; Esc: cancel)".format(*pixel)

    def pick(self, context: bpy.types.Context, pixel: tuple[int, int, int]) -> bool:
        """Pick the clicked pixel; return whether that succeeded."""
        self.module, self.column, self.row = pixel
        with suppress(InputError):  # the pixel can be picked even if its module is hidden or not in the scene any more
            tiles.activate(context, self.module)
        return self.execute(context) == {"FINISHED"}


class MPHDRR_OT_clear_pixel(reports.Reported, bpy.types.Operator):
    """Remove the picked pixel's ray and epipolar lines."""

    bl_label = "Clear Picked Pixel"

    poll = reports.needs((lambda context: context.scene.mphdrr_epipolar.views, "No pixel is picked"))

    def act(self, context: bpy.types.Context) -> None:
        epipolar.clear(context.scene)


def _has_image_editor(context: bpy.types.Context) -> bool:
    """Return whether an Image Editor is open in the window."""
    return bool(context.window) and any(area.type == "IMAGE_EDITOR" for area in context.window.screen.areas)


class MPHDRR_OT_pick_window(eyedropper.Eyedropper, bpy.types.Operator):
    """Click on a picture of the projections to make the exact number there the window's low or high end. The status bar
    shows the number under the mouse; Esc or a right click changes nothing.
    """

    bl_options = {"REGISTER", "UNDO"}

    end: EnumProperty(
        name="End", description="End of the window that the number becomes",
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
        """Return the description and the exact value of the number under the mouse, or None."""
        if (mouse := eyedropper.region_under(context, event)) is None or mouse[0].type != "IMAGE_EDITOR":
            return None
        area, region, place = mouse
        return tiles.value_at(area.spaces.active.image, *region.view2d.region_to_view(*place))

    def pick(self, context: bpy.types.Context, number: tuple[str, float]) -> bool:
        """Make the clicked number an end of the window; return whether that succeeded."""
        mosaic = images.tiles(bpy.data.images[ids.MOSAIC]) or {}
        settings = context.scene.mphdrr_display
        window = mosaic.get("window", (settings.low, settings.high))
        try:
            tiles.set_window(settings, self.end.lower(), number[1], window)
        except InputError as error:
            self.report({"WARNING"}, reports.in_window(error))
            return False
        self.report({"INFO"}, f"Window {self.end.lower()} is {number[1]:g} {tiles.unit()}: {number[0]}")
        return True

    def status_text(self, number: tuple[str, float] | None) -> str:
        """Return the status bar's text for the number under the mouse, if any."""
        text = f"{number[0]}: {number[1]:g} {tiles.unit()}" if number else f"Click on {self.target_words}"
        return f"{text}   (click: window {self.end.lower()}; Esc: cancel)"


def _shows_mosaic(context: bpy.types.Context) -> bool:
    """Return whether the mouse is in an Image Editor that shows the mosaic."""
    space = context.space_data
    return space is not None and space.type == "IMAGE_EDITOR" and images.tiles(space.image) is not None


class MPHDRR_OT_pick_module(bpy.types.Operator):
    """Make the module of the clicked image in the mosaic active."""

    bl_options = {"UNDO", "INTERNAL"}

    poll = reports.needs((_shows_mosaic, "Only in an Image Editor that shows the mosaic"))

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        try:
            picked = tiles.pick_module(context, event.mouse_region_x, event.mouse_region_y)
        except InputError as error:
            self.report({"WARNING"}, reports.in_window(error))
            return {"CANCELLED"}
        return {"PASS_THROUGH"} if picked is None else {"FINISHED"}
