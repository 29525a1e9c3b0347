"""GATE 9 macros and the GATE 10 script, read back and compared with their geometry."""

import importlib.util
import itertools
import json
import os
import re
import subprocess
import sys
import types
import typing
from collections import defaultdict
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.exchange import FORMATS
from mphdrr.core.exchange.gate9 import MAX_LINES, angle_and_axis

from .conftest import refused

SHAPE = (40, 60)
POSE = mph.euler_pose(0.4, 0.9, -0.3, (3.0, -5.0, 8.0))

# Every command that may occur, from the documentation and source of GATE 9.3; NAME is a volume, source or detector.
COMMANDS = re.compile(
    "|".join(
        pattern.replace("NAME", r"\w+")
        for pattern in (
            r"/control/execute",
            r"/gate/geometry/setMaterialDatabase",
            r"/gate/NAME/daughters/(name|insert|systemType)",
            r"/gate/NAME/setMaterial",
            r"/gate/NAME/geometry/set[XYZ]Length",
            r"/gate/NAME/geometry/set(Dz|Theta|Phi|Dy1|Dx1|Dx2|Alp1|Dy2|Dx3|Dx4|Alp2)",
            r"/gate/NAME/geometry/set(Rmin|Rmin1|Rmin2|Rmax|Rmax1|Rmax2|Height|PhiStart|DeltaPhi)",
            r"/gate/NAME/placement/setTranslation",
            r"/gate/NAME/repeaters/insert",
            r"/gate/NAME/genericRepeater/(setPlacementsFilename|useRelativeTranslation)",
            r"/gate/systems/SPECThead/crystal/attach",
            r"/gate/systems/NAME/level1/attach",
            r"/gate/NAME/attachCrystalSD",
            r"/gate/physics/addPhysicsList",
            r"/gate/physics/(Gamma|Electron|Positron)/SetCutInRegion",
            r"/gate/run/initialize",
            r"/gate/digitizerMgr/(name|chooseSD|insert)",
            r"/gate/digitizerMgr/NAME/SinglesDigitizer/NAME/(insert|setInputCollection)",
            r"/gate/digitizerMgr/NAME/SinglesDigitizer/NAME/adder/positionPolicy",
            r"/gate/digitizerMgr/NAME/SinglesDigitizer/NAME/readout/(setPolicy|setDepth)",
            r"/gate/digitizerMgr/NAME/SinglesDigitizer/NAME/energyResolution/(fwhm|energyOfReference)",
            r"/gate/digitizerMgr/NAME/SinglesDigitizer/NAME/spatialResolution/(fwhm|confineInsideOfSmallestElement)",
            r"/gate/digitizerMgr/NAME/SinglesDigitizer/NAME/energyFraming/(setMin|setMax)",
            r"/gate/source/addSource",
            r"/gate/source/NAME/(setActivity|setForcedUnstableFlag|setForcedHalfLife)",
            r"/gate/source/NAME/gps/(particle|ene/type|setSpectrumFile|ang/type)",
            r"/gate/source/NAME/gps/pos/(type|shape|radius|halfz|centre|confine|rot1|rot2)",
            r"/gate/output/root/(enable|setFileName|setRootHitFlag|setRootNtupleFlag|setRootSinglesFlag)",
            r"/gate/output/projection/(enable|setFileName|projectionPlane|setInputDataName)",
            r"/gate/output/projection/(pixelSize|pixelNumber)[XY]",
            r"/gate/random/(setEngineName|setEngineSeed)",
            r"/gate/application/(setTimeSlice|setTimeStart|setTimeStop|startDAQ)",
        )
    )
)


class Volume(NamedTuple):
    """Volume of a macro: its solid, and its placements in its mother as GATE 9 hands them to Geant4."""

    mother: str
    shape: str
    settings: dict[str, list[str]]
    centers: np.ndarray
    frames: np.ndarray  # (N, 3, 3): from the mother's axes to the volume's, as G4PVPlacement takes it

    def length(self, name: str) -> float:
        value, unit = self.settings[f"geometry/{name}"]
        assert unit == "mm"
        return float(value)

    def world(self, point: tuple[float, float, float]) -> np.ndarray:
        """Return a point of the solid at each of its places, (N, 3), in the mother's frame."""
        return self.centers + np.einsum("nij,i->nj", self.frames, point)

    def sizes(self) -> tuple[float, float, float]:
        """Return half widths or radii at the lower and the upper end of a frustum, and its height, mm."""
        if self.shape == "trap":
            assert all(self.settings[f"geometry/set{a}"] == ["0", "deg"] for a in ("Theta", "Phi", "Alp1", "Alp2"))
            ends = ("Dx1", "Dy1", "Dx2"), ("Dx3", "Dy2", "Dx4")
            lower, upper = ([self.length(f"set{a}") for a in axes] for axes in ends)
            assert len({*lower}) == len({*upper}) == 1
            return lower[0], upper[0], 2 * self.length("setDz")
        assert self.shape == "cone"
        return self.length("setRmax1"), self.length("setRmax2"), self.length("setHeight")


