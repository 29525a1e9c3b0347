"""Build the extension: one zip per platform in dist/, validated, with every wheel it needs, as `make dist` does.

Run by an environment with bpy, whose own command-line tool builds and validates; no Blender application is needed.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import shutil
import subprocess
import sys
import tempfile
import tomllib
import zipfile
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
MANIFEST = ROOT / "blender_manifest.toml"

# Pinned, so that a zip can be built again. numpy is Blender's own: 1.26 in 4.5, 2.2 or later in 5.2; the bounds of
# numba (1.22 to 2.5) and h5py (1.21.2 on) hold both.
PURE = (
    "et-xmlfile==2.0.0",
    "importlib-resources==7.1.0",
    "nibabel==5.4.2",
    "openpyxl==3.1.5",
    "packaging==26.3",
    "pydicom==3.0.2",
    "pynrrd==1.1.3",
    "trimesh==5.2.0",
    "typing-extensions==4.16.0",
)
STABLE_ABI = ("psutil==7.2.2",)
COMPILED = ("h5py==3.16.0", "llvmlite==0.50.0", "numba==0.68.1", "pillow==13.0.0")
# The last numba with wheels for Intel Macs; it takes numpy from 1.22 to 2.3.
COMPILED_INTEL_MAC = ("h5py==3.16.0", "llvmlite==0.45.1", "numba==0.62.1", "pillow==13.0.0")


@dataclass(frozen=True)
class Platform:
    """What pip is asked for: wheel tags, Python versions and packages."""

    tags: tuple[str, ...]
    pythons: tuple[str, ...] = ("3.11", "3.13")  # Blender 4.5 and 5.0; 5.1 and later
    compiled: tuple[str, ...] = COMPILED


PLATFORMS = {
    # 3.14: Linux distributions build Blender on their own Python, and Blender refuses an extension that has compiled
    # wheels but none for the Python it runs on.
    "linux-x64": Platform(
        tuple(f"manylinux{tag}_x86_64" for tag in ("_2_28", "_2_27", "_2_17", "2014", "2010")), ("3.11", "3.13", "3.14")
    ),
    "windows-x64": Platform(("win_amd64",)),
    "macos-arm64": Platform(("macosx_12_0_arm64", "macosx_11_0_arm64")),
    # Blender 4.5 is the last for Intel Macs.
    "macos-x64": Platform(("macosx_10_15_x86_64", "macosx_10_9_x86_64"), ("3.11",), COMPILED_INTEL_MAC),
}


def download(folder: Path, packages: tuple[str, ...], *options: str) -> list[Path]:
    """Give the wheels of `packages` in `folder`, downloaded unless they are there; a stamp says that all are."""
    stamp = folder / ".complete"
    asked = " ".join((*packages, *options))
    if not (stamp.is_file() and stamp.read_text() == asked):
        shutil.rmtree(folder, ignore_errors=True)
        pip = (sys.executable, "-m", "pip", "download", "-qq", "--disable-pip-version-check", "--no-input")
        subprocess.run((*pip, "--no-deps", "--only-binary=:all:", *options, "-d", folder, *packages), check=True)
        stamp.write_text(asked)
    return sorted(folder.glob("*.whl"))


def wheels_for(name: str, folder: Path) -> list[Path]:
    """Give all wheels of one platform."""
    platform = PLATFORMS[name]
    tags = [option for tag in platform.tags for option in ("--platform", tag)]
    wheels = download(folder / "any", PURE)
    wheels += download(folder / name / "abi3", STABLE_ABI, *tags, "--python-version", platform.pythons[0])
    compiled = []
    for python in platform.pythons:
        compiled += download(folder / name / python, platform.compiled, *tags, "--python-version", python)
    return wheels + joined(compiled, folder / name / "joined")


def joined(wheels: list[Path], folder: Path) -> list[Path]:
    """Give `wheels` with those that hold the same files for several Pythons as one, retagged, in `folder`.

    So is llvmlite, a third of a zip each time: what is compiled in it knows no Python, and is loaded by ctypes.
    """
    same: dict[frozenset[tuple[str, int]], list[Path]] = {}
    for wheel in wheels:
        with zipfile.ZipFile(wheel) as archive:
            files = frozenset((file.filename, file.CRC) for file in archive.infolist())
        # Only these two tell for which Python a wheel is.
        same.setdefault(frozenset(f for f in files if Path(f[0]).name not in ("WHEEL", "RECORD")), []).append(wheel)
    return [alike[0] if len(alike) == 1 else retagged(alike, folder) for alike in same.values()]


def retagged(wheels: list[Path], folder: Path) -> Path:
    """Give one wheel in `folder` for all the Pythons that `wheels` are for, and any ABI."""
    name, version, _, _, platform = wheels[0].stem.split("-")
    pythons = ".".join(sorted(wheel.stem.split("-")[2] for wheel in wheels))
    target = folder / f"{name}-{version}-{pythons}-none-{platform}.whl"
    if not target.is_file():
        folder.mkdir(exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder) as made:
            copy = Path(made) / wheels[0].name
            link_or_copy(wheels[0], copy)
            tags = ("--python-tag", pythons, "--abi-tag", "none", "--remove")
            subprocess.run((sys.executable, "-m", "wheel", "tags", *tags, copy), check=True, stdout=subprocess.DEVNULL)
            next(Path(made).iterdir()).replace(target)
    return target


def source_files() -> list[Path]:
    """Give the files of the tree that git does not ignore, relative to the root; the manifest says which are packed."""
    command = ("git", "ls-files", "-z", "--cached", "--others", "--exclude-standard")
    names = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout.split("\0")
    return [Path(name) for name in names if name and (ROOT / name).is_file()]


def stage(folder: Path, platforms: list[str], wheels: list[Path]) -> None:
    """Lay out the extension's source in `folder`: the tree, the wheels, and the manifest that lists them."""
    for name in source_files():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(ROOT / name, folder / name)
    (folder / "wheels").mkdir()
    for wheel in wheels:
        link_or_copy(wheel, folder / "wheels" / wheel.name)
    given = MANIFEST.read_text(encoding="utf-8")
    declared = f"platforms = {toml_list(tomllib.loads(given)['platforms'])}\n"
    if declared not in given:
        raise SystemExit(f"{MANIFEST.name}: expected the platforms on one line, as in {declared.strip()}")
    listed = f"platforms = {toml_list(platforms)}\nwheels = [\n"
    listed += "".join(f'  "./wheels/{wheel.name}",\n' for wheel in wheels) + "]\n"
    (folder / MANIFEST.name).write_text(given.replace(declared, listed), encoding="utf-8")


