"""CT by X-ray tubes beside the pinholes, as the attenuation of SPECT."""

from collections.abc import Mapping
from typing import Any

import bpy

from .blender import jobs
from .runs import projection_properties, runs
from .scanner import scanner
from .volumes import volume_import, volumes


def reconstruction_details(scene: bpy.types.Scene) -> Mapping[str, Any]:
    """Return the details of the shown run's reconstruction; empty where there is none."""
    settings, run = scene.mphdrr_reconstruction, runs.shown_run(scene)
    if run is None or settings.volume not in volumes.volume_objects(scene):
        return {}
    details: Mapping[str, Any] = settings.details
    return details if run.file.endswith(details.get("run", "")) else {}


def spect_inputs(scene: bpy.types.Scene) -> tuple[bpy.types.Collection, bpy.types.Object] | None:
    """Return the scanner with pinholes and the activity for SPECT, where a CT has been reconstructed; else None."""
    if runs.run_settings(scene).get("model.kind") != "spectral" or not reconstruction_details(scene):
        return None
    body = runs.projected_volume(scene)
    pinholes = list(filter(scanner.sees_activity, scanner.scanners(scene)))
    activities = [item for item in volumes.volume_objects(scene) if volumes.quantity_of(item) == "activity"]
    activities.sort(key=lambda item: body is None or item != body.parent)
    return (pinholes[0], activities[0]) if pinholes and activities else None


def use_ct_job(context: bpy.types.Context) -> jobs.Job:
    """Return the job that makes CT numbers of the reconstructed CT, and sets the panels for SPECT with it.

    The projected body attenuates the photons of SPECT; the CT is the attenuation that the reconstruction uses.
    """
    uid = context.scene.session_uid
    job = volume_import.ct_numbers_job(context.scene.mphdrr_reconstruction.volume)
    add = job.finish

    def finish(result: Any) -> str:
        """Add the CT, make it the attenuation of the SPECT that comes next, and return the line to report."""
        scene = jobs.require_scene(uid, "the CT is")
        inputs, body = spect_inputs(scene), runs.projected_volume(scene)
        text = str(add(result))
        if inputs is not None:
            settings, reconstruction = scene.mphdrr_projections, scene.mphdrr_reconstruction
            reconstruction.mu = bpy.context.object
            scene.mphdrr_geometry.scanner, settings.volume = inputs
            settings.mu, settings.model = body, "EMISSION"
            settings.isotope = "Tc-99m" if settings.isotope == "NONE" else settings.isotope
            projection_properties.set_time(settings)
            for name in ("colors", "scale"):  # drops those of radiographs
                scene.mphdrr_display.property_unset(name)
        return text

    job.finish = finish
    return job
