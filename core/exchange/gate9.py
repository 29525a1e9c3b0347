"""Format of GATE 9 macros (9.3 and later, whose digitizer has another syntax): a folder of files, ``main.mac`` first.

The system is GATE's SPECThead: its base can be repeated from a list of placements, each copy is a head with its own number,
and only this system writes projections, one image per head. SPECThead supports one kind of crystal. Where crystals differ in
size, each kind is a system of type scanner with its own digitizer and singles, and there are no projections.

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
from .monte_carlo import REFERENCE_ENERGY, GateGeometry, PlacedSolids, Simulation, build_geometry, material_database

MAX_LINES = 100
"""Largest number of lines in a macro. Files of placements are data, one line each, and may be longer."""

_MARGIN = 0.1  # mm by which a head's box exceeds its crystal at the sides and behind it
_ANGLES = {"Theta", "Phi", "Alp1", "Alp2", "PhiStart", "DeltaPhi"}  # settings in degrees; all others are in mm


def _write(system: PinholeSystem, views: Views, temporary: Path, **options: Any) -> None:
    """Write the macros into the folder `temporary`; the projections have the shape (n_v, n_u) of the views."""
    simulation = Simulation(**options)
    geometry = build_geometry(system, simulation)
    folder = _MacroFolder(temporary)
    folder.write("GateMaterials.db", material_database())
    crystals = [solids for solids, _ in geometry.crystals]
    has_one_size = len(crystals) == 1
    heads = [_write_head(folder, c, "SPECThead" if has_one_size else f"head{i}") for i, c in enumerate(crystals, 1)]
    collimators = [
        folder.write_macro(f"geometry/{solid.name}", sum(map(_single_commands, air), _repeated_commands(folder, solid)))
        for solid, *air in geometry.collimators
    ]
    world = _prefixed("/gate/world", *(f"geometry/set{axis}Length {_n(geometry.world)} mm" for axis in "XYZ"))
    macros = [folder.write_macro("geometry/world", [*world, "/gate/world/setMaterial Air"])]
    macros += [folder.write_list("geometry/heads", heads), folder.write_list("geometry/collimators", collimators)]
    if geometry.phantom is not None:
        volumes = (geometry.phantom, *(rods for rods, _ in geometry.rods))
        commands = [line for solids in volumes for line in _repeated_commands(folder, solids)]
        macros.append(folder.write_macro("geometry/phantom", commands))
    cuts = _prefixed("/gate/physics", *(f"{p}/SetCutInRegion world 0.1 mm" for p in ("Gamma", "Electron", "Positron")))
    flags = ("setRootHitFlag 0", "setRootNtupleFlag 0", "setRootSinglesFlag 1")
    singles = _prefixed("/gate/output/root", "enable", "setFileName singles", *flags)
    side, (n_v, n_u) = crystals[0].size[0], views.shape
    pixels = [f"pixelSizeX {_n(side / n_u)} mm", f"pixelSizeY {_n(side / n_v)} mm"]
    pixels += [f"pixelNumberX {n_u}", f"pixelNumberY {n_v}"]
    plane = ("enable", "setFileName projections", "projectionPlane XY")
    projections = _prefixed("/gate/output/projection", *plane, *pixels, "setInputDataName Window")
    digitizers = [_write_digitizer(folder, solids.name, simulation) for solids in crystals]
    lines = [
        f"# {len(system)} pinhole modules in GATE 9.3 or later. Run it from this folder: Gate main.mac",
        "/gate/geometry/setMaterialDatabase GateMaterials.db",
        *_execute(macros),
        *_execute([folder.write_macro("physics", ["/gate/physics/addPhysicsList emstandard_opt4", *cuts])]),
        "/gate/run/initialize",
        *_execute([folder.write_list("digitizer/all", digitizers)]),
        *_execute([folder.write_macro("source", _write_sources(folder, geometry, simulation))]),
        *_execute([folder.write_macro("output", singles)]),
        *(_execute([folder.write_macro("projections", projections)]) if has_one_size else []),
        "/gate/random/setEngineName MersenneTwister",
        f"/gate/random/setEngineSeed {int(simulation.seed)}",
        f"/gate/application/setTimeSlice {_n(simulation.time)} s",
        "/gate/application/setTimeStart 0 s",
        f"/gate/application/setTimeStop {_n(simulation.time)} s",
        "/gate/application/startDAQ",
    ]
    folder.write_macro("main", lines)
    copies = sorted((m, c.name, copy) for c, modules in geometry.crystals for copy, m in enumerate(modules))
    table = ["# module, its crystal's volume, the copy of that crystal's head from 0"]
    table += [f"{system.numbers[m]} {crystal} {copy}" for m, crystal, copy in copies]
    folder.write("modules.txt", "\n".join(table) + "\n")


GATE9 = Format("gate9", "GATE 9.3 macros: a folder, to run by Gate main.mac", (), _write, options_source=Simulation)


class _MacroFolder:
    """Folder of the export with methods that write its files; macros are named by their path without the ending."""

    def __init__(self, temporary: Path) -> None:
        self.folder = temporary

    def write(self, name: str, text: str) -> str:
        """Write a text file and return its path relative to the folder."""
        temporary = self.folder / name
        temporary.parent.mkdir(parents=True, exist_ok=True)
        temporary.write_text(text, encoding="ascii", newline="\n")
        return name

    def write_macro(self, name: str, lines: Iterable[str]) -> str:
        """Write a macro of these lines and return its path."""
        lines = list(lines)
        assert len(lines) <= MAX_LINES, f"{name}: {len(lines)} lines"
        return self.write(f"{name}.mac", "\n".join(lines) + "\n")

    def write_list(self, name: str, macros: list[str]) -> str:
        """Write a macro that executes `macros`, through further macros where it would be too long; return its path."""
        n = 0  # number of further macros so far
        while len(macros) > MAX_LINES:
            groups = [macros[i : i + MAX_LINES] for i in range(0, len(macros), MAX_LINES)]
            macros = [self.write_macro(f"{name}_{n + i + 1}", _execute(group)) for i, group in enumerate(groups)]
            n += len(groups)
        return self.write_macro(name, _execute(macros))

    def write_placements(self, solids: PlacedSolids) -> str:
        """Write the placements of solids, one line each, and return the file's path."""
        lines = ["# rotation of the mother's frame into the solid's (angle, axis), then the solid's centre"]
        lines += ["Time s", "Rotation deg", "Translation mm"]
        for center, rotation in zip(solids.centers, solids.rotations, strict=True):
            angle, axis = angle_and_axis(rotation.T)
            lines.append("0 " + " ".join(_n(x) for x in (np.degrees(angle), *axis, *center)))
        return self.write(f"placements/{solids.name}.placements", "\n".join(lines) + "\n")


