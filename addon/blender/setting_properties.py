"""Blender properties made from the settings of `core.runs.settings`, and the values of recipes that they say."""

from collections.abc import Callable, Iterator, Mapping
from typing import Any

from bpy import props

from ...core.errors import InputError, expecting
from ...core.recipes.settings import Setting
from ...core.recipes.values import is_met
from ...core.runs.settings import SETTINGS
from . import choices, decimals, layouts, storage

Settings = Mapping[str, Setting]
"""Settings by the names of their properties. A coefficient has a second property, of its material."""

_NUMBERS = {
    "model": choices.MODELS,
    "isotope": choices.ISOTOPES,
    "aperture_material": choices.APERTURES,
    "edge": choices.EDGES,
    "crystal_material": choices.CRYSTALS,
    "detector": choices.DETECTORS,
    "backend": choices.BACKENDS,
}


def material_of(name: str, setting: Setting) -> str | None:
    """The property of a coefficient's material; None for other settings."""
    return name.replace("_mu", "_material") if setting.kind is float and setting.words else None


def of_modules(name: str, setting: Setting) -> str | None:
    """The property of numbers of modules, a text; None for settings that have one number."""
    return f"{name}_of_modules" if setting.of_modules else None


def identifier(name: str, word: str) -> str:
    """How an enumeration calls a word: isotopes, materials and what is said of files by their names, others in capitals."""
    is_name = name in ("isotope", "orientation", "raw_type") or name.endswith("_material")
    return word if is_name else word.upper().replace("-", "_")


def properties_of(settings: Settings) -> dict[str, Any]:
    """The properties, annotations of a class, of settings."""
    made: dict[str, Any] = {}
    for name, setting in settings.items():
        nothing = "empty" if setting.kind is str else "0"
        absent = f"; {nothing}: {setting.absent}" if setting.default is None and setting.absent else ""
        common: dict[str, Any] = {"name": setting.label, "description": setting.text + absent}
        if setting.kind in (int, float):
            least = setting.least if setting.above is None else 1e-6
            limits = {"min": 0 if setting.default is None else least, "max": setting.most, "soft_max": setting.slider}
            limits["precision"] = 3 if setting.kind is float else None
            common |= {key: value for key, value in limits.items() if value is not None}
        material = material_of(name, setting)
        if material is not None:
            none = ("NUMBER", "By Coefficient", f"By its attenuation coefficient{absent}")
            made[material] = _enumeration(material, setting, none)
            common["name"] = f"µ ({setting.unit})"  # below the material's menu
        if setting.kind is bool:
            made[name] = props.BoolProperty(**common, default=setting.default)
        elif setting.kind is str and not setting.words:
            made[name] = props.StringProperty(**common)
        elif setting.kind is str:
            absent_item = ("NONE", setting.unset, setting.absent.capitalize()) if setting.default is None else None
            made[name] = _enumeration(name, setting, absent_item)
        elif is_list(setting):
            text = f"{setting.text}; such as 10, 20, 30. Empty: {setting.absent}"
            made[name] = props.StringProperty(name=setting.label, description=text)
        elif _is_vector(setting):
            many = props.IntVectorProperty if setting.kind is int else props.FloatVectorProperty
            made[name] = many(size=setting.sizes[0], default=(0,) * setting.sizes[0], **common)  # type: ignore[index]
        else:
            make: Callable[..., Any] = props.IntProperty if setting.kind is int else props.FloatProperty
            default = setting.default[0] if isinstance(setting.default, tuple) else setting.default or 0
            made[name] = make(default=default, **common)
        if each := of_modules(name, setting):
            or_file = f", or a file with an image for each ({', '.join(setting.endings)})" if setting.endings else ""
            as_file = {"subtype": "FILE_PATH", "options": {"PATH_SUPPORTS_BLEND_RELATIVE"}} if setting.endings else {}
            made[each] = props.StringProperty(
                **as_file,
                name=f"Each {setting.label.partition(' (')[0]}",
                description=f"A number for each module that is projected, such as 10, 20, 30{or_file}. Empty: one for all",
            )
    return made


def unset_of(settings: Settings) -> dict[str, Any]:
    """Check marks for a panel's class, one for each number that need not be given: whether it is not.

    Where it is taken away, the number becomes a tenth of what its slider reaches.
    """
    marks = {}
    for name, setting in settings.items():
        if setting.kind in (int, float) and setting.default is None and not is_list(setting):
            first = setting.kind((setting.slider or 10) / 10)
            values = tuple(first * (k + 1) for k in range(setting.sizes[0])) if _is_vector(setting) else first  # type: ignore[index]
            marks[layouts.unset_name(name)] = check_mark(name, setting.unset, setting.absent, values)
    return marks


