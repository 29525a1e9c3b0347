"""Action ``mphdrr events make SET -n 1000``: the missing events of a set."""

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
from ..options import add_set_action, print_answer, progress_bar, say

if TYPE_CHECKING:
    from ...events.work import Making


def add_parser(actions) -> None:  # type: ignore[no-untyped-def]
    """Add the action ``events make``."""
    add = add_set_action(actions, "make", _run).add_argument
    add("--recipe", metavar="FILE", help="recipe (.toml) of a new set, whose folder keeps a copy")
    add("-n", "--count", type=int, metavar="N", help="number of events; default: as in the call before")
    add("--first", type=int, default=0, metavar="I", help="number of the first event")
    add("--workers", type=int, default=1, metavar="N", help="processes, which share the processor's cores")
    text = "make only part I of N, for several machines that work on one folder"
    add("--shard", type=_parse_shard, default="1/1", metavar="I/N", help=text)
    text = "use a Dask cluster, whose workers see SET under the same path; local: --workers of this machine"
    add("--dask", metavar="ADDRESS|local", help=text)
    add("--pack", action="store_true", help="put events into shards, files of many events; sets with shards always do")
    add("--quiet", action="store_true", help="say nothing on standard error but warnings")


def chosen_recipe(folder: str, recipe: str | None) -> events.EventRecipe:
    """Return the recipe in a file, or that in the set's folder if `recipe` is None."""
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
    n_made, folder = run_with_reports(work, arguments.quiet), work.folder
    n_events, n_total = len(folder.store.locations()), sum(map(len, folder.requested))
    record = {"folder": arguments.folder, "asked": n_total, "events": n_events, "made": n_made}
    print_answer(arguments, record, [f"{arguments.folder}: {n_events} of {n_total} events, {n_made} made now"])


def run_with_reports(work: Making, quiet: bool) -> int:
    """Make the missing events, print the size of the set and the remaining time, and return the number of events made."""
    start_time, n_done, size, remaining = time.monotonic(), 0, 0, ""
    bar = progress_bar("making", lambda: f"{remaining} left")
    if not quiet:
        say(f"events missing: {len(work.missing)}, {_expected_size(work)}; {readable_size(_free_bytes(work))} are free")
    for progress in work:
        n_done, size = progress.done, size + progress.size
        ratio = (progress.total - n_done) / n_done  # remaining events per event made
        remaining = f"{readable_size(size * ratio)}, {_duration_text((time.monotonic() - start_time) * ratio)}"
        if n_done == 1 and not quiet:
            facts = f"{readable_size(size)} in {progress.seconds:.1f} s; {progress.total - 1} more: {remaining}"
            say(f"event {progress.number}: {facts}")
        if n_done in (1, 10, 100, 1000) and size * ratio > _free_bytes(work):
            say(f"warning: only {readable_size(_free_bytes(work))} are free on the disk of {work.folder.path}")
        if not quiet:
            bar(n_done, progress.total)
    return n_done


def _expected_size(work: Making) -> str:
    """Return the expected size of the missing events as text, from the first events of the set if there are any."""
    from ...events.store import file_size

    missing = len(work.missing)
    if sizes := [file_size(location) for location in islice(work.folder.store.locations().values(), 100)]:
        mean_size = sum(sizes) / len(sizes)
        return f"about {readable_size(mean_size)} each, {readable_size(mean_size * missing)} in all"
    raw = work.folder.maker.raw_bytes
    return f"up to {readable_size(raw)} each, {readable_size(raw * missing)} in all, before they are compressed"


def _free_bytes(work: Making) -> int:
    """Return the free bytes on the disk of a set."""
    return shutil.disk_usage(work.folder.path).free


def _parse_shard(text: str) -> tuple[int, int]:
    """Parse ``I/N``, part and number of parts."""
    part_text, _, count_text = text.partition("/")
    try:
        return int(part_text), int(count_text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected I/N, such as 1/3, got {text}") from None


def _duration_text(seconds: float) -> str:
    """Return a duration as text, such as "85 min"."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"
