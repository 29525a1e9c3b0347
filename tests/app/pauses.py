"""How long the window stands still, for the scripts in it."""

import itertools
import time
from collections.abc import Iterator
from pathlib import Path

from driving import drawn, ours, seen

beats: list[float] = []


def own_time() -> float:
    """Return the time, s, without that in which this thread could run but had no processor (Linux counts it)."""
    try:
        waited = int(Path("/proc/thread-self/schedstat").read_text().split()[1])
    except OSError:
        waited = 0
    return time.perf_counter() - waited * 1e-9


def beat() -> float:
    """Note the time, as a timer whose pauses are measured, and the words of the running job."""
    beats.append(own_time())
    current = ours("addon.blender.jobs")._current
    if current is not None and current.text not in seen["words"]:
        seen["words"].append(current.text)
    return 0.02


def longest_pause() -> float:
    """Return the longest pause between two beats, s."""
    return max(b - a for a, b in itertools.pairwise(beats))


def pause_beyond_redraw() -> Iterator[float]:
    """Yield seconds to wait; return the longest pause since the beats were cleared, less that of a redraw."""
    during = longest_pause()
    beats.clear()
    yield from drawn(3)
    return round(during - longest_pause(), 3)
