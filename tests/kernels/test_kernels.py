"""The kernels without Python, on hostile jobs: under sanitizers, for arm64 under qemu, for Windows under Wine.

check.c runs thousands of jobs from a file: bundles of rays, and places in arrays. Their results are
compared with the float64 references in numpy; that nothing is read or written outside its array is seen by sanitizers, and
elsewhere by pages that cannot be touched.
"""

from __future__ import annotations

import math
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mphdrr.core.rays.backends import reference
from mphdrr.core.rays.backends.cpu import _fans
from mphdrr.core.rays.ray_geometry import Attenuation, IndexFans, IndexRays

from .jobs import BAD, Made, Read, close, packed
from .photon_jobs import photon_jobs
from .places_jobs import places_jobs

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tools"))
import build_kernels  # noqa: E402

Array = np.ndarray[Any, Any]

DRIVER = ROOT / "tests/kernels/check.c"
BUNDLES = 10_000
SANITIZERS = ("-O0", "-g", "-std=gnu11", "-fPIC", "-fsanitize=address,undefined", "-fno-sanitize-recover=undefined")
QEMU_ROOT = Path("/usr/aarch64-linux-gnu")
WINE = Path("/usr/lib/x86_64-linux-gnu/wine/x86_64-windows")


@dataclass
class Bundle:
    """Job of the kernels: all its arrays are of one kind of number; rays are in the index space of their lattice."""

    volume: Array
    rays: IndexRays | IndexFans
    attenuation: Attenuation | None
    values: Array
    tame: Array  # rays that the reference can compute
    by_ends: bool  # whether derivatives by the ends are compared: at edges they are discontinuous
    tolerance: float


def lattice(rng: np.random.Generator, kind: type) -> Array:
    """Return voxels, often few, with zeros among them."""
    shape = rng.integers(1, rng.choice([2, 4, 12]), 3, endpoint=True)
    return (rng.random(shape) * (rng.random(shape) < 0.8)).astype(kind)


def points(rng: np.random.Generator, count: int, shape: tuple[int, ...]) -> Array:
    """Return ends of rays in and around a lattice."""
    return rng.uniform(-1.0, 2.0, (count, 3)) * shape


def hostile(rng: np.random.Generator, starts: Array, ends: Array, shape: tuple[int, ...], kind: str) -> Array:
    """Change some of the rays in place; return which."""
    changed = rng.random(len(starts)) < 0.5
    for i in np.flatnonzero(changed):
        a, b = rng.permutation(3)[:2]
        if kind == "awkward":  # through edges and corners, along faces and edges, of length zero
            which = rng.integers(5)
            corner = rng.integers(-1, np.array(shape) + 2).astype(float)
            if which == 0:
                starts[i], ends[i] = corner, rng.integers(-1, np.array(shape) + 2)
            elif which == 1:
                starts[i], ends[i] = corner - 20, corner + 20
            elif which == 4:
                ends[i] = starts[i]
            else:
                starts[i, a] = ends[i, a] = corner[a]
                if which == 3:
                    starts[i, b] = ends[i, b] = corner[b]
        elif kind == "far":
            starts[i] += rng.choice([-1e9, 1e9, 1e6])
            if rng.random() < 0.5:
                ends[i] += ends[i] - starts[i]
        else:
            (starts if rng.random() < 0.5 else ends)[i, a] = rng.choice(BAD)
            if rng.random() < 0.3:
                starts[i, b], ends[i, b] = rng.choice(BAD, 2)
    return changed


