"""``mphdrr events pack SET`` and ``mphdrr events unpack SET``."""

import argparse
from typing import TYPE_CHECKING

from ...validation import positive
from ..options import add_set_action, counted, print_answer, progress_bar

if TYPE_CHECKING:
    from ...events.folders import SetFolder


def add_parser(actions) -> None:  # type: ignore[no-untyped-def]
    """Add both actions."""
    pack = add_set_action(actions, "pack", _pack)
    pack.add_argument("--gigabytes", type=float, default=1.0, metavar="N", help="size of a shard, about")
    add_set_action(actions, "unpack", _unpack)


def _pack(arguments: argparse.Namespace) -> None:
    """Put the events of a set into shards, tar archives of many events.

    mphdrr events pack set
    """
    store, size = _set(arguments).store, positive(arguments.gigabytes, "--gigabytes") * 1e9
    done = store.pack(progress_bar("packing"), int(size))
    shards = counted(len(store.shard_paths()), "shard")
    print_answer(arguments, {"packed": done}, [f"{arguments.folder}: {done} events packed, {shards}"])


def _unpack(arguments: argparse.Namespace) -> None:
    """Give each event of a set's shards a file of its own again.

    mphdrr events unpack set
    """
    done = _set(arguments).store.unpack(progress_bar("unpacking"))
    print_answer(arguments, {"unpacked": done}, [f"{arguments.folder}: {done} events have files of their own again"])


def _set(arguments: argparse.Namespace) -> "SetFolder":
    from ...events.folders import SetFolder

    folder = SetFolder(arguments.folder)
    _ = folder.recipe  # refuses what is no event set
    return folder
