"""Build the package's wheels, its source archive and the extension's zips in dist/, for each platform: `make dist`.

The C kernels are compiled for all platforms here. A zip contains every wheel that it needs, for one of Blender's Pythons.
Needs an environment with bpy, whose command-line tool builds and validates the zips; no Blender application is needed.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from dataclasses import dataclass
from pathlib import Path

import build_kernels

ROOT = Path(__file__).resolve().parents[1]
MANIFEST = ROOT / "blender_manifest.toml"

# Pinned, so that a zip can be built again. numpy is Blender's own: 1.26 in 4.5, 2.2 or later in 5.2; those of the compiled
# wheels' bounds (1.26.4 for SciPy) hold it.
PURE = (
    "et-xmlfile==2.0.0",
    "importlib-resources==7.1.0",
    "nibabel==5.4.2",
    "openpyxl==3.1.5",
    "packaging==26.3",
    "pydicom==3.0.2",
    "pylibjpeg==2.1.0",
    "pynrrd==1.1.3",
    "trimesh==5.2.0",
    "typing-extensions==4.16.0",
)
STABLE_ABI = ("psutil==7.2.2",)
H5PY = "h5py==3.15.1"


@dataclass(frozen=True)
class BlenderPython:
    """A Python of Blender: the versions that have it, and the compiled packages for it."""

    name: str  # in the zip's name
    first: str  # version of Blender
    end: str | None  # the first version without it, None where the newest has it
    compiled: tuple[str, ...]


PYTHONS = {
    # From 2.4 on pylibjpeg-openjpeg asks for numpy 2, and 2.3 for macOS 14; so does SciPy from 1.18 on.
    "3.11": BlenderPython("blender_4.5", "4.5.0", "5.1.0", (H5PY, "pylibjpeg-openjpeg==2.2.1", "scipy==1.17.1")),
    "3.13": BlenderPython("blender_5.1", "5.1.0", None, (H5PY, "pylibjpeg-openjpeg==2.6.0", "scipy==1.18.1")),
    # Linux distributions build Blender on their own Python, and Blender refuses an extension that has compiled wheels but
    # none for the Python it runs on.
    "3.14": BlenderPython("python_3.14", "5.1.0", None, (H5PY, "pylibjpeg-openjpeg==2.6.0", "scipy==1.18.1")),
}


@dataclass(frozen=True)
class Platform:
    """Wheel tags and Python versions for pip."""

    tags: tuple[str, ...]
    pythons: tuple[str, ...] = ("3.11", "3.13")


PLATFORMS = {
    "linux-x64": Platform(
        tuple(f"manylinux{tag}_x86_64" for tag in ("_2_28", "_2_27", "_2_17", "2014", "2010")), ("3.11", "3.13", "3.14")
    ),
    "windows-x64": Platform(("win_amd64",)),
    "macos-arm64": Platform(("macosx_12_0_arm64", "macosx_11_0_arm64")),
    # Blender 4.5 is the last for Intel Macs.
    "macos-x64": Platform(tuple(f"macosx_{tag}_x86_64" for tag in ("12_0", "10_15", "10_14", "10_9")), ("3.11",)),
}


def download(folder: Path, packages: tuple[str, ...], *options: str) -> list[Path]:
    """Return the wheels of `packages` in `folder`, downloaded unless a stamp there says that they are complete."""
    stamp = folder / ".complete"
    asked = " ".join((*packages, *options))
    if not (stamp.is_file() and stamp.read_text() == asked):
        shutil.rmtree(folder, ignore_errors=True)
        pip = (sys.executable, "-m", "pip", "download", "-qq", "--disable-pip-version-check", "--no-input")
        subprocess.run((*pip, "--no-deps", "--only-binary=:all:", *options, "-d", folder, *packages), check=True)
        stamp.write_text(asked)
    return sorted(folder.glob("*.whl"))


def wheels_for(name: str, python: str, folder: Path) -> list[Path]:
    """Return all wheels of one platform and Python."""
    platform = PLATFORMS[name]
    tags = [option for tag in platform.tags for option in ("--platform", tag)]
    wheels = download(folder / "any", PURE)
    wheels += download(folder / name / "abi3", STABLE_ABI, *tags, "--python-version", platform.pythons[0])
    return wheels + download(folder / name / python, PYTHONS[python].compiled, *tags, "--python-version", python)


def source_files() -> list[Path]:
    """Return the files of the tree that git does not ignore, relative to the root; the manifest chooses those to pack."""
    command = ("git", "ls-files", "-z", "--cached", "--others", "--exclude-standard")
    names = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout.split("\0")
    return [Path(name) for name in names if name and (ROOT / name).is_file()]


def stage(folder: Path) -> None:
    """Copy the tree to `folder`."""
    for name in source_files():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(ROOT / name, folder / name)


def own_readme(tree: Path, website: str | None) -> None:
    """Make the README of `tree` fit a zip without docs/: its pictures lie beside it, links lead to the website."""

    def fitting(link: re.Match[str]) -> str:
        is_picture, text, path = link.groups()
        if is_picture:
            shutil.copyfile(tree / path, tree / Path(path).name)
            return f"![{text}]({Path(path).name})"
        page = Path(path).with_suffix(".html").name
        return f"[{text}]({website.rstrip('/')}/{page})" if website else text

    readme = tree / "README.md"
    given = readme.read_text(encoding="utf-8")
    readme.write_text(re.sub(r"(!?)\[([^]]*)\]\((docs/[^)]+)\)", fitting, given), encoding="utf-8")


def build_wheel(name: str, tree: Path, output: Path) -> None:
    """Build the package's wheel for platform `name` from a copy of the tree."""
    options = ("--no-build-isolation", "--no-deps", "-qq", "--disable-pip-version-check", "-w", output)
    asked = f"--config-settings=--build-option=--plat-name={name}"
    subprocess.run((sys.executable, "-m", "pip", "wheel", *options, asked, tree), check=True)