def angle_and_axis(rotation: Floats) -> tuple[float, Floats]:
    """Return the angle, 0 to pi, and the unit axis of a rotation matrix (3, 3); the axis of the identity is z."""
    from nibabel.quaternions import mat2quat

    cosine, *axis = mat2quat(rotation)  # cosine and sine of half the angle
    sine = float(np.linalg.norm(axis))
    return 2 * math.atan2(sine, cosine), np.array(axis) / sine if sine else np.array([0.0, 0.0, 1.0])


def _n(*numbers: float) -> str:
    """Return numbers as text with 12 significant digits, separated by spaces."""
    return " ".join(f"{number:.12g}" for number in numbers)


def _prefixed(prefix: str, *commands: str) -> list[str]:
    """Return commands within a command folder of GATE."""
    return [f"{prefix}/{command}" for command in commands]


def _execute(macros: Iterable[str]) -> list[str]:
    """Return the commands that execute macros."""
    return [f"/control/execute {name}" for name in macros]


def _volume_commands(solids: PlacedSolids) -> list[str]:
    """Return the commands that create the volume of solids, without a placement."""
    a, b, last = solids.size[0], solids.size[1], solids.size[-1]
    square = {"Dy1": a, "Dx1": a, "Dx2": a, "Alp1": 0, "Dy2": b, "Dx3": b, "Dx4": b, "Alp2": 0}
    cone = {"Rmin1": 0, "Rmax1": a, "Rmin2": 0, "Rmax2": b, "Height": last, "PhiStart": 0, "DeltaPhi": 360}
    shape, settings = {
        "box": ("box", {"XLength": a, "YLength": b, "ZLength": last}),
        "cylinder": ("cylinder", {"Rmin": 0, "Rmax": a, "Height": last}),
        "cone": ("cone", cone),
        "trd": ("trap", {"Dz": last / 2, "Theta": 0, "Phi": 0, **square}),
    }[solids.shape]
    sizes = (f"geometry/set{key} {_n(x)} {'deg' if key in _ANGLES else 'mm'}" for key, x in settings.items())
    commands = _prefixed(f"/gate/{solids.mother}/daughters", f"name {solids.name}", f"insert {shape}")
    return commands + _prefixed(f"/gate/{solids.name}", *sizes, f"setMaterial {solids.material}")


