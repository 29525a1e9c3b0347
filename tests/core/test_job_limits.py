"""Memory and cores are those of the job: of its control groups, affinity and `ulimit`, not of the machine."""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from mphdrr.core import memory
from mphdrr.core.events.pool import threads_per_worker
from mphdrr.core.rays.parallel import thread_count

from .conftest import WORKBOOK, refused, run_python

MIB = 2**20


@pytest.fixture
def job(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Yield a folder that stands for /sys/fs/cgroup, with /proc/self beside it; `groups` says where a process is."""
    monkeypatch.setattr(memory, "_PROCESS", tmp_path / "proc")
    for kept in (memory._control_groups, memory._limit_files):
        kept.cache_clear()
    yield tmp_path / "sys"
    for kept in (memory._control_groups, memory._limit_files):
        kept.cache_clear()


def groups(job: Path, cgroup: str, mounts: str) -> None:
    proc = job.parent / "proc"
    proc.mkdir()
    (proc / "cgroup").write_text(cgroup)
    (proc / "mountinfo").write_text(f"31 23 0:28 / {job} rw - tmpfs tmpfs rw\n" + mounts.replace("SYS", str(job)))


def files(folder: Path, **texts: object) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in texts.items():
        (folder / name.replace("__", ".")).write_text(f"{text}\n")


VERSION_1 = "36 31 0:33 / SYS/cpu rw - cgroup cgroup rw,cpu,cpuacct\n"
VERSION_2 = "35 31 0:32 / SYS rw,relatime shared:9 - cgroup2 cgroup2 rw\n"


@pytest.mark.parametrize(
    "own, above, left", [(400, 900, 300), (900, 400, 250), ("max", 400, 250), ("max", "max", None)]
)
def test_the_narrowest_group_of_version_2_counts_and_its_page_cache_is_free(job, own, above, left):
    groups(job, "0::/slurm/job_7\n", VERSION_2)
    limits = [limit if limit == "max" else limit * MIB for limit in (own, above)]
    stat = f"anon 1\nactive_file {30 * MIB}\ninactive_file"
    files(job / "slurm/job_7", memory__max=limits[0], memory__current=120 * MIB, memory__stat=f"{stat} {20 * MIB}")
    files(job / "slurm", memory__max=limits[1], memory__current=190 * MIB, memory__stat=f"{stat} {40 * MIB}")
    machine = memory.available()
    if left is None:
        assert machine > 500 * MIB
    else:
        assert machine == left * MIB
        refused(lambda: memory.require((0.9 * left + 1) * MIB, "a volume"), "a volume", f"{0.9 * left:.0f} MiB can be")
        memory.require((0.9 * left - 1) * MIB, "a volume")


@pytest.mark.parametrize("root, path", [("/", "/pbs/42"), ("/docker/ab", "/docker/ab"), ("/", "/../42"), ("/x", "/y")])
def test_groups_of_version_1_are_found_in_containers_too(job, root, path):
    mounts = f"35 31 0:32 {root} SYS/memory rw - cgroup cgroup rw,memory\n"
    groups(job, f"4:memory:{path}\n1:cpu,cpuacct:/some\n0::/\n", mounts + VERSION_1)
    where = job / "memory" / ("pbs/42" if path == "/pbs/42" else "")
    stat = f"inactive_file 3\ntotal_inactive_file {100 * MIB}"
    files(where, memory__limit_in_bytes=600 * MIB, memory__usage_in_bytes=200 * MIB, memory__stat=stat)
    files(job / "memory", memory__usage_in_bytes=200 * MIB, memory__stat=stat)
    if where != job / "memory":
        files(job / "memory", memory__limit_in_bytes=2**63 - 4096)
    assert memory.available() == 500 * MIB


def test_what_is_used_beyond_the_limit_leaves_nothing(job):
    groups(job, "0::/\n", VERSION_2)
    files(job, memory__max=100 * MIB, memory__current=150 * MIB)
    assert memory.available() == 0
    refused(lambda: memory.require(1, "a pixel"), "a pixel needs", "0 KiB can be used")


@pytest.mark.parametrize("version, quota, cores", [
    (2, "max 100000", None), (2, "50000 100000", 1), (2, "130000 100000", 2), (2, "1000 1000000", 1),
    (1, "-1 100000", None), (1, "250000 100000", 3), (1, "9000000 100000", None),
])  # fmt: skip
def test_a_share_of_the_processors_time_is_rounded_up_to_cores(job, monkeypatch, version, quota, cores):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(64)), raising=False)
    if version == 2:
        groups(job, "0::/a/b\n", VERSION_2)
        files(job / "a", cpu__max=quota)
    else:  # quota and period apart
        groups(job, "2:cpu,cpuacct:/q\n", VERSION_1)
        files(job / "cpu/q", **dict(zip(("cpu__cfs_quota_us", "cpu__cfs_period_us"), quota.split(), strict=True)))
    assert memory.cores() == thread_count(None) == (cores or 64)
    assert [threads_per_worker(n) for n in (1, 2, 100)] == [cores or 64, max(1, (cores or 64) // 2), 1]


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="processes have no affinity here")
def test_cores_are_those_that_the_process_may_run_on():
    one = min(os.sched_getaffinity(0))
    said = run_python(f"import os; os.sched_setaffinity(0, [{one}])\nimport mphdrr.core.memory as m; print(m.cores())")
    assert said.stdout.strip() == "1", said.stderr


@pytest.mark.skipif(sys.platform != "linux", reason="ulimit -v holds on Linux")
def test_a_limit_of_address_space_counts():
    said = run_python(
        "import resource, mphdrr.core.memory as m\n"
        "before = m.available()\n"
        "resource.setrlimit(resource.RLIMIT_AS, (2**31, -1))\n"
        "print(0 < m.available() < min(before, 2**31))"
    )
    assert said.stdout.strip() == "True", said.stderr


GROUPS = Path("/sys/fs/cgroup/memory")
EVENTS = f"""
version = 1
[system]
file = {str(WORKBOOK)!r}
modules = "1-8"
[detector]
rows = 32
columns = 32
[truth]
voxels = 320
spacing = 0.75
[[phantoms]]
kind = "nema"
[models.rays]
kind = "transmission"
"""
JOBS = [
    "phantom cylinder --radius 40 --height 80 --voxels 384 --spacing 0.25 -o OUT.nrrd",
    "project WORKBOOK --volume volume.nii.gz --emission --time 1 --hole point --set model.pixel_points=1 "
    "--set model.tolerance=1e6 --noise 1 --size 600 600 -o OUT.h5",
    "reconstruct run.h5 --method cgls --iterations 1 --voxels 320 --spacing 0.4 -o OUT.nii.gz",
    "reconstruct counts.h5 --method osem --subsets 8 --iterations 1 --voxels 256 --spacing 0.4 --hole rays "
    "--aperture-points 1 -o OUT.nii.gz",
    "reconstruct counts.h5 --method bsrem --subsets 4 --iterations 1 --voxels 224 --spacing 0.4 --hole rays "
    "--aperture-points 1 --prior relative-difference --weight 0.1 -o OUT.nii.gz",
    "backproject run.h5 --how product --voxels 320 --spacing 0.3 -o OUT.nii.gz",
    "volume convert volume.nii.gz --spacing 0.25 -o OUT.nii.gz",
    "geometry map WORKBOOK --modules 1 --quantity modules --voxels 384 --spacing 0.6 -o OUT.nii.gz",
    "score large.nii.gz --truth run.h5",
    "events make OUT --recipe events.toml -n 2 --workers 2",
]


def in_group(arguments: list[str], folder: Path, limit: int | None = None) -> tuple[int, str, int]:
    """Return status, errors and peak memory, bytes, of a command in a control group of its own."""
    group = GROUPS / f"mphdrr-test-{os.getpid()}"
    group.mkdir()
    try:
        if limit is not None:
            (group / "memory.limit_in_bytes").write_text(str(limit))
        enter = f"import os; open({str(group / 'cgroup.procs')!r}, 'w').write(str(os.getpid()))"
        code = f"if __name__ == '__main__':\n {enter}; import sys; from mphdrr.addon.cli import main; sys.exit(main())"
        (folder / "entered.py").write_text(code)
        with open(folder / "said", "w+") as said:
            process = subprocess.Popen([sys.executable, "entered.py", *arguments], cwd=folder, stdout=said, stderr=said)
            most = 0
            while process.poll() is None:
                stat = dict(line.split() for line in (group / "memory.stat").read_text().splitlines())
                most = max(most, int(stat["total_rss"]))
                time.sleep(0.005)
            said.seek(0)
            return process.returncode, said.read(), most
    finally:
        for _ in range(200):  # helpers of Python's pools end a little later
            with contextlib.suppress(OSError):
                group.rmdir()
                break
            time.sleep(0.05)


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("jobs")
    (folder / "events.toml").write_text(EVENTS)
    project = f"project {WORKBOOK} --modules 1-8 --volume volume.nii.gz --size 48 48 --quantity activity"
    for command in (
        "phantom cylinder --radius 40 --height 80 --voxels 48 --spacing 2 -o volume.nii.gz",
        "phantom cylinder --radius 40 --height 80 --voxels 320 --spacing 0.3 -o large.nii.gz",
        f"{project} -o run.h5",
        f"{project} --emission --time 60 --hole point --set model.pixel_points=1 --set model.tolerance=1e6 -o counts.h5",
    ):
        subprocess.run([sys.executable, "-m", "mphdrr", *command.split()], cwd=folder, check=True)
    return folder


@pytest.mark.long
@pytest.mark.skipif(
    not os.access(GROUPS / "memory.limit_in_bytes", os.W_OK), reason="no control groups of version 1 to make here"
)
@pytest.mark.parametrize("job", JOBS)
def test_a_job_with_half_the_memory_that_it_needs_says_so_in_one_line_and_leaves_nothing(job, inputs, tmp_path):
    words = [str(WORKBOOK) if word == "WORKBOOK" else word.replace("OUT", f"{tmp_path}/out") for word in job.split()]
    status, said, most = in_group(words, inputs)
    assert status == 0, said
    assert most > 250 * MIB  # mostly what the job needs, not Python
    for path in tmp_path.iterdir():
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    status, said, _ = in_group(words, inputs, most // 2)
    lines = [line for line in said.splitlines() if "warning: " not in line]
    assert status == 1 and len(lines) == 1 and " of memory, but " in lines[0], (status, said)
    assert not list(tmp_path.iterdir())


def test_tasks_that_have_tasks_end():
    """Each task of as many as there are threads asks the same threads for more, as reconstructions of several events do."""
    code = (
        "from mphdrr.core.rays.parallel import in_order\n"
        "outer = lambda i: sum(in_order(lambda j: i * j, range(50), 2))\n"
        "print(list(in_order(outer, range(20), 2)))"
    )
    assert run_python(code, timeout=60).stdout.strip() == str([1225 * i for i in range(20)])
