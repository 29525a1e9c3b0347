"""Making event sets: the same bytes by any number of workers, after any interruption."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import psutil
import pytest

from mphdrr.core import events
from mphdrr.core.progress import Cancelled

from .conftest import WORKBOOK, refused, refused_command
from .small_events import TEXT, small_recipe
from .small_events import WORKBOOK as SMALL_WORKBOOK

COUNT = 6


def tree(folder: Path) -> dict[str, bytes]:
    """Return all files of a folder, hidden ones, too."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory) -> dict[str, bytes]:
    folder = tmp_path_factory.mktemp("undisturbed")
    events.make(small_recipe(folder), folder / "set", COUNT)
    return tree(folder / "set")


def begin(folder: Path, *options: str, **how: Any) -> subprocess.Popen[str]:
    """Begin the command."""
    command = [sys.executable, "-m", "mphdrr", "events", "make", str(folder / "set")]
    command += ["--recipe", str(folder / "small.toml"), "-n", str(COUNT), *options]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=folder, **how)


def test_workers_shards_and_parts_make_the_same_bytes(tmp_path, undisturbed):
    recipe = small_recipe(tmp_path)
    events.make(recipe, tmp_path / "two", COUNT, workers=2)
    assert tree(tmp_path / "two") == undisturbed
    for part in (2, 3, 1):
        made = [made.number for made in events.making(recipe, tmp_path / "shards", COUNT, shard=(part, 3))]
        assert made == [part - 1, part + 2]
    events.make(recipe, tmp_path / "parts", 2, first=4)
    assert events.make(recipe, tmp_path / "parts", COUNT).numbers == list(range(COUNT))
    assert tree(tmp_path / "shards") == tree(tmp_path / "parts") == undisturbed


def is_worker(process: psutil.Process) -> bool:
    try:
        return "spawn_main" in " ".join(process.cmdline())
    except psutil.NoSuchProcess:  # it has just ended
        return False


def events_in(folder: Path) -> list[Path]:
    return list(folder.glob("set/events/[0-9]*"))


@pytest.mark.long
@pytest.mark.parametrize(("options", "kills"), [((), 2), (("--dask", "local"), 1)])
def test_killed_workers_cost_nothing_but_time(tmp_path, undisturbed, options, kills):
    if options:
        pytest.importorskip("distributed")
    small_recipe(tmp_path)
    work = begin(tmp_path, "--workers", "2", *options)
    killed = 0
    while work.poll() is None and killed < kills:
        workers = [child for child in psutil.Process(work.pid).children(recursive=True) if is_worker(child)]
        if workers and events_in(tmp_path):
            workers[0].kill()
            killed += 1
            time.sleep(0.3)
        time.sleep(0.005)
    assert work.wait(600) == 0 < killed, work.communicate()
    assert tree(tmp_path / "set") == undisturbed


def test_a_cluster_that_does_not_answer_is_one_line(tmp_path, capsys, monkeypatch):
    small_recipe(tmp_path)
    words = ["events", "make", tmp_path / "set", "--recipe", tmp_path / "small.toml", "-n", 2, "--quiet", "--dask"]
    pytest.importorskip("distributed")
    monkeypatch.setattr("mphdrr.core.events.dask_work._ANSWER_SECONDS", 1)
    address = "tcp://127.0.0.1:1"
    assert f"--dask {address}: no scheduler answers there" in refused_command(capsys, *words, address)
    monkeypatch.setitem(sys.modules, "distributed", None)
    missing = '--dask: distributed is missing: pip install "mphdrr[dask]"'
    assert missing in refused_command(capsys, *words, "local")


def test_cancelled_work_goes_on(tmp_path, undisturbed):
    recipe = small_recipe(tmp_path)
    # 3 events of 6, and 2 of the 3 others
    for last, call in ((3, events.make), (2, lambda *job, **options: list(events.making(*job, **options)))):

        def stop(done: int, total: int, last: int = last) -> None:
            if done == last:
                raise Cancelled

        with pytest.raises(Cancelled):
            call(recipe, tmp_path / "set", COUNT, progress=stop)
        assert len(events.EventSet(tmp_path / "set")) >= 3
    events.make(recipe, tmp_path / "set", COUNT)
    assert tree(tmp_path / "set") == undisturbed


