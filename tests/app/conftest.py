"""A real Blender, driven from outside: the built zip installed into a clean home, without network.

Needs the script `real-blender` (REAL_BLENDER, or shared/tools beside the clone) and the zip in dist/: make test-app.
Blender runs in its own root, which contains this repository's disk but not the machine's temporary folder: files for it and
from it go to `work_folder`.
"""

from __future__ import annotations

import functools
import json
import os
import shutil
import subprocess
import tomllib
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]
REAL_BLENDER = Path(os.environ.get("REAL_BLENDER", ROOT.parent / "shared/tools/real-blender"))
OUTPUT = ROOT / "out" / "test-app"
MODULE = "bl_ext.user_default.mphdrr"
# Where the script binds the top folder of this repository's path into Blender's root.
BOUND = Path(os.environ.get("REAL_BLENDER_ROOT", "/opt/real-blender")).joinpath(*ROOT.parts[1:2])

PATIENCE = 600  # s after which a window that has not said that it is done is closed

Run = Callable[..., subprocess.CompletedProcess[str]]


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    if not REAL_BLENDER.is_file():
        for item in items:
            if item.path.is_relative_to(Path(__file__).parent):
                item.add_marker(pytest.mark.skip(reason=f"needs a real Blender: no {REAL_BLENDER}"))


def real_blender(
    *arguments: str | Path, home: Path, network: bool = False, timeout: float = 300
) -> subprocess.CompletedProcess[str]:
    """Run the script with these arguments, in its own mount namespace and, by default, without network.

    The script does not unmount our folder, and takes whatever is mounted there for ours: once the folder was
    deleted and created again, it would show the deleted one. In a namespace of its own the mounts end with it.
    """
    command = [str(REAL_BLENDER), *map(str, arguments)]
    if shutil.which("unshare"):
        afresh = 'while umount --lazy "$0" 2>/dev/null; do :; done; exec "$@"'
        command = ["unshare", "--mount", *([] if network else ["--net"]), "bash", "-c", afresh, str(BOUND), *command]
    environment = {**os.environ, "REAL_BLENDER_HOME": str(home)}
    return subprocess.run(
        command, cwd=ROOT, env=environment, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=timeout
    )


def run_blender(
    *arguments: str | Path, home: Path, check: bool = True, network: bool = False, timeout: float = 300
) -> subprocess.CompletedProcess[str]:
    done = real_blender("run", *arguments, home=home, network=network, timeout=timeout)
    if check and done.returncode != 0:
        pytest.fail(f"blender ended with status {done.returncode}\n{done.stdout[-4000:]}\n{done.stderr[-4000:]}")
    return done


def _emptied(folder: Path) -> Path:
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    return folder


@pytest.fixture(scope="session")
def extension_zip() -> Path:
    """Return the built zip for Linux and the real Blender; it must be of this tree."""
    version = tomllib.loads((ROOT / "blender_manifest.toml").read_text())["version"]
    path = ROOT / "dist" / f"mphdrr-{version}-linux_x64-python_3.14.zip"  # the real Blender is a distribution's
    if not path.is_file():
        pytest.fail(f"{path.name} is not in dist/; run: make dist PLATFORM=linux-x64")
    with zipfile.ZipFile(path) as archive:
        for name in archive.namelist():
            if name.endswith((".py", "siddon.so")) and archive.read(name) != (ROOT / name).read_bytes():
                pytest.fail(f"{path.name} is older than {name}; run: make dist PLATFORM=linux-x64")
    return path


@pytest.fixture(scope="session")
def home(extension_zip: Path) -> Path:
    """Return a clean home of Blender with the extension installed from the zip and enabled."""
    subprocess.run([REAL_BLENDER, "setup"], check=True, capture_output=True)
    folder = _emptied(OUTPUT / f"home-{os.environ.get('PYTEST_XDIST_WORKER', 'alone')}")
    run_blender("--command", "extension", "install-file", "-r", "user_default", "-e", extension_zip, home=folder)
    return folder


@pytest.fixture
def work_folder(home: Path, request: pytest.FixtureRequest) -> Path:
    """Return an empty folder of this test's own that Blender sees at the same path."""
    return _emptied(OUTPUT / request.node.name.replace("/", "-"))


@pytest.fixture
def blender(home: Path) -> Run:
    """Return `blender(*arguments, check=True, network=False, timeout=300)`: it runs with the extension, for its output."""
    return functools.partial(run_blender, home=home)


@pytest.fixture
def new_blender(request: pytest.FixtureRequest) -> Run:
    """Return a `blender` in a clean home of the test's own, without the extension."""
    return functools.partial(run_blender, home=_emptied(OUTPUT / f"home-{request.node.name}"))


@pytest.fixture
def blender_script(blender: Run, work_folder: Path) -> Run:
    """Return `blender_script(text, *arguments)`: it runs Python in a windowless Blender; an exception fails the test."""

    def run(text: str, *arguments: str | Path, **options: float) -> subprocess.CompletedProcess[str]:
        script = work_folder / "script.py"
        script.write_text(text, encoding="utf-8")
        return blender("--background", "--python-exit-code", "3", "--python", script, "--", *arguments, **options)

    return run


@pytest.fixture
def window(home: Path, work_folder: Path) -> Callable[..., dict[str, Any]]:
    """Return `window(name, *arguments)`: it takes the steps of window_NAME.py in Blender's window and returns its `seen`.

    The window is closed when the script says that it has ended, and at the latest after some minutes; "screen" is then a
    PNG of the whole screen, and nothing may have gone wrong, in the script or in what Blender printed.
    """

    def run(name: str, *arguments: str | Path) -> dict[str, Any]:
        here, screen, said = Path(__file__).parent, work_folder / "window.png", work_folder / "seen.json"
        script = here / f"window_{name}.py"
        given = (str(PATIENCE), work_folder, work_folder, *arguments)
        done = real_blender("python", here / "in_window.py", screen, script, *given, home=home, timeout=PATIENCE + 60)
        if not screen.is_file() or not said.is_file():
            pytest.fail(f"no screenshot, or nothing seen\n{done.stdout[-4000:]}\n{done.stderr[-4000:]}")
        seen = json.loads(said.read_text())
        assert seen["ok"], seen.get("error", seen)
        log = (work_folder / "log.txt").read_text()
        assert "Traceback" not in log, log
        return {**seen, "screen": screen}

    return run
