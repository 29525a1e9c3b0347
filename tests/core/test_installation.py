"""Wheel and source archive in clean environments of each Python, without make, compiler or, after the download, network."""

from __future__ import annotations

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
FROM_PACKAGE = "import mphdrr.core as mph\n"
PROJECTED = """
rods = mph.DerenzoPhantom(40, (8, 6, 5, 4, 3, 2), 40).voxelize(mph.Grid.centered((12, 12, 12), 8.0))
A = mph.Projector(rods.grid, mph.read_system(WORKBOOK)[:3].views(shape=(16, 16)), threads=1)
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
    """What a program prints in a bare surrounding: nothing on the path, and no network where that can be had."""
    words = [str(word) for word in command]
    alone = [shutil.which("unshare") or "unshare", "--map-root-user", "--net"]
    if shutil.which("unshare") and subprocess.run([*alone, "true"], capture_output=True).returncode == 0:
        words = [*alone, *words]
    bare = {"PATH": str(folder / "empty"), "HOME": str(folder), "PIP_DISABLE_PIP_VERSION_CHECK": "1"}
    done = subprocess.run(words, cwd=folder, env=bare, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="session")
def house(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of the source archive and of all that is needed besides, downloaded."""
    pytest.importorskip("pip")
    folder = tmp_path_factory.mktemp("house")
    leave = shutil.ignore_patterns(
        ".*", "out", "dist", "build", "wheels", "*.egg-info", "__pycache__", "*.so", "*.dll", "*.dylib"
    )
    shutil.copytree(ROOT, folder / "tree", ignore=leave)
    code = f"from setuptools.build_meta import build_sdist; build_sdist({str(folder)!r})"
    subprocess.run([sys.executable, "-c", code], cwd=folder / "tree", check=True, capture_output=True)
    fetch = [sys.executable, "-m", "pip", "download", "-qq", "--only-binary=:all:", "-d", str(folder)]
    wanted = [[*PROJECT["build-system"]["requires"]]]
    wanted += [["--python-version", python, *PROJECT["project"]["dependencies"]] for python in PYTHONS]
    for words in wanted:
        fetched = subprocess.run([*fetch, *words], capture_output=True, text=True)
        if fetched.returncode:
            pytest.skip(f"cannot be downloaded here: {fetched.stderr.strip().splitlines()[-1]}")
    return folder


@pytest.fixture(scope="session")
def wheel(house: Path) -> Path:
    """Built from the source archive, the kernels with the compiler that came as a wheel."""
    command = (
        sys.executable,
        "-m",
        "pip",
        "wheel",
        "-qq",
        "--no-index",
        "--find-links",
        house,
        "--no-deps",
        "-w",
        house,
    )
    run(*command, house / f"mphdrr-{VERSION}.tar.gz", folder=house)
    (built,) = house.glob("mphdrr-*.whl")
    return built


@pytest.fixture(params=PYTHONS)
def python(request: pytest.FixtureRequest, wheel: Path, tmp_path: Path) -> Path:
    """The Python of a clean environment in which the wheel is installed."""
    kept = sorted(Path.home().glob(f".pyenv/versions/{request.param}.*/bin/python"))
    found = kept[-1] if kept else shutil.which(f"python{request.param}")
    if found is None:
        pytest.skip(f"there is no Python {request.param} here")
    subprocess.run([found, "-m", "venv", "--without-pip", tmp_path / "env"], check=True)
    python = tmp_path / "env" / "bin" / "python"
    pip = (sys.executable, "-m", "pip", "--python", python, "install", "-qq", "--no-compile")
    run(*pip, "--no-index", "--find-links", wheel.parent, wheel, folder=tmp_path)
    return python


def test_an_installed_package_projects_as_the_source_does(python: Path, tmp_path: Path):
    assert run(python.with_name("mphdrr"), "--version", folder=tmp_path) == f"mphDRR {VERSION}\n"
    workbook = str(tmp_path / "scanner.xlsx")
    shutil.copy(ROOT / "examples" / "dc-spect-80.xlsx", workbook)
    projected = PROJECTED.replace("WORKBOOK", repr(workbook))
    said = json.loads(run(python, "-c", FROM_PACKAGE + projected + SAID, folder=tmp_path))
    assert said["version"] == VERSION and said["backend"] == "cpu" and str(tmp_path) in said["place"]
    here: dict = {"mph": mph}
    exec(projected, here)
    np.testing.assert_array_equal(np.array(said["images"], np.float32), here["images"])

    about, files = said["metadata"], said["files"]
    assert about["License-Expression"] == ["GPL-3.0-or-later"] and about["License-File"] == ["LICENSE"]
    assert {f"Programming Language :: Python :: {version}" for version in PYTHONS} <= set(about["Classifier"])
    assert set(about["Provides-Extra"]) == set(PROJECT["project"]["optional-dependencies"])
    assert said["commands"] == ["mphdrr.addon.cli:main"] and "mphdrr/py.typed" in files
    assert [file for file in files if file.endswith("licenses/LICENSE")]

    if (python.parents[1] / "lib" / f"python{PYTHONS[-1]}").is_dir():
        assert_types_are_seen(python, tmp_path)


def assert_types_are_seen(python: Path, folder: Path) -> None:
    """By a type checker, those of the installed package; one Python is enough."""
    pytest.importorskip("mypy")
    (folder / "script.py").write_text(TYPED)
    command = [sys.executable, "-m", "mypy", "--python-executable", str(python), "script.py"]
    alone = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "MYPYPATH")}
    said = subprocess.run(command, cwd=folder, env=alone, capture_output=True, text=True).stdout
    assert "ndarray[" in said and 'attribute "read_runn"' in said and "Found 1 error" in said, said
