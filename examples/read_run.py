"""Load a batch of projections and volumes from a run, as a training script would.

    python read_run.py run.h5

A run is one HDF5 file; `h5py.File(path)["projections"][m]` reads only one view. ``mphdrr export run.h5 -o run.pt`` writes
it as .pt, which loads with ``torch.load("run.pt", weights_only=True)``.
"""

from __future__ import annotations

import sys

import h5py
import numpy as np


def load_batch(path: str, modules: np.ndarray) -> dict[str, np.ndarray]:
    """Return projections (B, 1, n_v, n_u), projection matrices (B, 3, 4) and the volume of the views `modules`."""
    with h5py.File(path) as file:
        return {
            "projections": np.stack([file["projections"][m] for m in modules])[:, None],
            "matrices": file["geometry/projection_matrix"][()][modules],
            "volume": file["volume/array"][()],
        }


if __name__ == "__main__":
    path = sys.argv[1] if len(sys.argv) > 1 else "out/run.h5"
    with h5py.File(path) as file:
        print(file.attrs["conventions"])
        count = len(file["projections"])
    batch = load_batch(path, np.random.default_rng(0).choice(count, size=min(8, count), replace=False))
    for name, array in batch.items():
        print(f"{name:12s} {array.dtype} {array.shape}, mean {array.mean():.4g}")
