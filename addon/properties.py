"""Property groups of the extension: the settings in the panels, and the values stored in the .blend file.

Blender's FloatProperty is a float32: 100 mm is kept to 8e-6 mm only. `ModuleProperties.exact` therefore holds the
float64 numbers beside it (`module_values.py`). Names and enumeration numbers must stay as they are: old files have them.
"""

from __future__ import annotations

import math

import bpy
from bpy.props import (
    BoolProperty,
    EnumProperty,
    FloatProperty,
    FloatVectorProperty,
    IntProperty,
    PointerProperty,
    StringProperty,
)

from ..core.geometry.system import PinholeSystem
from .blender import choices, ids
from .blender.file_properties import path_property
from .blender.updates import FUNCTIONS, on_edit
from .events import event_properties
from .perspective import perspective_properties
from .phantoms import phantom_properties
from .pictures import display_properties
from .reconstruction import reconstruction_properties
from .runs import projection_properties
from .scanner import column_maps, columns, scanner
from .scanner.collimators import PARTS


# Functions, not lambdas: Blender evaluates annotations in a place where a lambda does not find this module's names.
def _is_visible(self: ModuleProperties) -> bool:
    """Return whether a module is shown in the viewport."""
    return not self.id_data.hide_viewport


def _set_visible(self: ModuleProperties, value: bool) -> None:
    """Show or hide a module."""
    FUNCTIONS["visible"](self.id_data, value)


_LENGTH_MODES = [
    ("FROM_ROI", "From ROI", "l follows b, d, Ld and R: the field of view is tangent to the ROI sphere", 0),
    ("TYPED", "Typed", "l stays as it was typed", 1),
]
_SEES_ROI = 1 - 1e-6  # radius seen, relative to R, from which on the ROI counts as seen: allows for rounding of `l`


class ModuleProperties(bpy.types.PropertyGroup):
    """Properties of a module, `Object.mphdrr_module`, on its camera object; other parts have `part` and `number` only.

    There is also a property for each typed column of any kind of scanner that is no coordinate (`add_columns`).
    """

    is_module: BoolProperty(name="Is Module", options={"HIDDEN"})
    part: EnumProperty(
        name="Part", description="Kind of part of a scanner", options={"HIDDEN"},
        default="NONE",
        items=choices.items(choices.PARTS, ((part, part.capitalize(), "") for part in dict.fromkeys((*ids.PARTS, *PARTS)))),
    )  # fmt: skip
    visible: BoolProperty(name="Visible",
                          description="Show the module, its collimator and its crystal, also in renders",
                          get=_is_visible, set=_set_visible)  # fmt: skip
    number: IntProperty(name="Number", description="Module number, as in the workbook")
    index: IntProperty(name="Index", description="Index of the module in its system, from 0", min=0, options={"HIDDEN"})
    ring: IntProperty(name="Ring", description="Ring of the module, counted from 0", min=0)
    added: BoolProperty(name="Added", description="The module is not in the workbook", options={"HIDDEN"})
    length_mode: EnumProperty(name="Length", description="Origin of the collimator's length l", items=_LENGTH_MODES,
                              default="TYPED", update=on_edit("module"))  # fmt: skip
    exact: StringProperty(name="Exact Values", description="Numbers and pose as imported, JSON", options={"HIDDEN"})
    placed: FloatVectorProperty(name="Placed", description="Position when last built, mm", size=3, options={"HIDDEN"})
    built: StringProperty(name="Built", description="Values behind the readouts", options={"HIDDEN"})
    # Readouts, which `following.py` writes and the panels show.
    pinhole_distance: FloatProperty(name="Pinhole Distance", description="Distance b to the isocentre, in mm")
    sensitivity: FloatProperty(name="Sensitivity", description="Ideal pinhole's sensitivity at the isocentre, cps/MBq")
    resolution: FloatProperty(name="Resolution", description="FWHM of hole and detector at the isocentre, in mm")
    magnification: FloatProperty(name="Magnification l / b", description="Magnification of the image on the crystal")
    roi_seen: FloatProperty(name="Radius Seen", description="Radius in mm of the largest sphere that is seen whole")
    aimed: BoolProperty(name="Aimed", description="The camera looks at the isocentre", default=True)
    problem: StringProperty(name="Problem", description="Reason why the module's numbers are impossible")
    finding: StringProperty(name="Finding", description="Findings of the last geometry check at this module")

    @property
    def sees_roi(self) -> bool:
        """Whether the module sees its whole ROI sphere."""
        return not self.problem and self.roi_seen >= _SEES_ROI * self.roi_radius


