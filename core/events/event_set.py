"""Access to event sets: events as NumPy arrays, by number or by their rows of the index."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

import numpy as np

from .. import hdf5
from ..arrays import Floats, Floats32
from ..errors import InputError, number_ranges, several, warn
from ..files import AnyPath
from ..geometry.scanner import Scanner
from ..geometry.views import Views
from ..physics.isotopes import isotope
from ..physics.noise import NOISE_MODELS
from ..runs.counting import recorded_shares, scale_by_module
from ..runs.projecting import LINES
from ..runs.recipe import Recipe, recorded_recipe
from ..runs.run import ProjectionRun
from ..runs.run_recipe import recipe_model, with_phantom
from ..validation import freeze, positive
from ..volumes.images import Images
from ..volumes.volume import Volume
from .event_files import FileLocation, read_array, read_truth
from .event_maker import radon_views
from .folders import SetFolder
from .index import column
from .planning import PlannedEvent, plan
from .recipe import EventRecipe

COUNTED = ("counts", "photons")
"""Units of images that have Poisson noise."""


def _stored_array(name: str, description: str) -> Any:
    """Return a property of `Event` that reads an array of its file, float64, with this description as docstring."""

    def read(event: Event) -> Floats:
        """Return the array that the event's file stores under the property's name."""
        with event.opened() as file:
            return np.asarray(hdf5.read_numbers(event._dataset(file, name)), np.float64)

    return property(read, doc=description)


class Event:
    """Event of a set; each access opens the event's file, reads one item and closes the file."""

    def __init__(self, folder: SetFolder, number: int) -> None:
        self._folder, self.number = folder, number
        self._file: Any = None

    @contextmanager
    def opened(self) -> Iterator[Any]:
        """Open the event's file as an ``h5py.File`` that checks bytes as they are read; `InputError` where it is damaged."""
        if self._file is not None:
            yield self._file
            return
        if not self.path.exists():  # the set may have been packed or unpacked meanwhile
            vars(self._folder).pop("locations", None)
        with hdf5.opened(self.path, self._location.offset) as file:
            if file.attrs["event"] != self.number or file.attrs["recipe_sha256"] != self.recipe.fingerprint:
                raise InputError("an event of another number or recipe")
            yield file

    @contextmanager
    def held(self) -> Iterator[Event]:
        """Open the event's file and yield an event that reads from it, for several readings in one thread."""
        event = Event(self._folder, self.number)
        with self.opened() as event._file:
            yield event

    @property
    def _location(self) -> FileLocation:
        """The location of the event's file; that of a file of its own where there is none yet."""
        return self._folder.locations.get(self.number) or FileLocation(str(self._folder.store.event_path(self.number)))

    @property
    def recipe(self) -> EventRecipe:
        """The recipe of the event's set."""
        return self._folder.recipe

    @property
    def path(self) -> Path:
        """The path of the event's file, or of the shard that holds it."""
        return Path(self._location.path)

    @property
    def row(self) -> dict[str, Any]:
        """The event's row of the index, by column."""
        return self._folder.index.values(self._folder.line(self.number))

    @cached_property
    def attributes(self) -> dict[str, Any]:
        """The attributes of the event's file."""
        with self.opened() as file:
            return hdf5.attributes(file)

    @property
    def name(self) -> str:
        """The name of the phantom in the recipe."""
        return str(self.attributes["phantom"])

    @property
    def split(self) -> str | None:
        """The split of the event, such as "train"; None where the recipe has no splits."""
        return self.attributes["split"] or None

    @property
    def settings(self) -> dict[str, Any]:
        """All settings of the phantom by their names in recipes, or the names of its files."""
        return json.loads(self.attributes["settings"])

    @property
    def noise_seed(self) -> int:
        """The seed of the event's own noise."""
        return int(self.attributes["noise_seed"])

    @property
    def planned(self) -> PlannedEvent:
        """The drawn parameters of the event, with its phantom."""
        return plan(self._folder.recipe, self.number)

    pose: Floats = _stored_array("pose", "The pose (4, 4), world from phantom, mm: rotation and translation.")
    placement: Floats = _stored_array("placement", "The pose (4, 4) with mirroring and the factor of size, mm.")
    position: Floats = _stored_array("position", "The position of the phantom's centre, (3,), mm.")
    euler_degrees: Floats = _stored_array("euler_degrees", "The angles phi, theta, psi of the phantom, (3,), degrees.")
    module_gain: Floats = _stored_array("module_gain", "The sensitivity factors (M,) of the modules, for counts.")

    @property
    def truth(self) -> Volume:
        """The true volume, from which all images were simulated."""
        return Volume(freeze(self.truth_part()), self.recipe.grid, self.recipe.quantity)

    def truth_part(self, part: tuple[slice, ...] = (), out: Floats32 | None = None) -> Floats32:
        """Read the values of the truth, or a part of them (a slice per axis), into `out`, an array of zeros, if given."""
        grid = self.recipe.grid
        with self.opened() as file:
            if "truth" in file:
                self._dataset(file, "truth", grid.shape)
            return read_truth(file, grid, part, out)

    @property
    def views(self) -> Views:
        """The views of the images (M, n_v, n_u)."""
        return self._folder.maker.views

    @property
    def system(self) -> Scanner:
        """The scanner of the set."""
        return self._folder.maker.system

    @property
    def models(self) -> list[str]:
        """The names of the models whose images the event has."""
        with self.opened() as file:
            return list(file.get("images", ()))

    def unit(self, model: str) -> str:
        """Return the unit of a model's images, such as "counts"."""
        with self.opened() as file:
            return str(self._image_dataset(file, model).attrs["unit"])

    def images(
        self,
        model: str,
        noise_seed: int | None = None,
        level: float = 1.0,
        modules: Any = slice(None),
        out: Floats32 | None = None,
    ) -> Floats32:
        """Read a model's images.

        Parameters
        ----------
        model
            Name of the model in the recipe.
        noise_seed
            Seed of Poisson counts (`sample_counts`), such as the event's own `Event.noise_seed`. None: expected means.
        level
            Fraction of the acquisition time; only for counts and photons.
        modules
            Modules whose images are returned: an index, a slice or a list of indices. Noise does not depend on the choice.
        out
            Array of zeros (M, n_v, n_u), float32, into which the images of all modules are written.

        Returns
        -------
        array (M, n_v, n_u), float32
            Images in the unit that `unit` returns; column index along +u, row index along +v. For one index, (n_v, n_u).

        Raises
        ------
        InputError
            There is no such model, or noise or a level was asked for but the images are no counts.
        """
        level = positive(level, "level")
        with self.opened() as file:
            dataset = self._image_dataset(file, model)
            if (noise_seed is not None or level != 1.0) and dataset.attrs["unit"] not in COUNTED:
                unit = dataset.attrs["unit"]
                raise InputError(f"{model}: only counts and photons have noise and levels, its images are {unit}")
            is_range = isinstance(modules, slice) and modules.step in (None, 1)
            region = (modules, slice(None), slice(None)) if is_range and noise_seed is None else ()
            images = read_array(file, dataset.name, region, out)
        if level != 1.0:
            images *= np.float32(level)
        if noise_seed is not None:
            noise = self.recipe.settings.choice("noise.model", NOISE_MODELS)
            NOISE_MODELS[noise].draw(images, noise_seed, images)
        return images if region else images[modules]

    def radon(self, count: int) -> Floats32:
        """Read the parallel projections (count, n_v, n_u) of the truth at `count` angles, value x mm."""
        with self.opened() as file:
            shape = None if self.recipe.radon is None else (count, *self.recipe.radon.shape)
            return Images.tag(read_array(file, self._dataset(file, f"radon/{count}", shape).name), self.recipe.quantity)

    def radon_views(self, count: int) -> Views:
        """Return the views of the parallel projections at `count` angles."""
        return radon_views(self._folder.recipe, count)

    def run(self, model: str, noise_seed: int | None = None, level: float = 1.0) -> ProjectionRun:
        """Return the images of a model as a projection run with truth, scanner and recipe, to show, write or reconstruct.

        `level` is the detected fraction of the decays and of the background; the recipe's acquisition time is shortened
        accordingly. The run has no recipe where attenuation comes from a phantom that no recipe of projections describes:
        one with a factor of activity, the mean of several gates, or a volume.
        """
        models = self._folder.recipe.models
        if model not in models:
            raise InputError(f"{model!r}: no such model; there are {', '.join(models) or 'none'}")
        settings: dict[str, Any] = {"model": model, "event": self.number, "volume": self.name}
        recipe = models[model] if level == 1.0 else _at_level(models[model], positive(level, "level"))
        if (record := self._run_recipe(recipe)) is not None:
            settings["recipe"] = record.tables()
        image_model: Any = recipe_model(self._folder.recipe.placed(recipe), self.system)
        images = self.images(model, noise_seed, level)
        background = scale_by_module(image_model.background, recorded_shares(recipe, images))
        return ProjectionRun(images, self.system, self.views, self.truth, unit=self.unit(model), settings=settings,
                             seed=noise_seed, background=background, efficiency=image_model.efficiency)  # fmt: skip

    def _run_recipe(self, model: Recipe) -> Recipe | None:
        """Return the recipe of a run with a model's images; None where no recipe can describe the attenuation."""
        planned, recipe, grid = self.planned, self.recipe, self.recipe.grid
        files = {key: model[key] for key in ("system.file", "system.columns")}
        changes: dict[str, Any] = {key: str(recipe.input(name).path) for key, name in files.items() if name is not None}
        if (mu_files := model["attenuation.file"]) is not None:
            changes["attenuation.file"] = [str(recipe.input(name).path) for name in mu_files]
            if model["attenuation.energy"] != LINES:
                changes |= {"attenuation.energy": None}  # the set's copy holds mu, not CT numbers
        record = recorded_recipe(recipe.placed(model.updated(changes)))
        if planned.phantom is not None and planned.entry["gates"] == 1 and planned.activity_factor == 1:
            values: dict[str, Any] = {"phantom.voxels": grid.shape, "phantom.spacing": grid.spacing.tolist()}
            if planned.file is not None:
                values["phantom.file"] = str(recipe.input(planned.file).path)
            return with_phantom(record.updated(values), planned.phantom, planned.placement)
        return None if model["attenuation.of_phantom"] else record

    def __repr__(self) -> str:
        return f"Event({self.number}, {self.path})"

    def _image_dataset(self, file: Any, model: str) -> Any:
        """Return the dataset of a model's images in an open file; `InputError` where it has another shape than the views."""
        return self._dataset(file, f"images/{model}", (len(self.views), *self.views.shape))

    def _dataset(self, file: Any, name: str, shape: tuple[int, ...] | None = None) -> Any:
        """Return a dataset of an open file; `InputError` where it is missing, or its shape is not `shape`."""
        group, _, last = name.rpartition("/")
        members = file.get(group, {}) if group else file
        if last not in members:
            raise InputError(f"no {group or 'array'} of {last!r}; there are {', '.join(members) or 'none'}")
        if shape is not None and file[name].shape != shape:
            raise InputError(f"{name}: expected the shape {shape}, got {file[name].shape}")
        return file[name]


