"""Settings of the projections, and where the last run lies."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import bpy
from bpy.props import BoolProperty, EnumProperty, FloatProperty, IntProperty, PointerProperty, StringProperty

from ..core.errors import InputError
from ..core.geometry.system import PinholeSystem
from ..core.physics.isotopes import ISOTOPES
from ..core.physics.materials import APERTURES, CRYSTALS
from ..core.volumes.volume import Volume
from . import choices, ids, volumes
from .decimals import typed

if TYPE_CHECKING:
    from ..core.projector import Model


def _materials(numbers: dict[str, int], names: tuple[str, ...], none: str) -> choices.Items:
    """Items of a choice of material, by name or by its coefficient."""
    by_number = ("NUMBER", "By Coefficient", f"By its attenuation coefficient; 0: {none}")
    by_name = ((name, name[0].upper() + name[1:], "As it attenuates the isotope's photons") for name in names)
    return choices.items(numbers, (by_number, *by_name))


class ProjectionSettings:
    """How to project; mixed into the scene's properties (the panel) and into the operator (scripts)."""

    model: EnumProperty(
        name="Model",
        description="What a pixel holds",
        items=(
            ("TRANSMISSION", "Radiograph", "Line integrals of the volume", 0),
            ("EMISSION", "SPECT Counts", "Photons of a volume of activity that the crystal counts", 1),
            (
                "INVERSE_SQUARE",
                "Inverse Square Sum",
                "Line integrals with each segment times a point source's sensitivity, as 1/h^2: no counts, for comparison",
                2,
            ),
        ),
        default="TRANSMISSION",
    )
    time: FloatProperty(name="Time (s)", description="Acquisition time of SPECT counts", default=1.0, min=1e-6)
    photons: FloatProperty(
        name="Photons", description="X-ray photons per pixel: a radiograph of attenuation coefficients then holds those "
        "that pass; 0: line integrals", default=0.0, min=0.0, soft_max=1e6,
    )  # fmt: skip
    isotope: EnumProperty(
        name="Isotope",
        description="What decays: its photons are counted, and its activity falls during the acquisition",
        items=choices.items(
            choices.ISOTOPES,
            (
                ("NONE", "None", "One photon per decay, and an activity that stays"),
                *((name, name, "Energy window 10 % around its strongest line") for name in ISOTOPES),
            ),
        ),
        default="NONE",
    )
    aperture_points: IntProperty(
        name="Aperture Points", description="Points of the hole that rays pass; 1: its middle, no blur, 7 and more: the "
        "blur of a hole of this size", default=1, min=1, soft_max=64,
    )  # fmt: skip
    pixel_points: IntProperty(
        name="Pixel Points", description="Points of each pixel's area, for each of the hole. 0: for counts as many as keep "
        "a single voxel's total within 2 %, which takes longer for small voxels; for radiographs the pixel's centre",
        default=0, min=0, soft_max=100,
    )  # fmt: skip
    aperture_material: EnumProperty(
        name="Aperture", description="Material that photons penetrate at the aperture's edge",
        items=_materials(choices.APERTURES, APERTURES, "nothing penetrates it"), default="NUMBER",
    )  # fmt: skip
    aperture_mu: FloatProperty(
        name="Aperture µ", description="Attenuation coefficient of the aperture in 1/mm, at the photons' energy, "
        "where no material is chosen; 0: nothing penetrates it",
        default=0.0, min=0.0, soft_max=10.0, precision=3,
    )  # fmt: skip
    edge: EnumProperty(
        name="Knife Edge",
        description="How photons penetrate the aperture's edge",
        items=(
            ("PAIX", "Effective Diameter", "As if the hole were wider (Paix 1967)", 0),
            ("PATH", "Path Length", "Each by its path through the edge: more rays", 1),
        ),
        default="PAIX",
    )
    crystal_material: EnumProperty(
        name="Crystal", description="Material that stops the photons that are counted",
        items=_materials(choices.CRYSTALS, CRYSTALS, "all photons are counted"), default="NUMBER",
    )  # fmt: skip
    crystal_mu: FloatProperty(
        name="Crystal µ", description="Attenuation coefficient of the crystal in 1/mm, at the photons' energy, where no "
        "material is chosen; 0: all photons are counted",
        default=0.0, min=0.0, soft_max=5.0, precision=3,
    )  # fmt: skip
    depth_layers: IntProperty(
        name="Depth Layers", description="Depths in the crystal at which photons are recorded (parallax); 1: where they "
        "enter. Needs the crystal's µ", default=1, min=1, soft_max=8,
    )  # fmt: skip
    intrinsic_fwhm: FloatProperty(
        name="Intrinsic Blur", description="Full width at half maximum of the detector's own blur in mm on the crystal",
        default=0.0, min=0.0, soft_max=10.0, precision=2,
    )  # fmt: skip
    within_cone: BoolProperty(name="Knife-Edge Cone", description="Nothing passes steeper than the knife edge's cone")
    within_walls: BoolProperty(
        name="Collimator Walls", description="The walls stop photons that would miss the crystal's front"
    )
    within_crystal: BoolProperty(name="Crystal's Side", description="Pixels beyond the crystal count nothing")
    noise: BoolProperty(name="Poisson Noise", description="Draw counts instead of their expected means")
    seed: IntProperty(name="Seed", description="Of the noise: the same seed draws the same counts", default=1, min=0)
    width: IntProperty(name="Width", description="Pixel columns of each image", default=256, min=1, max=8192)
    height: IntProperty(name="Height", description="Pixel rows of each image", default=256, min=1, max=8192)
    detector: EnumProperty(
        name="Detector",
        description="Where the images are taken",
        items=(
            ("VIRTUAL", "Virtual", "Plane in front of the pinhole: upright, what the module's camera sees", 0),
            ("REAL", "Real", "Front face of the crystal behind the pinhole: point-inverted", 1),
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
            ("AUTO", "Automatic", "The fastest that works here", 0),
            ("CPU", "CPU", "Compiled, on the processor", 1),
            ("TORCH", "PyTorch", "On the processor or the graphics card", 2),
            ("NUMPY", "NumPy", "Float64 reference, slow", 3),
            ("CUDA", "CUDA", "On an NVIDIA graphics card; needs warp-lang in Blender's Python", 4),
        ),
        default="AUTO",
    )