class ScannerProperties(bpy.types.PropertyGroup):
    """Properties of a scanner, `Collection.mphdrr_scanner`; it has the modules' properties, too."""

    is_scanner: BoolProperty(name="Is Scanner", options={"HIDDEN"})
    is_ring: BoolProperty(name="Is Ring", description="The collection is a ring of a scanner", options={"HIDDEN"})
    kind: StringProperty(name="Kind", description="Kind of the scanner", default=PinholeSystem.kind, options={"HIDDEN"})
    scanner_name: StringProperty(name="Scanner Name", description="Name in the import; the same name replaces it")
    workbook: path_property("Workbook", "Workbook that was last read or written")
    sha256: StringProperty(name="SHA-256", description="Checksum of the workbook when it was read")
    n_modules: IntProperty(name="Modules", description="Number of modules when the scanner was imported", min=0)
    source: StringProperty(name="Source", description="Workbook that the numbers come from, JSON", options={"HIDDEN"})
    plate_thickness: FloatProperty(
        name="Plate", description="Thickness of the aperture plates in mm", min=0.0, update=on_edit("scanner")
    )
    wall_thickness: FloatProperty(
        name="Wall", description="Thickness of the collimators' walls in mm", min=0.0, update=on_edit("scanner")
    )
    opening_angle: FloatProperty(
        name="Opening Angle", description="Full angle of the double cone in which holes open from the knife edge",
        subtype="ANGLE", default=math.pi / 2, min=0.01, max=3.1, update=on_edit("scanner"),
    )  # fmt: skip
    edge_at: EnumProperty(
        name="Knife Edge", description="Depth of the knife edge in the plate; it stays at the pinhole's centre",
        items=[
            ("MIDDLE", "Middle", "In the middle of the plate", 0),
            ("FRONT", "Front", "On the plate's face towards the ROI", 1),
            ("BACK", "Back", "On the plate's face towards the crystal", 2),
        ],
        default="MIDDLE", update=on_edit("scanner"),
    )  # fmt: skip
    intrinsic_fwhm: FloatProperty(
        name="Intrinsic FWHM", description="Resolution of the detectors on the crystal in mm, for the readouts; 0: ideal",
        min=0.0, soft_max=10.0, step=10, update=on_edit("scanner"),
    )  # fmt: skip
    bore: FloatProperty(
        name="Bore", description="Radius in mm around the z axis that the patient needs, for Check Geometry; 0: unchecked",
        min=0.0, soft_max=500.0,
    )  # fmt: skip
    keep_aimed: BoolProperty(
        name="Keep Aimed",
        description="Turn a module that is moved so that it keeps looking at the isocentre. One that is only turned "
        "stays turned: it is tilted. What an animation, a constraint or a deformed parent moves keeps its direction",
        default=True, update=on_edit("scanner"),
    )  # fmt: skip
    # The modules' properties have the first module's values here. `mixed` names those that differ between modules.
    length_mode: EnumProperty(
        name="Length", description="Origin of the collimators' lengths l. Changing it sets all modules",
        items=_LENGTH_MODES, default="TYPED", update=on_edit("all_modules", "length_mode"),
    )  # fmt: skip
    mixed: StringProperty(name="Mixed", description="Names of the numbers that differ between modules")
    # Readouts of all modules together, which `following.py` writes.
    count: IntProperty(name="Modules", description="Present number of modules", min=0)
    sensitivity: FloatProperty(name="Sensitivity", description="Sensitivity of all modules at the isocentre, cps/MBq")
    resolution: FloatProperty(name="Resolution", description="Mean FWHM in mm of the modules at the isocentre")
    n_covering: IntProperty(name="Covering", description="Number of modules that see their whole ROI sphere")
    parts_free: BoolProperty(name="Free", description="Parts may be grabbed; 0.1.0 locked them", options={"HIDDEN"})
    untidy: StringProperty(name="Untidy", description="Copied cameras and parts without a camera, in words")
    findings: StringProperty(name="Findings", description="Findings of the last geometry check, JSON")
    design: StringProperty(name="Design", description="Result of the last design, lines as JSON")
    calibration: StringProperty(name="Calibration", description="Result of the last calibration, lines as JSON")


