"""Settings of the Projections panel: Blender properties made from `core.runs.settings`, and the recipe in them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import bpy
from bpy.props import BoolProperty, CollectionProperty, IntProperty, PointerProperty, StringProperty

from ...core.errors import InputError
from ...core.physics.maps import MAPS
from ...core.runs.presets import PRESETS
from ...core.runs.recipe import Recipe, fitting_recipe
from ...core.runs.settings import SETTINGS
from ..blender import setting_properties
from ..blender.file_properties import path_property
from ..blender.setting_properties import material_property, modules_property, set_property
from ..blender.updates import on_edit
from ..scanner import scanner
from ..volumes import volumes

OPENING_ANGLE = "model.opening_angle_degrees"
"""Key of the opening angle, which the scanner's properties hold: its collimators are drawn with it."""

USUAL_TIME = 600.0
"""Duration, s, of a cardiac acquisition: the panel's time when a preset or a volume makes it simulate counts."""

_NAMES = {"model.kind": "model", "detector.plane": "detector", "detector.rows": "height", "detector.columns": "width",
          "frames.times": "frame_times", "frames.starts": "frame_starts", "scatter.model": "scatter",
          "scatter.precision": "scatter_precision", "scatter.seed": "scatter_seed"}  # fmt: skip
"""Names of properties in .blend files that differ from the names of their settings."""

_TABLES = ("system.modules", "model.", "scatter.", "detector.", "frames.", "compute.")
PROPERTIES = {
    _NAMES.get(key, key.partition(".")[2]): setting
    for key, setting in SETTINGS.items()
    if key.startswith(_TABLES) and key not in (OPENING_ANGLE, "frames.bins")
}
"""The panel's settings by property name; an attenuation coefficient has a second property for its material."""


class ProjectionSettings:
    """Properties for projecting, shared by the scene's settings (the panel) and the operator (scripts)."""

    noise: BoolProperty(name="Poisson Noise", description="Draw Poisson counts instead of expected counts")
    seed: IntProperty(name="Seed", description="Seed of the noise: it determines the drawn counts", default=1, min=0)
    # Of earlier versions' files and scripts; `modules` stands for them.
    first: IntProperty(name="First Module", description="0: the lowest", default=0, min=0, options={"HIDDEN"})
    last: IntProperty(name="Last Module", description="0: the highest", default=0, min=0, options={"HIDDEN"})


ProjectionSettings.__annotations__.update(setting_properties.make_properties(PROPERTIES))


def recipe_values(get: Callable[[str], Any]) -> dict[str, Any]:
    """Return the values of the settings by recipe key, None where unset; `get` returns a property's value by its name."""
    values = setting_properties.read_values(PROPERTIES, get)
    values["noise.seed"] = get("seed") if get("noise") else None
    return values


def settings_recipe(
    get: Callable[[str], Any],
    is_set: Callable[[str], bool],
    extra: Mapping[str, Any],
    collection: bpy.types.Collection | None = None,
) -> Recipe:
    """Return the recipe of model, detector, noise and backend, with `extra` entries.

    `get` returns a property's value, `is_set` whether a script has set it: `InputError` then if it has no effect. Images of
    a scanner `collection` with fixed pixels have these, unless a script has set others.
    """
    values = {**recipe_values(get), **extra}
    if is_set("first") or is_set("last"):
        values["system.modules"] = _range_text(get) or None
    if fixed_pixels := collection and scanner.fixed_pixels(collection):
        pixels = {"height": fixed_pixels[0], "width": fixed_pixels[1]}
        names = [name for name, setting in PROPERTIES.items() if setting.key.startswith("detector.")]
        values |= {PROPERTIES[name].key: pixels.get(name) for name in names if not is_set(name)}
    set_keys = [
        setting.key
        for name, setting in PROPERTIES.items()
        if any(map(is_set, filter(None, (name, material_property(name, setting), modules_property(name, setting)))))
        and values[setting.key] != setting.default
    ]
    return fitting_recipe(values, set_keys)


def _range_text(get: Callable[[str], Any]) -> str:
    """Return the range of modules of an earlier version's file or script as text; 0 is the lowest or the highest number."""
    return f"{get('first') or ''}-{get('last') or ''}" if get("first") or get("last") else ""


def set_panel(settings: ProjectionProperties, recipe: Recipe) -> None:
    """Set the panel to a recipe's values, all else to its defaults; raise `InputError` for what the panel cannot show."""
    if recipe["model.pixel_points"] == "auto" and recipe["model.kind"] != "emission":
        raise InputError("model.pixel_points: the panel has no automatic number for radiographs")
    if recipe["frames.bins"] is not None:
        raise InputError("frames.bins: the panel has one bin")
    for name, setting in PROPERTIES.items():
        set_property(settings, PROPERTIES, name, recipe.given.get(setting.key))
    settings.fitted = ""  # keeps the recipe's model, whatever the volume's quantity
    settings.model = setting_properties.identifier("model", recipe["model.kind"])
    settings.noise = recipe["noise.seed"] is not None
    if settings.noise:
        settings.seed = recipe["noise.seed"]


def use_preset(settings: ProjectionProperties, preset: str) -> None:
    """Set the physics to a preset of `core.runs.presets`; settings that it does not name stay."""
    changes = PRESETS[preset].changes
    for name, setting in PROPERTIES.items():
        if setting.key in changes:
            set_property(settings, PROPERTIES, name, changes[setting.key])
    set_time(settings)


