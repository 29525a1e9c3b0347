"""Runs as HDF5: arrays as datasets with a `unit`, attributes on the root."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from .record import Record

# Below this many bytes compressing costs more than it saves.
_COMPRESS_FROM = 1 << 16


def write(record: Record, path: Path) -> None:
    """Write `record` to `path`; projections are chunked a view at a time, so that one view reads alone."""
    import h5py

    with h5py.File(path, "w") as file:
        file.attrs.update(record.attributes)
        for name, array in record.arrays.items():
            packed = {}
            if array.nbytes >= _COMPRESS_FROM:
                packed = {
                    "chunks": (1, *array.shape[1:]),
                    "compression": "gzip",
                    "compression_opts": 1,
                    "shuffle": True,
                }
            dataset = file.create_dataset(name, data=array, **packed)
            dataset.attrs["unit"] = record.unit(name)


def read(path: Path) -> Record:
    """Read what `write` wrote."""
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
