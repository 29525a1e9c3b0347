"""Jobs that add volumes to the scene: from files, the attenuation of CTs, and the dose of activity."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import bpy

from ...core import Volume, absorbed_dose_rate, centered, hu_to_mu, memory, mu_to_hu
from ...core.progress import Progress, part_of
from ...core.volumes.volume_files import READ_FORMATS, read_volume
from ..blender import jobs, storage
from . import stored_volumes, vdb, volumes

READ_ENDINGS = (*READ_FORMATS, ".vdb")
"""Endings of the names of files that can be read as volumes."""


def import_job(
    paths: Sequence[Path],
    name: str = "",
    *,
    quantity: str | None = None,
    center: bool = True,
    energy: float | None = None,
    grid: str | None = None,
    unit: float = 1.0,
    frame_start: int = 1,
) -> jobs.Job:
    """Return the job that reads a file (or the folder of a DICOM series) as a volume, or several as the states of one.

    Parameters
    ----------
    paths, name, frame_start
        The files, the object's name (by default the first file's), and the frame of the first state.
    quantity
        Quantity of the voxels, one of `UNITS`. Default: the file's; else activity in OpenVDB, CT numbers elsewhere.
    center
        Move the (first) volume's middle to the isocentre; states move together.
    energy
        Convert CT numbers to attenuation of photons of this energy, keV.
    grid, unit
        Arguments for OpenVDB files, see `vdb.read_vdb`.
    """
    count = len(paths)
    names = [path.name for path in paths]
    provenance: dict[str, Any] = {"file": names[0]} if count == 1 else {"files": names}

    def make(progress: Progress) -> list[Volume]:
        """Return the volumes of the files, in mu for a photon energy, and centred if asked for."""
        states: list[Volume] = []
        for k, path in enumerate(paths):
            progress(k, count)
            if path.suffix.lower() == ".vdb":
                states.append(vdb.read_vdb(path, quantity, grid, unit=unit))
            else:
                states.append(read_volume(path, quantity, progress=part_of(progress, k, count)))
            if k == 0 and count > 1:
                shape = " x ".join(map(str, states[0].grid.shape))
                memory.require(4.0 * (count - 1) * states[0].grid.n_voxels, f"{count} volumes of {shape} voxels")
        provenance["read_as"] = states[0].quantity
        if energy is not None:
            states = [hu_to_mu(volume, energy) for volume in states]
            provenance["energy_keV"] = energy
        if center:
            middle = states[0].grid.center
            provenance["moved_mm"] = (-middle).tolist()
            states = [centered(volume, volume.grid.center - middle) for volume in states]
        return states

    def finish(item: bpy.types.Object, stored: stored_volumes.StoredVolume) -> str:
        """Set the first frame of a sequence, and return the line to report."""
        if item.data.is_sequence:
            item.data.frame_start = frame_start
        volume, states = stored.volume, f"{count} states of " if count > 1 else ""
        voxels = " x ".join(map(str, volume.grid.shape))
        moved = ", its middle moved to the isocentre" if center else ""
        values = f"{volume.quantity}, {volumes.values_text(stored)}"
        return f"Imported {item.name!r}: {states}{voxels} voxels of {values}{moved}"

    label = "Importing a volume" if count == 1 else f"Importing {count} volumes"
    name, collection = name or name_without_ending(paths[0]), bpy.context.collection
    return volumes.add_volume_job(label, make, name, finish, provenance=provenance, collection=collection)


importing = import_job  # the name in version 0.2.0, for scripts


def name_without_ending(path: Path) -> str:
    """Return a file's name without the ending by which it is read."""
    endings = sorted(READ_ENDINGS, key=len, reverse=True)
    ending = next((e for e in endings if path.name.lower().endswith(e)), "")
    return path.name[: len(path.name) - len(ending)] or path.name


def attenuation_job(item: bpy.types.Object, energy: float) -> jobs.Job:
    """Return the job that adds the attenuation of a CT for photons of an energy, keV; the CT stays."""
    provenance = {"ct": item.name, "energy_keV": energy}
    return _derived_volume_job(item, "mu", f" at {energy:g} keV", provenance, lambda ct, _: hu_to_mu(ct, energy))


def ct_numbers_job(item: bpy.types.Object) -> jobs.Job:
    """Return the job that adds the CT numbers of a mu that holds at the energy of CTs; the mu stays."""
    return _derived_volume_job(item, "CT", "", {"mu": item.name}, lambda mu, _: mu_to_hu(mu))


def dose_job(item: bpy.types.Object, isotope: str) -> jobs.Job:
    """Return the job that adds the absorbed dose rate, mGy/h, of an isotope's activity in water; the activity stays."""
    provenance = {"activity": item.name, "isotope": isotope}
    return _derived_volume_job(
        item, "dose rate", f" of {isotope}", provenance,
        lambda activity, progress: absorbed_dose_rate(activity, isotope, progress=progress),
    )  # fmt: skip


def _derived_volume_job(
    item: bpy.types.Object,
    label: str,
    note: str,
    provenance: dict[str, Any],
    derive: Callable[[Volume, Progress | None], Volume],
) -> jobs.Job:
    """Return the job that adds a volume derived from another one, state by state, in the same place.

    The new volume's name ends in `label`; `note` ends the line to report.
    """
    volumes.require_volume(item)
    readers = [volumes.reader(item, path) for path in storage.state_files(item.data)]
    count = len(readers)
    n_x, n_y, n_z = item.mphdrr_volume.shape
    memory.require(8.0 * count * n_x * n_y * n_z, f"the {label} of {count * n_x * n_y * n_z} voxels")
    frame_start, sequence_mode, look = item.data.frame_start, item.data.sequence_mode, item.mphdrr_volume.look

    def make(progress: Progress) -> list[Volume]:
        """Return the volume that `derive` makes of each state."""
        states: list[Volume] = []
        for number, read in enumerate(readers):
            progress(number, count)
            states.append(derive(read(), part_of(progress, number, count)))
        return states

    def finish(result: bpy.types.Object, stored: stored_volumes.StoredVolume) -> str:
        """Make the new volume play its states as the old one does, and return the line to report."""
        result.data.frame_start, result.data.sequence_mode = frame_start, sequence_mode
        if stored.volume.quantity == "mu":
            result.mphdrr_volume.look = look
        return f"Added {result.name!r}: {volumes.values_text(stored)}{note}"

    name, pose, collection = f"{item.name} {label}", volumes.pose_of_object(item), item.users_collection[0]
    return volumes.add_volume_job(f"Making {label}", make, name, finish, pose, provenance, collection, [item])
