"""TOML files: reading with one-line errors, and writing values."""

import json
import tomllib
from collections.abc import Iterable
from typing import Any

from .errors import InputError
from .files import AnyPath, read_text


def read_toml(path: AnyPath) -> dict[str, Any]:
    """What a TOML file holds."""
    return parse_toml(toml_text(path), str(path))


def toml_text(path: AnyPath) -> str:
    """The text of a TOML file, every line's end as it is."""
    return read_text(path, "TOML, a text in UTF-8")


def parse_toml(text: str, name: str) -> dict[str, Any]:
    """What a text in TOML holds; messages call it `name`."""
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{name}: not TOML: {error}") from None
    except RecursionError:
        raise InputError(f"{name}: its lists are nested too deeply") from None


def toml_value(value: Any) -> str:
    """A text, a boolean, a number or a list of these as TOML."""
    if isinstance(value, str):
        # JSON's escapes are TOML's, except that DEL must be escaped as well.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, Iterable):
        return f"[{', '.join(map(toml_value, value))}]"
    return repr(value)
