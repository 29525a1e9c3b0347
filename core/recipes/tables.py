"""Tables of a recipe's TOML file: read into values by key, with checks that name the entry."""

from collections.abc import Collection, Mapping
from contextlib import suppress
from typing import Any

from ..errors import InputError
from .settings import Setting, table_names


def check_entries(values: Mapping[str, Any], version: int, names: Collection[str]) -> None:
    """Raise `InputError` unless a recipe is of this `version` of its language and has only entries and tables of `names`."""
    if "version" not in values:
        raise InputError(f"version: missing; this mphDRR reads version = {version}")
    if values["version"] != version or isinstance(values["version"], bool):
        raise InputError(f"version: expected {version}, got {values['version']!r}; a newer mphDRR may read it")
    for key in values:
        if key not in names:
            raise InputError(f"{key}: no such entry; expected {', '.join(names)}")


def read_table(values: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Return a table of a recipe, an empty one if it is missing; raise `InputError` if the entry is not a table."""
    table = values.get(name, {})
    if not isinstance(table, dict):
        raise InputError(f"{name}: expected a table [{name}]")
    return table


def table_entries(values: Mapping[str, Any], rows: Mapping[str, Setting]) -> dict[str, Any]:
    """Return the entries of all tables that `rows` has settings of, by keys such as "grid.voxels"."""
    names = table_names(rows)
    return flat_entries({name: read_table(values, name) for name in names}, rows, *names)


def flat_entries(values: Mapping[str, Any], rows: Mapping[str, Setting], *tables: str) -> dict[str, Any]:
    """Return the entries of a recipe by the keys of their `rows`: "table.name" for those of `tables`, else "name"."""
    entries = {key: value for key, value in values.items() if key not in tables}
    for name in tables:
        entries |= {f"{name}.{key}": value for key, value in read_table(values, name).items()}
    return {key: _converted(value, rows[key]) if key in rows else value for key, value in entries.items()}


def _converted(value: Any, row: Setting) -> Any:
    """Return a value in the type of its setting, where earlier versions took true for 1.0, "60" for 60.0, and 8.0 for 8."""
    if isinstance(value, list):
        return [_converted(item, row) for item in value]
    if isinstance(value, dict):
        return {key: _converted(item, row) if key == "one_of" else item for key, item in value.items()}
    is_number = isinstance(value, str) and row.words and value not in row.words
    if row.kind is float and (is_number or isinstance(value, bool)):
        with suppress(ValueError):
            return float(value)
    return int(value) if row.kind is int and isinstance(value, float) and value.is_integer() else value


def require_value(value: Any, key: str, advice: str) -> Any:
    """Return the value of an entry without a default; raise `InputError` with `advice` if it is None."""
    if value is None:
        raise InputError(f"{key}: missing; {advice}")
    return value


def require_name(name: Any, place: str) -> str:
    """Return a name that can also be that of a file: letters, digits, - and _; raise `InputError` for any other."""
    if not isinstance(name, str) or not name.replace("-", "").replace("_", "").isalnum():
        raise InputError(f"{place}: expected a name of letters, digits, - and _, got {name!r}")
    return name
