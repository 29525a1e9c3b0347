"""GATE 9 macros (9.3 and later, whose digitizer has its own syntax): a folder of short files, ``main.mac`` first.

The system is GATE's SPECThead: its base may be repeated from a list of placements, each copy is a head with a number of its
own, and only this system writes projections, one image a head. It knows one kind of crystal. Where crystals differ in size,
each kind is a system of type scanner with a digitizer and singles of its own, and there are no projections.

Placements: GATE 9 hands the rotation of a placements file unchanged to ``G4PVPlacement(G4RotationMatrix*, ...)``, which
takes it as the rotation to the volume's frame *from* its mother's, while ``/placement/setRotationAngle`` turns the volume
itself. So the files hold the inverse of the solid's rotation. (GateMiscFunctions.cc, GateGenericRepeater.cc,
GateVVolume.cc, GateVolumePlacement.cc of GATE 9.3.)
"""

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from ..arrays import Floats
from ..geometry.system import PinholeSystem
from ..geometry.views import Views
from .format import Format
from .monte_carlo import REFERENCE_ENERGY, Placed, Setup, Simulation, build_setup, material_database

MOST_LINES = 100
"""No macro is longer. Placements are data, one line each, and may be any number."""

_MARGIN = 0.1  # mm by which a head's box is larger than its crystal, at the sides and behind it
_IN_DEGREES = {"Theta", "Phi", "Alp1", "Alp2", "PhiStart", "DeltaPhi"}  # of the settings of shapes


def _write(system: PinholeSystem, views: Views, temporary: Path, **options: Any) -> None:
    """Write the macros into the folder `temporary`; the shape of the views is that of the projections."""
    simulation = Simulation(**options)
    setup = build_setup(system, simulation)
    folder = _Folder(temporary)
    folder.write("GateMaterials.db", material_database())
    one = len(setup.crystals) == 1
    heads = [_head(folder, c, "SPECThead" if one else f"head{i + 1}") for i, (c, _) in enumerate(setup.crystals)]
    collimators = [
        folder.macro(f"geometry/{solid.name}", sum(map(_centered, air), _repeated(folder, solid)))
        for solid, *air in setup.collimators
    ]
    world = _under("/gate/world", *(f"geometry/set{axis}Length {_n(setup.world)} mm" for axis in "XYZ"))
    geometry = [folder.macro("geometry/world", [*world, "/gate/world/setMaterial Air"])]
    geometry += [folder.list("geometry/heads", heads), folder.list("geometry/collimators", collimators)]
    if setup.phantom is not None:
        parts = (setup.phantom, *(rods for rods, _ in setup.rods))
        geometry.append(folder.macro("geometry/phantom", [x for part in parts for x in _repeated(folder, part)]))
    cuts = _under("/gate/physics", *(f"{p}/SetCutInRegion world 0.1 mm" for p in ("Gamma", "Electron", "Positron")))
    flags = ("setRootHitFlag 0", "setRootNtupleFlag 0", "setRootSinglesFlag 1")
    singles = _under("/gate/output/root", "enable", "setFileName singles", *flags)
    side, (n_v, n_u) = setup.crystals[0][0].size[0], views.shape
    pixels = [f"pixelSizeX {_n(side / n_u)} mm", f"pixelSizeY {_n(side / n_v)} mm"]
    pixels += [f"pixelNumberX {n_u}", f"pixelNumberY {n_v}"]
    plane = ("enable", "setFileName projections", "projectionPlane XY")
    projections = _under("/gate/output/projection", *plane, *pixels, "setInputDataName Window")
    main = [
        f"# {len(system)} pinhole modules in GATE 9.3 or later. Run it from this folder: Gate main.mac",
        "/gate/geometry/setMaterialDatabase GateMaterials.db",
        *_execute(geometry),
        *_execute([folder.macro("physics", ["/gate/physics/addPhysicsList emstandard_opt4", *cuts])]),
        "/gate/run/initialize",
        *_execute([folder.list("digitizer/all", [_digitizer(folder, c.name, simulation) for c, _ in setup.crystals])]),
        *_execute([folder.macro("source", _source(folder, setup, simulation))]),
        *_execute([folder.macro("output", singles)]),
        *(_execute([folder.macro("projections", projections)]) if one else []),
        "/gate/random/setEngineName MersenneTwister",
        f"/gate/random/setEngineSeed {int(simulation.seed)}",
        f"/gate/application/setTimeSlice {_n(simulation.time)} s",
        "/gate/application/setTimeStart 0 s",
        f"/gate/application/setTimeStop {_n(simulation.time)} s",
        "/gate/application/startDAQ",
    ]
    folder.macro("main", main)
    copies = sorted((m, c.name, copy) for c, modules in setup.crystals for copy, m in enumerate(modules))
    table = ["# module, its crystal's volume, the copy of that crystal's head from 0"]
    table += [f"{system.numbers[m]} {crystal} {copy}" for m, crystal, copy in copies]
    folder.write("modules.txt", "\n".join(table) + "\n")


