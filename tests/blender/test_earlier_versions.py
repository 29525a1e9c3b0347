"""Files of earlier versions open with the choices, scanner, phantom and runs that they were saved with."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import zlib
from pathlib import Path

import bpy
import numpy as np
import pytest

from mphdrr.addon import registration
from mphdrr.addon.blender import choices, storage
from mphdrr.addon.pictures import images
from mphdrr.addon.runs import runs
from mphdrr.addon.scanner import scanner
from mphdrr.addon.volumes import volumes
from mphdrr.core.runs.files import read_run

from .conftest import Drawn

DATA = Path(__file__).parent / "data"
SAVED = DATA / "choices-0.1.0.blend"
"""Every choice that a scene can keep, numbered by position as version 0.1.0 did; what they are is in its text."""
RENAMED = {"NUMBA": "CPU"}
"""Identifiers that have changed since; their numbers have not."""

QUANTITIES = {
    "activity": 0, "mu": 1, "hu": 2, "sensitivity": 3, "modules": 4, "resolution": 5, "completeness": 6,
}  # fmt: skip
HELD = {"activity": 0, "mu": 1}
PROJECTIONS = {
    "model": {"TRANSMISSION": 0, "EMISSION": 1, "INVERSE_SQUARE": 2},
    "isotope": {
        "NONE": 0, "F-18": 1, "Ga-67": 2, "Tc-99m": 3, "In-111": 4, "I-123": 5, "I-131": 6, "Xe-133": 7, "Lu-177": 8,
        "Tl-201": 9,
    },
    "aperture_material": {"NUMBER": 0, "tungsten": 1, "lead": 2, "gold": 3, "uranium": 4},
    "edge": {"PAIX": 0, "PATH": 1},
    "crystal_material": {"NUMBER": 0, "NaI": 1, "CsI": 2, "CZT": 3, "CdTe": 4, "BGO": 5, "LYSO": 6, "GAGG": 7},
    "detector": {"VIRTUAL": 0, "REAL": 1},
    "backend": {"AUTO": 0, "CPU": 1, "TORCH": 2, "NUMPY": 3, "CUDA": 4},
}  # fmt: skip
PHANTOMS = {
    "derenzo": {}, "nema": {}, "jaszczak": {}, "defrise": {}, "points": {}, "torso": {}, "mixture": {},
    "shepp_logan": {"contrast": {"modified": 0, "original": 1}},
}  # fmt: skip
READ_AS = {
    "AUTO": 0, "activity": 1, "mu": 2, "hu": 3, "sensitivity": 4, "modules": 5, "resolution": 6, "completeness": 7,
}  # fmt: skip
UNITS = {
    "NONE": 0, "mm": 1, "cm": 2, "m": 3, "in": 4, "µm": 5, "rad": 6, "deg": 7, "dm": 8, "ft": 9, "mil": 10, "0.1 mm": 11,
}  # fmt: skip

# Never change a number here: files hold them.
FROZEN = {
    "ModuleProperties": {
        "part": {"NONE": 0, "CAMERA": 1, "COLLIMATOR": 2, "CRYSTAL": 3, "ROI": 4},
        "length_mode": {"FROM_ROI": 0, "TYPED": 1},
    },
    "ScannerProperties": {
        "length_mode": {"FROM_ROI": 0, "TYPED": 1},
        "edge_at": {"MIDDLE": 0, "FRONT": 1, "BACK": 2},
    },
    "VolumeProperties": {
        "kind": {
            "VOLUME": 0, "DERENZO": 1, "NEMA": 2, "JASZCZAK": 3, "DEFRISE": 4, "SHEPP_LOGAN": 5, "POINTS": 6, "TORSO": 7,
            "FILE": 1000,
        },
        "quantity": QUANTITIES,
    },
    **{f"{name}Properties": {"quantity": HELD} for name in (
        "DerenzoPhantom", "NemaBody", "JaszczakPhantom", "DefrisePhantom", "MixturePhantom", "PointGrid", "CardiacTorso",
        "PhantomText",
    )},
    "SheppLoganProperties": {"quantity": HELD, **PHANTOMS["shepp_logan"]},
    "ProjectionProperties": PROJECTIONS,
    "ColumnMapTable": {"rows": {"BY_NUMBER": 0, "IN_ORDER": 1, "ONE_FOR_ALL": 2}},
    "ColumnMapQuantity": {"unit": UNITS},
    "ColumnMapProperties": {"unit": {name: number for name, number in UNITS.items() if name not in ("rad", "deg")}},
    # Those of operators are stored in the preferences, for users' keys and menus.
    "MPHDRR_OT_render_projections": PROJECTIONS,
    "MPHDRR_OT_import_phantom": {"quantity": HELD},
    **{f"MPHDRR_OT_add_{kind}": {"quantity": HELD, **words} for kind, words in PHANTOMS.items()},
    "MPHDRR_OT_import_volume": {"quantity": READ_AS},
    "MPHDRR_OT_import_volume_sequence": {"quantity": READ_AS},
    "MPHDRR_OT_voxelize_objects": {"quantity": HELD},
    "MPHDRR_OT_add_map": {"quantity": {"sensitivity": 0, "modules": 1, "resolution": 2, "completeness": 3}},
    "MPHDRR_OT_show_modules": {"mode": {"ONLY": 0, "SHOW": 1, "HIDE": 2, "ALL": 3}},
    "MPHDRR_OT_renumber_modules": {"order": {"RINGS": 0, "LIST": 1}},
    "MPHDRR_OT_export_for_program": {
        "format": {  # 7 and 8 were PyTomography and STIR in version 0.1.0
            "astra": 0, "rtk": 1, "opencv": 2, "kornia": 3, "pytorch3d": 4, "nerf": 5, "leap": 6,
            "stl": 9, "stl-parts": 10, "3mf": 11, "glb": 12, "gate9": 13, "gate10": 14, "mphdrr": 15,
        },
    },
}  # fmt: skip
DEFAULTS = {
    "part": "NONE", "length_mode": "TYPED", "edge_at": "MIDDLE", "kind": "VOLUME", "contrast": "modified",
    "model": "TRANSMISSION",
    "isotope": "NONE", "aperture_material": "NUMBER", "edge": "PAIX", "crystal_material": "NUMBER",
    "detector": "VIRTUAL", "backend": "AUTO", "rows": "BY_NUMBER", "unit": "NONE",
    "colors": "INFERNO", "scale": "LINEAR", "region": "OBJECT", "planes": "ALL", "look": "DENSITY", "figure": "SCANNER",
    "method": "OSEM", "prior": "NONE", "hole": "AUTO", "lines": "TOGETHER", "dead_time_kind": "NON_PARALYSABLE",
    "panel": "COUNTING", "sensor": "NONE", "scatter": "NONE", "materials": "WATER_BONE",
    "how": "SUM", "uniform": "K", "MixturePhantomProperties.look": "solids",
}  # fmt: skip
"""What files mean that do not hold a choice, because nobody has made it."""


def _registered():
    """Yield class and property of every enumeration of the extension."""
    for cls in registration.CLASSES:
        if issubclass(cls, bpy.types.Operator):
            group, name = cls.bl_idname.split(".")
            known = getattr(getattr(bpy.ops, group), name).get_rna_type().properties
        elif issubclass(cls, bpy.types.PropertyGroup | bpy.types.AddonPreferences):
            known = cls.bl_rna.properties
        else:
            continue
        for prop in known:
            if prop.type == "ENUM":
                yield cls.__name__, prop


def test_every_choice_has_the_number_that_files_keep():
    found = {}
    for name, prop in _registered():
        assert not prop.is_enum_flag
        found.setdefault(name, {})[prop.identifier] = {item.identifier: item.value for item in prop.enum_items}
    for name, properties in found.items():
        for prop, numbers in properties.items():
            first = FROZEN.get(name, {}).get(prop, {})
            expected = {choice: first.get(choice, zlib.crc32(choice.encode()) & 0xFFFFFF) for choice in numbers}
            assert numbers == expected, f"{name}.{prop}: a choice was moved or renumbered: see addon/blender/choices.py"
            assert len(set(numbers.values())) == len(numbers)
            # Buttons side by side keep numbers as float32: a click would set another number.
            assert all(np.float32(number) == number for number in numbers.values()), f"{name}.{prop}"
            if "_OT_" not in name:
                assert first.keys() <= numbers.keys(), f"{name}.{prop}: files hold a choice that is gone"


def test_files_without_a_choice_mean_what_they_did():
    for name, prop in _registered():
        if "_OT_" not in name:
            own = f"{name}.{prop.identifier}"
            assert prop.default == DEFAULTS.get(own, DEFAULTS.get(prop.identifier, "activity")), own


def test_a_new_choice_has_a_number_of_its_own():
    ((_, _, _, old), (_, _, _, new)) = choices.items(choices.ISOTOPES, [("F-18", "", ""), ("Co-57", "Co-57", "")])
    assert old == 1 and new == zlib.crc32(b"Co-57") & 0xFFFFFF


# In a new Python: enumerations are made when the extension is imported.
OPEN = """
import importlib, json, sys
import bpy
from mphdrr.core.phantoms import kinds
from mphdrr.core.physics import isotopes, materials
from mphdrr.core.volumes import volume

