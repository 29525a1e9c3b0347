"""``mphdrr counts flood FLOOD -o efficiency.npy``: what measured counts say of the detectors."""

import argparse
import io
from pathlib import Path

import numpy as np

from ... import core as mph
from ..files import write_bytes
from ..runs.counting import EFFICIENCY
from ..runs.files import FORMATS
from ..volumes.formats import numpy_files
from .options import add_command, add_run, output_path, print_answer

_ENDINGS = (".npy", ".npz")
_LISTED = 10  # pixels


def add_parser(subparsers) -> None:  # type: ignore[no-untyped-def]
    """Add the command."""
    example = "mphdrr counts flood flood.h5 -o efficiency.npy"
    counts = add_command(subparsers, "counts", "what measured counts say of the detectors", example)
    actions = counts.add_subparsers(metavar="ACTION", required=True)
    flood = add_run(actions, "flood", _run)
    text = f"run of measured counts of an even source ({', '.join(FORMATS)}), or images of modules (.npy)"
    flood.add_argument("file", metavar="FLOOD", help=text)
    flood.add_argument("--order", type=int, default=2, metavar="N", help="largest power of the trend's polynomial")
    text = "relative standard deviation that pixels may have of their own at least"
    flood.add_argument("--spread", type=float, default=0.05, metavar="SHARE", help=text)
    flood.add_argument("--json", action="store_true", help="print JSON")
    flood.add_argument("-o", "--output", metavar="FILE", required=True, help=", ".join(_ENDINGS))


def _run(arguments: argparse.Namespace) -> None:
    """Find pixels' efficiencies, and dead and hot pixels, from the image of an even source.

    mphdrr project scanner.xlsx --counts flood.npy --frames 1-80 --orientation front+v --time 600 -o flood.h5
    mphdrr counts flood flood.h5 -o efficiency.npy
    """
    path, file = output_path(arguments.output, _ENDINGS), Path(arguments.file)
    run = mph.read_run(file) if file.suffix.lower() in FORMATS else None
    images = mph.read_counts(file) if run is None else run.projections
    numbers = list(range(1, len(images) + 1)) if run is None else run.system.numbers.tolist()
    found = mph.flood_efficiency(images, arguments.order, arguments.spread)
    memory = io.BytesIO()
    np.save(memory, found.efficiency.astype(np.float32))
    packed = numpy_files.packed({EFFICIENCY: found.efficiency.astype(np.float32)})
    write_bytes(path, packed if path.suffix.lower() == ".npz" else memory.getbuffer())
    pixels = {"dead": found.dead, "hot": found.hot}
    places = {name: [(numbers[m], int(v) + 1, int(u) + 1) for m, v, u in known] for name, known in pixels.items()}
    dead_modules = [numbers[m] for m in found.dead_modules]
    lines = [f"{path}: {found}"]
    for name, known in places.items():
        some = "; ".join("module {}, row {}, column {}".format(*place) for place in known[:_LISTED])
        more = f"; and {len(known) - _LISTED} more" if len(known) > _LISTED else ""
        lines += [f"{name}: {some}{more}"] if known else []
    if dead_modules:
        lines.append(f"dead modules: {', '.join(map(str, dead_modules))}")
    answer = {"file": str(path), "spread": found.spread, "dead_modules": dead_modules, **places}
    print_answer(arguments, answer, lines)