class Macros:
    """Folder of macros, read as GATE would, from main.mac on."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.used = folder, {folder / "main.mac"}
        self.commands: list[tuple[str, list[str]]] = []
        self._execute(folder / "main.mac")
        self.volumes = self._volumes()

    def _execute(self, path: Path) -> None:
        lines = path.read_text().splitlines()
        assert len(lines) <= MAX_LINES, path
        for line in lines:
            if line.startswith("#"):
                continue
            command, *words = line.split()
            assert COMMANDS.fullmatch(command), line
            self.commands.append((command, words))
            if command == "/control/execute":
                self.used.add(self.folder / words[0])
                self._execute(self.folder / words[0])

    def _file(self, name: str) -> Path:
        self.used.add(self.folder / name)
        return self.folder / name

    def _volumes(self) -> dict[str, Volume]:
        volumes: dict[str, dict] = {"world": {"mother": "", "shape": "box"}}
        settings: dict[str, dict[str, list[str]]] = defaultdict(dict)
        named = None
        for command, words in self.commands:
            _, root, name, *rest = command.split("/")
            key = "/".join(rest)
            if root != "gate" or name in (
                "geometry", "systems", "physics", "run", "digitizerMgr", "source", "output", "random", "application",
            ):  # fmt: skip
                continue
            assert name in volumes, f"{command} before {name} is made"
            if key == "daughters/name":
                (named,) = words
            elif key == "daughters/insert":
                assert named not in volumes
                volumes[named] = {"mother": name, "shape": words[0]}
            else:
                settings[name][key] = words
        places = {name: self._places(settings[name]) for name in volumes}
        return {name: Volume(**v, settings=settings[name], **places[name]) for name, v in volumes.items()}

    def _places(self, settings: dict[str, list[str]]) -> dict[str, np.ndarray]:
        if "repeaters/insert" not in settings:
            *xyz, unit = settings.get("placement/setTranslation", ["0", "0", "0", "mm"])
            assert unit == "mm"
            return {"centers": np.array([xyz], float), "frames": np.eye(3)[None]}
        lines = self._file(settings["genericRepeater/setPlacementsFilename"][0]).read_text().splitlines()
        lines = [line for line in lines if not line.startswith("#")]
        assert lines[:3] == ["Time s", "Rotation deg", "Translation mm"]
        table = np.array([line.split() for line in lines[3:]], float)
        assert table.shape[1] == 8 and not table[:, 0].any()
        return {"centers": table[:, 5:], "frames": np.stack([rodrigues(np.radians(r[1]), r[2:5]) for r in table])}

    def values(self, pattern: str) -> list[list[str]]:
        return [words for command, words in self.commands if re.fullmatch(pattern, command)]


def rodrigues(angle: float, axis: np.ndarray) -> np.ndarray:
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def export(system: mph.PinholeSystem, path: Path, format: str, **options) -> Path:
    mph.write_geometry(system, path, format, views=system.views(SHAPE, "real"), **options)
    return path


def crystal_points(system: mph.PinholeSystem, u: float, v: float, depth: float) -> np.ndarray:
    """Return points (M, 3) of the crystals: u and v in half sides, depth in thicknesses behind the front face."""
    half, behind = system.detector_side / 2, system.collimator_length + depth * system.detector_thickness
    return system.centers + np.einsum("mij,mi->mj", system.frames(), np.stack([u * half, v * half, -behind], axis=1))


@pytest.mark.parametrize("phantom", ["point", "derenzo"])
def test_macros_of_the_scanner_say_where_its_crystals_and_holes_are(scanner, tmp_path, phantom) -> None:
    macros = Macros(export(scanner, tmp_path / "out", "gate9", phantom=phantom))
    head, crystal = macros.volumes["SPECThead"], macros.volumes["crystal"]
    assert len(head.centers) == len(scanner) and crystal.mother == "SPECThead"
    half = np.array([crystal.length(f"set{axis}Length") for axis in "XYZ"]) / 2
    box = np.array([head.length(f"set{axis}Length") for axis in "XYZ"]) / 2
    assert np.all(np.abs(crystal.centers[0]) + half <= box + 1e-12)
    for u, v, depth in itertools.product((-1, 0.3, 1), (-1, -0.6, 1), (0, 0.5, 1)):
        point = crystal.world((u * half[0], v * half[1], (1 - 2 * depth) * half[2]))[0]
        np.testing.assert_allclose(head.world(point), crystal_points(scanner, u, v, depth), atol=1e-6)

    classes = {name: v for name, v in macros.volumes.items() if re.fullmatch(r"collimator_\d+", name)}
    assert len(classes) == len(np.unique(scanner.collimator_length.round(6))) == 40
    seen = []
    for name, solid in classes.items():
        front, back = macros.volumes[f"front_{name}"], macros.volumes[f"back_{name}"]
        waist = (0, 0, -front.length("setHeight") / 2)
        hole = solid.world(front.world(waist)[0])
        m = np.argmin(np.linalg.norm(scanner.centers - hole[:, None], axis=2), axis=1)
        seen += m.tolist()
        np.testing.assert_allclose(hole, scanner.centers[m], atol=1e-6)
        np.testing.assert_allclose(solid.world(back.world((0, 0, back.length("setHeight") / 2))[0]), hole, atol=1e-6)
        assert 2 * front.length("setRmax1") == 2 * back.length("setRmax2") == scanner.pinhole_diameter[m[0]]
        assert front.length("setHeight") + back.length("setHeight") == 2  # the plate's thickness
        # It ends at the crystal's front face, with walls of 2 mm, its sides along u and v.
        corner, share = solid.world((25.0, -25.0, -solid.length("setDz"))), 50 / scanner.detector_side[m[0]]
        np.testing.assert_allclose(corner, crystal_points(scanner[m], share, -share, 0), atol=1e-6)
        assert solid.length("setDx1") - macros.volumes[f"channel_{name}"].length("setDx1") == 2
    assert sorted(seen) == list(range(len(scanner)))


def test_macros_of_any_scanner_hang_together(system, tmp_path) -> None:
    folder = export(system, tmp_path / "out", "gate9", phantom="derenzo", crystal="CZT", collimator="Lead")
    macros = Macros(folder)
    (database,) = macros.values("/gate/geometry/setMaterialDatabase")[0]
    spectra = {words[0] for words in macros.values(".*/gps/setSpectrumFile")}
    macros.used |= {folder / name for name in (database, "modules.txt", *spectra)}
    assert {p for p in folder.rglob("*") if p.is_file()} == macros.used  # no file is missing, none is left over
    # Crystals of twelve sizes are twelve systems, each with its detector and its digitizer.
    detectors = [c.split("/")[2] for c, _ in macros.commands if c.endswith("/attachCrystalSD")]
    assert len(detectors) == len(system)
    attached = {c.split("/")[3]: words[0] for c, words in macros.commands if c.endswith("/level1/attach")}
    assert len(macros.values("/gate/world/daughters/systemType")) == len(system)
    known = re.findall(r"^(\w+):", (folder / database).read_text(), re.M)
    rows = [line.split() for line in (folder / "modules.txt").read_text().splitlines()[1:]]
    whose = {(crystal, copy): number for number, crystal, copy in rows}
    for head, crystal in attached.items():
        volume = macros.volumes[crystal]
        assert volume.mother == head and crystal in detectors
        place = macros.volumes[head].world(volume.centers[0])[0]
        (m,) = np.flatnonzero(system.numbers == int(whose[crystal, "0"]))
        np.testing.assert_allclose(place, crystal_points(system, 0, 0, 0.5)[m], atol=1e-6)
        assert volume.length("setXLength") == pytest.approx(system.detector_side[m], abs=1e-9)
        assert volume.length("setZLength") == pytest.approx(system.detector_thickness[m], abs=1e-9)
        modules = [words[0] for words in macros.values(f"/gate/digitizerMgr/{crystal}/SinglesDigitizer/\\w+/insert")]
        assert modules == ["adder", "readout", "energyResolution", "spatialResolution", "energyFraming"]
    assert {v.settings["setMaterial"][0] for v in macros.volumes.values()} == {"Air", "CZT", "Lead"} <= set(known)
    # Everything lies in the world.
    reach = float(macros.volumes["world"].length("setXLength")) / 2
    for volume in macros.volumes.values():
        if volume.mother == "world":
            assert np.abs(volume.centers).max() < reach - 50


def test_heads_on_the_axes(tmp_path) -> None:
    """With rotations by 0, 90 and 180 degrees, and on the z axis, where z × k is 0."""
    centers = 200 * np.concatenate([np.eye(3), -np.eye(3), [[0.6, 0, 0.8]]])
    system = mph.PinholeSystem(centers, 2.0, 60.0, 50.0, 10.0, 75.0)
    for chosen in (system, *(system[m] for m in range(len(system)))):
        head = Macros(export(chosen, tmp_path / f"{chosen.numbers}", "gate9")).volumes["SPECThead"]
        for u, v in ((0.3, 1), (-1, 0.2)):
            point = (u * 25, v * 25, 5 + 0.05)  # in the head, whose middle is half its margin behind the crystal's
            np.testing.assert_allclose(head.world(point), crystal_points(chosen, u, v, 0), atol=1e-6)


def test_a_scanner_of_many_kinds_of_module_has_no_long_macro(tmp_path) -> None:
    n = 2 * MAX_LINES + 30
    angles = np.linspace(0, 2 * np.pi, n, endpoint=False)
    centers = np.stack([900 * np.cos(angles), 900 * np.sin(angles), np.zeros(n)], axis=1)
    many = mph.PinholeSystem(centers, 2.0, np.linspace(50, 60, n), np.linspace(10, 12, n), 5.0, 75.0)
    macros = Macros(export(many, tmp_path / "out", "gate9"))
    assert sum(name.startswith("collimator_") for name in macros.volumes) == n
    assert len({c for c, _ in macros.commands if c.endswith("/attachCrystalSD")}) == n


def test_derenzo_rods_are_sources_in_their_pose(scanner, tmp_path) -> None:
    phantom = mph.DerenzoPhantom(45, (9, 7, 0, 5, 4, 3), 30, activity=250)
    folder = export(scanner, tmp_path / "g9", "gate9", phantom=phantom, pose=POSE, isotope="In-111")
    macros = Macros(folder)
    body = macros.volumes["phantom"]
    np.testing.assert_allclose(body.frames[0].T, POSE[:3, :3], atol=1e-12)
    photons = sum(p for _, p in mph.ISOTOPES["In-111"].lines)
    total, table = 0.0, phantom.rods()
    for sector in np.unique(table[:, 0]).astype(int):
        rods, own = macros.volumes[f"rods_{sector}"], table[table[:, 0] == sector]
        assert rods.mother == "phantom" and np.array_equal(rods.frames, np.broadcast_to(np.eye(3), (len(own), 3, 3)))
        np.testing.assert_allclose(rods.centers[:, :2], own[:, 1:3], atol=1e-9)
        assert 2 * rods.length("setRmax") == own[0, 3] and rods.length("setHeight") == phantom.height
        s = f"/gate/source/sector_{sector}"
        (activity,) = macros.values(f"{s}/setActivity")
        volume = len(own) * np.pi / 4 * own[0, 3] ** 2 * phantom.height
        assert float(activity[0]) == pytest.approx(250 * volume * photons, rel=1e-9)  # kBq/mL x mm^3 = Bq
        total += float(activity[0])
        # The cylinder that is sampled has all rods of the sector in it.
        assert macros.values(f"{s}/gps/pos/confine") == [[f"rods_{sector}_phys"]]
        x, y = (np.array(macros.values(f"{s}/gps/pos/rot{i}")[0], float) for i in (1, 2))
        np.testing.assert_allclose([x, y, np.cross(x, y)], POSE[:3, :3].T, atol=1e-9)
        center = np.array(macros.values(f"{s}/gps/pos/centre")[0][:3], float)
        radius, half = (float(macros.values(f"{s}/gps/pos/{k}")[0][0]) for k in ("radius", "halfz"))
        local = (rods.centers @ POSE[:3, :3].T + POSE[:3, 3] - center) @ POSE[:3, :3]
        assert np.all(np.hypot(*local[:, :2].T) + own[:, 3] / 2 <= radius + 1e-6)
        assert half == phantom.height / 2 and np.abs(local[:, 2]).max() < 1e-9
    assert total == pytest.approx(phantom.total_activity * 1e3 * photons)
    mode, *lines = np.loadtxt(folder / "spectrum.txt")
    assert mode[0] == 1
    np.testing.assert_allclose(np.array(lines) * [1e3, 1], mph.ISOTOPES["In-111"].lines, rtol=1e-9)

    folder = export(scanner, tmp_path / "g10", "gate10", phantom=phantom, pose=POSE)
    emitters = json.loads((folder / "simulation.json").read_text())["emitters"]
    assert len(emitters) == len(table) and {e["mother"] for e in emitters} == {"phantom"}
    np.testing.assert_allclose([e["center_mm"][:2] for e in emitters], table[:, 1:3])
    np.testing.assert_allclose([2 * e["radius_mm"] for e in emitters], table[:, 3])
    volumes = np.pi / 4 * table[:, 3] ** 2 * phantom.height
    np.testing.assert_allclose([e["activity_Bq"] for e in emitters], 250 * volumes)


def test_options(scanner, tmp_path) -> None:
    folder = export(
        scanner, tmp_path / "out", "gate9",
        isotope="Tl-201", activity=3.0, time=20, seed=77, window_percent=30, intrinsic_fwhm=0, energy_resolution=0.06,
        position=(1, 2, -3),
    )  # fmt: skip
    macros = Macros(folder)
    assert macros.values("/gate/application/setTimeStop") == [["20", "s"]]
    assert macros.values("/gate/random/setEngineSeed") == [["77"]]
    low, high = (float(macros.values(f".*/energyFraming/{k}")[0][0]) for k in ("setMin", "setMax"))
    assert (low, high) == pytest.approx((71.07 * 0.85, 71.07 * 1.15))
    assert not macros.values(".*/spatialResolution/.*")
    assert macros.values("/gate/source/point/gps/pos/centre") == [["1", "2", "-3", "mm"]]
    photons = 3e6 * sum(p for _, p in mph.ISOTOPES["Tl-201"].lines)
    assert float(macros.values("/gate/source/point/setActivity")[0][0]) == pytest.approx(photons)
    sizes = [float(macros.values(f"/gate/output/projection/pixelSize{k}")[0][0]) for k in "XY"]
    numbers = [int(macros.values(f"/gate/output/projection/pixelNumber{k}")[0][0]) for k in "XY"]
    assert numbers == [SHAPE[1], SHAPE[0]]
    assert np.multiply(sizes, numbers) == pytest.approx(scanner.detector_side[0])
    assert {"phantom", "isotope", "activity", "seed", "plate_thickness"} < set(FORMATS["gate9"].options)
    types = {name: type_ for name, (type_, _) in FORMATS["gate9"].options.items()}
    assert types["time"] is float and types["seed"] is int and typing.get_args(types["crystal"]) == ("NaI", "CZT")
    assert set(FORMATS["gate10"].options) - set(FORMATS["gate9"].options) == {"threads"}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"phantom": "jaszczak"}, "phantom 'jaszczak': expected point, derenzo"),
        ({"isotope": "Xx-1"}, "isotope 'Xx-1'"),
        ({"crystal": "BGO"}, "crystal 'BGO': expected one of NaI, CZT"),
        ({"opening_degrees": 180}, "opening_degrees: expected less than 180"),
        ({"opening_degrees": 175, "plate_thickness": 3}, "its hole is 71.01 mm wide"),
        ({"plate_thickness": 300}, "aperture plate: expected less than the collimator's"),
        ({"edge_at": "top"}, "edge_at 'top': expected one of middle, front, back"),
        ({"time": 0}, "time: expected more than 0 s"),
        ({"seed": 1.5}, "seed: expected a whole number"),
        ({"phantom": "derenzo", "rods": (1, 2)}, "Derenzo rod diameters: expected one for each of 6 sectors"),
        ({"position": "here"}, "position: expected real numbers"),
        ({"pose": np.diag([1.0, 1, -1, 1])}, "phantom pose: expected a rotation"),
        ({"phantom": "derenzo", "radius": 250}, "begins inside the phantom"),
        ({"energy": 3}, "no option 'energy'"),
    ],
)  # fmt: skip
def test_what_cannot_be_simulated_is_refused_in_one_line(scanner, tmp_path, options, message) -> None:
    for format in ("gate9", "gate10"):
        refused(lambda format=format: mph.write_geometry(scanner, tmp_path / "out", format, **options), message)
        assert not list(tmp_path.iterdir())


def test_half_turns_have_an_axis(rng) -> None:
    for _ in range(20):
        axis = rng.normal(size=3)
        for angle in (0.0, 1e-9, 1.0, np.pi - 1e-9, np.pi):
            turn = rodrigues(angle, axis)
            np.testing.assert_allclose(rodrigues(*angle_and_axis(turn)), turn, atol=1e-12)


def load_script(folder: Path):
    spec = importlib.util.spec_from_file_location("gate10_simulation", folder / "simulation.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module, json.loads((folder / "simulation.json").read_text())


def test_the_script_bins_singles_into_the_real_detectors_pixels(system, tmp_path, rng) -> None:
    script, data = load_script(export(system, tmp_path / "out", "gate10"))
    views = system.views(SHAPE, "real")
    targets = rng.uniform(-10, 10, (40, 3))
    for m, matrix in enumerate(views.projection_matrices()):
        column, row, w = matrix @ np.column_stack([targets, np.ones(len(targets))]).T
        column, row = np.rint([column / w, row / w]).astype(int)
        # Where the ray from each target through the pinhole meets the crystal, a little behind its front face.
        _, _, k = system.frames()[m]
        away = system.centers[m] - targets
        points = system.centers[m] + away * ((system.collimator_length[m] + 1e-4) / (away @ -k))[:, None]
        expected = np.zeros(SHAPE)
        np.add.at(expected, (row, column), 1)
        found = script.images(data, points)
        assert np.array_equal(found[m], expected) and found.sum() == len(targets)


# Geant4 is built once per process, so each of these tests runs in a process of its own.
_DRIVER = """
import json, sys
import simulation as script
data = json.loads(open("simulation.json").read())
made = script.build(data, data["threads"])
script.construct(made)
def matrix(r):  # None: not turned
    return [[1, 0, 0], [0, 1, 0], [0, 0, 1]] if r is None else [[getattr(r, a + b)() for b in "xyz"] for a in "xyz"]
