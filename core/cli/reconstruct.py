"""``mphdrr reconstruct RUN -o volume.nii.gz``: from a run's images back to a volume."""

from __future__ import annotations

import argparse
import signal
import sys
import time
from collections.abc import Sequence
from typing import Any

from ... import core as mph
from ..figures.page import DARK, SUFFIXES, Page
from ..reconstruction.methods import Method, method_of
from ..reconstruction.result import iterations_text
from ..runs import FORMATS
from ..runs.settings import HOW_TABLES, SETTINGS
from ..volumes.volume_files import VOLUME_FORMATS
from .options import add_run, output_path, progress_bar, say
from .recipe_options import add_entries, add_setting, typed_entries

_OTHERS = ("attenuation.file", "attenuation.energy", "compute.backend", "compute.threads")
"""Settings that are options beside those of the reconstruction."""


def add_parser(subparsers) -> None:  # type: ignore[no-untyped-def]
    """Add the command."""
    parser = add_run(subparsers, "reconstruct", _run)
    parser.add_argument("file", metavar="RUN", help=f"a run of mphDRR: {', '.join(FORMATS)}")
    text = f"recipe (.toml) whose tables {', '.join(f'[{table}]' for table in HOW_TABLES)} say how; options override it"
    parser.add_argument("--recipe", metavar="FILE", help=text)
    for setting in SETTINGS.values():
        if setting.key.startswith("reconstruction.") or setting.key in _OTHERS:
            add_setting(parser, setting)
    add_entries(parser, "model.intrinsic_fwhm=3")
    text = "begin with this volume, on the same voxels, instead of the same value everywhere"
    start = parser.add_mutually_exclusive_group()
    start.add_argument("--start", metavar="FILE", help=text)
    text = "go on where the reconstruction in this file ended: the iterations are done in addition"
    start.add_argument("--resume", metavar="H5", help=text)
    text = "keep all that is needed to resume; where Ctrl-C ends the reconstruction, too"
    parser.add_argument("--save-state", metavar="H5", help=text)
    parser.add_argument("-o", "--output", metavar="FILE", help=f"the volume: {', '.join(VOLUME_FORMATS)}")
    text = f"also draw slices and the objective ({', '.join(SUFFIXES)}), of a simulated run beside the truth"
    parser.add_argument("--picture", metavar="FILE", help=text)
    parser.add_argument("--quiet", action="store_true", help="no line for each iteration on standard error")
    text = "write the recipe (.toml) of these options instead of reconstructing"
    parser.add_argument("--write-recipe", metavar="FILE", help=text)


def _chosen(arguments: argparse.Namespace, run: mph.ProjectionRun) -> mph.Recipe:
    from ..runs.reconstructing import reconstruction_recipe

    asked = mph.Recipe() if arguments.recipe is None else mph.read_recipe(arguments.recipe)
    changes = typed_entries(arguments)
    for key in changes:
        if key.partition(".")[0] not in HOW_TABLES:
            raise mph.InputError(f"--set {key}: expected an entry of {', '.join(f'[{table}]' for table in HOW_TABLES)}")
    recipe = reconstruction_recipe(run, asked if "recipe" in run.settings else asked.updated(changes))
    if changes.get("attenuation.file") is not None:  # instead of what attenuated in the run
        changes = {"attenuation.of_phantom": None, "attenuation.object": None} | changes
    return recipe.updated(changes)


