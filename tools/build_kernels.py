"""Compile the C kernels of the projector into the library of one platform, with the compiler in the package ziglang.

Zig compiles for every platform on any other. The sources are in core/rays/backends/kernels/; each is compiled
once per level of processor and number type.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

WITHOUT_KERNELS = "MPHDRR_WITHOUT_KERNELS"
"""Environment variable that asks for a package without the library."""
KERNELS = Path(__file__).resolve().parents[1] / "core/rays/backends/kernels"
AVX2 = ("-mavx2", "-mfma", "-mprfchw")
AVX512 = (*AVX2, "-mavx512f", "-mavx512vl", "-mavx512dq", "-mavx512bw")
# No -ffast-math: linked into a library, it switches denormal numbers off for the whole process that loads it.
FLAGS = (
    *("-O3", "-std=gnu11", "-g0", "-fPIC", "-fvisibility=hidden", "-Wall", "-Wextra", "-Werror"),
    *("-ffp-contract=fast", "-fno-math-errno", "-fno-trapping-math", "-fno-sanitize=undefined"),
)


@dataclass(frozen=True)
class Platform:
    """The names of a platform for compiler and pip, its library's name, and the flags of each processor level."""

    target: str
    tag: str
    library: str = "libsiddon.so"
    levels: tuple[tuple[str, ...], ...] = ((), AVX2, AVX512)


# Blender's names; linux-arm64, for which there is no Blender, is named in the same way.
PLATFORMS = {
    "linux-x64": Platform("x86_64-linux-gnu.2.17", "manylinux_2_17_x86_64.manylinux2014_x86_64"),
    "linux-arm64": Platform("aarch64-linux-gnu.2.17", "manylinux_2_17_aarch64.manylinux2014_aarch64", levels=((),)),
    "windows-x64": Platform("x86_64-windows-gnu", "win_amd64", "siddon.dll"),
    "macos-x64": Platform("x86_64-macos.10.15", "macosx_10_15_x86_64", "libsiddon.dylib"),
    "macos-arm64": Platform("aarch64-macos.11.0", "macosx_11_0_arm64", "libsiddon.dylib", levels=((),)),
}


def this_platform() -> str | None:
    """Return the name of the platform that this Python runs on, or None if the kernels are not built for it."""
    system = {"linux": "linux", "win32": "windows", "darwin": "macos"}.get(sys.platform)
    machine = {"x86_64": "x64", "amd64": "x64", "aarch64": "arm64", "arm64": "arm64"}.get(platform.machine().lower())
    if sys.maxsize < 2**32 or (system == "linux" and platform.libc_ver()[0] != "glibc"):
        return None
    name = f"{system}-{machine}"
    return name if name in PLATFORMS else None


def zig(*arguments: str | Path, cwd: str | Path) -> None:
    """Run the compiler; exit if it fails."""
    if subprocess.run((sys.executable, "-m", "ziglang", *arguments), cwd=cwd).returncode != 0:
        raise SystemExit("the kernels could not be compiled: see the compiler's messages above")


def compiled(name: str, folder: str | Path, flags: tuple[str, ...] = FLAGS) -> list[str]:
    """Compile the object files of platform `name`'s library into `folder`, and return their names."""
    made_for = PLATFORMS[name]
    calls: list[tuple[str, str, tuple[str, ...]]] = [("levels.o", "levels.c", ())]
    for level, options in enumerate(made_for.levels):
        for real in ("float", "double"):
            for source in ("siddon", "depth", "places", *(["photons"] if real == "float" else [])):
                made = f"{source}_{real}{level}.o"
                calls.append((made, f"{source}.c", (*options, f"-DLEVEL={level}", f"-DREAL={real}")))

    def compile_one(call: tuple[str, str, tuple[str, ...]]) -> str:
        made, source, options = call
        zig("cc", "-target", made_for.target, *flags, *options, "-c", KERNELS / source, "-o", made, cwd=folder)
        return made

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return list(pool.map(compile_one, calls))


def build(name: str, folder: Path) -> Path:
    """Compile the library of platform `name` into `folder`, which is made if necessary, and return its path.

    The kernels call no C library, so none is linked, only the compiler's own functions; to prepare Windows' would take Zig
    two minutes.
    """
    made_for = PLATFORMS[name]
    if importlib.util.find_spec("ziglang") is None:
        raise SystemExit(
            "the C kernels need a compiler that is missing: pip install ziglang==0.17.1; or set the environment variable "
            f"{WITHOUT_KERNELS}=1, and torch or numpy does their work, many times slower"
        )
    with tempfile.TemporaryDirectory() as objects:
        options = (
            "-dynamic",
            "-fcompiler-rt",
            "-fno-allow-shlib-undefined",
            "-fstrip",
            "-OReleaseFast",
            "--name",
            "siddon",
        )
        zig("build-lib", "-target", made_for.target, *options, *compiled(name, objects), cwd=objects)
        folder.mkdir(parents=True, exist_ok=True)
        # Replaced, not overwritten: a process may have the old one loaded.
        new = folder / (made_for.library + ".new")
        shutil.copyfile(Path(objects) / made_for.library, new)
        return new.replace(folder / made_for.library)


def main() -> None:
    """Build for this machine, or for the given platform."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "platform", nargs="?", choices=PLATFORMS, default=this_platform(), help="default: this machine's"
    )
    parser.add_argument("--output", type=Path, default=KERNELS, help="folder of the library")
    arguments = parser.parse_args()
    if arguments.platform is None:
        raise SystemExit(f"the kernels are not built for this machine; name one of {', '.join(PLATFORMS)}")
    print(build(arguments.platform, arguments.output))


if __name__ == "__main__":
    main()
