"""The wheel: what it holds, what type checkers say of scripts that use it, and how it is built without a compiler."""

from __future__ import annotations

import importlib.util
import json
import os
import runpy
import shutil
import subprocess
import sys
import venv
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import mphdrr.core as mph

from .conftest import WORKBOOK
from .small_events import small_recipe

ROOT = Path(__file__).parents[2]
SCRIPT = Path(__file__).parent / "data" / "user_script.py"


@pytest.fixture(scope="session")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the wheel without the kernels' library, from a copy of the tree."""
    pytest.importorskip("pip")
    folder = tmp_path_factory.mktemp("wheel")
    leave = shutil.ignore_patterns(".*", "out", "dist", "build", "*.egg-info", "__pycache__", "docs", "benchmarks")
    shutil.copytree(ROOT, folder / "tree", ignore=leave)
    command = [sys.executable, "-m", "pip", "wheel", ".", "--no-deps", "--no-build-isolation", "-w", str(folder)]
    environment = os.environ | {"MPHDRR_WITHOUT_KERNELS": "1"}
    built = subprocess.run(command, cwd=folder / "tree", env=environment, capture_output=True, text=True)
    assert built.returncode == 0, built.stdout + built.stderr
    (found,) = folder.glob("*.whl")
    return found


@pytest.fixture(scope="session")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Yield the Python of an environment that has the wheel, and all else of this one."""
    folder = tmp_path_factory.mktemp("installed")
    venv.create(folder, with_pip=False)
    (site,) = [*folder.glob("lib/python*/site-packages"), *folder.glob("Lib/site-packages")]
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)
    (site / "others.pth").write_text("\n".join(path for path in sys.path if path.endswith("site-packages")))
    yield next(iter([*folder.glob("bin/python"), *folder.glob("Scripts/python.exe")]))


def test_the_wheel_holds_the_package_and_nothing_else(wheel):
    assert wheel.name.endswith("-py3-none-any.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
    own = {name.removeprefix("mphdrr/") for name in names if name.startswith("mphdrr/")}
    assert all(name.startswith("mphdrr-") and ".dist-info/" in name for name in names if not name.startswith("mphdrr/"))
    folders = ("core", "addon", "operators", "panels")
    modules = {path.relative_to(ROOT).as_posix() for folder in folders for path in (ROOT / folder).rglob("*.py")}
    assert {name for name in own if name.endswith(".py") and name.split("/")[0] in folders} == modules
    assert {name.split("/")[0] for name in own} == {
        *folders, "examples", "__init__.py", "__main__.py", "py.typed", "blender_manifest.toml"
    }  # fmt: skip
    kinds = {"".join(Path(name).suffixes[-1:]) for name in own}
    assert kinds == {".py", ".pyi", ".toml", ".txt", ".xlsx", ".typed"}
    assert {f"core/events/templates/{name}.toml" for name in ("cardiac", "derenzo", "files", "mixed")} <= own


def test_a_missing_compiler_is_said_in_one_line_with_the_way_around_it(monkeypatch, tmp_path):
    build = runpy.run_path(str(ROOT / "tools" / "build_kernels.py"))
    monkeypatch.setitem(sys.modules, "ziglang", None)
    with pytest.raises(SystemExit) as stop:
        build["build"]("linux-x64", tmp_path)
    said = str(stop.value)
    assert "\n" not in said and "pip install ziglang==" in said and f"{build['WITHOUT_KERNELS']}=1" in said
    assert not list(tmp_path.iterdir())


def test_without_the_library_numpy_does_the_work(installed, tmp_path):
    code = (
        "import sys, json; sys.modules['torch'] = None\n"
        "import mphdrr, mphdrr.core as mph, numpy as np\n"
        f"system = mph.read_system({str(WORKBOOK)!r})[:2]\n"
        "grid = mph.Grid.centered((5, 4, 3), 9.0)\n"
        "A = mph.Projector(grid, system.views(shape=(3, 4)))\n"
        "print(json.dumps([mphdrr.__file__, A.backend, A(np.ones(grid.shape, np.float32)).tolist()]))"
    )
    said = subprocess.run([str(installed), "-W", "ignore", "-c", code], cwd=tmp_path, capture_output=True, text=True)
    assert said.returncode == 0, said.stderr
    place, backend, images = json.loads(said.stdout)
    assert str(installed.parents[1]) in place and backend == "numpy"
    grid = mph.Grid.centered((5, 4, 3), 9.0)
    expected = mph.Projector(grid, mph.read_system(WORKBOOK)[:2].views(shape=(3, 4)))(np.ones(grid.shape, np.float32))
    np.testing.assert_allclose(images, expected, rtol=1e-5, atol=1e-4)


def checked(command: list[str], folder: Path, text: str) -> subprocess.CompletedProcess[str]:
    (folder / "script.py").write_text(text, encoding="utf-8")
    return subprocess.run([*command, "script.py"], cwd=folder, capture_output=True, text=True)


@pytest.mark.long
@pytest.mark.parametrize("checker", ["mypy", "pyright"])
def test_type_checkers_accept_what_users_write_and_see_their_mistakes(checker, installed, tmp_path):
    pytest.importorskip("torch")
    if importlib.util.find_spec(checker) is None:
        pytest.skip(f"{checker} is not installed")
    command = {
        "mypy": [sys.executable, "-m", "mypy", "--strict", "--python-executable", str(installed)],
        "pyright": [sys.executable, "-m", "pyright", "--pythonpath", str(installed)],
    }[checker]
    text = SCRIPT.read_text(encoding="utf-8")
    found = checked(command, tmp_path, text)
    assert found.returncode == 0, found.stdout
    mistakes = (
        ("count=4", "count='four'"), ("shape=(16, 16), detector", "shape=16, detector"), (".truth\n", ".trueth\n"),
        ("mph.nrmse(", "mph.rmse("),
    )  # fmt: skip
    for right, wrong in mistakes:
        assert right in text
        text = text.replace(right, wrong, 1)
    found = checked(command, tmp_path, text)
    assert found.returncode == 1 and found.stdout.count("error:") >= len(mistakes), found.stdout


def test_what_users_write_runs(tmp_path):
    pytest.importorskip("torch")
    script = runpy.run_path(str(SCRIPT))
    run = script["simulate"](WORKBOOK, tmp_path)
    assert run.projections.shape == (80, 16, 16)
    recipe = mph.Recipe({
        "system.file": str(WORKBOOK), "system.modules": "1-8", "phantom.kind": "derenzo", "phantom.voxels": 24,
        "model.kind": "emission", "model.hole": "point", "model.pixel_points": 1, "model.tolerance": 1e6,
        "detector.rows": 12, "detector.columns": 12,
    })  # fmt: skip
    assert script["reconstruct"](recipe, tmp_path).volume.grid.shape == (12, 12, 12)
    small_recipe(tmp_path)
    script["train"](tmp_path / "small.toml", tmp_path)
    assert script["geometry"](WORKBOOK)["modules"] == 80
