"""The Reconstruction panel's settings: Blender properties made from `core.runs.settings`, and what they say."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import bpy
from bpy.props import EnumProperty, PointerProperty, StringProperty

from ...core.perspective.backprojection import HOW
from ...core.reconstruction.methods import METHOD_FILES, METHODS
from ...core.runs.recipe import Recipe, fitting_recipe
from ...core.runs.settings import SETTINGS
from ..blender import choices
from ..blender.file_properties import path_property
from ..blender.setting_properties import make_check_marks, make_properties, properties_to_draw, read_values
from ..volumes import volumes

_BY_COMMAND_LINE = ("anatomy", "allow", "stop_change", "stop_noise", "stop_region", "stop_seconds")
"""Settings that the panel does not have: of files, and of ends that Finish Now is for."""

PROPERTIES = {
    key.partition(".")[2]: setting
    for key, setting in SETTINGS.items()
    if key.startswith("reconstruction.") and not key.endswith(_BY_COMMAND_LINE)
}
"""The settings by the names of their properties."""


_OF_VOXELS = ("voxels", "spacing", "center")
_HOW = {
    "sum": ("Sum", "Add up the views: large wherever many rays cross something"),
    "product": ("Geometric Mean", "Multiply the views: nothing where one view sees nothing"),
    "minimum": ("Minimum", "The least that a view sees there"),
}
HOW_LABELS = {how: _HOW.get(how, (how.capitalize(), ""))[0] for how in HOW}
"""What the ways to put views together are called."""


class ReconstructionSettings:
    """How to reconstruct; mixed into the scene's properties (the panel) and into the operator (scripts)."""


_FILES = ", ".join(METHOD_FILES)
ReconstructionSettings.__annotations__ = make_properties(PROPERTIES)
ReconstructionSettings.__annotations__["method_file"] = path_property(
    "Method File", f"A trained network ({_FILES}) instead of the method; it has voxels of its own"
)
_OF_FILES = ("ignore_attenuation", "ignore_blur", "hole", "aperture_points", "pixel_points")
"""Settings that matter to methods in files: of the model alone."""


_PUT_TOGETHER = EnumProperty(
    name="Combine By", description="How the views that see a voxel are put together",
    items=choices.items({}, ((how.upper(), HOW_LABELS[how], _HOW.get(how, ("", ""))[1]) for how in HOW)), default="SUM",
)  # fmt: skip


class BackprojectionSettings:
    """How to back-project; mixed into the operator (scripts)."""


BackprojectionSettings.__annotations__ = make_properties({name: PROPERTIES[name] for name in _OF_VOXELS})
BackprojectionSettings.__annotations__["how"] = _PUT_TOGETHER


def voxels_recipe(get: Callable[[str], Any]) -> Recipe:
    """The recipe's voxels alone; `get` gives a property's value."""
    values = read_values({name: PROPERTIES[name] for name in _OF_VOXELS}, get)
    return Recipe({key: value for key, value in values.items() if value is not None})


def settings_recipe(get: Callable[[str], Any], is_given: Callable[[str], bool]) -> Recipe:
    """The recipe's [reconstruction]; `get` gives a property's value, `is_given` whether a script has set it.

    Raises InputError where a setting that is given has no effect.
    """
    values = read_values(PROPERTIES, get)
    given = [s.key for name, s in PROPERTIES.items() if is_given(name) and values[s.key] != s.default]
    if file := get("method_file"):
        kept = {*given, *(PROPERTIES[name].key for name in _OF_FILES)} - {"reconstruction.method"}
        values = {key: value for key, value in values.items() if key in kept}
        values["reconstruction.method"] = bpy.path.abspath(file)
    return fitting_recipe(values, given)


def fit_method(settings: ReconstructionProperties, of_counts: bool) -> None:
    """Choose the method by what the run holds, counts or line integrals, unless the user has chosen one."""
    is_free = not settings.is_property_set("method") or settings.method == settings.fitted
    if is_free and METHODS[settings.method.lower()].of_counts != of_counts:
        settings.method = settings.fitted = "OSEM" if of_counts else "CGLS"


def drawn(settings: ReconstructionProperties) -> Iterator[tuple[str, bool]]:
    """The properties that the chosen method and prior have, each with whether it has an effect."""
    shown = {name: PROPERTIES[name] for name in _OF_FILES} if settings.method_file else PROPERTIES
    yield from properties_to_draw(shown, settings, lambda need: True)
    yield "method_file", True


class ReconstructionProperties(ReconstructionSettings, bpy.types.PropertyGroup):
    """State of the Reconstruction panel; `Scene.mphdrr_reconstruction`."""

    volume: PointerProperty(
        name="Reconstruction", description="The last reconstructed volume", type=bpy.types.Object,
        poll=lambda self, item: volumes.is_volume(item), options={"HIDDEN"},
    )  # fmt: skip
    mu: PointerProperty(
        name="Attenuation", description="Volume of attenuation coefficients (1/mm) or CT numbers for counts, in place of "
        "that which the run was made with; empty: the run's", type=bpy.types.Object,
        poll=lambda self, item: volumes.is_volume(item) and volumes.quantity_of(item) in ("mu", "hu"),
    )  # fmt: skip
    fitted: StringProperty(
        name="Fitted Method", description="The method that what a run holds has chosen", options={"HIDDEN"}
    )
    record: StringProperty(name="Record", description="What is known of it, JSON", options={"HIDDEN"})

    @property
    def known(self) -> Mapping[str, Any]:
        """What is known of the last reconstruction: `title`, `objective`, its `name`, `scores`, `flatters` and its `run`."""
        return json.loads(self.record) if self.record else {}


ReconstructionProperties.__annotations__.update(make_check_marks(PROPERTIES), how=_PUT_TOGETHER)

CLASSES = (ReconstructionProperties,)
