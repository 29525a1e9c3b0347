"""The samples that a network learns from: events with noise, OSEM's volumes and the truth on the network's grid.

They are made once, into a folder whose name is a hash of all that they depend on, so that trainings share them.
"""

import hashlib
import io
import json
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
from ..memory import readable_size
from ..progress import Progress, tell
from ..runs.reconstructing import flattering, model_of
from ..runs.run import ProjectionRun
from ..runs.run_recipe import projector_of_run
from ..volumes.resampling import resample
from .recipe import TrainingRecipe
from .setup import Sample, Setup

_VERSION = 1
"""Of what a sample's file holds."""
_MUCH = 2**32
"""Bytes of disk that are worth a warning."""

Draw = tuple[int, int]
"""An event's number, and that of its noise."""


class Source:
    """What samples are made from: an event set and a recipe's [data], [grid] and [osem].

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
            found = EventSet(path)
            if not len(found):
                raise InputError(f"{path}: it holds no events")
        return found

    @cached_property
    def model(self) -> str:
        """The model whose images are taken."""
        models = {name: model["model.kind"] for name, model in self.events.recipe.models.items()}
        counts = [name for name, kind in models.items() if kind == "emission"]
        given = self.recipe["data.model"]
        name = counts[0] if given is None and len(counts) == 1 else given
        if name not in counts:
            raise InputError(f"data.model: expected one of the set's models of counts, {', '.join(counts) or 'none'}")
        if self.events.recipe.models[name]["attenuation.of_phantom"]:
            raise InputError(f"data.model: {name}: each event attenuates otherwise; choose a model without attenuation")
        if self.events.recipe.models[name]["model.dead_time"]:
            differs = "dead time takes another share of each event"
            raise InputError(f"data.model: {name}: {differs}; choose a model without it")
        return str(name)

    @cached_property
    def run(self) -> ProjectionRun:
        """The first event's, which says what scanner and physics are."""
        run = self.events[0].run(self.model)
        model = self.events.recipe.models[self.model]
        if "recipe" not in run.settings:  # none of projections describes its volume
            run = replace(run, settings={**run.settings, "recipe": model.tables()})
        return run

    @cached_property
    def setup(self) -> Setup:
        """The operators, those by which a run of the same scanner is reconstructed."""
        model, threads = model_of(self.run, self.run.recipe), self.recipe["training.threads"]
        A = projector_of_run(self.run, self.recipe.grid, None, model, threads=threads)
        return Setup(A, self.recipe["osem.subsets"], self.recipe["osem.after"], self.recipe["network.permuted"])

    @property
    def levels(self) -> Sequence[float]:
        """Shares of the acquisition time."""
        return self.recipe["data.levels"] or self.events.recipe.levels

    @cached_property
    def kind(self) -> np.dtype[np.void]:
        """What a sample's file holds: `Sample` without the batch, one number or array after the other."""
        (m, n_v, n_u), grid = self.setup.A.shape_out, self.recipe.grid.shape
        shapes = ((m, n_v, n_u), (m, n_v, n_u), (len(self.setup.after), *grid), (), grid)
        return np.dtype([(name, "<f4", shape) for name, shape in zip(Sample._fields, shapes, strict=True)])

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 of what a sample depends on besides its event and draw."""
        setup, grid = self.setup, self.recipe.grid
        told = (
            _VERSION, self.events.recipe.fingerprint, self.model, list(self.levels), grid.shape, grid.affine.tolist(),
            setup.subsets, setup.after, self.recipe["network.permuted"], setup.scanner, setup.physics,
        )  # fmt: skip
        return hashlib.sha256(json.dumps(told).encode()).hexdigest()

    def draws(self, split: str) -> list[Draw]:
        """The samples of a split; of one for validation each event has one draw."""
        count = 1 if split == self.recipe["data.validation"] else self.recipe["data.draws"]
        with naming("data"):
            numbers = self.events.split(split).numbers
            if not numbers:
                raise InputError(f"the split {split!r} of {self.recipe.path('data.events')} holds no events")
        return [(number, draw) for number in numbers for draw in range(count)]

    def sample(self, draw: Draw) -> Sample:
        """A batch of one."""
        event, grid = self._by_number[draw[0]], self.recipe.grid
        with event.held() as held:
            if held.unit(self.model) not in COUNTED:
                raise InputError(f"data.model: {self.model}: expected counts")
            level = float(self.levels[sum(draw) % len(self.levels)])
            seed = mixed_seed(held.noise_seed, draw[1]) if draw[1] else held.noise_seed
            counts = held.images(self.model, seed, level)
            truth = resample(held.truth, grid, "mean").array
        background = np.broadcast_to(self.setup.A.background, counts.shape) * level
        return self.setup.sample(counts, background.astype(np.float32), truth * np.float32(level))

    @cached_property
    def _by_number(self) -> dict[int, Event]:
        return {event.number: event for event in self.events}


class _Making(Dataset[int]):
    """Makes a sample's file for each item that a loader, in any number of processes, asks for."""

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
    """Samples without the axis of the batch, read from the files of `prepared`."""

    def __init__(self, folder: Path, draws: Sequence[Draw]) -> None:
        self.folder, self.draws = folder, draws

    def __len__(self) -> int:
        return len(self.draws)

    def record(self, index: int) -> NDArray[np.void]:
        """A sample's arrays by name, on the disk."""
        return np.load(_path(self.folder, self.draws[index]), mmap_mode="r")

    def __getitem__(self, index: int) -> Sample:
        record = self.record(index)
        return Sample(*(torch.from_numpy(np.array(record[name])) for name in Sample._fields))


def prepared(
    source: Source, beside: Path, splits: Sequence[str], workers: int = 1, progress: Progress | None = None
) -> list[Samples]:
    """The samples of splits, after those that are missing were made; what is interrupted goes on at the next call.

    Parameters
    ----------
    source
        What they are made from.
    beside
        The folder that the samples' own is in, or is made in.
    splits
        Names of the set's splits.
    workers
        Processes that make them.
    progress
        Called after each sample.

    Raises
    ------
    InputError
        The samples do not fit onto the disk, or events cannot be read.

    Warns
    -----
    InputWarning
        They take several gigabytes, or the events' voxels are not fine enough to be learned from.
    """
    for text in flattering(source.run, source.recipe.grid, model_of(source.run, source.run.recipe)):
        warn(text)
    draws = [source.draws(split) for split in splits]
    folder = ensure_folder(beside / f"samples-{source.fingerprint[:16]}")
    remove_leftovers(folder)
    there = {path.name for path in folder.glob("*.npy")}
    missing = [draw for each in draws for draw in each if _path(folder, draw).name not in there]
    _check_disk(folder, len(missing) * source.kind.itemsize)
    several = {} if workers == 1 else {"num_workers": workers, "multiprocessing_context": "spawn"}
    making = DataLoader(_Making(source, folder, missing), batch_size=None, **several)
    for done, _ in enumerate(making if missing else (), 1):
        tell(progress, done, len(missing))
    return [Samples(folder, each) for each in draws]


def _check_disk(folder: Path, size: int) -> None:
    """Say how much disk samples take, where that is a lot; `InputError` where there is not enough."""
    free = shutil.disk_usage(folder).free
    text = f"{folder}: the samples take {readable_size(size)}, {readable_size(free)} are free"
    if size > 0.95 * free:
        raise InputError(text)
    if size > _MUCH:
        warn(text)


def _path(folder: Path, draw: Draw) -> Path:
    return folder / f"{draw[0]:06d}-{draw[1]}.npy"