GATE9 = Format("gate9", "GATE 9.3 macros: a folder, to run by Gate main.mac", (), _write, options_of=Simulation)


class _Folder:
    """Writes text files; macros are named by their path without the ending."""

    def __init__(self, temporary: Path) -> None:
        self.folder = temporary

    def write(self, name: str, text: str) -> str:
        temporary = self.folder / name
        temporary.parent.mkdir(parents=True, exist_ok=True)
        temporary.write_text(text, encoding="ascii", newline="\n")
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

    def placements(self, part: Placed) -> str:
        lines = ["# rotation of the mother's frame into the solid's (angle, axis), then the solid's centre"]
        lines += ["Time s", "Rotation deg", "Translation mm"]
        for center, rotation in zip(part.centers, part.rotations, strict=True):
            angle, axis = angle_and_axis(rotation.T)
            lines.append("0 " + " ".join(_n(x) for x in (np.degrees(angle), *axis, *center)))
        return self.write(f"placements/{part.name}.placements", "\n".join(lines) + "\n")


def angle_and_axis(rotation: Floats) -> tuple[float, Floats]:
    """Angle, 0 to pi, and unit axis of a rotation matrix (3, 3); the axis is z where it does not turn."""
    from nibabel.quaternions import mat2quat

    cosine, *axis = mat2quat(rotation)  # of half the angle
    sine = float(np.linalg.norm(axis))
    return 2 * math.atan2(sine, cosine), np.array(axis) / sine if sine else np.array([0.0, 0.0, 1.0])


def _n(*numbers: float) -> str:
    return " ".join(f"{number:.12g}" for number in numbers)


def _under(prefix: str, *commands: str) -> list[str]:
    return [f"{prefix}/{command}" for command in commands]


def _execute(macros: Iterable[str]) -> list[str]:
    return [f"/control/execute {name}" for name in macros]


def _volume(part: Placed) -> list[str]:
    """The commands that make a volume, without its place."""
    a, b, last = part.size[0], part.size[1], part.size[-1]
    square = {"Dy1": a, "Dx1": a, "Dx2": a, "Alp1": 0, "Dy2": b, "Dx3": b, "Dx4": b, "Alp2": 0}
    cone = {"Rmin1": 0, "Rmax1": a, "Rmin2": 0, "Rmax2": b, "Height": last, "PhiStart": 0, "DeltaPhi": 360}
    shape, settings = {
        "box": ("box", {"XLength": a, "YLength": b, "ZLength": last}),
        "cylinder": ("cylinder", {"Rmin": 0, "Rmax": a, "Height": last}),
        "cone": ("cone", cone),
        "trd": ("trap", {"Dz": last / 2, "Theta": 0, "Phi": 0, **square}),
    }[part.shape]
    sizes = (f"geometry/set{key} {_n(x)} {'deg' if key in _IN_DEGREES else 'mm'}" for key, x in settings.items())
    made = _under(f"/gate/{part.mother}/daughters", f"name {part.name}", f"insert {shape}")
    return made + _under(f"/gate/{part.name}", *sizes, f"setMaterial {part.material}")


def _centered(part: Placed) -> list[str]:
    """A volume at one place, not turned."""
    return [*_volume(part), f"/gate/{part.name}/placement/setTranslation {_n(*part.centers[0])} mm"]


def _repeated(folder: _Folder, part: Placed) -> list[str]:
    """A volume at all its places."""
    file = f"genericRepeater/setPlacementsFilename {folder.placements(part)}"
    commands = "repeaters/insert genericRepeater", file, "genericRepeater/useRelativeTranslation 0"
    return _volume(part) + _under(f"/gate/{part.name}", *commands)


