"""Where the scene's large files are: beside the saved .blend, or in Blender's temporary folder until it is saved.

`study.blend` has them in `study_mphdrr/` next to it and points there by `//` paths, so that both can be moved together.
Files made before the first save are copied there when it happens. Packing a .blend does not include volumes.
"""

import functools
import os
import re
import shutil
import time
from pathlib import Path
from typing import Any

import bpy

from ...core.errors import InputError, refusing, warn
from ...core.files import ensure_folder, replacing
from ...core.memory import readable_size
from . import ids

_OUR_VOLUME = re.compile(r"[a-z]+-[0-9a-f]{16}(\.preview)?(_\d{4})?\.vdb")
"""Names of the files that `stored_volumes` writes, made from their content."""
_OUR_RUN = re.compile(r".*-projections-[0-9a-f]{8}\.h5")  # names of the files of runs
_FRAME = re.compile(r"_\d{4}\.vdb$")  # of a sequence, at the end of the name

_LOOK = 2.0  # s that a file's size, once read, is shown

# Paths as they were before the save that is running: (owner, attribute, old path).
_before_save: list[tuple[Any, str, str]] = []


def folder() -> Path:
    """The folder for this .blend's large files, made if need be."""
    return ensure_folder(_folder())


def is_own(path: Path) -> bool:
    """Whether a file is in the folder for this .blend's large files."""
    return path.resolve().parent == _folder().resolve()


def stored_path(path: Path) -> str:
    """How the .blend should name a file: `//...` when it is saved and the file lies below it, else absolute."""
    if bpy.data.filepath:
        top = Path(bpy.data.filepath).parent
        if path.is_relative_to(top):
            return "//" + path.relative_to(top).as_posix()
    return str(path)


def absolute(path: str) -> Path:
    """A path as stored in the .blend, made absolute."""
    return Path(bpy.path.abspath(path))


def full_resolution(path: Path) -> Path:
    """The .vdb with every voxel that belongs to the one that Blender shows (which may be a coarser copy)."""
    return path.with_name(path.name.replace(ids.PREVIEW, "", 1))


def of_frame(path: Path, number: int) -> Path:
    """The file of a sequence with that number."""
    return path.with_name(_FRAME.sub(f"_{number:04d}.vdb", path.name))


