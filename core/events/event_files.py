"""File of one event: HDF5 that any reader opens, behind a seal with checksums of all bytes (`core/hdf5.py`)."""

import itertools
import json
import os
import zlib
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .. import hdf5
from ..arrays import Array, Floats32
from ..errors import InputError, naming
from ..geometry.grid import Grid
from ..memory import cores
from ..runs.run import versions
from ..version import build
from ..volumes.volume import Volume
from .event_maker import EventArrays
from .recipe import EventRecipe

VERSION = 2
"""Version of the file format."""
_KIND = "mphDRR event"
_MIN_COMPRESSED = 1 << 13  # bytes of an array: compressing smaller ones costs more than it saves
_BLOCK_SIDE = 32  # voxels along each axis of a chunk of the truth; chunks of zeros are not stored
_LIST_CHUNK = 1 << 18  # numbers in a chunk of a one-dimensional dataset
_COMPRESSION: dict[str, Any] = {"compression": "gzip", "compression_opts": 1, "shuffle": True}

try:
    from zlib_ng.zlib_ng import decompress as inflate
except ImportError:  # zlib_ng is only faster, by a factor of two
    from zlib import decompress as inflate

CONVENTIONS = (
    "Lengths in mm. World: right-handed, origin at the isocentre, +z along the patient. "
    "truth[ix, iy, iz]: truth_affine from index to world, an integer index is the voxel's centre. "
    "images/NAME[m, row, column]: expected means; column along the module's +u, row along +v. "
    "pose: world-from-phantom, acting on column vectors; placement: the same with mirroring and size. "
    "geometry/projection_matrix @ (x, y, z, 1) is a multiple of (column, row, 1). "
    "radon/N[i, row, column]: N angles i / N of radon_over_degrees; columns along (sin phi, -cos phi, 0), rows along +z. "
    "Stored numbers times the attribute scale, where there is one, are the values."
)


class FileLocation(NamedTuple):
    """Location of an event's file: a file of its own, or a range of bytes within a shard."""

    path: str  # path on the disk; text, since making a hundred thousand `Path` objects takes half a second
    offset: int = 0  # first byte within that file
    size: int | None = None  # bytes; None: up to the end of the file


class Header(NamedTuple):
    """Header of an event's file, from the seal at its beginning."""

    event: int  # number of the event
    recipe: str  # fingerprint of the recipe
    size: int  # bytes of the event's file
    build: str = ""  # build of mphDRR that made the file (`version.build`); empty in files of version 0.1


def read_header(location: FileLocation) -> Header:
    """Read the header of an event's file; `InputError` where it is no event, or has another size than the header states."""
    path, offset, size = location
    try:
        with open(path, "rb", buffering=0) as file:
            size = os.fstat(file.fileno()).st_size if size is None else size
            if offset:
                file.seek(offset)
            seal = hdf5.parse_seal(file.read(hdf5.HEADER))
    except (OSError, InputError) as error:  # not by `naming`, which is slow for a hundred thousand files
        raise InputError(f"{path}: {getattr(error, 'strerror', None) or error}") from None
    if seal is None or seal.kind != _KIND or "recipe" not in seal.fields:
        raise InputError(f"{path}: not an event of mphDRR")
    if size != seal.file_size:
        raise InputError(f"{path}: cut: {size} of {seal.file_size} bytes")
    return Header(int(seal.fields.get("event", -1)), seal.fields["recipe"], size, seal.fields.get("build", ""))


def verify(location: FileLocation) -> Header:
    """Check every byte of an event's file against its checksums and return its header; `InputError` names the damage."""
    checked = read_header(location)
    with naming(location.path):
        hdf5.verify(location.path, location.offset)
    return checked


