"""GATE 10 (opengate 10.1): a Python script, its numbers in a JSON file, and the materials.

Rotations are the solids' own: opengate hands them to ``G4PVPlacement(G4Transform3D, ...)``, which turns the solid.
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
from .monte_carlo import REFERENCE_ENERGY, Setup, Simulation, build_setup, material_database

_SCRIPT = Path(__file__).with_name("gate10_script.py")
_KEYS = {"size": "size_mm", "centers": "centers_mm"}  # of `Placed`, in the file of numbers


@dataclass(frozen=True, kw_only=True)
class Gate10Simulation(Simulation):
    """A simulation in several threads, which together emit the activity."""

    threads: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        whole_number(self.threads, "threads")


def _write(system: PinholeSystem, views: Views, temporary: Path, **options: Any) -> None:
    """Write script, numbers and materials into the folder `temporary`; the shape of the views is that of the images."""
    simulation = Gate10Simulation(**options)
    record = _record(system, build_setup(system, simulation), simulation) | {"image_shape": list(views.shape)}
    (temporary / "simulation.py").write_text(_SCRIPT.read_text(encoding="utf-8"), encoding="utf-8")
    (temporary / "simulation.json").write_text(json.dumps(record, indent=1), encoding="utf-8")
    (temporary / "GateMaterials.db").write_text(material_database(), encoding="ascii", newline="\n")


_TITLE = "GATE 10 (opengate) script: a folder, to run by python simulation.py"
GATE10 = Format("gate10", _TITLE, (), _write, options_of=Gate10Simulation)


def _record(system: PinholeSystem, setup: Setup, simulation: Gate10Simulation) -> dict[str, Any]:
    parts = [part for parts in setup.collimators for part in parts] + [solids for solids, _ in setup.crystals]
    if setup.phantom is not None:
        parts += [setup.phantom, *(rods for rods, _ in setup.rods)]
    modules = {
        int(m): {
            "number": int(system.numbers[m]),
            "crystal": part.name,
            "copy": copy,
            "crystal_center_mm": part.centers[copy].tolist(),
            "crystal_size_mm": [float(x) for x in part.size],
            "axes_uvk": part.rotations[copy].T.tolist(),
        }
        for part, indices in setup.crystals
        for copy, m in enumerate(indices)
    }
    return {
        "threads": int(simulation.threads),
        "seed": int(simulation.seed),
        "time_s": float(simulation.time),
        "world_mm": setup.world,
        "isotope": simulation.nuclide.name,
        "half_life_s": simulation.nuclide.half_life,
        "lines_keV_photons_per_decay": [list(line) for line in simulation.nuclide.lines],
        "detector": {
            "energy_resolution": float(simulation.energy_resolution),
            "reference_keV": REFERENCE_ENERGY,
            "intrinsic_fwhm_mm": float(simulation.intrinsic_fwhm),
            "window_keV": list(simulation.window),
        },
        "emitters": _emitters(setup, simulation),
        "crystals": [solids.name for solids, _ in setup.crystals],
        "modules": [modules[m] for m in range(len(system))],
        "volumes": [
            {_KEYS.get(name, name): np.asarray(value).tolist() for name, value in part._asdict().items()}
            for part in parts
        ],
    }


def _emitters(setup: Setup, simulation: Simulation) -> list[dict[str, Any]]:
    """The point, or each rod with its share of its sector's activity."""
    if setup.phantom is None:
        center = simulation.world_from_phantom[:3, 3].tolist()
        return [{"mother": "world", "center_mm": center, "activity_Bq": simulation.becquerels}]
    return [
        {
            "mother": setup.phantom.name,
            "center_mm": center.tolist(),
            "radius_mm": float(rods.size[0]),
            "height_mm": float(rods.size[1]),
            "activity_Bq": float(activity / len(rods.centers)),
        }
        for rods, activity in setup.rods
        for center in rods.centers
    ]
