"""``mphdrr geometry export FILE -o OUT``."""

from __future__ import annotations

import argparse
import inspect
import typing
from pathlib import Path
from types import UnionType
from typing import Any

from ...errors import InputError
from ...exchange import FORMATS, Format, write_geometry
from ...geometry.grid import Grid
from ...volumes.volume_files import read_volume
from ..options import add_command, add_view_options, add_workbook, chosen_modules, output_path, read_workbook


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
    parser.add_argument(
        "-o", "--output", required=True, metavar="OUT", help="the file to write, or the new folder for several"
    )
    parser.add_argument(
        "--format", choices=FORMATS, metavar="NAME", help="one of those below; default: the only one of OUT's suffix"
    )
    parser.add_argument(
        "--set", action="append", default=[], metavar="NAME=VALUE", help="an option of the format; may be repeated"
    )
    add_view_options(parser)
    parser.epilog = (
        "formats, with what --set knows:\n" + "\n".join(map(_described, FORMATS.values())) + f"\n{parser.epilog}"
    )
    parser.set_defaults(run=_run)


def _described(format: Format) -> str:
    files = ", ".join(format.suffixes) or "folder"
    text = f"  {format.name:<13}{format.title} ({files})"
    typed = {name: kind for name, type in option_types(format).items() if (kind := _kind(type))}
    if not typed:
        return text
    options = (f"{name}={_written(format.options[name].default, kind)}" for name, kind in typed.items())
    return f"{text}\n{'':15}{'; '.join(options)}"


def _written(default: Any, kind: str) -> str:
    """An option's default as it is typed, or what is to be typed where it has none."""
    if default is None or default is inspect.Parameter.empty or "|" in kind:
        return kind
    return ",".join(f"{x:g}" for x in default) if isinstance(default, tuple) else f"{default}"


def _run(arguments: argparse.Namespace) -> None:
    format = FORMATS[arguments.format] if arguments.format else _format_of(arguments.output)
    options = dict(_setting(format, text) for text in arguments.set)
    path = output_path(arguments.output, format.suffixes) if format.suffixes else Path(arguments.output)
    system = chosen_modules(read_workbook(arguments), arguments.modules)
    views = system.views(tuple(arguments.size), arguments.detector, arguments.magnification, arguments.pitch)
    write_geometry(system, path, format.name, views=views, **options)
    print(f"{path}: {format.title}, {len(system)} module{'s' * (len(system) > 1)}")


def _format_of(output: str) -> Format:
    fitting = [f for f in FORMATS.values() if f.suffixes and output.lower().endswith(f.suffixes)]
    if len(fitting) != 1:
        fault = "several formats may be meant" if fitting else "no format has files of that name"
        names = ", ".join(f.name for f in fitting or FORMATS.values())
        raise InputError(f"{output}: {fault}; choose one by --format: {names}")
    return fitting[0]


def option_types(format: Format) -> dict[str, Any]:
    """The types of a format's options, by name."""
    hints = typing.get_type_hints(format.write)
    return {name: hints.get(name, str) for name in format.options}


def _setting(format: Format, text: str) -> tuple[str, Any]:
    name, equals, value = text.partition("=")
    types = option_types(format)
    if not equals or name not in types:
        raise InputError(f"--set {text!r}: expected NAME=VALUE, format {format.name} has {', '.join(types) or 'none'}")
    for kind in _alternatives(types[name]):
        try:
            return name, _value(value, kind)
        except ValueError as error:
            if isinstance(error, InputError):
                raise
    raise InputError(f"--set {text!r}: expected {name}={_kind(types[name])}")


def _alternatives(kind: Any) -> list[Any]:
    """What a type is made of, without None."""
    parts = typing.get_args(kind) if isinstance(kind, UnionType) or typing.get_origin(kind) is typing.Union else (kind,)
    return [part for part in parts if part is not type(None)]


def _value(text: str, kind: Any) -> Any:
    """`text` as a `kind`; ValueError if it is none."""
    if kind is Grid:
        return read_volume(text).grid
    if kind is bool:
        return ("no", "yes").index(text) == 1
    if typing.get_origin(kind) is typing.Literal:
        return typing.get_args(kind)[[str(choice) for choice in typing.get_args(kind)].index(text)]
    if typing.get_origin(kind) is tuple:
        return tuple(_value(part, typing.get_args(kind)[0]) for part in text.split(","))
    if kind in (int, float, str, Path):
        return kind(text)
    raise ValueError


def _kind(kind: Any) -> str:
    """How a value of `kind` is typed; nothing if it cannot be."""
    names = {bool: "yes|no", int: "N", float: "NUMBER", str: "TEXT", Path: "FILE", Grid: "VOLUME-FILE"}
    words = []
    for part in _alternatives(kind):
        if typing.get_origin(part) is typing.Literal:
            words += [str(choice) for choice in typing.get_args(part)]
        elif typing.get_origin(part) is tuple:
            words.append(",".join([_kind(typing.get_args(part)[0])] * 2))
        elif part in names:
            words.append(names[part])
    return "|".join(words)