def fit_model(settings: ProjectionProperties, quantity: str) -> None:
    """Choose the model by a volume's quantity unless the user has chosen one: counts for activity, a radiograph for mu."""
    model = {"activity": "EMISSION", "mu": "TRANSMISSION"}.get(quantity)
    if model is None or (settings.is_property_set("model") and settings.model != settings.fitted):
        return
    settings.model = settings.fitted = model
    if model == "EMISSION":
        set_time(settings)


def set_time(settings: ProjectionProperties) -> None:
    """Set the usual time unless one was set: the default, 1 s, only serves to make counts equal to rates."""
    if not settings.is_property_set("time"):
        settings.time = USUAL_TIME


def panel_properties(settings: ProjectionProperties, table: str) -> Iterator[tuple[str, bool]]:
    """Yield the properties of a table that the chosen model and hole have, each with whether it has an effect."""
    properties = setting_properties.properties_to_draw(
        PROPERTIES, settings, lambda need: need.startswith("model.kind=") or "model.hole=rays" in need, table
    )
    for name, is_active in properties:
        yield name, is_active and (name != "magnification" or settings.detector == "VIRTUAL")


def makes_counts(settings: ProjectionProperties) -> bool:
    """Return whether images hold numbers of photons, which may have noise."""
    counts_xrays = settings.model == "SPECTRAL" and settings.panel == "COUNTING"
    return settings.model == "EMISSION" or counts_xrays or (settings.model == "TRANSMISSION" and settings.photons > 0)


class RunProperties(bpy.types.PropertyGroup):
    """Properties of a run in the scene's list `ProjectionProperties.runs`, written by `addon/runs/runs.py`."""

    name: StringProperty(name="Name", description="Name of the run; a renamed run is kept")
    usual_name: StringProperty(name="Usual Name", description="Original name of the run", options={"HIDDEN"})
    file: path_property("File", "File with the run's exact arrays", "HIDDEN")
    scanner: PointerProperty(name="Scanner", description="Scanner of the run", type=bpy.types.Collection)
    summary: StringProperty(name="Summary", description="Contents of the run", options={"HIDDEN"})
    state: StringProperty(name="State", description="The scene's state when made, float64 JSON", options={"HIDDEN"})
    keep: BoolProperty(
        name="Keep",
        description="Keep this run. Of all others the last two stay, and the next render replaces the older",
    )
    is_saved: BoolProperty(name="Saved", description="A saved .blend may need the run's file", options={"HIDDEN"})

    @property
    def is_kept(self) -> bool:
        """Whether the next render keeps the run."""
        return bool(self.keep or self.name != self.usual_name)


def _volume_chosen(self: ProjectionProperties, context: bpy.types.Context) -> None:
    # Only in the panel: for a script, a model that changes by itself would give wrong numbers without a warning.
    """Fit the model to a volume that the user chooses in the panel."""
    if self.volume is not None and context.region is not None and context.region.type == "UI":
        fit_model(self, volumes.quantity_of(self.volume))


def _chosen_modules(self: ProjectionProperties) -> str:
    """Return the numbers of the modules that are projected, also those of an earlier version's range."""
    return _range_text(lambda name: getattr(self, name)) or str(self.numbers)


def _choose_modules(self: ProjectionProperties, text: str) -> None:
    """Choose the modules that are projected, in place of an earlier version's range."""
    self.numbers, self.first, self.last = text, 0, 0


class ProjectionProperties(ProjectionSettings, bpy.types.PropertyGroup):
    """State of the Projections panel; `Scene.mphdrr_projections`."""

    volume: PointerProperty(name="Volume", description="Volume to project; empty: the active volume, or the only one",
                            type=bpy.types.Object, update=_volume_chosen, poll=lambda self, item:
                            volumes.is_volume(item) and volumes.quantity_of(item) not in MAPS)  # fmt: skip
    modules: StringProperty(
        name="Modules", description="Numbers of the modules to project into, such as 1-40, 45; empty: all",
        get=_chosen_modules, set=_choose_modules, search=scanner.suggested_ranges,
    )  # fmt: skip
    numbers: StringProperty(name="Numbers", description="The text in Modules", options={"HIDDEN"})
    fitted: StringProperty(name="Fitted", description="Model chosen for the volume's quantity", options={"HIDDEN"})
    mu: PointerProperty(
        name="Attenuation", description="Volume of attenuation coefficients (1/mm) before the pinhole, or of CT numbers, "
        "which attenuate each line of the isotope at its energy; empty: none",
        type=bpy.types.Object,
        poll=lambda self, item: volumes.is_volume(item) and volumes.quantity_of(item) in ("mu", "hu"),
    )  # fmt: skip
    runs: CollectionProperty(type=RunProperties, name="Runs", options={"HIDDEN"})
    active_run: IntProperty(name="Run", description="Run whose images are shown", update=on_edit("active_run"))
    run_file: path_property("Run", "File with the shown run's exact arrays", "HIDDEN")
    run_summary: StringProperty(name="Shown Run", description="Contents of the shown run", options={"HIDDEN"})


ProjectionProperties.__annotations__.update(setting_properties.make_check_marks(PROPERTIES))

CLASSES = (RunProperties, ProjectionProperties)
