"""How far a scene is on the way from a scanner to training data, and the one step that comes next."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import bpy

from ..core.physics.maps import MAPS
from ..core.xray.dose import decays
from . import spect_ct
from .events import event_notes
from .preferences import website
from .runs import runs
from .scanner import scanner
from .volumes import volumes

_TOP = Path(__file__).parents[1]


@dataclass(frozen=True)
class Stage:
    """A stage of the work, and what the scene has of it: "" for nothing."""

    name: str
    found: str = ""
    is_stale: bool = False  # not of the scene as it is now


@dataclass(frozen=True)
class Step:
    """What to do next: an operator, its settings, and what its button says."""

    operator: str
    text: str
    icon: str
    settings: Mapping[str, Any] = field(default_factory=dict)
    item: bpy.types.Object | None = None  # which it takes for the active one


_RENDER = Step("mphdrr.render_projections", "Render Projections", "RENDER_STILL")


def stages(context: bpy.types.Context) -> list[Stage]:
    """The stages in their order."""
    scene = context.scene
    collection, run, known = scanner.active_scanner(scene), _run(scene), _phantoms(scene)
    stale, found = (_stale(scene), spect_ct.shown_reconstruction(scene)) if run else ([], {})
    scores = found.get("scores", ())
    made = event_notes.set_note(scene.mphdrr_events.folder)
    return [
        Stage("Scanner", collection.name if collection else ""),
        Stage("Phantom", known[0].name if len(known) == 1 else f"{len(known)} volumes" if known else ""),
        Stage("Run", stale[0] if stale else run.summary.partition(",")[0] if run else "", bool(stale)),
        Stage("Reconstruction", ": ".join(scores[0]) if scores else "not scored" if found else ""),
        Stage("Event Set", made.text.partition(",")[0] if made else ""),
    ]


def next_step(context: bpy.types.Context) -> Step:
    """The step that comes next."""
    scene, run = context.scene, _run(context.scene)
    if run is None and scanner.active_scanner(scene) is None:
        return Step("mphdrr.load_example", "Load Example", "PLAY")
    if run is None or _stale(scene):
        if not _phantoms(scene):
            return Step("mphdrr.add_derenzo", "Add Phantom", "OUTLINER_DATA_VOLUME", {"confirmed": True})
        return _RENDER if run is None else Step(_RENDER.operator, "Render Again", "FILE_REFRESH")
    if not spect_ct.shown_reconstruction(scene):
        return Step("mphdrr.reconstruct", "Reconstruct", "OUTLINER_OB_VOLUME")
    if spect_ct.chain(scene):
        return Step("mphdrr.use_ct", "Use CT for SPECT", "MOD_FLUIDSIM")
    if _is_without_dose(scene):
        isotope = {"isotope": runs.run_settings(scene)["model.isotope"]}
        item = scene.mphdrr_reconstruction.volume
        return Step("mphdrr.add_dose_map", "Dose Map", "OUTLINER_DATA_VOLUME", isotope, item)
    if scene.mphdrr_events.recipe:
        return Step("mphdrr.make_event_set", "Make Event Set", "FILE_CACHE")
    return Step("mphdrr.export_dataset", "Export Dataset", "EXPORT")


@cache
def tutorial() -> str:
    """The address of the tutorial: on the website, or beside this file, or of the README that the zip has."""
    if website():
        return f"{website().rstrip('/')}/tutorial.html"
    page = _TOP / "docs" / "tutorial.md"
    return (page if page.is_file() else _TOP / "README.md").as_uri()


def _phantoms(scene: bpy.types.Scene) -> list[bpy.types.Object]:
    """The volumes that may be projected: no maps, and not what was reconstructed."""
    found = scene.mphdrr_reconstruction.volume
    return [item for item in volumes.volume_objects(scene) if item != found and volumes.quantity_of(item) not in MAPS]


def _run(scene: bpy.types.Scene) -> bpy.types.PropertyGroup | None:
    """The shown run, unless it is of another scanner than the panels work on."""
    run = runs.shown_run(scene)
    is_other = run is not None and run.scanner not in (None, scanner.active_scanner(scene))
    return None if is_other else run


def _is_without_dose(scene: bpy.types.Scene) -> bool:
    """Whether SPECT beside X-ray tubes has been reconstructed, of an isotope whose dose is known, and no dose made yet."""
    has_tubes = not all(map(scanner.sees_activity, scanner.scanners(scene)))
    has_dose = any(volumes.quantity_of(each) == "dose_rate" for each in volumes.volume_objects(scene))
    return has_tubes and not has_dose and runs.run_settings(scene).get("model.isotope") in decays()


def _stale(scene: bpy.types.Scene) -> list[str]:
    """What has changed since the shown run, if it can be rendered again."""
    lines = runs.change_lines(scene)
    return [] if lines == [runs.UNKNOWN] or runs.measured_text(scene) else lines
