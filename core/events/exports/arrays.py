"""Conversion of arrays to the bytes of files; equal arrays give equal bytes."""

import io
from collections.abc import Mapping
from typing import Any

import numpy as np

from ...arrays import Array
from ...errors import needing


def npy_bytes(array: Array) -> bytes:
    """Return the bytes of an .npy file of an array."""
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=False)
    return buffer.getvalue()


def pt_bytes(array: Array) -> bytes:
    """Return the bytes of a .pt file of an array: one tensor, which ``torch.load(path, weights_only=True)`` reads."""
    with needing(feature="files of tensors (.pt)"):
        import torch
    buffer = io.BytesIO()  # torch writes a file's own name into it, and that of a temporary one is random
    torch.save(torch.from_numpy(np.array(array, order="C")), buffer)
    return buffer.getvalue()


def hdf5_bytes(arrays: Mapping[str, Array], attributes: Mapping[str, Any]) -> bytes:
    """Return the bytes of an HDF5 file of arrays by name, compressed, each image (the last two axes) a chunk."""
    import h5py

    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as file:
        file.attrs.update(attributes)
        for name, array in arrays.items():
            chunks = (1,) * (array.ndim - 2) + array.shape[-2:]
            file.create_dataset(name, data=array, chunks=chunks, compression="gzip", compression_opts=1, shuffle=True)
    return buffer.getvalue()
