"""A run of the example in water with scatter in the window: settings, the photons shown apart, and the reconstruction's."""

import bpy
import numpy as np
from driving import drawn, editor, idle, open_tab, opened, ours, press, run, seen
from pointing import picture

images, runs = ours("addon.pictures.images"), ours("addon.runs.runs")


def water() -> bpy.types.Object:
    """Add a box of water around the isocentre."""
    core, volumes = ours("core"), ours("addon.volumes.volumes")
    grid = core.Grid.centered(20, 10.0)
    return volumes.add_volume(core.Volume(np.full(grid.shape, 0.0153, np.float32), grid, "mu"), "Water")


def shown_sum() -> float:
    """Return the sum of the projection of module 30 that the scene holds."""
    return float(images.projection_array(bpy.data.images["mphDRR 30"]).sum())


def steps():
    """Yield seconds to wait."""
    press(bpy.ops.mphdrr.load_example, "EXEC_DEFAULT")
    yield from idle()
    settings = bpy.context.scene.mphdrr_projections
    settings.volume = runs.projected_volume(bpy.context.scene)
    settings.model, settings.time = "EMISSION", 600.0
    settings.mu, settings.isotope, settings.energy_fwhm = water(), "Tc-99m", 0.1
    settings.mu.hide_set(True)  # it would hide the phantom
    settings.scatter, settings.scatter_precision = "BODY", 0.02
    settings.width = settings.height = 48
    editor()[1].spaces.active.show_region_ui = True
    yield from drawn()
    press(bpy.ops.mphdrr.render_projections)
    yield from idle()
    opened("MPHDRR_PT_runs", "MPHDRR_PT_projections")
    open_tab()
    yield from drawn()
    for part in ("ALL", "PRIMARY", "SCATTER"):
        press(bpy.ops.mphdrr.show_run, index=settings.active_run, photons=part)
        yield from idle()
        yield from drawn()
        picture(part.lower())
        seen[part] = shown_sum()
    seen["shown"] = [name for name, _, is_shown in runs.parts_to_show(bpy.context.scene) if is_shown]
    window, area, _ = editor()
    region = next(each for each in area.regions if each.type == "WINDOW")
    with bpy.context.temp_override(window=window, area=area, region=region):
        bpy.ops.wm.call_panel(name="MPHDRR_PT_physics", keep_open=True)
    yield from drawn()
    picture("physics")


run(steps())
