"""``mphdrr export RUN -o FILE``."""

import argparse

from ..errors import InputError
from ..runs.files import FORMATS, read_run, write_run
from ..runs.mosaic import write_sheet
from .options import add_command, output_path


def add_parser(subparsers) -> None:  # type: ignore[no-untyped-def]
    """Add the command."""
    parser = add_command(
        subparsers, "export", "write a projection run in another format", "mphdrr export run.h5 -o run.pt -o run.npz"
    )
    parser.add_argument("file", metavar="RUN", help=f"a run written by mphDRR: {', '.join(FORMATS)}")
    parser.add_argument(
        "-o", "--output", action="append", default=[], metavar="FILE", help=f"{', '.join(FORMATS)}; may be repeated"
    )
    parser.add_argument("--mosaic", metavar="PNG", help="all images in one picture")
    parser.set_defaults(run=_run)


def _run(arguments: argparse.Namespace) -> None:
    if not arguments.output and not arguments.mosaic:
        raise InputError("nothing to write: give --output FILE or --mosaic PNG")
    run = read_run(arguments.file)
    paths = [output_path(name, FORMATS) for name in arguments.output]
    picture = output_path(arguments.mosaic) if arguments.mosaic else None
    for path in paths:
        write_run(run, path)
        print(path)
    if picture is not None:
        write_sheet(run, picture)
        print(picture)