placed = {}
for part in data["volumes"]:
    volumes = made.volume_manager.get_volume(part["name"]).g4_physical_volumes
    centers = [p.GetObjectTranslation() for p in volumes]
    placed[part["name"]] = {
        "cubic": made.volume_manager.get_volume(part["name"]).solid_info.cubic_volume,
        "centers": [[c.x, c.y, c.z] for c in centers],
        "rotations": [matrix(p.GetObjectRotationValue()) for p in volumes],
        "frames": [matrix(p.GetFrameRotation()) for p in volumes],
    }
actors = made.actor_manager.actors.values()
(source,) = list(made.source_manager.sources.values())[:1]
described = {
    "placed": placed,
    "chain": [[a.name, a.attached_to, getattr(a, "input_digi_collection", None)] for a in actors],
    "channels": [dict(a.channels[0]) for a in actors if hasattr(a, "channels")],
    "source": [source.activity, list(source.energy.spectrum_energies), source.half_life, source.attached_to],
    "sources": len(made.source_manager.sources),
    "run": [made.random_seed, made.number_of_threads, made.run_timing_intervals],
}
json.dump(described, open("described.json", "w"))
"""


def run_gate10(folder: Path, *command: str, **variables: str) -> str:
    """Return the output of GATE 10; it must not look for Geant4's data, which it would download."""
    options = {"cwd": folder, "env": {**os.environ, "GATEONRTD": "1", **variables}, "timeout": 600}
    run = subprocess.run([sys.executable, *command], capture_output=True, text=True, **options)
    assert run.returncode == 0, run.stderr
    return run.stdout + run.stderr


