"""The files that a recipe names: read once, kept as copies in the set, known by what they hold."""

import hashlib
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..files import write_bytes
from ..runs.run_recipe import read_mu
from ..volumes.volume import Volume
from ..volumes.volume_files import read_volume, read_volume_of, write_volume


@dataclass(frozen=True)
class Input:
    """A file that the recipe names, or a set's copy of it."""

    path: Path
    what: str  # "copy" for a file as it is; of a volume its quantity, "activity", "mu" or "mu at 60" (from CT numbers)
    sha256: str  # of a file's bytes; of a volume's numbers, places and quantity
    is_copy: bool = False

    def volume(self) -> Volume:
        """The volume in it."""
        return read_volume(self.path) if self.is_copy else _volume(self.path, self.what)

    def copy_to(self, folder: Path) -> "Input":
        """A copy in a folder: of a file its bytes, of a volume, which may be a folder of DICOM files, an HDF5 file."""
        stem, ending = (self.path.stem, self.path.suffix) if self.what == "copy" else (_stem(self.path), ".h5")
        target, number = folder / f"{stem}{ending}", 1
        while target.exists():
            if _hash(target, self.what, True) == self.sha256:  # another shard was faster
                return Input(target, self.what, self.sha256, True)
            number += 1
            target = folder / f"{stem}-{number}{ending}"
        if self.what == "copy":
            write_bytes(target, self.path.read_bytes())
        else:
            write_volume(self.volume(), target)
        return Input(target, self.what, self.sha256, True)

    def current_sha256(self) -> str:
        """What `sha256` is of the file as it is now; `InputError` where it cannot be read."""
        return _hash(self.path, self.what, self.is_copy)


def original_input(name: str, folder: Path, what: str) -> Input:
    """A file by its name in a recipe, relative to a folder."""
    path = Path(os.path.normpath(folder / name))
    if not path.exists():
        raise InputError(f"{path}: no such file")
    return Input(path, what, _hash(path, what, False))


def _hash(path: Path, what: str, is_copy: bool) -> str:
    if what == "copy":
        try:
            return hashlib.sha256(path.read_bytes()).hexdigest()
        except OSError as error:
            raise InputError(f"{path}: {error.strerror or error}") from None
    volume = read_volume(path) if is_copy else _volume(path, what)
    found = hashlib.sha256(f"{volume.quantity} {volume.grid.shape}".encode())
    found.update(np.ascontiguousarray(volume.grid.affine, "<f8").tobytes())
    found.update(np.ascontiguousarray(volume.array, "<f4").tobytes())
    return found.hexdigest()


def _volume(path: Path, what: str) -> Volume:
    """The volume in a user's file."""
    quantity, _, energy = what.partition(" at ")
    return read_mu(path, energy or None) if quantity == "mu" else read_volume_of(path, quantity)


def _stem(path: Path) -> str:
    name = path.name
    return name[: -len(".nii.gz")] if name.lower().endswith(".nii.gz") else path.stem
