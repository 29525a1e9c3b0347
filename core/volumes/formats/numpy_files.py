"""numpy's files: npz with the exact affine, and bare npy arrays."""

import io
from pathlib import Path
from typing import Any

import numpy as np

from ...arrays import Array
from ...errors import InputError
from ..volume import Volume
from .contents import Contents


def read(path: Path) -> Contents:
    """Read .npz with the arrays array, affine, quantity and optionally unit; or .npy, which has no affine."""
    arrays = load(path, {"array", "affine", "quantity", "unit"})
    if path.suffix.lower() == ".npy":
        return Contents(arrays[""], None)
    missing = {"array", "affine", "quantity"} - set(arrays)
    if missing:
        raise InputError(f"expected the arrays array, affine and quantity; {', '.join(sorted(missing))} not found")
    unit = str(arrays["unit"]) if "unit" in arrays else None
    return Contents(arrays["array"], arrays["affine"], str(arrays["quantity"]), unit)


def write(volume: Volume, temporary: Path) -> None:
    """Write .npz."""
    arrays = {"array": volume.array, "affine": volume.grid.affine, "quantity": volume.quantity, "unit": volume.unit}
    arrays |= {"note": volume.note} if volume.note else {}
    temporary.write_bytes(packed(arrays))


def packed(arrays: dict[str, Any]) -> memoryview:
    """The bytes of an .npz of these arrays, compressed."""
    memory = io.BytesIO()
    np.savez_compressed(memory, **arrays)  # type: ignore[arg-type]
    return memory.getbuffer()


def load(path: Path, wanted: set[str] | None = None) -> dict[str, Array]:
    """The arrays of an .npz by name, or those that are `wanted`; of an .npy its array, with the name "".

    Each member of an .npz is read to its end, where its checksum is.
    """
    with open(path, "rb") as opened:  # not by numpy, which leaves a damaged archive open
        if not opened.read(6).startswith((b"\x93NUMPY", b"PK")):  # numpy would take it for pickled objects
            raise InputError("not a file of numpy")
        opened.seek(0)
        found = np.load(opened, allow_pickle=False)
        is_single = isinstance(found, np.ndarray)
        if is_single != (path.suffix.lower() == ".npy"):
            kinds = ("a single array", "an npz archive")
            raise InputError("expected {}, found {}".format(*(kinds[::-1] if is_single else kinds)))
        if is_single:
            return {"": found}
        arrays = {}
        for name in found.files if wanted is None else wanted.intersection(found.files):
            with found.zip.open(f"{name}.npy") as member:
                arrays[name] = np.lib.format.read_array(member, allow_pickle=False)  # type: ignore[no-untyped-call]
                if member.read(1):
                    raise InputError(f"{name}: expected nothing behind its array")
        return arrays
