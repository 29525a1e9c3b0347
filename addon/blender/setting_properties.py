"""Blender properties made from the settings of `core.runs.settings`, and the recipe values that they hold."""

from collections.abc import Callable, Iterator, Mapping
from typing import Any

from bpy import props

from ...core.errors import InputError, expecting
from ...core.recipes.settings import Setting
from ...core.recipes.values import is_met
from ...core.runs.settings import SETTINGS
from . import choices, decimals, layouts, storage

Settings = Mapping[str, Setting]
"""Settings by the names of their properties; an attenuation coefficient has a second property for its material."""

_CHOICE_NUMBERS = {
    "model": choices.MODELS,
    "isotope": choices.ISOTOPES,
    "aperture_material": choices.APERTURES,
    "edge": choices.EDGES,
    "crystal_material": choices.CRYSTALS,
    "detector": choices.DETECTORS,
    "backend": choices.BACKENDS,
}
"""The numbers by which .blend files store each choice, by the name of its property."""


def material_property(name: str, setting: Setting) -> str | None:
    """Return the name of the property for an attenuation coefficient's material; None for any other setting."""
    return name.replace("_mu", "_material") if setting.kind is float and setting.words else None


def modules_property(name: str, setting: Setting) -> str | None:
    """Return the name of the text property for one number per module; None for settings with one number for all."""
    return f"{name}_of_modules" if setting.of_modules else None


def identifier(name: str, word: str) -> str:
    """Return a word's identifier in an enumeration: capitals, but isotopes, materials and file layouts keep their names."""
    is_proper_name = name in ("isotope", "orientation", "raw_type") or name.endswith("_material")
    return word if is_proper_name else word.upper().replace("-", "_")


def make_properties(settings: Settings) -> dict[str, Any]:
    """Return the Blender properties of settings, by name, as a class takes them in its annotations."""
    result: dict[str, Any] = {}
    for name, setting in settings.items():
        zero = "empty" if setting.kind is str else "0"
        absent = f"; {zero}: {setting.absent}" if setting.default is None and setting.absent else ""
        common: dict[str, Any] = {"name": setting.label, "description": setting.text + absent}
        if setting.kind in (int, float):
            least = setting.least if setting.above is None else 1e-6
            limits = {"min": 0 if setting.default is None else least, "max": setting.most, "soft_max": setting.slider}
            limits["precision"] = 3 if setting.kind is float else None
            common |= {key: value for key, value in limits.items() if value is not None}
        if (material := material_property(name, setting)) is not None:
            no_material = ("NUMBER", "By Coefficient", f"By its attenuation coefficient{absent}")
            result[material] = _enumeration(material, setting, no_material)
            common["name"] = f"µ ({setting.unit})"  # below the material's menu
        if setting.kind is bool:
            result[name] = props.BoolProperty(**common, default=setting.default)
        elif setting.kind is str and not setting.words:
            result[name] = props.StringProperty(**common)
        elif setting.kind is str:
            absent_item = ("NONE", setting.unset, setting.absent.capitalize()) if setting.default is None else None
            result[name] = _enumeration(name, setting, absent_item)
        elif is_list(setting):
            text = f"{setting.text}; such as 10, 20, 30. Empty: {setting.absent}"
            result[name] = props.StringProperty(name=setting.label, description=text)
        elif _is_vector(setting):
            vector = props.IntVectorProperty if setting.kind is int else props.FloatVectorProperty
            result[name] = vector(size=setting.sizes[0], default=(0,) * setting.sizes[0], **common)  # type: ignore[index]
        else:
            make: Callable[..., Any] = props.IntProperty if setting.kind is int else props.FloatProperty
            default = setting.default[0] if isinstance(setting.default, tuple) else setting.default or 0
            result[name] = make(default=default, **common)
        if modules_name := modules_property(name, setting):
            or_file = f", or a file with an image for each ({', '.join(setting.endings)})" if setting.endings else ""
            as_file = {"subtype": "FILE_PATH", "options": {"PATH_SUPPORTS_BLEND_RELATIVE"}} if setting.endings else {}
            result[modules_name] = props.StringProperty(
                **as_file,
                name=f"Each {setting.label.partition(' (')[0]}",
                description=f"A number for each module that is projected, such as 10, 20, 30{or_file}. Empty: one for all",
            )
    return result


def make_check_marks(settings: Settings) -> dict[str, Any]:
    """Return check marks, by name, for the numbers that may be left out; a mark is set where the number is left out.

    Where the user removes a mark, the number becomes a tenth of its slider's upper end.
    """
    marks = {}
    for name, setting in settings.items():
        if setting.kind in (int, float) and setting.default is None and not is_list(setting):
            first = setting.kind((setting.slider or 10) / 10)
            size = setting.sizes[0] if _is_vector(setting) else 0  # type: ignore[index]
            value = tuple(first * (k + 1) for k in range(size)) or first
            marks[layouts.unset_name(name)] = check_mark(name, setting.unset, setting.absent, value)
    return marks


