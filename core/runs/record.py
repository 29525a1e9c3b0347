"""What a run's file holds, whatever its format: named arrays with units, and attributes."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..geometry.grid import Grid
from ..geometry.system import PinholeSystem
from ..geometry.views import Views
from ..volumes.volume import Volume
from .run import ProjectionRun

FORMAT = "mphDRR run"
FORMAT_VERSION = 1

CONVENTIONS = (
    "Lengths in mm. World: right-handed, origin at the isocentre, +z along the patient. "
    "Module frame (u, v, k): right-handed, k from the pinhole to the isocentre, u = normalize(z x k), v = k x u. "
    "projections[m, row, column]: column along +u, row along +v, pixel 0's centre at 0; seen from the pinhole with "
    "+v up, +u points to the left. Poses: world-from-module, acting on column vectors. "
    "intrinsics @ (u, v, k) and projection_matrix @ (x, y, z, 1) are multiples of (column, row, 1). "
    "volume[ix, iy, iz]: affine from index to world, an integer index is the voxel's centre, 0 outside."
)

ARRAYS: dict[str, tuple[str, Callable[[ProjectionRun], Any]]] = {
    "geometry/number": ("", lambda run: run.system.numbers),
    "geometry/ring": ("", lambda run: run.system.rings()),
    "geometry/center": ("mm", lambda run: run.system.centers),
    "geometry/pinhole_distance": ("mm", lambda run: run.system.pinhole_distance),
    "geometry/pinhole_diameter": ("mm", lambda run: run.system.pinhole_diameter),
    "geometry/collimator_length": ("mm", lambda run: run.system.collimator_length),
    "geometry/detector_side": ("mm", lambda run: run.system.detector_side),
    "geometry/detector_thickness": ("mm", lambda run: run.system.detector_thickness),
    "geometry/roi_radius": ("mm", lambda run: run.system.roi_radius),
    "geometry/pose": ("mm", lambda run: run.system.poses()),
    "geometry/intrinsics": ("pixel", lambda run: run.intrinsics()),
    "geometry/projection_matrix": ("pixel", lambda run: run.views.projection_matrices()),
    "views/sources": ("mm", lambda run: run.views.sources),
    "views/detector_centers": ("mm", lambda run: run.views.detector_centers),
    "views/u_steps": ("mm", lambda run: run.views.u_steps),
    "views/v_steps": ("mm", lambda run: run.views.v_steps),
    "volume/affine": ("mm", lambda run: run.volume.grid.affine),
}
"""Name, unit and contents of the arrays beside projections and volume, whose units are attributes of the run."""


@dataclass(frozen=True)
class Record:
    """Arrays by name (``"geometry/center"``), attributes by name (text or whole numbers)."""

    arrays: dict[str, NDArray]
    attributes: dict[str, Any]

    def unit(self, name: str) -> str:
        """The unit of array `name`."""
        if name == "projections":
            return str(self.attributes["projections_unit"])
        if name == "volume/array":
            return str(self.attributes["volume_unit"])
        return ARRAYS[name][0]


def record_of(run: ProjectionRun) -> Record:
    """Everything of `run`, as arrays and attributes."""
    arrays = {"projections": run.projections, "volume/array": run.volume.array}
    arrays |= {name: get(run) for name, (_, get) in ARRAYS.items()}
    attributes: dict[str, Any] = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "conventions": CONVENTIONS,
        "projections_unit": run.unit,
        "volume_quantity": run.volume.quantity,
        "volume_unit": run.volume.unit,
        "seed": "none" if run.seed is None else int(run.seed),
        "workbook": run.workbook,
        "workbook_sha256": run.workbook_sha256,
        "settings": json.dumps(dict(run.settings)),
        "versions": json.dumps(dict(run.versions)),
    }
    return Record(arrays, attributes)


def run_of(record: Record) -> ProjectionRun:
    """The run that `record` was made from."""
    arrays, attributes = record.arrays, record.attributes
    if attributes.get("format") != FORMAT:
        raise InputError(f"expected a file marked {FORMAT!r}, found {attributes.get('format', 'no mark')!r}")
    if int(attributes["format_version"]) > FORMAT_VERSION:
        raise InputError(f"written by a newer mphDRR (format {attributes['format_version']}); update to read it")
    missing = [name for name in ("projections", "volume/array", *ARRAYS) if name not in arrays]
    if missing:
        raise InputError(f"array {missing[0]} is missing")
    n_v, n_u = arrays["projections"].shape[1:]
    system = PinholeSystem(
        centers=arrays["geometry/center"],
        pinhole_diameter=arrays["geometry/pinhole_diameter"],
        collimator_length=arrays["geometry/collimator_length"],
        detector_side=arrays["geometry/detector_side"],
        detector_thickness=arrays["geometry/detector_thickness"],
        roi_radius=arrays["geometry/roi_radius"],
        numbers=arrays["geometry/number"],
    )
    volume = arrays["volume/array"]
    n_x, n_y, n_z = volume.shape
    sources, middles, u_steps, v_steps = (
        arrays[f"views/{name}"] for name in ("sources", "detector_centers", "u_steps", "v_steps")
    )
    seed = attributes["seed"]
    return ProjectionRun(
        projections=np.asarray(arrays["projections"], np.float32),
        system=system,
        views=Views(sources, middles, u_steps, v_steps, (n_v, n_u)),
        volume=Volume(volume, Grid((n_x, n_y, n_z), arrays["volume/affine"]), str(attributes["volume_quantity"])),
        unit=str(attributes["projections_unit"]),
        settings=json.loads(attributes["settings"]),
        seed=None if seed == "none" else int(seed),
        workbook=str(attributes["workbook"]),
        workbook_sha256=str(attributes["workbook_sha256"]),
        versions=json.loads(attributes["versions"]),
    )
