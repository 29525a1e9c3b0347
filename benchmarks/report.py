"""The measurements of `projector.py` as a Markdown page and a plot."""

from __future__ import annotations

import platform
import subprocess
from dataclasses import dataclass
from datetime import date
from pathlib import Path

import numpy as np
import psutil
from case import SIDE, Case, Row

from mphdrr.core.runs.run import versions
from mphdrr.core.version import VERSION

EVENTS = "## Event sets"
"""The heading of the page's last section, which `events.py` writes."""
TITLES = {"forward": "forward", "adjoint": "adjoint", "emission": "emission", "pose_gradient": "pose gradient"}

RECORDED_WORK = (8, 256, 256)  # views, pixels, voxels
RECORDED = [
    "0.1, numba (recorded) | exact | 2 | 9.46 | 14.8 | 21.6 | 23.7 | 2e-06 | 0.000 | 2e-10 | 2e-06 | 2e-05 | 62",
    "0.1, numba (recorded) | exact | 1 | 18.2 | 23.5 | 42.7 | 33.3 | 2e-06 | 0.000 | 1e-10 | 2e-06 | 2e-05 | 7",
]
"""Lines of the table, of that work."""
RECORDED_NOTE = """- *recorded*: version 0.1 of mphDRR, whose kernels numba compiled, in its last run (2026-11-21, AMD EPYC,
  2 cores, Python 3.11.7, numba 0.68.1), not in this one."""


@dataclass(frozen=True)
class Point:
    """One measurement of how time grows."""

    what: str
    case: Case
    task: str
    name: str
    seconds: float


@dataclass(frozen=True)
class Results:
    """All measurements of a run."""

    case: Case
    rows: dict[tuple[str, int], Row]
    missing: dict[str, str]
    scaling: list[Point]
    threads: int
    seconds: float


def write(results: Results, folder: Path) -> None:
    """Write ``benchmarks.md``, and, where matplotlib is installed, ``images/benchmarks.svg``."""
    picture = folder / "images" / "benchmarks.svg"
    drawn = draw(results, picture)
    path = folder / "benchmarks.md"
    _, heading, events = path.read_text(encoding="utf-8").partition(EVENTS) if path.is_file() else ("", "", "")
    text = page(results, picture.relative_to(folder) if drawn else None)
    path.write_text(text + (f"\n{heading}{events}" if heading else ""), encoding="utf-8")
    print(f"{path}" + (f" and {picture}" if drawn else "; for a plot: pip install matplotlib"))


def page(results: Results, picture: Path | None) -> str:
    """Return the page, with a link to the picture if there is one."""
    case = results.case
    parts = [
        "# Benchmarks",
        f"Written by `make bench`, {date.today()}; do not edit. mphDRR {VERSION}.",
        "What the window's main thread takes is in [window](window.md#what-the-window-takes).",
        machine(results),
        f"""The work: {case.n_views} pinhole views of {case.pixels} x {case.pixels} pixels (of modules all over
`examples/dc-spect-80.xlsx`, from the pinhole to the virtual detector at 10 l) through {case.voxels}^3 voxels in a cube of
{SIDE:g} mm around the isocentre. All contenders get the same rays and volumes, each in a process of its own; one works at
a time, in turns, and the best of its turns counts. The slow ones computed one view, once or twice. The volume is noise, so
no voxel can be skipped.""",
        "## Time per view, error, memory",
        table(results),
        "\n".join([NOTES, RECORDED_NOTE]) if has_recorded(case) else NOTES,
        *([f"Not installed, so not measured: {_list(results.missing)}."] if results.missing else []),
        "## Ratios",
        ratios(results),
        *(["## How time grows", growth(results)] if results.scaling else []),
        *([f"![Time per view of all, and how it grows with voxels and rays]({picture.as_posix()})"] if picture else []),
    ]
    return "\n\n".join(parts) + "\n"


NOTES = """- *emission*: counts of the ideal pinhole, attenuated between voxel and pinhole by another volume of noise.
- *pose gradient*: the image and the derivatives of a weighted sum of its pixels by the six parameters of the camera's pose.
- *error*: largest difference from the float64 integral (`backend="numpy"`) of the noise, relative to the largest integral.
  Joseph's method and sampling interpolate: their difference is one of models, not a fault.
- *offset*: displacement of a smooth volume's image in pixels, by least squares; it shows whether the rays are the same,
  whatever the model.
- *mismatch* of forward and adjoint: |<A x, y> - <x, A' y>| / <A x, y>, random x and y.
- *errors of emission, gradient*: largest difference from the float64 result, relative to the largest number. RTK attenuates
  towards the detector, so its counts are not compared.
- *memory*: peak of the process, without its libraries, the volume and the images.
- plastimatch is a program that works on files: the time is the one it reports, without reading and writing.
- A dash: the contender cannot do it, had used a minute before its turn came, or did not finish within two.
- The adjoint of nanodrr and DiffDRR is by autograd and includes a forward projection. They are given 4096 rays at a time."""