def _single_commands(solids: PlacedSolids) -> list[str]:
    """Return the commands that create a volume at its first centre, not turned."""
    return [*_volume_commands(solids), f"/gate/{solids.name}/placement/setTranslation {_n(*solids.centers[0])} mm"]


def _repeated_commands(folder: _MacroFolder, solids: PlacedSolids) -> list[str]:
    """Return the commands that create a volume at all its placements, which are written into a file."""
    file = f"genericRepeater/setPlacementsFilename {folder.write_placements(solids)}"
    commands = "repeaters/insert genericRepeater", file, "genericRepeater/useRelativeTranslation 0"
    return _volume_commands(solids) + _prefixed(f"/gate/{solids.name}", *commands)


def _write_head(folder: _MacroFolder, crystal: PlacedSolids, name: str) -> str:
    """Write the macro of a system's base, a box of air close around the crystal, with the crystal in it; return its path."""
    side, _, thickness = crystal.size
    size = (side + 2 * _MARGIN, side + 2 * _MARGIN, thickness + _MARGIN)
    k = crystal.rotations[:, :, 2]
    box = PlacedSolids(name, "world", "box", size, "Air", crystal.centers - _MARGIN / 2 * k, crystal.rotations)
    inner_crystal = crystal._replace(mother=name, centers=np.array([[0.0, 0.0, _MARGIN / 2]]))
    creation, *placing = _repeated_commands(folder, box)
    system_type = [] if name == "SPECThead" else ["/gate/world/daughters/systemType scanner"]
    level = "crystal" if name == "SPECThead" else "level1"
    attachments = [f"/gate/systems/{name}/{level}/attach {crystal.name}", f"/gate/{crystal.name}/attachCrystalSD"]
    commands = [creation, *system_type, *placing, *_single_commands(inner_crystal), *attachments]
    return folder.write_macro(f"geometry/{name}", commands)


def _write_digitizer(folder: _MacroFolder, crystal: str, simulation: Simulation) -> str:
    """Write the macro of a crystal's digitizers, for all singles and for those in the energy window; return its path.

    The window is a separate digitizer with one module, since GATE's projections read the first module of a digitizer.
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
    lines = _prefixed(f"{detector}/Singles", *singles)
    lines += _prefixed("/gate/digitizerMgr", "name Window", f"chooseSD {crystal}", "insert SinglesDigitizer")
    return folder.write_macro(f"digitizer/{crystal}", lines + _prefixed(f"{detector}/Window", *window))


def _write_sources(folder: _MacroFolder, geometry: GateGeometry, simulation: Simulation) -> list[str]:
    """Return the commands of a point source, or of a source per sector: a cylinder around its rods, confined to these."""
    energies = "".join(f"{_n(energy / 1000, photons)}\n" for energy, photons in simulation.nuclide.lines)
    spectrum = folder.write("spectrum.txt", "1 0\n" + energies)
    pose = simulation.world_from_phantom
    photons_per_decay = sum(photons for _, photons in simulation.nuclide.lines)

    def source(name: str, activity: float, center: Floats, *shape: str) -> list[str]:
        """Return the commands of a source with an activity, Bq, and a centre, mm."""
        settings = [
            *("gps/particle gamma", "gps/ene/type UserSpectrum", f"gps/setSpectrumFile {spectrum}"),
            *(f"setActivity {_n(activity * photons_per_decay)} becquerel", "setForcedUnstableFlag true"),
            *(f"setForcedHalfLife {_n(simulation.nuclide.half_life)} s", "gps/ang/type iso"),
            *_prefixed("gps/pos", *shape, f"centre {_n(*center)} mm"),
        ]
        return [f"/gate/source/addSource {name} gps", *_prefixed(f"/gate/source/{name}", *settings)]

    if geometry.phantom is None:
        return source("point", simulation.becquerels, pose[:3, 3], "type Point")
    macros = []
    for rods, activity in geometry.rods:
        radius, height = rods.size
        sector_center = rods.centers.mean(axis=0)
        sector_radius = np.linalg.norm(rods.centers - sector_center, axis=1).max() + radius
        name = rods.name.replace("rods", "sector")
        shape = ["type Volume", "shape Cylinder", f"radius {_n(sector_radius)} mm", f"halfz {_n(height / 2)} mm"]
        shape += [f"rot1 {_n(*pose[:3, 0])}", f"rot2 {_n(*pose[:3, 1])}", f"confine {rods.name}_phys"]
        lines = source(name, activity, pose[:3, :3] @ sector_center + pose[:3, 3], *shape)
        macros.append(folder.write_macro(f"sources/{name}", lines))
    return _execute(macros)
