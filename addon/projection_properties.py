"""Settings of the projections, and where the last run lies."""

from __future__ import annotations

import bpy
from bpy.props import EnumProperty, FloatProperty, IntProperty, PointerProperty, StringProperty

from . import ids


class ProjectionSettings:
    """How to project; mixed into the scene's properties (the panel) and into the operator (scripts)."""

    model: EnumProperty(
        name="Model",
        description="What a pixel holds",
        items=(
            ("TRANSMISSION", "Radiograph", "Line integrals of the volume"),
            ("EMISSION", "SPECT Counts", "Expected photons of a volume of activity through the ideal pinhole"),
        ),
        default="TRANSMISSION",
    )
    time: FloatProperty(name="Time (s)", description="Acquisition time of SPECT counts", default=1.0, min=1e-6)
    width: IntProperty(name="Width", description="Pixel columns of each image", default=256, min=1, max=8192)
    height: IntProperty(name="Height", description="Pixel rows of each image", default=256, min=1, max=8192)
    detector: EnumProperty(
        name="Detector",
        description="Where the images are taken",
        items=(
            ("VIRTUAL", "Virtual", "Plane in front of the pinhole: upright, what the module's camera sees"),
            ("REAL", "Real", "Front face of the crystal behind the pinhole: point-inverted"),
        ),
        default="VIRTUAL",
    )
    magnification: FloatProperty(
        name="Magnification", description="Distance of the virtual detector in units of the collimator length",
        default=10.0, min=0.1, soft_max=20.0,
    )  # fmt: skip
    first: IntProperty(name="First", description="First module number to project; 0: from the first", default=0, min=0)
    last: IntProperty(name="Last", description="Last module number to project; 0: to the last", default=0, min=0)
    backend: EnumProperty(
        name="Backend",
        description="What computes the line integrals",
        items=(
            ("AUTO", "Automatic", "The fastest that works here"),
            ("NUMBA", "Numba", "Compiled, on the processor"),
            ("TORCH", "PyTorch", "On the processor or the graphics card"),
            ("NUMPY", "NumPy", "Float64 reference, slow"),
        ),
        default="AUTO",
    )


def _is_ours(self: ProjectionProperties, item: bpy.types.Object) -> bool:
    return item.type == "VOLUME" and getattr(item, ids.OBJECT_VOLUME).is_volume


class ProjectionProperties(ProjectionSettings, bpy.types.PropertyGroup):
    """State of the Projections panel; `Scene.mphdrr_projections`."""

    volume: PointerProperty(
        name="Volume", description="What to project; empty: the active volume, or the only one", type=bpy.types.Object,
        poll=_is_ours,
    )  # fmt: skip
    run_file: StringProperty(
        name="Run",
        description="File with the last run's exact arrays",
        subtype="FILE_PATH",
        options={"HIDDEN", "PATH_SUPPORTS_BLEND_RELATIVE"},
    )
    run_summary: StringProperty(name="Last Run", description="What the last run was", options={"HIDDEN"})


CLASSES = (ProjectionProperties,)
