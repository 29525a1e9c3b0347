"""numpy's files: npz with the exact affine, and bare npy arrays."""

from pathlib import Path

import numpy as np

from ...errors import InputError
from ..volume import Volume
from .contents import Contents


def read(path: Path) -> Contents:
    """Read .npz with the arrays array, affine, quantity and optionally unit; or .npy, which has no affine."""
    with open(path, "rb") as opened:  # not by numpy, which leaves a damaged archive open
        if not opened.read(6).startswith((b"\x93NUMPY", b"PK")):  # numpy would take it for pickled objects
            raise InputError("not a file of numpy")
        opened.seek(0)
        file = np.load(opened, allow_pickle=False)
        if path.suffix.lower() == ".npy":
            if not isinstance(file, np.ndarray):
                raise InputError("expected a single array, found an npz archive")
            return Contents(file, None)
        if not isinstance(file, np.lib.npyio.NpzFile):
            raise InputError("expected an npz archive, found a single array")
        missing = {"array", "affine", "quantity"} - set(file.files)
        if missing:
            raise InputError(f"expected the arrays array, affine and quantity; {', '.join(sorted(missing))} not found")
        unit = str(file["unit"]) if "unit" in file.files else None
        return Contents(file["array"], file["affine"], str(file["quantity"]), unit)


def write(volume: Volume, path: Path) -> None:
    """Write .npz."""
    arrays = {"array": volume.array, "affine": volume.grid.affine, "quantity": volume.quantity, "unit": volume.unit}
    with open(path, "wb") as file:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]
