"""pytorch-3dunet: an HDF5 file an event with the arrays ``raw`` and ``label``, (Z, Y, X) float32 of one shape.

Files are in a folder for each split, ``train/000012.h5``, which the loaders' ``file_paths`` may name. What the two are:

=============== ======================================================================================================
``slots``       raw: one model's images by slots, as in the users' layout; label: the Radon images of as many angles.
                Z is the slot or the angle, Y the row, X the column: 96 images each, of one size
``backprojection`` raw: the back-projection of one model's images, as line integrals, onto the truth's voxels; label:
                the truth. Z, Y, X are the axes z, y, x of the world where the grid is upright
=============== ======================================================================================================
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any, Literal

import numpy as np

from ...errors import InputError
from ...files import AnyPath
from ...perspective.backprojection import backproject
from ...runs.backprojecting import run_line_integrals
from ...validation import one_of, shape_text
from ..event_set import Event
from .arrays import hdf5
from .layout import Chosen, Layout, Row, only_model
from .slots import read_slots, row_slots

Raw = Literal["slots", "backprojection"]
RAW: tuple[Raw, ...] = ("slots", "backprojection")


class Unet3d(Layout):
    """`raw`: what the network takes, which says what it is to give; `slots`: a table of them (`slots.read_slots`)."""

    packed = True

    def __init__(self, chosen: Chosen, *, raw: Raw = "slots", slots: AnyPath | None = None) -> None:
        super().__init__(chosen)
        one_of(raw, RAW, "raw")
        self.model, self.raw = only_model(chosen, "3dunet"), raw
        if raw == "backprojection":
            if slots is not None:
                raise InputError("slots: a back-projection has none; leave them out, or choose raw slots")
            self.label = "truth"
            return
        system = chosen.events.system
        self.slots = row_slots(system) if slots is None else read_slots(slots, system)
        self.label = f"radon{len(self.slots)}"
        shapes, counts = chosen.shapes, chosen.radon_counts
        if self.label not in shapes:
            had = ", ".join(map(str, counts)) or "none"
            needed = f"{len(self.slots)} slots need Radon images of as many angles for their label"
            advice = "name them in the recipe's [radon] angles, or choose raw backprojection"
            raise InputError(f"raw slots: {needed}, and the set has {had}; {advice}")
        images, radon = shapes[self.model][1:], shapes[self.label][1:]
        if images != radon:
            found = f"views have {shape_text(images)} pixels and Radon images {shape_text(radon)}"
            advice = "make them alike in the recipe, or choose raw backprojection"
            raise InputError(f"raw slots: raw and label must be of one shape, but {found}; {advice}")

    @property
    def fields(self) -> tuple[str, ...]:
        """The label, and raw, which has its shape."""
        return (self.label, self.label)

    def contained(self) -> dict[str, Any]:
        """The table of slots, and what raw is by default."""
        slots = {"slots": self.slots.table(self.chosen.events.system)} if self.raw == "slots" else {}
        return {"raw": self.raw} | slots

    def files(self, row: Row) -> tuple[str, ...]:
        """One, in the folder of its split."""
        return (f"{row['split']}/{row['i']:06d}.h5",)

    def contents(self, row: Row, event: Event) -> Iterator[tuple[str, bytes]]:
        """The two arrays."""
        if self.raw == "slots":
            raw = self.slots.arranged(self.chosen.images(event, self.model))
            label = event.radon(len(self.slots))
        else:
            images = self.chosen.images(event, self.model) / np.float32(self.chosen.level)  # of the whole time
            run = replace(event.run(self.model), projections=images)
            volume: Any = backproject(run_line_integrals(run), run.views, run.volume.grid)  # type: ignore[union-attr]
            raw, label = volume.array.T, run.volume.array.T  # type: ignore[union-attr]
        arrays = {"raw": np.ascontiguousarray(raw, np.float32), "label": np.ascontiguousarray(label, np.float32)}
        yield self.files(row)[0], hdf5(arrays, {"event": row["event"]})

    def tables(self, rows: list[Row]) -> dict[str, bytes]:
        """What the slots show."""
        if self.raw == "backprojection":
            return {}
        return {"slots.csv": self.slots.table(self.chosen.events.system).encode()}
