"""Read and write numpy's files: .npz archives with the exact affine; read bare .npy arrays."""

import io
from pathlib import Path
from typing import Any

import numpy as np

from ...arrays import Array
from ...errors import InputError
from ..volume import Volume
from .contents import VolumeFileContents


def read(path: Path) -> VolumeFileContents:
    """Read a .npz file with the arrays array, affine, quantity and optionally unit, or a .npy file, without an affine."""
    arrays = load(path, {"array", "affine", "quantity", "unit"})
    if path.suffix.lower() == ".npy":
        return VolumeFileContents(arrays[""], None)
    missing = {"array", "affine", "quantity"} - set(arrays)
    if missing:
        raise InputError(f"expected the arrays array, affine and quantity; {', '.join(sorted(missing))} not found")
    unit = str(arrays["unit"]) if "unit" in arrays else None
    return VolumeFileContents(arrays["array"], arrays["affine"], str(arrays["quantity"]), unit)


def write(volume: Volume, temporary: Path) -> None:
    """Write a volume as .npz to the path `temporary`."""
    arrays = {"array": volume.array, "affine": volume.grid.affine, "quantity": volume.quantity, "unit": volume.unit}
    arrays |= {"note": volume.note} if volume.note else {}
    temporary.write_bytes(pack_npz(arrays))


def pack_npz(arrays: dict[str, Any]) -> memoryview:
    """Return the bytes of a compressed .npz archive of these arrays."""
    memory = io.BytesIO()
    np.savez_compressed(memory, **arrays)  # type: ignore[arg-type]
    return memory.getbuffer()


def load(path: Path, names: set[str] | None = None) -> dict[str, Array]:
    """Return the arrays of an .npz file by name, all or those of `names`; of an .npy file its array, by the name "".

    Each member of an .npz is read to its end, where its checksum is.
    """
    with open(path, "rb") as file:  # not opened by numpy, which leaves a damaged archive open
        begin = file.read(6)
        if not begin.startswith((b"\x93NUMPY", b"PK")):  # numpy would take other bytes for pickled objects
            raise InputError("not a file of numpy")
        if (is_single := begin == b"\x93NUMPY") != (path.suffix.lower() == ".npy"):
            kinds = ("a single array", "an npz archive")
            raise InputError("expected {}, found {}".format(*(kinds[::-1] if is_single else kinds)))
        if is_single:  # mapped, so that its size is compared with the file's before memory is taken
            return {"": np.array(np.load(path, mmap_mode="r", allow_pickle=False))}
        file.seek(0)
        archive, arrays = np.load(file, allow_pickle=False), {}
        for name in archive.files if names is None else names.intersection(archive.files):
            with archive.zip.open(f"{name}.npy") as member:
                arrays[name] = np.lib.format.read_array(member, allow_pickle=False)  # type: ignore[no-untyped-call]
                if member.read(1):
                    raise InputError(f"{name}: expected nothing behind its array")
        return arrays