def toml_list(values: list[str]) -> str:
    """Write `values` as Blender's manifests do."""
    return "[" + ", ".join(f'"{value}"' for value in values) + "]"


def link_or_copy(source: Path, target: Path) -> None:
    """Link, or copy where the file system cannot: wheels weigh hundreds of megabytes."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)


def extension_tool() -> Path:
    """Give Blender's command-line tool for extensions, from the bpy wheel, without importing bpy."""
    spec = importlib.util.find_spec("bpy")
    if spec is None or not spec.submodule_search_locations:
        raise SystemExit("bpy is not installed here; run this as: make dist")
    return next(Path(spec.submodule_search_locations[0]).glob("*/scripts/addons_core/bl_pkg/cli/blender_ext.py"))


def main() -> None:
    """Build and validate."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--platform", action="append", choices=PLATFORMS, help="build this one only; may be repeated")
    parser.add_argument("--output", type=Path, default=ROOT / "dist", help="folder of the zips")
    arguments = parser.parse_args()
    platforms = arguments.platform or list(PLATFORMS)
    tool = (sys.executable, extension_tool())
    wheels = {wheel.name: wheel for name in platforms for wheel in wheels_for(name, ROOT / "wheels")}
    arguments.output.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=ROOT / "wheels", prefix="stage-") as folder:
        stage(Path(folder), platforms, sorted(wheels.values(), key=lambda wheel: wheel.name))
        options = ("--source-dir", folder, "--output-dir", arguments.output, "--split-platforms")
        subprocess.run((*tool, "build", *options), check=True, stdout=subprocess.DEVNULL)
    version = tomllib.loads(MANIFEST.read_text(encoding="utf-8"))["version"]
    for name in platforms:
        file = arguments.output / f"mphdrr-{version}-{name.replace('-', '_')}.zip"
        subprocess.run((*tool, "validate", file), check=True, stdout=subprocess.DEVNULL)
        print(f"{os.path.relpath(file)}: {file.stat().st_size / 1e6:.0f} MB, valid")


if __name__ == "__main__":
    main()
