"""GATE 9 macros (9.3 and later, whose digitizer has its own syntax): a folder of short files, ``main.mac`` first.

The system is GATE's SPECThead: its base may be repeated from a list of placements, each copy is a head with a number of its
own, and only this system writes projections, one image a head. It knows one kind of crystal; where the crystals differ in
size each kind is a system of type scanner, with a digitizer and singles of its own, and there are no projections.

Placements: GATE 9 hands the rotation of a placements file to ``G4PVPlacement(G4RotationMatrix*, ...)`` as it stands, which
takes it to the volume's frame *from* its mother's, while ``/placement/setRotationAngle`` turns the volume itself. So files
have the inverse of the solid's rotation. (GateMiscFunctions.cc, GateGenericRepeater.cc, GateVVolume.cc,
GateVolumePlacement.cc of GATE 9.3.)
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..geometry.system import PinholeSystem
from ..geometry.views import Views
from .format import Format
from .monte_carlo import (
    REFERENCE_ENERGY,
    Crystals,
    Part,
    Scene,
    Simulation,
    build_scene,
    material_database,
)

MOST_LINES = 100
"""No macro is longer; placements are data, a line each, and any number of them."""

_MARGIN = 0.1  # mm by which a head's box is larger than its crystal, at the sides and behind it


def write(system: PinholeSystem, views: Views, path: Path, **options: Any) -> None:
    """Write the macros into the folder `path`.

    Parameters
    ----------
    system, path
        The modules and the empty folder.
    views
        Their shape is that of the projections, which cover each crystal.
    options
        Those of `Simulation`.

    Raises
    ------
    InputError
        An option, or what `build_scene` refuses.
    """
    scene = build_scene(system, Simulation(**options))
    simulation = scene.simulation
    folder = _Folder(path)
    folder.write("GateMaterials.db", material_database())
    one = len(scene.crystals) == 1
    heads = [_head(folder, c, "SPECThead" if one else f"head{i + 1}") for i, c in enumerate(scene.crystals)]
    detectors = [_digitizer(folder, c.part.name, simulation) for c in scene.crystals]
    geometry = [
        folder.macro("geometry/world", _world(scene)),
        folder.list("geometry/heads", heads),
        folder.list("geometry/collimators", [_collimator(folder, parts) for parts in scene.collimators]),
    ]
    if scene.phantom is not None:
        geometry.append(folder.macro("geometry/phantom", _phantom(folder, scene)))
    projections = [folder.macro("projections", _projections(scene, views))] if one else []
    main = [
        f"# {len(system)} pinhole modules in GATE 9.3 or later. Run it from this folder: Gate main.mac",
        "/gate/geometry/setMaterialDatabase GateMaterials.db",
        *_execute(geometry),
        *_execute([folder.macro("physics", _physics())]),
        "/gate/run/initialize",
        *_execute([folder.list("digitizer/all", detectors), folder.macro("source", _source(folder, scene))]),
        *_execute([folder.macro("output", _output()), *projections]),
        "/gate/random/setEngineName MersenneTwister",
        f"/gate/random/setEngineSeed {simulation.seed}",
        f"/gate/application/setTimeSlice {_n(simulation.time)} s",
        "/gate/application/setTimeStart 0 s",
        f"/gate/application/setTimeStop {_n(simulation.time)} s",
        "/gate/application/startDAQ",
    ]
    folder.macro("main", main)
    folder.write("modules.txt", _modules(system, scene))


GATE9 = Format("gate9", "GATE 9.3 macros: a folder, to run by Gate main.mac", (), write, options_of=Simulation)


class _Folder:
    """Writes text files of a folder; macros are named by their path without the ending."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def write(self, name: str, text: str) -> str:
        path = self.path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="ascii", newline="\n")
        return name

    def macro(self, name: str, lines: Iterable[str]) -> str:
        lines = list(lines)
        assert len(lines) <= MOST_LINES, f"{name}: {len(lines)} lines"
        return self.write(f"{name}.mac", "\n".join(lines) + "\n")

    def list(self, name: str, macros: list[str]) -> str:
        """A macro that executes `macros`, through further ones where it would be too long."""
        parts = 0
        while len(macros) > MOST_LINES:
            pieces = [macros[i : i + MOST_LINES] for i in range(0, len(macros), MOST_LINES)]
            macros = [self.macro(f"{name}_{parts + i + 1}", _execute(piece)) for i, piece in enumerate(pieces)]
            parts += len(pieces)
        return self.macro(name, _execute(macros))

    def placements(self, part: Part) -> str:
        lines = ["# rotation of the mother's frame into the solid's (angle, axis), then the solid's centre"]
        lines += ["Time s", "Rotation deg", "Translation mm"]
        for center, rotation in zip(part.centers, part.rotations, strict=True):
            angle, axis = angle_and_axis(rotation.T)
            lines.append("0 " + " ".join(_n(x) for x in (np.degrees(angle), *axis, *center)))
        return self.write(f"placements/{part.name}.placements", "\n".join(lines) + "\n")