def table(results: Results) -> str:
    """Return the table of times, errors and memory."""
    head = [
        "projector", "integral", "threads", *(f"{title} ms" for title in TITLES.values()), "error", "offset px", "mismatch",
        "error of emission", "of gradient", "memory MB",
    ]  # fmt: skip
    lines = []
    for row in sorted(results.rows.values(), key=lambda row: row.seconds.get("forward", float("inf"))):
        lines.append(
            [
                f"**{row.label}**" if row.name == "cpu" else row.label,
                row.model,
                str(row.threads),
                *(_milliseconds(row.seconds.get(task)) for task in TITLES),
                _small(row.errors.get("forward")),
                _number(row.errors.get("offset"), ".3f"),
                _small(row.errors.get("adjoint")),
                _small(row.errors.get("emission")),
                _small(row.errors.get("pose_gradient")),
                _number(row.memory, ".0f"),
            ]
        )
    return _table(head, [*lines, *(line.split(" | ") for line in RECORDED if has_recorded(results.case))])


def has_recorded(case: Case) -> bool:
    """Return whether the work is that of `RECORDED`."""
    return (case.n_views, case.pixels, case.voxels) == RECORDED_WORK


def ratios(results: Results) -> str:
    """Return the table of ratios of mphDRR's times to its peers' and among each other."""
    ours = results.rows.get(("cpu", results.threads))
    if ours is None or "forward" not in ours.seconds:
        return "mphDRR's cpu backend was not measured."
    lines = []
    for name, wanted in (
        ("c", "at most 0.35"),
        ("rtk", "at most 0.2"),
        ("plastimatch", ""),
        ("diffdrr", "at most 0.0033"),
    ):
        other = results.rows.get((name, results.threads))
        if other is not None and "forward" in other.seconds:
            lines.append([f"forward / {other.label}'s", *_ratio(ours, "forward", other, "forward"), wanted])
    for task, wanted in (("adjoint", "at most 1.5"), ("emission", "at most 2.5"), ("pose_gradient", "at most 2")):
        if task in ours.seconds:
            lines.append([f"{TITLES[task]} / own forward", *_ratio(ours, task, ours, "forward"), wanted])
    one = results.rows.get(("cpu", 1))
    if one is not None and one is not ours and "forward" in one.seconds:
        lines.append([f"forward, 1 thread / {results.threads} threads", *_ratio(one, "forward", ours, "forward"), ""])
    words = "Of mphDRR's cpu backend, all threads. Where other work disturbs the run, processor time is more reliable."
    return words + "\n\n" + _table(["", "wall clock", "processor time", "aim"], lines)


def _ratio(a: Row, task: str, b: Row, other: str) -> list[str]:
    wall = f"{a.seconds[task] / b.seconds[other]:.3g}"
    return [wall, f"{a.processor[task] / b.processor[other]:.3g}" if other in b.processor else "–"]


def growth(results: Results) -> str:
    """Return the table of times of mphDRR and of plain C, with the time per voxel that a ray passes."""
    lines = []
    for point in results.scaling:
        case, n = point.case, voxel_steps(point.case)
        labels = {"cpu": "mphDRR, cpu", "c": "plain C"}
        lines.append(
            [
                point.what, f"{case.voxels}^3", f"{case.n_views} x {case.pixels}^2", TITLES[point.task], labels[point.name],
                f"{point.seconds:.3f}", f"{1e9 * point.seconds / n:.2f}",
            ]
        )  # fmt: skip
    head = ["what changes", "voxels", "rays", "task", "projector", "s", "ns per voxel passed"]
    words = f'All {results.threads} threads. "Small object": all but the middle eighth of the volume is 0.'
    return words + "\n\n" + _table(head, lines)


def voxel_steps(case: Case) -> float:
    """Return the approximate number of voxels that the rays of all views pass: the planes crossed along each axis."""
    total = 0.0
    for m in range(case.n_views):
        source, targets = case.views.rays(m)
        along = targets - source
        with np.errstate(divide="ignore"):
            planes = np.sort(np.stack([(side * SIDE / 2 - source) / along for side in (-1, 1)]), axis=0)
        enter, leave = planes[0].max(axis=1).clip(0), planes[1].min(axis=1).clip(None, 1)
        inside = np.abs(along).sum(axis=1) * (leave - enter).clip(0)
        total += float(inside.sum()) / (SIDE / case.voxels)
    return total


