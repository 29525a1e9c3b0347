"""Efficiencies of pixels, found in the file of a flood and written to a file."""

import io
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..files import AnyPath, require_ending, write_bytes
from ..physics.flood import FloodEfficiency, flood_efficiency
from . import FORMATS
from .files import read_run
from .frame_files import read_counts

Places = dict[str, list[list[int]]]
"""Module number, row and column, counted from 1, of dead and hot pixels; the numbers of dead modules."""


def write_flood(file: AnyPath, path: AnyPath, order: int = 2) -> tuple[FloodEfficiency, Places, list[str]]:
    """Find the pixels' efficiencies in the `file` of a flood, a run or images (.npy), and write them to `path` (.npy).

    `order` is the largest power of the trend's polynomial. Returns the result of `flood_efficiency`, the positions of dead
    and hot pixels and of dead modules, and lines of text that list them.
    """
    file = Path(file)
    require_ending(file, (*FORMATS, ".npy"))  # frames of other files have no module and no orientation
    require_ending(path, (".npy",))
    if Path(path).resolve() == file.resolve():
        raise InputError(f"{path}: expected another file than that of the flood")
    run = read_run(file) if file.suffix.lower() in FORMATS else None
    images = read_counts(file) if run is None else run.projections
    numbers = list(range(1, len(images) + 1)) if run is None else run.system.numbers.tolist()
    flood = flood_efficiency(images, order)
    np.save(memory := io.BytesIO(), flood.efficiency.astype(np.float32))
    write_bytes(path, memory.getbuffer())
    places = {
        "dead": [[numbers[m], int(v) + 1, int(u) + 1] for m, v, u in flood.dead],
        "hot": [[numbers[m], int(v) + 1, int(u) + 1] for m, v, u in flood.hot],
        "dead modules": [[numbers[m]] for m in flood.dead_modules],
    }
    lines = [f"{name}: {', '.join('/'.join(map(str, row)) for row in rows)}" for name, rows in places.items() if rows]
    note = ["module/row/column, from 1:"] if lines else []
    return flood, places, [f"{path}: {flood}", *note, *lines]