def check_mark(name: str, word: str, text: str, first: Any) -> Any:
    """A check mark, called by a word: whether a number is 0 and not given. Where it is taken away, it becomes `first`."""
    nothing = (0.0,) * len(first) if isinstance(first, tuple) else type(first)(0)

    def is_unset(owner: Any) -> bool:
        value = getattr(owner, name)
        return not (any(value) if isinstance(first, tuple) else value)

    def give(owner: Any, unset: bool) -> None:
        if unset != is_unset(owner):
            setattr(owner, name, nothing if unset else first)

    description = f"{word}: {text}. Take the check mark away to give a number"
    return props.BoolProperty(name=word, description=description, get=is_unset, set=give)


def values_of(settings: Settings, get: Callable[[str], Any]) -> dict[str, Any]:
    """The values of the settings by their keys in a recipe, None for none; `get` gives a property's."""
    values: dict[str, Any] = {}
    for name, setting in settings.items():
        material = material_of(name, setting)
        value = get(name)
        if (each := of_modules(name, setting)) and (text := get(each).strip()):
            values[setting.key] = str(storage.absolute(text)) if setting.names_file(text) else text
            continue
        if material is not None and get(material) != "NUMBER":
            name, value = material, get(material)
        if is_list(setting):
            values[setting.key] = _numbers(setting, value)
        elif isinstance(value, str) and not setting.words:
            values[setting.key] = value or None
        elif isinstance(value, str):
            words = {identifier(name, word): word for word in setting.words} | {"NONE": None}
            if value not in words:
                raise InputError(f"{setting.label}: {value!r} is not known to this version; choose another")
            values[setting.key] = words[value]
        elif _is_vector(setting):
            numbers = (decimals.typed(each) if setting.kind is float else each for each in value)
            values[setting.key] = tuple(numbers) if any(value) else None
        else:
            number = decimals.typed(value) if isinstance(value, float) else value
            values[setting.key] = number if number or setting.default is not None else None
    return values


def drawn_of(
    settings: Settings, owner: Any, is_hidden: Callable[[str], bool], table: str = ""
) -> Iterator[tuple[str, bool]]:
    """The properties of an owner to draw, of all tables or one, each with whether it has an effect beside the others.

    Those of whose unmet conditions one `is_hidden` are left out.
    """
    try:
        known = values_of(settings, lambda name: getattr(owner, name))
    except InputError:  # a choice of a later version, which work refuses
        known = {}
    values = {key: value for key, value in known.items() if value is not None}
    for name, setting in settings.items():
        if table and not setting.key.startswith(f"{table}."):
            continue
        unmet = [need for need in setting.needs if not is_met(values, need, SETTINGS)]
        if any(map(is_hidden, unmet)):
            continue
        material = material_of(name, setting)
        if material is not None:
            yield material, not unmet
        if material is None or getattr(owner, material) == "NUMBER":
            yield name, not unmet
        if each := of_modules(name, setting):
            yield each, not unmet


def set_property(owner: Any, settings: Settings, name: str, value: Any) -> None:
    """Set a property to a value of a recipe; None and "auto" are its default."""
    setting = settings[name]
    material, each = material_of(name, setting), of_modules(name, setting)
    for own in filter(None, (name, material, each)):
        owner.property_unset(own)
    if each and isinstance(value, str | list | tuple):
        setattr(owner, each, value if isinstance(value, str) else ", ".join(map(str, value)))
    elif is_list(setting):
        setattr(owner, name, ", ".join(f"{number:g}" for number in value or ()))
    elif isinstance(value, str) and value != "auto":
        own = material or name
        setattr(owner, own, identifier(own, value))
    elif value not in (None, "auto"):
        setattr(owner, name, value)


def is_list(setting: Setting) -> bool:
    """Whether it has any number of values; its property is a text."""
    return setting.sizes == () and setting.kind is float


def _numbers(setting: Setting, text: str) -> tuple[float, ...] | None:
    with expecting(f"{setting.label}: expected numbers such as 10, 20, 30, got {text!r}"):
        return tuple(map(float, text.replace(",", " ").split())) or None


def _is_vector(setting: Setting) -> bool:
    """Whether it has several values; of one that may have one for all, the property is that one."""
    return bool(setting.sizes) and 1 not in setting.sizes  # type: ignore[operator]


def _enumeration(name: str, setting: Setting, none: tuple[str, str, str] | None) -> Any:
    words = [(identifier(name, word), label, text) for word, (label, text) in setting.words.items()]
    items = choices.items(_NUMBERS.get(name, {}), ([none] if none else []) + words)
    default = none[0] if none else identifier(name, setting.default)
    return props.EnumProperty(name=setting.label, description=setting.text, items=items, default=default)
