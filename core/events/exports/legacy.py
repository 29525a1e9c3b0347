"""Users' own layout: each tensor of an event in a file, and the poses of all events in two tables.

==================================  =======================================================================================
truth_0.pt                          [1, n, n, n] float32: the true volume, axes x, y, z
Projections_0.pt                    [1, 96, n_v, n_u] float32: the images of one model, by slots (`slots.Slots`)
ProjRadon96_0.pt, ProjRadon256_0.pt [1, N, n_v, n_u] float32: parallel projections, for every N of the recipe
RunTranslate.npy                    [events, 3] float64: position of each event's phantom, mm
RunRotate.npy                       [events, 3] float64: angles phi, theta, psi of the phantom, rad
slots.csv                           the module that each slot shows, and whether mirrored
==================================  =======================================================================================

The row index of images increases along +v and the column index along +u, as everywhere in mphDRR.
"""

from collections.abc import Iterator

import numpy as np

from ...files import AnyPath
from ..event_set import Event
from ..fields import float32_bytes
from .arrays import npy_bytes, pt_bytes
from .layout import ExportLayout, ExportSelection, Row, single_model
from .slots import read_slots, row_slots

_ANGLES = ("phi", "theta", "psi")


class Legacy(ExportLayout):
    """Users' own layout of tensors; `slots`: table of slots (`slots.read_slots`), default: `slots.row_slots`."""

    def __init__(self, selection: ExportSelection, *, slots: AnyPath | None = None) -> None:
        super().__init__(selection)
        self.model = single_model(selection, "legacy")
        system = selection.events.system
        self.slots = row_slots(system) if slots is None else read_slots(slots, system)

    @property
    def event_bytes(self) -> int:
        """The bytes of an event's files: those of its arrays, and of the images in further slots."""
        n_v, n_u = self.selection.shapes[self.model][1:]
        return super().event_bytes + float32_bytes([(len(self.slots) - len(self.selection.events.system), n_v, n_u)])

    def files(self, row: Row) -> tuple[str, ...]:
        """Return the paths of truth, projections, and of the Radon images for each number of angles."""
        names = ("truth", "Projections", *(f"ProjRadon{n}" for n in self.selection.radon_counts))
        return tuple(f"{name}_{row['i']}.pt" for name in names)

    def contents(self, row: Row, event: Event) -> Iterator[tuple[str, bytes]]:
        """Yield the path and the tensor file of each array of an event."""
        for path, (name, values) in zip(self.files(row), self.selection.arrays(event), strict=True):
            yield path, pt_bytes((self.slots.arrange(values) if name == self.model else values)[None])

    def tables(self, rows: list[Row]) -> dict[str, bytes]:
        """Return the tables of positions, angles and slots, by file name."""
        index = self.selection.events.index
        positions = np.array([[row[f"{axis}_mm"] for axis in "xyz"] for row in index], np.float64)
        angles = np.radians([[row[f"{name}_degrees"] for name in _ANGLES] for row in index])
        return {"RunTranslate.npy": npy_bytes(positions), "RunRotate.npy": npy_bytes(angles), **super().tables(rows)}
