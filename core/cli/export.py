"""Command ``mphdrr export RUN -o FILE``: a run in another format."""

import argparse

from ... import core as mph
from ..runs import EXPORT_FORMATS, FORMATS
from ..runs.mosaic import write_sheet
from .options import add_photons, add_run, output_path


def add_parser(subparsers) -> None:  # type: ignore[no-untyped-def]
    """Add the command ``mphdrr export``."""
    parser, formats = add_run(subparsers, "export", _run), ", ".join(FORMATS)
    add = parser.add_argument
    add("file", metavar="RUN", help=f"a run written by mphDRR: {formats}")
    output = f"{formats}, or the counts alone as .dcm; may be repeated"
    add("-o", "--output", action="append", default=[], metavar="FILE", help=output)
    add("--mosaic", metavar="PNG", help="all images in one picture")
    add_photons(parser)


def _run(arguments: argparse.Namespace) -> None:
    """Write a projection run in another format.

    mphdrr export run.h5 -o run.pt -o run.npz
    """
    if not arguments.output and not arguments.mosaic:
        raise mph.InputError("nothing to write: give --output FILE or --mosaic PNG")
    run = mph.read_run(arguments.file).of_photons(arguments.photons)
    paths = [output_path(name, EXPORT_FORMATS) for name in arguments.output]
    picture = output_path(arguments.mosaic) if arguments.mosaic else None
    for path in paths:
        mph.write_run(run, path)
        print(path)
    if picture is not None:
        write_sheet(run, picture)
        print(picture)
