"""Settings of phantoms and volumes: what an operator asks for is what the object keeps.

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

FILE = "file"  # beside the names of `KINDS`: a phantom that a text in TOML describes


class PhantomSettings:
    """What a phantom is made from: mixed into the operator that adds one and into the properties that its object keeps.

    The properties themselves are those of `settings_class`, or a text, and those of `sampling`.
    """

    identifier = ""
    """The kind's name in Python: of its operator and of its settings in `VolumeProperties`."""
    own_names: tuple[str, ...] = ()
    """Names of the settings beside those of `sampling`, in the order of drawing."""
    n_states = 1
    """How many states there are, one for each frame."""

    voxels: Any
    voxel_size: Any

    @property
    def n_voxels(self) -> int:
        """How many voxels a volume has, of all states."""
        return int(self.voxels**3) * self.n_states

    def values(self) -> dict[str, Any]:
        """Every setting by name, vectors as tuples."""
        values = {name: getattr(self, name) for name in (*self.own_names, *sampling())}
        return {k: tuple(v) if isinstance(v, bpy.types.bpy_prop_array) else v for k, v in values.items()}

    def phantom(self) -> Phantom:
        """The phantom; of one that beats, its first state. Raises InputError."""
        raise NotImplementedError

    def recipe(self) -> dict[str, Any]:
        """The settings as JSON can hold them."""
        raise NotImplementedError

    def grid(self, phantom: Phantom) -> Grid:
        """The phantom's grid, in its own frame: as many voxels along every side."""
        low, high = phantom.box
        # One voxel is kept free all around, so that nothing touches the edge.
        fitted = float((high - low).max()) / max(1, self.voxels - 2)
        return Grid.centered((self.voxels,) * 3, decimals.typed(self.voxel_size) or fitted, (low + high) / 2)

    def draw_settings(self, layout: bpy.types.UILayout) -> None:
        """Draw the settings into a panel or a dialog."""
        own = layout.column(align=True)
        own.use_property_split = False  # names with units need the whole width
        for name in self.own_names:
            value = getattr(self, name)
            if isinstance(value, bpy.types.bpy_prop_array):
                known: Any = getattr(self, "properties", self)  # an operator keeps them apart
                own.label(text=known.bl_rna.properties[name].name)
                for first in range(0, len(value), 3):
                    row = own.row(align=True)
                    for k in range(first, min(first + 3, len(value))):
                        row.prop(self, name, index=k, text="")
            else:
                own.prop(self, name)
        layouts.draw_settings(layout.column(align=True), self, ((name, True) for name in sampling()))


class KindSettings(PhantomSettings):
    """The settings of one of `KINDS`."""

    kind = KINDS[0]

    @property
    def n_states(self) -> int:  # type: ignore[override]
        """How many phases of the heart's cycle."""
        return int(self.frames) if _beats(self.kind) else 1  # type: ignore[attr-defined]

    def phantom(self) -> Phantom:
        """The phantom; float32 settings are read as the decimal numbers that the user typed."""
        return self.kind.phantom(**self._arguments())

    def recipe(self) -> dict[str, Any]:
        """The class's fields, their units in their names, and the number of frames of one that beats."""
        recipe: dict[str, Any] = {"phantom": self.kind.name}
        for field in _fields(self.kind):
            value = self._arguments()[field.name]
            recipe[field.name + _key_ending(field)] = list(value) if isinstance(value, tuple) else value
        return recipe | {"frames": self.n_states} if self.n_states > 1 else recipe

    def _arguments(self) -> dict[str, Any]:
        values = {field.name: _plain(getattr(self, field.name)) for field in _fields(self.kind)}
        return values | {"phase": 0.0} if self.n_states > 1 else values


def sampling(update: Any = None) -> dict[str, Any]:
    """Properties of all phantoms: what the voxels hold, and how many there are."""
    quantities = (("activity", "Activity", "In kBq/mL"), ("mu", "Attenuation", "Linear attenuation in 1/mm"))
    return {
        "quantity": EnumProperty(
            name="Quantity", description="What the voxels hold", default="activity", update=update,
            items=choices.items(choices.QUANTITIES, quantities),
        ),
        "voxels": IntProperty(
            name="Voxels per Side", description="How many the grid has along each of its sides", default=128, min=4,
            soft_max=512, max=4096, update=update,
        ),
        "voxel_size": FloatProperty(
            name="Voxel Size (mm)", description="0 fits the grid to the phantom", min=0.0, soft_max=10.0, precision=3,
            update=update,
        ),
    }  # fmt: skip


