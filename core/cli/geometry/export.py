"""``mphdrr geometry export FILE -o OUT``."""

from __future__ import annotations

import argparse
import typing
from pathlib import Path
from types import UnionType
from typing import Any, Literal

from ...errors import InputError
from ...exchange import FORMATS, Format, write_geometry
from ...geometry.grid import Grid
from ...volumes.volume_files import read_volume
from ..options import add_command, add_view_options, add_workbook, chosen_modules, output_path, read_workbook

_WORDS = {bool: "yes|no", int: "N", float: "NUMBER", str: "TEXT", Grid: "VOLUME-FILE"}
"""How a value of each type is shown in the help."""


def add_parser(actions) -> None:  # type: ignore[no-untyped-def]
    """Add the action."""
    parser = add_command(
        actions,
        "export",
        "write the geometry for another program",
        "mphdrr geometry export scanner.xlsx -o scanner.xml --size 128 128 --detector real\n"
        "example: mphdrr geometry export scanner.xlsx -o cameras.npz --format pytorch3d --set in_ndc=no",
    )
    add_workbook(parser)
    parser.add_argument("-o", "--output", required=True, metavar="OUT", help="file, or new folder, to write")
    parser.add_argument(
        "--format", choices=FORMATS, metavar="NAME", help="see the list below; default: the only one with OUT's ending"
    )
    parser.add_argument(
        "--set", action="append", default=[], metavar="NAME=VALUE", help="an option of the format; may be repeated"
    )
    add_view_options(parser, computing=False)
    described = "\n".join(map(_described, FORMATS.values()))
    parser.epilog = f"formats, with their options for --set:\n{described}\n{parser.epilog}"
    parser.set_defaults(run=_run)


def _run(arguments: argparse.Namespace) -> None:
    format = FORMATS[arguments.format] if arguments.format else _format_of(arguments.output)
    options = dict(_option(format, text) for text in arguments.set)
    path = output_path(arguments.output, format.suffixes) if format.suffixes else Path(arguments.output)
    system = chosen_modules(read_workbook(arguments), arguments.modules)
    views = system.views(tuple(arguments.size), arguments.detector, arguments.magnification, arguments.pitch)
    write_geometry(system, path, format.name, views=views, **options)
    print(f"{path}: {format.title}, {len(system)} module{'s' * (len(system) > 1)}")


def _format_of(output: str) -> Format:
    """The only format with the file's ending."""
    fitting = [f for f in FORMATS.values() if f.suffixes and output.lower().endswith(f.suffixes)]
    if len(fitting) == 1:
        return fitting[0]
    problem = "several formats have this ending" if fitting else "no format has this ending"
    names = ", ".join(f.name for f in fitting or FORMATS.values())
    raise InputError(f"{output}: {problem}; choose one by --format: {names}")


def _described(format: Format) -> str:
    """The format and its options, for the help."""
    options = []
    for name, (type_, default) in format.options.items():
        word = _word(type_)
        shown = word if default is None or "|" in word else _typed(default)
        options += [f"{name}={shown}"] * bool(word)
    text = f"  {format.name:<13}{format.title} ({', '.join(format.suffixes) or 'folder'})"
    return text + f"\n{'':15}{'; '.join(options)}" * bool(options)


def _typed(default: Any) -> str:
    return ",".join(f"{x:g}" for x in default) if isinstance(default, tuple) else str(default)


def _option(format: Format, text: str) -> tuple[str, Any]:
    """Name and value of a ``NAME=VALUE``."""
    name, equals, value = text.partition("=")
    options = format.options
    if not equals or name not in options:
        raise InputError(
            f"--set {text!r}: expected NAME=VALUE, format {format.name} has {', '.join(options) or 'none'}"
        )
    for type_ in _alternatives(options[name][0]):
        try:
            return name, _parsed(value, type_)
        except ValueError as error:
            if isinstance(error, InputError):
                raise
    raise InputError(f"--set {text!r}: expected {name}={_word(options[name][0])}")


def _alternatives(type_: Any) -> list[Any]:
    """The members of a union, without None."""
    members = typing.get_args(type_) if typing.get_origin(type_) in (UnionType, typing.Union) else (type_,)
    return [member for member in members if member is not type(None)]


def _parsed(text: str, type_: Any) -> Any:
    """`text` as a value of the type; ValueError if it is not one."""
    if type_ is Grid:
        return read_volume(text).grid
    if type_ is bool:
        return ("no", "yes").index(text) == 1
    if typing.get_origin(type_) is Literal:
        return typing.get_args(type_)[typing.get_args(type_).index(text)]
    if typing.get_origin(type_) is tuple:
        return tuple(_parsed(part, typing.get_args(type_)[0]) for part in text.split(","))
    if type_ in (int, float, str):
        return type_(text)
    raise ValueError(text)


def _word(type_: Any) -> str:
    """How a value of the type is typed; empty if it cannot be."""
    words: list[str] = []
    for member in _alternatives(type_):
        if typing.get_origin(member) is Literal:
            words += typing.get_args(member)
        elif typing.get_origin(member) is tuple:
            words.append(",".join([_word(typing.get_args(member)[0])] * 2))
        elif member in _WORDS:
            words.append(_WORDS[member])
    return "|".join(words)
