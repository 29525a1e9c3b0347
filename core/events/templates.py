"""Recipe templates: commented recipes that users copy and change."""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

from ..example import EXAMPLE
from ..files import AnyPath
from ..recipes.toml import toml_value
from ..validation import one_of

_FOLDER = Path(__file__).with_name("templates")

TEMPLATES: Mapping[str, str] = MappingProxyType({
    "derenzo": "Derenzo phantoms turned at random: counts or line integrals, Radon images; explains draws",
    "cardiac": "a beating torso with and without perfusion defects: counts with attenuation",
    "mixed": "phantoms of several kinds in any position, one for the test alone; small images",
    "files": "your own volumes, each placed and turned a little differently, with their attenuation",
})  # fmt: skip
"""Descriptions of the templates, by name."""


def template_text(name: str, workbook: AnyPath = EXAMPLE) -> str:
    """Return the text of a template (TOML) with the path of a workbook, relative to the recipe's folder or absolute.

    `InputError` where there is no template of this name.

    >>> Path("derenzo.toml").write_text(template_text("derenzo", "scanner.xlsx"))
    """
    one_of(name, TEMPLATES, "recipe to begin with")
    return with_workbook((_FOLDER / f"{name}.toml").read_text(encoding="utf-8"), workbook)


def with_workbook(text: str, workbook: AnyPath) -> str:
    """Return a recipe's text with the path of a workbook in place of the example's."""
    path = str(workbook) if isinstance(workbook, str) else Path(workbook).as_posix()
    return text.replace(toml_value(EXAMPLE.name), toml_value(path), 1)
