"""What many events cost: the work of a set's folder per event by their number, and reading at training speed.

    python benchmarks/event_store.py [--counts 1000 10000 100000] [--events 24] [--output FOLDER]

The folder's work is measured with small files in place of events' (a seal, and a kilobyte). Reading: full-size events (256^3
truth, 80 views of 256 x 256 with noise), each in a file of its own and in shards, through a DataLoader with two workers.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import events as cases

import mphdrr.core as mph
from mphdrr.core import hdf5
from mphdrr.core.events.folders import SetFolder
from mphdrr.core.version import build

SHARDS = 50


def timed(call: Callable[[], Any]) -> tuple[float, Any]:
    """Return the wall time of a call, s, and its result."""
    started = time.perf_counter()
    found = call()
    return time.perf_counter() - started, found


def many(folder: Path, count: int) -> mph.events.EventRecipe:
    """Make a set of `count` small events, of which the last fiftieth is missing, and return its recipe."""
    recipe = mph.events.EventRecipe(cases.recipe("line integrals", 16, 8).text + "[splits]\ntrain = 0.8\ntest = 0.2\n")
    target = SetFolder(folder)
    target.prepare(recipe, [range(count)], [])
    body = bytes(1000)
    for number in range(count - count // 50):
        fields = {"event": str(number), "recipe": target.recipe.fingerprint, "build": build()}
        seal = hdf5.Seal("mphDRR event", len(body), fields)
        table = hdf5.digests(body)
        seal = seal.signed(table)
        target.store.event_path(number).write_bytes(seal.text() + body + table)
    target.complete_index()
    return recipe


def memory(folder: Path, count: int) -> float:
    """Return the peak memory, MB, of a process that begins a shard of a set, on Linux."""
    code = (
        "import re, sys, mphdrr.core as mph; recipe = mph.events.read_recipe(sys.argv[1] + '/recipe.toml')\n"
        f"mph.events.making(recipe, sys.argv[1], {count}, shard=(7, {SHARDS}))\n"
        "print(int(re.search(r'VmHWM:\\s*(\\d+)', open('/proc/self/status').read())[1]) / 1e3)"  # not that of its parent
    )
    return float(subprocess.run([sys.executable, "-c", code, str(folder)], capture_output=True, check=True).stdout)


def folder_work(count: int, place: str) -> None:
    """Print the seconds of the operations that look at a whole set."""
    with tempfile.TemporaryDirectory(dir=place) as name:
        folder = Path(name) / "set"
        recipe = many(folder, count)
        start, work = timed(lambda: mph.events.making(recipe, folder, count, shard=(7, SHARDS)))
        made = list(work)
        each = sum(one.seconds for one in made)
        more, _ = timed(lambda: work.folder.index.add(count - 1))
        checked, _ = timed(lambda: mph.events.status(folder))
        opened, there = timed(lambda: mph.events.EventSet(folder))
        split, _ = timed(lambda: there.split("train"))
        print(
            f"| {count:,} | {start:.2f} | {1e3 * more:.2f} | {checked:.2f} | {opened + split:.2f} | "
            f"{memory(folder, count):.0f} | {len(made)} made, {each:.2f} s",
            flush=True,
        )


def reading(count: int, place: str) -> None:
    """Print events per second through a loader of two workers, and processor time in one process, from files and shards."""
    import torch

    torch.set_num_threads(1)  # as in a loader's workers
    with tempfile.TemporaryDirectory(dir=place) as name, warnings.catch_warnings():
        warnings.simplefilter("ignore", mph.InputWarning)
        folder = Path(name) / "set"
        there = mph.events.make(cases.recipe("emission", 256, 256), folder, count)
        for form in ("a file each", "shards"):
            if form == "shards":
                SetFolder(folder).store.pack()
                there = mph.events.EventSet(folder)
            for crop in (None, 64):
                fields = ("images", "truth") if crop is None else ("truth",)
                noise = "epoch" if crop is None else None
                dataset = mph.events.torch_dataset(there + there, fields, crop=crop, noise=noise)
                loader = torch.utils.data.DataLoader(dataset, batch_size=4, num_workers=2, persistent_workers=True)
                list(loader)
                seconds, _ = timed(lambda loader=loader: list(map(len, loader)))
                worked = time.process_time()
                for place in range(count):
                    dataset[place]
                each = (time.process_time() - worked) / count
                what = "truth and noisy counts" if crop is None else "parts of 64^3 of the truth"
                print(
                    f"{form}, {what}: {2 * count / seconds:.1f} events/s, {1e3 * each:.0f} ms of a core each",
                    flush=True,
                )


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--counts", type=int, nargs="+", default=[1000, 10_000, 100_000])
    parser.add_argument("--events", type=int, default=24)
    parser.add_argument("--output", default=tempfile.gettempdir())
    arguments = parser.parse_args()
    print("| events | a shard of 50 starts, s | index row, ms | status, s | opening, s | MB | |")
    for count in arguments.counts:
        folder_work(count, arguments.output)
    reading(arguments.events, arguments.output)


if __name__ == "__main__":
    main()
