"""Action ``mphdrr geometry export FILE -o OUT``: the geometry in the formats of other programs."""

import argparse
import typing
from pathlib import Path
from types import UnionType
from typing import Any, Literal

from .... import core as mph
from ...errors import expecting
from ...exchange import FORMATS, Format
from ..options import add_run, output_path
from ..scanners import add_workbook, chosen_modules, read_any_scanner
from .arguments import add_views, chosen_views

_WORDS = {bool: "yes|no", int: "N", float: "NUMBER", str: "TEXT", tuple: "NUMBER,NUMBER,...", mph.Grid: "VOLUME-FILE"}
"""Type of an option's value -> placeholder in the help; options of other types are for scripts."""


def add_parser(actions) -> None:  # type: ignore[no-untyped-def]
    """Add the action ``geometry export``."""
    parser = add_run(actions, "export", _run)
    add_workbook(parser)
    add = parser.add_argument
    add("-o", "--output", required=True, metavar="OUT", help="file, or new folder, to write")
    add("--format", choices=FORMATS, metavar="NAME", help="see the list below; default: the only one with OUT's ending")
    add("--set", action="append", default=[], metavar="NAME=VALUE", help="an option of the format; may be repeated")
    add_views(parser, "pixels")
    add("--modules", metavar="RANGE", help="such as 1-40 or 1-20,41; default: all")
    formats = "\n".join(map(_format_help, FORMATS.values()))
    parser.epilog = f"formats, with their options for --set:\n{formats}\n{parser.epilog}"


def _run(arguments: argparse.Namespace) -> None:
    """Write the geometry for another program.

    mphdrr geometry export scanner.xlsx -o scanner.xml --size 128 128 --detector real
    mphdrr geometry export scanner.xlsx -o cameras.npz --format pytorch3d --set in_ndc=no
    """
    format = FORMATS[arguments.format] if arguments.format else _find_format(arguments.output)
    options = dict(_parse_option(format, text) for text in arguments.set)
    path = output_path(arguments.output, format.suffixes) if format.suffixes else Path(arguments.output)
    system = chosen_modules(read_any_scanner(arguments), arguments.modules)
    mph.write_geometry(system, path, format.name, views=chosen_views(system, arguments), **options)
    print(f"{path}: {format.title}, {len(system)} module{'s' * (len(system) > 1)}")


def _find_format(output: str) -> Format:
    """Return the only format with the file's ending; raise `InputError` if there is none or several."""
    candidates = [f for f in FORMATS.values() if f.suffixes and output.lower().endswith(f.suffixes)]
    if len(candidates) == 1:
        return candidates[0]
    problem = "several formats have this ending" if candidates else "no format has this ending"
    names = ", ".join(f.name for f in candidates or FORMATS.values())
    raise mph.InputError(f"{output}: {problem}; choose one by --format: {names}")


def _typed_options(format: Format) -> dict[str, tuple[Any, Any]]:
    """Return name -> (type, default) of the options that can be typed; of a union of types, the first counts."""
    options = {}
    for name, (type_, default) in format.options.items():
        if typing.get_origin(type_) in (UnionType, typing.Union):
            type_ = typing.get_args(type_)[0]
        if _type_word(type_):
            options[name] = type_, default
    return options


def _type_word(type_: Any) -> str:
    """Return how a value of a type is shown in the help, "" for a type that cannot be typed."""
    if typing.get_origin(type_) is Literal:
        return "|".join(typing.get_args(type_))
    return _WORDS.get(typing.get_origin(type_) or type_, "")


def _format_help(format: Format) -> str:
    """Return the lines of the help about a format and its options."""
    option_texts = []
    for name, (type_, default) in _typed_options(format).items():
        word = _type_word(type_)
        if default is not None and "|" not in word:
            word = ",".join(f"{x:g}" for x in default) if isinstance(default, tuple) else str(default)
        option_texts.append(f"{name}={word}")
    text = f"  {format.name:<13}{format.title} ({', '.join(format.suffixes) or 'folder'})"
    return text + f"\n{'':15}{'; '.join(option_texts)}" * bool(option_texts)


def _parse_option(format: Format, text: str) -> tuple[str, Any]:
    """Return name and value of an option of the format from a text ``NAME=VALUE``."""
    name, equals, value = text.partition("=")
    options = _typed_options(format)
    if not equals or name not in options:
        names = ", ".join(options) or "none"
        raise mph.InputError(f"--set {text!r}: expected NAME=VALUE, format {format.name} has {names}")
    type_, _ = options[name]
    if type_ is mph.Grid:
        return name, mph.read_volume(value).grid
    with expecting(f"--set {text!r}: expected {name}={_type_word(type_)}", KeyError, ValueError):
        if type_ is bool:
            return name, {"yes": True, "no": False}[value]
        if typing.get_origin(type_) is tuple:
            return name, tuple(float(part) for part in value.split(","))
        return name, value if typing.get_origin(type_) is Literal else type_(value)  # the format checks its choices
