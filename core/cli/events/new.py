"""Action ``mphdrr events new --like derenzo``: a recipe to start from."""

import argparse
from pathlib import Path

from ...errors import InputError
from ...events.templates import TEMPLATES, template_text
from ...example import EXAMPLE
from ...files import relative_path, write_bytes
from ..options import add_run, new_recipe_path, print_answer


def add_parser(actions) -> None:  # type: ignore[no-untyped-def]
    """Add the action ``events new``."""
    parser = add_run(actions, "new", _run)
    add = parser.add_argument
    add("--like", choices=tuple(TEMPLATES), default="derenzo", metavar="NAME", help="see the list below")
    add("--system", metavar="FILE", help="the scanner's geometry workbook; default: the example")
    add("-o", "--output", metavar="FILE", help="a new file (.toml); default: standard output")
    add("--json", action="store_true", help="print the recipe and its file as JSON")
    names = "\n".join(f"  {name:<13}{text}" for name, text in TEMPLATES.items())
    parser.epilog = f"recipes:\n{names}\n{parser.epilog}"


def _run(arguments: argparse.Namespace) -> None:
    """Write a commented recipe to start from.

    mphdrr events new --like derenzo --system scanner.xlsx -o derenzo.toml
    """
    workbook = Path(EXAMPLE if arguments.system is None else arguments.system)
    if not workbook.is_file():
        raise InputError(f"--system {workbook}: no such file; expected a geometry workbook (.xlsx, .xlsm)")
    if arguments.output is None:
        text = template_text(arguments.like, workbook.absolute())
        print_answer(arguments, {"file": None, "recipe": text}, [text.removesuffix("\n")])
        return
    path = new_recipe_path(arguments.output)
    text = template_text(arguments.like, EXAMPLE if workbook == EXAMPLE else relative_path(workbook, path.parent))
    write_bytes(path, text.encode())
    advice = f"{path}: edit it, then: mphdrr events make SET --recipe {path} -n 1000"
    print_answer(arguments, {"file": str(path), "recipe": text}, [advice])