class GeometryProperties(bpy.types.PropertyGroup):
    """State of the Geometry panel; `Scene.mphdrr_geometry`."""

    scanner: PointerProperty(name="Scanner", description="Scanner that the panels work on: the active object's",
                             type=bpy.types.Collection, poll=lambda self, item: item.mphdrr_scanner.is_scanner,
                             update=on_edit("scanner_chosen"))  # fmt: skip
    active_index: IntProperty(name="Active Module", description="Index in the list", update=on_edit("active_module"))
    all_at_once: BoolProperty(name="All Modules", description="Show and change all modules, not the active one alone")
    visible: StringProperty(
        name="Visible Modules", description="Numbers of the modules that are shown, such as 1-40, 45; empty: all",
        get=scanner.visible_modules, set=scanner.show_visible_modules, search=scanner.suggested_ranges,
    )  # fmt: skip
    visible_problem: StringProperty(name="Problem", description="Reason why modules stay hidden", options={"SKIP_SAVE"})
    # Lines that `sight_lines.py` draws in the 3D views.
    show_rays: BoolProperty(name="Ray",
                            description="Draw the principal ray, through the isocentre to the virtual detector",
                            update=on_edit("sight_lines"))  # fmt: skip
    show_frustums: BoolProperty(
        name="Frustum", description="Draw the field of view, from the pinhole to the virtual detector's corners",
        update=on_edit("sight_lines"),
    )  # fmt: skip
    show_detectors: BoolProperty(name="Detector",
                                 description="Draw the virtual detector at its distance, the magnification times l",
                                 update=on_edit("sight_lines"))  # fmt: skip
    sight_all: BoolProperty(name="All Modules",
                            description="Draw the lines of all visible modules, not of the active one only",
                            update=on_edit("sight_lines"))  # fmt: skip


_ROOMS = (
    phantom_properties, projection_properties, reconstruction_properties, display_properties,
    perspective_properties, event_properties, column_maps,
)  # fmt: skip
_OWN_ANNOTATIONS = {cls: dict(cls.__annotations__) for cls in (ModuleProperties, ScannerProperties)}


def add_columns() -> None:
    """Give modules and scanners the properties of all typed columns of the present kinds, before they are registered."""
    all_columns = columns.all_columns()
    for cls, make_update, suffix in (
        (ModuleProperties, lambda name: on_edit("length" if callable(all_columns[name].blank) else "module"), ""),
        (ScannerProperties, lambda name: on_edit("all_modules", name), ". Changing it sets all modules"),
    ):
        cls.__annotations__ = columns.make_properties(make_update, suffix) | _OWN_ANNOTATIONS[cls]


# All property groups; a group comes after those that it refers to.
CLASSES = (ModuleProperties, ScannerProperties, GeometryProperties, *(cls for room in _ROOMS for cls in room.CLASSES))

# (Blender type, attribute name, group): `registration.py` attaches a `PointerProperty` of the group to the type.
POINTERS = (
    (bpy.types.Object, "mphdrr_module", ModuleProperties),
    (bpy.types.Collection, "mphdrr_scanner", ScannerProperties),
    (bpy.types.Scene, "mphdrr_geometry", GeometryProperties),
    (bpy.types.Object, "mphdrr_volume", phantom_properties.VolumeProperties),
    (bpy.types.Scene, "mphdrr_projections", projection_properties.ProjectionProperties),
    (bpy.types.Scene, "mphdrr_reconstruction", reconstruction_properties.ReconstructionProperties),
    (bpy.types.Scene, "mphdrr_display", display_properties.DisplayProperties),
    (bpy.types.Scene, "mphdrr_epipolar", perspective_properties.EpipolarProperties),
    (bpy.types.Scene, "mphdrr_perspective", perspective_properties.PerspectiveProperties),
    (bpy.types.Scene, "mphdrr_events", event_properties.EventProperties),
    (bpy.types.WindowManager, "mphdrr_columns", column_maps.ColumnMapProperties),
)
