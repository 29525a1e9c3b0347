"""Run files: HDF5, numpy archives and torch files, each of which holds a run whole.

Whatever the format, a file holds arrays by name (``"geometry/center"``) with units, and attributes (text or whole numbers).
"""

import hashlib
import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ..arrays import Array
from ..errors import InputError, needing, reading
from ..files import AnyPath, require_ending, require_file, write_bytes
from ..geometry.grid import Grid
from ..geometry.scanner import Scanner
from ..geometry.system import PinholeSystem
from ..geometry.views import Views
from ..hdf5 import attributes, datasets, opened, pack, read_numbers
from ..scanner_kinds import scanner_kind
from ..volumes.formats import numpy_files
from ..volumes.volume import Volume
from .formats import FORMATS
from .run import ProjectionRun

_FORMAT = "mphDRR run"
_FORMAT_VERSION = 2
"""Of files of measured runs, which hold no volume; others stay what earlier versions of mphDRR read, version 1."""

_CONVENTIONS = (
    "Lengths in mm. World: right-handed, origin at the isocentre, +z along the patient. "
    "Module frame (u, v, k): right-handed, k from the pinhole to the isocentre, u = normalize(z x k), v = k x u. "
    "projections[m, row, column]: column along +u, row along +v, pixel 0's centre at 0; seen from the pinhole with "
    "+v up, +u points to the left. Poses: world-from-module, acting on column vectors. "
    "intrinsics @ (u, v, k) and projection_matrix @ (x, y, z, 1) are multiples of (column, row, 1). "
    "volume[ix, iy, iz]: affine from index to world, an integer index is the voxel's centre, 0 outside."
)

_RAYS = ("sources", "detector_centers", "u_steps", "v_steps")

_FILE_NAMES = {"centers": "center"}
"""Attribute of a scanner -> its name in files, where that is another."""
_UNITS = {"length": "mm", "angle": "rad"}
_PINHOLE = "pinhole"
"""The kind of scanner of files that name none."""
_KIND, _TEXTS = "scanner", "texts"
"""Attributes: the kind of scanner where it is another, and the texts of its columns, as JSON."""


def _geometry(scanner: Scanner) -> dict[str, tuple[str, Array]]:
    """Unit and contents of the arrays of a scanner, by name."""
    found = {"number": ("", scanner.numbers), "ring": ("", scanner.rings()), "pose": ("mm", scanner.poses())}
    if isinstance(scanner, PinholeSystem):
        found["pinhole_distance"] = ("mm", scanner.pinhole_distance)
    for name, values in scanner.filled().items():
        column = scanner.columns.fields[name][0]
        if not column.is_text:
            found[_FILE_NAMES.get(name, name)] = (_UNITS.get(column.kind, ""), values)
    return {f"geometry/{name}": item for name, item in found.items()}


def _texts(scanner: Scanner) -> dict[str, list[str]]:
    """Attribute -> the texts of a column."""
    filled = scanner.filled().items()
    return {name: values.tolist() for name, values in filled if scanner.columns.fields[name][0].is_text}


def _scanner(arrays: dict[str, Array], attributes: dict[str, Any]) -> Scanner:
    """The scanner that a file holds."""
    kind = scanner_kind(attributes.get(_KIND, _PINHOLE))
    given = {"numbers": arrays["geometry/number"], **json.loads(attributes.get(_TEXTS, "{}"))}
    for name, (column, *_) in kind.columns.fields.items():
        place = f"geometry/{_FILE_NAMES.get(name, name)}"
        if place in arrays:
            given[name] = arrays[place]
        elif name not in given and not column.has_constant_blank:
            raise InputError(f"array {place} is missing")
    return kind.of(given)


_VOLUME = ("volume/array", "volume/affine")
"""Which a measured run does not have."""
_BACKGROUND = "background"  # in the unit of the projections; where there is none, nothing but the volume was projected
_EFFICIENCY = "efficiency"  # where there is none, 1
_ATTRIBUTES, _SHA256 = "attributes", "sha256"
_COMPRESS_FROM = 1 << 16  # bytes: below, compressing costs more than it saves