has_gate10 = importlib.util.find_spec("opengate") is not None
needs_gate10 = pytest.mark.skipif(not has_gate10, reason="needs opengate (GATE 10): pip install opengate")


def cubic(shape: str, *size: float) -> float:
    """Return the volume, mm^3, of a solid."""
    if shape == "box":
        return float(np.prod(size))
    *widths, height = size
    a, b = widths if len(widths) == 2 else widths * 2
    return (4 if shape == "trd" else np.pi) * height / 3 * (a * a + a * b + b * b)


@needs_gate10
def test_gate10_builds_the_scanner_in_geant4(scanner, tmp_path) -> None:
    pose = {"euler_degrees": (20, 50, -10), "position": (3, -5, 8)}
    folder = export(scanner, tmp_path / "g10", "gate10", phantom="derenzo", **pose)
    printed = run_gate10(folder, "-c", _DRIVER)
    data, described = (json.loads((folder / f"{name}.json").read_text()) for name in ("simulation", "described"))
    assert printed.count("OK!") == sum(len(v["centers_mm"]) for v in data["volumes"])  # no overlap of any of them
    placed = {name: {k: np.array(v) for k, v in parts.items()} for name, parts in described["placed"].items()}

    assert [m["copy"] for m in data["modules"]] == list(range(len(scanner)))
    assert [m["number"] for m in data["modules"]] == scanner.numbers.tolist()
    crystal, side, thickness = placed["crystal"], scanner.detector_side[0], scanner.detector_thickness[0]
    np.testing.assert_allclose(crystal["rotations"], scanner.frames().transpose(0, 2, 1), atol=1e-9)
    for u, v, depth in ((1, 1, 0), (-1, 1, 1), (0, 0, 0.5)):
        local = [u * side / 2, v * side / 2, (0.5 - depth) * thickness]
        points = crystal["centers"] + crystal["rotations"] @ local
        np.testing.assert_allclose(points, crystal_points(scanner, u, v, depth), atol=1e-6)
    holes = []
    for part in data["volumes"]:
        assert placed[part["name"]]["cubic"] == pytest.approx(cubic(part["shape"], *part["size_mm"]), rel=1e-9)
        if part["shape"] == "cone" and part["name"].startswith("front_"):
            mother = placed[part["mother"]]
            waist = placed[part["name"]]["centers"][0] - [0, 0, part["size_mm"][2] / 2]
            holes.append(mother["centers"] + mother["rotations"] @ waist)
    distances = np.linalg.norm(np.concatenate(holes)[:, None] - scanner.centers, axis=2)
    assert sorted(distances.argmin(axis=1)) == list(range(len(scanner))) and distances.min(axis=1).max() < 1e-6
    turn = mph.euler_pose(*np.radians([20, 50, -10]))[:3, :3]
    np.testing.assert_allclose(placed["phantom"]["rotations"], turn[None], atol=1e-12)
    assert described["sources"] == len(data["emitters"]) == sum(len(placed[f"rods_{k}"]["centers"]) for k in range(6))

    # GATE 9 hands the rotations of its placements file to Geant4 as those of the frame.
    macros = Macros(export(scanner, tmp_path / "g9", "gate9"))
    np.testing.assert_allclose(macros.volumes["SPECThead"].frames, crystal["frames"], atol=1e-9)


