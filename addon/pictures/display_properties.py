"""Settings for showing projections: `Scene.mphdrr_display`."""

import bpy
from bpy.props import BoolProperty, EnumProperty, FloatProperty, FloatVectorProperty

from ...core.errors import InputError
from ...core.runs.display import COLORS, SCALES, Display
from ..blender import choices, updates

_SCALE_TEXTS = {
    "linear": ("Linear", "Colours in proportion to the numbers"),
    "sqrt": ("Square Root", "Small numbers are told apart better; noise of counts looks the same everywhere"),
    "log": ("Logarithmic", "Colours in proportion to the numbers' logarithms, over three decades unless typed"),
}
_REGIONS = choices.items({}, (
    ("OBJECT", "Object", "In the mosaic the part around the middle that holds what is seen, elsewhere whole images"),
    ("HALF", "Central Half", "The middle half of each image, often called FOV"),
    ("WHOLE", "Whole Images", "All of each image, the wide FOV"),
))  # fmt: skip
_PLANES = (
    ("NONE", "None", "No planes"),
    ("ACTIVE", "Active", "The plane of the active module"),
    ("RING", "Ring", "The planes of the active module's ring"),
    ("ALL", "All", "The planes of all visible modules"),
)


def _show_region(self: bpy.types.PropertyGroup, number: int) -> None:
    """Show the region of this number."""
    self.half, self.is_whole = (number == part[3] for part in _REGIONS[1:])


class DisplayProperties(bpy.types.PropertyGroup):
    """Colours, window and planes with which the last run's projections are shown; the exact numbers stay."""

    colors: EnumProperty(name="Colors", description="Colours of the numbers; all but grey are perceptually uniform",
                         items=choices.items({}, ((name.upper(), name.capitalize(), "") for name in COLORS)),
                         default="INFERNO", update=updates.on_edit("display"))  # fmt: skip
    scale: EnumProperty(name="Scale", description="Relation between numbers and colours",
                        items=choices.items({}, ((name.upper(), *_SCALE_TEXTS[name]) for name in SCALES)),
                        default="LINEAR", update=updates.on_edit("display"))  # fmt: skip
    automatic: BoolProperty(name="Automatic",
                            description="Show the numbers from 0, or from the smallest, to the largest", default=True,
                            update=updates.on_edit("display"))  # fmt: skip
    low: FloatProperty(name="Low", description="Number with the first colour", update=updates.on_edit("display"))
    high: FloatProperty(
        name="High", description="Number with the last colour", default=1.0, update=updates.on_edit("display")
    )
    region: EnumProperty(name="Show", description="Part of each image that the pictures show; the exact images stay whole",
                        items=_REGIONS, get=lambda self: _REGIONS[1 if self.half else 2 * self.is_whole][3],
                        set=_show_region)  # fmt: skip
    half: BoolProperty(name="Central Half", options={"HIDDEN"}, update=updates.on_edit("display"))
    is_whole: BoolProperty(name="Whole Images", options={"HIDDEN"}, update=updates.on_edit("display"))
    planes: EnumProperty(name="Planes", description="Modules whose projections stand in the scene",
                         items=choices.items({}, _PLANES), default="ALL", update=updates.on_edit("planes"))  # fmt: skip
    plane_distance: FloatProperty(name="Distance",
                                  description="Distance of the planes from the pinholes, mm; 0: automatic", min=0.0,
                                  soft_max=500.0, update=updates.on_edit("planes"))  # fmt: skip
    preview_place: FloatVectorProperty(
        name="Preview's Place", description="Position of the live preview in the 3D views, 0 to 1 to the right and up",
        size=2, default=(1.0, 0.0), min=0.0, max=1.0, options={"HIDDEN"},
    )  # fmt: skip
    plane_at_detector: BoolProperty(name="At Virtual Detector",
                                    description="Put the planes at the virtual detectors, behind the ROI",
                                    update=updates.on_edit("planes"))  # fmt: skip
    plane_opacity: FloatProperty(
        name="Opacity", description="Opacity of the planes and of pictures in the cameras' views", subtype="FACTOR", min=0.0,
        max=1.0, default=1.0, update=updates.on_edit("planes"),
    )  # fmt: skip
    backgrounds: BoolProperty(name="In Camera Views",
                              description="Lay each projection over the view of its module's camera", default=True,
                              update=updates.on_edit("planes"))  # fmt: skip

    @property
    def problem(self) -> str:
        """Problem of the window in words; "" for a valid window."""
        try:
            self.display()
        except InputError as error:
            return str(error)
        return ""

    def display(self) -> Display:
        """Return the colours, scale, window and shown part; raise `InputError` for an invalid window."""
        low, high = (None, None) if self.automatic else (self.low, self.high)
        return Display(self.colors.lower(), self.scale.lower(), low, high, self.region.lower())


CLASSES = (DisplayProperties,)