def _at_level(recipe: Recipe, level: float) -> Recipe:
    """Return a model's recipe with time, photons and background scaled to a fraction `level` of the counts."""
    changes: dict[str, Any] = {key: level * recipe[key] for key in ("model.photons", "model.background") if recipe[key]}
    if recipe["model.kind"] == "emission":
        times, name = np.atleast_1d(recipe["model.time"]).tolist(), recipe["model.isotope"]
        nuclide = None if name is None else isotope(name)
        changes["model.time"] = [nuclide.duration(level, time) if nuclide else level * time for time in times]
    return recipe.updated(changes)


class EventSet:
    """The events of one folder, or of several joined (``a + b``), in order of their numbers.

    A set holds no open file and reads on access: it can be pickled, and used in threads and in processes that fork or
    spawn.

    Parameters
    ----------
    folder
        Folder of the set.

    Raises
    ------
    InputError
        The folder is no event set.

    Warns
    -----
    InputWarning
        Requested events are missing: they are not made yet, or files or members of shards were lost.

    Examples
    --------
    >>> events = mph.events.EventSet("set")
    >>> train = events.split("train")
    >>> hot = events.where(lambda row: row["phantom.activity"] > 50)
    >>> train[0].truth.array.shape
    (256, 256, 256)
    """

    def __init__(self, folder: AnyPath) -> None:
        set_folder = SetFolder(folder)
        _ = set_folder.recipe  # raises InputError where the folder is no set
        requested = set_folder.requested_numbers()
        self._events = [Event(set_folder, number) for number in set_folder.locations]
        if missing := [number for number in requested if number not in set_folder.locations]:
            count = f"{len(missing)} of {len(requested)} events are missing: {several(number_ranges(missing), 10)}"
            warn(f"{set_folder.path}: {count}; mphdrr events make {set_folder.path} makes them", 2)

    @classmethod
    def _from_events(cls, events: list[Event]) -> EventSet:
        """Return a set of these events, which may belong to several folders."""
        event_set = cls.__new__(cls)
        event_set._events = events
        return event_set

    def __len__(self) -> int:
        return len(self._events)

    if TYPE_CHECKING:  # typing keeps overloads for ever, and with them all that can be reached from here, such as bpy

        @overload
        def __getitem__(self, index: int) -> Event: ...
        @overload
        def __getitem__(self, index: slice) -> EventSet: ...
        def __getitem__(self, index: Any) -> Any: ...

    else:

        def __getitem__(self, index: Any) -> Any:
            selected = self._events[index]
            return self._from_events(selected) if isinstance(index, slice) else selected

    def __iter__(self) -> Iterator[Event]:
        return iter(self._events)

    def __add__(self, other: EventSet) -> EventSet:
        return self._from_events([*self._events, *other._events])

    @property
    def numbers(self) -> list[int]:
        """The numbers of the events, in order."""
        return [event.number for event in self._events]

    @property
    def index(self) -> list[dict[str, Any]]:
        """The rows of the index, one for each event."""
        return [event.row for event in self._events]

    @property
    def recipe(self) -> EventRecipe:
        """The recipe of the first event's set."""
        return self._first_folder.recipe

    @property
    def system(self) -> Scanner:
        """The scanner of the first event's set."""
        return self._first_folder.maker.system

    def where(self, holds: Callable[[Mapping[str, Any]], bool]) -> EventSet:
        """Return the events for whose row of the index `holds(row)` is true."""
        return self._from_events([event for event in self._events if holds(event.row)])

    def split(self, name: str) -> EventSet:
        """Return the events of a split, such as "train"; `InputError` where the recipe has no such split."""
        splits = [column(event._folder.line(event.number), 2) for event in self._events]
        names = set(splits) - {""} | (set(self.recipe.splits) if self._events else set())
        if name not in names:
            raise InputError(f"split {name!r}: there are {', '.join(sorted(names)) or 'none'}")
        return self._from_events([event for event, split in zip(self._events, splits, strict=True) if split == name])

    def __repr__(self) -> str:
        return f"EventSet({len(self)} events)"

    @property
    def _first_folder(self) -> SetFolder:
        """The folder of the first event; `InputError` in an empty set."""
        if not self._events:
            raise InputError("the event set holds no events")
        return self._events[0]._folder
