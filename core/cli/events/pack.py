"""``mphdrr events pack SET`` and ``mphdrr events unpack SET``."""

import argparse

from ...events.folders import SetFolder
from ...events.store import SHARD_BYTES
from ...validation import positive
from ..options import add_command, print_answer, progress_bar


def add_parser(actions) -> None:  # type: ignore[no-untyped-def]
    """Add both actions."""
    pack = add_command(
        actions, "pack", "put the events of a set into shards, tar archives of many events", "mphdrr events pack set"
    )
    pack.add_argument("--gigabytes", type=float, default=SHARD_BYTES / 1e9, metavar="N", help="size of a shard, about")
    unpack = add_command(
        actions, "unpack", "give each event of a set's shards a file of its own again", "mphdrr events unpack set"
    )
    for parser, run in ((pack, _pack), (unpack, _unpack)):
        parser.add_argument("folder", metavar="SET", help="folder of the set")
        parser.add_argument("--json", action="store_true", help="as JSON")
        parser.set_defaults(run=run)


def _pack(arguments: argparse.Namespace) -> None:
    store = _set(arguments).store
    done = store.pack(progress_bar("packing"), int(positive(arguments.gigabytes, "--gigabytes") * 1e9))
    _say(arguments, f"{done} events packed, {len(store.shard_paths())} shards", packed=done)


def _unpack(arguments: argparse.Namespace) -> None:
    done = _set(arguments).store.unpack(progress_bar("unpacking"))
    _say(arguments, f"{done} events have files of their own again", unpacked=done)


def _set(arguments: argparse.Namespace) -> SetFolder:
    folder = SetFolder(arguments.folder)
    _ = folder.recipe  # refuses what is no event set
    return folder


def _say(arguments: argparse.Namespace, text: str, **record: int) -> None:
    print_answer(arguments, record, [f"{arguments.folder}: {text}"])