def check_mark(name: str, word: str, text: str, first_value: Any) -> Any:
    """Return a check mark labelled `word`, set while the number `name` is 0; removing it gives the number a first value."""
    zero = (0.0,) * len(first_value) if isinstance(first_value, tuple) else type(first_value)(0)

    def is_unset(owner: Any) -> bool:
        """Return whether the number is left out."""
        value = getattr(owner, name)
        return not (any(value) if isinstance(first_value, tuple) else value)

    def set_unset(owner: Any, unset: bool) -> None:
        """Remove the number, or give it a value."""
        if unset != is_unset(owner):
            setattr(owner, name, zero if unset else first_value)

    description = f"{word}: {text}. Take the check mark away to give a number"
    return props.BoolProperty(name=word, description=description, get=is_unset, set=set_unset)


def read_values(settings: Settings, get: Callable[[str], Any]) -> dict[str, Any]:
    """Return the values of settings by recipe key, None where unset; `get` returns a property's value by its name."""
    values: dict[str, Any] = {}
    for name, setting in settings.items():
        material = material_property(name, setting)
        value = get(name)
        if (modules_name := modules_property(name, setting)) and (text := get(modules_name).strip()):
            values[setting.key] = str(storage.absolute(text)) if setting.names_file(text) else text
            continue
        if material is not None and get(material) != "NUMBER":
            name, value = material, get(material)
        if is_list(setting):
            values[setting.key] = _parse_numbers(setting, value)
        elif isinstance(value, str) and not setting.words:
            values[setting.key] = value or None
        elif isinstance(value, str):
            words = {identifier(name, word): word for word in setting.words} | {"NONE": None}
            if value not in words:
                raise InputError(f"{setting.label}: {value!r} is not known to this version; choose another")
            values[setting.key] = words[value]
        elif _is_vector(setting):
            components = (decimals.typed(x) if setting.kind is float else x for x in value)
            values[setting.key] = tuple(components) if any(value) else None
        else:
            number = decimals.typed(value) if isinstance(value, float) else value
            values[setting.key] = number if number or setting.default is not None else None
    return values


def properties_to_draw(
    settings: Settings, owner: Any, is_hidden: Callable[[str], bool], table: str = ""
) -> Iterator[tuple[str, bool]]:
    """Yield the names of the properties to draw, each with whether it has an effect beside the other values.

    `table` restricts them to the settings of one recipe table. A setting is left out if `is_hidden` is true of one of its
    unmet conditions.
    """
    try:
        values = read_values(settings, lambda name: getattr(owner, name))
    except InputError:  # a choice of a later version, which work refuses
        values = {}
    values = {key: value for key, value in values.items() if value is not None}
    for name, setting in settings.items():
        if table and not setting.key.startswith(f"{table}."):
            continue
        unmet = [need for need in setting.needs if not is_met(values, need, SETTINGS)]
        if any(map(is_hidden, unmet)):
            continue
        if (material := material_property(name, setting)) is not None:
            yield material, not unmet
        if material is None or getattr(owner, material) == "NUMBER":
            yield name, not unmet
        if modules_name := modules_property(name, setting):
            yield modules_name, not unmet


def set_property(owner: Any, settings: Settings, name: str, value: Any) -> None:
    """Set a property to a value of a recipe; None and "auto" reset it to its default."""
    setting = settings[name]
    material, modules_name = material_property(name, setting), modules_property(name, setting)
    for property_name in filter(None, (name, material, modules_name)):
        owner.property_unset(property_name)
    if modules_name and isinstance(value, str | list | tuple):
        setattr(owner, modules_name, value if isinstance(value, str) else ", ".join(map(str, value)))
    elif is_list(setting):
        setattr(owner, name, ", ".join(f"{number:g}" for number in value or ()))
    elif isinstance(value, str) and value != "auto":
        property_name = material or name
        setattr(owner, property_name, identifier(property_name, value) if setting.words else value)
    elif value not in (None, "auto"):
        setattr(owner, name, value)


def is_list(setting: Setting) -> bool:
    """Return whether a setting has any number of values; its property is then a text."""
    return setting.sizes == () and setting.kind is float


def _parse_numbers(setting: Setting, text: str) -> tuple[float, ...] | None:
    """Parse a text such as "10, 20, 30" as numbers; return None for an empty one."""
    with expecting(f"{setting.label}: expected numbers such as 10, 20, 30, got {text!r}"):
        return tuple(map(float, text.replace(",", " ").split())) or None


def _is_vector(setting: Setting) -> bool:
    """Return whether a setting has several components; if one number may stand for all, its property is that number."""
    return bool(setting.sizes) and 1 not in setting.sizes  # type: ignore[operator]


def _enumeration(name: str, setting: Setting, no_choice: tuple[str, str, str] | None) -> Any:
    """Return an enumeration of a setting's words; `no_choice` is the entry for none, the default where there is one."""
    entries = [(identifier(name, word), label, text) for word, (label, text) in setting.words.items()]
    items = choices.items(_CHOICE_NUMBERS.get(name, {}), ([no_choice] if no_choice else []) + entries)
    default = no_choice[0] if no_choice else identifier(name, setting.default)
    return props.EnumProperty(name=setting.label, description=setting.text, items=items, default=default)
