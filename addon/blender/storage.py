"""The scene's large files: beside the saved .blend, or in Blender's temporary folder until it is saved.

`study.blend` has them in `study_mphdrr/` next to it and points there by `//` paths, so that both can be moved together.
Files made before the first save are copied there when it happens, and Save As copies those of the old folder, unless the
preferences say that they are shared. Packing a .blend does not include volumes.
"""

import filecmp
import functools
import glob
import os
import re
import shutil
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import bpy

from ...core.errors import InputError, refusing, several, warn
from ...core.files import ensure_folder, relative_path, replacing
from ...core.memory import readable_size
from . import ids

_OURS = re.compile(r"([a-z_]+-[0-9a-f]{16}|.*-projections-[0-9a-f]{8})(\.preview)?(_\d{4})?\.(vdb|h5)")
"""Names of files that `stored_volumes` writes, made from their content, and of run files; all of a result begin alike."""
_ENDING = re.compile(r"\.[A-Za-z]\w*$")  # a file's ending; a folder, or a number typed in place of a file, has none
_FRAME = re.compile(r"_\d{4}\.vdb$")  # the frame number at the end of the names of a sequence's files

_SIZE_LIFETIME = 2.0  # s for which a file's size, once read, is shown

_FOLDER = "_mphdrr"  # the end of the names of .blend files' folders
_LARGE = 4 * 2**30  # bytes; Save As onto another disk shares larger volumes and files instead of copying them
_UNCOPIED = {"recipe"}  # properties with the path of a text that refers to files beside itself
_NOTE_TIME = 15.0  # s for which the status bar shows the line about a save

copies = True
"""Whether Save As copies files, as the preferences say; if not, both .blend files share them."""


class _ChangedPath(NamedTuple):
    """A path in the .blend's data that a save has changed."""

    owner: Any
    name: str  # the name of the owner's property
    old: str  # the property's value before the save
    path: Path  # the file or folder that the property names now


_changed_paths: list[_ChangedPath] = []  # paths changed by the save that is going on
_saved_folder = Path()  # folder of the .blend, or the temporary one, before the save that is going on
_saved_names: set[str] | None = None  # names of our files that the .blend as last saved needs; None: not known
_left_folders: dict[Path, set[str] | None] = {}
"""Folders that a Save As has left, with the `_saved_names` of their .blend."""
_save_note = (0.0, "")  # the time of the last save, s, and the line about it


def folder() -> Path:
    """Return the folder for this .blend's large files; make it if there is none."""
    return ensure_folder(_folder())


def is_in_folder(path: Path) -> bool:
    """Return whether a file is in the folder for this .blend's large files."""
    return path.resolve().parent == _folder().resolve()


def stored_path(path: Path) -> str:
    """Return the path to store in the .blend: `//...` for a file below the folder of the saved .blend, else absolute."""
    if bpy.data.filepath:
        top = Path(bpy.data.filepath).parent
        if path.is_relative_to(top):
            return "//" + path.relative_to(top).as_posix()
    return str(path)


def absolute(path: str) -> Path:
    """Return a path that is stored in the .blend as an absolute one."""
    return Path(bpy.path.abspath(path))


def full_resolution_file(path: Path) -> Path:
    """Return the .vdb with every voxel for the .vdb that Blender shows, which may be a coarser copy."""
    return path.with_name(path.name.replace(ids.PREVIEW, "", 1))


def resume_file(path: Path) -> Path:
    """Return the file beside a reconstruction's .vdb from which the reconstruction can be continued."""
    return full_resolution_file(path).with_suffix(".h5")


def frame_file(path: Path, number: int) -> Path:
    """Return the file of a sequence's frame."""
    return path.with_name(_FRAME.sub(f"_{number:04d}.vdb", path.name))


