"""From a file of a flood to a file of efficiencies, for the command line and the window."""

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
"""Of dead and hot pixels module's number, row and column, from 1; of dead modules their numbers."""


def write_flood(file: AnyPath, path: AnyPath, order: int = 2) -> tuple[FloodEfficiency, Places, list[str]]:
    """Write the efficiencies that the `file` of a flood, a run or images (.npy), tells; `order` is that of the trend.

    Returns what `flood_efficiency` does, which pixels and modules are dead or hot, and lines of text that say so.
    """
    file = Path(file)
    require_ending(file, (*FORMATS, ".npy"))  # frames of other files may be of any module, and lie in any way
    require_ending(path, (".npy",))
    if Path(path).resolve() == file.resolve():
        raise InputError(f"{path}: expected another file than that of the flood")
    run = read_run(file) if file.suffix.lower() in FORMATS else None
    images = read_counts(file) if run is None else run.projections
    numbers = list(range(1, len(images) + 1)) if run is None else run.system.numbers.tolist()
    found = flood_efficiency(images, order)
    np.save(memory := io.BytesIO(), found.efficiency.astype(np.float32))
    write_bytes(path, memory.getbuffer())
    places = {
        "dead": [[numbers[m], int(v) + 1, int(u) + 1] for m, v, u in found.dead],
        "hot": [[numbers[m], int(v) + 1, int(u) + 1] for m, v, u in found.hot],
        "dead modules": [[numbers[m]] for m in found.dead_modules],
    }
    lines = [f"{name}: {', '.join('/'.join(map(str, one)) for one in each)}" for name, each in places.items() if each]
    note = ["module/row/column, from 1:"] if lines else []
    return found, places, [f"{path}: {found}", *note, *lines]
