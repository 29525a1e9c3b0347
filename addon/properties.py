"""The extension's property groups: what the panels show and what is stored in the .blend file.

Blender's FloatProperty is a float32: 100 mm is kept to 8e-6 mm only. `ModuleProperties.exact` therefore holds
the float64 numbers beside it (see `addon/module_values.py`).
"""

from __future__ import annotations

import bpy
from bpy.props import BoolProperty, EnumProperty, FloatProperty, IntProperty, PointerProperty, StringProperty

from . import ids, jobs, phantom_properties, projection_properties


def _module_changed(self: ModuleProperties, context: bpy.types.Context) -> None:
    from . import scanner  # here, because scanner reads these properties

    scanner.refresh_module(self.id_data)


def _get_visible(self: ModuleProperties) -> bool:
    return not self.id_data.hide_viewport


def _set_visible(self: ModuleProperties, value: bool) -> None:
    from . import scanner

    scanner.set_visible(self.id_data, value)


class ModuleProperties(bpy.types.PropertyGroup):
    """One pinhole module; lives on the module's camera object as `Object.mphdrr_module`.

    The scanner's other objects (collimator, crystal, ROI sphere) carry `part` and `number` only.
    """

    is_module: BoolProperty(name="Is Module", options={"HIDDEN"})
    part: EnumProperty(
        name="Part", description="What the object is in a scanner", options={"HIDDEN"},
        items=[(part, part.capitalize(), "") for part in ids.PARTS],
    )  # fmt: skip
    visible: BoolProperty(
        name="Visible", description="Show the module, its collimator and its crystal, also in renders",
        get=_get_visible, set=_set_visible,
    )  # fmt: skip
    number: IntProperty(name="Number", description="Module number, as in the workbook")
    index: IntProperty(name="Index", description="Place of the module in its system, from 0", min=0, options={"HIDDEN"})
    ring: IntProperty(name="Ring", description="Ring of the module, counted from 0", min=0)
    pinhole_diameter: FloatProperty(
        name="Pinhole Diameter",
        description="d: diameter of the hole in mm",
        min=0.0,
        unit="NONE",
        update=_module_changed,
    )
    collimator_length: FloatProperty(
        name="Collimator Length", description="l: from the pinhole to the crystal's front face, in mm",
        min=1e-3, update=_module_changed,
    )  # fmt: skip
    detector_side: FloatProperty(
        name="Detector Side",
        description="Ld: side of the square crystal in mm",
        min=1e-3,
        update=_module_changed,
    )
    detector_thickness: FloatProperty(
        name="Detector Thickness",
        description="Td: thickness of the crystal in mm",
        min=0.0,
        update=_module_changed,
    )
    roi_radius: FloatProperty(
        name="ROI Radius", description="R: radius in mm of the sphere that the module must see", min=0.0
    )
    pinhole_distance: FloatProperty(
        name="Pinhole Distance",
        description="b: from the pinhole to the isocentre, in mm, when it was imported",
        min=0.0,
    )
    exact: StringProperty(
        name="Exact Values",
        description="The same numbers and the pose in double precision, JSON",
        options={"HIDDEN"},
    )


class ScannerProperties(bpy.types.PropertyGroup):
    """One scanner; lives on its collection as `Collection.mphdrr_scanner`."""

    is_scanner: BoolProperty(name="Is Scanner", options={"HIDDEN"})
    is_ring: BoolProperty(name="Is Ring", description="The collection is a ring of a scanner", options={"HIDDEN"})
    scanner_name: StringProperty(
        name="Scanner Name", description="What the scanner was imported as: the same name replaces it"
    )
    workbook: StringProperty(name="Workbook", description="File that the scanner was read from", subtype="FILE_PATH")
    sha256: StringProperty(name="SHA-256", description="Checksum of the workbook when it was read")
    n_modules: IntProperty(name="Modules", description="Number of modules when it was imported", min=0)
    quick_ranges: StringProperty(
        name="Quick Ranges", description="Module ranges with a button of their own, JSON", options={"HIDDEN"}
    )
    source: StringProperty(name="Source", description="Where the numbers come from, JSON", options={"HIDDEN"})
    plate_thickness: FloatProperty(name="Plate", description="Thickness of the aperture plate in mm", min=0.0)
    wall_thickness: FloatProperty(name="Wall", description="Thickness of the collimator's walls in mm", min=0.0)


def _is_scanner(self: GeometryProperties, collection: bpy.types.Collection) -> bool:
    return collection.mphdrr_scanner.is_scanner


def _active_changed(self: GeometryProperties, context: bpy.types.Context) -> None:
    from . import scanner

    scanner.select_active(context)


class GeometryProperties(bpy.types.PropertyGroup):
    """State of the Geometry panel; `Scene.mphdrr_geometry`."""

    scanner: PointerProperty(
        name="Scanner",
        description="The scanner that the panels work on",
        type=bpy.types.Collection,
        poll=_is_scanner,
    )
    active_index: IntProperty(
        name="Active Module",
        description="Index of the module among the scanner's objects",
        update=_active_changed,
    )
    first: IntProperty(name="First", description="First module number of the range", default=1)
    last: IntProperty(name="Last", description="Last module number of the range", default=40)


# Every property group, in order: a group comes after those it points to. registration.py reads this.
CLASSES = (
    ModuleProperties,
    ScannerProperties,
    GeometryProperties,
    *phantom_properties.CLASSES,
    *projection_properties.CLASSES,
    jobs.JobProperties,
)

# (Blender type, attribute name, group): attached as `PointerProperty(type=group)`; registration.py reads it.
POINTERS = (
    (bpy.types.Object, ids.OBJECT_MODULE, ModuleProperties),
    (bpy.types.Collection, ids.COLLECTION_SCANNER, ScannerProperties),
    (bpy.types.Scene, ids.SCENE_GEOMETRY, GeometryProperties),
    (bpy.types.Object, ids.OBJECT_VOLUME, phantom_properties.VolumeProperties),
    (bpy.types.Scene, ids.SCENE_PROJECTIONS, projection_properties.ProjectionProperties),
    (bpy.types.WindowManager, ids.WINDOW_JOB, jobs.JobProperties),
)