# Settings that are arguments of `Emission`; those that may be missing are 0 or NONE.
_EMISSION = (
    "time", "isotope", "aperture_points", "aperture_mu", "opening_angle", "edge", "crystal_mu", "depth_layers",
    "intrinsic_fwhm", "within_cone", "within_walls", "within_crystal", "pixel_points",
)  # fmt: skip
_OPTIONAL = ("isotope", "aperture_mu", "crystal_mu", "pixel_points")


def chosen_model(settings: dict[str, Any], system: PinholeSystem, mu: Volume | None = None) -> Model:
    """The model that `settings` (`ProjectionSettings`, and the scanner's opening angle) ask for; leaves bpy alone."""
    from ..core.projector import Emission, InverseSquareSum, Transmission

    if settings["model"] == "TRANSMISSION":
        return Transmission(settings["pixel_points"] or 1)
    if settings["model"] == "INVERSE_SQUARE":
        return InverseSquareSum(system)
    if settings["model"] != "EMISSION":  # of a file that a later version wrote
        raise InputError(f"model {settings['model']!r} is not known to this version: choose what the pixels hold")
    given: dict[str, Any] = {name: settings[name] for name in _EMISSION}
    given |= {name: typed(value) for name, value in given.items() if isinstance(value, float)}
    given |= {name: None for name in _OPTIONAL if given[name] in (0, "NONE")}
    for part in ("aperture", "crystal"):
        if settings[f"{part}_material"] != "NUMBER":
            given[f"{part}_mu"] = settings[f"{part}_material"]
    return Emission(system, mu, **(given | {"edge": given["edge"].lower()}))


def _is_ours(self: ProjectionProperties, item: bpy.types.Object) -> bool:
    return volumes.can_be_projected(item)


def _is_mu(self: ProjectionProperties, item: bpy.types.Object) -> bool:
    return volumes.is_volume(item) and getattr(item, ids.OBJECT_VOLUME).quantity == "mu"


class ProjectionProperties(ProjectionSettings, bpy.types.PropertyGroup):
    """State of the Projections panel; `Scene.mphdrr_projections`."""

    volume: PointerProperty(
        name="Volume", description="What to project; empty: the active volume, or the only one", type=bpy.types.Object,
        poll=_is_ours,
    )  # fmt: skip
    mu: PointerProperty(
        name="Attenuation", description="Volume of attenuation coefficients (1/mm) before the pinhole; empty: none",
        type=bpy.types.Object, poll=_is_mu,
    )  # fmt: skip
    run_file: StringProperty(
        name="Run",
        description="File with the last run's exact arrays",
        subtype="FILE_PATH",
        options={"HIDDEN", "PATH_SUPPORTS_BLEND_RELATIVE"},
    )
    run_summary: StringProperty(name="Last Run", description="What the last run was", options={"HIDDEN"})


CLASSES = (ProjectionProperties,)
