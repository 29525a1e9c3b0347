"""Actions ``mphdrr events pack SET`` and ``mphdrr events unpack SET``: events in shards, or in files of their own."""

import argparse
from typing import TYPE_CHECKING

from ...validation import positive
from ..options import add_set_action, count_text, print_answer, progress_bar

if TYPE_CHECKING:
    from ...events.folders import SetFolder


def add_parser(actions) -> None:  # type: ignore[no-untyped-def]
    """Add the actions ``events pack`` and ``events unpack``."""
    pack = add_set_action(actions, "pack", _pack)
    pack.add_argument("--gigabytes", type=float, default=1.0, metavar="N", help="approximate size of a shard")
    add_set_action(actions, "unpack", _unpack)


def _pack(arguments: argparse.Namespace) -> None:
    """Put the events of a set into shards, tar archives of many events.

    mphdrr events pack set
    """
    store, size = _open_folder(arguments).store, positive(arguments.gigabytes, "--gigabytes") * 1e9
    n_packed = store.pack(progress_bar("packing"), int(size))
    shards = count_text(len(store.shard_paths()), "shard")
    print_answer(arguments, {"packed": n_packed}, [f"{arguments.folder}: {n_packed} events packed, {shards}"])


def _unpack(arguments: argparse.Namespace) -> None:
    """Give each event of a set's shards a file of its own again.

    mphdrr events unpack set
    """
    count = _open_folder(arguments).store.unpack(progress_bar("unpacking"))
    print_answer(arguments, {"unpacked": count}, [f"{arguments.folder}: {count} events have files of their own again"])


def _open_folder(arguments: argparse.Namespace) -> "SetFolder":
    """Return the folder of the set; raise `InputError` if it holds no event set."""
    from ...events.folders import SetFolder

    folder = SetFolder(arguments.folder)
    _ = folder.recipe  # raises InputError for a folder without an event set
    return folder
