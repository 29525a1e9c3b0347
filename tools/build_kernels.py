"""Compile the C kernels of the projector into the library of one platform, by the compiler that the package ziglang has.

Zig compiles for every platform on any other. What is compiled is core/projector/backends/kernels/; siddon.c once for each
level of processor and kind of number.
"""

from __future__ import annotations

import argparse
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

KERNELS = Path(__file__).resolve().parents[1] / "core/projector/backends/kernels"
AVX2 = ("-mavx2", "-mfma", "-mprfchw")
AVX512 = (*AVX2, "-mavx512f", "-mavx512vl", "-mavx512dq", "-mavx512bw")
# No -ffast-math: linked into a library, it switches denormal numbers off for the whole process that loads it.
FLAGS = (
    *("-O3", "-std=gnu11", "-g0", "-fPIC", "-fvisibility=hidden", "-Wall", "-Wextra", "-Werror"),
    *("-ffp-contract=fast", "-fno-math-errno", "-fno-trapping-math", "-fno-sanitize=undefined"),
)


@dataclass(frozen=True)
class Platform:
    """What the compiler and pip call a platform, its library's name, and the flags of each level of its processors."""

    target: str
    tag: str
    library: str = "libsiddon.so"
    levels: tuple[tuple[str, ...], ...] = ((), AVX2, AVX512)


# The names are Blender's; linux-arm64, which Blender has no builds for, is named alike.
PLATFORMS = {
    "linux-x64": Platform("x86_64-linux-gnu.2.17", "manylinux_2_17_x86_64.manylinux2014_x86_64"),
    "linux-arm64": Platform("aarch64-linux-gnu.2.17", "manylinux_2_17_aarch64.manylinux2014_aarch64", levels=((),)),
    "windows-x64": Platform("x86_64-windows-gnu", "win_amd64", "siddon.dll"),
    "macos-x64": Platform("x86_64-macos.10.15", "macosx_10_15_x86_64", "libsiddon.dylib"),
    "macos-arm64": Platform("aarch64-macos.11.0", "macosx_11_0_arm64", "libsiddon.dylib", levels=((),)),
}


def this_platform() -> str | None:
    """Give the name of the platform that this Python runs on, None where the kernels are not built for it."""
    system = {"linux": "linux", "win32": "windows", "darwin": "macos"}.get(sys.platform)
    machine = {"x86_64": "x64", "amd64": "x64", "aarch64": "arm64", "arm64": "arm64"}.get(platform.machine().lower())
    if sys.maxsize < 2**32 or (system == "linux" and platform.libc_ver()[0] != "glibc"):
        return None
    name = f"{system}-{machine}"
    return name if name in PLATFORMS else None


def zig(*arguments: str | Path, cwd: str | Path) -> None:
    """Run the compiler; stop where it fails, after its own words."""
    if subprocess.run((sys.executable, "-m", "ziglang", *arguments), cwd=cwd).returncode != 0:
        raise SystemExit("the kernels could not be compiled: the compiler's words are above")


def compiled(name: str, folder: str | Path, flags: tuple[str, ...] = FLAGS) -> list[str]:
    """Give the names of the objects of platform `name`'s library, compiled into `folder`."""
    made_for = PLATFORMS[name]
    calls: list[tuple[str, str, tuple[str, ...]]] = [("levels.o", "levels.c", ())]
    for level, options in enumerate(made_for.levels):
        for real in ("float", "double"):
            calls.append((f"{real}{level}.o", "siddon.c", (*options, f"-DLEVEL={level}", f"-DREAL={real}")))

    def compile_one(call: tuple[str, str, tuple[str, ...]]) -> str:
        made, source, options = call
        zig("cc", "-target", made_for.target, *flags, *options, "-c", KERNELS / source, "-o", made, cwd=folder)
        return made

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return list(pool.map(compile_one, calls))


def build(name: str, folder: Path) -> Path:
    """Give the library of platform `name`, compiled into `folder`, which is made.

    The kernels call no C library and none is linked, only the compiler's own functions: to make one of Windows ready takes
    Zig two minutes.
    """
    made_for = PLATFORMS[name]
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
        # Not written over: a process may have the one there loaded.
        new = folder / (made_for.library + ".new")
        shutil.copyfile(Path(objects) / made_for.library, new)
        return new.replace(folder / made_for.library)


def main() -> None:
    """Build for this machine, or for the platform named."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "platform", nargs="?", choices=PLATFORMS, default=this_platform(), help="this machine's if not given"
    )
    parser.add_argument("--output", type=Path, default=KERNELS, help="folder of the library")
    arguments = parser.parse_args()
    if arguments.platform is None:
        raise SystemExit(f"the kernels are not built for this machine; name one of {', '.join(PLATFORMS)}")
    print(build(arguments.platform, arguments.output))


if __name__ == "__main__":
    main()