_Arrays = dict[str, tuple[str, Array]]
"""Unit and contents of arrays by name."""
_Contents = tuple[dict[str, Array], dict[str, Any]]
"""Arrays and attributes by name."""


def write_run(run: ProjectionRun, path: AnyPath) -> None:
    """Write a run as HDF5 (.h5, .hdf5), numpy archive (.npz) or torch file (.pt), by the path's suffix.

    `InputError` for another suffix, where torch is missing for .pt, or the file cannot be written: the old one then stays.
    """
    packed, _ = _FORMATS[require_ending(path, FORMATS)]
    of_volume, of_scanner = {}, {}
    if run.volume is not None:
        of_volume = {"volume_quantity": run.volume.quantity, "volume_unit": run.volume.unit}
    if run.system.kind != _PINHOLE:
        of_scanner[_KIND] = run.system.kind
    if texts := _texts(run.system):
        of_scanner[_TEXTS] = json.dumps(texts)
    attributes = {
        "format": _FORMAT, "format_version": 1 if of_volume else _FORMAT_VERSION, "conventions": _CONVENTIONS,
        "projections_unit": run.unit, **of_volume, "seed": "none" if run.seed is None else int(run.seed),
        "workbook": run.workbook, "workbook_sha256": run.workbook_sha256, **of_scanner,
        "settings": json.dumps(dict(run.settings)), "versions": json.dumps(dict(run.versions)),
    }  # fmt: skip
    write_bytes(path, packed(_arrays(run), attributes))


def _arrays(run: ProjectionRun) -> _Arrays:
    """Name, unit and contents of all arrays of a run's file."""
    views = run.views
    found = {"projections": (run.unit, run.projections), **_geometry(run.system)}
    found["geometry/intrinsics"] = ("pixel", run.intrinsics())
    found["geometry/projection_matrix"] = ("pixel", views.projection_matrices())
    found |= {f"views/{name}": ("mm", getattr(views, name)) for name in _RAYS}
    if run.volume is not None:
        found |= {_VOLUME[0]: (run.volume.unit, run.volume.array), _VOLUME[1]: ("mm", run.volume.grid.affine)}
    if np.any(run.background):
        found[_BACKGROUND] = (run.unit, np.asarray(run.background))
    if np.any(np.asarray(run.efficiency) != 1):
        found[_EFFICIENCY] = ("", np.asarray(run.efficiency))
    return found


def read_run(path: AnyPath) -> ProjectionRun:
    """Read a run written by `write_run`; `InputError` where there is no such file, or no whole run in it."""
    _, read = _FORMATS[require_ending(path, FORMATS)]
    with reading(require_file(path), "a projection run"):
        return _run_of(*read(Path(path)))


def _run_of(arrays: dict[str, Array], attributes: dict[str, Any]) -> ProjectionRun:
    if attributes.get("format") != _FORMAT:
        raise InputError(f"expected a file marked {_FORMAT!r}, found {attributes.get('format', 'no mark')!r}")
    if int(attributes["format_version"]) > _FORMAT_VERSION:
        raise InputError(f"written by a newer mphDRR (format {attributes['format_version']}); update to read it")
    sha256 = attributes.pop(_SHA256, None)
    if sha256 not in (None, _sha256(arrays, attributes)):
        raise InputError("changed: its arrays or attributes are not those that were written")
    is_measured = int(attributes["format_version"]) == _FORMAT_VERSION
    system = _scanner(arrays, attributes)
    for name in ("projections", *(() if is_measured else _VOLUME), *(f"views/{name}" for name in _RAYS)):
        if name not in arrays:
            raise InputError(f"array {name} is missing")
    rays: Any = {name: arrays[f"views/{name}"] for name in _RAYS}
    volume, seed = None, attributes["seed"]
    if not is_measured:
        values = arrays["volume/array"]
        n_x, n_y, n_z = values.shape
        volume = Volume(values, Grid((n_x, n_y, n_z), arrays["volume/affine"]), str(attributes["volume_quantity"]))
    n_v, n_u = arrays["projections"].shape[1:]
    return ProjectionRun(
        arrays["projections"],
        system,
        Views(**rays, shape=(n_v, n_u)),
        volume,
        unit=str(attributes["projections_unit"]),
        settings=json.loads(attributes["settings"]),
        seed=None if seed == "none" else int(seed),
        workbook=str(attributes["workbook"]),
        workbook_sha256=str(attributes["workbook_sha256"]),
        versions=json.loads(attributes["versions"]),
        background=arrays.get(_BACKGROUND, 0.0),  # type: ignore[arg-type]  # checked there
        efficiency=arrays.get(_EFFICIENCY, 1.0),  # type: ignore[arg-type]
    )