def inserted(known, name, value, place=2):
    both = list(known.items())
    return dict([*both[:place], (name, value), *both[place:]])

if sys.argv[2] == "more":
    isotopes.ISOTOPES = inserted(isotopes.ISOTOPES, "Co-57", isotopes.Isotope("Co-57", 2.35e7, ((122.1, 0.856),)), 1)
    materials.APERTURES = ("platinum", *materials.APERTURES)
    materials.CRYSTALS = ("LaBr3", *materials.CRYSTALS)
    volume.UNITS = inserted(volume.UNITS, "density", "g/cm^3", 0)
    from mphdrr.addon.blender import ids
    ids.PARTS = ("PLATE", *ids.PARTS)

    from dataclasses import dataclass
    from mphdrr.core.phantoms.phantom import Phantom
    from mphdrr.core.phantoms.settings import choice, setting
    from mphdrr.core.phantoms.shapes import Sphere

    @dataclass(frozen=True)
    class Egg(Phantom):
        radius: float = setting(20.0, "mm", "radius of the egg")
        weight: float = setting(60.0, "g", "with its shell")
        shell: str = choice("white", ("white", "brown"), "colour of the shell")
        title = "egg"

        @property
        def shapes(self):
            return (Sphere(radius=self.radius, activity=2.0),)

    kinds.KINDS = (kinds.PhantomKind("goose-egg", Egg, "Goose Egg", "an egg"), *kinds.KINDS[::-1])
    importlib.reload(importlib.import_module("mphdrr.core.runs.settings"))  # whose words are these tables'

