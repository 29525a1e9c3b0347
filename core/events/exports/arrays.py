"""Arrays of an event as the bytes of files; the same arrays are the same bytes."""

import io
from collections.abc import Mapping
from typing import Any

import numpy as np

from ...arrays import Array
from ...errors import needing


def npy(array: Array) -> bytes:
    """An array as an .npy file."""
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=False)
    return buffer.getvalue()


def pt(array: Array) -> bytes:
    """An array as a .pt file: one tensor, which ``torch.load(path, weights_only=True)`` gives."""
    with needing(feature="files of tensors (.pt)"):
        import torch
    buffer = io.BytesIO()  # torch writes a file's own name into it, and that of a temporary one is random
    torch.save(torch.from_numpy(np.array(array, order="C")), buffer)
    return buffer.getvalue()


def hdf5(arrays: Mapping[str, Array], attributes: Mapping[str, Any]) -> bytes:
    """Arrays as an HDF5 file, compressed, a chunk for each of their last two axes' pictures."""
    import h5py

    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as file:
        file.attrs.update(attributes)
        for name, array in arrays.items():
            chunks = (1,) * (array.ndim - 2) + array.shape[-2:]
            file.create_dataset(name, data=array, chunks=chunks, compression="gzip", compression_opts=1, shuffle=True)
    return buffer.getvalue()
