"""Progress of a scene from a scanner to training data, and the one step that comes next."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import bpy

from ..core.physics.maps import MAPS
from . import spect_ct
from .events import event_notes
from .preferences import website
from .runs import runs
from .scanner import scanner
from .volumes import volumes

_TOP = Path(__file__).parents[1]


@dataclass(frozen=True)
class WorkStage:
    """Stage of the work, with a note on what the scene holds for it, "" if it holds nothing."""

    name: str
    note: str = ""
    is_stale: bool = False  # the scene has changed since


@dataclass(frozen=True)
class Step:
    """Next step: an operator, its settings, and the words of its button."""

    operator: str
    text: str
    icon: str
    settings: Mapping[str, Any] = field(default_factory=dict)
    item: bpy.types.Object | None = None  # object that the operator takes as the active one


_RENDER = Step("mphdrr.render_projections", "Render Projections", "RENDER_STILL")


def work_stages(context: bpy.types.Context) -> list[WorkStage]:
    """Return the stages of the work from scanner to event set, in their order."""
    scene, run = context.scene, _shown_run(context.scene)
    collection, names = scanner.active_scanner(scene), [item.name for item in _projectable_volumes(scene)]
    changes, reconstruction = (_scene_changes(scene), spect_ct.reconstruction_details(scene)) if run else ([], {})
    scores = reconstruction.get("scores", ())
    note = event_notes.set_note(scene.mphdrr_events.folder)
    return [
        WorkStage("Scanner", collection.name if collection else ""),
        WorkStage("Phantom", names[0] if len(names) == 1 else f"{len(names)} volumes" if names else ""),
        WorkStage("Run", changes[0] if changes else run.summary.partition(",")[0] if run else "", bool(changes)),
        WorkStage("Reconstruction", ": ".join(scores[0]) if scores else "not scored" if reconstruction else ""),
        WorkStage("Event Set", note.text.partition(",")[0] if note else ""),
    ]


def next_step(context: bpy.types.Context) -> Step:
    """Return the step that comes next: the first stage of the work that the scene has not done, or has to do again."""
    scene, run = context.scene, _shown_run(context.scene)
    if run is None and scanner.active_scanner(scene) is None:
        return Step("mphdrr.load_example", "Load Example", "PLAY")
    if run is None or _scene_changes(scene):
        if not _projectable_volumes(scene):
            return Step("mphdrr.add_derenzo", "Add Phantom", "OUTLINER_DATA_VOLUME", {"confirmed": True})
        return _RENDER if run is None else Step(_RENDER.operator, "Render Again", "FILE_REFRESH")
    if not spect_ct.reconstruction_details(scene):
        return Step("mphdrr.reconstruct", "Reconstruct", "OUTLINER_OB_VOLUME")
    if spect_ct.spect_inputs(scene):
        return Step("mphdrr.use_ct", "Use CT for SPECT", "MOD_FLUIDSIM")
    if _is_without_dose(scene):
        settings = {"isotope": runs.run_settings(scene)["model.isotope"]}
        reconstruction = scene.mphdrr_reconstruction.volume
        return Step("mphdrr.add_dose_map", "Dose Map", "OUTLINER_DATA_VOLUME", settings, reconstruction)
    if scene.mphdrr_events.recipe:
        return Step("mphdrr.make_event_set", "Make Event Set", "FILE_CACHE")
    return Step("mphdrr.export_dataset", "Export Dataset", "EXPORT")


@cache
def tutorial() -> str:
    """Return the address of the tutorial: on the website, in the source, or of the README in the zip."""
    if website():
        return f"{website().rstrip('/')}/tutorial.html"
    page = _TOP / "docs" / "tutorial.md"
    return (page if page.is_file() else _TOP / "README.md").as_uri()


def _projectable_volumes(scene: bpy.types.Scene) -> list[bpy.types.Object]:
    """Return the volumes of the scene that may be projected: all but the reconstruction and the scanner's maps (`MAPS`)."""
    excluded, objects = scene.mphdrr_reconstruction.volume, volumes.volume_objects(scene)
    return [item for item in objects if item != excluded and volumes.quantity_of(item) not in MAPS]


def _shown_run(scene: bpy.types.Scene) -> bpy.types.PropertyGroup | None:
    """Return the shown run, unless it is of another scanner than the panels work on."""
    run = runs.shown_run(scene)
    is_other = run is not None and run.scanner not in (None, scanner.active_scanner(scene))
    return None if is_other else run


def _is_without_dose(scene: bpy.types.Scene) -> bool:
    """Return whether a dose map is due: SPECT of an isotope beside X-ray tubes, and no dose map yet."""
    has_tubes = not all(map(scanner.sees_activity, scanner.scanners(scene)))
    has_dose = any(volumes.quantity_of(item) == "dose_rate" for item in volumes.volume_objects(scene))
    return has_tubes and not has_dose and runs.run_settings(scene).get("model.isotope") is not None


def _scene_changes(scene: bpy.types.Scene) -> list[str]:
    """Return the changes since the shown run that a new render would pick up; empty for measured runs."""
    lines = runs.change_lines(scene)
    return [] if lines == [runs.UNKNOWN] or runs.measured_text(scene) else lines
