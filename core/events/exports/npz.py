"""NumPy archives, one per event: ``000012.npz`` with truth, images of each model, Radon images, pose and record."""

import json
from collections.abc import Iterator

from ...volumes.formats.numpy_files import pack_npz
from ..event_set import Event
from .layout import ExportLayout, Row


class Npz(ExportLayout):
    """NumPy archives with truth (x, y, z), truth_affine, MODEL (M, n_v, n_u), radon96 (96, n_v, n_u), pose and record."""

    compressed = True

    def files(self, row: Row) -> tuple[str, ...]:
        """Return the path of the event's archive."""
        return (f"{row['i']:06d}.npz",)

    def contents(self, row: Row, event: Event) -> Iterator[tuple[str, bytes | memoryview]]:
        """Yield the archive with all arrays of the event, and its record as a text of JSON."""
        affine, text = event.recipe.grid.affine, json.dumps(self.selection.record(event))
        arrays = {**dict(self.selection.arrays(event)), "truth_affine": affine, "pose": event.pose, "record": text}
        yield self.files(row)[0], pack_npz(arrays)
