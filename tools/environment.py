"""Make a virtual environment of this tree, or do nothing when it is there; for the Makefile. Any Python 3 runs it.

bpy exists for Python 3.11 (Blender 4.5 LTS) and 3.13 (Blender 5.2 LTS) only, so one of these is looked for.
"""

from __future__ import annotations

import argparse
import ctypes
import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
KERNELS = ROOT / "core/projector/backends/kernels"
VERSIONS = ("3.11", "3.13")
VERSION_WITH_TORCH = "3.11"

# What tests/core/test_diffdrr.py compares with. DiffDRR declares more than it imports (pyvista, kornia, timm, torchvision,
# ...: gigabytes), so it is installed without its dependencies, and these are what its modules that we test import. pandas
# 3.1 asks for numpy 2, bpy 4.5 for numpy 1.
DIFFDRR = "diffdrr==0.6.1"
DIFFDRR_IMPORTS = ("einops", "fastcore", "pandas<3.1", "torchio")

# What bpy loads from the system -> the Debian package that has it.
LIBRARIES = {
    "libX11.so.6": "libx11-6",
    "libXi.so.6": "libxi6",
    "libXfixes.so.3": "libxfixes3",
    "libXrender.so.1": "libxrender1",
    "libXext.so.6": "libxext6",
    "libxkbcommon.so.0": "libxkbcommon0",
    "libSM.so.6": "libsm6",
    "libICE.so.6": "libice6",
    "libGL.so.1": "libgl1",
}


def version_of(python: str | Path) -> str | None:
    """Give "3.11" and the like, or None where `python` does not run (a pyenv shim of a version that is not chosen)."""
    ask = "import sys; print('%d.%d' % sys.version_info[:2])"
    try:
        answer = subprocess.run([str(python), "-c", ask], capture_output=True, text=True, timeout=60)
    except OSError:
        return None
    return answer.stdout.strip() if answer.returncode == 0 else None


def candidates(name: str) -> list[str | Path]:
    """Interpreters to try, the asked one first; a name with a version in it asks for that version alone."""
    match = re.search(r"3\.\d+$", name)
    versions = (match.group(),) if match else VERSIONS
    found: list[str | Path] = [name, *(f"python{version}" for version in versions)]
    shim = shutil.which(name) or shutil.which("python3") or ""
    roots = [os.environ.get("PYENV_ROOT"), Path(shim).parent.parent, Path.home() / ".pyenv"]
    for version in versions:
        for root in roots:
            if root:
                found += sorted(Path(root).glob(f"versions/{version}.*/bin/python"), reverse=True)
    return found


def find_python(name: str) -> tuple[str, str]:
    """Give the interpreter to use and its version, or stop with one line."""
    for python in candidates(name):
        version = version_of(python)
        if version in VERSIONS:
            return str(python), version
    raise SystemExit(
        f"{name}: no Python 3.11 or 3.13 found, the two that bpy exists for; name one: make PYTHON=/path/to/python3.11"
    )


def missing_packages() -> list[str]:
    """Debian packages of the system libraries that bpy needs and this machine lacks."""
    if not sys.platform.startswith("linux"):
        return []
    missing = []
    for library, package in LIBRARIES.items():
        try:
            ctypes.CDLL(library)
        except OSError:
            missing.append(package)
    return missing


def pip(venv: Path, *arguments: str) -> bool:
    """Run the environment's pip, silent but for errors; say whether it succeeded."""
    command = [str(venv / "bin/python"), "-m", "pip", *arguments, "-qq", "--disable-pip-version-check", "--no-input"]
    return subprocess.run(command, cwd=ROOT, stdin=subprocess.DEVNULL).returncode == 0


def add_diffdrr(venv: Path) -> bool:
    """Install the DiffDRR of the tests; say whether it succeeded."""
    # torchio would fetch a torch of its own where ours could not be installed.
    if subprocess.run([str(venv / "bin/python"), "-c", "import torch"], stderr=subprocess.DEVNULL).returncode != 0:
        return False
    return pip(venv, "install", *DIFFDRR_IMPORTS) and pip(venv, "install", "--no-deps", DIFFDRR)