def _head(folder: _Folder, crystal: Placed, name: str) -> str:
    """The system's base, a box of air close around the crystal, and the crystal in it."""
    side, _, thickness = crystal.size
    size = (side + 2 * _MARGIN, side + 2 * _MARGIN, thickness + _MARGIN)
    k = crystal.rotations[:, :, 2]
    box = Placed(name, "world", "box", size, "Air", crystal.centers - _MARGIN / 2 * k, crystal.rotations)
    inside = crystal._replace(mother=name, centers=np.array([[0.0, 0.0, _MARGIN / 2]]))
    made, *rest = _repeated(folder, box)
    kind = [] if name == "SPECThead" else ["/gate/world/daughters/systemType scanner"]
    level = "crystal" if name == "SPECThead" else "level1"
    attached = [f"/gate/systems/{name}/{level}/attach {crystal.name}", f"/gate/{crystal.name}/attachCrystalSD"]
    return folder.macro(f"geometry/{name}", [made, *kind, *rest, *_centered(inside), *attached])


def _digitizer(folder: _Folder, crystal: str, simulation: Simulation) -> str:
    """The singles of one sensitive detector, and those in the energy window.

    The window is a digitizer of its own, with this one module: GATE's projections read the first module of theirs.
    """
    singles = ["insert adder", "adder/positionPolicy energyWeightedCentroid"]
    singles += ["insert readout", "readout/setPolicy TakeEnergyWinner", "readout/setDepth 1"]
    if simulation.energy_resolution:
        singles += ["insert energyResolution", f"energyResolution/fwhm {_n(simulation.energy_resolution)}"]
        singles += [f"energyResolution/energyOfReference {_n(REFERENCE_ENERGY)} keV"]
    if simulation.intrinsic_fwhm:
        singles += ["insert spatialResolution", f"spatialResolution/fwhm {_n(simulation.intrinsic_fwhm)} mm"]
        singles += ["spatialResolution/confineInsideOfSmallestElement true"]
    low, high = simulation.window
    window = ["setInputCollection Singles", "insert energyFraming"]
    window += [f"energyFraming/setMin {_n(low)} keV", f"energyFraming/setMax {_n(high)} keV"]
    detector = f"/gate/digitizerMgr/{crystal}/SinglesDigitizer"
    lines = _under(f"{detector}/Singles", *singles)
    lines += _under("/gate/digitizerMgr", "name Window", f"chooseSD {crystal}", "insert SinglesDigitizer")
    return folder.macro(f"digitizer/{crystal}", lines + _under(f"{detector}/Window", *window))


def _source(folder: _Folder, setup: Setup, simulation: Simulation) -> list[str]:
    """A point, or a source for each sector: a cylinder around its rods, confined to them."""
    energies = "".join(f"{_n(energy / 1000, photons)}\n" for energy, photons in simulation.nuclide.lines)
    spectrum = folder.write("spectrum.txt", "1 0\n" + energies)
    pose = simulation.world_from_phantom
    photons_per_decay = sum(photons for _, photons in simulation.nuclide.lines)

    def source(name: str, activity: float, center: Floats, *shape: str) -> list[str]:
        settings = [
            *("gps/particle gamma", "gps/ene/type UserSpectrum", f"gps/setSpectrumFile {spectrum}"),
            *(f"setActivity {_n(activity * photons_per_decay)} becquerel", "setForcedUnstableFlag true"),
            *(f"setForcedHalfLife {_n(simulation.nuclide.half_life)} s", "gps/ang/type iso"),
            *_under("gps/pos", *shape, f"centre {_n(*center)} mm"),
        ]
        return [f"/gate/source/addSource {name} gps", *_under(f"/gate/source/{name}", *settings)]

    if setup.phantom is None:
        return source("point", simulation.becquerels, pose[:3, 3], "type Point")
    macros = []
    for rods, activity in setup.rods:
        radius, height = rods.size
        middle = rods.centers.mean(axis=0)
        around = np.linalg.norm(rods.centers - middle, axis=1).max() + radius
        name = rods.name.replace("rods", "sector")
        shape = ["type Volume", "shape Cylinder", f"radius {_n(around)} mm", f"halfz {_n(height / 2)} mm"]
        shape += [f"rot1 {_n(*pose[:3, 0])}", f"rot2 {_n(*pose[:3, 1])}", f"confine {rods.name}_phys"]
        lines = source(name, activity, pose[:3, :3] @ middle + pose[:3, 3], *shape)
        macros.append(folder.macro(f"sources/{name}", lines))
    return _execute(macros)