def bundles() -> Iterator[Bundle]:
    rng = np.random.default_rng(20)
    for i in range(BUNDLES):
        number = (np.float32, np.float64)[i % 2]
        volume = lattice(rng, number)
        attenuated = ("no", "same", "own")[i // 2 % 3]
        mu = None if attenuated == "no" else lattice(rng, number) if attenuated == "own" else np.empty_like(volume)
        if mu is not None:
            mu[:] = rng.random(mu.shape) * rng.choice([0.02, 0.3, 3])
        kind = rng.choice(["ordinary", "awkward", "far", "wild"])
        # Coordinates of 1e9 are rounded to 1e-7 voxels, in the reference as well.
        tolerance = 1e-9 if number == np.float64 and kind != "far" else 2e-5
        if rng.random() < 0.3:  # fans
            shape = tuple(rng.integers(1, 9, 2))
            vectors = rng.uniform(-1, 1, (rng.integers(1, 4), 4, 3)) * [[30], [6], [2], [2]]
            vectors[:, :2] += np.array(volume.shape) / 2
            table = np.concatenate([vectors, vectors * 1.5], axis=1)
            parallel = float(rng.choice([0.0, 0.0, 0.6, 1.0]))
            rays: IndexRays | IndexFans = IndexFans(table, shape, parallel)
            mu_rays: IndexRays | IndexFans | None = None
            if attenuated == "own":
                mu_table = table.copy()
                mu_table[:, :4] = table[:, :4] * 0.7
                mu_table[:, :2] += 0.3
                mu_rays = IndexFans(mu_table, shape, parallel)
            tame, by_ends = np.ones(len(rays), bool), True
        else:
            count = int(rng.integers(1, 40))
            starts, ends = points(rng, count, volume.shape), points(rng, count, volume.shape)
            changed = np.zeros(count, bool) if kind == "ordinary" else hostile(rng, starts, ends, volume.shape, kind)
            with np.errstate(all="ignore"):
                lengths = np.linalg.norm(ends - starts, axis=1) * 1.5
                rays = IndexRays(starts, ends - starts, lengths)
                # mu's lattice is slightly shifted and coarser.
                mu_rays = IndexRays(starts * 0.7 + 0.3, (ends - starts) * 0.7, lengths) if attenuated == "own" else None
            tame, by_ends = ~changed if kind == "wild" else np.ones(count, bool), kind == "ordinary"
        values = rng.random(len(rays)).astype(number)
        attenuation = None if mu is None else Attenuation(mu, mu_rays)
        yield Bundle(volume, rays, attenuation, values, tame, by_ends, tolerance)


def packed_rays(bundle: Bundle, level: int) -> bytes:
    """Return a bundle as check.c reads it."""
    rays, attenuation = bundle.rays, bundle.attenuation
    mu = bundle.volume if attenuation is None else attenuation.mu
    mu_rays = None if attenuation is None else attenuation.rays
    how = 0 if attenuation is None else 1 if mu_rays is None else 2
    fans = len(rays.table) if isinstance(rays, IndexFans) else 0
    header = (bundle.volume.itemsize == 8, how, *bundle.volume.shape, *mu.shape, fans, len(rays))
    arrays = [np.array(header, np.int64), bundle.volume]
    if attenuation is not None:
        arrays.append(mu)
    if isinstance(rays, IndexFans):
        arrays.append(_fans(rays, mu_rays))
    else:
        arrays += [column.T for r in (rays, mu_rays) if r is not None for column in (r.starts, r.directions)]
        arrays.append(rays.lengths)
    arrays.append(bundle.values)
    return packed("rays", level, *arrays)


def expected(bundle: Bundle) -> list[tuple[Array, float]]:
    """Return the reference's results for a bundle: arrays in check.c's order, each with the magnitude of its summands.

    NaN is not compared.
    """
    volume, rays, values = bundle.volume.astype(float), bundle.rays.listed(), bundle.values.astype(float)
    attenuation = bundle.attenuation
    some = _of(rays, bundle.tame)
    if attenuation is not None:
        mu_rays = None if attenuation.rays is None else _of(attenuation.rays.listed(), bundle.tame)
        attenuation = Attenuation(attenuation.mu.astype(float), mu_rays)
    integrals = np.full(len(rays), np.nan)
    integrals[bundle.tame] = reference.forward(volume, some, attenuation)
    back = np.full(volume.shape, np.nan)
    rows = np.full((7 if attenuation is None else 14, len(rays)), np.nan)
    gradient = np.full(() if attenuation is None else attenuation.mu.shape, np.nan)
    behind = 0.0  # derivatives by mu are differences of integrals beyond a voxel
    if bundle.tame.all():
        back[:] = 0.0
        reference.backproject(back, values, rays, attenuation)
        if bundle.by_ends:
            rows[:] = reference.derivatives(volume, rays, attenuation).T
        if attenuation is not None:
            gradient[:] = 0.0
            reference.mu_gradient(gradient, volume, values, rays, attenuation)
            behind = np.max(values * integrals * rays.lengths, initial=0.0)
    arrays = [integrals, back, rows] + ([] if attenuation is None else [gradient])
    return [(a, max(np.max(np.abs(a), where=~np.isnan(a), initial=0.0), behind * (a is gradient))) for a in arrays]


def _of(rays: IndexRays, which: Array) -> IndexRays:
    return IndexRays(rays.starts[which], rays.directions[which], rays.lengths[which])


def rays_jobs() -> Iterator[Made]:
    for i, bundle in enumerate(bundles()):
        arrays = expected(bundle)

        def check(read: Read, bundle: Bundle = bundle, arrays: list[tuple[Array, float]] = arrays) -> None:
            kind = bundle.volume.dtype
            for k, (right, size) in enumerate(
                arrays
            ):  # of derivatives by the ends, differences are summed: they round more
                of_ends = k == 2
                given = read(np.dtype(float) if of_ends else kind, right.shape)
                allowed = bundle.tolerance * size * (10 if of_ends else 1) + np.finfo(kind).tiny
                close(f"result {k}", given, right, allowed)

        yield Made(packed_rays(bundle, i // 6), check)


@pytest.fixture(scope="module")
def jobs() -> dict[str, list[Made]]:
    return {"rays": list(rays_jobs()), "places": list(places_jobs()), "photons": list(photon_jobs())}


def compare(jobs: dict[str, list[Made]], command: list[str | Path], folder: Path, **options: Any) -> None:
    """Run all `jobs` in `folder` and compare."""
    (folder / "jobs").write_bytes(b"".join(job.data for some in jobs.values() for job in some))
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=600, **options)
    assert done.returncode == 0, f"{done.returncode}\n{done.stderr[-6000:]}"
    results = (folder / "results").read_bytes()
    at = 0

    def read(kind: np.dtype[Any], shape: tuple[int, ...]) -> Array:
        nonlocal at
        given = np.frombuffer(results, kind, math.prod(shape), at).reshape(shape)
        at += given.nbytes
        return given

    for name, some in jobs.items():
        for i, job in enumerate(some):
            try:
                job.check(read)
            except AssertionError as error:
                raise AssertionError(f"{name}, job {i}: {error}") from None
    assert at == len(results)


def compile_driver(name: str, folder: Path, *links: str | Path, entry: str) -> None:
    """Compile check.c for a platform into `folder`, beside the library; it calls the platform's own C library."""
    cc = ("cc", "-target", build_kernels.PLATFORMS[name].target)
    library = build_kernels.build(name, folder)
    options = ("-O2", "-fno-sanitize=undefined", f"-DENTRY={entry}")
    build_kernels.zig(*cc, *options, "-c", DRIVER, "-o", "check.o", cwd=folder)
    build_kernels.zig(*cc, "-nostdlib", "check.o", library, *links, "-o", "check.exe", cwd=folder)


needs_gcc = pytest.mark.skipif(
    sys.platform != "linux" or not shutil.which("gcc"), reason="needs Debian's gcc, which links"
)


def link_with_gcc(flags: tuple[str, ...], objects: list[str], folder: Path) -> None:
    """Compile check.c and link it with `objects`, on Linux."""
    target = build_kernels.PLATFORMS["linux-x64"].target
    build_kernels.zig("cc", "-target", target, *flags, "-c", DRIVER, "-o", "check.o", cwd=folder)
    sanitizers = [flag for flag in flags if flag.startswith("-fsanitize")]
    command = ("gcc", *sanitizers, "check.o", *objects, "-lm", "-Wl,-rpath,$ORIGIN", "-o", "check.exe")
    subprocess.run(command, cwd=folder, check=True)


@needs_gcc
def test_sanitizers_find_nothing(jobs, tmp_path):
    link_with_gcc(SANITIZERS, build_kernels.compiled("linux-x64", tmp_path, SANITIZERS), tmp_path)
    compare(jobs, ["./check.exe"], tmp_path)


@needs_gcc
def test_library_stays_within_its_arrays(jobs, tmp_path):
    link_with_gcc(build_kernels.FLAGS, [build_kernels.build("linux-x64", tmp_path).name], tmp_path)
    compare(jobs, ["./check.exe"], tmp_path)


def test_arm64_under_qemu(jobs, tmp_path):
    if not shutil.which("qemu-aarch64") or not QEMU_ROOT.is_dir():
        pytest.skip("needs Debian's qemu-user and libc6-arm64-cross")
    compile_driver("linux-arm64", tmp_path, QEMU_ROOT / "lib/libc.so.6", "-Wl,-rpath,$ORIGIN", entry="_start")
    compare(jobs, ["qemu-aarch64", "-L", QEMU_ROOT, "./check.exe"], tmp_path)


def test_windows_under_wine(jobs, tmp_path):
    if not shutil.which("wine") or not WINE.is_dir():
        pytest.skip("needs Debian's wine and wine64")
    compile_driver("windows-x64", tmp_path, WINE / "ucrtbase.dll", entry="wWinMainCRTStartup")
    home = {"WINEPREFIX": str(tmp_path / "wine"), "WINEDEBUG": "-all", "PATH": "/usr/bin:/bin", "HOME": str(tmp_path)}
    compare(jobs, ["wine", "check.exe"], tmp_path, env=home)