def angle_and_axis(rotation: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
    """Angle, 0 to pi, and unit axis of a rotation matrix (3, 3); about z where it does not turn."""
    twice = np.array(
        [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    )
    sine, cosine = np.linalg.norm(twice) / 2, (np.trace(rotation) - 1) / 2
    if cosine > 0:
        axis = twice / (2 * sine) if sine > 0 else np.array([0.0, 0.0, 1.0])
    else:  # near pi `twice` vanishes; the axis is also the eigenvector to the largest eigenvalue of R + R^T
        axis = np.linalg.eigh(rotation + rotation.T)[1][:, 2]
        axis = axis if axis @ twice >= 0 else -axis
    return float(np.arctan2(sine, cosine)), axis


def _n(number: float) -> str:
    return f"{number:.12g}"


def _execute(macros: Iterable[str]) -> list[str]:
    return [f"/control/execute {name}" for name in macros]


def _volume(part: Part, centered: bool = False) -> list[str]:
    """The commands that make a volume, without its places where it is repeated."""
    name, g = part.name, f"/gate/{part.name}/geometry"
    shapes = {"box": "box", "trd": "trap", "cone": "cone", "cylinder": "cylinder"}
    if part.shape == "box":
        sizes = [f"{g}/set{axis}Length {_n(length)} mm" for axis, length in zip("XYZ", part.size, strict=True)]
    elif part.shape == "trd":
        a, b, height = part.size
        sizes = [f"{g}/setDz {_n(height / 2)} mm", f"{g}/setTheta 0 deg", f"{g}/setPhi 0 deg"]
        sizes += [f"{g}/set{key} {_n(a)} mm" for key in ("Dy1", "Dx1", "Dx2")] + [f"{g}/setAlp1 0 deg"]
        sizes += [f"{g}/set{key} {_n(b)} mm" for key in ("Dy2", "Dx3", "Dx4")] + [f"{g}/setAlp2 0 deg"]
    elif part.shape == "cone":
        a, b, height = part.size
        sizes = [f"{g}/setRmin1 0 mm", f"{g}/setRmax1 {_n(a)} mm", f"{g}/setRmin2 0 mm", f"{g}/setRmax2 {_n(b)} mm"]
        sizes += [f"{g}/setHeight {_n(height)} mm", f"{g}/setPhiStart 0 deg", f"{g}/setDeltaPhi 360 deg"]
    else:
        radius, height = part.size
        sizes = [f"{g}/setRmin 0 mm", f"{g}/setRmax {_n(radius)} mm", f"{g}/setHeight {_n(height)} mm"]
    made = [f"/gate/{part.mother}/daughters/name {name}", f"/gate/{part.mother}/daughters/insert {shapes[part.shape]}"]
    lines = made + sizes + [f"/gate/{name}/setMaterial {part.material}"]
    if centered:
        lines.append(f"/gate/{name}/placement/setTranslation {' '.join(map(_n, part.centers[0]))} mm")
    return lines


def _repeated(folder: _Folder, part: Part) -> list[str]:
    """Commands of a volume with all its places."""
    r = f"/gate/{part.name}/genericRepeater"
    return [
        *_volume(part),
        f"/gate/{part.name}/repeaters/insert genericRepeater",
        f"{r}/setPlacementsFilename {folder.placements(part)}",
        f"{r}/useRelativeTranslation 0",
    ]


def _modules(system: PinholeSystem, scene: Scene) -> str:
    """Which copy of which crystal is whose."""
    rows = [(m, c.part.name, copy) for c in scene.crystals for copy, m in enumerate(c.modules)]
    lines = [f"{system.numbers[m]} {crystal} {copy}" for m, crystal, copy in sorted(rows)]
    return "\n".join(["# module, its crystal's volume, the copy of that crystal's head from 0", *lines]) + "\n"


def _world(scene: Scene) -> list[str]:
    return [f"/gate/world/geometry/set{axis}Length {_n(scene.world)} mm" for axis in "XYZ"] + [
        "/gate/world/setMaterial Air"
    ]


def _head(folder: _Folder, crystals: Crystals, name: str) -> str:
    """The system's base, a box of air close around the crystal, and the crystal in it."""
    crystal = crystals.part
    side, _, thickness = crystal.size
    size = (side + 2 * _MARGIN, side + 2 * _MARGIN, thickness + _MARGIN)
    k = crystal.rotations[:, :, 2]
    box = Part(name, "world", "box", size, "Air", crystal.centers - _MARGIN / 2 * k, crystal.rotations)
    inside = crystal._replace(mother=name, centers=np.array([[0.0, 0.0, _MARGIN / 2]]))
    level = "crystal" if name == "SPECThead" else "level1"
    made, *rest = _repeated(folder, box)
    kind = [] if name == "SPECThead" else ["/gate/world/daughters/systemType scanner"]
    return folder.macro(
        f"geometry/{name}",
        [
            made,
            *kind,
            *rest,
            *_volume(inside, centered=True),
            f"/gate/systems/{name}/{level}/attach {crystal.name}",
            f"/gate/{crystal.name}/attachCrystalSD",
        ],
    )


def _collimator(folder: _Folder, parts: list[Part]) -> str:
    solid, *air = parts
    lines = [line for part in air for line in _volume(part, centered=True)]
    return folder.macro(f"geometry/{solid.name}", _repeated(folder, solid) + lines)


def _phantom(folder: _Folder, scene: Scene) -> list[str]:
    assert scene.phantom is not None
    return [line for part in (scene.phantom, *(rods.part for rods in scene.rods)) for line in _repeated(folder, part)]


def _physics() -> list[str]:
    return ["/gate/physics/addPhysicsList emstandard_opt4"] + [
        f"/gate/physics/{particle}/SetCutInRegion world 0.1 mm" for particle in ("Gamma", "Electron", "Positron")
    ]


def _digitizer(folder: _Folder, crystal: str, simulation: Simulation) -> str:
    """Of one sensitive detector: singles, and those of them in the window.

    The window is a digitizer of its own, of this one module: GATE's projections read the first module of theirs.
    """
    low, high = simulation.window
    singles = f"/gate/digitizerMgr/{crystal}/SinglesDigitizer/Singles"
    window = f"/gate/digitizerMgr/{crystal}/SinglesDigitizer/Window"
    lines = [
        f"{singles}/insert adder",
        f"{singles}/adder/positionPolicy energyWeightedCentroid",
        f"{singles}/insert readout",
        f"{singles}/readout/setPolicy TakeEnergyWinner",
        f"{singles}/readout/setDepth 1",
    ]
    if simulation.energy_resolution:
        lines += [
            f"{singles}/insert energyResolution",
            f"{singles}/energyResolution/fwhm {_n(simulation.energy_resolution)}",
            f"{singles}/energyResolution/energyOfReference {_n(REFERENCE_ENERGY)} keV",
        ]
    if simulation.intrinsic_fwhm:
        lines += [
            f"{singles}/insert spatialResolution",
            f"{singles}/spatialResolution/fwhm {_n(simulation.intrinsic_fwhm)} mm",
            f"{singles}/spatialResolution/confineInsideOfSmallestElement true",
        ]
    lines += [
        "/gate/digitizerMgr/name Window",
        f"/gate/digitizerMgr/chooseSD {crystal}",
        "/gate/digitizerMgr/insert SinglesDigitizer",
        f"{window}/setInputCollection Singles",
        f"{window}/insert energyFraming",
        f"{window}/energyFraming/setMin {_n(low)} keV",
        f"{window}/energyFraming/setMax {_n(high)} keV",
    ]
    return folder.macro(f"digitizer/{crystal}", lines)


def _source(folder: _Folder, scene: Scene) -> list[str]:
    """A point, or a source for each sector: a cylinder around its rods, confined to them."""
    simulation = scene.simulation
    spectrum = folder.write(
        "spectrum.txt", "1 0\n" + "".join(f"{_n(e / 1000)} {_n(p)}\n" for e, p in simulation.nuclide.lines)
    )
    pose = simulation.place

    def source(name: str, activity: float, center: NDArray[np.float64], shape: list[str]) -> list[str]:
        s = f"/gate/source/{name}"
        return [
            f"/gate/source/addSource {name} gps",
            f"{s}/gps/particle gamma",
            f"{s}/gps/ene/type UserSpectrum",
            f"{s}/gps/setSpectrumFile {spectrum}",
            f"{s}/setActivity {_n(activity * simulation.photons_per_decay)} becquerel",
            f"{s}/setForcedUnstableFlag true",
            f"{s}/setForcedHalfLife {_n(simulation.nuclide.half_life)} s",
            f"{s}/gps/ang/type iso",
            *(f"{s}/gps/pos/{line}" for line in shape),
            f"{s}/gps/pos/centre {' '.join(map(_n, center))} mm",
        ]

    if scene.phantom is None:
        return source("point", simulation.becquerels, pose[:3, 3], ["type Point"])
    lines = []
    for rods in scene.rods:
        radius, height = rods.part.size
        middle = rods.part.centers.mean(axis=0)
        around = np.linalg.norm(rods.part.centers - middle, axis=1).max() + radius
        shape = [
            "type Volume",
            "shape Cylinder",
            f"radius {_n(around)} mm",
            f"halfz {_n(height / 2)} mm",
            f"rot1 {' '.join(map(_n, pose[:3, 0]))}",
            f"rot2 {' '.join(map(_n, pose[:3, 1]))}",
            f"confine {rods.part.name}_phys",
        ]
        center = pose[:3, :3] @ middle + pose[:3, 3]
        name = rods.part.name.replace("rods", "sector")
        lines.append(folder.macro(f"sources/{name}", source(name, rods.activity, center, shape)))
    return _execute(lines)


def _output() -> list[str]:
    return [
        "/gate/output/root/enable",
        "/gate/output/root/setFileName singles",
        "/gate/output/root/setRootHitFlag 0",
        "/gate/output/root/setRootNtupleFlag 0",
        "/gate/output/root/setRootSinglesFlag 1",
    ]


def _projections(scene: Scene, views: Views) -> list[str]:
    (n_v, n_u), (side, _, _) = views.shape, scene.crystals[0].part.size
    return [
        "/gate/output/projection/enable",
        "/gate/output/projection/setFileName projections",
        "/gate/output/projection/projectionPlane XY",
        f"/gate/output/projection/pixelSizeX {_n(side / n_u)} mm",
        f"/gate/output/projection/pixelSizeY {_n(side / n_v)} mm",
        f"/gate/output/projection/pixelNumberX {n_u}",
        f"/gate/output/projection/pixelNumberY {n_v}",
        "/gate/output/projection/setInputDataName Window",
    ]
