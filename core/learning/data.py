"""Samples for training: noisy events with their OSEM volumes and truth, on the network's grid.

They are computed once, into a folder whose name is a hash of everything they depend on, so that trainings share them.
"""

import hashlib
import io
import json
import math
import shutil
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import DataLoader, Dataset

from ..errors import InputError, naming, warn
from ..events.event_set import COUNTED, Event, EventSet
from ..events.noise_choice import mixed_seed
from ..files import ensure_folder, remove_leftovers, write_bytes
from ..memory import readable_size, require
from ..progress import Progress, tell
from ..runs.reconstructing import inverse_crime_notes, reconstruction_model
from ..runs.run import ProjectionRun
from ..runs.run_recipe import projector_of_run
from ..validation import shape_text
from ..volumes.resampling import resample
from .recipe import TrainingRecipe
from .setup import Sample, ScannerSetup

_VERSION = 1
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
        """All events of the set."""
        path = self.recipe.path("data.events")
        with naming("data.events"):
            if not len(events := EventSet(path)):
                raise InputError(f"{path}: it holds no events")
        return events

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

    @cached_property
    def kind(self) -> np.dtype[np.void]:
        """Data type of a sample's file: the fields of `Sample` without the batch axis."""
        (m, n_v, n_u), grid = self.setup.A.shape_out, self.recipe.grid.shape
        shapes = ((m, n_v, n_u), (m, n_v, n_u), (len(self.setup.after), *grid), (), grid)
        require(4 * sum(map(math.prod, shapes)), f"a sample of {shape_text(grid)} voxels")
        return np.dtype([(name, "<f4", shape) for name, shape in zip(Sample._fields, shapes, strict=True)])

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


class _SampleWriter(Dataset[int]):
    """Dataset whose items write the files of missing samples, for loaders with any number of processes."""

    def __init__(self, source: Source, folder: Path, missing: Sequence[Draw]) -> None:
        self.source, self.folder, self.missing = source, folder, missing

    def __len__(self) -> int:
        return len(self.missing)

    def __getitem__(self, index: int) -> int:
        sample, memory = self.source.sample(self.missing[index]), io.BytesIO()
        record = np.zeros((), self.source.kind)
        for name, values in zip(Sample._fields, sample, strict=True):
            record[name] = values[0].numpy()
        np.save(memory, record)
        write_bytes(_path(self.folder, self.missing[index]), memory.getbuffer())
        return index


class Samples(Dataset[Sample]):
    """Dataset of samples without the batch axis, read from the files of `prepare_samples`."""

    def __init__(self, folder: Path, draws: Sequence[Draw]) -> None:
        self.folder, self.draws = folder, draws

    def __len__(self) -> int:
        return len(self.draws)

    def record(self, index: int) -> NDArray[np.void]:
        """Return a sample's arrays by name, mapped from the disk."""
        return np.load(_path(self.folder, self.draws[index]), mmap_mode="r")

    def __getitem__(self, index: int) -> Sample:
        record = self.record(index)
        return Sample(*(torch.from_numpy(np.array(record[name])) for name in Sample._fields))


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
    existing = {path.name for path in folder.glob("*.npy")}
    missing = [draw for split_draws in draws for draw in split_draws if _path(folder, draw).name not in existing]
    _check_disk(folder, len(missing) * source.kind.itemsize)
    loader_options = {} if workers == 1 else {"num_workers": workers, "multiprocessing_context": "spawn"}
    loader = DataLoader(_SampleWriter(source, folder, missing), batch_size=None, **loader_options)
    for n_done, _ in enumerate(loader if missing else (), 1):
        tell(progress, n_done, len(missing))
    return [Samples(folder, split_draws) for split_draws in draws]


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
    return folder / f"{draw[0]:06d}-{draw[1]}.npy"