from mphdrr.addon import registration
registration.register()
if sys.argv[2] == "more":
    names = [item.identifier for item in bpy.types.Scene.bl_rna.properties["mphdrr_projections"].fixed_type.properties[
        "isotope"].enum_items]
    assert names[:4] == ["NONE", "F-18", "Co-57", "Ga-67"], names
    bpy.ops.mphdrr.add_goose_egg(voxels=8, shell="brown")
    made = bpy.context.object.mphdrr_volume
    assert (made.kind, made.goose_egg.shell, made.maximum) == ("GOOSE_EGG", "brown", 2.0)
    assert made.goose_egg.recipe().keys() == {"phantom", "radius_mm", "weight_g", "shell"}
    weight = made.goose_egg.bl_rna.properties["weight"]
    assert (weight.name, weight.description) == ("Weight (g)", "With its shell, in g")
bpy.ops.wm.open_mainfile(filepath=sys.argv[1], load_ui=False)
expected = json.loads(bpy.data.texts["expected.json"].as_string())
read = {}
for kind, names in expected.items():
    for name, paths in names.items():
        for path in paths:
            owner, _, last = path.rpartition(".")
            value = getattr(getattr(bpy.data, kind)[name].path_resolve(owner), last)
            read.setdefault(kind, {}).setdefault(name, {})[path] = value
