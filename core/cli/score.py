"""Commands ``mphdrr score VOLUME --truth FILE`` and ``mphdrr score VOLUME KIND …``: scores of a reconstructed volume."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from ... import core as mph
from ..arrays import Floats
from ..errors import naming
from ..figures.page import SUFFIXES, Page
from ..runs import FORMATS
from ..volumes.volume import UNITS
from .options import add_run, output_path, print_answer, progress_bar, refuse
from .phantom import Make, add_kinds, add_pose, read_pose


def add_parser(subparsers) -> None:  # type: ignore[no-untyped-def]
    """Add the command ``mphdrr score``, with the kinds of phantoms as subcommands."""
    score = add_run(subparsers, "score", _run)
    score.add_argument("volume", metavar="VOLUME", help="volume to score (formats: docs/volumes.md)")
    truth = "a simulated run, a phantom's .toml, or a volume; one on another grid is resampled onto VOLUME's voxels"
    score.add_argument("--truth", metavar="FILE", help=truth)
    add_pose(score)
    _add_options(score)
    score.set_defaults(make=None)
    kinds = score.add_subparsers(metavar="KIND", title="kinds of phantoms, instead of --truth", required=False)

    def finish(parser: argparse.ArgumentParser, make: Make, beats: bool) -> None:
        """Add the options of the score to the parser of a kind of phantom."""
        parser.argument_default = argparse.SUPPRESS  # options typed before the kind keep their values
        add_pose(parser, argparse.SUPPRESS)
        _add_options(parser)
        parser.set_defaults(run=_run, make=make)

    add_kinds(kinds, "score against", "mphdrr score volume.nii.gz {}", finish)


def _add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that hold for the truth from a file and for a kind of phantom."""
    add = parser.add_argument
    add("--quantity", choices=tuple(UNITS), help="quantity of the volumes' values; default: as their files say")
    add("--json", action="store_true", help="print JSON")
    add("--picture", metavar="FILE", help=f"also draw slices beside the truth, and profiles: {', '.join(SUFFIXES)}")


def _run(arguments: argparse.Namespace) -> None:
    """Score a reconstructed volume against the truth: the volume of a simulated run, a phantom, or a volume.

    mphdrr score volume.nii.gz --truth run.h5 --picture score.png
    mphdrr score volume.nii.gz derenzo --rods 8 6 5 4 3 2 --activity 100 --euler 0 90 0
    """
    picture = None if arguments.picture is None else output_path(arguments.picture, SUFFIXES)
    if arguments.make is None and arguments.truth is None:
        raise mph.InputError("score: expected --truth FILE or a kind of phantom, see mphdrr score --help")
    if arguments.make is not None and arguments.truth is not None:
        raise mph.InputError("score: expected either --truth or a kind of phantom, got both")
    truth, pose, run = _read_truth(arguments)
    volume = mph.read_volume(arguments.volume, arguments.quantity, progress=progress_bar("reading"))
    score = mph.score_volume(volume, truth, pose, progress_bar("truth"))
    if run is not None:
        from ..runs.reconstructing import inverse_crime_notes

        score = replace(score, notes=(*inverse_crime_notes(run, volume.grid), *score.notes))
    if picture is not None:
        from ..figures.scores import SIZE, draw

        page = Page(*SIZE)
        draw(page, score, Path(arguments.volume).name)
        page.write(picture)
    print_answer(arguments, score.record, score.lines, score.notes)


_Truth = tuple[mph.Volume | mph.Phantom, Floats | None, mph.ProjectionRun | None]


def _read_truth(arguments: argparse.Namespace) -> _Truth:
    """Return the truth, the pose (4, 4) of a phantom, and the run if it was the simulated one; None for what is absent."""
    if arguments.make is not None:
        return arguments.make(arguments), read_pose(arguments), None
    file = Path(arguments.truth)
    if file.suffix.lower() == ".toml":
        return mph.read_phantom(file), read_pose(arguments), None
    refuse(arguments, ("position", "euler"), "is for a kind of phantom or a .toml; a run or a volume knows its place")
    try:
        run = mph.read_run(file) if file.suffix.lower() in FORMATS else None
    except mph.InputError:  # a volume may have the same ending as a run
        if file.suffix.lower() == ".pt" or not file.is_file():
            raise
        run = None
    if run is not None:
        from ..runs.run_recipe import run_truth

        with naming(file):
            return *run_truth(run), run
    return mph.read_volume(file, arguments.quantity, progress=progress_bar("reading the truth")), None, None
