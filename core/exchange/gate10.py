"""Format of GATE 10 (opengate 10.1): a Python script, its numbers in a JSON file, and the materials.

Rotations turn the solids: opengate hands them to ``G4PVPlacement(G4Transform3D, ...)``, which turns the solid.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..geometry.system import PinholeSystem
from ..geometry.views import Views
from ..validation import whole_number
from .format import Format
from .monte_carlo import REFERENCE_ENERGY, GateGeometry, Simulation, build_geometry, material_database

_SCRIPT = Path(__file__).with_name("gate10_script.py")
_JSON_NAMES = {"size": "size_mm", "centers": "centers_mm"}
"""Names in the JSON file of fields of `PlacedSolids` that are called otherwise there."""


@dataclass(frozen=True, kw_only=True)
class Gate10Simulation(Simulation):
    """Options of the GATE 10 format: a simulation in several threads, which together emit the activity."""

    threads: int = 1  # number of threads

    def __post_init__(self) -> None:
        super().__post_init__()
        whole_number(self.threads, "threads")


def _write(system: PinholeSystem, views: Views, temporary: Path, **options: Any) -> None:
    """Write script, numbers and materials into the folder `temporary`; the images have the shape (n_v, n_u) of the views."""
    simulation = Gate10Simulation(**options)
    geometry = build_geometry(system, simulation)
    record = _record(system, geometry, simulation) | {"image_shape": list(views.shape)}
    (temporary / "simulation.py").write_text(_SCRIPT.read_text(encoding="utf-8"), encoding="utf-8")
    (temporary / "simulation.json").write_text(json.dumps(record, indent=1), encoding="utf-8")
    (temporary / "GateMaterials.db").write_text(material_database(), encoding="ascii", newline="\n")


_TITLE = "GATE 10 (opengate) script: a folder, to run by python simulation.py"
GATE10 = Format("gate10", _TITLE, (), _write, options_source=Gate10Simulation)


def _record(system: PinholeSystem, geometry: GateGeometry, simulation: Gate10Simulation) -> dict[str, Any]:
    """Return the content of simulation.json: volumes, sources, crystals with their modules, detector and run."""
    volumes = [solids for kind in geometry.collimators for solids in kind] + [solids for solids, _ in geometry.crystals]
    if geometry.phantom is not None:
        volumes += [geometry.phantom, *(rods for rods, _ in geometry.rods)]
    modules = {
        int(m): {
            "number": int(system.numbers[m]),
            "crystal": crystals.name,
            "copy": copy,
            "crystal_center_mm": crystals.centers[copy].tolist(),
            "crystal_size_mm": [float(x) for x in crystals.size],
            "axes_uvk": crystals.rotations[copy].T.tolist(),
        }
        for crystals, indices in geometry.crystals
        for copy, m in enumerate(indices)
    }
    return {
        "threads": int(simulation.threads),
        "seed": int(simulation.seed),
        "time_s": float(simulation.time),
        "world_mm": geometry.world,
        "isotope": simulation.nuclide.name,
        "half_life_s": simulation.nuclide.half_life,
        "lines_keV_photons_per_decay": [list(line) for line in simulation.nuclide.lines],
        "detector": {
            "energy_resolution": float(simulation.energy_resolution),
            "reference_keV": REFERENCE_ENERGY,
            "intrinsic_fwhm_mm": float(simulation.intrinsic_fwhm),
            "window_keV": list(simulation.window),
        },
        "emitters": _emitters(geometry, simulation),
        "crystals": [solids.name for solids, _ in geometry.crystals],
        "modules": [modules[m] for m in range(len(system))],
        "volumes": [
            {_JSON_NAMES.get(name, name): np.asarray(value).tolist() for name, value in solids._asdict().items()}
            for solids in volumes
        ],
    }


def _emitters(geometry: GateGeometry, simulation: Simulation) -> list[dict[str, Any]]:
    """Return one source per rod, each with an equal share of its sector's activity, or a single point source."""
    if geometry.phantom is None:
        center = simulation.world_from_phantom[:3, 3].tolist()
        return [{"mother": "world", "center_mm": center, "activity_Bq": simulation.becquerels}]
    return [
        {
            "mother": geometry.phantom.name,
            "center_mm": center.tolist(),
            "radius_mm": float(rods.size[0]),
            "height_mm": float(rods.size[1]),
            "activity_Bq": float(activity / len(rods.centers)),
        }
        for rods, activity in geometry.rods
        for center in rods.centers
    ]
