"""Run files: HDF5, NumPy archives and torch files, each of which holds a whole run.

In every format, a file holds arrays by name (``"geometry/center"``) with units, and attributes (texts or whole numbers).
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
from ..geometry.views import Views
from ..hdf5 import attributes, datasets, opened, pack, read_numbers
from ..scanner_kinds import scanner_kind
from ..volumes.formats import numpy_files
from ..volumes.volume import Volume
from . import EXPORT_FORMATS, FORMATS
from .dicom_counts import write_counts
from .run import ProjectionRun

_FORMAT = "mphDRR run"
_FORMAT_VERSION = 2
"""Version of files of measured runs, which hold no volume; files with one are of version 1, which earlier mphDRR read."""

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
"""Names in files of those attributes of a scanner whose names differ there."""
_UNITS = {"length": "mm", "angle": "rad"}
_PINHOLE = "pinhole"
"""Kind of scanner of files that name no kind."""
_KIND, _TEXTS = "scanner", "texts"
"""Names of the attributes for a kind of scanner other than pinhole, and for the columns of text, as JSON."""


def _geometry_arrays(scanner: Scanner) -> dict[str, tuple[str, Array]]:
    """Return unit and values of a scanner's arrays by name."""
    arrays = {"number": ("", scanner.numbers), "ring": ("", scanner.rings()), "pose": ("mm", scanner.poses())}
    arrays |= {name: ("mm", lengths) for name, lengths in scanner.derived_lengths().items()}
    for name, values in scanner.filled().items():
        column = scanner.columns.fields[name][0]
        if not column.is_text:
            arrays[_FILE_NAMES.get(name, name)] = (_UNITS.get(column.kind, ""), values)
    return {f"geometry/{name}": item for name, item in arrays.items()}


def _column_texts(scanner: Scanner) -> dict[str, list[str]]:
    """Return the columns of text of a scanner by attribute."""
    filled = scanner.filled().items()
    return {name: values.tolist() for name, values in filled if scanner.columns.fields[name][0].is_text}


def _read_scanner(arrays: dict[str, Array], attributes: dict[str, Any]) -> Scanner:
    """Return the scanner of a file; raise `InputError` if an array is missing."""
    kind = scanner_kind(attributes.get(_KIND, _PINHOLE))
    values = {"numbers": arrays["geometry/number"], **json.loads(attributes.get(_TEXTS, "{}"))}
    for name, (column, *_) in kind.columns.fields.items():
        if (place := f"geometry/{_FILE_NAMES.get(name, name)}") in arrays:
            values[name] = arrays[place]
        elif name not in values and not column.has_constant_blank:
            raise InputError(f"array {place} is missing")
    return kind.of(values)


_VOLUME = ("volume/array", "volume/affine")
"""Names of the volume's arrays, which a file of a measured run does not have."""
_BACKGROUND = "background"  # in the unit of the projections; 0 if the array is missing
_EFFICIENCY = "efficiency"  # 1 if the array is missing
_SCATTER = "scatter"  # counts of scattered photons in the projections; not simulated if the array is missing
_ATTRIBUTES, _SHA256 = "attributes", "sha256"
_COMPRESS_FROM = 1 << 16  # bytes; smaller arrays are not worth compressing

_Arrays = dict[str, tuple[str, Array]]
"""Units and values of arrays by name."""
_Contents = tuple[dict[str, Array], dict[str, Any]]
"""Arrays and attributes by name."""


def write_run(run: ProjectionRun, path: AnyPath) -> None:
    """Write a run as HDF5 (.h5, .hdf5), NumPy archive (.npz) or torch file (.pt), or its counts as DICOM (.dcm).

    The path's ending chooses the format.

    Raises `InputError` for another ending, if torch is missing for .pt, or if the file cannot be written; an existing file
    then stays as it is.
    """
    if (ending := require_ending(path, EXPORT_FORMATS)) == ".dcm":
        write_counts(run, path)
        return
    pack_file, _ = _FORMATS[ending]
    volume_attributes, scanner_attributes = {}, {}
    if run.volume is not None:
        volume_attributes = {"volume_quantity": run.volume.quantity, "volume_unit": run.volume.unit}
    if run.system.kind != _PINHOLE:
        scanner_attributes[_KIND] = run.system.kind
    if texts := _column_texts(run.system):
        scanner_attributes[_TEXTS] = json.dumps(texts)
    attributes = {
        "format": _FORMAT, "format_version": 1 if volume_attributes else _FORMAT_VERSION, "conventions": _CONVENTIONS,
        "projections_unit": run.unit, **volume_attributes, "seed": "none" if run.seed is None else int(run.seed),
        "workbook": run.workbook, "workbook_sha256": run.workbook_sha256, **scanner_attributes,
        "settings": json.dumps(dict(run.settings)), "versions": json.dumps(dict(run.versions)),
    }  # fmt: skip
    write_bytes(path, pack_file(_run_arrays(run), attributes))


def _run_arrays(run: ProjectionRun) -> _Arrays:
    """Return units and values of all arrays of a run's file by name."""
    views = run.views
    arrays = {"projections": (run.unit, run.projections), **_geometry_arrays(run.system)}
    arrays["geometry/intrinsics"] = ("pixel", run.intrinsics())
    arrays["geometry/projection_matrix"] = ("pixel", views.projection_matrices())
    arrays |= {f"views/{name}": ("mm", getattr(views, name)) for name in _RAYS}
    if run.volume is not None:
        arrays |= {_VOLUME[0]: (run.volume.unit, run.volume.array), _VOLUME[1]: ("mm", run.volume.grid.affine)}
    if np.any(run.background):
        arrays[_BACKGROUND] = (run.unit, np.asarray(run.background))
    if np.any(np.asarray(run.efficiency) != 1):
        arrays[_EFFICIENCY] = ("", np.asarray(run.efficiency))
    if run.scatter is not None:
        arrays[_SCATTER] = (run.unit, run.scatter)
    return arrays