def _run(arguments: argparse.Namespace) -> None:
    """Reconstruct the volume that a run's images are of.

    mphdrr reconstruct run.h5 --iterations 20 --subsets 16 --voxels 64 --spacing 1.6 -o volume.nii.gz --picture slices.png
    mphdrr reconstruct run.h5 --recipe study.toml -o volume.nii.gz
    mphdrr reconstruct run.h5 --set model.intrinsic_fwhm=3 -o volume.nii.gz
    """
    from ..figures.reconstructions import SIZE, SIZE_BESIDE_TRUTH, draw
    from ..runs.reconstructing import voxels_text

    if arguments.write_recipe:
        recipe_path = output_path(arguments.write_recipe, (".toml",))
        mph.write_recipe(_chosen(arguments, mph.read_run(arguments.file)), recipe_path)
        print(recipe_path)
        return
    if not arguments.output and not arguments.picture:
        raise mph.InputError("nothing to write: give --output FILE, --picture FILE or --write-recipe FILE")
    path = output_path(arguments.output, VOLUME_FORMATS) if arguments.output else None
    picture = output_path(arguments.picture, SUFFIXES) if arguments.picture else None
    state = output_path(arguments.save_state, (".h5", ".hdf5")) if arguments.save_state else None
    run = mph.read_run(arguments.file)
    recipe = _chosen(arguments, run)
    start: mph.Volume | mph.Reconstruction | None = None
    if arguments.start is not None:
        start = mph.read_volume(arguments.start, "activity" if run.volume is None else run.volume.quantity)
    elif arguments.resume is not None:
        start = mph.read_reconstruction(arguments.resume)
    method = method_of(recipe["reconstruction.method"])
    log = _Log(method, recipe["reconstruction.iterations"], arguments.quiet, start)
    usual = signal.signal(signal.SIGINT, log.interrupt) if state is not None else None
    try:
        found = mph.reconstruct_run(run, recipe, start=start, watch=log, stages=log.stage, method=method)
    except mph.Cancelled as cancelled:
        if state is not None and cancelled.reconstruction is not None:
            mph.write_reconstruction(cancelled.reconstruction, state)
            done = cancelled.reconstruction.iterations
            say(f"{state}: iterations done: {done}; --resume goes on")
        raise
    finally:
        if usual is not None:
            signal.signal(signal.SIGINT, usual)
    if state is not None:
        mph.write_reconstruction(found, state)
    if path is not None:
        mph.write_volume(found.volume, path)
    if picture is not None:
        page = Page(*(SIZE if run.volume is None else SIZE_BESIDE_TRUTH), DARK)
        draw(page, found.volume, found.objective.tolist(), run.volume, f"{method.label} of {arguments.file}",
             [settings_line(found), *found.settings["flatters"]], method.objective)  # fmt: skip
        page.write(picture)
    voxels = voxels_text(found.volume.grid)
    largest = f"largest {float(found.volume.array.max()):.4g} {found.volume.unit}"
    print(f"{path or picture}: {', '.join(filter(None, (method.label, settings_line(found), voxels, largest)))}")


def settings_line(found: mph.Reconstruction) -> str:
    """The numbers of iterations and subsets that a picture shows of a reconstruction, where it has any."""
    subsets = found.settings.get("subsets", 1)
    return ", ".join(filter(None, (iterations_text(found.iterations), f"{subsets} subsets" if subsets > 1 else "")))


class _Log:
    """A line on standard error after each iteration; before the first, the stages' bars."""

    def __init__(self, method: Method, iterations: int | None, quiet: bool, start: Any) -> None:
        goes_on = isinstance(start, mph.Reconstruction) and start.settings.get("method") == method.label
        iterations = iterations or method.own.get("iterations", 0)
        self.total, self.quiet = (start.iterations if goes_on else 0) + iterations, quiet
        self.name = method.objective
        self.begun, self.interrupted = time.monotonic(), False

    def stage(self, words: str) -> mph.Progress | None:
        if words != "reconstructing":
            return progress_bar(words)
        self.begun = time.monotonic()
        return self._check

    def interrupt(self, *_: Any) -> None:
        """Ctrl-C was typed: stop after the update that is being made."""
        self.interrupted = True

    def _check(self, done: int, total: int) -> None:
        if self.interrupted:
            raise mph.Cancelled

    def __call__(self, iteration: int, values: Any, objective: Sequence[float]) -> None:
        if not self.quiet:
            seconds = time.monotonic() - self.begun
            line = f"{self.name} {objective[-1]:.8g}, largest {float(values.max()):.4g}, {seconds:.1f} s"
            print(f"iteration {iteration} of {self.total}: {line}", file=sys.stderr, flush=True)