def kernels_changed() -> bool:
    """Say whether the library of the C kernels is missing in the tree, or older than what it is built from."""
    sources = (ROOT / "tools/build_kernels.py", *KERNELS.glob("*.[ch]"))
    libraries = [file for file in KERNELS.iterdir() if file.suffix in (".so", ".dylib", ".dll")]
    return not libraries or libraries[0].stat().st_mtime < max(file.stat().st_mtime for file in sources)


def make(venv: Path, name: str, extras: set[str], torch: str | None) -> None:
    """Bring `venv` to what is asked; `torch` is a requirement, "" for an environment without it, None for either."""
    python, version = find_python(name)
    if torch and version != VERSION_WITH_TORCH:
        torch = ""
    state_file = venv / "mphdrr-environment.json"
    state = json.loads(state_file.read_text()) if state_file.is_file() else {}
    makers = ("pyproject.toml", "setup.py", "tools/environment.py")
    digest = hashlib.sha256(b"".join((ROOT / f).read_bytes() for f in makers))
    wanted = {
        "version": version,
        "digest": digest.hexdigest(),
        "extras": sorted(extras | set(state.get("extras", []))),
        "torch": state.get("torch", "") if torch is None else torch,
    }
    if state == wanted and not kernels_changed():
        return
    if state == wanted and "dev" in wanted["extras"]:  # the others have no compiler: pip gets them one for a moment
        subprocess.run([str(venv / "bin/python"), str(ROOT / "tools/build_kernels.py")], check=True)
        return
    started = time.monotonic()
    word = "bringing up to date" if state else "installing for the first time, which takes some minutes"
    print(f"{venv.name} (Python {version}): {word}", flush=True)
    if state.get("version", version) != version:
        shutil.rmtree(venv)
        state = {}
    if not (venv / "bin/pip").exists() and subprocess.run([python, "-m", "venv", str(venv)]).returncode != 0:
        raise SystemExit(f"{python} cannot make virtual environments; on Debian: apt-get install python3-venv")
    state_file.unlink(missing_ok=True)
    if wanted["torch"] != state.get("torch", ""):  # before the extras, which would bring a torch of their own
        if not wanted["torch"]:
            pip(venv, "uninstall", "-y", "torch", "roma")
        elif not pip(venv, "install", wanted["torch"], "roma>=1.5"):
            print(f"{wanted['torch']} could not be installed: going on without it, its tests are skipped", flush=True)
    if not pip(venv, "install", "-e", f".[{','.join(wanted['extras'])}]"):
        raise SystemExit("pip could not install what mphDRR needs; its words are above")
    if wanted["torch"] and "dev" in wanted["extras"] and not add_diffdrr(venv):
        print(f"{DIFFDRR} could not be installed: going on without it, its tests are skipped", flush=True)
    source = venv / "src"  # where mypy finds the repo root under the package's name
    source.mkdir(exist_ok=True)
    if not (source / "mphdrr").is_symlink():
        (source / "mphdrr").symlink_to(ROOT)
    state_file.write_text(json.dumps(wanted))
    print(f"{venv.name}: ready after {time.monotonic() - started:.0f} s", flush=True)


def main() -> None:
    """Parse the Makefile's call."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("venv", nargs="?", type=Path, help="folder of the environment")
    parser.add_argument("--python", default="python3", help="interpreter, or a name of one")
    parser.add_argument("--extras", default="blender", help="extras of pyproject.toml, separated by commas")
    parser.add_argument("--torch", help="requirement for torch, or empty for none; unset leaves it as it is")
    parser.add_argument(
        "--libraries", action="store_true", help="only list the Debian packages of all libraries bpy needs"
    )
    arguments = parser.parse_args()
    if arguments.libraries:
        print(*LIBRARIES.values())
        return
    if missing := missing_packages():
        raise SystemExit(f"bpy needs system libraries; install them with: apt-get install {' '.join(missing)}")
    make(arguments.venv.absolute(), arguments.python, set(arguments.extras.split(",")), arguments.torch)


if __name__ == "__main__":
    main()