def build_source_archive(tree: Path, output: Path) -> None:
    """Build the package's source archive from a copy of the tree."""
    code = f"from setuptools.build_meta import build_sdist; build_sdist({str(output.absolute())!r})"
    subprocess.run((sys.executable, "-c", code), cwd=tree, check=True, stdout=subprocess.DEVNULL)


def build_zip(name: str, python: str, source: Path, output: Path) -> Path:
    """Build the extension's zip for platform `name` and a Python from a copy of the tree, to which wheels are added."""
    tree, blender = source.with_name(f"{source.name}-{python}"), PYTHONS[python]
    shutil.copytree(source, tree)
    wheels = wheels_for(name, python, ROOT / "wheels")
    (tree / "wheels").mkdir()
    for wheel in wheels:
        shutil.copyfile(wheel, tree / "wheels" / wheel.name)
    text = (tree / MANIFEST.name).read_text(encoding="utf-8")
    given = tomllib.loads(text)
    own_readme(tree, given.get("website"))
    listed = f"platforms = {toml_list([name])}\nwheels = [\n"
    listed += "".join(f'  "./wheels/{wheel.name}",\n' for wheel in wheels) + "]"
    versions = f'blender_version_min = "{blender.first}"'
    versions += f'\nblender_version_max = "{blender.end}"' if blender.end else ""
    for declared, replacement in (
        (f"platforms = {toml_list(given['platforms'])}", listed),
        (f'blender_version_min = "{given["blender_version_min"]}"', versions),
    ):
        if f"\n{declared}\n" not in text:
            raise SystemExit(f"{MANIFEST.name}: expected a line {declared}")
        text = text.replace(declared, replacement)
    (tree / MANIFEST.name).write_text(text, encoding="utf-8")
    tool = (sys.executable, extension_tool())
    file = output / f"mphdrr-{given['version']}-{name.replace('-', '_')}-{blender.name}.zip"
    options = ("--source-dir", tree, "--output-filepath", file)
    subprocess.run((*tool, "build", *options), check=True, stdout=subprocess.DEVNULL)
    subprocess.run((*tool, "validate", file), check=True, stdout=subprocess.DEVNULL)
    return file


def toml_list(values: list[str]) -> str:
    """Format `values` as in Blender's manifests."""
    return "[" + ", ".join(f'"{value}"' for value in values) + "]"


def extension_tool() -> Path:
    """Return Blender's command-line tool for extensions, from the bpy wheel, without importing bpy."""
    spec = importlib.util.find_spec("bpy")
    if spec is None or not spec.submodule_search_locations:
        raise SystemExit("bpy is not installed here; run this as: make dist")
    return next(Path(spec.submodule_search_locations[0]).glob("*/scripts/addons_core/bl_pkg/cli/blender_ext.py"))


def main() -> None:
    """Build for all platforms, or for the given ones."""
    parser = argparse.ArgumentParser(description=__doc__)
    names = build_kernels.PLATFORMS
    parser.add_argument("--platform", action="append", choices=names, help="build for this one only; may be repeated")
    parser.add_argument("--output", type=Path, default=ROOT / "dist", help="folder of the wheels and zips")
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        stage(Path(folder))
        build_source_archive(Path(folder), arguments.output)
    for name in arguments.platform or names:
        with tempfile.TemporaryDirectory() as folder:
            tree = Path(folder) / "tree"
            stage(tree)
            build_wheel(name, tree, arguments.output)
            if name in PLATFORMS:
                build_kernels.build(name, tree / build_kernels.KERNELS.relative_to(ROOT))
                for python in PLATFORMS[name].pythons:
                    file = build_zip(name, python, tree, arguments.output)
                    print(f"{os.path.relpath(file)}: {file.stat().st_size / 1e6:.1f} MB, valid")
            else:
                print(f"{name}: a wheel alone, since there is no Blender for it")


if __name__ == "__main__":
    main()
