"""Event sets on clusters: a Dask scheduler with workers that die, and a disk that is lost while events are made."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time

import pytest

from mphdrr.core import events

from .small_events import small_recipe
from .test_event_work import begin, tree

COUNT = 8
pytestmark = pytest.mark.long

# Calls of files below a folder fail with "Input/output error" once a file named in the environment exists.
LOST = r"""
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

static int lost(const char *path) {
    const char *folder = getenv("LOST_FOLDER"), *when = getenv("LOST_WHEN");
    if (!folder || !when || !path || strncmp(path, folder, strlen(folder))) return 0;
    if (access(when, F_OK)) return 0;
    errno = EIO;
    return 1;
}

static int lost_open(int file) {
    char link[64], path[4096];
    snprintf(link, sizeof link, "/proc/self/fd/%d", file);
    ssize_t n = readlink(link, path, sizeof path - 1);
    if (n < 0) return 0;
    path[n] = 0;
    return lost(path);
}

#define OPEN(name) int name(const char *path, int flags, ...) { \
    va_list rest; va_start(rest, flags); int mode = va_arg(rest, int); va_end(rest); \
    static int (*real)(const char *, int, ...); if (!real) real = dlsym(RTLD_NEXT, #name); \
    return lost(path) ? -1 : real(path, flags, mode); }
OPEN(open)
OPEN(open64)

ssize_t write(int file, const void *data, size_t n) {
    static ssize_t (*real)(int, const void *, size_t); if (!real) real = dlsym(RTLD_NEXT, "write");
    return lost_open(file) ? -1 : real(file, data, n); }
int fsync(int file) {
    static int (*real)(int); if (!real) real = dlsym(RTLD_NEXT, "fsync");
    return lost_open(file) ? -1 : real(file); }
int rename(const char *from, const char *to) {
    static int (*real)(const char *, const char *); if (!real) real = dlsym(RTLD_NEXT, "rename");
    return lost(from) ? -1 : real(from, to); }
int unlink(const char *path) {
    static int (*real)(const char *); if (!real) real = dlsym(RTLD_NEXT, "unlink");
    return lost(path) ? -1 : real(path); }
"""


@pytest.fixture
def wanted(tmp_path) -> dict[str, bytes]:
    events.make(small_recipe(tmp_path), tmp_path / "alone", COUNT)
    return tree(tmp_path / "alone")


def wait_for(done, seconds: float = 600) -> None:
    end = time.monotonic() + seconds
    while not done():
        assert time.monotonic() < end
        time.sleep(0.02)


def test_a_scheduler_makes_the_same_bytes_though_one_of_its_workers_dies(tmp_path, wanted):
    pytest.importorskip("distributed")
    address = tmp_path / "scheduler.json"
    python, begun = [sys.executable, "-m"], []
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "cwd": tmp_path}
    try:
        scheduler = ["distributed.cli.dask_scheduler", "--port", "0", "--no-dashboard", "--host", "127.0.0.1"]
        begun.append(subprocess.Popen([*python, *scheduler, "--scheduler-file", str(address)], **quiet))
        wait_for(address.exists)
        worker = ["distributed.cli.dask_worker", "--nthreads", "1", "--no-dashboard", "--no-nanny"]
        begun += [subprocess.Popen([*python, *worker, "--scheduler-file", str(address)], **quiet) for _ in range(2)]

        work = begin(tmp_path, "-n", str(COUNT), "--quiet", "--dask", json.loads(address.read_text())["address"])
        wait_for(lambda: list(tmp_path.glob("set/events/*.h5")))
        begun[1].kill()
        assert work.wait(600) == 0, work.communicate()
    finally:
        for process in reversed(begun):
            process.kill()
    assert tree(tmp_path / "set") == wanted


@pytest.mark.parametrize("workers", ["1", "2"])
def test_a_lost_disk_ends_in_one_line_and_the_set_resumes(tmp_path, wanted, workers):
    if sys.platform != "linux":
        pytest.skip("the calls of files are replaced as Linux does it")
    pytest.importorskip("ziglang")
    (tmp_path / "lost.c").write_text(LOST)
    library, marker = tmp_path / "lost.so", tmp_path / "now"
    compiler = [sys.executable, "-m", "ziglang", "cc", "-shared", "-fPIC", "-O1"]
    subprocess.run([*compiler, "-o", str(library), str(tmp_path / "lost.c")], check=True)

    shim = {"LD_PRELOAD": str(library), "LOST_FOLDER": str(tmp_path / "set"), "LOST_WHEN": str(marker)}
    make = (tmp_path, "-n", str(COUNT), "--quiet", "--workers", workers)
    work = begin(*make, env=os.environ | shim)
    wait_for(lambda: len(list(tmp_path.glob("set/events/0*.h5"))) >= 2)
    marker.touch()
    _, said = work.communicate(timeout=600)
    assert work.returncode == 1
    assert len(said.splitlines()) == 1 and said.startswith("mphdrr: ") and "Input/output error" in said, said
    marker.unlink()
    assert begin(*make).wait(600) == 0
    assert tree(tmp_path / "set") == wanted
