"""The zip as a user gets it: its contents; Blender installs, enables and disables it."""

from __future__ import annotations

import re
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
KERNELS = "core/rays/backends/kernels"
MODULE = "bl_ext.user_default.mphdrr"


def test_zip_holds_the_extension_and_no_tests(extension_zip: Path):
    assert extension_zip.stat().st_size < 60e6
    with zipfile.ZipFile(extension_zip) as archive:
        names = archive.namelist()
        manifest = tomllib.loads(archive.read("blender_manifest.toml").decode())
    tops = {name.split("/")[0] for name in names}
    assert {"__init__.py", "LICENSE", "addon", "core", "operators", "panels", "examples", "wheels"} <= tops
    sources = "tests docs benchmarks tools out dist .ci .gitignore pyproject.toml setup.py"
    assert tops.isdisjoint(sources.split())
    assert not [name for name in names if re.search(r"(^|/)(test_|conftest|__pycache__|\.)", name)]
    assert "examples/dc-spect-80.xlsx" in names
    assert [name for name in names if name.startswith(KERNELS)] == [f"{KERNELS}/libsiddon.so"]
    assert manifest["platforms"] == ["linux-x64"] and manifest["blender_version_min"] == "5.1.0"
    assert sorted(manifest["wheels"]) == sorted(f"./{name}" for name in names if name.startswith("wheels/"))


def test_readme_in_the_zip_leads_nowhere_that_is_not_there(extension_zip: Path):
    with zipfile.ZipFile(extension_zip) as archive:
        links = re.findall(r"\]\(([^)]+)\)", archive.read("README.md").decode())
        names = set(archive.namelist())
    assert [link for link in links if link.endswith(".webp")] == ["picture.webp", "reconstruction.webp", "load.webp"]
    assert all(link in names or link.startswith("https://") for link in links), links


@pytest.mark.parametrize(
    "python, blender", [("cp311", "blender_4.5"), ("cp313", "blender_5.1"), ("cp314", "python_3.14")]
)
def test_zip_holds_the_compiled_wheels_for_its_python_alone(extension_zip: Path, python: str, blender: str):
    with zipfile.ZipFile(extension_zip.with_name(extension_zip.name.replace("python_3.14", blender))) as archive:
        wheels = [Path(name).name.split("-") for name in archive.namelist() if name.endswith(".whl")]
    compiled = {(name, tag) for name, _, tag, abi, *_ in wheels if abi not in ("none", "abi3")}
    assert compiled == {(name, python) for name in ("h5py", "pylibjpeg_openjpeg", "scipy")}
    assert not [name for name, *_ in wheels if name == "numpy"]  # Blender's own


def test_wheel_is_for_every_python_and_holds_the_kernels(extension_zip: Path):
    version = extension_zip.name.split("-")[1]
    name = f"mphdrr-{version}-py3-none-manylinux_2_17_x86_64.manylinux2014_x86_64.whl"
    with zipfile.ZipFile(extension_zip.with_name(name)) as archive:
        suffixes = (".so", ".dll", ".dylib", ".pyd", ".c", ".h")
        assert [name for name in archive.namelist() if name.endswith(suffixes)] == [f"mphdrr/{KERNELS}/libsiddon.so"]


def test_installs_and_enables_without_network(blender_script):
    said = blender_script(f"""
import importlib, sys, bpy
assert "{MODULE}" in bpy.context.preferences.addons, list(bpy.context.preferences.addons.keys())
assert hasattr(bpy.ops, "mphdrr") and "MPHDRR_PT_geometry" in dir(bpy.types)
assert "scipy" not in sys.modules and bpy.ops.mphdrr.optimise.poll()
for name in ("h5py", "openjpeg", "psutil", "openpyxl", "nibabel", "trimesh", "scipy.optimize"):
    module = importlib.import_module(name)
    assert ".local" in module.__file__, module.__file__  # from the extension's wheels, not from the machine
cpu = importlib.import_module("{MODULE}.core.rays.backends.cpu")
assert cpu.levels(), "the kernels"
cache = importlib.import_module("{MODULE}.core.cache")
assert str(cache.folder()) == bpy.utils.extension_path_user("{MODULE}", path="cache"), cache.folder()
assert not [finder for finder in sys.meta_path if "mphdrr" in type(finder).__module__]
print("ENABLED", sys.modules["{MODULE}"].__file__)
""")
    assert "ENABLED" in said.stdout
    assert "Traceback" not in said.stderr


def test_registers_and_unregisters_twice_cleanly(blender_script):
    said = blender_script(f"""
import addon_utils, bpy

def ours():
    classes = {{name for name in dir(bpy.types) if name.startswith("MPHDRR_")}}
    properties = {{
        (owner.__name__, name)
        for owner in (bpy.types.Scene, bpy.types.Object, bpy.types.Collection, bpy.types.WindowManager)
        for name in dir(owner) if name.startswith("mphdrr")
    }}
    menus = [
        draw for menu in (bpy.types.TOPBAR_MT_file_import, bpy.types.TOPBAR_MT_file_export)
        for draw in menu._dyn_ui_initialize() if "mphdrr" in draw.__module__
    ]
    handlers = [
        function for name in dir(bpy.app.handlers) if isinstance(getattr(bpy.app.handlers, name), list)
        for function in getattr(bpy.app.handlers, name) if "mphdrr" in getattr(function, "__module__", "")
    ]
    return classes, properties, len(menus), len(handlers)

def raise_it(error):
    raise error

enabled = ours()
assert enabled[0] and enabled[1] and enabled[2]
for _ in range(2):
    addon_utils.disable("{MODULE}", handle_error=raise_it)
    assert ours() == (set(), set(), 0, 0), ours()
    addon_utils.enable("{MODULE}", handle_error=raise_it)
    assert ours() == enabled, (ours(), enabled)
print("TWICE")
""")
    assert "TWICE" in said.stdout
    assert "Traceback" not in said.stderr
