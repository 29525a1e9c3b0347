"""Projection runs as files: one HDF5, npz or torch file holds a run whole.

The record (names, shapes, units) is in `export.record`; each format is one file here.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from ..errors import InputError
from ..files import replacing
from .record import Record, record_of, run_of
from .run import ProjectionRun

FORMATS = (".h5", ".hdf5", ".npz", ".pt")


def write_run(run: ProjectionRun, path: str | os.PathLike[str]) -> None:
    """Write a run as HDF5 (.h5, .hdf5), numpy archive (.npz) or torch file (.pt), by the path's suffix.

    Raises
    ------
    InputError
        Another suffix, torch is missing for .pt, or the file cannot be written (the old one then stays).
    """
    write, _ = _format(Path(path))
    with replacing(path) as temporary:
        write(record_of(run), temporary)


def read_run(path: str | os.PathLike[str]) -> ProjectionRun:
    """Read a run written by `write_run`.

    Raises
    ------
    InputError
        No such file, or not a whole run.
    """
    path = Path(path)
    _, read = _format(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    try:
        return run_of(read(path))
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except Exception as error:  # whatever the format's library raises on a damaged file
        reason = (str(error) or type(error).__name__).splitlines()[0]
        raise InputError(f"{path}: cannot be read as a projection run ({reason})") from error


def _format(path: Path) -> tuple[Callable[[Record, Path], None], Callable[[Path], Record]]:
    suffix = path.suffix.lower()
    if suffix in (".h5", ".hdf5"):
        from . import hdf5

        return hdf5.write, hdf5.read
    if suffix == ".npz":
        from . import npz

        return npz.write, npz.read
    if suffix == ".pt":
        from . import pt

        return pt.write, pt.read
    raise InputError(f"{path}: expected a name ending in {', '.join(FORMATS)}")
