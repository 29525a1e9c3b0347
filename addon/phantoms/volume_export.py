"""Export of the scene's volumes to files for other programs."""

from pathlib import Path
from typing import Any

import bpy

from ...core.errors import InputError
from ...core.progress import Progress, stages_of
from ...core.volumes.formats.dicom_writing import parse_tags
from ...core.volumes.volume_files import VOLUME_FORMATS, write_volume
from ..blender import jobs
from ..volumes import vdb, volumes
from . import phantoms

WRITTEN_ENDINGS = (".vdb", *VOLUME_FORMATS)
"""Endings of the names of files that volumes can be written to."""


def export_job(item: bpy.types.Object, path: Path, template: str = "", tags: str = "") -> jobs.Job:
    """Return the job that writes every voxel of a volume at its place in the world; the name's ending chooses the format.

    A DICOM file takes tags from the file `template`, and `tags` such as "PatientName=Doe^Jo; SeriesNumber=7".
    """
    if not path.name.lower().endswith(WRITTEN_ENDINGS):
        raise InputError(f"{path}: expected a name ending in {', '.join(WRITTEN_ENDINGS)}")
    read = volumes.reader(item)
    dicom: dict[str, Any] = {"template": template or None, "tags": parse_tags(tags.split(";"))}
    if path.resolve() == volumes.file_of(item).resolve():
        raise InputError(f"{path}: is the scene's own file of {item.name!r}; choose another name")
    phantoms.require_current(item)
    provenance: dict[str, Any] = {"object": item.name}
    if (phantom := phantoms.settings_of(item)) is not None:
        provenance |= phantom.recipe()
    if item.data.is_sequence:
        provenance |= {"frame": bpy.context.scene.frame_current, "state": volumes.state_text(item)}

    def work(progress: Progress) -> None:
        """Read the voxels, and write them to the chosen file."""
        stages_of(progress)("reading the voxels")
        volume = read()
        stages_of(progress)("writing the file")
        if path.suffix.lower() == ".vdb":
            vdb.write_vdb(volume, path, provenance)
        else:
            write_volume(volume, path, **dicom)

    return jobs.Job("Exporting a volume", work, lambda _: f"Wrote {path}")
