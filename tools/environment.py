"""Make a virtual environment for this tree, or bring it up to date, for the Makefile. Any Python 3 runs this script.

bpy exists for Python 3.11 (Blender 4.5 LTS) and 3.13 (Blender 5.2 LTS) only, so one of these is searched for.
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
KERNELS = ROOT / "core/rays/backends/kernels"
VERSIONS = ("3.11", "3.13")
VERSION_WITH_TORCH = "3.11"

# For tests/core/test_diffdrr.py. DiffDRR requires gigabytes of packages that the tested modules do not import (pyvista,
# kornia, timm, torchvision, ...), so it is installed without its dependencies, and with the imports of these modules only.
# pandas 3.1 requires numpy 2, bpy 4.5 numpy 1.
DIFFDRR = "diffdrr==0.6.1"
DIFFDRR_IMPORTS = ("einops", "fastcore", "pandas<3.1", "torchio")

# For tests/core/test_adapters.py and test_event_exports_peers.py, with the extra "peers": the packages without the
# dependencies that their tested modules do not import (a second OpenCV, uproot, tensorboard, ...), and those that
# they import and "peers" lacks.
ADAPTED = ("deepinv==0.5.0", "pytomography==3.4.0", "pytorch3dunet==1.9.6", "rt-utils==1.2.7")
ADAPTED_IMPORTS = ("fft-conv-pytorch", "natsort", "pandas", "requests", "scikit-image", "scipy", "torchvision", "tqdm")

# For tests/core/test_learning_*.py: the extra "learning", which goes where torch goes.
LEARNING = ("lightning>=2.6", "monai>=1.4", "tensorboard>=2.14")

# System library that bpy loads -> the Debian package that contains it.
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
    """Return a version such as "3.11", or None if `python` does not run (such as a pyenv shim of an inactive version)."""
    ask = "import sys; print('%d.%d' % sys.version_info[:2])"
    try:
        answer = subprocess.run([str(python), "-c", ask], capture_output=True, text=True, timeout=60)
    except OSError:
        return None
    return answer.stdout.strip() if answer.returncode == 0 else None


def candidates(name: str) -> list[str | Path]:
    """Return the interpreters to try, `name` first; a name that contains a version allows only that version."""
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
    """Return the interpreter to use and its version, or exit with one line."""
    for python in candidates(name):
        version = version_of(python)
        if version in VERSIONS:
            return str(python), version
    raise SystemExit(
        f"{name}: no Python 3.11 or 3.13 found, the two that bpy exists for; name one: make PYTHON=/path/to/python3.11"
    )


def missing_packages() -> list[str]:
    """Return the Debian packages of the system libraries that bpy needs and this machine lacks."""
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
    """Run the environment's pip, silent except for errors; return whether it succeeded."""
    command = [str(venv / "bin/python"), "-m", "pip", *arguments, "-qq", "--disable-pip-version-check", "--no-input"]
    return subprocess.run(command, cwd=ROOT, stdin=subprocess.DEVNULL).returncode == 0


def add_diffdrr(venv: Path) -> bool:
    """Install the DiffDRR of the tests; return whether it succeeded."""
    # torchio would fetch its own torch if ours could not be installed.
    if subprocess.run([str(venv / "bin/python"), "-c", "import torch"], stderr=subprocess.DEVNULL).returncode != 0:
        return False
    return pip(venv, "install", *DIFFDRR_IMPORTS) and pip(venv, "install", "--no-deps", DIFFDRR)


def add_adapted(venv: Path, torch: str) -> bool:
    """Install the packages that the projector has adapters for, and pytorch-3dunet; return whether it succeeded."""
    # torchvision would fetch another torch than ours.
    return pip(venv, "install", *ADAPTED_IMPORTS, torch) and pip(venv, "install", "--no-deps", *ADAPTED)


def kernels_changed() -> bool:
    """Return whether the library of the C kernels is missing in the tree, or older than its sources."""
    sources = (ROOT / "tools/build_kernels.py", *KERNELS.glob("*.[ch]"))
    libraries = [file for file in KERNELS.iterdir() if file.suffix in (".so", ".dylib", ".dll")]
    return not libraries or libraries[0].stat().st_mtime < max(file.stat().st_mtime for file in sources)


def make(venv: Path, name: str, extras: set[str], torch: str | None) -> None:
    """Make or update `venv`; `torch` is a requirement, "" for an environment without torch, None to leave it unchanged."""
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
    if state == wanted and "dev" in wanted["extras"]:  # elsewhere pip fetches the compiler for the build
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
    if wanted["torch"] != state.get("torch", ""):  # before the extras, which would install another torch
        if not wanted["torch"]:
            pip(venv, "uninstall", "-y", "torch", "roma")
        elif not pip(venv, "install", wanted["torch"], "roma>=1.5"):
            print(f"{wanted['torch']} could not be installed: going on without it, its tests are skipped", flush=True)
    if not pip(venv, "install", "-e", f".[{','.join(wanted['extras'])}]"):
        raise SystemExit("pip could not install what mphDRR needs: see its messages above")
    if wanted["torch"] and "dev" in wanted["extras"] and not add_diffdrr(venv):
        print(f"{DIFFDRR} could not be installed: going on without it, its tests are skipped", flush=True)
    if wanted["torch"] and "dev" in wanted["extras"] and not pip(venv, "install", *LEARNING, wanted["torch"]):
        print(
            f"{', '.join(LEARNING)} could not be installed: going on without them, their tests are skipped", flush=True
        )
    if wanted["torch"] and "peers" in wanted["extras"] and not add_adapted(venv, wanted["torch"]):
        print(f"{', '.join(ADAPTED)} could not be installed: going on without them", flush=True)
    source = venv / "src"  # where mypy finds the repo root by the package's name
    source.mkdir(exist_ok=True)
    if not (source / "mphdrr").is_symlink():
        (source / "mphdrr").symlink_to(ROOT)
    state_file.write_text(json.dumps(wanted))
    print(f"{venv.name}: ready after {time.monotonic() - started:.0f} s", flush=True)


def main() -> None:
    """Parse the Makefile's arguments."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("venv", nargs="?", type=Path, help="folder of the environment")
    parser.add_argument("--python", default="python3", help="interpreter, or a name of one")
    parser.add_argument("--extras", default="blender", help="extras of pyproject.toml, separated by commas")
    parser.add_argument("--torch", help="requirement for torch, or empty for none; default: unchanged")
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
