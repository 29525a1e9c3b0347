"""Command ``mphdrr reconstruct RUN -o volume.nii.gz``: reconstruction of a volume from a run's images."""

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
from .recipe_options import add_entries, add_setting, entries_from_options

_FURTHER_SETTINGS = ("attenuation.file", "attenuation.energy", "compute.backend", "compute.threads")
"""Settings that are options although they are not in the recipe's table [reconstruction]."""


def add_parser(subparsers) -> None:  # type: ignore[no-untyped-def]
    """Add the command ``mphdrr reconstruct``."""
    parser = add_run(subparsers, "reconstruct", _run)
    parser.add_argument("file", metavar="RUN", help=f"a run of mphDRR: {', '.join(FORMATS)}")
    text = f"recipe (.toml) of which the tables {', '.join(f'[{t}]' for t in HOW_TABLES)} are used; options override it"
    parser.add_argument("--recipe", metavar="FILE", help=text)
    for setting in SETTINGS.values():
        if setting.key.startswith("reconstruction.") or setting.key in _FURTHER_SETTINGS:
            add_setting(parser, setting)
    add_entries(parser, "model.intrinsic_fwhm=3")
    start = parser.add_mutually_exclusive_group()
    start.add_argument("--start", metavar="FILE", help="initial volume, on the same voxels; default: a constant value")
    start.add_argument("--resume", metavar="H5", help="continue the reconstruction in this file by further iterations")
    parser.add_argument("--save-state", metavar="H5", help="write the state for --resume, also after Ctrl-C")
    parser.add_argument("-o", "--output", metavar="FILE", help=f"the volume: {', '.join(VOLUME_FORMATS)}")
    text = f"also draw slices and the objective ({', '.join(SUFFIXES)}), for a simulated run beside the truth"
    parser.add_argument("--picture", metavar="FILE", help=text)
    parser.add_argument("--quiet", action="store_true", help="no bars and no lines of iterations on standard error")
    text = "write the recipe (.toml) of these options instead of reconstructing"
    parser.add_argument("--write-recipe", metavar="FILE", help=text)


def _recipe_from_options(arguments: argparse.Namespace, run: mph.ProjectionRun) -> mph.Recipe:
    """Return the recipe of the reconstruction: that of the run, changed by the recipe file and by the options."""
    from ..runs.reconstructing import reconstruction_recipe

    file_recipe = mph.Recipe() if arguments.recipe is None else mph.read_recipe(arguments.recipe)
    changes = entries_from_options(arguments)
    for key in changes:
        if key.partition(".")[0] not in HOW_TABLES:
            raise mph.InputError(f"--set {key}: expected an entry of {', '.join(f'[{table}]' for table in HOW_TABLES)}")
    recipe = reconstruction_recipe(run, file_recipe if "recipe" in run.settings else file_recipe.updated(changes))
    if changes.get("attenuation.file") is not None:  # it replaces what attenuated in the run
        changes = {"attenuation.of_phantom": None, "attenuation.object": None} | changes
    return recipe.updated(changes)