@needs_gate10
def test_gate10_finds_overlaps_that_are_there(tmp_path) -> None:
    near = mph.PinholeSystem([[200.0, 0, 0], [200.0, 30, 0]], 2.0, 60.0, 50.0, 10.0, 75.0)
    printed = run_gate10(export(near, tmp_path / "out", "gate10"), "simulation.py", "--build-only")
    assert "Overlap is detected" in printed


@needs_gate10
def test_gate10_chain_and_source(system, tmp_path) -> None:
    folder = export(system, tmp_path / "out", "gate10", isotope="I-123", activity=2, time=30, threads=2, seed=5)
    run_gate10(folder, "-c", _DRIVER)
    data, described = (json.loads((folder / f"{name}.json").read_text()) for name in ("simulation", "described"))
    # Geant4's own units: MeV and ns.
    lines = mph.ISOTOPES["I-123"].lines
    activity, energies, half_life, mother = described["source"]
    # In opengate 10.1.1 each of the two threads emits the full activity of its source.
    assert activity == pytest.approx(2e6 / 2 * sum(p for _, p in lines) * 1e-9)
    np.testing.assert_allclose(energies, [e * 1e-3 for e, _ in lines])
    assert half_life == pytest.approx(mph.ISOTOPES["I-123"].half_life * 1e9) and mother == "world"
    assert described["run"] == [5, 2, [[0, 30e9]]]
    for channel in described["channels"]:
        assert (channel["min"], channel["max"]) == pytest.approx((0.9 * 0.159, 1.1 * 0.159))
    links = {name: (attached, source) for name, attached, source in described["chain"]}
    assert len(data["crystals"]) == len(described["channels"]) == len(system)
    for crystal in data["crystals"]:
        names = [f"{crystal}_{k}" for k in ("hits", "singles", "energy", "place", "window")]
        assert [links[n] for n in names] == [(crystal, None), *((crystal, n) for n in names[:-1])]


