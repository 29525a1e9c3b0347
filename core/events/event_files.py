"""The file of one event: HDF5 that any reader opens, with a seal that says what every byte must be (`core/hdf5.py`)."""

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
_KIND = "mphDRR event"
_COMPRESS_FROM = 1 << 13  # bytes: below, compressing costs more than it saves
_BRICK = 32  # voxels along each axis of the truth's chunks, which are left out where they are empty
_PIECE = 1 << 18  # numbers in a chunk of a list
_PACKED: dict[str, Any] = {"compression": "gzip", "compression_opts": 1, "shuffle": True}


try:
    from zlib_ng.zlib_ng import decompress as inflate
except ImportError:  # twice as fast, and nothing else
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


class Place(NamedTuple):
    """Where the file of an event is: alone, or within another file."""

    path: str  # no Path, of which a hundred thousand take half a second
    offset: int = 0
    size: int | None = None  # bytes; None: as many as the file has


class Header(NamedTuple):
    """What the text at the beginning of an event's file says."""

    event: int
    recipe: str  # fingerprint
    size: int  # bytes of the whole file
    build: str = ""  # that made it (`version.build`); empty of sets of earlier versions


def header(place: Place) -> Header:
    """The header of an event's file; `InputError` where the file is none, or is not as long as it says."""
    path, offset, size = place
    try:
        with open(path, "rb", buffering=0) as file:
            size = os.fstat(file.fileno()).st_size if size is None else size
            if offset:
                file.seek(offset)
            seal = hdf5.parse_seal(file.read(hdf5.HEADER))
    except (OSError, InputError) as error:  # by hand, since sets have a hundred thousand
        raise InputError(f"{path}: {getattr(error, 'strerror', None) or error}") from None
    if seal is None or seal.kind != _KIND or "recipe" not in seal.fields:
        raise InputError(f"{path}: not an event of mphDRR")
    if size != seal.file_size:
        raise InputError(f"{path}: cut: {size} of {seal.file_size} bytes")
    return Header(int(seal.fields.get("event", -1)), seal.fields["recipe"], size, seal.fields.get("build", ""))


def verify(place: Place) -> Header:
    """The header of an event's file, after every byte of the file was compared with it; `InputError` says what is wrong."""
    found = header(place)
    with naming(place.path):
        hdf5.verify(place.path, place.offset)
    return found


def packed(event: EventArrays, recipe: EventRecipe, geometry: dict[str, Any], threads: int | None = None) -> memoryview:
    """The whole file of an event, the same bytes for the same event and versions.

    `geometry` holds small arrays by name, which go into the group ``geometry``.
    """
    planned = event.planned
    small = {
        "pose": (planned.pose, "mm"), "placement": (planned.placement, "mm"),
        "position": (np.array(planned.position), "mm"),
        "euler_angles": (np.deg2rad(planned.euler_degrees), "rad"),
        "euler_degrees": (np.array(planned.euler_degrees), "degrees"),
        "truth_affine": (event.truth.grid.affine, "mm"), "module_gain": (event.gains, "1"),
        **{f"geometry/{name}": value for name, value in geometry.items()},
    }  # fmt: skip

    def fill(file: Any) -> None:
        file.attrs.update({
            "format": _KIND, "format_version": VERSION, "conventions": CONVENTIONS, "recipe_sha256": recipe.fingerprint,
            "event": planned.number, "phantom": planned.name, "split": planned.split or "",
            "settings": json.dumps(planned.all_settings), "mirror": planned.mirror, "size": planned.size,
            "activity_factor": planned.activity_factor, "noise_seed": planned.noise_seed, "seed": recipe.seed,
            "radon_over_degrees": 0.0 if recipe.radon is None else recipe.radon.degrees,
            "warnings": json.dumps(event.warnings), "versions": json.dumps(versions()),
        })  # fmt: skip
        for name, (array, unit) in small.items():
            file.create_dataset(name, data=array).attrs["unit"] = unit
        _write_truth(file, event.truth, recipe, pool)
        named = [(f"images/{name}", images, event.units[name]) for name, images in event.images.items()]
        named += [(f"radon/{count}", images, f"{event.truth.unit} mm") for count, images in event.radon.items()]
        for name, images, unit in named:  # each image a chunk of its own, so that one reads alone
            _write(file, name, images, recipe["storage.images"], (1, *images.shape[1:]), pool, {"unit": unit})

    with ThreadPoolExecutor(threads or cores()) as pool:
        return hdf5.pack(_KIND, {"event": str(planned.number), "recipe": recipe.fingerprint, "build": build()}, fill)


def _write_truth(file: Any, truth: Volume, recipe: EventRecipe, pool: ThreadPoolExecutor) -> None:
    """The truth: whole, in half precision, or the values that are not 0 and their places."""
    array, store = truth.array, recipe["truth.store"]
    attributes = {"unit": truth.unit, "quantity": truth.quantity}
    if store != "sparse":
        brick = tuple(min(n, _BRICK) for n in array.shape)
        _write(file, "truth", array, store, brick, pool, attributes)
        return
    flat = array.reshape(-1)
    least = recipe["truth.below"] * float(np.abs(flat).max(initial=0.0))
    kept = np.flatnonzero(np.abs(flat) > least) if least > 0 else np.flatnonzero(flat)
    left = float(np.abs(np.delete(flat, kept)).max(initial=0.0)) if least > 0 else 0.0
    index = kept.astype(np.uint32 if flat.size <= 1 << 32 else np.uint64)
    chunk = (max(1, min(len(index), _PIECE)),)
    _write(file, "truth_values", flat[kept], "float32", chunk, pool, attributes | {"error": left, "shape": array.shape})
    _write(file, "truth_index", index, str(index.dtype), chunk, pool, {"unit": "1"})


