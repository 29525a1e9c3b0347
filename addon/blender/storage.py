"""Where the scene's large files are: beside the saved .blend, or in Blender's temporary folder until it is saved.

`study.blend` has them in `study_mphdrr/` next to it and points there by `//` paths, so that both can be moved together.
Files made before the first save are copied there when it happens, and Save As copies those of the old folder, unless the
preferences say that they are shared. Packing a .blend does not include volumes.
"""

import filecmp
import functools
import os
import re
import shutil
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import bpy

from ...core.errors import InputError, refusing, several, warn
from ...core.files import ensure_folder, replacing
from ...core.memory import readable_size
from . import ids

_OUR_VOLUME = re.compile(r"[a-z]+-[0-9a-f]{16}(\.preview)?(_\d{4})?\.(vdb|h5)")
"""Names of the files that `stored_volumes` writes, made from their content."""
_OUR_RUN = re.compile(r".*-projections-[0-9a-f]{8}\.h5")  # names of the files of runs
_ENDING = re.compile(r"\.[A-Za-z]\w*$")  # of files, not of folders, nor of numbers in place of a file
_FRAME = re.compile(r"_\d{4}\.vdb$")  # of a sequence, at the end of the name

_LOOK = 2.0  # s that a file's size, once read, is shown

_FOLDER = "_mphdrr"  # what the names of .blend files' folders end in
_LARGE = 4 * 2**30  # bytes of a volume or file: on another disk, a Save As shares what is larger
_STAY = {"recipe"}  # names of paths to texts that name files beside them
_SHOWN = 15.0  # s that the line about a save stands in the status bar

copies = True
"""Whether Save As copies files, as the preferences say; else they are shared."""


class _Changed(NamedTuple):
    owner: Any
    name: str  # of the owner's property
    old: str
    path: Path  # of the file, or folder, that it names from now on


_before_save: list[_Changed] = []  # paths that the save that is running has changed
_said = (0.0, "")  # about the last save: when, in s, and what


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


def resumable(path: Path) -> Path:
    """The file beside a reconstruction's .vdb from which it goes on."""
    return full_resolution(path).with_suffix(".h5")


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
    """Look for missing files by name, in a folder and all below it; returns whose were found."""
    top = absolute(directory)
    if not directory or not top.is_dir():
        raise InputError(f"{directory or 'no folder given'}: expected a folder to look in")
    found = _find(top.rglob("*"))
    if absent := sorted(data.name for data in missing_volumes()):
        warn(f"{top}: the files of {', '.join(absent)} are not there either")
    return f"Found the files of {', '.join(sorted(found)) or 'no volume'}"


def _find(files: Iterable[Path]) -> set[str]:
    """Have paths that lead nowhere lead to files of that name; returns the names of volumes and runs whose were found."""
    lost = []
    for owner, name in references():
        wanted = _files_of(owner) if isinstance(owner, bpy.types.Volume) else {absolute(getattr(owner, name))}
        if not all(path.exists() for path in wanted):
            lost.append((owner, name, set(map(_name, wanted))))
    names = {name for _, _, all_of_it in lost for name in all_of_it}
    there = {path.name: path for path in sorted((path for path in files if path.name in names), reverse=True)}
    found = set()
    for owner, name, all_of_it in lost:
        path = there.get(_name(getattr(owner, name)))  # the files of one volume are in one folder
        if path is not None and all(path.with_name(each).is_file() for each in all_of_it):
            setattr(owner, name, stored_path(path))
            found.add(getattr(owner, "name", ""))
    _size_at.cache_clear()
    return found - {""}


def _name(path: str | Path) -> str:
    """The last part of a path of any system."""
    return re.split(r"[\\/]", str(path))[-1]


def unused_volumes() -> list[Path]:
    """Files of voxels and of runs in this .blend's folder that none of its volumes and lists of runs needs."""
    used = {path.name for data in bpy.data.volumes for path in _all_of(data)}
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
    return f"{_amount({path: path.stat().st_size for path in files})} of voxels or runs that nothing needs"


def files_of_states(data: bpy.types.Volume) -> list[Path]:
    """The .vdb with every voxel, of each state of a sequence."""
    return _of_states(data, full_resolution(absolute(data.filepath)))


def _files_of(data: bpy.types.Volume) -> set[Path]:
    """The files that a volume needs: of every state, the one that is shown and the one with every voxel."""
    return {*files_of_states(data), *_of_states(data, absolute(data.filepath))}


