"""Read and write volumes as HDF5: datasets ``array`` (attributes quantity and unit) and ``affine``; also of run files."""

from functools import partial
from pathlib import Path
from typing import Any

from ...errors import InputError
from ...hdf5 import opened, pack, read_numbers
from ..volume import Volume
from .contents import VolumeFileContents, require_voxels


def read(path: Path) -> VolumeFileContents:
    """Read a .h5 or .hdf5 file: the volume at its root, or in the group ``volume`` of a run file."""
    import h5py

    with opened(path, whole=True) as file:
        group = file["volume"] if isinstance(file.get("volume"), h5py.Group) else file
        array, affine = group.get("array"), group.get("affine")
        for name, dataset in (("array", array), ("affine", affine)):
            if not isinstance(dataset, h5py.Dataset):
                members = ", ".join(group) or "nothing"
                raise InputError(f"expected the datasets array and affine; {name} not found (there are: {members})")
        require_voxels(array.shape, array.dtype)
        quantity = _attribute_text(array.attrs.get("quantity", file.attrs.get("volume_quantity")))
        length_unit, unit = (_attribute_text(dataset.attrs.get("unit")) for dataset in (affine, array))
        if length_unit not in (None, "mm"):
            raise InputError(f"its affine is in {length_unit}: expected mm")
        return VolumeFileContents(read_numbers(array), read_numbers(affine), quantity, unit)


def _attribute_text(attribute: Any) -> str | None:
    """Return an attribute's text, which programs write as bytes or str; None for a missing attribute."""
    return attribute.decode() if isinstance(attribute, bytes) else None if attribute is None else str(attribute)


def write(volume: Volume, temporary: Path) -> None:
    """Write a volume as .h5 or .hdf5 to the path `temporary`."""
    temporary.write_bytes(pack("mphDRR volume", {}, partial(write_datasets, volume)))


def write_datasets(volume: Volume, file: Any) -> None:
    """Write the volume's datasets into the root of an open ``h5py.File``."""
    array = file.create_dataset("array", data=volume.array, compression="gzip", compression_opts=1, shuffle=True)
    array.attrs.update(quantity=volume.quantity, unit=volume.unit, **({"note": volume.note} if volume.note else {}))
    description = "index to world, on column vectors; an integer index is a voxel's centre"
    file.create_dataset("affine", data=volume.grid.affine).attrs.update(unit="mm", description=description)
