"""Layouts of exports: the selected arrays of an event set, and the files that a program reads."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from ...arrays import Floats32
from ...errors import InputError
from ...files import write_bytes
from ..event_set import Event, EventSet
from ..fields import Shapes, field_shapes, float32_bytes
from ..noise_choice import NoiseChoice, chosen_seed, noisy_images

Row = dict[str, Any]
"""Row of events.csv by column: "i", the running number from 0; the event's number "event", its "split", phantom "name",
"mirror" and "size"; and "noise_seed", or ""."""


@dataclass(frozen=True)
class ExportSelection:
    """Selection of events, models and noise of a set for an export."""

    events: EventSet
    """The exported events."""
    models: tuple[str, ...]
    """The names of the models whose images are exported."""
    noise: NoiseChoice = None
    """Noise of the images: None for expected means, "own" for each event's own seed, or a seed of other noise."""
    level: float = 1.0
    """Fraction of the acquisition time; 1 without noise."""

    def noise_seed(self, event: Event) -> int | None:
        """Return the seed of an event's noise; None for no noise."""
        return chosen_seed(event.noise_seed, self.noise)

    def images(self, event: Event, model: str) -> Floats32:
        """Return a model's images (M, n_v, n_u) of an event, with the selected noise where they are counts."""
        return noisy_images(event, model, self.noise_seed(event), self.level)

    def arrays(self, event: Event) -> Iterator[tuple[str, Floats32]]:
        """Yield the name, as in `shapes`, and the values of each array of an event: truth, images, Radon images."""
        yield "truth", event.truth_part()
        for model in self.models:
            yield model, self.images(event, model)
        for n in self.radon_counts:
            yield f"radon{n}", event.radon(n)

    @cached_property
    def shapes(self) -> Shapes:
        """The shapes of an event's arrays, by name."""
        return field_shapes(self.events)

    def record(self, event: Event) -> dict[str, Any]:
        """Return the event's number, split, phantom, settings, poses, truth's affine, units and noise, for JSON."""
        return {
            "number": event.number,
            "split": event.split or "",
            "name": event.name,
            "settings": event.settings,
            "position_mm": event.position.tolist(),
            "euler_degrees": event.euler_degrees.tolist(),
            "pose": event.pose.tolist(),
            "placement": event.placement.tolist(),
            "truth_affine": event.recipe.grid.affine.tolist(),
            "truth_quantity": event.recipe.quantity,
            "units": {model: event.unit(model) for model in self.models},
            "noise_seed": self.noise_seed(event),
            "level": self.level,
        }

    @property
    def radon_counts(self) -> tuple[int, ...]:
        """The numbers of angles of the set's Radon images."""
        radon = self.events.recipe.radon
        return radon.counts if radon else ()


@dataclass(frozen=True)
class ExportPart:
    """Part of an export that is written at once: some files with the events that they hold."""

    files: tuple[str, ...]
    """Paths of the files relative to the export's folder, with "/"."""
    events: tuple[int, ...]
    """Running numbers of the events in these files."""


class ExportLayout:
    """Layout of the files of a program, of an `ExportSelection` and the program's options; a base class.

    A subclass implements `files` and `contents`, and takes options as keyword-only arguments.
    """

    compressed = False
    """Whether the files are compressed."""
    slots: Any = None
    """The `Slots` by which one model's images are written, with a table of them; None where there are none."""

    def __init__(self, selection: ExportSelection) -> None:
        self.selection = selection

    @property
    def event_bytes(self) -> int:
        """The bytes of an event's files without headers; an upper limit for compressed files."""
        return float32_bytes(self.selection.shapes[name] for name in self.array_names)

    @property
    def array_names(self) -> tuple[str, ...]:
        """The names, as in `ExportSelection.shapes`, of the arrays that are written; by default all."""
        return ("truth", *self.selection.models, *(f"radon{n}" for n in self.selection.radon_counts))

    def option_contents(self) -> dict[str, Any]:
        """Return the content of the files that options name, by option, to recognise an export with the same options."""
        return {} if self.slots is None else {"slots": self.slots.table(self.selection.events.system)}

    def files(self, row: Row) -> tuple[str, ...]:
        """Return the paths of an event's files, relative to the export's folder."""
        raise NotImplementedError

    def contents(self, row: Row, event: Event) -> Iterator[tuple[str, bytes | memoryview]]:
        """Yield the path and the content of each of an event's files."""
        raise NotImplementedError

    def tables(self, rows: list[Row]) -> dict[str, bytes]:
        """Return the contents of files that describe the whole export, by path; by default the table of slots, if any."""
        return {} if self.slots is None else {"slots.csv": self.slots.table(self.selection.events.system).encode()}

    def parts(self, rows: list[Row]) -> list[ExportPart]:
        """Return the parts of the export in the order of writing, by default one for each event.

        A part is written at once: it consists of files, and names the events in them.
        """
        return [ExportPart(self.files(row), (row["i"],)) for row in rows]

    def write(self, part: ExportPart, rows: list[Row], folder: Path, report_event: Callable[[], None]) -> None:
        """Write the files of a part of the export into a folder; call `report_event` after each event."""
        for i in part.events:
            for name, content in self.contents(rows[i], self.selection.events[i]):
                write_bytes(folder / name, content)
            report_event()


def single_model(selection: ExportSelection, program: str) -> str:
    """Return the selected model for a program that takes one; `InputError` where several, or none, are selected."""
    if len(selection.models) != 1:
        raise InputError(f"{program} takes the images of one model: choose one of {', '.join(selection.models)}")
    return selection.models[0]
