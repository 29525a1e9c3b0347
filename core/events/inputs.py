"""Files that a recipe names: read once, copied into the set, and identified by the SHA-256 of their content."""

import hashlib
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import InputError, refusing
from ..files import write_bytes
from ..runs.run_recipe import read_mu
from ..volumes.volume import Volume
from ..volumes.volume_files import read_volume, read_volume_of, write_volume


@dataclass(frozen=True)
class Input:
    """A file that a recipe names, or a set's copy of it."""

    path: Path
    """Path of the file, or of a folder of DICOM files."""
    content: str
    """Way to read it: "copy" for plain bytes; for a volume its quantity, "activity", "mu", or "mu at 60" for CT numbers
    converted at 60 keV."""
    sha256: str
    """SHA-256 of a plain file's bytes, or of a volume's values, affine and quantity."""
    is_copy: bool = False
    """Whether the file is the set's copy."""

    def volume(self) -> Volume:
        """Return the volume in the file."""
        return read_volume(self.path) if self.is_copy else _read_original(self.path, self.content)

    def copy_to(self, folder: Path) -> "Input":
        """Copy into a folder and return the copy: the same bytes of a plain file, an HDF5 file of a volume."""
        stem, ending = (self.path.stem, self.path.suffix) if self.content == "copy" else (_stem(self.path), ".h5")
        target, number = folder / f"{stem}{ending}", 1
        while target.exists():
            if _sha256(target, self.content, True) == self.sha256:  # another process has copied it meanwhile
                return Input(target, self.content, self.sha256, True)
            number += 1
            target = folder / f"{stem}-{number}{ending}"
        if self.content == "copy":
            write_bytes(target, self.path.read_bytes())
        else:
            write_volume(self.volume(), target)
        return Input(target, self.content, self.sha256, True)

    def current_sha256(self) -> str:
        """Return the SHA-256 of the file's present content, as in `sha256`; `InputError` where it cannot be read."""
        return _sha256(self.path, self.content, self.is_copy)


def original_input(name: str, folder: Path, content: str) -> Input:
    """Return the file of a name in a recipe, relative to the recipe's folder; `InputError` where there is none."""
    path = Path(os.path.normpath(folder / name))
    if not path.exists():
        raise InputError(f"{path}: no such file")
    return Input(path, content, _sha256(path, content, False))


def _sha256(path: Path, content: str, is_copy: bool) -> str:
    """Return the SHA-256 of a plain file's bytes, or of a volume's values, affine and quantity."""
    if content == "copy":
        with refusing(path, "cannot be read"):
            return hashlib.sha256(path.read_bytes()).hexdigest()
    volume = read_volume(path) if is_copy else _read_original(path, content)
    digest = hashlib.sha256(f"{volume.quantity} {volume.grid.shape}".encode())
    digest.update(np.ascontiguousarray(volume.grid.affine, "<f8").tobytes())
    digest.update(np.ascontiguousarray(volume.array, "<f4").tobytes())
    return digest.hexdigest()


def _read_original(path: Path, content: str) -> Volume:
    """Read the volume in a user's file as the quantity that `content` names."""
    quantity, _, energy = content.partition(" at ")
    return read_mu(path, energy or None) if quantity == "mu" else read_volume_of(path, quantity)


def _stem(path: Path) -> str:
    """Return the file name of a volume without its ending, .nii.gz included."""
    name = path.name
    return name[: -len(".nii.gz")] if name.lower().endswith(".nii.gz") else path.stem