def _run(arguments: argparse.Namespace) -> None:
    """Reconstruct the volume from the images of a run.

    mphdrr reconstruct run.h5 --iterations 20 --subsets 16 --voxels 64 --spacing 1.6 -o volume.nii.gz --picture slices.png
    mphdrr reconstruct run.h5 --recipe study.toml -o volume.nii.gz
    mphdrr reconstruct run.h5 --set model.intrinsic_fwhm=3 -o volume.nii.gz
    """
    from ..figures.reconstructions import SIZE, SIZE_BESIDE_TRUTH, draw
    from ..runs.recipe import note_files
    from ..runs.reconstructing import voxels_text

    if arguments.write_recipe:
        recipe_path = output_path(arguments.write_recipe, (".toml",))
        mph.write_recipe(_recipe_from_options(arguments, mph.read_run(arguments.file)), recipe_path)
        print(recipe_path)
        return
    if not arguments.output and not arguments.picture:
        raise mph.InputError("nothing to write: give --output FILE, --picture FILE or --write-recipe FILE")
    path = output_path(arguments.output, VOLUME_FORMATS) if arguments.output else None
    picture = output_path(arguments.picture, SUFFIXES) if arguments.picture else None
    state = output_path(arguments.save_state, (".h5", ".hdf5")) if arguments.save_state else None
    run = mph.read_run(arguments.file)
    recipe = _recipe_from_options(arguments, run)
    note_files(recipe)
    start: mph.Volume | mph.Reconstruction | None = None
    if arguments.start is not None:
        start = mph.read_volume(arguments.start, "activity" if run.volume is None else run.volume.quantity)
    elif arguments.resume is not None:
        start = mph.read_reconstruction(arguments.resume)
    method = method_of(recipe["reconstruction.method"])
    log = _IterationLog(method, recipe["reconstruction.iterations"], arguments.quiet, start)
    old_handler = signal.signal(signal.SIGINT, log.interrupt) if state is not None else None
    try:
        reconstruction = mph.reconstruct_run(run, recipe, start=start, watch=log, stages=log.stage, method=method)
    except mph.Cancelled as cancelled:
        if state is not None and cancelled.reconstruction is not None:
            mph.write_reconstruction(cancelled.reconstruction, state)
            iterations = cancelled.reconstruction.iterations
            say(f"{state}: iterations done: {iterations}; --resume goes on")
        raise
    finally:
        if old_handler is not None:
            signal.signal(signal.SIGINT, old_handler)
    if state is not None:
        mph.write_reconstruction(reconstruction, state)
    if path is not None:
        mph.write_volume(reconstruction.volume, path)
    if picture is not None:
        page = Page(*(SIZE if run.volume is None else SIZE_BESIDE_TRUTH), DARK)
        objective, title = reconstruction.objective.tolist(), f"{method.label} of {arguments.file}"
        draw(page, reconstruction.volume, objective, run.volume, title,
             [settings_line(reconstruction), *reconstruction.settings["flatters"]], method.objective)  # fmt: skip
        page.write(picture)
    voxels = voxels_text(reconstruction.volume.grid)
    largest = f"largest {float(reconstruction.volume.array.max()):.4g} {reconstruction.volume.unit}"
    texts = (method.label, settings_line(reconstruction), voxels, largest)
    print(f"{path or picture}: {', '.join(filter(None, texts))}")


def settings_line(reconstruction: mph.Reconstruction) -> str:
    """Return the numbers of iterations and subsets, and the scatter, of a reconstruction in words; "" if it has none."""
    settings, scatter = reconstruction.settings, reconstruction.state.get("scatter")
    subsets = settings.get("subsets", 1)
    share = (
        "" if scatter is None else f"scatter {scatter.sum(dtype=float) / max(1, settings['counts']):.1%} of the counts"
    )
    texts = (iterations_text(reconstruction.iterations), f"{subsets} subsets" if subsets > 1 else "", share)
    return ", ".join(filter(None, texts))


class _IterationLog:
    """Log of a reconstruction: a line on standard error after each iteration, and before the first the stages' bars."""

    def __init__(self, method: Method, iterations: int | None, quiet: bool, start: Any) -> None:
        is_resumed = isinstance(start, mph.Reconstruction) and start.settings.get("method") == method.label
        iterations = iterations or method.own.get("iterations", 0)
        self.n_iterations, self.quiet = (start.iterations if is_resumed else 0) + iterations, quiet
        self.objective_name = method.objective
        self.start_time, self.interrupted = time.monotonic(), False

    def stage(self, title: str) -> mph.Progress | None:
        """Return the progress callback of a stage: a bar, but on a terminal none of the iterations, which have lines."""
        self.bar = progress_bar(title)
        if title != "reconstructing":
            return self.bar
        self.start_time = time.monotonic()
        return self._check

    def interrupt(self, *_: Any) -> None:
        """Note that Ctrl-C was typed, which stops the reconstruction after the current update."""
        self.interrupted = True

    def _check(self, n_done: int, total: int) -> None:
        """Report the progress; raise `Cancelled` if Ctrl-C was typed."""
        if self.interrupted:
            raise mph.Cancelled
        if not sys.stderr.isatty():
            self.bar(n_done, total)

    def __call__(self, iteration: int, values: Any, objective: Sequence[float]) -> None:
        """Print the objective and the largest value after an iteration."""
        self.bar.remark = lambda: f"{self.objective_name} {objective[-1]:.8g}"
        if not self.quiet:
            seconds = time.monotonic() - self.start_time
            line = f"{self.objective_name} {objective[-1]:.8g}, largest {float(values.max()):.4g}, {seconds:.1f} s"
            print(f"iteration {iteration} of {self.n_iterations}: {line}", file=sys.stderr, flush=True)
