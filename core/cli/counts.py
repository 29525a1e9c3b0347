"""``mphdrr counts flood FLOOD -o efficiency.npy``: what measured counts say of the detectors."""

import argparse
import io
from pathlib import Path

import numpy as np

from ... import core as mph
from ..files import require_ending, write_bytes
from ..runs.formats import FORMATS
from . import COMMANDS
from .options import add_command, add_run, output_path, print_answer


def add_parser(subparsers) -> None:  # type: ignore[no-untyped-def]
    """Add the command."""
    example = "mphdrr counts flood flood.h5 -o efficiency.npy"
    counts = add_command(subparsers, "counts", COMMANDS["counts"], example)
    flood = add_run(counts.add_subparsers(metavar="ACTION", required=True), "flood", _run)
    text = f"run of measured counts of an even source ({', '.join(FORMATS)}), or images of modules (.npy)"
    flood.add_argument("file", metavar="FLOOD", help=text)
    flood.add_argument("--order", type=int, default=2, metavar="N", help="largest power of the trend's polynomial")
    flood.add_argument("--json", action="store_true", help="print JSON")
    flood.add_argument("-o", "--output", metavar="FILE", required=True, help=".npy")


def _run(arguments: argparse.Namespace) -> None:
    """Find pixels' efficiencies, and dead and hot pixels, from the image of an even source.

    mphdrr project scanner.xlsx --counts flood.npy --frames 1-80 --orientation front+v --time 600 -o flood.h5
    mphdrr counts flood flood.h5 -o efficiency.npy
    """
    path, file = output_path(arguments.output, (".npy",)), Path(arguments.file)
    require_ending(file, (*FORMATS, ".npy"))  # frames of other files may be of any module, and lie in any way
    run = mph.read_run(file) if file.suffix.lower() in FORMATS else None
    images = mph.read_counts(file) if run is None else run.projections
    numbers = list(range(1, len(images) + 1)) if run is None else run.system.numbers.tolist()
    found = mph.flood_efficiency(images, arguments.order)
    np.save(memory := io.BytesIO(), found.efficiency.astype(np.float32))
    write_bytes(path, memory.getbuffer())
    answer: dict[str, list[list[int]]] = {
        "dead": [[numbers[m], int(v) + 1, int(u) + 1] for m, v, u in found.dead],
        "hot": [[numbers[m], int(v) + 1, int(u) + 1] for m, v, u in found.hot],
        "dead modules": [[numbers[m]] for m in found.dead_modules],
    }
    lines = [
        f"{name}: {', '.join('/'.join(map(str, place)) for place in places)}"
        for name, places in answer.items()
        if places
    ]
    note = ["module/row/column, from 1:"] if lines else []
    print_answer(arguments, answer, [f"{path}: {found}", *note, *lines])