FITTED = {layouts.unset_name("voxel_size"): check_mark("voxel_size", "Auto", "fits the grid to the phantom", 1.0)}


def settings_class(kind: PhantomKind, name: str, bases: tuple[type, ...], update: Any = None, **members: Any) -> Any:
    """A class for Blender, of `KindSettings` and other bases, with the settings of one kind as properties."""
    own = {field.name: _property(field, kind, update) for field in _fields(kind)}
    if _beats(kind):
        own["frames"] = IntProperty(
            name="Frames", description="States of the heart's cycle; 1: it stands still at its phase", default=1, min=1,
            soft_max=48, max=1000, update=update, options={"SKIP_SAVE"},
        )  # fmt: skip
    members["__annotations__"] = members.get("__annotations__", {}) | own | sampling(update) | FITTED
    members |= {"kind": kind, "identifier": identifier(kind), "own_names": tuple(own)}
    return type(name, (KindSettings, *bases), members)


def plain_settings(name: str, **values: Any) -> KindSettings:
    """Settings of the kind with that name, for scripts: its defaults, and the values given; raises InputError."""
    kind = next((kind for kind in KINDS if name in (kind.name, identifier(kind))), None)
    if kind is None:
        raise InputError(f"phantom {name!r}: expected one of {', '.join(kind.name for kind in KINDS)}")
    settings = KindSettings()
    known = {field.name: kind.usual.get(field.name, field.default) for field in _fields(kind)}
    known |= {"frames": 1} if _beats(kind) else {}
    settings.kind, settings.identifier, settings.own_names = kind, identifier(kind), tuple(known)
    known |= {"quantity": "activity", "voxels": 128, "voxel_size": 0.0}
    if unknown := values.keys() - known.keys():
        raise InputError(f"{kind.label}: no setting {min(unknown)!r}; expected some of {', '.join(known)}")
    vars(settings).update(known | values)
    return settings


def identifier(kind: PhantomKind) -> str:
    """A kind's name in Python."""
    return kind.name.replace("-", "_")


def menu_entries() -> list[tuple[str, str, bool]]:
    """Identifier and label of each kind, and whether it can beat."""
    return [(identifier(kind), kind.label, _beats(kind)) for kind in KINDS]


def _beats(kind: PhantomKind) -> bool:
    """Whether a kind of phantom has states, one for each frame."""
    return hasattr(kind.phantom, "beating")


def _fields(kind: PhantomKind) -> list[Any]:
    """The fields of a kind's class that can be set: those made by `setting`, `count` and `choice`."""
    return [field for field in dataclasses.fields(kind.phantom) if field.metadata]


def _key_ending(field: Any) -> str:
    """A setting's unit as JSON's keys end with it: "_mm", "_kBq_per_mL", "_per_mm"; none for shares, degrees and words."""
    unit = field.metadata.get("unit", "")
    if not unit or unit.startswith("of ") or unit == "DEG":  # names of angles end with "_degrees" already
        return ""
    return "_" + unit.replace("1/", "per_").replace("/", "_per_")


def _property(field: Any, kind: PhantomKind, update: Any) -> Any:
    """A field of a phantom's dataclass as a property."""
    known = field.metadata
    unit = known.get("unit", "")
    name = field.name.removesuffix("_degrees").replace("_", " ").title()
    default = kind.usual.get(field.name, field.default)
    text = known["text"][0].upper() + known["text"][1:]
    options: dict[str, Any] = {"name": name, "description": text, "default": default, "update": update}
    if "choices" in known:
        words = ((word, word.capitalize(), text) for word in known["choices"])
        return EnumProperty(**options, items=choices.items(choices.PHANTOM_WORDS, words))
    many = {"size": len(default)} if isinstance(default, tuple) else {}
    if not unit:
        return (IntVectorProperty if many else IntProperty)(**options, **many, min=known["least"])
    if unit.startswith("of "):
        options |= {"description": f"Share {unit}, {known['text']}"}
    elif unit == "DEG":
        options |= {"name": f"{name} (°)", "description": f"{text}, in degrees"}
    else:
        options |= {"name": f"{name} ({unit})", "description": f"{text}, in {unit}"}
    # What must be above 0 has no smallest number.
    options |= {"min": 1e-6 if known["least"] is None else known["least"], "precision": 4 if unit == "1/mm" else 2}
    return (FloatVectorProperty if many else FloatProperty)(**options, **many)


def _plain(value: Any) -> Any:
    """A setting as the phantom's classes take it."""
    if isinstance(value, bpy.types.bpy_prop_array | tuple):
        return tuple(_plain(item) for item in value)
    return decimals.typed(value) if isinstance(value, float) else value


