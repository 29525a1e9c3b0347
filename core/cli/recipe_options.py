"""Options for the entries of recipes, made from `runs.settings`; an option that is not typed leaves no entry."""

import argparse
import tomllib
from typing import Any

from ..errors import InputError
from ..recipes.settings import Setting
from .options import parse_number_or_name


def add_setting(parser: Any, setting: Setting, is_listed: bool = True) -> None:
    """Add the option of a setting; the help leaves out a setting that is not listed."""
    help_text = argparse.SUPPRESS
    if is_listed:
        default = setting.default
        if isinstance(default, tuple):
            default = " ".join(f"{value:g}" for value in default)
        help_text = setting.help + (f" (default: {default})" if default not in (None, False) else "")
    details: dict[str, Any] = {"type": str} if setting.kind is str else {}
    if setting.kind is bool:
        details["action"] = argparse.BooleanOptionalAction if setting.default else "store_true"
    else:
        details["metavar"] = "FILE" if setting.is_path else "NAME" if details else setting.unit.upper() or "VALUE"
    if setting.sizes is not None or setting.kind is list:
        details["nargs"] = "+"
    add_option(parser, setting.option, (setting.key,), help_text, **details)


def add_option(parser: Any, option: str, keys: tuple[str, ...], help_text: str, **details: Any) -> None:
    """Add an option for the recipe's entries `keys`, one or several; further `details` are those of argparse."""
    if "action" not in details:
        details = {"type": _parse_value, "metavar": "VALUE", **details}
    if help_text != argparse.SUPPRESS:
        help_text = help_text.replace("%", "%%")
        # The help of other options begins in lower case, too.
        help_text = help_text[0].lower() + help_text[1:] if help_text[1].islower() else help_text
    parser.add_argument(option, dest=" ".join(keys), default=argparse.SUPPRESS, help=help_text, **details)


def add_entries(parser: Any, example: str = "model.aperture_points=7") -> None:
    """Add the option ``--set KEY=VALUE``, which sets or deletes any entry of a recipe."""
    help_text = f"any entry of a recipe, such as {example}; KEY= deletes it"
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", dest="entries", help=help_text)


def entries_from_options(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the recipe entries given as options, by key; None marks an entry to delete (``KEY=``)."""
    changes: dict[str, Any] = {}
    for dest, value in vars(arguments).items():
        keys = dest.split()
        changes |= dict(zip(keys, value if len(keys) > 1 else [value], strict=True)) if "." in dest else {}
    for entry in arguments.entries:
        key, equals, text = entry.partition("=")
        if not equals:
            raise InputError(f"--set {entry}: expected KEY=VALUE, such as model.aperture_points=7")
        changes[key.strip()] = _parse_value(text) if text.strip() else None
    return changes


def _parse_value(text: str) -> Any:
    """Parse a text as a TOML value, or return it as a text without quotes."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return parse_number_or_name(text.strip())