def file_size(path: Path) -> int | None:
    """Return a file's size in bytes, None where there is no file; the disk is asked every two seconds at most."""
    return _cached_size(path, time.monotonic() // _SIZE_LIFETIME)


@functools.lru_cache(maxsize=4096)
def _cached_size(path: Path, interval: float) -> int | None:
    """Return a file's size; `interval`, the number of the present two seconds, lets the cache forget older sizes."""
    return path.stat().st_size if path.is_file() else None


def missing_volumes() -> list[bpy.types.Volume]:
    """Return our volumes that miss a file, the shown one or the one with every voxel."""
    our_volumes = [data for data in bpy.data.volumes if _OURS.fullmatch(absolute(data.filepath).name)]
    return [data for data in our_volumes if any(file_size(path) is None for path in _files_of(data))]


def relocate(directory: str) -> str:
    """Look for missing files by name in a folder and all below it; return the line to report."""
    top = absolute(directory)
    if not directory or not top.is_dir():
        raise InputError(f"{directory or 'no folder given'}: expected a folder to look in")
    found_names = _relink(top.rglob("*"))
    if absent := sorted(data.name for data in missing_volumes()):
        warn(f"{top}: the files of {', '.join(absent)} are not there either")
    return f"Found the files of {', '.join(sorted(found_names)) or 'no volume'}"


def _relink(files: Iterable[Path]) -> set[str]:
    """Make broken paths lead to the `files` of the same name; return the names of the repaired volumes and runs."""
    broken = []
    for owner, name in file_references():
        paths = _files_of(owner) if isinstance(owner, bpy.types.Volume) else {absolute(getattr(owner, name))}
        if not all(path.exists() for path in paths):
            broken.append((owner, name, set(map(_file_name, paths))))
    names = {name for _, _, file_names in broken for name in file_names}
    path_by_name = {path.name: path for path in sorted((path for path in files if path.name in names), reverse=True)}
    relinked = set()
    for owner, name, file_names in broken:
        path = path_by_name.get(_file_name(getattr(owner, name)))  # the files of one volume are in one folder
        if path is not None and all(path.with_name(file_name).is_file() for file_name in file_names):
            setattr(owner, name, stored_path(path))
            relinked.add(getattr(owner, "name", ""))
    _cached_size.cache_clear()
    return relinked - {""}


def _file_name(path: str | Path) -> str:
    """Return the last part of a path of any operating system."""
    return re.split(r"[\\/]", str(path))[-1]


def unused_volumes() -> list[Path]:
    """Return the voxel files and run files in this .blend's folder that none of its volumes and lists of runs needs."""
    used_names = _used_names()
    our_files = [path for path in _folder().glob("*") if _OURS.fullmatch(path.name) and path.is_file()]
    return sorted(path for path in our_files if path.name not in used_names)


def _used_names() -> set[str]:
    """Return the names of the files that the volumes and the lists of runs need."""
    names = {path.name for data in bpy.data.volumes for path in _files_and_resume_files(data)}
    return names | {absolute(run.file).name for scene in bpy.data.scenes for run in scene.mphdrr_projections.runs}


def adopt(path: Path) -> Path:
    """Return the path in this .blend's folder of a file made by a job, in the folder that the .blend had when it began.

    After a Save As in the meantime, all files of the result move there; those that the other .blend needs are copied.
    """
    match = _OURS.fullmatch(path.name)
    if match is None or path.parent == _folder() or path.parent not in _left_folders:
        return path
    for file in list(path.parent.glob(f"{glob.escape(match[1])}*")):
        _copy_into(file, _folder())
        _remove_left(file)
    return _folder() / path.name


def remove_results(paths: Iterable[Path]) -> None:
    """Remove files made by a job that nothing needs, wherever they have moved."""
    unused = set(unused_volumes())
    for path in paths:
        _remove_left(path)
        for file in unused & {path, _folder() / path.name}:
            file.unlink(missing_ok=True)


def _remove_left(path: Path) -> None:
    """Remove a file from a folder that a Save As has left, unless the folder's .blend needs it."""
    saved_names = _left_folders.get(path.parent)
    if saved_names is not None and path.name not in saved_names:
        path.unlink(missing_ok=True)
        _remove_empty(path.parent)


def _remove_empty(path: Path) -> None:
    """Remove a folder if it is empty: jobs make it again."""
    with suppress(OSError):
        path.rmdir()


def remove_unused() -> str:
    """Remove the unused voxel files and run files, and return the line to report.

    `InputError` if the .blend has unsaved changes: as saved on disk, it may still need the files.
    """
    # Without a window, Blender does not keep `is_dirty` up to date.
    if bpy.data.filepath and bpy.data.is_dirty and not bpy.app.background:
        raise InputError("the .blend has changes that are not saved, and as saved may need these files: save it")
    files = unused_volumes()
    text = f"Removed {summarize_unused(files)}" if files else "No file of voxels or runs is unused"
    for path in files:
        with refusing(path, "cannot be removed"):
            path.unlink(missing_ok=True)
    return text


def summarize_unused(files: list[Path]) -> str:
    """Return the number and size of unused files in words."""
    return f"{_amount({path: path.stat().st_size for path in files})} of voxels or runs that nothing needs"


def state_files(data: bpy.types.Volume) -> list[Path]:
    """Return the .vdb files with every voxel of all states of a sequence; of another volume, its one file."""
    return _sequence_files(data, full_resolution_file(absolute(data.filepath)))


def _files_of(data: bpy.types.Volume) -> set[Path]:
    """Return the files that a volume needs: for every state, the shown one and the one with every voxel."""
    return {*state_files(data), *_sequence_files(data, absolute(data.filepath))}


def _files_and_resume_files(data: bpy.types.Volume) -> set[Path]:
    """Return the files that a volume needs, and the existing ones from which its reconstruction can be continued."""
    files = _files_of(data)
    return files | set(filter(Path.is_file, map(resume_file, files)))


def _sequence_files(data: bpy.types.Volume, path: Path) -> list[Path]:
    """Return the files of all states of a sequence, of which `path` is one; of another volume, `path` alone."""
    if not data.is_sequence:
        return [path]
    return [frame_file(path, data.frame_offset + 1 + k) for k in range(data.frame_duration)]


def file_references() -> Iterator[tuple[Any, str]]:
    """Yield (owner, property name) for every path in this .blend's own data that names a file or a folder."""
    images = [image for image in bpy.data.images if image.source == "FILE" and image.packed_file is None]
    scenes = [scene.mphdrr_projections for scene in bpy.data.scenes]
    scenes += [run for settings in scenes for run in settings.runs]
    scenes += [x for scene in bpy.data.scenes for x in (scene.mphdrr_reconstruction, scene.mphdrr_events)]
    for owner in (*bpy.data.volumes, *images, *scenes, *(c.mphdrr_scanner for c in bpy.data.collections)):
        properties = owner.bl_rna.properties
        paths = ["filepath"] if owner == owner.id_data else [p.identifier for p in properties if "_PATH" in p.subtype]
        yield from ((owner, name) for name in paths if owner.id_data.library is None and getattr(owner, name))


@dataclass
class _GatheredFiles:
    """Files copied into a .blend's folder, and files left in their places."""

    copied: dict[Path, int] = field(default_factory=dict)  # sizes, bytes, of the copies
    shared: dict[Path, int] = field(default_factory=dict)  # sizes, bytes, of files in other .blend files' folders
    outside: dict[Path, int] = field(default_factory=dict)  # sizes, bytes, of files anywhere else
    missing: list[str] = field(default_factory=list)  # names of missing files
    problems: list[str] = field(default_factory=list)  # messages about files that could not be copied

    @property
    def absent(self) -> str:
        """The missing files in words; "" for none."""
        return f"missing: {several(dict.fromkeys(self.missing), 6)}" if self.missing else ""

    @property
    def text(self) -> str:
        """The copied, shared and missing files in a line; "" for none."""
        target, owners = (", ".join(sorted({path.parent.name for path in x})) for x in (self.copied, self.shared))
        amounts = {
            f"copied {_amount(self.copied)} into {target}": self.copied,
            f"shares {_amount(self.shared)} with {owners}": self.shared,
            f"{_amount(self.outside)} elsewhere: Collect Files copies them": self.outside,
        }
        texts = (text for text, files in amounts.items() if files)
        return "; ".join(filter(None, [*texts, self.absent, *self.problems]))


def _amount(files: dict[Path, int]) -> str:
    """Return the number of files and their total size in words."""
    return f"{ids.counted(len(files), 'file')} ({readable_size(sum(files.values()))})"


def _gather_files(target: Path, is_wanted: Callable[[str, Path], bool]) -> _GatheredFiles:
    """Copy the wanted files into the folder `target` of a .blend, and make paths relative to this .blend where possible."""
    gathered, changes = _GatheredFiles(), []
    for owner, name in file_references():
        old = getattr(owner, name)
        path = absolute(old)
        files = _files_and_resume_files(owner) if isinstance(owner, bpy.types.Volume) else {path}
        sizes = {file: file.stat().st_size for file in files if file.is_file()}
        if sizes.keys() < files and _ENDING.search(path.name):
            gathered.missing.append(path.name)
        elif sizes and path.parent.resolve() != target.resolve():
            unmoved = gathered.shared if path.parent.name.endswith(_FOLDER) else gathered.outside
            try:
                if is_wanted(name, path) and not _is_too_large(path, sum(sizes.values()), target):
                    copied_files = {file: _copy_into(file, target) for file in files}
                    gathered.copied |= {copied_files[file]: size for file, size in sizes.items()}
                    path, sizes = copied_files.get(path, target / path.name), {}
            except InputError as error:  # such as a full disk
                gathered.problems.append(str(error))
            unmoved |= sizes
        is_near = owner != owner.id_data and path.is_relative_to(target.parent)
        if old.startswith("//") or path != absolute(old) or is_near:
            changes.append(_ChangedPath(owner, name, old, path))
    _changed_paths[:] = changes
    for change in changes:
        # Where a Save As leads to another folder, Blender itself rewrites the paths of datablocks from the old one.
        is_rewritten = bpy.data.filepath and change.owner == change.owner.id_data
        new = _relative_path(Path(bpy.data.filepath).parent if is_rewritten else target.parent, change.path)
        if new != getattr(change.owner, change.name):
            setattr(change.owner, change.name, new)
    return gathered


def collect_files() -> str:
    """Copy all files that the scene uses into this .blend's folder, name them by `//`, and return the line to report.

    A warning names missing files and files that stay outside the folder.
    """
    global _save_note
    gathered = _gather_files(_folder(), lambda name, path: name not in _UNCOPIED)
    _save_note = (0.0, "")  # the note may have asked for Collect Files
    _changed_paths.clear()
    inside = _folder().parent, bpy.utils.system_resource("DATAFILES")  # Blender's own brushes are in the latter
    paths = {Path(path) for path in bpy.utils.blend_paths(absolute=True, packed=False)} | gathered.outside.keys()
    paths = {path for path in paths if not any(map(path.is_relative_to, inside)) and path.name not in gathered.missing}
    notes = [f"outside the .blend's folder stay: {several(sorted(paths), 6)}"] if paths else []
    for text in (*notes, *filter(None, [gathered.absent, *gathered.problems])):
        warn(text)
    names = several(sorted(path.name for path in gathered.copied), 6)
    return f"Copied {_amount(gathered.copied)} into {_folder()}: {names}. Save the .blend" if names else "All are there"


def before_save(filepath: str, _: Any = None) -> None:
    """Copy files from the temporary folder, for a Save As also those of the old .blend, and make paths lead to them."""
    global _save_note, _saved_folder
    _changed_paths.clear()
    if not filepath:
        return
    _saved_folder = _folder()
    is_new = filepath != bpy.data.filepath

    def is_wanted(name: str, path: Path) -> bool:
        """Return whether a file is to be copied beside the saved .blend."""
        return _is_temporary(path) or (is_new and copies and path.parent.name.endswith(_FOLDER))

    gathered = _gather_files(_folder_of(filepath), is_wanted)
    for scene in bpy.data.scenes:
        for run in scene.mphdrr_projections.runs:
            run.is_saved = True
    if text := gathered.text if is_new or gathered.problems else "":
        _save_note = time.monotonic(), text[:1].upper() + text[1:]
        print(f"mphDRR: {_save_note[1]}")


def draw_save_note(header: bpy.types.Header, context: bpy.types.Context) -> None:
    """Draw the line about the last save's files in Blender's status bar."""
    if time.monotonic() < _save_note[0] + _NOTE_TIME:
        header.layout.label(text=_save_note[1], translate=False, icon="FILE_TICK")


def after_save(filepath: str, _: Any = None) -> None:
    """Restore paths after "Save Copy", when this session still belongs to another file; after Save As, leave that file."""
    global _saved_names
    if not filepath or bpy.data.filepath != filepath:
        restore_paths()
        return
    for change in _changed_paths:
        # `//` may not have led there yet when the path was set, so Blender could not read the voxels: set it again.
        if change.owner == change.owner.id_data:
            setattr(change.owner, change.name, _relative_path(Path(filepath).parent, change.path))
    _changed_paths.clear()
    if _saved_folder != _folder():
        _left_folders[_saved_folder] = _saved_names
        _remove_empty(_saved_folder)
    _left_folders.pop(_folder(), None)
    _saved_names = _used_names()


def restore_paths(*_: Any) -> None:
    """Restore paths as they were before a save, for example when Blender could not write the .blend."""
    for change in _changed_paths:
        setattr(change.owner, change.name, change.old)
    _changed_paths.clear()


def after_load(*_: Any) -> None:
    """Relink missing files that lie in the folder of a .blend which was renamed together with it."""
    global _saved_names
    _relink(_folder().glob("*") if bpy.data.filepath else ())
    _left_folders.clear()
    _saved_names = _used_names()


def _relative_path(folder: Path, path: Path) -> str:
    """Return the `//` path by which a .blend in a folder names a file; the absolute path for a file on another drive."""
    relative = relative_path(path, folder)
    return str(path) if os.path.isabs(relative) else f"//{relative}"


def _is_too_large(file: Path, size: int, target: Path) -> bool:
    """Return whether a file is too large to be copied onto another disk."""
    return size > _LARGE and file.stat().st_dev != target.parent.stat().st_dev


def _copy_into(file: Path, target: Path) -> Path:
    """Copy a file into a folder, under a new name if a different file has its name, and return the copy's path."""
    is_ours = _OURS.fullmatch(file.name)
    path, number = ensure_folder(target) / file.name, 2
    while path.exists():
        if is_ours or filecmp.cmp(file, path, shallow=False):
            return path  # our names are unique: made from the content or at random
        path, number = path.with_name(f"{file.stem}-{number}{file.suffix}"), number + 1
    with replacing(path) as temporary:
        try:
            if not is_ours or not os.access(file, os.W_OK):
                raise OSError
            os.link(file, temporary)  # our files never change, so both names may share one file on the disk
        except OSError:
            shutil.copyfile(file, temporary)
    return path


def _folder() -> Path:
    """Return the path of this .blend's folder for large files, which need not exist."""
    return _folder_of(bpy.data.filepath) if bpy.data.filepath else _temporary_folder()


def _folder_of(blend: str) -> Path:
    """Return the path of the folder for large files of the .blend file `blend`."""
    return Path(blend).with_name(Path(blend).stem + _FOLDER)


def _temporary_folder() -> Path:
    """Return the folder for large files until the .blend is saved."""
    return Path(bpy.app.tempdir) / "mphdrr"


def _is_temporary(path: Path) -> bool:
    """Return whether a path lies in the temporary folder."""
    return path.is_absolute() and path.is_relative_to(_temporary_folder())
