"""One contender in a process of its own: reads requests from standard input, one JSON object a line, and answers each.

    python worker.py PEER THREADS

The first answer is ``{"label": ...}`` or ``{"missing": why}``. A request
``{"case": {...}, "task": ..., "volume": ..., "save": path}`` is answered with ``{"seconds": wall clock, "cpu": seconds of
processor time, "memory": MB}``; `memory` is the peak beyond what was there before, less the volume and the images.
"""

from __future__ import annotations

import contextlib
import gc
import json
import os
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from case import Case
from peers import PEERS, cores

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]

MB = 2**20
_UNIT = 1.0 if sys.platform == "darwin" else 1024.0  # of ru_maxrss


def main() -> None:
    """Answer requests until standard input ends."""
    # Libraries may print what they like: their words go to standard error.
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    name, threads = sys.argv[1], int(sys.argv[2])
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, cores()[:threads])

    def answer(**words: Any) -> None:
        print(json.dumps(words), file=answers, flush=True)

    try:
        peer = PEERS[name](threads)
    except ImportError as error:
        answer(missing=str(error).splitlines()[0])
        return
    answer(label=peer.label)
    held, call, before, of_programs = None, None, 0.0, 0.0
    for line in sys.stdin:
        request = json.loads(line)
        case = Case(**request["case"])
        volume = {"volume": request["volume"]} if request.get("volume") else {}
        try:
            if held != (case, request["task"], volume):
                call = None
                gc.collect()
                before, of_programs = resident(), peak_of_programs()
                call = getattr(peer, request["task"])(case, **volume)
                held = (case, request["task"], volume)
            reset_peak()
            wall, processor = time.perf_counter(), cpu_seconds()
            result = call()  # type: ignore[misc]
            wall, processor = time.perf_counter() - wall, cpu_seconds() - processor
            given = 4 * (case.voxels**3 * (2 if request["task"] == "emission" else 1) + case.n_views * case.pixels**2)
            if hasattr(peer, "own_seconds"):  # its own clock leaves something out, which the processor's does not
                wall, processor = peer.own_seconds, None
            if request.get("save"):
                np.save(request["save"], result)
        except Exception as error:
            answer(failed=f"{type(error).__name__}: {str(error).strip().splitlines()[0] if str(error).strip() else ''}")
            continue
        used = peak() - before
        if peak_of_programs() > of_programs:
            used = max(used, peak_of_programs())
        answer(seconds=wall, cpu=processor, memory=max(0.0, used - given) / MB)


def resident() -> float:
    """Return the memory in use, bytes."""
    import psutil

    return float(psutil.Process().memory_info().rss)


def peak() -> float:
    """Return the largest memory in use since `reset_peak`, bytes; where the system does not tell, since the start."""
    status = Path("/proc/self/status")
    if status.is_file():
        return 1024.0 * next(float(s.split()[1]) for s in status.read_text().splitlines() if s.startswith("VmHWM"))
    return 0.0 if resource is None else _UNIT * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def peak_of_programs() -> float:
    """Return the largest memory in use of any program that was called, bytes."""
    return 0.0 if resource is None else _UNIT * resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss


def reset_peak() -> None:
    """Reset the peak that `peak` reads, where the system allows it."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def cpu_seconds() -> float:
    """Return the processor time of all threads and of the programs called, s."""
    return time.process_time() + sum(os.times()[2:4])


if __name__ == "__main__":
    main()
