"""Check and repair of event sets: content of the folder, and every byte of every file."""

import os
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from ..errors import InputError, refusing
from ..files import AnyPath, ensure_folder, final_name, is_leftover
from ..memory import cores
from ..progress import Progress, tell
from .event_files import FileLocation, read_header, verify
from .folders import INDEX, INPUT_LIST, INPUTS, RECIPE, REQUESTS, SetFolder
from .index import column
from .store import EVENTS, LOCK, SHARDS


@dataclass(frozen=True)
class Fault:
    """A fault of an event set, found by `check`."""

    kind: str
    """Kind of fault: "missing", "damaged", "another recipe", "leftover", "foreign", "index" or "input"."""
    path: Path
    """Path of the file that is at fault."""
    text: str
    """Description in one line, which begins with the path."""
    event: int | None = None
    """Number of the event that must be made again; None where no event is lost."""


@dataclass(frozen=True)
class Status:
    """Content of an event set, by the names and headers of its files."""

    asked: int
    """Number of requested events."""
    made: int
    """Number of these that are stored."""
    missing: list[int]
    """Numbers of the requested events that are not stored."""
    size: int
    """Bytes of the stored events."""
    phantoms: dict[str, int]
    """Number of stored events by phantom."""
    splits: dict[str, int]
    """Number of stored events by split; "none" for events without one."""
    builds: dict[str, int]
    """Number of stored events by the build of mphDRR that made them; "" for builds of version 0.1."""
    shards: int = 0
    """Number of shards, files of many events."""


def status(folder: AnyPath) -> Status:
    """Count the events of a set whose files have the expected size and recipe, without reading their data.

    `check` also reads the data. `InputError` where the folder is no event set.
    """
    target = SetFolder(folder)
    fingerprint = target.recipe.fingerprint
    all_headers = {number: target.valid_header(number, location) for number, location in target.locations.items()}
    headers = {n: header for n, header in all_headers.items() if header is not None and header.recipe == fingerprint}
    requested = target.requested_numbers() or list(headers)
    headers = {number: headers[number] for number in requested if number in headers}
    rows = [target.line(number) for number in headers]
    return Status(
        asked=len(requested),
        made=len(headers),
        missing=[number for number in requested if number not in headers],
        size=sum(header.size for header in headers.values()),
        phantoms=dict(sorted(Counter(column(row, 1) for row in rows).items())),
        splits=dict(sorted(Counter(column(row, 2) or "none" for row in rows).items())),
        builds=dict(sorted(Counter(header.build for header in headers.values()).items())),
        shards=len(target.store.shard_paths()),
    )


def check(folder: AnyPath, progress: Progress | None = None) -> list[Fault]:
    """Read every byte of a set's files and return all faults; an empty list for a set without faults.

    Faults are events that are missing, cut, changed or of another recipe; files that do not belong to the set; leftovers of
    interrupted processes; and an index or a copy of an input file that differs from what was written.

    Parameters
    ----------
    folder
        Folder of the set.
    progress
        Called as ``progress(events read, events)``; may raise `Cancelled`.

    Raises
    ------
    InputError
        The folder is no event set, or its recipe cannot be read any more.
    """
    target = SetFolder(folder)
    faults = list(_input_faults(target))
    if faults:  # without the input files, the fingerprint of the recipe is unknown
        return faults
    faults += index_faults(folder)
    requested, copies, locations = set(_expected_numbers(target)), target.store.copies(), target.store.locations()
    fingerprint = target.recipe.fingerprint

    def find_fault(number: int, location: FileLocation) -> Fault | None:
        """Return the fault of an event's copy; "foreign" for a faulty file of an event that nobody requested."""
        if (fault := _event_fault(location, number, fingerprint)) is None:
            return None
        if number not in requested:
            return Fault("foreign", fault.path, f"{fault.text}, and not in the index")
        if location != locations.get(number, location):
            return Fault(fault.kind, fault.path, f"{fault.text} (event {number} is stored twice)")
        return fault

    none = {number: [FileLocation(str(target.store.event_path(number)))] for number in requested.difference(copies)}
    files = [(number, location) for number, places in sorted((none | copies).items()) for location in places]
    with ThreadPoolExecutor(cores()) as pool:
        for n_checked, fault in enumerate(pool.map(find_fault, *zip(*files, strict=True)), 1):
            if fault is not None:
                faults.append(fault)
            tell(progress, n_checked, len(files))
    return [*faults, *_foreign_files(target)]


def repair(folder: AnyPath, faults: list[Fault]) -> list[int]:
    """Repair the faults that `check` found, leave all else, and return the numbers of the events to make again.

    Damaged events, events of another recipe and leftovers of interrupted processes are removed. Files that do not belong to
    the set may be the user's: they are moved to a folder beside it, ``SET-foreign``. The index is written again.

    Raises
    ------
    InputError
        A copy of an input file is damaged, which only the original can replace; or a file cannot be moved.
    """
    target = SetFolder(folder)
    target.refuse_links()
    for fault in faults:
        if fault.kind == "input":
            raise InputError(f"{fault.text}; put the original back, or make a new set")
    requested = _expected_numbers(target)
    shards = {fault.path for fault in faults}.intersection(target.store.shard_paths())
    for fault in faults:
        if fault.kind == "foreign" and fault.path not in shards:
            _move_aside(fault.path, target)
        elif fault.kind in ("damaged", "another recipe", "leftover") and fault.path not in shards:
            _remove(fault.path, target)
    target.store.unpack(shards=shards)  # which keeps their intact events
    if any(fault.kind == "index" for fault in faults):
        target.index.complete(target.store.locations, requested, redraw=True)
    return sorted({fault.event for fault in faults if fault.event is not None})


