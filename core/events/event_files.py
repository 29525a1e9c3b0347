"""The file of one event: HDF5 that any reader opens, after 512 bytes of text that say what every following byte must be."""

import hashlib
import io
import json
import zlib
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..geometry.grid import Grid
from ..memory import cores
from ..runs.run import versions
from ..volumes.volume import Volume
from .making import EventArrays
from .recipe import EventRecipe

VERSION = 1
HEADER = 512
"""Bytes of text before the HDF5 data: its "user block", which readers skip."""
_FORMAT = "mphDRR event"
_COMPRESS_FROM = 1 << 13  # bytes: below, compressing costs more than it saves
_CHUNK = 1 << 20  # bytes of the truth's chunks, about

CONVENTIONS = (
    "Lengths in mm. World: right-handed, origin at the isocentre, +z along the patient. "
    "truth[ix, iy, iz]: truth_affine from index to world, an integer index is the voxel's centre. "
    "images/NAME[m, row, column]: expected means; column along the module's +u, row along +v. "
    "pose: world-from-phantom, acting on column vectors; placement: the same with mirroring and size. "
    "geometry/projection_matrix @ (x, y, z, 1) is a multiple of (column, row, 1). "
    "radon/N[i, row, column]: N angles i / N of radon_over_degrees; columns along (sin phi, -cos phi, 0), rows along +z. "
    "Stored numbers times the attribute scale, where there is one, are the values."
)


@dataclass(frozen=True)
class Header:
    """What the text at the beginning of an event's file says."""

    event: int
    recipe: str  # fingerprint
    size: int  # bytes that follow
    sha256: str  # of these

    def pack(self) -> bytes:
        """The text, padded to `HEADER` bytes."""
        lines = (
            f"{_FORMAT} {VERSION}",
            f"event {self.event}",
            f"recipe {self.recipe}",
            f"bytes {self.size}",
            f"sha256 {self.sha256}",
        )
        return "".join(f"{line}\n" for line in lines).encode().ljust(HEADER, b"\0")


def header(path: Path) -> Header:
    """The header of an event's file; `InputError` where the file is none, or is not as long as it says."""
    try:
        with open(path, "rb") as file:
            start = file.read(HEADER)
            size = file.seek(0, 2)
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}") from None
    found = _parsed(start, path)
    if size != HEADER + found.size:
        raise InputError(f"{path}: cut: {size} of {HEADER + found.size} bytes")
    return found


def verify(path: Path) -> Header:
    """The header of an event's file, after every byte of the file was compared with it; `InputError` says what is wrong."""
    found = header(path)
    digest = hashlib.sha256()
    with open(path, "rb") as file:
        if file.read(HEADER) != found.pack():
            raise InputError(f"{path}: changed: its first {HEADER} bytes are not as they were written")
        while block := file.read(1 << 20):
            digest.update(block)
    if digest.hexdigest() != found.sha256:
        raise InputError(f"{path}: changed: its bytes are not those that were written")
    return found


def _parsed(start: bytes, path: Path) -> Header:
    try:
        lines = [line.rpartition(" ")[::2] for line in start.rstrip(b"\0").decode("ascii").splitlines()]
        names, (version, event, recipe, size, sha256) = zip(*lines, strict=True)
        if names != (_FORMAT, "event", "recipe", "bytes", "sha256"):
            raise ValueError
        if int(version) > VERSION:
            raise InputError(f"{path}: written by a newer mphDRR (format {version}); update to read it")
        return Header(int(event), recipe, int(size), sha256)
    except InputError:
        raise
    except ValueError:
        raise InputError(f"{path}: not an event of mphDRR") from None


def packed(event: EventArrays, recipe: EventRecipe, geometry: dict[str, Any], threads: int | None = None) -> bytes:
    """The whole file of an event, the same bytes for the same event and versions.

    `geometry` holds small arrays by name, which go into the group ``geometry``.
    """
    import h5py

    planned = event.planned
    memory = io.BytesIO()
    with ThreadPoolExecutor(threads or cores()) as pool, h5py.File(memory, "w", userblock_size=HEADER) as file:
        file.attrs.update({
            "format": _FORMAT, "format_version": VERSION, "conventions": CONVENTIONS, "recipe_sha256": recipe.fingerprint,
            "event": planned.number, "phantom": planned.name, "split": planned.split or "",
            "settings": json.dumps(planned.all_settings), "mirror": planned.mirror, "size": planned.size,
            "activity_factor": planned.activity_factor, "noise_seed": planned.noise_seed, "seed": recipe.seed,
            "radon_over_degrees": 0.0 if recipe.radon is None else recipe.radon.degrees,
            "warnings": json.dumps(event.warnings), "versions": json.dumps(versions()),
        })  # fmt: skip
        small = {
            "pose": (planned.pose, "mm"), "placement": (planned.placement, "mm"),
            "position": (np.array(planned.position), "mm"),
            "euler_angles": (np.deg2rad(planned.euler_degrees), "rad"),
            "euler_degrees": (np.array(planned.euler_degrees), "degrees"),
            "truth_affine": (event.truth.grid.affine, "mm"), "module_gain": (event.gains, "1"),
            **{f"geometry/{name}": value for name, value in geometry.items()},
        }  # fmt: skip
        for name, (array, unit) in small.items():
            file.create_dataset(name, data=array).attrs["unit"] = unit
        _write_truth(file, event.truth, recipe, pool)
        for name, images in event.images.items():
            _write_images(file, f"images/{name}", images, event.units[name], recipe, pool)
        for count, images in event.radon.items():
            _write_images(file, f"radon/{count}", images, f"{event.truth.unit} mm", recipe, pool)
    body = memoryview(memory.getbuffer())[HEADER:]
    digest = hashlib.sha256(body).hexdigest()
    return Header(planned.number, recipe.fingerprint, len(body), digest).pack() + bytes(body)