def _all_of(data: bpy.types.Volume) -> set[Path]:
    """The files that a volume needs, and, of a reconstruction, that from which it goes on, if there is one."""
    needed = _files_of(data)
    return needed | set(filter(Path.is_file, map(resumable, needed)))


def _of_states(data: bpy.types.Volume, path: Path) -> list[Path]:
    if not data.is_sequence:
        return [path]
    return [of_frame(path, data.frame_offset + 1 + k) for k in range(data.frame_duration)]


def references() -> Iterator[tuple[Any, str]]:
    """Every path in this .blend's own data that names a file or a folder: its owner, and its property's name."""
    images = [image for image in bpy.data.images if image.source == "FILE" and image.packed_file is None]
    scenes = [scene.mphdrr_projections for scene in bpy.data.scenes]
    scenes += [run for settings in scenes for run in settings.runs]
    scenes += [x for scene in bpy.data.scenes for x in (scene.mphdrr_reconstruction, scene.mphdrr_events)]
    for owner in (*bpy.data.volumes, *images, *scenes, *(c.mphdrr_scanner for c in bpy.data.collections)):
        known = owner.bl_rna.properties
        paths = ["filepath"] if owner == owner.id_data else [p.identifier for p in known if "_PATH" in p.subtype]
        yield from ((owner, name) for name in paths if owner.id_data.library is None and getattr(owner, name))


@dataclass
class _Kept:
    """Which files were copied into a .blend's folder, and which stay where they are."""

    copied: dict[Path, int] = field(default_factory=dict)  # their sizes in bytes
    shared: dict[Path, int] = field(default_factory=dict)  # files of other .blend files' folders
    outside: dict[Path, int] = field(default_factory=dict)  # the user's own
    missing: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)

    @property
    def absent(self) -> str:
        """Which files are missing; "" for none."""
        return f"missing: {several(dict.fromkeys(self.missing), 6)}" if self.missing else ""

    @property
    def text(self) -> str:
        """What was done, in a line; "" for nothing."""
        target, homes = (", ".join(sorted({path.parent.name for path in each})) for each in (self.copied, self.shared))
        amounts = {
            f"copied {_amount(self.copied)} into {target}": self.copied,
            f"shares {_amount(self.shared)} with {homes}": self.shared,
            f"{_amount(self.outside)} elsewhere: Collect Files copies them": self.outside,
        }
        return "; ".join(
            filter(None, [*(text for text, files in amounts.items() if files), self.absent, *self.problems])
        )


def _amount(files: dict[Path, int]) -> str:
    return f"{len(files)} file{'s' * (len(files) > 1)} ({readable_size(sum(files.values()))})"


def _keep_together(target: Path, is_wanted: Callable[[str, Path], bool]) -> _Kept:
    """Copy the wanted files into the folder `target` of a .blend, and have all paths lead to where files are, from there."""
    kept, changed = _Kept(), []
    for owner, name in references():
        old = getattr(owner, name)
        path = absolute(old)
        files = _all_of(owner) if isinstance(owner, bpy.types.Volume) else {path}
        sizes = {file: file.stat().st_size for file in files if file.is_file()}
        if sizes.keys() < files and _ENDING.search(path.name):
            kept.missing.append(path.name)
        elif sizes and path.parent.resolve() != target.resolve():
            stays = kept.shared if path.parent.name.endswith(_FOLDER) else kept.outside
            try:
                if is_wanted(name, path) and not _is_too_large(path, sum(sizes.values()), target):
                    brought = {file: _bring(file, target) for file in files}
                    kept.copied |= {brought[file]: size for file, size in sizes.items()}
                    path, sizes = brought.get(path, target / path.name), {}
            except InputError as error:  # such as a full disk
                kept.problems.append(str(error))
            stays |= sizes
        is_near = owner != owner.id_data and path.is_relative_to(target.parent)
        if old.startswith("//") or path != absolute(old) or is_near:
            changed.append(_Changed(owner, name, old, path))
    _before_save[:] = changed
    for each in changed:
        # Where a Save As leads to another folder, Blender itself rewrites the paths of datablocks from the old one.
        own = each.owner == each.owner.id_data
        new = _below(Path(bpy.data.filepath).parent if own and bpy.data.filepath else target.parent, each.path)
        if new != getattr(each.owner, each.name):
            setattr(each.owner, each.name, new)
    return kept


