"""Settings of phantoms and volumes: the same properties in the operator that adds a phantom and on its object.

The settings of each kind of phantom follow from the fields of its class (`core.phantoms.kinds`).
"""

import dataclasses
from typing import Any

import bpy
from bpy.props import (
    BoolProperty,
    EnumProperty,
    FloatProperty,
    FloatVectorProperty,
    IntProperty,
    IntVectorProperty,
    PointerProperty,
    StringProperty,
)

from ...core import Grid, InputError, Phantom
from ...core.phantoms.kinds import KINDS, PhantomKind
from ...core.phantoms.language import parse_phantom
from ...core.volumes.volume import UNITS
from ..blender import choices, decimals, layouts
from ..blender.setting_properties import check_mark
from ..blender.updates import on_edit

FILE = "file"  # the kind, beside those in `KINDS`, of a phantom that a text in TOML describes


class PhantomSettings:
    """Base class of a phantom's settings: of the operator that adds it and of the properties that its object keeps.

    The properties themselves come from `settings_class`, or are a text, and from `sampling`.
    """

    identifier = ""
    """The kind's name in Python, also of its operator and of its settings in `VolumeProperties`."""
    setting_names: tuple[str, ...] = ()
    """Names of the settings, without those of `sampling`, in the order of drawing."""
    n_states = 1
    """Number of states, one for each frame."""

    voxels: Any
    voxel_size: Any

    @property
    def n_voxels(self) -> int:
        """Number of voxels of a volume, of all states."""
        return int(self.voxels**3) * self.n_states

    def values(self) -> dict[str, Any]:
        """Return every setting by name, vectors as tuples."""
        values = {name: getattr(self, name) for name in (*self.setting_names, *sampling())}
        return {k: tuple(v) if isinstance(v, bpy.types.bpy_prop_array) else v for k, v in values.items()}

    def phantom(self) -> Phantom:
        """Return the phantom, a beating one in its first state, or raise `InputError`."""
        raise NotImplementedError

    def recipe(self) -> dict[str, Any]:
        """Return the settings as a dictionary that JSON can hold."""
        raise NotImplementedError

    def grid(self, phantom: Phantom) -> Grid:
        """Return the phantom's grid in its own frame, with equally many voxels along every side."""
        low, high = phantom.box
        # A margin of one voxel all around keeps the phantom off the edge.
        fitted_spacing = float((high - low).max()) / max(1, self.voxels - 2)
        return Grid.centered((self.voxels,) * 3, decimals.typed(self.voxel_size) or fitted_spacing, (low + high) / 2)

    def draw_settings(self, layout: bpy.types.UILayout) -> None:
        """Draw the settings into a panel or a dialog."""
        column = layout.column(align=True)
        column.use_property_split = False  # names with units need the whole width
        for name in self.setting_names:
            value = getattr(self, name)
            if isinstance(value, bpy.types.bpy_prop_array):
                properties: Any = getattr(self, "properties", self)  # an operator has them in `properties`
                column.label(text=properties.bl_rna.properties[name].name)
                for first in range(0, len(value), 3):
                    row = column.row(align=True)
                    for k in range(first, min(first + 3, len(value))):
                        row.prop(self, name, index=k, text="")
            else:
                column.prop(self, name)
        layouts.draw_settings(layout.column(align=True), self, ((name, True) for name in sampling()))