def _write_truth(file: Any, truth: Volume, recipe: EventRecipe, pool: ThreadPoolExecutor) -> None:
    """The truth: whole, in half precision, or the values that are not 0 and their places."""
    array, store = truth.array, recipe.truth_store
    attributes = {"unit": truth.unit, "quantity": truth.quantity}
    if store != "sparse":
        rows = max(1, min(len(array), _CHUNK // max(1, array[0].nbytes)))
        _write(file, "truth", array, store, (rows, *array.shape[1:]), pool, attributes)
        return
    flat = array.reshape(-1)
    least = recipe.truth_below * float(np.abs(flat).max(initial=0.0))
    kept = np.flatnonzero(np.abs(flat) > least) if least > 0 else np.flatnonzero(flat)
    left = float(np.abs(np.delete(flat, kept)).max(initial=0.0)) if least > 0 else 0.0
    index = kept.astype(np.uint32 if flat.size <= 1 << 32 else np.uint64)
    chunk = (max(1, min(len(index), _CHUNK // 4)),)
    _write(file, "truth_values", flat[kept], "float32", chunk, pool, attributes | {"error": left, "shape": array.shape})
    _write(file, "truth_index", index, str(index.dtype), chunk, pool, {"unit": "1"})


def _write_images(
    file: Any, name: str, images: NDArray[np.float32], unit: str, recipe: EventRecipe, pool: ThreadPoolExecutor
) -> None:
    """Images, each a chunk of its own, so that one reads alone."""
    _write(file, name, images, recipe.image_store, (1, *images.shape[1:]), pool, {"unit": unit})


def _write(
    file: Any, name: str, array: NDArray[Any], store: str, chunk: tuple[int, ...], pool: ThreadPoolExecutor,
    attributes: dict[str, Any],
) -> None:  # fmt: skip
    """A dataset, compressed in threads as HDF5 itself would do it in one: shuffled bytes, deflated."""
    if store == "float16":
        array, more = _halved(array)
        attributes = attributes | more
    kind = np.dtype(array.dtype).newbyteorder("<")
    if array.nbytes < _COMPRESS_FROM:
        dataset = file.create_dataset(name, data=array.astype(kind, copy=False))
    else:
        dataset = file.create_dataset(
            name, array.shape, kind, chunks=chunk, compression="gzip", compression_opts=1, shuffle=True
        )
        starts = list(np.ndindex(*(-(-n // m) for n, m in zip(array.shape, chunk, strict=True))))
        places = [tuple(i * m for i, m in zip(start, chunk, strict=True)) for start in starts]

        def deflated(place: tuple[int, ...]) -> bytes:
            part = array[tuple(slice(i, i + m) for i, m in zip(place, chunk, strict=True))]
            whole = part if part.shape == chunk else np.zeros(chunk, array.dtype)
            if whole is not part:  # chunks at the end are filled up
                whole[tuple(map(slice, part.shape))] = part
            octets = np.ascontiguousarray(whole, kind).view(np.uint8).reshape(-1, kind.itemsize)
            return zlib.compress(octets.T.tobytes(), 1)

        for place, data in zip(places, pool.map(deflated, places), strict=True):
            dataset.id.write_direct_chunk(place, data)
    dataset.attrs.update(attributes)


def _halved(array: NDArray[Any]) -> tuple[NDArray[np.float16], dict[str, float]]:
    """An array in half precision, times a power of 2 that uses its range; the factor, and the largest error made."""
    largest = float(np.abs(array).max(initial=0.0))
    scale = 2.0 ** (int(np.frexp(largest)[1]) - 15) if largest else 1.0
    halved = (array * np.float32(1 / scale)).astype(np.float16)
    error = float(np.abs(halved.astype(np.float32) * np.float32(scale) - array).max(initial=0.0))
    return halved, {"scale": scale, "error": error}


def read_array(file: Any, name: str, which: Any = ()) -> NDArray[np.float32]:
    """The numbers of a dataset, or some of them, in float32."""
    dataset = file[name]
    values = np.asarray(dataset[which], np.float32)
    scale = dataset.attrs.get("scale")
    if scale is not None:
        values *= np.float32(scale)
    return values


def read_truth(file: Any, grid: Grid) -> NDArray[np.float32]:
    """The truth of an open event's file (n_x, n_y, n_z), float32."""
    if "truth" in file:
        return read_array(file, "truth")
    values = np.zeros(grid.n_voxels, np.float32)
    values[file["truth_index"][()]] = file["truth_values"][()]
    return values.reshape(grid.shape)


def names_of(file: Any, group: str) -> Iterator[str]:
    """The names in a group of an open event's file."""
    return iter(file[group]) if group in file else iter(())