class PhantomTextProperties(PhantomSettings, bpy.types.PropertyGroup):
    """Settings of a phantom that a text of the .blend describes."""

    __annotations__ = {
        "text": PointerProperty(
            name="Text", description="Describes the phantom in TOML", type=bpy.types.Text, update=on_edit("phantom")
        ),
        **sampling(on_edit("phantom")),
        **FITTED,
    }
    identifier = FILE
    own_names = ("text",)

    def phantom(self) -> Phantom:
        """The text's phantom."""
        recipe = self.recipe()
        return parse_phantom(recipe["text"], recipe["file"])

    def recipe(self) -> dict[str, Any]:
        """The whole text, and its name. Raises InputError."""
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
    (FILE.upper(), "Text", "Shapes that a text describes"),
)


LOOKS = (
    ("DENSITY", "Density", "Smoke that is the denser, the higher the value"),
    ("BRIGHTEST", "Brightest", "The highest values shine through, as in a maximum intensity projection"),
    ("SHELL", "Shell", "The surface at a value: spheres, rods, the heart"),
    ("CUT", "Cut-Away", "The outer surface, cut open at the slices"),
    ("BONE", "Bone", "Of a CT or mu: the bones' surface, and their window"),
    ("SOFT", "Soft Tissue", "Of a CT or mu: the skin, and the window of soft tissue"),
    ("LUNG", "Lung", "Of a CT or mu: where air begins, so that a cut shows the lungs, and their window"),
)


class VolumeProperties(bpy.types.PropertyGroup):
    """One volume; lives on its object as `Object.mphdrr_volume`, with the settings of every kind (`.derenzo`, ...)."""

    is_volume: BoolProperty(options={"HIDDEN"})
    kind: EnumProperty(
        name="Kind", description="The kind whose settings count", default="VOLUME",
        items=choices.items(choices.KINDS, _KINDS),
    )  # fmt: skip
    with_parent: BoolProperty(options={"HIDDEN"})  # another quantity of the phantom that is the parent
    outdated: BoolProperty(options={"HIDDEN"})  # the phantom's settings have changed since its voxels were made
    recipe: StringProperty(options={"HIDDEN"})  # of a map: how it was made, JSON
    scanner: PointerProperty(type=bpy.types.Collection, options={"HIDDEN"})  # that a map is of
    message: StringProperty(options={"HIDDEN"})  # what is wrong with the phantom's settings
    quantity: EnumProperty(
        name="Quantity", description="What the voxels hold", default="activity",
        items=choices.items(choices.QUANTITIES, ((name, name.capitalize(), f"In {unit}") for name, unit in UNITS.items())),
    )  # fmt: skip
    unit: StringProperty(name="Unit", description="Unit of the voxels' values")
    shape: IntVectorProperty(name="Shape", description="Voxels along the grid's axes", size=3)
    spacing: FloatVectorProperty(name="Spacing", description="Voxel size in mm along the grid's axes", size=3)
    minimum: FloatProperty(name="Minimum", description="Smallest voxel value")
    maximum: FloatProperty(name="Maximum", description="Largest voxel value")
    # Largest side in mm of the box around the voxels that are not empty.
    extent: FloatProperty(default=1.0, options={"HIDDEN"})
    display_low: FloatProperty(
        name="Low", description="Value at and below which nothing is shown", update=on_edit("display_range")
    )
    display_high: FloatProperty(
        name="High", description="Value that is shown brightest", default=1.0, update=on_edit("display_range")
    )
    look: EnumProperty(
        name="Look", description="How the volume is drawn", items=choices.items({}, LOOKS), default="DENSITY",
        update=on_edit("look"),
    )  # fmt: skip
    surface: FloatProperty(
        name="Surface", description="Value at which the surface is drawn", update=on_edit("display_range")
    )
    slices: IntVectorProperty(name="Slices", description="Voxel from 0", size=3, min=0, update=on_edit("slices"))
    # Name of the file that the voxels were first stored in: says whether they are the same, in every version of Blender.
    content: StringProperty(options={"HIDDEN"})
    exact_pose: StringProperty(options={"HIDDEN"})  # world-from-object matrix in double precision, JSON
    # Voxels by which the .vdb is shifted for the Blender that wrote it.
    center_shift: FloatProperty(options={"HIDDEN"})


VolumeProperties.__annotations__.update(
    {name: PointerProperty(name=name.capitalize(), type=group) for name, group in _GROUPS.items()}
)

CLASSES = (*_GROUPS.values(), VolumeProperties)