def read_run(path: AnyPath) -> ProjectionRun:
    """Read a run written by `write_run`; raise `InputError` if there is no such file, or if it holds no complete run."""
    _, read = _FORMATS[require_ending(path, FORMATS)]
    with reading(require_file(path), "a projection run"):
        return _build_run(*read(Path(path)))


def _build_run(arrays: dict[str, Array], attributes: dict[str, Any]) -> ProjectionRun:
    """Return the run of a file's arrays and attributes; raise `InputError` if they are incomplete or were changed."""
    if attributes.get("format") != _FORMAT:
        raise InputError(f"expected a file marked {_FORMAT!r}, found {attributes.get('format', 'no mark')!r}")
    if int(attributes["format_version"]) > _FORMAT_VERSION:
        raise InputError(f"written by a newer mphDRR (format {attributes['format_version']}); update to read it")
    sha256 = attributes.pop(_SHA256, None)
    if sha256 not in (None, _content_hash(arrays, attributes)):
        raise InputError("changed: its arrays or attributes are not those that were written")
    is_measured = int(attributes["format_version"]) == _FORMAT_VERSION
    system = _read_scanner(arrays, attributes)
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
        background=arrays.get(_BACKGROUND, 0.0),  # type: ignore[arg-type]  # checked by `ProjectionRun`
        efficiency=arrays.get(_EFFICIENCY, 1.0),  # type: ignore[arg-type]
        scatter=arrays.get(_SCATTER),
    )


def _content_hash(arrays: dict[str, Array], attributes: dict[str, Any]) -> str:
    """Return the SHA-256 of all arrays and attributes of a run's file."""
    digest = hashlib.sha256(json.dumps(attributes, sort_keys=True).encode())
    for name, array in sorted(arrays.items()):
        digest.update(f"{name} {array.dtype.str} {array.shape}".encode())
        digest.update(np.asarray(array, order="C").data)
    return digest.hexdigest()


def _pack_hdf5(arrays: _Arrays, attributes: dict[str, Any]) -> memoryview:
    """Return an HDF5 file: datasets with a `unit`, with chunks of one view for reading views singly, and attributes."""

    def write_contents(file: Any) -> None:
        """Write the attributes and the arrays into an open ``h5py.File``."""
        file.attrs.update(attributes)
        for name, (unit, array) in arrays.items():
            storage_options: dict[str, Any] = {}
            if array.nbytes >= _COMPRESS_FROM:
                storage_options = {"compression": "gzip", "compression_opts": 1, "shuffle": True}
                storage_options["chunks"] = (1, *array.shape[1:])
            file.create_dataset(name, data=array, **storage_options).attrs["unit"] = unit

    return pack(_FORMAT, {}, write_contents)


def _read_hdf5(path: Path) -> _Contents:
    """Return arrays and attributes of an HDF5 file."""
    with opened(path, whole=True) as file:
        return {name: read_numbers(item) for name, item in datasets(file).items()}, attributes(file)


def _pack_npz(described: _Arrays, attributes: dict[str, Any]) -> memoryview:
    """Return a NumPy archive: arrays by name, and the attributes as JSON text."""
    arrays = {name: array for name, (_, array) in described.items()}
    text = json.dumps({**attributes, _SHA256: _content_hash(arrays, attributes)})
    return numpy_files.pack_npz({**arrays, _ATTRIBUTES: np.array(text)})


def _read_npz(path: Path) -> _Contents:
    """Return arrays and attributes of a NumPy archive."""
    arrays = numpy_files.load(path)
    return arrays, json.loads(str(arrays.pop(_ATTRIBUTES, "{}")))


def _pack_pt(described: _Arrays, attributes: dict[str, Any]) -> memoryview:
    """Return a torch file of tensors, texts and whole numbers only, which ``torch.load(path, weights_only=True)`` reads."""
    torch, memory = _import_torch(), io.BytesIO()
    arrays = {name: array for name, (_, array) in described.items()}
    tensors = {name: torch.from_numpy(np.array(array, order="C")) for name, array in arrays.items()}
    torch.save({_ATTRIBUTES: {**attributes, _SHA256: _content_hash(arrays, attributes)}, **tensors}, memory)
    return memory.getbuffer()


def _read_pt(path: Path) -> _Contents:
    """Return arrays and attributes of a torch file."""
    content = _import_torch().load(path, weights_only=True, map_location="cpu")
    attributes = content.pop(_ATTRIBUTES, {})
    return {name: tensor.numpy() for name, tensor in content.items()}, attributes


def _import_torch() -> Any:
    """Return the module torch; raise `InputError` if it is missing."""
    with needing(feature=".pt files, unlike .h5 and .npz"):
        import torch
    return torch


_Format = tuple[Callable[[_Arrays, dict[str, Any]], memoryview], Callable[[Path], _Contents]]
_HDF5: _Format = (_pack_hdf5, _read_hdf5)
_FORMATS = dict(zip(FORMATS, (_HDF5, _HDF5, (_pack_npz, _read_npz), (_pack_pt, _read_pt)), strict=True))
