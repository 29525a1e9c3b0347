"""Speed, accuracy and memory of the projector beside its peers, on the same rays, in one run: `make bench`.

    python benchmarks/projector.py [--quick] [--no-growth] [--only cpu,c,rtk] [--output FOLDER]

Every contender (`peers.py`) works in a process of its own (`worker.py`), with one thread and with one per core. They take
turns, one at a time, several rounds; the best time of each counts. The slow ones get one view and few turns.
Writes `benchmarks.md` and a plot of it. Peers that are not installed are named and left out; those that pip has:
``pip install '.[bench]'``.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import report
from beside import tell
from case import Case, Row, reference, save_volumes
from peers import PEERS, TASKS, cores, set_thread_variables

ROOT = Path(__file__).parents[1]
PATIENCE = 3.0  # s: what takes longer has one turn
ENOUGH = 60.0  # s: a slow contender that has taken this long is asked for nothing more
TOO_LONG = 120.0  # s: a contender that has not answered one request by then is ended


class Worker:
    """A contender's process."""

    def __init__(self, name: str, threads: int) -> None:
        self.name, self.threads = name, threads
        self._spent = 0.0  # s, on all requests
        environment = dict(os.environ)
        set_thread_variables(environment, threads)
        command = [sys.executable, str(Path(__file__).with_name("worker.py")), name, str(threads)]
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            env=environment,
        )
        self.label = ""

    def wait(self) -> str | None:
        """Wait until the process is ready; return the reason why the contender is missing, or None."""
        first = self._read()
        self.label = first.get("label", "")
        return first.get("missing", first.get("failed"))

    def measure(self, case: Case, task: str, **request: Any) -> dict[str, Any]:
        """Ask the process to do a task of a case; return its answer, which has "failed" where it ended."""
        assert self._process.stdin is not None
        started = time.monotonic()
        end = threading.Timer(TOO_LONG, self._process.kill)
        end.start()
        try:
            print(json.dumps({"case": asdict(case), "task": task, **request}), file=self._process.stdin, flush=True)
            answer = self._read()
        except BrokenPipeError:
            return {"failed": "its process ended"}
        finally:
            end.cancel()
        self._spent += time.monotonic() - started
        return answer

    @property
    def exhausted(self) -> bool:
        """Whether the contender has used its share of time; never the reference, which is needed."""
        return PEERS[self.name].slow and self.name != "numpy" and self._spent > ENOUGH

    def close(self) -> None:
        """End the process."""
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.close()
        self._process.wait(60)

    def _read(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        return json.loads(line) if line else {"failed": f"its process ended, status {self._process.wait(60)}"}


def main() -> None:
    """Measure all contenders, and write the page."""
    arguments = parse_arguments()
    started = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="mphdrr-bench-") as folder:
        case = Case(folder, arguments.voxels, arguments.pixels, arguments.views)
        save_volumes(folder, case.voxels)
        workers, missing = start(arguments.only, cores())
        rows = compare(workers, case, arguments.rounds)
        check_others(workers, case, rows)
        scaled = {w.name: w for w in workers if w.name in ("cpu", "c") and w.threads == len(cores())}
        for worker in workers:
            if worker not in scaled.values():
                worker.close()
        scaling = [] if arguments.no_growth else scale(scaled, case)
        for worker in scaled.values():
            worker.close()
    results = report.Results(case, rows, missing, scaling, len(cores()), time.monotonic() - started)
    folder_out = arguments.output
    folder_out.mkdir(parents=True, exist_ok=True)
    report.write(results, folder_out)
    ours = rows.get(("cpu", len(cores())))
    for (name, threads), row in rows.items():
        if ours is None or name in ("cpu", "numpy", "torch") or threads != len(cores()):
            continue
        for task in TASKS:
            if task in row.seconds and task in ours.seconds:
                work = f"{report.TITLES[task]}, a view of {case.pixels}², {case.voxels}³"
                note = "" if row.model == "exact" else f"its integral: {row.model}"
                tell("projector", work, ours.seconds[task], row.label, row.seconds[task], note)


