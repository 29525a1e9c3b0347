"""Read and write TOML, with errors of one line."""

import json
import tomllib
from collections.abc import Iterable
from typing import Any

from ..errors import InputError
from ..files import AnyPath, read_text


def read_toml(path: AnyPath) -> dict[str, Any]:
    """Return the tables and entries of a TOML file; raise `InputError`, which names the file, if it is not TOML."""
    return parse_toml(toml_text(path), str(path))


def toml_text(path: AnyPath) -> str:
    """Return the text of a TOML file, with the line ends that it has."""
    return read_text(path, "TOML, a text in UTF-8")


def parse_toml(text: str, name: str) -> dict[str, Any]:
    """Return the tables and entries of a TOML text; messages of `InputError` begin with `name`."""
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{name}: not TOML: {error}") from None
    except RecursionError:
        raise InputError(f"{name}: its lists are nested too deeply") from None


def toml_value(value: Any) -> str:
    """Return a text, a boolean, a number, or a list of these, as TOML."""
    if isinstance(value, str):
        # JSON's escapes are those of TOML, except that TOML also wants DEL escaped.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, Iterable):
        return f"[{', '.join(map(toml_value, value))}]"
    return repr(value)