def _input_faults(target: SetFolder) -> Iterator[Fault]:
    """Yield a fault for each copy of an input file that is missing or has changed."""
    copies = target.copies()
    for name in target.recipe.files:
        path = copies[name].path if name in copies else target.inputs / INPUT_LIST
        try:
            if name not in copies:
                raise InputError(f"{path}: lists no copy of {name}")
            if copies[name].current_sha256() != copies[name].sha256:
                raise InputError(f"{path}: changed: not the {name} with which the set was begun")
        except InputError as error:
            yield Fault("input", path, str(error))


def _expected_numbers(target: SetFolder) -> list[int]:
    """Return the numbers of the events that the set should have.

    These are the requested events. Where no request is stored, stored events of the set's recipe belong to it as well.
    """
    try:
        requested = target.requested_numbers()
    except InputError:
        requested = []
    if target.requests_path.is_dir() and requested:
        return requested
    locations = target.store.locations()  # the index may have been cut and lack some
    stored = (n for n, location in locations.items() if not requested or target.is_made(n, location))
    return sorted({*requested, *stored})


def index_faults(folder: AnyPath) -> list[Fault]:
    """Return the faults of the index alone, as `check` returns them."""
    target = SetFolder(folder)
    index, locations = target.index, target.store.locations()
    if not index.path.is_file():
        return [Fault("index", index.path, f"{index.path}: missing")] if locations else []
    requested = set(_expected_numbers(target))
    try:
        stored = index.read()
    except InputError:
        stored = {}
    lines = {number: index.line(number) for number in (*stored, *locations) if number in requested}
    if index.path.read_bytes() != index.content(lines):
        return [Fault("index", index.path, f"{index.path}: changed: its rows differ from those that recipe.toml gives")]
    return []


def _event_fault(location: FileLocation, number: int, fingerprint: str) -> Fault | None:
    """Return the fault of an event's file, of which every byte is read; None where it is intact and of this recipe."""
    path = Path(location.path)
    if not path.exists():
        return Fault("missing", path, f"{path}: missing", number)
    try:
        file_header = read_header(location)
        if file_header.recipe != fingerprint:
            text = f"{path}: of another recipe ({file_header.recipe[:8]}…, the set's is {fingerprint[:8]}…)"
            return Fault("another recipe", path, text, number)
        if file_header.event != number:
            return Fault("damaged", path, f"{path}: is event {file_header.event}", number)
        verify(location)
    except InputError as error:
        return Fault("damaged", path, str(error), number)
    return None


def _foreign_files(target: SetFolder) -> Iterator[Fault]:
    """Yield a fault for each file or folder that does not belong to the set, leftovers of interrupted processes included."""
    store = target.store
    inputs = {INPUT_LIST, *(copy.path.name for copy in target.copies().values())}
    # The originals of the input files may lie in the set's folder.
    originals = [Path(os.path.normpath(target.path / name)) for name in target.recipe.files]
    for folder, expected in (
        (target.path, {RECIPE, INDEX, INPUTS, REQUESTS, EVENTS, SHARDS}),
        (target.inputs, inputs),
        (target.requests_path, target.request_names),  # ranges of simultaneous processes may overlap
        (store.events, {store.event_path(number).name for number in store.copies()}),
        (store.shards, {LOCK, *(path.name for path in store.shard_paths())}),
    ):
        for name in sorted(os.listdir(folder)) if folder.is_dir() else ():
            path = folder / name
            if name in expected or any(original.is_relative_to(path) for original in originals):
                continue
            if is_leftover(path):
                yield Fault("leftover", path, f"{path}: left by an interrupted process")
            elif final_name(name) is None:  # otherwise a process is writing it
                yield Fault("foreign", path, f"{path}: does not belong to this set")


def _remove(path: Path, target: SetFolder) -> None:
    """Remove a file of the set; a folder of its name does not belong to the set and is moved aside."""
    if path.is_dir() and not path.is_symlink():
        _move_aside(path, target)
        return
    with refusing(path, "cannot be removed"):
        path.unlink(missing_ok=True)


def _move_aside(path: Path, target: SetFolder) -> None:
    """Move a file that does not belong to a set to the folder ``SET-foreign`` beside the set."""
    foreign_folder = ensure_folder(target.path.with_name(f"{target.path.name}-foreign"))
    destination, number = foreign_folder / path.name, 1
    while os.path.lexists(destination):
        number += 1
        destination = foreign_folder / f"{path.stem}-{number}{path.suffix}"
    with refusing(path, f"cannot be moved to {destination}"):
        path.rename(destination)