def parse_arguments() -> argparse.Namespace:
    """Parse the command line, with the defaults of a quick or a full run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="96 voxels and pixels, 2 rounds: a minute or two")
    parser.add_argument("--voxels", type=int, help="along each side of the cube (default 256)")
    parser.add_argument("--pixels", type=int, help="along each side of the image (default 256)")
    parser.add_argument("--views", type=int, default=8, help="at most 80 (default 8)")
    parser.add_argument("--rounds", type=int, help="turns of each contender (default 5)")
    parser.add_argument("--no-growth", action="store_true", help="not how the time grows with voxels, rays and views")
    parser.add_argument("--only", type=lambda s: s.split(","), default=list(PEERS), help=f"some of {','.join(PEERS)}")
    parser.add_argument("--output", type=Path, help="folder (default docs, with --quick out)")
    arguments = parser.parse_args()
    unknown = [name for name in arguments.only if name not in PEERS]
    if unknown:
        parser.error(f"--only: no {', '.join(unknown)}; expected some of {','.join(PEERS)}")
    quick = arguments.quick
    arguments.voxels = arguments.voxels or (96 if quick else 256)
    arguments.pixels = arguments.pixels or (96 if quick else 256)
    arguments.rounds = arguments.rounds or (2 if quick else 5)
    arguments.output = arguments.output or ROOT / ("out" if quick else "docs")
    return arguments


def start(names: list[str], available: list[int]) -> tuple[list[Worker], dict[str, str]]:
    """Start the contenders; return those that are installed, and why the others are missing."""
    workers = []
    for name in names:
        one_thread_too = PEERS[name].cpu and not PEERS[name].slow
        for threads in sorted({1, len(available)} if one_thread_too else {len(available)}):
            workers.append(Worker(name, threads))
    missing = {}
    for worker in workers:  # all load their libraries by now
        why = worker.wait()
        if why is not None and PEERS[worker.name].label not in missing:
            missing[PEERS[worker.name].label] = why
            say(f"{PEERS[worker.name].label}: left out ({why})")
    return [worker for worker in workers if PEERS[worker.name].label not in missing], missing


def compare(workers: list[Worker], case: Case, rounds: int) -> dict[tuple[str, int], Row]:
    """Measure every task of every contender, in turns."""
    small = replace(case, voxels=16, pixels=8, n_views=1)
    save_volumes(case.folder, small.voxels)
    rows = {}
    for w in workers:
        slow = PEERS[w.name].slow
        rows[w.name, w.threads] = Row(w.name, w.threads, 1 if slow else case.n_views, w.label, PEERS[w.name].model)
        for task in PEERS[w.name].tasks():  # compiles what there is to compile
            w.measure(small, task)
    for task in TASKS:
        for turn in range(rounds):
            for w in workers:
                row = rows[w.name, w.threads]
                turns = 2 if PEERS[w.name].slow else rounds
                too_slow = w.exhausted or row.n_views * row.seconds.get(task, 0.0) > PATIENCE
                if task not in PEERS[w.name].tasks() or turn >= turns or too_slow:
                    continue
                own = replace(case, n_views=row.n_views)
                answer = w.measure(own, task, save=str(result_path(case, w, task)))
                if "failed" in answer:
                    say(f"{row.label}: {task} failed: {answer['failed']}")
                    continue
                seconds = answer["seconds"] / row.n_views
                row.seconds[task] = min(seconds, row.seconds.get(task, float("inf")))
                if answer["cpu"] is not None:
                    row.processor[task] = min(answer["cpu"] / row.n_views, row.processor.get(task, float("inf")))
                if turn == 0:
                    row.memory = float(np.nanmax([row.memory, answer["memory"]]))
                    say(f"{row.label}, {w.threads} threads: {task} {1e3 * seconds:.1f} ms a view")
        if task == "forward":
            check_rays(workers, case, rows)
    return rows


def check_rays(workers: list[Worker], case: Case, rows: dict[tuple[str, int], Row]) -> None:
    """Measure errors of the line integrals, and whether all contenders use the same rays."""
    noise, smooth = (reference(case, volume) for volume in ("noise", "smooth"))
    for w in workers:
        row, images = rows[w.name, w.threads], load(case, w.name, w.threads, "forward")
        if images is None:
            continue
        row.errors["forward"] = noise.error(images)
        path, own = result_path(case, w, "smooth"), replace(case, n_views=row.n_views)
        if "failed" not in w.measure(own, "forward", volume="smooth", save=str(path)):
            row.errors["offset"], row.errors["scale"] = smooth.offset(np.load(path))


def check_others(workers: list[Worker], case: Case, rows: dict[tuple[str, int], Row]) -> None:
    """Measure errors of the other tasks."""
    of_numpy = {task: load(case, "numpy", len(cores()), task) for task in ("emission", "pose_gradient")}
    for w in workers:
        row = rows[w.name, w.threads]
        results = {task: load(case, w.name, w.threads, task) for task in TASKS}
        forward, adjoint = results["forward"], results["adjoint"]
        if forward is not None and adjoint is not None:
            x, y = case.volume("noise"), case.images[: row.n_views]
            through = np.vdot(forward.astype(np.float64), y)
            row.errors["adjoint"] = abs(np.einsum("ijk,ijk", adjoint, x, dtype=np.float64) / through - 1)
        for task, expected in of_numpy.items():
            if results[task] is not None and expected is not None and w.name != "rtk":  # which attenuates the other way
                row.errors[task] = float(np.abs(results[task][:1] - expected).max() / np.abs(expected).max())


def scale(workers: dict[str, Worker], case: Case) -> list[report.Point]:
    """Measure how the time grows with voxels, rays and views, and how it depends on the content of the volume."""
    cases = [
        ("voxels", replace(case, voxels=n)) for n in (case.voxels // 4, case.voxels // 2, case.voxels, case.voxels * 2)
    ]
    cases += [
        ("rays", replace(case, pixels=n)) for n in (case.pixels // 4, case.pixels // 2, case.pixels, case.pixels * 2)
    ]
    cases += [("views", replace(case, n_views=n)) for n in (1, 8, 80)]
    points = []
    for what, scaled in cases:
        save_volumes(case.folder, scaled.voxels, ("noise",))
        points += measured(workers, what, scaled, "forward", 3)
    for what, task in (("80 views", "adjoint"), ("80 views", "emission")):
        points += measured(workers, what, replace(case, n_views=80), task, 1)
    save_volumes(case.folder, case.voxels, ("small",))
    return points + measured(workers, "small object", case, "forward", 3, volume="small")


def measured(
    workers: dict[str, Worker], what: str, case: Case, task: str, turns: int, **request: Any
) -> list[report.Point]:
    """Measure one task of one case; return the best time of each contender."""
    best: dict[str, float] = {}
    for _ in range(turns):
        for name, worker in workers.items():
            answer = worker.measure(case, task, **request)
            if "failed" not in answer:
                best[name] = min(answer["seconds"], best.get(name, float("inf")))
    for name, seconds in best.items():
        say(f"{what} ({case.voxels}^3, {case.n_views} x {case.pixels}^2), {task}, {name}: {seconds:.3f} s")
    return [report.Point(what, replace(case), task, name, seconds) for name, seconds in best.items()]


def result_path(case: Case, worker: Worker, task: str) -> Path:
    """Return the path of the file for a contender's result."""
    return Path(case.folder) / f"result-{worker.name}-{worker.threads}-{task}.npy"


def load(case: Case, name: str, threads: int, task: str) -> np.ndarray | None:
    """Load a contender's result; None where there is none."""
    path = Path(case.folder) / f"result-{name}-{threads}-{task}.npy"
    return np.load(path) if path.is_file() else None


def say(words: str) -> None:
    """Print at once."""
    print(words, flush=True)


if __name__ == "__main__":
    main()
