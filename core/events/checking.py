"""What is in a set's folder, and whether it is whole: every byte of every file."""

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
from .event_files import Place, header, verify
from .folders import ASKED, INDEX, INPUT_LIST, INPUTS, RECIPE, SetFolder
from .index import column
from .store import EVENTS, LOCK, SHARDS


@dataclass(frozen=True)
class Fault:
    """Something that is wrong in a set."""

    kind: str  # "missing", "damaged", "another recipe", "leftover", "foreign", "index" or "input"
    path: Path
    text: str  # one line
    event: int | None = None  # that `repair` makes anew


@dataclass(frozen=True)
class Status:
    """What is in a set, by the names and headers of its files."""

    asked: int  # events
    made: int
    missing: list[int]
    size: int  # bytes of the events
    phantoms: dict[str, int]  # events made, by phantom
    splits: dict[str, int]  # and by split
    builds: dict[str, int]  # and by the build of mphDRR that made them; "" of earlier versions
    shards: int = 0  # files of many events


def status(folder: AnyPath) -> Status:
    """What is in a set; events count if their files have the length and recipe that they should (`check` reads all bytes).

    `InputError` where the folder is no event set.
    """
    target = SetFolder(folder)
    fingerprint = target.recipe.fingerprint
    headers = {number: target.header(number, place) for number, place in target.places.items()}
    made = {number: found for number, found in headers.items() if found is not None and found.recipe == fingerprint}
    asked = target.planned() or list(made)
    made = {number: made[number] for number in asked if number in made}
    rows = [target.line(number) for number in made]
    return Status(
        asked=len(asked),
        made=len(made),
        missing=[number for number in asked if number not in made],
        size=sum(found.size for found in made.values()),
        phantoms=dict(sorted(Counter(column(row, 1) for row in rows).items())),
        splits=dict(sorted(Counter(column(row, 2) or "none" for row in rows).items())),
        builds=dict(sorted(Counter(found.build for found in made.values()).items())),
        shards=len(target.store.shard_paths()),
    )


def check(folder: AnyPath, progress: Progress | None = None) -> list[Fault]:
    """All faults of a set: every byte of every file is read. Empty where there are none.

    Found are events that are missing, cut, changed, or of another recipe; files that do not belong to the set, and those
    that an interrupted work left; an index or a copy of an input that is not as it was written.

    Parameters
    ----------
    folder
        The set's.
    progress
        Called as ``progress(events read, events)``; may raise `Cancelled`.

    Raises
    ------
    InputError
        The folder is no event set, or its recipe cannot be understood any more.
    """
    target = SetFolder(folder)
    faults = list(_inputs(target))
    if faults:  # what events should be is not known without them
        return faults
    faults += index_faults(folder)
    planned, places = set(_planned(target)), target.store.places()
    fingerprint = target.recipe.fingerprint

    def faults_of(number: int) -> Fault | None:
        place = places.get(number, Place(str(target.store.event_path(number))))
        fault = _event_fault(place, number, fingerprint)
        if fault is None or number in planned:
            return fault
        return Fault("foreign", fault.path, f"{fault.text}, and not in the index")  # nobody asked for it

    numbers = sorted({*planned, *places})
    with ThreadPoolExecutor(cores()) as pool:
        for done, fault in enumerate(pool.map(faults_of, numbers), 1):
            if fault is not None:
                faults.append(fault)
            tell(progress, done, len(numbers))
    return [*faults, *_foreign(target)]


def repair(folder: AnyPath, faults: list[Fault]) -> list[int]:
    """Mend what `check` found, and touch nothing else; the numbers of the events that are to be made again.

    Damaged events and those of another recipe are removed, leftovers of interrupted works too. Files that do not belong to
    the set may be the user's: they move to a folder beside it, ``SET-foreign``. The index is written anew.

    Raises
    ------
    InputError
        A copy of an input is damaged: only its original can replace it; or a file cannot be moved.
    """
    target = SetFolder(folder)
    for fault in faults:
        if fault.kind == "input":
            raise InputError(f"{fault.text}; put the original back, or make a new set")
    planned = _planned(target)
    shards = {fault.path for fault in faults if fault.path.parent == target.store.shards and fault.event is not None}
    if shards:
        target.store.unpack(shards=shards)  # what is whole in them stays
    for fault in faults:
        if fault.kind == "foreign":
            _move(fault.path, target)
        elif fault.kind in ("damaged", "another recipe", "leftover") and fault.path not in shards:
            _remove(fault.path, target)
    if any(fault.kind == "index" for fault in faults):
        target.index.complete(target.store.places, planned, anew=True)
    return sorted({fault.event for fault in faults if fault.event is not None})


