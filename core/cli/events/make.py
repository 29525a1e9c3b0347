"""``mphdrr events make SET -n 1000``."""

from __future__ import annotations

import argparse
import shutil
import time
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

from ... import events
from ...errors import InputError
from ...memory import readable_size
from ..options import print_answer, progress_bar, say
from .action import add_action

if TYPE_CHECKING:
    from ...events.work import Making


def add_parser(actions) -> None:  # type: ignore[no-untyped-def]
    """Add the action."""
    parser = add_action(actions, "make", _run)
    add = parser.add_argument
    add("--recipe", metavar="FILE", help="recipe (.toml) of a new set, whose folder keeps a copy")
    add("-n", "--count", type=int, metavar="N", help="events; default: as many as were asked for before")
    add("--first", type=int, default=0, metavar="I", help="number of the first event")
    add("--workers", type=int, default=1, metavar="N", help="processes, which share the processor's cores")
    text = "only part I of N, for several machines that work on one folder"
    add("--shard", type=_shard, default="1/1", metavar="I/N", help=text)
    text = "let the workers of a Dask cluster make them, which see SET under the same path; local: --workers of this machine"
    add("--dask", metavar="ADDRESS|local", help=text)
    text = "put events into shards, files of many, as they become enough; a set that has shards goes on so"
    add("--pack", action="store_true", help=text)
    add("--quiet", action="store_true", help="say nothing on standard error but warnings")


def chosen_recipe(folder: str, recipe: str | None) -> events.EventRecipe:
    """The recipe in a file, or that of a set's folder."""
    from ...events.folders import SetFolder

    if recipe is not None:
        return events.read_recipe(recipe)
    if Path(folder).is_file():
        advice = f"name the set's folder, and a recipe by --recipe: make set --recipe {folder}"
        raise InputError(f"{folder}: is a file; {advice}")
    if not SetFolder(folder).recipe_path.is_file():
        raise InputError(f"{folder}: it holds no recipe.toml: give --recipe FILE (mphdrr events new writes one)")
    return SetFolder(folder).recipe


def _run(arguments: argparse.Namespace) -> None:
    """Make the events of a set that are missing.

    mphdrr events make set --recipe derenzo.toml -n 1000 --workers 2
    mphdrr events make set
    mphdrr events make set -n 100000 --shard 3/50
    """
    recipe = chosen_recipe(arguments.folder, arguments.recipe)
    options = {name: getattr(arguments, name) for name in ("count", "first", "workers", "shard", "dask", "pack")}
    work = events.making(recipe, arguments.folder, **options)
    done, folder = watched(work, arguments.quiet), work.folder
    there, asked = len(folder.store.locations()), sum(map(len, folder.requested))
    record = {"folder": arguments.folder, "asked": asked, "events": there, "made": done}
    print_answer(arguments, record, [f"{arguments.folder}: {there} of {asked} events, {done} made now"])


def watched(work: Making, quiet: bool) -> int:
    """Do the work, and say how large the set becomes and what is left; the number of events that it made."""
    started, done, size, left = time.monotonic(), 0, 0, ""
    bar = progress_bar("making", lambda: f"{left} left")
    if not quiet:
        say(f"events missing: {len(work.missing)}, {_expected(work)}; {readable_size(_free(work))} are free")
    for made in work:
        done, size = made.done, size + made.size
        share = (made.total - done) / done  # what is left is so many times what was done
        left = f"{readable_size(size * share)}, {_time((time.monotonic() - started) * share)}"
        if done == 1 and not quiet:
            what = f"{readable_size(size)} in {made.seconds:.1f} s; {made.total - 1} more: {left}"
            say(f"event {made.number}: {what}")
        if done in (1, 10, 100, 1000) and size * share > _free(work):
            say(f"warning: only {readable_size(_free(work))} are free on the disk of {work.folder.path}")
        if not quiet:
            bar(done, made.total)
    return done


def _expected(work: Making) -> str:
    """How large the missing events become, by the first ones that are there."""
    from ...events.store import file_size

    missing = len(work.missing)
    sizes = [file_size(location) for location in islice(work.folder.store.locations().values(), 100)]
    if sizes:
        each = sum(sizes) / len(sizes)
        return f"about {readable_size(each)} each, {readable_size(each * missing)} in all"
    raw = work.folder.maker.raw_bytes
    return f"up to {readable_size(raw)} each, {readable_size(raw * missing)} in all, before they are compressed"


def _free(work: Making) -> int:
    """Bytes on the disk of a set."""
    return shutil.disk_usage(work.folder.path).free


def _shard(text: str) -> tuple[int, int]:
    part, _, parts = text.partition("/")
    try:
        return int(part), int(parts)
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected I/N, such as 1/3, got {text}") from None


def _time(seconds: float) -> str:
    """A duration, such as "85 min"."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"