class KindSettings(PhantomSettings):
    """Settings of one of `KINDS`."""

    kind = KINDS[0]

    @property
    def n_states(self) -> int:  # type: ignore[override]
        """Number of phases of the heart's cycle."""
        return int(self.frames) if _has_states(self.kind) else 1  # type: ignore[attr-defined]

    def phantom(self) -> Phantom:
        """Return the phantom; float32 settings are read as the decimal numbers that the user typed."""
        return self.kind.phantom(**self._arguments())

    def recipe(self) -> dict[str, Any]:
        """Return the fields of the kind's class, with units in their keys, and the number of frames of a beating phantom."""
        recipe: dict[str, Any] = {"phantom": self.kind.name}
        for field in _setting_fields(self.kind):
            value = self._arguments()[field.name]
            recipe[field.name + _key_ending(field)] = list(value) if isinstance(value, tuple) else value
        return recipe | {"frames": self.n_states} if self.n_states > 1 else recipe

    def _arguments(self) -> dict[str, Any]:
        """Return the arguments of the phantom's class; a beating phantom starts at phase 0."""
        values = {field.name: _plain_value(getattr(self, field.name)) for field in _setting_fields(self.kind)}
        return values | {"phase": 0.0} if self.n_states > 1 else values


def sampling(update: Any = None) -> dict[str, Any]:
    """Return the properties that all phantoms have: the voxels' quantity, their number and their size."""
    quantities = (("activity", "Activity", "In kBq/mL"), ("mu", "Attenuation", "Linear attenuation in 1/mm"))
    return {
        "quantity": EnumProperty(
            name="Quantity", description="Quantity of the voxels", default="activity", update=update,
            items=choices.items(choices.QUANTITIES, quantities),
        ),
        "voxels": IntProperty(
            name="Voxels per Side", description="Number of voxels along each side of the grid", default=128, min=4,
            soft_max=512, max=4096, update=update,
        ),
        "voxel_size": FloatProperty(
            name="Voxel Size (mm)", description="0 fits the grid to the phantom", min=0.0, soft_max=10.0, precision=3,
            update=update,
        ),
    }  # fmt: skip


AUTO_SIZE = {layouts.unset_name("voxel_size"): check_mark("voxel_size", "Auto", "fits the grid to the phantom", 1.0)}
"""Check mark that fits the voxel size to the phantom."""


def settings_class(kind: PhantomKind, name: str, bases: tuple[type, ...], update: Any = None, **members: Any) -> Any:
    """Return a class for Blender, of `KindSettings` and other bases, with the settings of one kind as properties."""
    fields = {field.name: _make_property(field, kind, update) for field in _setting_fields(kind)}
    if _has_states(kind):
        fields["frames"] = IntProperty(
            name="Frames", description="Number of states of the heart's cycle; 1: its phase alone", default=1, min=1,
            soft_max=48, max=1000, update=update, options={"SKIP_SAVE"},
        )  # fmt: skip
    members["__annotations__"] = members.get("__annotations__", {}) | fields | sampling(update) | AUTO_SIZE
    members |= {"kind": kind, "identifier": identifier(kind), "setting_names": tuple(fields)}
    return type(name, (KindSettings, *bases), members)


def plain_settings(name: str, **values: Any) -> KindSettings:
    """Return a kind's default settings for scripts, with `values` in their place; raise `InputError` for an unknown name."""
    if (kind := next((kind for kind in KINDS if name in (kind.name, identifier(kind))), None)) is None:
        raise InputError(f"phantom {name!r}: expected one of {', '.join(kind.name for kind in KINDS)}")
    settings = KindSettings()
    defaults = {field.name: kind.usual.get(field.name, field.default) for field in _setting_fields(kind)}
    defaults |= {"frames": 1} if _has_states(kind) else {}
    settings.kind, settings.identifier, settings.setting_names = kind, identifier(kind), tuple(defaults)
    defaults |= {"quantity": "activity", "voxels": 128, "voxel_size": 0.0}
    if unknown := values.keys() - defaults.keys():
        raise InputError(f"{kind.label}: no setting {min(unknown)!r}; expected some of {', '.join(defaults)}")
    vars(settings).update(defaults | values)
    return settings


def identifier(kind: PhantomKind) -> str:
    """Return a kind's name in Python."""
    return kind.name.replace("-", "_")


def menu_entries() -> list[tuple[str, str, bool]]:
    """Return the identifier and label of each kind, and whether it can beat."""
    return [(identifier(kind), kind.label, _has_states(kind)) for kind in KINDS]


