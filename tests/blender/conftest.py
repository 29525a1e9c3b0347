"""Every test gets a fresh factory scene in which the extension is registered; without bpy they are skipped."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

bpy = pytest.importorskip("bpy", reason="needs Blender's Python module: pip install mphdrr[blender]")

from mphdrr.addon import registration  # noqa: E402
from mphdrr.addon.blender import jobs, plots, timers  # noqa: E402
from mphdrr.addon.events import event_notes  # noqa: E402
from mphdrr.addon.pictures import recoloring  # noqa: E402
from mphdrr.addon.runs import preview  # noqa: E402
from mphdrr.core.geometry.system import PinholeSystem  # noqa: E402
from mphdrr.core.workbook import read_system, write_system  # noqa: E402

WORKBOOK = Path(__file__).parents[2] / "examples" / "dc-spect-80.xlsx"


@pytest.fixture(scope="session")
def registered() -> Iterator[None]:
    """The extension in Blender with its own preferences and add-ons: to register it takes longer than a scene."""
    bpy.ops.wm.read_factory_settings()
    registration.register()
    yield
    registration.unregister()


@pytest.fixture(autouse=True)
def scene(registered: None) -> Iterator[bpy.types.Scene]:
    """A fresh factory scene; what was going on in the one before has ended, as when the extension is disabled."""
    bpy.ops.wm.read_homefile(use_factory_startup=True)
    shutil.rmtree(Path(bpy.app.tempdir, "mphdrr"), ignore_errors=True)
    yield bpy.context.scene
    for module in (jobs, preview, plots, recoloring, event_notes, timers):
        module.stop()


@pytest.fixture(scope="session")
def workbook() -> Path:
    return WORKBOOK


@pytest.fixture(scope="session")
def dc_spect() -> PinholeSystem:
    """The real scanner: 80 modules in 4 rings."""
    return read_system(WORKBOOK)


@pytest.fixture(scope="session")
def small_workbook(dc_spect, tmp_path_factory) -> Path:
    """The real scanner's first 16 modules in a workbook of the same layout."""
    path = tmp_path_factory.mktemp("workbook") / "small.xlsx"
    write_system(dc_spect[:16], path)
    return path


@pytest.fixture
def ring_system() -> PinholeSystem:
    """Two rings of four modules of different sizes: small, and nothing in it symmetric."""
    angle = np.radians([-80.0, -20.0, 35.0, 120.0])
    radius = np.array([180.0, 210.0, 195.0, 240.0])
    ring = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(4, -30.0)], axis=1)
    centers = np.concatenate([ring, ring * [1.0, 1.0, -1.3]])
    centers[:, 0] += 0.1234567890123
    return PinholeSystem(centers, 2.3, np.linspace(50.0, 71.0, 8) / 1.00000001, 48.0, 9.5, 60.0)