def _write(
    file: Any, name: str, array: Array, store: str, chunk: tuple[int, ...], pool: ThreadPoolExecutor,
    attributes: dict[str, Any],
) -> None:  # fmt: skip
    """A dataset, compressed in threads as HDF5 itself would do it in one: shuffled bytes, deflated; no chunk of zeros."""
    if store == "float16":
        array, more = _halved(array)
        attributes = attributes | more
    kind = np.dtype(array.dtype).newbyteorder("<")
    if array.nbytes < _COMPRESS_FROM:
        dataset = file.create_dataset(name, data=array.astype(kind, copy=False))
    else:
        dataset = file.create_dataset(name, array.shape, kind, chunks=chunk, **_PACKED)
        places = list(_places(array.shape, chunk))

        def deflated(place: tuple[int, ...]) -> bytes | None:
            part = array[tuple(slice(i, i + m) for i, m in zip(place, chunk, strict=True))]
            if not part.any():
                return None
            whole = part if part.shape == chunk else np.zeros(chunk, array.dtype)
            if whole is not part:  # chunks at the end are filled up
                whole[tuple(map(slice, part.shape))] = part
            octets = np.ascontiguousarray(whole, kind).view(np.uint8).reshape(-1, kind.itemsize)
            return zlib.compress(octets.T.tobytes(), 1)

        for place, data in zip(places, pool.map(deflated, places), strict=True):
            if data is not None:
                dataset.id.write_direct_chunk(place, data)
    dataset.attrs.update(attributes)


def _halved(array: Array) -> tuple[NDArray[np.float16], dict[str, float]]:
    """An array in half precision, times a power of 2 that uses its range; the factor, and the largest error made."""
    largest = float(np.abs(array).max(initial=0.0))
    scale = 2.0 ** (int(np.frexp(largest)[1]) - 15) if largest else 1.0
    halved = (array * np.float32(1 / scale)).astype(np.float16)
    error = float(np.abs(halved.astype(np.float32) * np.float32(scale) - array).max(initial=0.0))
    return halved, {"scale": scale, "error": error}


def read_array(file: Any, name: str, which: tuple[slice, ...] = (), out: Floats32 | None = None) -> Floats32:
    """The numbers of a dataset in float32, or a part of them; into `out`, which holds zeros, where it is given.

    `which` are slices without steps, one for each axis or none.
    """
    dataset = file[name]
    which = which or (slice(None),) * len(dataset.shape)
    bounds = [part.indices(n)[:2] for part, n in zip(which, dataset.shape, strict=True)]
    shape = tuple(max(0, stop - start) for start, stop in bounds)
    if out is None:
        out = np.zeros(shape, np.float32)
    scale = np.float32(dataset.attrs.get("scale", 1))
    if dataset.compression != "gzip" or not dataset.shuffle or dataset.dtype.kind != "f":
        np.multiply(dataset[which], scale, out=out, casting="unsafe")
        return out
    chunk = dataset.chunks
    for place in _places(dataset.shape, chunk, bounds):
        if dataset.id.get_chunk_info_by_coord(place).byte_offset is None:  # of zeros
            continue
        part = _inflated(dataset.id.read_direct_chunk(place)[1], dataset.dtype).reshape(chunk)
        within = [(max(i, a), min(i + m, b)) for i, m, (a, b) in zip(place, chunk, bounds, strict=True)]
        there = tuple(slice(a - i, b - i) for i, (a, b) in zip(place, within, strict=True))
        here = tuple(slice(a - start, b - start) for (start, _), (a, b) in zip(bounds, within, strict=True))
        np.multiply(part[there], scale, out=out[here], casting="unsafe")
    return out


def _inflated(data: bytes, kind: np.dtype[Any]) -> Array:
    """The numbers of a chunk, as HDF5 itself would read them, in a fourth of the time."""
    planes = np.frombuffer(inflate(data), np.uint8).reshape(kind.itemsize, -1)
    words = planes[-1].astype(f"<u{kind.itemsize}")
    for plane in planes[-2::-1]:
        words <<= 8
        words |= plane
    return words.view(kind)


def _places(
    shape: Sequence[int], chunk: Sequence[int], bounds: Sequence[tuple[int, int]] | None = None
) -> Iterator[tuple[int, ...]]:
    """Where the chunks of an array begin, or those that have a part between `bounds`."""
    bounds = [(0, n) for n in shape] if bounds is None else bounds
    axes = [range(start // m * m, stop, m) for m, (start, stop) in zip(chunk, bounds, strict=True)]
    return itertools.product(*axes)


def read_truth(file: Any, grid: Grid, which: tuple[slice, ...] = (), out: Floats32 | None = None) -> Floats32:
    """The truth (n_x, n_y, n_z) of an open event's file, or a part of it, as `read_array` does."""
    if "truth" in file:
        return read_array(file, "truth", which, out)
    values = np.zeros(grid.n_voxels, np.float32)
    values[hdf5.read_numbers(file["truth_index"])] = hdf5.read_numbers(file["truth_values"])
    found = values.reshape(grid.shape)[which]
    if out is None:
        return found
    out[...] = found
    return out
