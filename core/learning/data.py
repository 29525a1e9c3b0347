"""Samples for training: noisy events with their OSEM volumes and truth, on the network's grid.

They are computed once, into a folder whose name is a hash of everything they depend on, so that trainings share them.
"""

import hashlib
import json
import math
import shutil
from collections.abc import Collection, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from torch.utils.data import DataLoader, Dataset

from ..errors import InputError, naming, several, warn
from ..events.event_set import COUNTED, Event, EventSet
from ..events.noise_choice import mixed_seed
from ..files import ensure_folder, remove_leftovers
from ..memory import readable_size, require
from ..progress import Progress, tell
from ..runs.reconstructing import inverse_crime_notes, reconstruction_model
from ..runs.run import ProjectionRun
from ..runs.run_recipe import projector_of_run
from ..validation import shape_text
from ..volumes.resampling import resample
from .recipe import TrainingRecipe
from .seals import Damaged, read_sealed, write_sealed
from .setup import Sample, ScannerSetup

_VERSION = 2
"""Version of the contents of sample files."""
_MAX_SAMPLES = 10**7
"""Largest number of samples of a split."""
_LARGE = 2**32
"""Disk space, bytes, from which on a warning is given."""

Draw = tuple[int, int]
"""Number of an event, and number of its noise draw."""


class Source:
    """Source of samples: an event set and the tables [data], [grid] and [osem] of a recipe.

    It can be pickled before it is used: operators are made in the process that needs them.
    """

    def __init__(self, recipe: TrainingRecipe) -> None:
        self.recipe = recipe

    def __getstate__(self) -> dict[str, TrainingRecipe]:
        return {"recipe": self.recipe}

    @cached_property
    def events(self) -> EventSet:
        """All events of the set, as they are at the first access; or those of `restrict`."""
        path = self.recipe.path("data.events")
        with naming("data.events"):
            if not len(events := EventSet(path)):
                raise InputError(f"{path}: it holds no events")
        return events

    def restrict(self, numbers: Collection[int]) -> None:
        """Keep the events of these numbers only; raise `InputError` if some are gone."""
        if gone := sorted({*numbers} - {*self.events.numbers}):
            problem = f"the training has begun with events that are gone: {several(gone)}"
            raise InputError(f"data.events: {problem}; put them back, or choose another -o")
        self.events = self.events.where(lambda row: row["event"] in numbers)

    @property
    def used(self) -> EventSet:
        """Events of the splits for training and validation."""
        with naming("data"):
            return self.events.split(self.recipe["data.train"]) + self.events.split(self.recipe["data.validation"])

    @cached_property
    def model(self) -> str:
        """Name of the set's model whose images are used."""
        models = {name: model["model.kind"] for name, model in self.events.recipe.models.items()}
        counts = [name for name, kind in models.items() if kind == "emission"]
        choice = self.recipe["data.model"]
        name = counts[0] if choice is None and len(counts) == 1 else choice
        if name not in counts:
            raise InputError(f"data.model: expected one of the set's models of counts, {', '.join(counts) or 'none'}")
        if self.events.recipe.models[name]["attenuation.of_phantom"]:
            raise InputError(f"data.model: {name}: attenuation differs by event; choose a model without attenuation")
        if self.events.recipe.models[name]["model.dead_time"]:
            raise InputError(f"data.model: {name}: dead time differs by event; choose a model without it")
        return str(name)

    @cached_property
    def run(self) -> ProjectionRun:
        """Run of the first event, which describes scanner and physics."""
        run = self.events[0].run(self.model)
        model = self.events.recipe.models[self.model]
        if "recipe" not in run.settings:  # no recipe of projections can describe its volume
            run = replace(run, settings={**run.settings, "recipe": model.tables()})
        return run

    @cached_property
    def setup(self) -> ScannerSetup:
        """Operators of the scanner, those with which a run by it is reconstructed."""
        model, threads = reconstruction_model(self.run, self.run.recipe), self.recipe["training.threads"]
        A = projector_of_run(self.run, self.recipe.grid, None, model, threads=threads)
        return ScannerSetup(A, self.recipe["osem.subsets"], self.recipe["osem.after"], self.recipe["network.permuted"])

    @property
    def levels(self) -> Sequence[float]:
        """Shares of the acquisition time."""
        return self.recipe["data.levels"] or self.events.recipe.levels

    @property
    def size(self) -> int:
        """Size of a sample's arrays, bytes."""
        n_volumes, A = len(self.setup.after) + 1, self.setup.A
        size = 4 * (2 * math.prod(A.shape_out) + n_volumes * math.prod(A.shape_in))
        require(size, f"a sample of {shape_text(self.recipe.grid.shape)} voxels")
        return size

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 of everything a sample depends on besides its event and draw."""
        setup, grid = self.setup, self.recipe.grid
        record = (
            _VERSION, self.events.recipe.fingerprint, self.model, list(self.levels), grid.shape, grid.affine.tolist(),
            setup.subsets, setup.after, self.recipe["network.permuted"], setup.scanner, setup.physics,
        )  # fmt: skip
        return hashlib.sha256(json.dumps(record).encode()).hexdigest()

    def draws(self, split: str) -> list[Draw]:
        """Return the samples of a split as pairs of event and draw; each validation event has one draw."""
        n_draws = 1 if split == self.recipe["data.validation"] else self.recipe["data.draws"]
        with naming("data"):
            if not (numbers := self.events.split(split).numbers):
                raise InputError(f"the split {split!r} of {self.recipe.path('data.events')} holds no events")
            if (count := len(numbers) * n_draws) > _MAX_SAMPLES:
                raise InputError(f"draws: at most {_MAX_SAMPLES:,} samples of a split, got {count:,}")
        return [(number, draw) for number in numbers for draw in range(n_draws)]

    def sample(self, draw: Draw) -> Sample:
        """Return the sample of an event and a noise draw as a batch of one."""
        event, grid = self._by_number[draw[0]], self.recipe.grid
        with event.held() as loaded:
            if loaded.unit(self.model) not in COUNTED:
                raise InputError(f"data.model: {self.model}: expected counts")
            level = float(self.levels[sum(draw) % len(self.levels)])
            seed = mixed_seed(loaded.noise_seed, draw[1]) if draw[1] else loaded.noise_seed
            counts = loaded.images(self.model, seed, level)
            truth = resample(loaded.truth, grid, "mean").array
        background = np.broadcast_to(self.setup.A.background, counts.shape) * level
        return self.setup.sample(counts, background.astype(np.float32), truth * np.float32(level))

    @cached_property
    def _by_number(self) -> dict[int, Event]:
        """Events by their number."""
        return {event.number: event for event in self.events}


class Samples(Dataset[Sample]):
    """Dataset of samples without the batch axis, kept in sealed files, which are made where they are missing or damaged."""

    def __init__(self, source: Source, folder: Path, draws: Sequence[Draw]) -> None:
        self.source, self.folder, self.draws = source, folder, draws

    def __len__(self) -> int:
        return len(self.draws)

    def __getitem__(self, index: int) -> Sample:
        content = self._read(self.draws[index]) or self._write(self.draws[index])
        return Sample(*(content[name] for name in Sample._fields))

    def _read(self, draw: Draw) -> dict[str, Any]:
        """Return the content of a sample's file; nothing if it is missing or, with a warning, if it is damaged."""
        if not (path := _path(self.folder, draw)).exists():
            return {}
        try:
            content: dict[str, Any] = read_sealed(path, "sample")[0]
            if content["of"] != [self.source.fingerprint, *draw]:
                raise Damaged(f"{path}: a sample of another event or draw")
            return content
        except Damaged as error:
            warn(f"{error}; it is made again", 1)  # under this module's name: Lightning's warnings are silenced
            return {}

    def _write(self, draw: Draw) -> dict[str, Any]:
        """Compute a sample, write its file, and return the file's content."""
        arrays = {name: values[0] for name, values in self.source.sample(draw)._asdict().items()}
        content = {"of": [self.source.fingerprint, *draw], **arrays}
        write_sealed(_path(self.folder, draw), content)
        return content


