"""Maps of the scanner's sensitivity, resolution and coverage in every voxel, as volumes in the scene."""

import json
from typing import Any

import bpy

from ...core import Grid, Progress, memory
from ...core.physics.maps import MAPS, within_roi
from ..blender import choices, ids, jobs, storage
from ..volumes import slices, volume_materials, volumes
from ..volumes.stored_volumes import StoredVolume, store_volume
from . import scanner

_DESCRIPTIONS = {
    "sensitivity": "Sensitivity of all modules together, cps/MBq",
    "modules": "Number of modules that see a voxel",
    "resolution": "FWHM in mm of the projections of all modules together",
    "completeness": "Angular completeness (Tuy): 1 where every plane through the voxel meets a pinhole. Slow",
}
QUANTITIES = choices.items(choices.MAPS, ((name, name.capitalize(), _DESCRIPTIONS.get(name, "")) for name in MAPS))
_BYTES_PER_VOXEL = 40.0  # memory needed while the map is made and put into the scene


def map_job(
    scene: bpy.types.Scene,
    quantity: str,
    voxels: int = 64,
    side: float = 0.0,
    only_roi: bool = True,
    collection: bpy.types.Collection | None = None,
) -> jobs.Job:
    """Return the job that adds a map of a scanner with slices, or replaces its last map of that quantity.

    The map is a cube of `voxels` along each `side` (mm; 0: the ROI's diameter) around the isocentre, of one of `MAPS`, for
    ideal modules; with `only_roi`, voxels outside the ROI sphere are 0. The scanner is by default that of the panels.
    """
    collection = collection or scanner.required_scanner(scene)
    system = scanner.read_pinholes(collection)
    grid = Grid.centered((voxels,) * 3, (side or 2 * float(system.roi_radius.max())) / voxels)
    memory.require(_BYTES_PER_VOXEL * grid.n_voxels, f"a map of {voxels}^3 voxels")
    name, folder, owner = _map_name(quantity), storage.folder(), collection.name
    recipe = json.dumps({"voxels": voxels, "side": side, "only_roi": only_roi})
    provenance: dict[str, Any] = {"map": quantity, "modules": len(system), "scanner": collection.name}

    def work(progress: Progress) -> StoredVolume:
        """Compute the map, and store it as a volume."""
        volume = MAPS[quantity](system, grid, progress=progress)
        return store_volume(within_roi(volume, system) if only_roi else volume, folder, provenance=provenance)

    def finish(stored: StoredVolume) -> str:
        """Add the map to the scene, or replace the scanner's map of this quantity, and return the line to report."""
        collection = bpy.data.collections.get(owner)  # None if it has been removed since
        maps = (map_ for map_ in volumes.volume_objects(scene) if volumes.quantity_of(map_) == quantity)
        if (item := next((map_ for map_ in maps if _belongs_to(map_, collection)), None)) is not None:
            volumes.replace_stored(item, stored)
        else:
            item = volumes.add_stored(stored, name, scene.collection)
            volume_materials.show_in_eevee(scene)
        item.mphdrr_volume.recipe, item.mphdrr_volume.scanner = recipe, collection
        unit, factor = volume_materials.display_unit(quantity)
        values, high = stored.volume.array, stored.high
        low, high = factor * float(values[values > 0].min(initial=high)), factor * high
        item.mphdrr_volume.display_low, item.mphdrr_volume.display_high = low if low < high else 0.0, high
        if not slices.planes_of(item):  # the solid viewport draws a volume in one colour, but its slices in the ramp's
            slices.add_slices(item)
        return f"{name}: {volumes.range_text(low, high, unit)}"

    return jobs.Job(f"{name} of {ids.counted(len(system), 'module')}", work, finish)


mapping = map_job  # the name in version 0.2.0, for scripts


def _belongs_to(item: bpy.types.Object, collection: bpy.types.Collection | None) -> bool:
    """Return whether a volume is a map of a scanner; maps of earlier versions, which name no scanner, belong to any."""
    settings = item.mphdrr_volume
    is_of_any = settings.scanner is None and item.name.startswith(_map_name(settings.quantity))
    return settings.scanner == collection or is_of_any


def _map_name(quantity: str) -> str:
    """Return the name of a map's object."""
    return f"{quantity.capitalize()} map"


def can_be_made_again(scene: bpy.types.Scene, item: bpy.types.Object) -> bool:
    """Return whether a volume is a map with its settings, of a scanner in the scene."""
    return bool(item.mphdrr_volume.recipe) and item.mphdrr_volume.scanner in scanner.scanners(scene)


def remake_map_job(scene: bpy.types.Scene, item: bpy.types.Object) -> jobs.Job:
    """Return the job that makes a map again, of its scanner as it is now."""
    settings = item.mphdrr_volume
    return map_job(scene, settings.quantity, **json.loads(settings.recipe), collection=settings.scanner)
