"""Wheel and source archive in clean environments of each Python, without make, compiler or, after the download, network."""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.version import VERSION

pytestmark = pytest.mark.long


ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
PYTHONS = ("3.11", "3.12", "3.13")
PIP = (sys.executable, "-m", "pip")
PROJECTED = """
rods = mph.DerenzoPhantom(40, (8, 6, 5, 4, 3, 2), 40).voxelize(mph.Grid.centered((12, 12, 12), 8.0))
A = mph.Projector(rods.grid, mph.read_system(workbook)[:3].views(shape=(16, 16)), threads=1)
images = A(rods)
"""
SAID = """
import json, mphdrr, sys, pathlib
from importlib.metadata import distribution
own = distribution("mphdrr")
print(json.dumps({
    "images": images.tolist(), "backend": A.backend, "version": mphdrr.__version__, "place": mphdrr.__file__,
    "metadata": {name: own.metadata.get_all(name) for name in set(own.metadata)},
    "files": [str(file) for file in own.files], "commands": [str(point.value) for point in own.entry_points],
}))
"""
TYPED = "import mphdrr.core as mph\nimages = mph.read_run('run.h5').projections\nreveal_type(images)\nmph.read_runn\n"


def run(*command: object, folder: Path) -> str:
    """Return the output of a program in a bare surrounding: nothing on the path, and no network where that can be had."""
    words = [str(word) for word in command]
    alone = [shutil.which("unshare") or "unshare", "--map-root-user", "--net"]
    if shutil.which("unshare") and subprocess.run([*alone, "true"], capture_output=True).returncode == 0:
        words = [*alone, *words]
    bare = {"PATH": str(folder / "empty"), "HOME": str(folder), "PIP_DISABLE_PIP_VERSION_CHECK": "1"}
    done = subprocess.run(words, cwd=folder, env=bare, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def download(folder: Path) -> None:
    """Put the source archive, and all that is needed besides, into a folder."""
    leave = shutil.ignore_patterns(
        ".*", "out", "dist", "build", "wheels", "*.egg-info", "__pycache__", "*.so", "*.dll", "*.dylib"
    )
    shutil.copytree(ROOT, folder / "tree", ignore=leave)
    code = f"from setuptools.build_meta import build_sdist; build_sdist({str(folder)!r})"
    subprocess.run([sys.executable, "-c", code], cwd=folder / "tree", check=True, capture_output=True)
    for_pythons = [["--python-version", python, *PROJECT["project"]["dependencies"]] for python in PYTHONS]
    for words in [PROJECT["build-system"]["requires"], *for_pythons]:
        command = [*PIP, "download", "-qq", "--only-binary=:all:", "-d", str(folder), *words]
        fetched = subprocess.run(command, capture_output=True, text=True)
        if fetched.returncode:
            pytest.skip(f"cannot be downloaded here: {fetched.stderr.strip().splitlines()[-1]}")


def interpreter(version: str) -> str | None:
    """Return a Python of this version, if there is any."""
    kept = sorted(Path.home().glob(f".pyenv/versions/{version}.*/bin/python"))
    found = str(kept[-1]) if kept else shutil.which(f"python{version}")
    # pyenv's shim of a version that is not chosen is there, but does not run
    works = found and subprocess.run([found, "-c", ""], capture_output=True, check=False).returncode == 0
    return found if works else None


def test_the_source_archive_becomes_a_wheel_that_projects_alike_in_every_python(tmp_path: Path):
    """One test, for one download and one compilation of the kernels, by the compiler that pip fetched."""
    pytest.importorskip("pip")
    house = tmp_path / "house"
    house.mkdir()
    download(house)
    offline = ("-qq", "--no-index", "--find-links", house)
    run(*PIP, "wheel", *offline, "--no-deps", "-w", house, house / f"mphdrr-{VERSION}.tar.gz", folder=house)
    (wheel,) = house.glob("mphdrr-*.whl")
    shutil.copy(ROOT / "examples" / "dc-spect-80.xlsx", tmp_path / "scanner.xlsx")
    here: dict = {"mph": mph, "workbook": str(tmp_path / "scanner.xlsx")}
    exec(PROJECTED, here)

    tried = []
    for version in PYTHONS:
        if (found := interpreter(version)) is None:
            continue
        folder = tmp_path / version
        subprocess.run([found, "-m", "venv", "--without-pip", folder], check=True)
        python = folder / "bin" / "python"
        run(*PIP, "--python", python, "install", *offline, "--no-compile", wheel, folder=folder)
        assert run(python.with_name("mphdrr"), "--version", folder=folder) == f"mphDRR {VERSION}\n"
        code = f"import mphdrr.core as mph\nworkbook = {here['workbook']!r}\n{PROJECTED}{SAID}"
        said = json.loads(run(python, "-c", code, folder=folder))
        assert said["version"] == VERSION and said["backend"] == "cpu" and str(folder) in said["place"]
        np.testing.assert_array_equal(np.array(said["images"], np.float32), here["images"])
        tried.append(python)
    assert tried, f"expected one of Python {', '.join(PYTHONS)}"
    assert_metadata(said["metadata"], said["files"], said["commands"])
    assert_types_are_seen(tried[-1], tmp_path)


def assert_metadata(about: dict, files: list[str], commands: list[str]) -> None:
    assert about["License-Expression"] == ["GPL-3.0-or-later"] and about["License-File"] == ["LICENSE"]
    assert {f"Programming Language :: Python :: {version}" for version in PYTHONS} <= set(about["Classifier"])
    assert set(about["Provides-Extra"]) == set(PROJECT["project"]["optional-dependencies"])
    assert commands == ["mphdrr.addon.cli:main"] and "mphdrr/py.typed" in files
    assert [file for file in files if file.endswith("licenses/LICENSE")]


def assert_types_are_seen(python: Path, folder: Path) -> None:
    """Check that a type checker sees the types of the installed package."""
    if importlib.util.find_spec("mypy") is None:
        return
    (folder / "script.py").write_text(TYPED)
    command = [sys.executable, "-m", "mypy", "--python-executable", str(python), "script.py"]
    alone = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "MYPYPATH")}
    said = subprocess.run(command, cwd=folder, env=alone, capture_output=True, text=True).stdout
    assert "ndarray[" in said and 'attribute "read_runn"' in said and "Found 1 error" in said, said
