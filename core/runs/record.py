"""What a run's file holds, whatever its format: named arrays with units, and attributes."""

from __future__ import annotations

import json
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

UNITS = {
    "geometry/number": "",
    "geometry/ring": "",
    "geometry/center": "mm",
    "geometry/pinhole_distance": "mm",
    "geometry/pinhole_diameter": "mm",
    "geometry/collimator_length": "mm",
    "geometry/detector_side": "mm",
    "geometry/detector_thickness": "mm",
    "geometry/roi_radius": "mm",
    "geometry/pose": "mm",
    "geometry/intrinsics": "pixel",
    "geometry/projection_matrix": "pixel",
    "views/sources": "mm",
    "views/detector_centers": "mm",
    "views/u_steps": "mm",
    "views/v_steps": "mm",
    "volume/affine": "mm",
}
"""Units of the arrays beside projections and volume, whose units are attributes of the run."""


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
        return UNITS[name]


def record_of(run: ProjectionRun) -> Record:
    """Everything of `run`, as arrays and attributes."""
    system, views = run.system, run.views
    arrays: dict[str, NDArray] = {
        "projections": run.projections,
        "geometry/number": system.numbers,
        "geometry/ring": system.rings(),
        "geometry/center": system.centers,
        "geometry/pinhole_distance": system.pinhole_distance,
        "geometry/pinhole_diameter": system.pinhole_diameter,
        "geometry/collimator_length": system.collimator_length,
        "geometry/detector_side": system.detector_side,
        "geometry/detector_thickness": system.detector_thickness,
        "geometry/roi_radius": system.roi_radius,
        "geometry/pose": system.poses(),
        "geometry/intrinsics": run.intrinsics(),
        "geometry/projection_matrix": views.projection_matrices(),
        "views/sources": views.sources,
        "views/detector_centers": views.detector_centers,
        "views/u_steps": views.u_steps,
        "views/v_steps": views.v_steps,
        "volume/array": run.volume.array,
        "volume/affine": run.volume.grid.affine,
    }
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
    missing = [name for name in ("projections", "volume/array", *UNITS) if name not in arrays]
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
    array = arrays["volume/array"]
    n_x, n_y, n_z = array.shape
    grid = Grid((n_x, n_y, n_z), arrays["volume/affine"])
    seed = attributes["seed"]
    return ProjectionRun(
        projections=np.asarray(arrays["projections"], np.float32),
        system=system,
        views=Views(
            arrays["views/sources"],
            arrays["views/detector_centers"],
            arrays["views/u_steps"],
            arrays["views/v_steps"],
            (n_v, n_u),
        ),
        volume=Volume(array, grid, str(attributes["volume_quantity"])),
        unit=str(attributes["projections_unit"]),
        settings=json.loads(attributes["settings"]),
        seed=None if seed == "none" else int(seed),
        workbook=str(attributes["workbook"]),
        workbook_sha256=str(attributes["workbook_sha256"]),
        versions=json.loads(attributes["versions"]),
    )
