"""One archive of numpy an event: ``000012.npz`` with the truth, the images of each model, Radon images and the pose."""

import json
from collections.abc import Iterator

from ...volumes.formats.numpy_files import pack_npz
from ..event_set import Event
from .layout import Layout, Row
from .record import record


class Npz(Layout):
    """Names: truth (x, y, z), truth_affine, those of the models (M, n_v, n_u), radon96 (96, n_v, n_u), pose, record."""

    packed = True

    def files(self, row: Row) -> tuple[str, ...]:
        """One."""
        return (f"{row['i']:06d}.npz",)

    def contents(self, row: Row, event: Event) -> Iterator[tuple[str, bytes | memoryview]]:
        """All that there is of the event; `record` is text, as JSON."""
        affine, text = event.recipe.grid.affine, json.dumps(record(self.chosen, event))
        arrays = {**dict(self.chosen.arrays(event)), "truth_affine": affine, "pose": event.pose, "record": text}
        yield self.files(row)[0], pack_npz(arrays)
