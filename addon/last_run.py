"""The last projection run of a scene: its images in the .blend, its exact arrays in a file beside it."""

from __future__ import annotations

from pathlib import Path

import bpy

from ..core.runs.run import ProjectionRun
from . import ids, images, storage


def show_run(scene: bpy.types.Scene, run: ProjectionRun, path: Path) -> None:
    """Make images of `run`, which is kept in the file `path`, and make it the scene's last run."""
    images.store_projections(run.projections, run.system.numbers)
    record_run(scene, run, path)


def record_run(scene: bpy.types.Scene, run: ProjectionRun, path: Path) -> None:
    """Make `run`, which is kept in the file `path`, the scene's last one: what the panels show and exports write."""
    state = getattr(scene, ids.SCENE_PROJECTIONS)
    state.run_file = storage.stored_path(path.absolute())
    n_v, n_u = run.views.shape
    what = [run.settings.get("volume"), run.settings.get("backend")]
    state.run_summary = ", ".join([f"{len(run.views)} views of {n_u} × {n_v}", *(text for text in what if text)])
