"""Files of pytorch-3dunet: one HDF5 file per event with the arrays ``raw`` and ``label``, (Z, Y, X) float32 of one shape.

Files are in a folder for each split, ``train/000012.h5``, which the loaders' ``file_paths`` may name. The option `raw`
chooses the two arrays:

=============== ======================================================================================================
``slots``       raw: one model's images by slots, as in the users' layout; label: the Radon images at as many angles.
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
from .arrays import hdf5_bytes
from .layout import ExportLayout, ExportSelection, Row, single_model
from .slots import read_slots, row_slots

Raw = Literal["slots", "backprojection"]
"""Content of the array raw, the network's input."""
RAW: tuple[Raw, ...] = ("slots", "backprojection")


class Unet3d(ExportLayout):
    """HDF5 files with the network's input `raw`, slots or a back-projection; `slots`: table (`slots.read_slots`)."""

    compressed = True

    def __init__(self, selection: ExportSelection, *, raw: Raw = "slots", slots: AnyPath | None = None) -> None:
        super().__init__(selection)
        one_of(raw, RAW, "raw")
        self.model, self.raw = single_model(selection, "3dunet"), raw
        if raw == "backprojection":
            if slots is not None:
                raise InputError("slots: expected none for a back-projection; leave them out, or choose raw slots")
            self.label = "truth"
            return
        system = selection.events.system
        self.slots = row_slots(system) if slots is None else read_slots(slots, system)
        self.label = f"radon{len(self.slots)}"
        shapes, counts = selection.shapes, selection.radon_counts
        if self.label not in shapes:
            available = ", ".join(map(str, counts)) or "none"
            requirement = f"{len(self.slots)} slots need Radon images of as many angles for their label"
            advice = "name them in the recipe's [radon] angles, or choose raw backprojection"
            raise InputError(f"raw slots: {requirement}, and the set has {available}; {advice}")
        images, radon = shapes[self.model][1:], shapes[self.label][1:]
        if images != radon:
            shapes_text = f"views have {shape_text(images)} pixels and Radon images {shape_text(radon)}"
            advice = "make them alike in the recipe, or choose raw backprojection"
            raise InputError(f"raw slots: raw and label must be of one shape, but {shapes_text}; {advice}")

    @property
    def array_names(self) -> tuple[str, ...]:
        """The name of the label twice: raw has the same shape."""
        return (self.label, self.label)

    def option_contents(self) -> dict[str, Any]:
        """Return the option raw, which may be the default, and the content of the table of slots."""
        return {"raw": self.raw, **super().option_contents()}

    def files(self, row: Row) -> tuple[str, ...]:
        """Return the path of the event's file, in the folder of its split."""
        return (f"{row['split']}/{row['i']:06d}.h5",)

    def contents(self, row: Row, event: Event) -> Iterator[tuple[str, bytes]]:
        """Yield the event's file with raw and label."""
        if self.raw == "slots":
            raw = self.slots.arrange(self.selection.images(event, self.model))
            label = event.radon(len(self.slots))
        else:
            # Scaled to the whole acquisition time, since the run's recipe has that time.
            images = self.selection.images(event, self.model) / np.float32(self.selection.level)
            run = replace(event.run(self.model), projections=images)
            volume: Any = backproject(run_line_integrals(run), run.views, run.volume.grid)  # type: ignore[union-attr]
            raw, label = volume.array.T, run.volume.array.T  # type: ignore[union-attr]
        arrays = {"raw": np.ascontiguousarray(raw, np.float32), "label": np.ascontiguousarray(label, np.float32)}
        yield self.files(row)[0], hdf5_bytes(arrays, {"event": row["event"]})
