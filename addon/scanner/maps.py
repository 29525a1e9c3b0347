"""Maps of what the scanner does in every voxel, as volumes in the scene."""

import json
from typing import Any

import bpy

from ...core import Grid, Progress, memory
from ...core.physics.maps import MAPS, within_roi
from ..blender import choices, jobs, storage
from ..volumes import slices, volume_materials, volumes
from ..volumes.stored_volumes import StoredVolume, store_volume
from . import scanner

_DESCRIPTIONS = {
    "sensitivity": "Of all modules together, cps/MBq",
    "modules": "Number of modules that see a voxel",
    "resolution": "FWHM in mm that the projections hold, all modules together",
    "completeness": "Of the angular sampling (Tuy): 1 where every plane through the voxel meets a pinhole. Slow",
}
QUANTITIES = choices.items(choices.MAPS, ((name, name.capitalize(), _DESCRIPTIONS.get(name, "")) for name in MAPS))
_BYTES = 40.0  # a voxel, while the map is made and put into the scene


def mapping(
    scene: bpy.types.Scene,
    quantity: str,
    voxels: int = 64,
    side: float = 0.0,
    only_roi: bool = True,
    collection: bpy.types.Collection | None = None,
) -> jobs.Job:
    """The job that adds a map of a scanner, with ideal modules and slices, or replaces its last of that quantity.

    The map is a cube of `voxels` along each `side` (mm; 0: the ROI's diameter) around the isocentre, of one of `MAPS`;
    with `only_roi`, without what lies outside the ROI sphere. The scanner is by default that of the panels.
    """
    collection = collection or scanner.required_scanner(scene)
    system = scanner.read_pinholes(collection)
    grid = Grid.centered((voxels,) * 3, (side or 2 * float(system.roi_radius.max())) / voxels)
    memory.require(_BYTES * grid.n_voxels, f"a map of {voxels}^3 voxels")
    name, folder, owner = _name(quantity), storage.folder(), collection.name
    recipe = json.dumps({"voxels": voxels, "side": side, "only_roi": only_roi})
    provenance: dict[str, Any] = {"map": quantity, "modules": len(system), "scanner": collection.name}

    def work(progress: Progress) -> StoredVolume:
        volume = MAPS[quantity](system, grid, progress=progress)
        return store_volume(within_roi(volume, system) if only_roi else volume, folder, provenance=provenance)

    def finish(stored: StoredVolume) -> str:
        collection = bpy.data.collections.get(owner)  # it may have been removed since
        known = (old for old in volumes.volume_objects(scene) if volumes.quantity_of(old) == quantity)
        item = next((old for old in known if _is_of(old, collection)), None)
        if item is not None:
            volumes.replace_stored(item, stored)
        else:
            item = volumes.add_stored(stored, name, scene.collection)
            volume_materials.show_in_eevee(scene)
        item.mphdrr_volume.recipe, item.mphdrr_volume.scanner = recipe, collection
        unit, factor = volume_materials.display_unit(quantity)
        values, high = stored.volume.array, stored.high
        low, high = factor * float(values[values > 0].min(initial=high)), factor * high
        item.mphdrr_volume.display_low, item.mphdrr_volume.display_high = low if low < high else 0.0, high
        if not slices.planes_of(item):  # the solid viewport draws a volume in one colour, its slices in all
            slices.add_slices(item)
        return f"{name}: {low:.4g} to {high:.4g} {unit}".removesuffix(" 1")

    return jobs.Job(f"{name} of {len(system)} modules", work, finish)


def _is_of(item: bpy.types.Object, collection: bpy.types.Collection | None) -> bool:
    """Whether a volume is a map of a scanner; those of earlier versions do not say of which, nor that they are maps."""
    settings = item.mphdrr_volume
    return settings.scanner == collection or (
        settings.scanner is None and item.name.startswith(_name(settings.quantity))
    )


def _name(quantity: str) -> str:
    return f"{quantity.capitalize()} map"


def can_be_made_again(scene: bpy.types.Scene, item: bpy.types.Object) -> bool:
    """Whether a volume is a map that knows how it was made, of a scanner in the scene."""
    return bool(item.mphdrr_volume.recipe) and item.mphdrr_volume.scanner in scanner.scanners(scene)


def again(scene: bpy.types.Scene, item: bpy.types.Object) -> jobs.Job:
    """The job that makes a map again, of its scanner as it is now."""
    settings = item.mphdrr_volume
    return mapping(scene, settings.quantity, **json.loads(settings.recipe), collection=settings.scanner)
