"""Helpers for the tests without Blender."""

from __future__ import annotations

import functools
import importlib.util
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mphdrr.core import events
from mphdrr.core.cli import main
from mphdrr.core.errors import Cancelled, InputError
from mphdrr.core.geometry.frames import euler_pose
from mphdrr.core.geometry.grid import Grid
from mphdrr.core.geometry.system import PinholeSystem
from mphdrr.core.projector import Emission
from mphdrr.core.recording import recorded_warnings
from mphdrr.core.volumes.volume import Volume
from mphdrr.core.workbook import read_system

from .small_events import small_recipe

WORKBOOK = Path(__file__).parents[2] / "examples" / "dc-spect-80.xlsx"
FEWER_MODULES = Path(__file__).parent / "data" / "first-24-modules.xlsx"

needs_torch = pytest.mark.skipif(importlib.util.find_spec("torch") is None, reason="torch is not installed")
BACKENDS = ["numpy", pytest.param("torch", marks=needs_torch), "cpu"]
"""Parameters of what holds of every backend on the processor."""


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20261121)


@pytest.fixture
def command(capsys: pytest.CaptureFixture[str]) -> Callable[..., Any]:
    """Return a function that runs `mphdrr` with words, checks its status, and returns what it printed: `out`, `err`."""

    def run(*words: object, status: int = 0) -> Any:
        capsys.readouterr()
        result = main([*map(str, words)])
        printed = capsys.readouterr()
        assert result == status, printed.err
        return printed

    return run


@pytest.fixture(scope="session")
def workbook() -> Path:
    return WORKBOOK


@pytest.fixture(scope="session")
def small_workbook() -> Path:
    """Return the workbook of the scanner's first 24 modules, where any will do: it is read in a third of the time."""
    return FEWER_MODULES


@functools.cache
def dc_spect() -> PinholeSystem:
    """Return the users' scanner of 80 modules, read once."""
    return read_system(WORKBOOK)


@pytest.fixture(scope="session")
def scanner() -> PinholeSystem:
    """Return the users' scanner of 80 modules."""
    return dc_spect()


@pytest.fixture
def system(rng: np.random.Generator) -> PinholeSystem:
    """Return twelve modules in two rings, all numbers different, tilted by up to 3 degrees."""
    angles = np.linspace(0.1, 5.5, 6)
    ring = np.stack([220 * np.cos(angles), 180 * np.sin(angles), np.full(6, 30.0)], axis=1)
    centers = np.concatenate([ring * [1, 1, -1], ring]) + rng.uniform(-2, 2, (12, 3))
    return PinholeSystem(
        centers=centers,
        pinhole_diameter=rng.uniform(1, 3, 12),
        collimator_length=rng.uniform(50, 90, 12),
        detector_side=rng.uniform(40, 60, 12),
        detector_thickness=rng.uniform(5, 12, 12),
        roi_radius=75.0,
        numbers=np.arange(101, 113),
        tilt=np.random.default_rng(3).uniform(-0.03, 0.03, (12, 3)),
    )


def general_grid(rng: np.random.Generator, shape: tuple[int, int, int]) -> Grid:
    """Return a grid whose affine is rotated, sheared, anisotropic and mirrored, around the isocentre."""
    affine = euler_pose(*rng.uniform(-3, 3, 3))
    affine[:3, :3] @= np.array([[1.3, 0.2, 0.0], [0.0, -0.8, 0.1], [0.0, 0.0, 2.1]])
    affine[:3, 3] -= affine[:3, :3] @ (np.array(shape) - 1) / 2
    return Grid(shape, affine)


def voxel_centers(grid: Grid) -> np.ndarray:
    """Return the world places (n_x, n_y, n_z, 3) of a grid's voxels."""
    return np.moveaxis(np.indices(grid.shape), 0, -1) @ grid.affine[:3, :3].T + grid.affine[:3, 3]


def emission(system: PinholeSystem, mu: Volume | None = None, **options: Any) -> Emission:
    """Return an emission of one ray to each pixel's centre, for laws of single rays, without the warning of too few.

    Through the middle of the hole, if nothing is said of the hole.
    """
    said = {"hole", "aperture_points", "aperture_tolerance"} & set(options)
    return Emission(
        system, mu, **({"pixel_points": 1, "tolerance": 1e9, "hole": "rays" if said else "point"} | options)
    )


