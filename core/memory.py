"""What a job has of memory and processor cores, and checks that it fits before it begins."""

import functools
import itertools
import os
from math import ceil
from pathlib import Path

from .errors import InputError

# The rest is left to other programs.
_USABLE_SHARE = 0.9

# Bytes that are not worth asking the system again, which takes as long as a small projection.
_LITTLE = 2**20

_PROCESS = Path("/proc/self")
# Of Linux's control groups: the file with a limit in bytes, and that with how many are used, page cache included.
_LIMITS = {"memory.max": "memory.current", "memory.limit_in_bytes": "memory.usage_in_bytes"}


def available() -> int:
    """Bytes of memory that can be used without swapping: of the machine's, of the job's control groups, of its `ulimit`."""
    import psutil

    machine, process = psutil.virtual_memory(), psutil.Process()
    left = [int(machine.available)]
    for group, limit in itertools.product(_groups("memory"), _LIMITS):
        most = _text(group / limit)
        if most.isdigit() and int(most) < machine.total:
            stat = dict(line.split() for line in _text(group / "memory.stat").splitlines())
            # What was read of files is given back when it is needed. Version 1's total is of the groups below, too.
            cache = stat.get("total_inactive_file", stat.get("inactive_file", 0))
            left.append(int(most) - int(_text(group / _LIMITS[limit])) + int(cache))
    if hasattr(psutil, "RLIMIT_AS") and (space := process.rlimit(psutil.RLIMIT_AS)[0]) != psutil.RLIM_INFINITY:
        left.append(space - process.memory_info().vms)
    return max(0, min(left))


def cores() -> int:
    """Processor cores that this job may use: its affinity, or a control group's share of time, rounded up."""
    most = [len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1]
    for group in _groups("cpu"):
        in_version_1 = (_text(group / f"cpu.cfs_{name}_us") for name in ("quota", "period"))
        limit = _text(group / "cpu.max") or " ".join(in_version_1)
        quota, _, period = limit.partition(" ")
        if quota.isdigit():  # not "max", nor version 1's -1
            most.append(ceil(int(quota) / int(period)))
    return max(1, min(most))


@functools.cache
def _groups(controller: str) -> list[Path]:
    """This process's folders of a controller of Linux's control groups, from its own up to the root that it sees."""
    lines = [line.split(":", 2) for line in _text(_PROCESS / "cgroup").splitlines()]
    own = {name: path for _, names, path in lines for name in names.split(",")}  # "": version 2, of all controllers
    found: list[Path] = []
    for line in _text(_PROCESS / "mountinfo").splitlines():
        (_, _, _, root, mount, *_), _, (kind, _, options) = (part.split(" ") for part in line.partition(" - "))
        if kind == "cgroup2" or (kind == "cgroup" and controller in options.split(",")):
            path = own.get("" if kind == "cgroup2" else controller, "/")
            # In a container, `root` is its own group; a path outside of what is mounted counts as that.
            inside = Path(path).is_relative_to(root) and ".." not in path
            group = Path(mount, os.path.relpath(path, root) if inside else "")
            found += [each for each in (group, *group.parents) if each.is_relative_to(mount)]
    return found


def _text(path: Path) -> str:
    """What is in a file of the system, or nothing where there is none."""
    try:
        return path.read_text(encoding="utf-8").strip()
    except OSError:
        return ""


def require(n_bytes: float, what: str) -> None:
    """Raise `InputError` if `n_bytes` do not fit; `what` needs them, such as ``"a volume of 9 x 9 x 9 voxels"``."""
    usable = _USABLE_SHARE * available()
    if n_bytes > usable:
        needs = f"{what} needs {readable_size(n_bytes)} of memory, but {readable_size(usable)} can be used"
        raise InputError(f"{needs}: choose fewer voxels or pixels, or free some memory")


class Requirements:
    """`require` for work that is done again and again: what is little, and has fitted once, is not asked for again."""

    def __init__(self) -> None:
        self._fitted: set[str] = set()

    def __call__(self, n_bytes: float, what: str) -> None:
        """See `require`."""
        if n_bytes > _LITTLE or what not in self._fitted:
            require(n_bytes, what)
            self._fitted.add(what)


def readable_size(n_bytes: float) -> str:
    """Bytes as ``"34 KiB"``, ``"12 MiB"`` or ``"3.4 GiB"``."""
    if n_bytes < 2**20:
        return f"{n_bytes / 2**10:.0f} KiB"
    if n_bytes < 2**30:
        return f"{n_bytes / 2**20:.0f} MiB"
    return f"{n_bytes / 2**30:.3g} GiB"
