"""Read and write files of reconstructions, from which these can be resumed."""

import json
from typing import Any

import numpy as np

from ..errors import InputError, reading
from ..files import AnyPath, require_ending, write_bytes
from ..hdf5 import opened, pack, read_numbers
from ..validation import instance, require_finite
from ..volumes.formats import hdf5
from ..volumes.volume_files import read_volume
from .result import Reconstruction

_FORMAT_VERSION = 1
_GROUP = "reconstruction"
_ENDINGS = (".h5", ".hdf5")


def write_reconstruction(result: Reconstruction, path: AnyPath) -> None:
    """Write a reconstruction as HDF5 (.h5, .hdf5), with everything that is needed to resume it.

    `read_volume` reads the volume of such a file. Raise `InputError` for another ending, or if the file cannot be written;
    an existing file is then left unchanged.
    """
    require_ending(path, _ENDINGS)
    instance(result, Reconstruction, "write_reconstruction")

    def write_contents(file: Any) -> None:
        """Write the volume and everything that is needed to resume into an open ``h5py.File``."""
        hdf5.write_datasets(result.volume, file)
        group = file.create_group(_GROUP)
        group.attrs.update(format_version=_FORMAT_VERSION, settings=json.dumps(dict(result.settings)))
        group["objective"] = result.objective
        for name, array in result.state.items():
            group[f"state/{name}"] = array

    write_bytes(path, pack("mphDRR reconstruction", {}, write_contents))


def read_reconstruction(path: AnyPath) -> Reconstruction:
    """Read a file of `write_reconstruction`; raise `InputError` if it is missing, or holds no complete reconstruction."""
    import h5py

    require_ending(path, _ENDINGS)
    volume = read_volume(path)
    with reading(path, "a reconstruction"), opened(path, whole=True) as file:
        group = file.get(_GROUP)
        if not isinstance(group, h5py.Group):
            raise InputError("it holds a volume, but no reconstruction: use it as start with read_volume")
        if int(group.attrs["format_version"]) > _FORMAT_VERSION:
            raise InputError(f"written by a newer mphDRR (format {group.attrs['format_version']}); update to read it")
        objective = np.asarray(read_numbers(group["objective"]), np.float64)
        state = {name: read_numbers(array) for name, array in group.get("state", {}).items()}
        if objective.ndim != 1:
            raise InputError(f"objective: expected one number for each iteration, got {objective.ndim} axes")
        for name, array in (("objective", objective), *state.items()):
            require_finite(array, name)
        return Reconstruction(volume, objective, json.loads(group.attrs["settings"]), state)
