"""Settings of the Reconstruction panel: Blender properties made from `core.runs.settings`, and the recipe in them."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import bpy
from bpy.props import EnumProperty, PointerProperty, StringProperty

from ...core.perspective.backprojection import HOW
from ...core.reconstruction.method_files import METHOD_FILES
from ...core.reconstruction.methods import METHODS
from ...core.runs.recipe import Recipe, fitting_recipe
from ...core.runs.settings import SETTINGS
from ..blender import choices
from ..blender.file_properties import path_property
from ..blender.reports import has
from ..blender.setting_properties import make_check_marks, make_properties, properties_to_draw, read_values
from ..volumes import volumes

_BY_COMMAND_LINE = ("anatomy", "allow", "stop_change", "stop_noise", "stop_region", "stop_seconds")
"""Settings that the panel lacks: files, and stopping criteria, in place of which there is Finish Now."""

PROPERTIES = {
    key.partition(".")[2]: setting
    for key, setting in SETTINGS.items()
    if key.startswith("reconstruction.") and not key.endswith(_BY_COMMAND_LINE)
}
"""The panel's settings by property name."""


_VOXEL_NAMES = ("voxels", "spacing", "center")
_WAYS = {
    "sum": ("Sum", "Add up the views: large wherever many rays cross something"),
    "product": ("Geometric Mean", "Multiply the views: nothing where one view sees nothing"),
    "minimum": ("Minimum", "The smallest value that a view has there"),
}
HOW_LABELS = {how: _WAYS.get(how, (how.capitalize(), ""))[0] for how in HOW}
"""Labels of the ways to combine views."""


class ReconstructionSettings:
    """Properties for reconstructing, shared by the scene's settings (the panel) and the operator (scripts)."""


_FILES = ", ".join(METHOD_FILES)
ReconstructionSettings.__annotations__ = make_properties(PROPERTIES)
ReconstructionSettings.__annotations__["method_file"] = path_property(
    "Method File", f"A trained network ({_FILES}) instead of the method; it has voxels of its own, and needs torch"
)
_METHOD_FILE_NAMES = ("ignore_attenuation", "ignore_blur", "hole", "aperture_points", "pixel_points")
"""Settings of the model that also matter to methods in files."""


_COMBINE_BY = EnumProperty(
    name="Combine By", description="How the views of a voxel are combined",
    items=choices.items({}, ((how.upper(), HOW_LABELS[how], _WAYS.get(how, ("", ""))[1]) for how in HOW)), default="SUM",
)  # fmt: skip


class BackprojectionSettings:
    """Properties for back-projecting, of the operator (scripts)."""


BackprojectionSettings.__annotations__ = make_properties({name: PROPERTIES[name] for name in _VOXEL_NAMES})
BackprojectionSettings.__annotations__["how"] = _COMBINE_BY


def voxels_recipe(get: Callable[[str], Any]) -> Recipe:
    """Return the recipe with the voxels alone; `get` returns a property's value by its name."""
    values = read_values({name: PROPERTIES[name] for name in _VOXEL_NAMES}, get)
    return Recipe({key: value for key, value in values.items() if value is not None})


def settings_recipe(get: Callable[[str], Any], is_set: Callable[[str], bool]) -> Recipe:
    """Return the recipe's table [reconstruction]; `get` returns a property's value, `is_set` whether a script has set it.

    Raises InputError where a setting that a script has set has no effect.
    """
    values = read_values(PROPERTIES, get)
    set_keys = [s.key for name, s in PROPERTIES.items() if is_set(name) and values[s.key] != s.default]
    if file := get("method_file"):
        kept_keys = {*set_keys, *(PROPERTIES[name].key for name in _METHOD_FILE_NAMES)} - {"reconstruction.method"}
        values = {key: value for key, value in values.items() if key in kept_keys}
        values["reconstruction.method"] = bpy.path.abspath(file)
    return fitting_recipe(values, set_keys)


def fit_method(settings: ReconstructionProperties, of_counts: bool) -> None:
    """Choose a method for the run's content, counts or line integrals, unless the user has chosen one."""
    is_free = not settings.is_property_set("method") or settings.method == settings.fitted
    if is_free and METHODS[settings.method.lower()].of_counts != of_counts:
        settings.method = settings.fitted = "OSEM" if of_counts else "CGLS"


def panel_properties(settings: ReconstructionProperties) -> Iterator[tuple[str, bool]]:
    """Yield the properties that the chosen method and prior have, each with whether it has an effect."""
    settings_shown = {name: PROPERTIES[name] for name in _METHOD_FILE_NAMES} if settings.method_file else PROPERTIES
    yield from properties_to_draw(settings_shown, settings, lambda need: True)
    yield "method_file", has("torch")


class ReconstructionProperties(ReconstructionSettings, bpy.types.PropertyGroup):
    """State of the Reconstruction panel; `Scene.mphdrr_reconstruction`."""

    volume: PointerProperty(name="Reconstruction", description="The last reconstructed volume", type=bpy.types.Object,
                            poll=lambda self, item: volumes.is_volume(item), options={"HIDDEN"})  # fmt: skip
    mu: PointerProperty(
        name="Attenuation", description="Volume of attenuation coefficients (1/mm) or CT numbers for counts, in place of "
        "that which the run was made with; empty: the run's", type=bpy.types.Object,
        poll=lambda self, item: volumes.is_volume(item) and volumes.quantity_of(item) in ("mu", "hu"),
    )  # fmt: skip
    fitted: StringProperty(name="Fitted Method", description="Method chosen for the run's content", options={"HIDDEN"})
    record: StringProperty(name="Record", description="Details of the last reconstruction, JSON", options={"HIDDEN"})

    @property
    def details(self) -> Mapping[str, Any]:
        """Details of the last reconstruction: `title`, `objective`, its `name`, `scores`, `flatters` and its `run`."""
        return json.loads(self.record) if self.record else {}


ReconstructionProperties.__annotations__.update(make_check_marks(PROPERTIES), how=_COMBINE_BY)

CLASSES = (ReconstructionProperties,)