@pytest.mark.parametrize(
    ("handed", "share"),
    [
        (None, 0.25),  # 10.0 to 10.1.0
        (lambda activity, threads: activity, 0.25),  # 10.1.1
        (lambda activity, threads: activity / threads, 1.0),  # after it
        (lambda activity, threads: activity / 2, None),
    ],
)
def test_the_script_asks_opengate_who_divides_the_activity(system, tmp_path, handed, share) -> None:
    script, _ = load_script(export(system, tmp_path / "out", "gate10"))

    class Simulation:
        """Simulation of an opengate that hands `handed(activity, threads)` to each thread, or has no such call."""

        number_of_threads = 1

        def add_source(self, kind, name):
            source = types.SimpleNamespace(activity=0.0)
            if handed is not None:
                source.initialize_g4_source = lambda listener, intervals: listener.InitializeUserInfo(
                    {"activity": handed(source.activity, self.number_of_threads)}
                )
            return source

    opengate = types.SimpleNamespace(Simulation=Simulation, __version__="11")
    assert script.activity_for_each_thread(opengate, 1) == 1
    if share is None:
        with pytest.raises(SystemExit, match=r"each of 4 threads would emit 0\.5 of the activity"):
            script.activity_for_each_thread(opengate, 4)
    else:
        assert script.activity_for_each_thread(opengate, 4) == share


