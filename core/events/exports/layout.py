"""What an export is made of: what was chosen of a set, and the files that a program wants."""

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
"""A row of events.csv: i, the export's running number from 0; the event's number, split and name, what places its phantom
besides the pose; the noise's seed, or ""."""


@dataclass(frozen=True)
class Chosen:
    """What of a set is exported."""

    events: EventSet
    models: tuple[str, ...]
    """The models whose images are exported."""
    noise: NoiseChoice = None
    """None: the mean images; "own": with the noise of each event's own seed; a number: another noise of that seed."""
    level: float = 1.0
    """Share of the acquisition time, with noise."""

    def seed(self, event: Event) -> int | None:
        """The seed of the event's noise; None: there is none."""
        return chosen_seed(event.noise_seed, self.noise)

    def images(self, event: Event, model: str) -> Floats32:
        """A model's images (M, n_v, n_u): with the noise, where they are counts."""
        return noisy_images(event, model, self.seed(event), self.level)

    def arrays(self, event: Event) -> Iterator[tuple[str, Floats32]]:
        """The event's arrays by their names in `shapes`: truth, images of the models, Radon images."""
        yield "truth", event.truth_part()
        for model in self.models:
            yield model, self.images(event, model)
        for n in self.radon_counts:
            yield f"radon{n}", event.radon(n)

    @cached_property
    def shapes(self) -> Shapes:
        """The shapes of an event's arrays."""
        return field_shapes(self.events)

    @property
    def radon_counts(self) -> tuple[int, ...]:
        """Numbers of angles of the Radon images that there are."""
        radon = self.events.recipe.radon
        return radon.counts if radon else ()


@dataclass(frozen=True)
class Part:
    """What is written at once: files, of these events of the export."""

    files: tuple[str, ...]
    """Paths in the export's folder, with "/"."""
    events: tuple[int, ...]
    """Their running numbers."""


class Layout:
    """The files of a program. Subclasses are made of `Chosen` and the program's own options, and say what to write."""

    packed = False
    """Whether files are compressed."""

    def __init__(self, chosen: Chosen) -> None:
        self.chosen = chosen

    @property
    def event_bytes(self) -> int:
        """Bytes of the files of an event, headers left out; of packed ones the most that they can be."""
        return float32_bytes(self.chosen.shapes[name] for name in self.fields)

    @property
    def fields(self) -> tuple[str, ...]:
        """The arrays of an event that are written, by their names in `Chosen.shapes`; here all."""
        return ("truth", *self.chosen.models, *(f"radon{n}" for n in self.chosen.radon_counts))

    def contained(self) -> dict[str, Any]:
        """The contents of the files that options name, which are compared to tell whether two exports are the same."""
        return {}

    def files(self, row: Row) -> tuple[str, ...]:
        """Paths of an event's files."""
        raise NotImplementedError

    def contents(self, row: Row, event: Event) -> Iterator[tuple[str, bytes | memoryview]]:
        """Each of an event's files, and what is in it."""
        raise NotImplementedError

    def tables(self, rows: list[Row]) -> dict[str, bytes]:
        """Files of the whole export."""
        return {}

    def parts(self, rows: list[Row]) -> list[Part]:
        """What is written, one after the other; here, the files of an event."""
        return [Part(self.files(row), (row["i"],)) for row in rows]

    def write(self, part: Part, rows: list[Row], folder: Path, written: Callable[[], None]) -> None:
        """Write a part; call `written` after each event."""
        for i in part.events:
            for name, content in self.contents(rows[i], self.chosen.events[i]):
                write_bytes(folder / name, content)
            written()


def only_model(chosen: Chosen, program: str) -> str:
    """The model of a program that takes the images of one; `InputError` if several are chosen."""
    if len(chosen.models) != 1:
        raise InputError(f"{program} takes the images of one model: choose one of {', '.join(chosen.models)}")
    return chosen.models[0]
