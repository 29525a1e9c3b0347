"""Configuration of Sphinx, which makes the site from the pages of this folder: `make docs`."""

import argparse
import ast
import operator
import os
import re
from pathlib import Path
from typing import Any

from docutils import nodes
from docutils.statemachine import StringList
from sphinx.application import Sphinx
from sphinx.util import logging
from sphinx.util.docutils import SphinxDirective

import mphdrr.core as mph
from mphdrr.addon.cli import COMMANDS
from mphdrr.core.cli import build_parser
from mphdrr.core.version import VERSION

project, author = "mphDRR", "The mphDRR authors"
release = VERSION
copyright = f"2026 {author}"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
html_theme = "furo"
html_title = f"{project} {release}"
html_show_sphinx = False
myst_heading_anchors = 3
myst_enable_extensions = ["colon_fence"]

# A word in single backticks is a name of this package where there is one, else plain code.
default_role = "py:obj"
add_module_names = False
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
napoleon_use_ivar = True  # attributes are described once, in the class
autodoc_default_options = {"members": True, "member-order": "bysource"}
toc_object_entries = False
html_copy_source = False

# numpy's aliases, which Python spells out, as they are written.
_PATH = r"[~\w.]*"
_ALIASES = {
    rf"{_PATH}_SupportsArray\[[^|]*\| {_PATH}_NestedSequence\[[^|]*\|[^\[]*_NestedSequence\[[^]]*\]": "ArrayLike",
    rf"{_PATH}ndarray\[[^\[]*?, {_PATH}dtype\[{_PATH}?(\w+)\]\]": r"NDArray[\1]",
}
_PUBLIC = Path(mph.__file__)


def public_names() -> dict[str, list[str]]:
    """Return the names of `mphdrr.core`, by the room (or file) of core that they come from, in the order of its imports.

    Names of a room with names of its own, ``mph.events``, begin with the room's name.
    """
    rooms: dict[str, list[str]] = {}
    body = ast.parse(_PUBLIC.read_text(encoding="utf-8")).body
    (block,) = (each for each in body if isinstance(each, ast.If))
    for line in block.body:
        if isinstance(line, ast.ImportFrom) and line.module:
            names = [alias.name for alias in line.names if alias.name in mph.__all__]
            rooms.setdefault(line.module.split(".")[0], []).extend(names)
        elif isinstance(line, ast.ImportFrom):
            for alias in line.names:
                own = getattr(getattr(mph, alias.name), "__all__", ())
                rooms |= {alias.name: [f"{alias.name}.{name}" for name in own]} if own else {}
    return rooms


class PublicNames(SphinxDirective):
    """``.. public-names:: ROOM ...``: the reference of the public names of these rooms."""

    required_arguments, final_argument_whitespace = 1, True

    def run(self) -> list[nodes.Node]:
        """Have autodoc describe each name."""
        seen = self.env.domaindata.setdefault("mphdrr", {"rooms": set()})["rooms"]
        lines = []
        for room in self.arguments[0].split():
            seen.add(room)
            for name in public_names()[room]:
                value = operator.attrgetter(name)(mph)
                if isinstance(value, dict):  # a table of what has names
                    lines += [f".. py:data:: mphdrr.core.{name}", "", f"   By name: {', '.join(value)}.", ""]
                elif isinstance(value, type) or callable(value):
                    kind = "class" if isinstance(value, type) else "function"
                    lines += [f".. auto{kind}:: mphdrr.core.{name}", ""]
        box = nodes.container()
        self.state.nested_parse(StringList(lines, source=str(_PUBLIC)), self.content_offset, box)
        return box.children


class Commands(SphinxDirective):
    """``{commands}``: the help of every command, as the program prints it."""

    def run(self) -> list[nodes.Node]:
        """Return the sections of all commands, from their parsers."""
        os.environ["COLUMNS"] = "88"
        return _sections(build_parser(COMMANDS))


def _sections(parser: Any) -> list[nodes.Node]:
    section = nodes.section("", nodes.title("", parser.prog), ids=[nodes.make_id(parser.prog)])
    section += nodes.literal_block(parser.format_help(), parser.format_help(), language="text")
    found: list[nodes.Node] = [section]
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for command in dict.fromkeys(action.choices.values()):
                found += _sections(command)
    return found


def _complete(app: Sphinx, _: Exception | None) -> None:
    seen = app.env.domaindata.get("mphdrr", {"rooms": set()})["rooms"]
    for room in sorted(set(public_names()) - seen):
        logging.getLogger(__name__).warning("docs/api.md: the public names of core.%s are not there", room)


def _shorter(
    app: Sphinx, what: str, name: str, value: Any, options: Any, arguments: str | None, result: str | None
) -> tuple[str | None, str | None]:
    for spelled, alias in _ALIASES.items():
        arguments, result = (text and re.sub(spelled, alias, text) for text in (arguments, result))
    return arguments, result


def setup(app: Sphinx) -> None:
    """Register this file's directives and handlers."""
    app.add_directive("public-names", PublicNames)
    app.add_directive("commands", Commands)
    app.connect("autodoc-process-signature", _shorter)
    app.connect("build-finished", _complete)
