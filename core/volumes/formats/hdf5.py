"""HDF5: datasets ``array``, with the attributes quantity and unit, and ``affine``. Run files are read, too."""

from functools import partial
from pathlib import Path
from typing import Any

from ...errors import InputError
from ...hdf5 import opened, pack, read_numbers
from ..volume import Volume
from .contents import Contents, require_voxels


def read(path: Path) -> Contents:
    """Read .h5 or .hdf5: the volume at the file's root, or in the group ``volume`` of a run file."""
    import h5py

    with opened(path, whole=True) as file:
        place = file["volume"] if isinstance(file.get("volume"), h5py.Group) else file
        array, affine = place.get("array"), place.get("affine")
        for name, dataset in (("array", array), ("affine", affine)):
            if not isinstance(dataset, h5py.Dataset):
                found = ", ".join(place) or "nothing"
                raise InputError(f"expected the datasets array and affine; {name} not found (there are: {found})")
        require_voxels(array.shape, array.dtype)
        quantity = _text(array.attrs.get("quantity", file.attrs.get("volume_quantity")))
        length, unit = (_text(dataset.attrs.get("unit")) for dataset in (affine, array))
        if length not in (None, "mm"):
            raise InputError(f"its affine is in {length}: expected mm")
        return Contents(read_numbers(array), read_numbers(affine), quantity, unit)


def _text(attribute: Any) -> str | None:
    """The text of an attribute, as any program writes it; None where there is none."""
    return attribute.decode() if isinstance(attribute, bytes) else None if attribute is None else str(attribute)


def write(volume: Volume, temporary: Path) -> None:
    """Write .h5 or .hdf5."""
    temporary.write_bytes(pack("mphDRR volume", {}, partial(fill, volume)))


def fill(volume: Volume, file: Any) -> None:
    """Put the volume into the root of an ``h5py.File``, open for writing."""
    array = file.create_dataset("array", data=volume.array, compression="gzip", compression_opts=1, shuffle=True)
    array.attrs.update(quantity=volume.quantity, unit=volume.unit, **({"note": volume.note} if volume.note else {}))
    file.create_dataset("affine", data=volume.grid.affine).attrs.update(
        unit="mm", description="index to world, on column vectors; an integer index is a voxel's centre"
    )