def collect() -> str:
    """Copy all files that the scene uses into this .blend's folder, from where it names them by `//`; returns what was done.

    What is missing, and what stays where it is, is said in a warning.
    """
    global _said
    kept = _keep_together(_folder(), lambda name, path: name not in _STAY)
    _said = (0.0, "")  # it may have asked for this
    _before_save.clear()
    known = _folder().parent, bpy.utils.system_resource("DATAFILES")  # which has Blender's own brushes
    others = {Path(path) for path in bpy.utils.blend_paths(absolute=True, packed=False)} | kept.outside.keys()
    others = {path for path in others if not any(map(path.is_relative_to, known)) and path.name not in kept.missing}
    stay = [f"outside the .blend's folder stay: {several(sorted(others), 6)}"] if others else []
    for text in (*stay, *filter(None, [kept.absent, *kept.problems])):
        warn(text)
    names = several(sorted(path.name for path in kept.copied), 6)
    return f"Copied {_amount(kept.copied)} into {_folder()}: {names}. Save the .blend" if names else "All are there"


def before_save(filepath: str, _: Any = None) -> None:
    """Copy files from the temporary folder, of a Save As those of the old .blend, too, and keep paths up to date."""
    global _said
    _before_save.clear()
    if not filepath:
        return
    is_new = filepath != bpy.data.filepath

    def is_wanted(name: str, path: Path) -> bool:
        return _is_temporary(path) or (is_new and copies and path.parent.name.endswith(_FOLDER))

    kept = _keep_together(_folder_of(filepath), is_wanted)
    for scene in bpy.data.scenes:
        for run in scene.mphdrr_projections.runs:
            run.is_saved = True
    if text := kept.text if is_new or kept.problems else "":
        _said = time.monotonic(), text[:1].upper() + text[1:]
        print(f"mphDRR: {_said[1]}")


def draw_said(header: bpy.types.Header, context: bpy.types.Context) -> None:
    """Draw in Blender's status bar what the last save did with files."""
    if time.monotonic() < _said[0] + _SHOWN:
        header.layout.label(text=_said[1], translate=False, icon="FILE_TICK")


def after_save(filepath: str, _: Any = None) -> None:
    """Set paths back after "Save Copy", when this session still belongs to another file or to none."""
    if not filepath or bpy.data.filepath != filepath:
        restore_paths()
    for each in _before_save:
        # `//` may not have led there yet when the path was set, so Blender could not read the voxels: set it again.
        if each.owner == each.owner.id_data:
            setattr(each.owner, each.name, _below(Path(filepath).parent, each.path))
    _before_save.clear()


def restore_paths(*_: Any) -> None:
    """Set paths back as they were before a save, for example when Blender could not write the .blend."""
    for each in _before_save:
        setattr(each.owner, each.name, each.old)
    _before_save.clear()


def after_load(*_: Any) -> None:
    """Find the files of a .blend that was renamed with its folder: those that are missing where they were, and lie there."""
    _find(_folder().glob("*") if bpy.data.filepath else ())


def _below(folder: Path, path: Path) -> str:
    """How a .blend in a folder names a file."""
    try:
        return "//" + Path(os.path.relpath(path, folder)).as_posix()
    except ValueError:  # another drive
        return str(path)


def _is_too_large(file: Path, size: int, target: Path) -> bool:
    return size > _LARGE and file.stat().st_dev != target.parent.stat().st_dev


def _bring(file: Path, target: Path) -> Path:
    """Copy a file into a folder, under another name where there is another one of its name; returns the copy's path."""
    is_ours = _OUR_VOLUME.fullmatch(file.name) or _OUR_RUN.fullmatch(file.name)
    path, number = ensure_folder(target) / file.name, 2
    while path.exists():
        if is_ours or filecmp.cmp(file, path, shallow=False):
            return path  # named by its content, or a run's own name
        path, number = path.with_name(f"{file.stem}-{number}{file.suffix}"), number + 1
    with replacing(path) as temporary:
        try:
            if not is_ours or not os.access(file, os.W_OK):
                raise OSError
            os.link(file, temporary)  # nobody changes ours, so one on the disk is enough for both names
        except OSError:
            shutil.copyfile(file, temporary)
    return path


def _folder() -> Path:
    return _folder_of(bpy.data.filepath) if bpy.data.filepath else _temporary_folder()


def _folder_of(blend: str) -> Path:
    return Path(blend).with_name(Path(blend).stem + _FOLDER)


def _temporary_folder() -> Path:
    return Path(bpy.app.tempdir) / "mphdrr"


def _is_temporary(path: Path) -> bool:
    return path.is_absolute() and path.is_relative_to(_temporary_folder())