@pytest.mark.long
@pytest.mark.parametrize(("moments", "workers"), [(6, "1"), (2, "2")])
def test_killed_work_goes_on_bit_for_bit(tmp_path, undisturbed, moments, workers):
    """Killed at random moments of its start, and after random numbers of events, and resumed once."""
    chance = random.Random(4)
    small_recipe(tmp_path)
    started = time.monotonic()
    assert begin(tmp_path, "--workers", workers).wait(600) == 0
    whole = time.monotonic() - started
    left = set()
    for moment in range(moments):
        folder = tmp_path / str(moment)
        small_recipe(folder)
        work = begin(folder, "--workers", workers)
        children: list[psutil.Process] = []
        after = moment % COUNT
        end = time.monotonic() + (chance.uniform(0.2, 1.0) * whole if after == 0 else 60)
        while time.monotonic() < end and work.poll() is None and len(events_in(folder)) < (after or COUNT):
            time.sleep(0.002)
            children = psutil.Process(work.pid).children(recursive=True) or children
        work.send_signal(signal.SIGKILL)
        work.wait()
        psutil.wait_procs(children, timeout=20)
        assert not any(child.is_running() for child in children)  # none is left behind
        left.add(len(events_in(folder)))
        assert begin(folder).wait(600) == 0
        assert tree(folder / "set") == undisturbed
    assert moments < 6 or len(left) > 2  # they were killed at different places


LONG = (
    TEXT.replace('modules = "1-4,21-24"', "")
    .replace(str(SMALL_WORKBOOK), str(WORKBOOK))
    .replace("rows = 14\ncolumns = 16", "rows = 256\ncolumns = 256")
    .replace("voxels = 16\nspacing = 6.0", "voxels = 128\nspacing = 0.8")
    .replace('hole = "point"\npixel_points = 1', 'hole = "rays"\naperture_points = 127\npixel_points = 55')
)
"""Events that take minutes."""


@pytest.mark.long
@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no process groups of this kind")
@pytest.mark.parametrize(
    ("workers", "busy", "whom"),
    [(0, 0.0, "all"), (1, 0.5, "parent"), (2, 3.0, "all")],
    ids=["begins", "starts", "makes"],
)
def test_an_interrupt_ends_two_workers_within_three_seconds(tmp_path, workers, busy, whom):
    """When they begin, and in the middle of an event, as their processor times tell.

    Where other work has the processors, the three seconds are what was computed since the interrupt.
    """
    small_recipe(tmp_path, LONG)
    before = children_seconds()
    work = begin(tmp_path, "--workers", "2", start_new_session=True)
    there: list[psutil.Process] = []
    while len(there) < workers or not (tmp_path / "set").exists() or any(seconds_of(each) < busy for each in there):
        assert work.poll() is None
        time.sleep(0.02)
        there = [child for child in psutil.Process(work.pid).children() if is_worker(child)]
    sent, computed = time.monotonic(), sum(map(seconds_of, [psutil.Process(work.pid), *there]))
    (os.killpg if whom == "all" else os.kill)(work.pid, signal.SIGINT)
    _, said = work.communicate(timeout=600)
    assert min(time.monotonic() - sent, children_seconds() - before - computed) < 3
    assert work.returncode == 130, said
    assert said.splitlines()[-1] == "mphdrr: cancelled; no file is left half-written" and "Traceback" not in said
    assert not psutil.wait_procs(there, timeout=20)[1]
    assert not list(tmp_path.glob("set/events/*")) and not list(tmp_path.glob("set/.*"))


def seconds_of(process: psutil.Process) -> float:
    return sum(process.cpu_times()[:2])


