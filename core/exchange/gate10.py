"""GATE 10 (opengate 10.1): a Python script, its numbers in a JSON file, and the materials.

Rotations are the solids' own: opengate hands them to ``G4PVPlacement(G4Transform3D, ...)``, which turns the solid.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..geometry.system import PinholeSystem
from ..geometry.views import Views
from ..validation import whole_number
from .format import Format
from .monte_carlo import REFERENCE_ENERGY, Part, Scene, Simulation, build_scene, material_database

_SCRIPT = Path(__file__).with_name("gate10_script.py")


@dataclass(frozen=True, kw_only=True)
class Gate10Simulation(Simulation):
    """A simulation by several threads.

    Attributes
    ----------
    threads : int
        All together emit the activity.
    """

    threads: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        whole_number(self.threads, "threads")


def write(system: PinholeSystem, views: Views, path: Path, **options: Any) -> None:
    """Write ``simulation.py``, ``simulation.json`` and ``GateMaterials.db`` into the folder `path`.

    Parameters
    ----------
    system, path
        The modules and the empty folder.
    views
        Their shape is that of the images, which cover each crystal.
    options
        Those of `Simulation`, and `threads`, a whole number.

    Raises
    ------
    InputError
        An option, or what `build_scene` refuses.
    """
    simulation = Gate10Simulation(**options)
    scene = build_scene(system, simulation)
    record = {"threads": simulation.threads, **_record(system, scene), "image_shape": list(views.shape)}
    (path / "simulation.py").write_text(_SCRIPT.read_text(encoding="utf-8"), encoding="utf-8")
    (path / "simulation.json").write_text(_json(record), encoding="utf-8")
    (path / "GateMaterials.db").write_text(material_database(), encoding="ascii", newline="\n")


GATE10 = Format(
    "gate10",
    "GATE 10 (opengate) script: a folder, to run by python simulation.py",
    (),
    write,
    options_of=Gate10Simulation,
)


def _json(record: dict[str, Any]) -> str:
    """JSON with one line for each entry, and for each item of lists of entries."""
    entries = []
    for key, value in record.items():
        text = json.dumps(value)
        if isinstance(value, list) and value and isinstance(value[0], dict):
            text = "[\n  " + ",\n  ".join(map(json.dumps, value)) + "\n ]"
        entries.append(f"{json.dumps(key)}: {text}")
    return "{\n " + ",\n ".join(entries) + "\n}\n"


def _record(system: PinholeSystem, scene: Scene) -> dict[str, Any]:
    simulation = scene.simulation
    parts = [part for parts in scene.collimators for part in parts] + [c.part for c in scene.crystals]
    if scene.phantom is not None:
        parts += [scene.phantom, *(rods.part for rods in scene.rods)]
    return {
        "seed": simulation.seed,
        "time_s": simulation.time,
        "world_mm": scene.world,
        "isotope": simulation.nuclide.name,
        "half_life_s": simulation.nuclide.half_life,
        "lines_keV_photons_per_decay": [list(line) for line in simulation.nuclide.lines],
        "detector": {
            "energy_resolution": simulation.energy_resolution,
            "reference_keV": REFERENCE_ENERGY,
            "intrinsic_fwhm_mm": simulation.intrinsic_fwhm,
            "window_keV": list(simulation.window),
        },
        "emitters": _emitters(scene),
        "crystals": [c.part.name for c in scene.crystals],
        "modules": _modules(system, scene),
        "volumes": [_volume(part) for part in parts],
    }


def _volume(part: Part) -> dict[str, Any]:
    return {
        "name": part.name,
        "mother": part.mother,
        "shape": part.shape,
        "size_mm": [float(x) for x in part.size],
        "material": part.material,
        "centers_mm": part.centers.tolist(),
        "rotations": part.rotations.tolist(),
    }


def _modules(system: PinholeSystem, scene: Scene) -> list[dict[str, Any]]:
    """Each module's crystal, for its images."""
    rows: list[dict[str, Any]] = [{}] * len(system)
    for part, modules in scene.crystals:
        for i, m in enumerate(modules):
            rows[m] = {
                "number": int(system.numbers[m]),
                "crystal": part.name,
                "copy": i,
                "crystal_center_mm": part.centers[i].tolist(),
                "crystal_size_mm": [float(x) for x in part.size],
                "axes_uvk": part.rotations[i].T.tolist(),
            }
    return rows


def _emitters(scene: Scene) -> list[dict[str, Any]]:
    """The point, or every rod with its share of its sector's activity."""
    simulation = scene.simulation
    if scene.phantom is None:
        center = simulation.place[:3, 3].tolist()
        return [{"mother": "world", "center_mm": center, "activity_Bq": simulation.becquerels}]
    return [
        {
            "mother": scene.phantom.name,
            "center_mm": center.tolist(),
            "radius_mm": float(rods.part.size[0]),
            "height_mm": float(rods.part.size[1]),
            "activity_Bq": float(rods.activity / len(rods.part.centers)),
        }
        for rods in scene.rods
        for center in rods.part.centers
    ]