def pack(event: EventArrays, recipe: EventRecipe, geometry: dict[str, Any], threads: int | None = None) -> memoryview:
    """Return the bytes of an event's file, which are the same for the same event and the same versions of all packages.

    `geometry` holds small arrays with their units, by name, for the group ``geometry``. `threads` compress the arrays, by
    default one per core.
    """
    planned = event.planned
    small_arrays = {
        "pose": (planned.pose, "mm"), "placement": (planned.placement, "mm"),
        "position": (np.array(planned.position), "mm"),
        "euler_angles": (np.deg2rad(planned.euler_degrees), "rad"),
        "euler_degrees": (np.array(planned.euler_degrees), "degrees"),
        "truth_affine": (event.truth.grid.affine, "mm"), "module_gain": (event.gains, "1"),
        **{f"geometry/{name}": value for name, value in geometry.items()},
    }  # fmt: skip

    def write_contents(file: Any) -> None:
        """Write all attributes and datasets of the event into an open HDF5 file."""
        file.attrs.update({
            "format": _KIND, "format_version": VERSION, "conventions": CONVENTIONS, "recipe_sha256": recipe.fingerprint,
            "event": planned.number, "phantom": planned.name, "split": planned.split or "",
            "settings": json.dumps(planned.all_settings), "mirror": planned.mirror, "size": planned.size,
            "activity_factor": planned.activity_factor, "noise_seed": planned.noise_seed, "seed": recipe.seed,
            "radon_over_degrees": 0.0 if recipe.radon is None else recipe.radon.degrees,
            "warnings": json.dumps(event.warnings), "versions": json.dumps(versions()),
        })  # fmt: skip
        for name, (array, unit) in small_arrays.items():
            file.create_dataset(name, data=array).attrs["unit"] = unit
        _write_truth(file, event.truth, recipe, pool)
        image_arrays = [(f"images/{name}", images, event.units[name]) for name, images in event.images.items()]
        image_arrays += [(f"radon/{count}", images, f"{event.truth.unit} mm") for count, images in event.radon.items()]
        for name, images, unit in image_arrays:  # a chunk for each image, so that one can be read alone
            _write_dataset(file, name, images, recipe["storage.images"], (1, *images.shape[1:]), pool, {"unit": unit})

    with ThreadPoolExecutor(threads or cores()) as pool:
        fields = {"event": str(planned.number), "recipe": recipe.fingerprint, "build": build()}
        return hdf5.pack(_KIND, fields, write_contents)


def _write_truth(file: Any, truth: Volume, recipe: EventRecipe, pool: ThreadPoolExecutor) -> None:
    """Write the truth as the recipe stores it: in single or half precision, or only its values that are not 0."""
    array, storage = truth.array, recipe["truth.store"]
    attributes: dict[str, Any] = {"unit": truth.unit, "quantity": truth.quantity}
    if storage != "sparse":
        block_shape = tuple(min(n, _BLOCK_SIDE) for n in array.shape)
        _write_dataset(file, "truth", array, storage, block_shape, pool, attributes)
        return
    flat = array.reshape(-1)
    threshold = recipe["truth.below"] * float(np.abs(flat).max(initial=0.0))
    stored = np.flatnonzero(np.abs(flat) > threshold) if threshold > 0 else np.flatnonzero(flat)
    error = float(np.abs(np.delete(flat, stored)).max(initial=0.0)) if threshold > 0 else 0.0
    index = stored.astype(np.uint32 if flat.size <= 1 << 32 else np.uint64)
    chunk = (max(1, min(len(index), _LIST_CHUNK)),)
    attributes |= {"error": error, "shape": array.shape}
    _write_dataset(file, "truth_values", flat[stored], "float32", chunk, pool, attributes)
    _write_dataset(file, "truth_index", index, str(index.dtype), chunk, pool, {"unit": "1"})


def _write_dataset(
    file: Any, name: str, array: Array, storage: str, chunk: tuple[int, ...], pool: ThreadPoolExecutor,
    attributes: dict[str, Any],
) -> None:  # fmt: skip
    """Write an array as a dataset, compressed in threads as HDF5 itself would do it in one; skip chunks of zeros.

    HDF5 shuffles a chunk (all first bytes of its numbers, then all second bytes, ...) and deflates it.
    """
    if storage == "float16":
        array, scale_attributes = _to_half(array)
        attributes = attributes | scale_attributes
    dtype = np.dtype(array.dtype).newbyteorder("<")
    if array.nbytes < _MIN_COMPRESSED:
        dataset = file.create_dataset(name, data=array.astype(dtype, copy=False))
    else:
        dataset = file.create_dataset(name, array.shape, dtype, chunks=chunk, **_COMPRESSION)
        corners = list(_chunk_corners(array.shape, chunk))

        def compress_chunk(corner: tuple[int, ...]) -> bytes | None:
            """Return the stored bytes of the chunk that begins at `corner`; None where it holds only zeros."""
            block = array[tuple(slice(i, i + m) for i, m in zip(corner, chunk, strict=True))]
            if not block.any():
                return None
            full_block = block if block.shape == chunk else np.zeros(chunk, array.dtype)
            if full_block is not block:  # chunks at the array's end are padded with zeros
                full_block[tuple(map(slice, block.shape))] = block
            shuffled = np.ascontiguousarray(full_block, dtype).view(np.uint8).reshape(-1, dtype.itemsize)
            return zlib.compress(shuffled.T.tobytes(), 1)

        for corner, data in zip(corners, pool.map(compress_chunk, corners), strict=True):
            if data is not None:
                dataset.id.write_direct_chunk(corner, data)
    dataset.attrs.update(attributes)