def test_the_script_refuses_a_run_that_emitted_something_else(system, tmp_path) -> None:
    script, data = load_script(export(system, tmp_path / "out", "gate10", isotope="Tc-99m", activity=1, time=3600))
    life = mph.ISOTOPES["Tc-99m"].half_life / np.log(2)
    photons = 1e6 * life * (1 - np.exp(-3600 / life)) * sum(p for _, p in mph.ISOTOPES["Tc-99m"].lines)
    for right in (0, 5, -5):
        script.check_emitted(data, round(photons + right * np.sqrt(photons)))
    for wrong in (photons / 2, photons * 8, photons + 10 * np.sqrt(photons)):
        with pytest.raises(SystemExit, match="photons were emitted, expected"):
            script.check_emitted(data, round(wrong))


# Photons without interactions need no data sets: empty files in their place, and no physics but decays.
_RUN = """
import json, sys
import opengate, uproot
import simulation as script
opengate.physics.PhysicsListBuilder.available_g4_physics_constructors.append("G4DecayPhysics")
data = json.loads(open("simulation.json").read())
made = script.build(data, int(sys.argv[1]))
made.physics_manager.physics_list_name = "G4DecayPhysics"
made.check_volumes_overlap = False
made.progress_bar = False
emitted = made.add_actor("PhaseSpaceActor", "emitted")
emitted.attached_to, emitted.attributes, emitted.output_filename = "world", ["ThreadID", "EventID"], "emitted.root"
emitted.steps_to_store = "first"
made.run()
counts = made.get_actor("statistics").counts
script.check_emitted(data, int(counts.events))
with uproot.open("emitted.root") as file:
    threads = file["emitted"]["ThreadID"].array(library="np").tolist()
json.dump([int(counts.events), threads], open("emitted.json", "w"))
"""


@needs_gate10
@pytest.mark.parametrize("threads", [1, 2, 4])
def test_gate10_emits_the_activity_whatever_the_number_of_threads(scanner, tmp_path, threads) -> None:
    """Run by Geant4: each thread emits its part, all together the requested activity, within 5 standard deviations."""
    asked = {"isotope": "Tc-99m", "activity": 2e-3, "time": 3, "seed": 11}
    folder = export(scanner[:2], tmp_path / "out", "gate10", **asked)
    (tmp_path / "ENSDFSTATE.dat").touch()
    variables = dict.fromkeys(("G4ENSDFSTATEDATA", "G4LEVELGAMMADATA"), str(tmp_path))
    run_gate10(folder, "-c", _RUN, str(threads), **variables)
    events, threads_of_photons = json.loads((folder / "emitted.json").read_text())
    expected = 2000 * 3 * sum(p for _, p in mph.ISOTOPES["Tc-99m"].lines)
    assert abs(events - expected) < 5 * np.sqrt(expected)
    numbers, each = np.unique(threads_of_photons, return_counts=True)
    assert len(numbers) == threads and each.sum() == events
    assert np.all(np.abs(each - expected / threads) < 5 * np.sqrt(expected / threads))
