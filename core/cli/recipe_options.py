"""Options for the entries of recipes, made from `runs.settings`; in the namespace are only those that are typed."""

import argparse
import tomllib
from typing import Any

from ..errors import InputError
from ..recipes.settings import Setting
from .options import number_or_name


def add_setting(parser: Any, setting: Setting, is_listed: bool = True) -> None:
    """Add the option of a setting; one that is not listed is left out of the help."""
    text = argparse.SUPPRESS
    if is_listed:
        default = setting.default
        if isinstance(default, tuple):
            default = " ".join(f"{value:g}" for value in default)
        text = setting.help + (f" (default: {default})" if default not in (None, False) else "")
    details: dict[str, Any] = {"type": str} if setting.kind is str else {}
    if setting.kind is bool:
        details["action"] = argparse.BooleanOptionalAction if setting.default else "store_true"
    else:
        details["metavar"] = "FILE" if setting.is_path else "NAME" if details else setting.unit.upper() or "VALUE"
    if setting.sizes is not None or setting.kind is list:
        details["nargs"] = "+"
    add_option(parser, setting.option, (setting.key,), text, **details)


def add_option(parser: Any, option: str, keys: tuple[str, ...], text: str, **details: Any) -> None:
    """Add an option for an entry of the recipe, or for several."""
    if "action" not in details:
        details = {"type": _value, "metavar": "VALUE", **details}
    if text != argparse.SUPPRESS:
        text = text.replace("%", "%%")
        text = text[0].lower() + text[1:] if text[1].islower() else text  # as in the other options' help
    parser.add_argument(option, dest=" ".join(keys), default=argparse.SUPPRESS, help=text, **details)


def add_entries(parser: Any, example: str = "model.aperture_points=7") -> None:
    """Add ``--set KEY=VALUE``."""
    text = f"any entry of a recipe, such as {example}; KEY= takes it away"
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", dest="entries", help=text)


def typed_entries(arguments: argparse.Namespace) -> dict[str, Any]:
    """What the options say, by the keys of recipes; None for what is taken away."""
    changes: dict[str, Any] = {}
    for dest, value in vars(arguments).items():
        keys = dest.split()
        changes |= dict(zip(keys, value if len(keys) > 1 else [value], strict=True)) if "." in dest else {}
    for entry in arguments.entries:
        key, equals, text = entry.partition("=")
        if not equals:
            raise InputError(f"--set {entry}: expected KEY=VALUE, such as model.aperture_points=7")
        changes[key.strip()] = _value(text) if text.strip() else None
    return changes


def _value(text: str) -> Any:
    """A value as in TOML, or a text without quotes."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return number_or_name(text.strip())