def _to_half(array: Array) -> tuple[NDArray[np.float16], dict[str, float]]:
    """Convert an array to half precision, scaled by a power of 2 to use its range.

    Return the halves and the attributes "scale" (values = halves x scale) and "error", the largest absolute error.
    """
    largest = float(np.abs(array).max(initial=0.0))
    scale = 2.0 ** (int(np.frexp(largest)[1]) - 15) if largest else 1.0
    halved = (array * np.float32(1 / scale)).astype(np.float16)
    error = float(np.abs(halved.astype(np.float32) * np.float32(scale) - array).max(initial=0.0))
    return halved, {"scale": scale, "error": error}


def read_array(file: Any, name: str, region: tuple[slice, ...] = (), out: Floats32 | None = None) -> Floats32:
    """Read a dataset, or a region of it, as float32, into `out` where that is given: an array of zeros.

    `region` has a slice without step for each axis; an empty one stands for the whole dataset.
    """
    dataset = file[name]
    region = region or (slice(None),) * len(dataset.shape)
    bounds = [span.indices(n)[:2] for span, n in zip(region, dataset.shape, strict=True)]
    shape = tuple(max(0, stop - start) for start, stop in bounds)
    if out is None:
        out = np.zeros(shape, np.float32)
    scale = np.float32(dataset.attrs.get("scale", 1))
    if dataset.compression != "gzip" or not dataset.shuffle or dataset.dtype.kind != "f":
        np.multiply(dataset[region], scale, out=out, casting="unsafe")
        return out
    chunk = dataset.chunks
    for corner in _chunk_corners(dataset.shape, chunk, bounds):
        if dataset.id.get_chunk_info_by_coord(corner).byte_offset is None:  # a chunk of zeros is not stored
            continue
        block = _inflate_chunk(dataset.id.read_direct_chunk(corner)[1], dataset.dtype).reshape(chunk)
        overlap = [(max(i, a), min(i + m, b)) for i, m, (a, b) in zip(corner, chunk, bounds, strict=True)]
        source = tuple(slice(a - i, b - i) for i, (a, b) in zip(corner, overlap, strict=True))
        target = tuple(slice(a - start, b - start) for (start, _), (a, b) in zip(bounds, overlap, strict=True))
        np.multiply(block[source], scale, out=out[target], casting="unsafe")
    return out


def _inflate_chunk(data: bytes, dtype: np.dtype[Any]) -> Array:
    """Return the numbers of a stored chunk, inflated and unshuffled as HDF5 does it, in a quarter of its time."""
    planes = np.frombuffer(inflate(data), np.uint8).reshape(dtype.itemsize, -1)
    bits = planes[-1].astype(f"<u{dtype.itemsize}")
    for plane in planes[-2::-1]:
        bits <<= 8
        bits |= plane
    return bits.view(dtype)


def _chunk_corners(
    shape: Sequence[int], chunk: Sequence[int], bounds: Sequence[tuple[int, int]] | None = None
) -> Iterator[tuple[int, ...]]:
    """Return the first indices of the chunks of an array, or of those that reach into `bounds` (start, stop) per axis."""
    bounds = [(0, n) for n in shape] if bounds is None else bounds
    axes = [range(start // m * m, stop, m) for m, (start, stop) in zip(chunk, bounds, strict=True)]
    return itertools.product(*axes)


def read_truth(file: Any, grid: Grid, region: tuple[slice, ...] = (), out: Floats32 | None = None) -> Floats32:
    """Read the truth (n_x, n_y, n_z), or a region of it, from an open event's file; arguments as for `read_array`."""
    if "truth" in file:
        return read_array(file, "truth", region, out)
    values = np.zeros(grid.n_voxels, np.float32)
    values[hdf5.read_numbers(file["truth_index"])] = hdf5.read_numbers(file["truth_values"])
    region_values = values.reshape(grid.shape)[region]
    if out is None:
        return region_values
    out[...] = region_values
    return out