def _inputs(target: SetFolder) -> Iterator[Fault]:
    """Copies of what the recipe names that are missing or not as they were."""
    copies = target.copies()
    for name in target.recipe.files:
        path = copies[name].path if name in copies else target.inputs / INPUT_LIST
        try:
            if name not in copies:
                raise InputError(f"{path}: it has no copy of {name}")
            if copies[name].current_sha256() != copies[name].sha256:
                raise InputError(f"{path}: changed: it is not the {name} that the set was begun with")
        except InputError as error:
            yield Fault("input", path, str(error))


def _planned(target: SetFolder) -> list[int]:
    """The events that the set should have: those asked for; where nothing says these, all that are there of its recipe."""
    try:
        asked = target.planned()
    except InputError:
        asked = []
    if target.asked_path.is_dir() and asked:
        return asked
    places = target.store.places()  # of which the index may have been cut
    return sorted({*asked, *(n for n, place in places.items() if not asked or target.is_made(n, place))})


def index_faults(folder: AnyPath) -> list[Fault]:
    """What is wrong with the index alone, as `check` says it."""
    target = SetFolder(folder)
    index, made = target.index, target.store.places()
    if not index.path.is_file():
        return [Fault("index", index.path, f"{index.path}: missing")] if made else []
    planned = set(_planned(target))
    try:
        there = index.read()
    except InputError:
        there = {}
    wanted = {number: index.line(number) for number in (*there, *made) if number in planned}
    if index.path.read_bytes() != index.text(wanted):
        text = f"{index.path}: changed: it is not what recipe.toml says of these events"
        return [Fault("index", index.path, text)]
    return []


def _event_fault(place: Place, number: int, fingerprint: str) -> Fault | None:
    path = Path(place.path)
    if not path.exists():
        return Fault("missing", path, f"{path}: missing", number)
    try:
        found = header(place)
        if found.recipe != fingerprint:
            text = f"{path}: of another recipe ({found.recipe[:8]}…, the set's is {fingerprint[:8]}…)"
            return Fault("another recipe", path, text, number)
        if found.event != number:
            return Fault("damaged", path, f"{path}: it is event {found.event}", number)
        verify(place)
    except InputError as error:
        return Fault("damaged", path, str(error), number)
    return None


def _foreign(target: SetFolder) -> Iterator[Fault]:
    """Files and folders that do not belong to the set."""
    store = target.store
    inputs = {INPUT_LIST, *(copy.path.name for copy in target.copies().values())}
    # They may lie beside the recipe.
    originals = [Path(os.path.normpath(target.path / name)) for name in target.recipe.files]
    for folder, known in (
        (target.path, {RECIPE, INDEX, INPUTS, ASKED, EVENTS, SHARDS}),
        (target.inputs, inputs),
        (target.asked_path, target.asked_names),  # of works that began at once some may lie within others
        (store.events, {store.event_path(number).name for number in store.alone()}),
        (store.shards, {LOCK, *(path.name for path in store.shard_paths())}),
    ):
        for name in sorted(os.listdir(folder)) if folder.is_dir() else ():
            path = folder / name
            if name in known or any(original.is_relative_to(path) for original in originals):
                continue
            if is_leftover(path):
                yield Fault("leftover", path, f"{path}: left by a work that was interrupted")
            elif final_name(name) is None:  # else it is under way
                yield Fault("foreign", path, f"{path}: not of this set")


def _remove(path: Path, target: SetFolder) -> None:
    """Remove a file of the set; a folder in its place is not the set's, and moves."""
    if path.is_dir() and not path.is_symlink():
        _move(path, target)
        return
    with refusing(path, "cannot be removed"):
        path.unlink(missing_ok=True)


def _move(path: Path, target: SetFolder) -> None:
    """Move what does not belong to a set to a folder beside it."""
    beside = ensure_folder(target.path.with_name(f"{target.path.name}-foreign"))
    new, number = beside / path.name, 1
    while new.exists():
        number += 1
        new = beside / f"{path.stem}-{number}{path.suffix}"
    with refusing(path, f"cannot be moved to {new}"):
        path.rename(new)