def _has_states(kind: PhantomKind) -> bool:
    """Return whether a kind of phantom beats, with one state for each frame."""
    return hasattr(kind.phantom, "beating")


def _setting_fields(kind: PhantomKind) -> list[Any]:
    """Return the fields of a kind's class that are settings: those made by `setting`, `count` and `choice`."""
    return [field for field in dataclasses.fields(kind.phantom) if field.metadata]


def _key_ending(field: Any) -> str:
    """Return the ending of a setting's JSON key for its unit: "_mm", "_kBq_per_mL", "_per_mm".

    Shares, angles and words have none.
    """
    unit = field.metadata.get("unit", "")
    if not unit or unit.startswith("of ") or unit == "DEG":  # names of angles end with "_degrees" already
        return ""
    return "_" + unit.replace("1/", "per_").replace("/", "_per_")


def _make_property(field: Any, kind: PhantomKind, update: Any) -> Any:
    """Return the Blender property of a field of a phantom's dataclass."""
    metadata = field.metadata
    unit = metadata.get("unit", "")
    name = field.name.removesuffix("_degrees").replace("_", " ").title()
    default = kind.usual.get(field.name, field.default)
    text = metadata["text"][0].upper() + metadata["text"][1:]
    options: dict[str, Any] = {"name": name, "description": text, "default": default, "update": update}
    if "choices" in metadata:
        words = ((word, word.capitalize(), text) for word in metadata["choices"])
        return EnumProperty(**options, items=choices.items(choices.PHANTOM_WORDS, words))
    size = {"size": len(default)} if isinstance(default, tuple) else {}
    if not unit:
        return (IntVectorProperty if size else IntProperty)(**options, **size, min=metadata["least"])
    if unit.startswith("of "):
        options |= {"description": f"Share {unit}, {metadata['text']}"}
    elif unit == "DEG":
        options |= {"name": f"{name} (°)", "description": f"{text}, in degrees"}
    else:
        options |= {"name": f"{name} ({unit})", "description": f"{text}, in {unit}"}
    # A number that must be above 0 has no `least`.
    options |= {"min": 1e-6 if (least := metadata["least"]) is None else least, "precision": 4 if unit == "1/mm" else 2}
    return (FloatVectorProperty if size else FloatProperty)(**options, **size)


def _plain_value(value: Any) -> Any:
    """Return the value of a setting as the phantom's classes take it."""
    if isinstance(value, bpy.types.bpy_prop_array | tuple):
        return tuple(_plain_value(item) for item in value)
    return decimals.typed(value) if isinstance(value, float) else value


class PhantomTextProperties(PhantomSettings, bpy.types.PropertyGroup):
    """Settings of a phantom that a text of the .blend describes."""

    __annotations__ = {
        "text": PointerProperty(
            name="Text", description="The phantom in TOML", type=bpy.types.Text, update=on_edit("phantom")
        ),
        **sampling(on_edit("phantom")),
        **AUTO_SIZE,
    }
    identifier = FILE
    setting_names = ("text",)

    def phantom(self) -> Phantom:
        """Return the phantom that the text describes."""
        recipe = self.recipe()
        return parse_phantom(recipe["text"], recipe["file"])

    def recipe(self) -> dict[str, Any]:
        """Return the whole text and its name; `InputError` where none is chosen."""
        if self.text is None:
            raise InputError("no text is chosen: choose one that describes a phantom")
        return {"phantom": FILE, "file": self.text.name, "text": self.text.as_string()}


_GROUPS = {
    identifier(kind): settings_class(
        kind, f"{kind.phantom.__name__}Properties", (bpy.types.PropertyGroup,), on_edit("phantom"),
        __doc__=f"Settings of {kind.summary}.",
    )
    for kind in KINDS
} | {FILE: PhantomTextProperties}  # fmt: skip