def same_matter(grid: Grid, mu: np.ndarray) -> list[Volume]:
    """Return the same mu on `grid`, on a twice finer one and on a larger one."""
    fine, moved = np.diag([0.5, 0.5, 0.5, 1.0]), np.eye(4)
    fine[:3, 3], moved[:3, 3] = -0.25, (-1, -2, -3)
    padding = np.array(((1, 1), (2, 0), (3, 4)))
    twice = Grid(tuple(2 * n for n in grid.shape), grid.affine @ fine)
    larger = Grid(tuple(grid.shape + padding.sum(axis=1)), grid.affine @ moved)
    return [
        Volume(mu, grid, "mu"),
        Volume(mu.repeat(2, 0).repeat(2, 1).repeat(2, 2), twice, "mu"),
        Volume(np.pad(mu, padding), larger, "mu"),
    ]


def refused(call: Callable[[], object], *words: str) -> None:
    """Check that `call` is refused in one line that has these words, or what matches them as regular expressions."""
    with pytest.raises(InputError) as error:
        call()
    text = str(error.value)
    assert all(word in text or re.search(word, text) for word in words) and "\n" not in text, text


def warned(call: Callable[[], object]) -> list[str]:
    """Return the warnings of `call`, each one a line."""
    with recorded_warnings() as texts:
        call()
    assert not any("\n" in text for text in texts)
    return texts


def stop(*_: object) -> None:
    """Cancel whatever reports its progress."""
    raise Cancelled


def assert_progress(call: Callable[[Callable[..., None]], object], steps: int = 2) -> None:
    """Check that `call(progress)` goes on to its end in `steps` or more, and ends where its progress is cancelled."""
    shares: list[float] = []
    call(lambda done, total: shares.append(done / total))
    assert shares == sorted(shares) and shares[-1] == 1 and len(shares) >= steps
    with pytest.raises(Cancelled):
        call(stop)


def refused_command(capsys: pytest.CaptureFixture[str], *words: object) -> str:
    """Run a command that is refused in one line, and return the line."""
    assert main([*map(str, words)]) == 1
    (line,) = [line for line in capsys.readouterr().err.splitlines() if not line.startswith("mphdrr: warning")]
    return line.removeprefix("mphdrr: ")


def run_python(
    code: str, environment: dict[str, str] | None = None, **options: Any
) -> subprocess.CompletedProcess[str]:
    """Run `code` in a Python of its own, and return what it printed."""
    together = os.environ | (environment or {})
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=together, **options)


EVENT_RECIPE = f"""
version = 1
seed = 3
[system]
file = '{FEWER_MODULES}'
modules = "1-4,21-24"
[detector]
rows = 12
columns = 12
[truth]
voxels = [10, 9, 8]
spacing = 14
[[phantoms]]
kind = "derenzo"
radius = 40
rod_diameters = [14, 12, 10, 9, 8, 7]
height = 60
activity = {{ from = 50, to = 90 }}
[phantoms.pose]
position = [{{ from = -9, to = 9 }}, 0, {{ from = -5, to = 5 }}]
turn = "uniform"
[models.counts]
kind = "emission"
time = 600
[models.rays]
kind = "transmission"
[radon]
angles = [16, 6]
rows = 12
columns = 12
pitch = 12
[splits]
train = 0.6
test = 0.4
"""
"""Of 8 modules in two rings: rows of 4 and their 4 mirror images are 16 slots."""


@pytest.fixture(scope="session")
def event_set(tmp_path_factory: pytest.TempPathFactory) -> events.EventSet:
    """Make five tiny events of 8 modules."""
    folder = tmp_path_factory.mktemp("events")
    return events.make(small_recipe(folder, EVENT_RECIPE), folder / "set", 5)


@pytest.fixture(scope="session")
def small_set(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of eight small events, to copy."""
    folder = tmp_path_factory.mktemp("small-events")
    events.make(small_recipe(folder), folder / "set", 8)
    return folder / "set"


def distance_to_line(points: np.ndarray, line: np.ndarray) -> np.ndarray:
    """Return the distances (…) of points (…, 3) to a line, a Plücker matrix (4, 4), that is not at infinity."""
    direction = line[:3, 3]
    moment = np.array([line[1, 2], line[2, 0], line[0, 1]])  # a x b
    # a x b = x x (b - a) for all points x of the line, and the matrix holds a - b.
    return np.linalg.norm(moment + np.cross(points, direction), axis=-1) / np.linalg.norm(direction)
