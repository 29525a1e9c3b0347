"""A CT by X-ray tubes beside the pinholes: what attenuates in SPECT."""

from collections.abc import Mapping
from typing import Any

import bpy

from .blender import jobs
from .runs import projection_properties, runs
from .scanner import scanner
from .volumes import volume_import, volumes


def shown_reconstruction(scene: bpy.types.Scene) -> Mapping[str, Any]:
    """What is known of the reconstruction of the shown run; empty where there is none."""
    settings, run = scene.mphdrr_reconstruction, runs.shown_run(scene)
    if run is None or settings.volume not in volumes.volume_objects(scene):
        return {}
    known: Mapping[str, Any] = settings.details
    return known if run.file.endswith(known.get("run", "")) else {}


def chain(scene: bpy.types.Scene) -> tuple[bpy.types.Collection, bpy.types.Object] | None:
    """The pinholes and the activity that SPECT would be of, where a CT has been reconstructed; else None."""
    if runs.run_settings(scene).get("model.kind") != "spectral" or not shown_reconstruction(scene):
        return None
    body = runs.projected_volume(scene)
    pinholes = list(filter(scanner.sees_activity, scanner.scanners(scene)))
    found = [each for each in volumes.volume_objects(scene) if volumes.quantity_of(each) == "activity"]
    found.sort(key=lambda each: body is None or each != body.parent)
    return (pinholes[0], found[0]) if pinholes and found else None


def using_ct(context: bpy.types.Context) -> jobs.Job:
    """The job that makes CT numbers of the reconstructed CT, and has the panels ask for SPECT with it.

    The body that the X rays saw attenuates its photons; the CT is what the reconstruction knows of it.
    """
    uid = context.scene.session_uid
    job = volume_import.ct_numbers_job(context.scene.mphdrr_reconstruction.volume)
    add = job.finish

    def finish(result: Any) -> str:
        scene = jobs.require_scene(uid, "the CT is")
        found, body = chain(scene), runs.projected_volume(scene)
        text = str(add(result))
        if found is not None:
            settings, reconstruction = scene.mphdrr_projections, scene.mphdrr_reconstruction
            reconstruction.mu = bpy.context.object
            scene.mphdrr_geometry.scanner, settings.volume = found
            settings.mu, settings.model = body, "EMISSION"
            settings.isotope = "Tc-99m" if settings.isotope == "NONE" else settings.isotope
            projection_properties.set_time(settings)
            for name in ("colors", "scale"):  # those of radiographs
                scene.mphdrr_display.property_unset(name)
        return text

    job.finish = finish
    return job
