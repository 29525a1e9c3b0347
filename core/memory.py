"""Memory and processor cores that this job may use, and checks that its arrays fit before it begins."""

import functools
import os
from math import ceil
from pathlib import Path

from .errors import InputError

_USABLE_SHARE = 0.9  # share of the available memory; the rest is left to other programs

# Needs of up to so many bytes are checked once alone, because asking the system takes as long as a small projection.
_LITTLE = 2**20

_PROCESS = Path("/proc/self")
# Files of Linux's control groups: the one with a limit in bytes, and the one with the bytes in use, page cache included.
_LIMITS = {"memory.max": "memory.current", "memory.limit_in_bytes": "memory.usage_in_bytes"}


def available() -> int:
    """Return the bytes of memory that can be used without swapping.

    It is the least of the machine's available memory, the rest of the limits of the job's control groups, and the rest of
    its `ulimit`.
    """
    import psutil

    machine = psutil.virtual_memory()
    free = [int(machine.available)]
    for file in _limit_files():
        limit = _read_text(file)
        if limit.isdigit() and int(limit) < machine.total:
            stat = dict(line.split() for line in _read_text(file.with_name("memory.stat")).splitlines())
            # The page cache is freed when memory is needed. In version 1 the total includes the groups below.
            cache = stat.get("total_inactive_file", stat.get("inactive_file", 0))
            free.append(int(limit) - int(_read_text(file.with_name(_LIMITS[file.name]))) + int(cache))
    if hasattr(psutil, "RLIMIT_AS"):
        from resource import RLIM_INFINITY, RLIMIT_AS, getrlimit  # quicker than those of a `psutil.Process`

        if (space := getrlimit(RLIMIT_AS)[0]) != RLIM_INFINITY:
            free.append(space - psutil.Process().memory_info().vms)
    return max(0, min(free))


def cores() -> int:
    """Return the processor cores that this job may use: its affinity, or a control group's share of time, rounded up."""
    limits = [len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1]
    for group in _control_groups("cpu"):
        version_1 = (_read_text(group / f"cpu.cfs_{name}_us") for name in ("quota", "period"))
        limit = _read_text(group / "cpu.max") or " ".join(version_1)
        quota, _, period = limit.partition(" ")
        if quota.isdigit():  # "max", and -1 in version 1, is no limit
            limits.append(ceil(int(quota) / int(period)))
    return max(1, min(limits))


@functools.cache
def _limit_files() -> list[Path]:
    """Return the files that hold the memory limits of this process's control groups."""
    files = (group / name for group in _control_groups("memory") for name in _LIMITS)
    return [file for file in files if os.access(file, os.R_OK)]


@functools.cache
def _control_groups(controller: str) -> list[Path]:
    """Return the folders of this process's Linux control groups for `controller`, from its own up to the visible root."""
    lines = [line.split(":", 2) for line in _read_text(_PROCESS / "cgroup").splitlines()]
    paths = {name: path for _, names, path in lines for name in names.split(",")}  # version 2: "" for all controllers
    groups: list[Path] = []
    for line in _read_text(_PROCESS / "mountinfo").splitlines():
        (_, _, _, root, mount, *_), _, (kind, _, options) = (part.split(" ") for part in line.partition(" - "))
        if kind == "cgroup2" or (kind == "cgroup" and controller in options.split(",")):
            path = paths.get("" if kind == "cgroup2" else controller, "/")
            # In a container, `root` is the container's own group; a path outside the mounted tree is taken as that group.
            inside = Path(path).is_relative_to(root) and ".." not in path
            group = Path(mount, os.path.relpath(path, root) if inside else "")
            groups += [folder for folder in (group, *group.parents) if folder.is_relative_to(mount)]
    return groups


def _read_text(path: Path) -> str:
    """Return the text of a file of the system, or "" if it cannot be read."""
    try:
        return path.read_text(encoding="utf-8").strip()
    except OSError:
        return ""


def require(n_bytes: float, purpose: str) -> None:
    """Raise `InputError` if `n_bytes` do not fit into memory.

    `purpose` is what needs them, the subject of the message, such as "a volume of 9 x 9 x 9 voxels".
    """
    usable = _USABLE_SHARE * available()
    if n_bytes > usable:
        needs = f"{purpose} needs {readable_size(n_bytes)} of memory, but {readable_size(usable)} can be used"
        raise InputError(f"{needs}: choose fewer voxels or pixels, or free some memory")


class Requirements:
    """Memory check for repeated work: `require`, but a small need whose purpose has fitted once is not checked again."""

    def __init__(self) -> None:
        self._fitted: set[str] = set()

    def __call__(self, n_bytes: float, purpose: str) -> None:
        """Raise `InputError` if `n_bytes` for `purpose` do not fit into memory."""
        if n_bytes > _LITTLE or purpose not in self._fitted:
            require(n_bytes, purpose)
            self._fitted.add(purpose)


def readable_size(n_bytes: float) -> str:
    """Return a number of bytes as a text such as "34 KiB", "12 MiB" or "3.4 GiB"."""
    if n_bytes < 2**20:
        return f"{n_bytes / 2**10:.0f} KiB"
    if n_bytes < 2**30:
        return f"{n_bytes / 2**20:.0f} MiB"
    return f"{n_bytes / 2**30:.3g} GiB"