_KINDS = (
    ("VOLUME", "Volume", "Voxels from elsewhere"),
    *((identifier(kind).upper(), kind.label, kind.summary) for kind in KINDS),
    (FILE.upper(), "Text", "Shapes described by a text"),
)


LOOKS = (
    ("DENSITY", "Density", "Smoke that is the denser, the higher the value"),
    ("BRIGHTEST", "Brightest", "The highest values shine through, as in a maximum intensity projection"),
    ("SHELL", "Shell", "The isosurface of a value: spheres, rods, the heart"),
    ("CUT", "Cut-Away", "The outer surface, cut open at the slices"),
    (
        "BONE",
        "Bone",
        "Of a CT or mu: the bones, in the skin that is cut open at the slices, and the window of soft tissue",
    ),
    ("SOFT", "Soft Tissue", "Of a CT or mu: the skin, and the window of soft tissue"),
    ("LUNG", "Lung", "Of a CT or mu: where air begins, so that a cut shows the lungs, and their window"),
)


class VolumeProperties(bpy.types.PropertyGroup):
    """Properties of a volume, `Object.mphdrr_volume`, with the settings of every kind of phantom (`.derenzo`, ...)."""

    is_volume: BoolProperty(options={"HIDDEN"})
    kind: EnumProperty(name="Kind", description="Kind of the phantom whose settings are used", default="VOLUME",
                       items=choices.items(choices.KINDS, _KINDS))  # fmt: skip
    with_parent: BoolProperty(options={"HIDDEN"})  # another quantity of the phantom that is the parent
    outdated: BoolProperty(options={"HIDDEN"})  # the phantom's settings have changed since its voxels were made
    recipe: StringProperty(options={"HIDDEN"})  # settings of a map, JSON
    scanner: PointerProperty(type=bpy.types.Collection, options={"HIDDEN"})  # scanner of a map
    message: StringProperty(options={"HIDDEN"})  # problem of the phantom's settings
    quantity: EnumProperty(
        name="Quantity", description="Quantity of the voxels", default="activity",
        items=choices.items(choices.QUANTITIES, ((name, name.capitalize(), f"In {unit}") for name, unit in UNITS.items())),
    )  # fmt: skip
    unit: StringProperty(name="Unit", description="Unit of the voxels' values")
    shape: IntVectorProperty(name="Shape", description="Numbers of voxels along the grid's axes", size=3)
    spacing: FloatVectorProperty(name="Spacing", description="Voxel size in mm along the grid's axes", size=3)
    minimum: FloatProperty(name="Minimum", description="Smallest voxel value")
    maximum: FloatProperty(name="Maximum", description="Largest voxel value")
    # Largest side, mm, of the bounding box of the non-empty voxels.
    extent: FloatProperty(default=1.0, options={"HIDDEN"})
    display_low: FloatProperty(
        name="Low", description="Value at and below which nothing is shown", update=on_edit("display_range")
    )
    display_high: FloatProperty(
        name="High", description="Value with the brightest colour", default=1.0, update=on_edit("display_range")
    )
    look: EnumProperty(name="Look", description="How the volume is drawn", items=choices.items({}, LOOKS),
                       default="DENSITY", update=on_edit("look"))  # fmt: skip
    surface: FloatProperty(name="Surface", description="Value of the drawn surface", update=on_edit("display_range"))
    slices: IntVectorProperty(name="Slices", description="Voxel of each slice", size=3, min=0, update=on_edit("slices"))
    # Name of the file that the voxels were first stored in: it identifies them in every version of Blender.
    content: StringProperty(options={"HIDDEN"})
    exact_pose: StringProperty(options={"HIDDEN"})  # world-from-object matrix in double precision, JSON
    # Voxels by which the .vdb is shifted for the Blender that wrote it.
    center_shift: FloatProperty(options={"HIDDEN"})


VolumeProperties.__annotations__.update(
    {name: PointerProperty(name=name.capitalize(), type=group) for name, group in _GROUPS.items()}
)

CLASSES = (*_GROUPS.values(), VolumeProperties)