def _sha256(arrays: dict[str, Array], attributes: dict[str, Any]) -> str:
    """Of all that a run's file holds."""
    digest = hashlib.sha256(json.dumps(attributes, sort_keys=True).encode())
    for name, array in sorted(arrays.items()):
        digest.update(f"{name} {array.dtype.str} {array.shape}".encode())
        digest.update(np.asarray(array, order="C").data)
    return digest.hexdigest()


def _packed_hdf5(arrays: _Arrays, attributes: dict[str, Any]) -> memoryview:
    """Arrays as datasets with a `unit`, in chunks of one view each, so that one view reads alone; attributes on the root."""

    def fill(file: Any) -> None:
        file.attrs.update(attributes)
        for name, (unit, array) in arrays.items():
            packed: dict[str, Any] = {}
            if array.nbytes >= _COMPRESS_FROM:
                packed = {"compression": "gzip", "compression_opts": 1, "shuffle": True}
                packed["chunks"] = (1, *array.shape[1:])
            file.create_dataset(name, data=array, **packed).attrs["unit"] = unit

    return pack(_FORMAT, {}, fill)


def _read_hdf5(path: Path) -> _Contents:
    with opened(path, whole=True) as file:
        return {name: read_numbers(item) for name, item in datasets(file).items()}, attributes(file)


def _packed_npz(described: _Arrays, attributes: dict[str, Any]) -> memoryview:
    """Arrays by name, attributes as JSON text."""
    arrays = {name: array for name, (_, array) in described.items()}
    text = json.dumps({**attributes, _SHA256: _sha256(arrays, attributes)})
    return numpy_files.pack_npz({**arrays, _ATTRIBUTES: np.array(text)})


def _read_npz(path: Path) -> _Contents:
    arrays = numpy_files.load(path)
    return arrays, json.loads(str(arrays.pop(_ATTRIBUTES, "{}")))


def _packed_pt(described: _Arrays, attributes: dict[str, Any]) -> memoryview:
    """Only tensors, text and whole numbers: ``torch.load(path, weights_only=True)`` reads them."""
    torch, memory = _torch(), io.BytesIO()
    arrays = {name: array for name, (_, array) in described.items()}
    tensors = {name: torch.from_numpy(np.array(array, order="C")) for name, array in arrays.items()}
    torch.save({_ATTRIBUTES: {**attributes, _SHA256: _sha256(arrays, attributes)}, **tensors}, memory)
    return memory.getbuffer()


def _read_pt(path: Path) -> _Contents:
    content = _torch().load(path, weights_only=True, map_location="cpu")
    attributes = content.pop(_ATTRIBUTES, {})
    return {name: tensor.numpy() for name, tensor in content.items()}, attributes


def _torch() -> Any:
    with needing(feature=".pt files, unlike .h5 and .npz"):
        import torch
    return torch


_Format = tuple[Callable[[_Arrays, dict[str, Any]], memoryview], Callable[[Path], _Contents]]
_HDF5: _Format = (_packed_hdf5, _read_hdf5)
_FORMATS = dict(zip(FORMATS, (_HDF5, _HDF5, (_packed_npz, _read_npz), (_packed_pt, _read_pt)), strict=True))
