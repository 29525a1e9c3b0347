"""What the layout promises and no linter sees: one version, no stray package, nothing imported too early."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from mphdrr.core.version import VERSION

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("addon", "core", "operators", "panels")
SOURCES = [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]


def toml(name: str) -> dict:
    return tomllib.loads((ROOT / name).read_text(encoding="utf-8"))


def test_version_is_the_same_everywhere():
    assert toml("pyproject.toml")["project"]["version"] == VERSION
    assert toml("blender_manifest.toml")["version"] == VERSION


def test_one_compiler_builds_the_kernels_everywhere():
    project = toml("pyproject.toml")
    required = [*project["build-system"]["requires"], *project["project"]["optional-dependencies"]["dev"]]
    assert len({text.split(";")[0].strip() for text in required if text.startswith("ziglang")}) == 1


def test_pyproject_lists_every_package():
    folders = {path.parent for path in SOURCES}
    names = {"mphdrr"} | {".".join(("mphdrr", *folder.relative_to(ROOT).parts)) for folder in folders}
    assert set(toml("pyproject.toml")["tool"]["setuptools"]["packages"]) == names
    assert all((folder / "__init__.py").is_file() for folder in folders)


def test_only_compat_looks_at_the_version_of_blender():
    looks = [path for path in SOURCES if "bpy.app.version" in path.read_text(encoding="utf-8")]
    assert [path.relative_to(ROOT).as_posix() for path in looks] in ([], ["addon/compat.py"])


def test_imports_inside_the_package_are_relative():
    """As an extension the package is called bl_ext.<repository>.mphdrr."""
    absolute = re.compile(r"^\s*(from|import) mphdrr\b", re.MULTILINE)
    assert [path for path in SOURCES if absolute.search(path.read_text(encoding="utf-8"))] == []


@pytest.mark.parametrize(
    ("module", "unwanted"),
    [
        ("mphdrr", {"numpy", "bpy", "mphdrr.core", "mphdrr.addon"}),
        ("mphdrr.core", {"bpy", "torch", "h5py", "trimesh", "PIL", "nibabel", "scipy", "openpyxl"}),
    ],
)
def test_import_loads_nothing_heavy(module: str, unwanted: set[str]):
    script = f"import sys, {module}; print(*(set({sorted(unwanted)!r}) & set(sys.modules)))"
    loaded = subprocess.run([sys.executable, "-c", script], check=True, capture_output=True, text=True).stdout
    assert loaded.strip() == ""
