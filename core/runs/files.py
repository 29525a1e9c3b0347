"""Run files: HDF5, numpy archives and torch files, each of which holds a run whole.

What they hold (names, shapes, units) is in `record`.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from ..files import replacing
from .record import Record, record_of, run_of
from .run import ProjectionRun

_ATTRIBUTES = "attributes"
_COMPRESS_FROM = 1 << 16  # bytes: below, compressing costs more than it saves


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


def _write_hdf5(record: Record, path: Path) -> None:
    """Arrays as datasets with a `unit`, in chunks of one view each, so that one view reads alone; attributes on the root."""
    import h5py

    with h5py.File(path, "w") as file:
        file.attrs.update(record.attributes)
        for name, array in record.arrays.items():
            packed: dict[str, Any] = {}
            if array.nbytes >= _COMPRESS_FROM:
                packed = {
                    "compression": "gzip",
                    "compression_opts": 1,
                    "shuffle": True,
                    "chunks": (1, *array.shape[1:]),
                }
            dataset = file.create_dataset(name, data=array, **packed)
            dataset.attrs["unit"] = record.unit(name)


def _read_hdf5(path: Path) -> Record:
    import h5py

    arrays: dict[str, np.ndarray] = {}

    def take(name: str, item: h5py.Dataset | h5py.Group) -> None:
        if isinstance(item, h5py.Dataset):
            arrays[name] = item[()]

    with h5py.File(path, "r") as file:
        file.visititems(take)
        attributes = {
            name: value.item() if isinstance(value, np.generic) else value for name, value in file.attrs.items()
        }
    return Record(arrays, attributes)


def _write_npz(record: Record, path: Path) -> None:
    """Arrays by name, attributes as JSON text."""
    contents: dict[str, Any] = {**record.arrays, _ATTRIBUTES: np.array(json.dumps(record.attributes))}
    with open(path, "wb") as file:
        np.savez_compressed(file, **contents)


def _read_npz(path: Path) -> Record:
    with np.load(path, allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files if name != _ATTRIBUTES}
        attributes = json.loads(str(file[_ATTRIBUTES])) if _ATTRIBUTES in file.files else {}
    return Record(arrays, attributes)


def _write_pt(record: Record, path: Path) -> None:
    """Only tensors, text and whole numbers: ``torch.load(path, weights_only=True)`` reads them."""
    torch = _torch()
    tensors = {name: torch.from_numpy(np.array(array, order="C")) for name, array in record.arrays.items()}
    torch.save({_ATTRIBUTES: record.attributes, **tensors}, path)


def _read_pt(path: Path) -> Record:
    content = _torch().load(path, weights_only=True, map_location="cpu")
    attributes = content.pop(_ATTRIBUTES, {})
    return Record({name: tensor.numpy() for name, tensor in content.items()}, attributes)


def _torch() -> Any:
    try:
        import torch
    except ImportError:
        raise InputError(
            ".pt files need torch, which is not installed: pip install torch, or use .h5 or .npz"
        ) from None
    return torch


_Format = tuple[Callable[[Record, Path], None], Callable[[Path], Record]]
_FORMATS: dict[str, _Format] = {
    ".h5": (_write_hdf5, _read_hdf5),
    ".hdf5": (_write_hdf5, _read_hdf5),
    ".npz": (_write_npz, _read_npz),
    ".pt": (_write_pt, _read_pt),
}
FORMATS = tuple(_FORMATS)


def _format(path: Path) -> _Format:
    try:
        return _FORMATS[path.suffix.lower()]
    except KeyError:
        raise InputError(f"{path}: expected a name ending in {', '.join(FORMATS)}") from None