def size_of(path: Path) -> int | None:
    """Bytes of a file, None where there is none. Panels are drawn often: looks at the disk are two seconds apart."""
    return _size_at(path, time.monotonic() // _LOOK)


@functools.lru_cache(maxsize=4096)
def _size_at(path: Path, now: float) -> int | None:
    return path.stat().st_size if path.is_file() else None


def missing_volumes() -> list[bpy.types.Volume]:
    """Volumes of ours of which a file, shown or with every voxel, is missing, by `size_of`."""
    ours = [data for data in bpy.data.volumes if _OUR_VOLUME.fullmatch(absolute(data.filepath).name)]
    return [data for data in ours if any(size_of(path) is None for path in _files_of(data))]


def relocate(directory: str) -> str:
    """Look for missing volumes' files by name, in a folder and all below it; returns which volumes' were found."""
    top = absolute(directory)
    if not directory or not top.is_dir():
        raise InputError(f"{directory or 'no folder given'}: expected a folder to look in")
    _size_at.cache_clear()
    missing = missing_volumes()
    wanted = {absolute(data.filepath).name for data in missing}
    there = {path.name: path for path in sorted(top.rglob("*.vdb"), reverse=True) if path.name in wanted}
    found = []
    for data in missing:
        shown = there.get(absolute(data.filepath).name)  # the files of one volume are in one folder
        if shown is not None and all(shown.with_name(path.name).is_file() for path in _files_of(data)):
            data.filepath = stored_path(shown)
            data.grids.load()
            found.append(data.name)
    _size_at.cache_clear()
    if absent := sorted(data.name for data in missing if data.name not in found):
        warn(f"{top}: the files of {', '.join(absent)} are not there either")
    return f"Found the files of {', '.join(sorted(found)) or 'no volume'}"


def unused_volumes() -> list[Path]:
    """Files of voxels and of runs in this .blend's folder that none of its volumes and lists of runs needs."""
    used = {path.name for data in bpy.data.volumes for path in _files_of(data)}
    used |= {absolute(run.file).name for scene in bpy.data.scenes for run in scene.mphdrr_projections.runs}
    ours = [p for p in _folder().glob("*") if _OUR_VOLUME.fullmatch(p.name) or _OUR_RUN.fullmatch(p.name)]
    return sorted(path for path in ours if path.is_file() and path.name not in used)


def remove_unused() -> str:
    """Remove the `unused_volumes`, unless the .blend, as it is saved, may need them; returns how many there were."""
    # Without a window Blender does not keep account of changes.
    if bpy.data.filepath and bpy.data.is_dirty and not bpy.app.background:
        raise InputError("the .blend has changes that are not saved, and as saved may need these files: save it")
    unused = unused_volumes()
    text = f"Removed {summary(unused)}" if unused else "No file of voxels or runs is unused"
    for path in unused:
        with refusing(path, "cannot be removed"):
            path.unlink(missing_ok=True)
    return text


def summary(files: list[Path]) -> str:
    """How many unused files there are, and how large they are."""
    size = readable_size(sum(path.stat().st_size for path in files))
    return f"{len(files)} unused file{'s' if len(files) != 1 else ''} of voxels or runs ({size})"


def files_of_states(data: bpy.types.Volume) -> list[Path]:
    """The .vdb with every voxel, of each state of a sequence."""
    return _of_states(data, full_resolution(absolute(data.filepath)))


def _files_of(data: bpy.types.Volume) -> set[Path]:
    """The files that a volume needs: of every state, the one that is shown and the one with every voxel."""
    return {*files_of_states(data), *_of_states(data, absolute(data.filepath))}


def _of_states(data: bpy.types.Volume, path: Path) -> list[Path]:
    if not data.is_sequence:
        return [path]
    return [of_frame(path, data.frame_offset + 1 + k) for k in range(data.frame_duration)]


def before_save(filepath: str, _: Any = None) -> None:
    """Copy files from the temporary folder, and keep paths up to date that Blender does not know of."""
    _before_save.clear()
    if not filepath:
        return
    target = _folder_of(filepath)
    for volume in bpy.data.volumes:
        source = Path(volume.filepath)
        if _is_temporary(source):
            for file in _files_of(volume):
                _bring(file, target)
            _set(volume, "filepath", f"//{target.name}/{source.name}")
    for scene in bpy.data.scenes:
        settings = scene.mphdrr_projections
        for owner, name in [(settings, "run_file"), *((run, "file") for run in settings.runs)]:
            if getattr(owner, name):
                _set(owner, name, _run_path(absolute(getattr(owner, name)), target))
        for run in settings.runs:
            run.is_saved = True


def after_save(filepath: str, _: Any = None) -> None:
    """Set paths back after "Save Copy", when this session still belongs to another file or to none."""
    if not filepath or bpy.data.filepath != filepath:
        restore_paths()
    for owner, name, _ in _before_save:
        # `//` did not lead there yet when the path was set, so Blender could not read the voxels: set it again.
        if isinstance(owner, bpy.types.Volume):
            setattr(owner, name, getattr(owner, name))
    _before_save.clear()


def restore_paths(*_: Any) -> None:
    """Set paths back as they were before a save, for example when Blender could not write the .blend."""
    for owner, name, old in _before_save:
        setattr(owner, name, old)
    _before_save.clear()


def _set(owner: Any, name: str, path: str) -> None:
    old = getattr(owner, name)
    if old != path:
        _before_save.append((owner, name, old))
        setattr(owner, name, path)


def _run_path(source: Path, target: Path) -> str:
    """How the .blend names a run's file, which is copied to the folder `target` if it is a temporary one."""
    if _is_temporary(source):
        if source.is_file():  # of a list, not each is needed
            _bring(source, target)
        source = target / source.name
    # A Save As elsewhere leaves the file where it is, as Blender does with images; only the path changes.
    try:
        return "//" + Path(os.path.relpath(source, target.parent)).as_posix()
    except ValueError:  # another drive
        return str(source)


def _bring(file: Path, target: Path) -> None:
    destination = ensure_folder(target) / file.name
    if not file.is_file():
        raise InputError(f"{file}: is gone, so it cannot be stored beside the .blend; make it again")
    if destination.exists():
        return  # named by its content, or a run's own name
    with replacing(destination) as temporary:
        shutil.copyfile(file, temporary)


def _folder() -> Path:
    return _folder_of(bpy.data.filepath) if bpy.data.filepath else _temporary_folder()


def _folder_of(blend: str) -> Path:
    return Path(blend).with_name(f"{Path(blend).stem}_mphdrr")


def _temporary_folder() -> Path:
    return Path(bpy.app.tempdir) / "mphdrr"


def _is_temporary(path: Path) -> bool:
    return path.is_absolute() and path.is_relative_to(_temporary_folder())