def machine(results: Results) -> str:
    """Return a paragraph about the machine and its software, with a warning where it was busy."""
    found = versions()
    names = {"python": "Python", "numpy": "numpy", "torch": "torch", "cpu": "kernels for"}
    software = ", ".join(f"{names[name]} {found[name]}" for name in names if name in found)
    c = results.rows.get(("c", results.threads))
    compiler = ""
    if c is not None:
        compiler = subprocess.run(["cc", "--version"], capture_output=True, text=True).stdout.splitlines()[0]
        compiler = f"; plain C: {compiler}, -O3 -march=native -fopenmp"
    warning = ""
    if c is not None and c.processor.get("forward", 0.0) < 0.8 * results.threads * c.seconds.get("forward", 0.0):
        share = c.processor["forward"] / (results.threads * c.seconds["forward"])
        warning = (
            f"\n\n**The machine was busy with other work**: plain C got {share:.0%} of its cores in its best turn. "
            "Times are too long, and ratios less certain than their digits suggest."
        )
    memory = psutil.virtual_memory().total / 2**30
    return (
        f"The machine: {processor()}, {results.threads} cores, {memory:.0f} GiB, {platform.system()} {platform.machine()}; "
        f"{software}{compiler}. The run took {results.seconds / 60:.1f} minutes.{warning}"
    )


def processor() -> str:
    """Return the processor's name."""
    information = Path("/proc/cpuinfo")
    if information.is_file():
        for line in information.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def draw(results: Results, path: Path) -> bool:
    """Draw the plot to `path`; return False where matplotlib is missing."""
    try:
        import matplotlib
    except ImportError:
        return False
    matplotlib.use("svg")
    import matplotlib.pyplot as plt

    matplotlib.rcParams.update({"svg.hashsalt": "mphdrr", "svg.fonttype": "none", "font.size": 9})
    figure, (bars, voxels, rays) = plt.subplots(1, 3, figsize=(11, 3.6), width_ratios=(1.6, 1, 1), layout="constrained")
    colors = {"forward": "#1f4e79", "adjoint": "#5b9bd5", "emission": "#c55a11", "pose_gradient": "#7f7f7f"}
    rows = [row for row in results.rows.values() if row.threads == results.threads and "forward" in row.seconds]
    rows.sort(key=lambda row: -row.seconds["forward"])
    for i, task in enumerate(TITLES):
        at = np.arange(len(rows)) + 0.3 - 0.2 * i
        bars.barh(at, [1e3 * row.seconds.get(task, 0) for row in rows], 0.2, color=colors[task], label=TITLES[task])
    bars.set_yticks(range(len(rows)), [row.label for row in rows])
    bars.set_xscale("log")
    bars.set_xlabel("ms a view")
    bars.legend(frameon=False)
    for axes, what, size in ((voxels, "voxels", "voxels"), (rays, "rays", "pixels")):
        for name, color, words in (("cpu", colors["forward"], "mphDRR, cpu"), ("c", "#7f7f7f", "plain C")):
            points = [p for p in results.scaling if p.what == what and p.name == name]
            sizes = [getattr(p.case, size) for p in points]
            times = [1e3 * p.seconds / p.case.n_views for p in points]
            axes.loglog(sizes, times, "o-", color=color, label=words, markersize=4)
            axes.set_xticks(sizes, [str(n) for n in sizes], minor=False)
        axes.minorticks_off()
        axes.set_xlabel(f"{size} along each side")
        axes.set_ylabel("forward, ms a view")
        axes.legend(frameon=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, metadata={"Date": None})
    plt.close(figure)
    return True


def _table(head: list[str], lines: list[list[str]]) -> str:
    rows = [head, ["---"] * len(head), *lines]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in rows)


def _milliseconds(seconds: float | None) -> str:
    if seconds is None:
        return "–"
    return f"{1e3 * seconds:.0f}" if seconds >= 0.1 else f"{1e3 * seconds:.3g}"


def _small(number: float | None) -> str:
    return "–" if number is None else f"{number:.0e}" if number else "0"


def _number(number: float | None, form: str) -> str:
    return "–" if number is None or np.isnan(number) else format(number, form)


def _list(missing: dict[str, str]) -> str:
    return "; ".join(f"{label} ({why})" for label, why in missing.items())
