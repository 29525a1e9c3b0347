"""The users' own layout: tensors of an event in files of their own, and the poses of all in two tables.

==================================  =======================================================================================
truth_0.pt                          [1, n, n, n] float32: the true volume, axes x, y, z
Projections_0.pt                    [1, 96, n_v, n_u] float32: the images of one model, by slots (`slots.Slots`)
ProjRadon96_0.pt, ProjRadon256_0.pt [1, N, n_v, n_u] float32: parallel projections, for every N of the recipe
RunTranslate.npy                    [events, 3] float64: where each event's phantom stands, mm
RunRotate.npy                       [events, 3] float64: its angles phi, theta, psi, rad
slots.csv                           which module each slot shows, and whether mirrored
==================================  =======================================================================================

Rows of images go along +v and columns along +u, as everywhere in mphDRR.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np

from ...files import AnyPath
from ..event_set import Event
from ..fields import float32_bytes
from .arrays import npy, pt
from .layout import Chosen, Layout, Row, only_model
from .slots import read_slots, row_slots

_ANGLES = ("phi", "theta", "psi")


class Legacy(Layout):
    """`slots`: a table of them instead of a row of images and its mirrored ones (`slots.read_slots`)."""

    def __init__(self, chosen: Chosen, *, slots: AnyPath | None = None) -> None:
        super().__init__(chosen)
        self.model = only_model(chosen, "legacy")
        system = chosen.events.system
        self.slots = row_slots(system) if slots is None else read_slots(slots, system)

    @property
    def event_bytes(self) -> int:
        """More than that of the set's arrays, by the mirrored images."""
        n_v, n_u = self.chosen.shapes[self.model][1:]
        return super().event_bytes + float32_bytes([(len(self.slots) - len(self.chosen.events.system), n_v, n_u)])

    def contained(self) -> dict[str, Any]:
        """The table of slots."""
        return {"slots": self.slots.table(self.chosen.events.system)}

    def files(self, row: Row) -> tuple[str, ...]:
        """Truth, projections, and a file for each number of angles."""
        names = ("truth", "Projections", *(f"ProjRadon{n}" for n in self.chosen.radon_counts))
        return tuple(f"{name}_{row['i']}.pt" for name in names)

    def contents(self, row: Row, event: Event) -> Iterator[tuple[str, bytes]]:
        """Their tensors."""
        for file, (name, array) in zip(self.files(row), self.chosen.arrays(event), strict=True):
            yield file, pt((self.slots.arranged(array) if name == self.model else array)[None])

    def tables(self, rows: list[Row]) -> dict[str, bytes]:
        """The poses, and what the slots show."""
        index = self.chosen.events.index
        places = np.array([[row[f"{axis}_mm"] for axis in "xyz"] for row in index], np.float64)
        angles = np.radians([[row[f"{name}_degrees"] for name in _ANGLES] for row in index])
        slots = self.slots.table(self.chosen.events.system).encode()
        return {"RunTranslate.npy": npy(places), "RunRotate.npy": npy(angles), "slots.csv": slots}