print("READ", json.dumps([expected, read]))
"""


@pytest.mark.parametrize("items", [pytest.param("as they are", marks=pytest.mark.long), "more"])
def test_a_file_of_the_first_version_opens_with_the_choices_it_was_saved_with(items):
    done = subprocess.run(
        [sys.executable, "-c", OPEN, str(SAVED), items], capture_output=True, text=True, timeout=600, check=False
    )
    answer = [line for line in done.stdout.splitlines() if line.startswith("READ ")]
    assert answer, done.stderr
    expected, read = json.loads(answer[0].removeprefix("READ "))
    for owners in expected.values():
        for values in owners.values():
            values |= {path: RENAMED[value] for path, value in values.items() if value in RENAMED}
    assert read == expected
    isotopes = {paths["mphdrr_projections.isotope"] for paths in read["scenes"].values()}
    assert isotopes == set(FROZEN["ProjectionProperties"]["isotope"])
    materials = {paths["mphdrr_projections.crystal_material"] for paths in read["scenes"].values()}
    assert materials == set(FROZEN["ProjectionProperties"]["crystal_material"])


def opened(name: str, folder: Path) -> bpy.types.Scene:
    """Open a copy of a .blend with its folder, and return its scene."""
    shutil.copytree(DATA / f"{name}_mphdrr", folder / f"{name}_mphdrr")
    shutil.copy(DATA / f"{name}.blend", folder)
    bpy.ops.wm.open_mainfile(filepath=str(folder / f"{name}.blend"))
    return bpy.context.scene


@pytest.fixture
def old_scene(scene, tmp_path):
    return opened("scene-0.1.0", tmp_path)


def test_the_scanner_reads_back_exactly(old_scene):
    collection = scanner.active_scanner(old_scene)
    system = scanner.read_scanner(collection)
    assert system.numbers.tolist() == [3, 31, 66]
    assert system.centers.tolist() == [
        [201.3326, 136.87, -68.0519], [-170.499, 95.57272, -23.9678], [56.74056, 177.7703, 71.7895],
    ]  # fmt: skip
    assert system.pinhole_diameter.tolist() == [2.3, 2.7, 2.3]
    np.testing.assert_allclose(system.collimator_length, [75.55147057014942, 61.3, 57.9776304498216], rtol=1e-14)
    assert system.collimator_length[1] == 61.3
    for name, value in (("detector_side", 50.0), ("detector_thickness", 10.0), ("roi_radius", 75.0)):
        assert getattr(system, name).tolist() == [value] * 3
    assert [camera.mphdrr_module.visible for camera in scanner.modules(collection)] == [True, True, False]
    assert [camera.mphdrr_module.length_mode for camera in scanner.modules(collection)] == [
        "FROM_ROI", "TYPED", "FROM_ROI",
    ]  # fmt: skip
    assert scanner.losses(collection) == ["module 3 moved or turned", "modules 3, 31 with changed numbers"]
    assert scanner.source(collection).cell("x1", 31) == ("Coordinates", "B4")


def test_settings_are_there(old_scene):
    built = scanner.active_scanner(old_scene).mphdrr_scanner
    for name, value in {
        "scanner_name": "Three", "n_modules": 3, "plate_thickness": 3.5, "wall_thickness": 1.25, "edge_at": "BACK",
        "opening_angle": np.radians(60), "intrinsic_fwhm": 3.2, "keep_aimed": False,
        "mixed": "pinhole_diameter collimator_length length_mode", "count": 3, "untidy": "",
    }.items():  # fmt: skip
        assert getattr(built, name) == (pytest.approx(value) if isinstance(value, float) else value), name
    rendered = old_scene.mphdrr_projections
    for name, value in {
        "model": "EMISSION", "isotope": "Tc-99m", "aperture_material": "tungsten", "crystal_material": "CZT",
        "magnification": 8.0, "width": 24, "height": 16, "detector": "VIRTUAL", "noise": False,
    }.items():  # fmt: skip
        assert getattr(rendered, name) == value, name


def test_phantom_and_projections_are_there(old_scene):
    (phantom,) = volumes.volume_objects(old_scene)
    settings = phantom.mphdrr_volume
    assert (settings.kind, settings.quantity, settings.derenzo.voxels) == ("DERENZO", "activity", 16)
    assert settings.derenzo.activity == 80.0
    assert volumes.volume_from_object(phantom).array.max() == pytest.approx(settings.maximum)
    phantom.mphdrr_volume.display_high = 33.0
    looked = phantom.data.materials[0].node_tree.nodes["Display Range"].inputs["From Max"]
    assert looked.default_value == 33.0, "its material has no look, and follows all the same"
    run = read_run(storage.absolute(old_scene.mphdrr_projections.run_file))
    assert run.system.numbers.tolist() == [3, 31, 66] and run.projections.shape == (3, 16, 24)
    for number, projection in zip(run.system.numbers, run.projections, strict=True):
        image = bpy.data.images[f"mphDRR {number:02d}"]
        np.testing.assert_array_equal(images.projection_array(image), projection)


def test_a_file_of_version_0_1_0_shows_its_run(old_scene):
    settings = old_scene.mphdrr_projections
    (item,) = settings.runs
    assert item.file == settings.run_file and runs.changes(old_scene) == [runs.UNKNOWN]
    assert runs.UNKNOWN in " ".join(Drawn("MPHDRR_PT_runs").texts)
    settings.width, settings.height = 12, 8
    bpy.ops.mphdrr.render_projections()
    assert runs.changes(old_scene) == [] and len(settings.runs) == 2
    settings.active_run = 0
    assert images.projection_array(bpy.data.images["mphDRR 03"]).shape == (16, 24)


def test_two_runs_of_blender_4_5_open_in_every_version(scene, tmp_path):
    """Three modules; Module 03 was moved and the phantom turned between the runs, of which the second is shown."""
    scene = opened("runs-4.5", tmp_path)
    settings = scene.mphdrr_projections
    first, second = settings.runs
    assert (first.name, second.name) == ("Before", "Derenzo, emission") and runs.shown_run(scene) == second
    hole = ["hole Rays, now Automatic"]  # its middle, the default of that version
    assert runs.changes(scene, first) == ["Module 03 moved", "phantom Derenzo turned", *hole]
    assert runs.changes(scene) == hole
    settings.hole, settings.aperture_points = "RAYS", 1
    expected = read_run(storage.absolute(second.file)).projections
    assert np.array_equal(images.projection_array(bpy.data.images["mphDRR 66"]), expected[2])
    assert bpy.ops.mphdrr.render_projections() == {"FINISHED"}
    again = read_run(storage.absolute(settings.runs[-1].file)).projections
    np.testing.assert_allclose(again, expected, rtol=1e-6)
    assert runs.changes(scene, settings.runs[1]) == []