def children_seconds() -> float:
    """Return the processor time, s, of this process's children that have ended, and of theirs."""
    return sum(os.times()[2:4])


def test_workers_that_die_again_and_again_are_refused(tmp_path, monkeypatch):
    recipe = small_recipe(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    (tmp_path / "sitecustomize.py").write_text("import os, sys\nif '--multiprocessing-fork' in sys.argv: os._exit(9)\n")
    words = "event 0: its worker ended 3 times before it was made .*fewer workers"
    refused(lambda: events.make(recipe, tmp_path / "set", 3, workers=2), words)


def test_what_a_worker_refuses_is_one_line(tmp_path, command):
    text = TEXT.replace("pixel_points = 1", 'pixel_points = 1\nattenuation = "phantom"').replace(
        'kind = "points"', 'kind = "points"\nspheres = 3'
    )
    (tmp_path / "small.toml").write_text(text)
    options = ["--recipe", tmp_path / "small.toml", "-n", "3", "--workers", "2"]
    said = command("events", "make", tmp_path / "set", *options, status=1).err
    assert "points: spheres: no such setting; expected counts" in said and "Traceback" not in said


@pytest.fixture
def small_disk(tmp_path):
    """Yield a disk of 400 KiB; where there may be none, skip."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mounted = sys.platform == "linux" and os.geteuid() == 0
    if mounted:
        command = ["mount", "-t", "tmpfs", "-o", "size=400k", "tmpfs", str(disk)]
        mounted = subprocess.run(command, capture_output=True).returncode == 0
    if not mounted:
        pytest.skip("no right to mount a small disk")
    yield disk
    subprocess.run(["umount", str(disk)], check=True)


def test_a_full_disk_ends_with_one_line_and_a_set_that_resumes(tmp_path, small_disk, undisturbed, command):
    small_recipe(tmp_path)
    make = ["events", "make", small_disk / "set", "--recipe", tmp_path / "small.toml", "--quiet"]
    make += ["-n", COUNT, "--workers", 2]
    (small_disk / "other").write_bytes(b"x" * 150_000)
    said = [line for line in command(*make, status=1).err.splitlines() if "warning: only" not in line]
    assert len(said) == 1 and "cannot be written (No space left on device)" in said[0], said
    assert 0 < len(events.EventSet(small_disk / "set")) < COUNT
    assert not list(small_disk.glob("set/events/.*"))
    (small_disk / "other").unlink()
    command(*make)
    assert tree(small_disk / "set") == undisturbed


def test_the_command_says_what_it_does(tmp_path, command):
    small_recipe(tmp_path)
    make = ["events", "make", tmp_path / "set"]
    assert "it holds no recipe.toml: give --recipe FILE" in command(*make, "-n", 2, status=1).err
    said = command(*make, "--recipe", tmp_path / "small.toml", "-n", 2, "--shard", "2/3")
    assert "1 of 2 events, 1 made now" in said.out and "up to" in said.err and "are free" in said.err
    assert "2 of 2 events, 1 made now" in command(*make).out
    assert "shard: expected i/n with i from 1 to n, got 4/3" in command(*make, "--shard", "4/3", status=1).err
    command(*make, "--shard", "x", status=2)


def test_what_is_no_address_of_a_cluster_is_refused_at_once(tmp_path, capsys):
    pytest.importorskip("distributed")
    small_recipe(tmp_path)
    words = ["events", "make", tmp_path / "set", "--recipe", tmp_path / "small.toml", "-n", 2, "--dask"]
    start = time.monotonic()
    for address in (
        "nonsense",
        "host:port",
        "http://127.0.0.1:1",
        "tcp://127.0.0.1:99999",
        "127.0.0.1:-5",
        "..:8786",
        "a b:3",
    ):
        line = refused_command(capsys, *words, address)
        assert line.startswith(f"--dask {address}: expected local, or an address such as tcp://"), line
    assert time.monotonic() - start < 20 and not (tmp_path / "set").exists()