def prepare_samples(
    source: Source, parent: Path, splits: Sequence[str], workers: int = 1, progress: Progress | None = None
) -> list[Samples]:
    """Create the missing sample files of the given splits and return the samples.

    After an interruption, the next call resumes.

    Parameters
    ----------
    source
        Source of the samples.
    parent
        Folder in which the samples' own folder is, or is created.
    splits
        Names of the set's splits.
    workers
        Number of processes that create samples.
    progress
        Called after each sample.

    Raises
    ------
    InputError
        The samples do not fit onto the disk, or events cannot be read.

    Warns
    -----
    InputWarning
        The samples take several gigabytes, or the events' voxels are not fine enough to learn from.
    """
    model = reconstruction_model(source.run, source.run.recipe)
    for text in inverse_crime_notes(source.run, source.recipe.grid, model):
        warn(text)
    draws = [source.draws(split) for split in splits]
    folder = ensure_folder(parent / f"samples-{source.fingerprint[:16]}")
    remove_leftovers(folder)
    existing = {path.name for path in folder.glob("*.pt")}
    missing = [draw for split_draws in draws for draw in split_draws if _path(folder, draw).name not in existing]
    _check_disk(folder, len(missing) * source.size)
    loader_options = {} if workers == 1 else {"num_workers": workers, "multiprocessing_context": "spawn"}
    # Each process writes files, and returns no more than the number of a sample's fields.
    loader = DataLoader(Samples(source, folder, missing), batch_size=None, collate_fn=len, **loader_options)
    for n_done, _ in enumerate(loader if missing else (), 1):
        tell(progress, n_done, len(missing))
    return [Samples(source, folder, split_draws) for split_draws in draws]


def _check_disk(folder: Path, size: int) -> None:
    """Warn if samples of this `size`, bytes, take much of the disk; raise `InputError` if they do not fit."""
    free = shutil.disk_usage(folder).free
    text = f"{folder}: the samples take {readable_size(size)}, {readable_size(free)} are free"
    if size > 0.95 * free:
        raise InputError(text)
    if size > _LARGE:
        warn(text)


def _path(folder: Path, draw: Draw) -> Path:
    """Return the path of a sample's file."""
    return folder / f"{draw[0]:06d}-{draw[1]}.pt"
