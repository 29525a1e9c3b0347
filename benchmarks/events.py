"""Event sets beside the usual pipeline with DiffDRR, in one run: `make bench-events`.

    python benchmarks/events.py [--quick] [--events 50] [--voxels 256] [--pixels 256] [--output FOLDER]

The event: a Derenzo phantom of random pose, its true volume, all views of the real workbook, parallel projections at 96 and
256 angles, written. Made with line integrals, and with emission through the whole hole; by one worker that has all cores,
and by one worker per core. The pipeline: numpy, DiffDRR 0.6.1 and torch, a few views and
angles of one event, scaled to all. Writes the section "Event sets" of `benchmarks.md`.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import report
from beside import in_one_run, tell
from case import Case
from peers import PEERS, cores

import mphdrr.core as mph

ROOT = Path(__file__).parents[1]
WORKBOOK = ROOT / "examples" / "dc-spect-80.xlsx"
SIDE = 256.0  # mm, of the cube of voxels
ANGLES = (96, 256)
RADIUS, RODS, HEIGHT = 40.0, (8.0, 6.0, 5.0, 4.0, 3.0, 2.0), 40.0  # mm, as in docs/reconstruction.md
MODELS = {
    "line integrals": 'kind = "transmission"',
    "emission": 'kind = "emission"\ntime = 600',
}
RECIPE = """version = 1
seed = 1
[system]
file = {workbook!r}
[detector]
rows = {pixels}
columns = {pixels}
[truth]
voxels = {voxels}
spacing = {spacing}
[[phantoms]]
kind = "derenzo"
radius = {radius}
rod_diameters = {rods}
height = {height}
[phantoms.pose]
position = [{{ from = -25, to = 25 }}, {{ from = -25, to = 25 }}, {{ from = -25, to = 25 }}]
turn = "uniform"
[models.images]
{model}
[radon]
angles = {angles}
"""


@dataclass(frozen=True)
class Making:
    """The time and the sizes of events made in one call."""

    model: str
    workers: int
    count: int
    seconds: float  # of all, with the start of the workers
    size: float  # bytes of an event, mean
    largest: int

    @property
    def each(self) -> float:
        """Seconds per event."""
        return self.seconds / self.count


def recipe(model: str, voxels: int, pixels: int) -> mph.events.EventRecipe:
    """Return the recipe of the events."""
    text = RECIPE.format(
        workbook=str(WORKBOOK), pixels=pixels, voxels=voxels, spacing=SIDE / voxels, radius=RADIUS, rods=list(RODS),
        height=HEIGHT, model=MODELS[model], angles=list(ANGLES),
    )  # fmt: skip
    return mph.events.EventRecipe(text)


def made(model: str, workers: int, count: int, voxels: int, pixels: int, folder: str) -> Making:
    """Make events in a new folder, and return their time and sizes."""
    with tempfile.TemporaryDirectory(dir=folder) as target, warnings.catch_warnings():
        warnings.simplefilter("ignore", mph.InputWarning)
        started = time.perf_counter()
        sizes = [one.size for one in mph.events.making(recipe(model, voxels, pixels), target, count, workers=workers)]
        seconds = time.perf_counter() - started
    who = f"{model}, {workers} worker{'s' * (workers > 1)}"
    say(f"{who}: {count} events in {seconds:.1f} s, {np.mean(sizes) / 1e6:.1f} MB each")
    return Making(model, workers, count, seconds, float(np.mean(sizes)), max(sizes))


def painted(voxels: int, pose: np.ndarray) -> np.ndarray:
    """Voxelize the phantom as a script does: coordinates of all voxels, a mask for each rod."""
    at = ((np.arange(voxels) + 0.5) / voxels - 0.5).astype(np.float32) * np.float32(SIDE)
    turn, shift = pose[:3, :3].astype(np.float32), pose[:3, 3].astype(np.float32)
    x, y, z = (
        (at - shift[0])[:, None, None] * turn[0, i]
        + (at - shift[1])[None, :, None] * turn[1, i]
        + (at - shift[2])[None, None, :] * turn[2, i]
        for i in range(3)
    )
    volume, within = np.zeros((voxels,) * 3, np.float32), np.abs(z) <= HEIGHT / 2
    for _, x0, y0, diameter in mph.DerenzoPhantom(RADIUS, RODS, HEIGHT, 100.0).shapes[0].rods:
        volume[within & ((x - np.float32(x0)) ** 2 + (y - np.float32(y0)) ** 2 <= (diameter / 2) ** 2)] = 100.0
    return volume


def parallel(volume: Any, angles: np.ndarray) -> Any:
    """Return parallel projections (angles, z, columns): the volume turned about z and summed, angle by angle, in torch."""
    import torch

    slices = volume.permute(2, 0, 1)[None]  # z as channels
    images = []
    for angle in angles:
        c, s = float(np.cos(angle)), float(np.sin(angle))
        grid = torch.nn.functional.affine_grid(torch.tensor([[[c, -s, 0.0], [s, c, 0.0]]]), slices.shape, False)
        images.append(torch.nn.functional.grid_sample(slices, grid, align_corners=False)[0].sum(dim=1))
    return torch.stack(images)


def pipeline(voxels: int, pixels: int, views: int, angles: int, folder: str) -> dict[str, tuple[float, float]] | None:
    """Return the seconds of the pipeline's steps for one event: as measured, and scaled to all views and angles.

    None where DiffDRR or torch is not installed.
    """
    try:
        renderer = PEERS["diffdrr"](len(cores()))
        import torch
    except ImportError as error:
        say(f"DiffDRR is left out: {error}")
        return None
    pose = mph.euler_pose(0.4, 0.7, 0.2, (10.0, 5.0, -5.0))
    found: dict[str, tuple[float, float]] = {}

    def timed(name: str, call: Callable[[], Any], factor: float = 1.0) -> Any:
        started = time.perf_counter()
        result = call()
        seconds = time.perf_counter() - started
        found[name] = (seconds, seconds * factor)
        say(f"pipeline, {name}: {seconds:.2f} s, all {seconds * factor:.1f} s")
        return result

    volume = timed("voxels", lambda: painted(voxels, pose))
    np.save(Path(folder) / f"noise-{voxels}.npy", volume)
    n_views = len(mph.read_system(WORKBOOK))
    warm = Case(folder, voxels, 8, 1)
    renderer.forward(warm)()  # what is made once does not count
    timed("views", renderer.forward(Case(folder, voxels, pixels, views)), n_views / views)
    tensor = torch.from_numpy(volume)
    every = np.pi * np.arange(angles) / angles
    timed("radon", lambda: parallel(tensor, every), sum(ANGLES) / angles)
    shapes = {"truth": None, "Projections": (1, 96, pixels, pixels)}
    shapes |= {f"ProjRadon{n}": (1, n, voxels, voxels) for n in ANGLES}

    def save() -> None:
        for name, shape in shapes.items():
            array = tensor[None] if shape is None else torch.zeros(shape)
            torch.save(array, Path(folder) / f"{name}_0.pt")

    timed("torch.save", save)
    stored = sum((Path(folder) / f"{name}_0.pt").stat().st_size for name in shapes)
    found["bytes"] = (stored, stored)
    return found


def section(
    makings: list[Making], peer: dict[str, tuple[float, float]] | None, views: int, angles: int, voxels: int, pixels: int,
    load: float, minutes: float,
) -> str:  # fmt: skip
    """Return the page's section on event sets."""
    threads = len(cores())
    lines = []
    for one in makings:
        who = f"{one.workers} workers" if one.workers > 1 else f"1 worker, {threads} threads"
        lines.append([
            one.model, who, str(one.count), f"{one.each:.2f}", f"{60 / one.each:.1f}", f"{one.size / 1e6:.1f}",
            f"{one.largest / 1e6:.1f}", f"{1000 * one.each / 60:.0f}", f"{one.size / 1e6:.1f}",
        ])  # fmt: skip
    head = ["images", "made by", "events", "s an event", "events a minute", "MB an event", "largest MB",
            "1000 events: minutes", "GB"]  # fmt: skip
    busy = ""
    if load > 0.5 and not in_one_run():
        busy = (
            f"\n\n**The machine was busy with other work** (load {load:.1f} before the run): times are too long, and all\n"
            "comparisons less certain than their digits suggest: the company changed from one to the next."
        )
    parts = [
        f"""{HEADING}

Written by `make bench-events`, {date.today()}; do not edit. {report.processor()}, {threads} cores; the run took
{minutes:.1f} minutes.{busy}

An event: a Derenzo phantom (radius {RADIUS:g} mm, rods of {", ".join(f"{d:g}" for d in RODS)} mm, {HEIGHT:g} mm high) turned
at random and moved by up to 25 mm along each axis; its volume of {voxels}^3 voxels of {SIDE / voxels:g} mm, 80 views of
{pixels} x {pixels} pixels, parallel projections at {" and ".join(map(str, ANGLES))} angles; compressed without loss, on the
disk. Emission is through the whole hole, by depth. Times are of the whole work, with the start of the
workers, by the number of events; what 1000 take is scaled from them. A larger phantom compresses to more.""",
        report._table(head, lines),
    ]
    if peer is None:
        parts.append("DiffDRR or torch was not installed, so the usual pipeline was not measured.")
        return "\n\n".join(parts) + "\n"
    steps = {
        "voxels": ("numpy: coordinates of all voxels, a mask for each rod", "whole"),
        "views": ("DiffDRR 0.6.1 (Siddon), 4096 rays at a time", f"{views} of 80 views"),
        "radon": ("torch: turned about z with grid_sample and summed", f"{angles} of {sum(ANGLES)} angles"),
        "torch.save": ("the tensors, 96 slots for the views", "whole"),
    }
    rows = [[name, *words, f"{peer[name][0]:.2f}", f"{peer[name][1]:.1f}"] for name, words in steps.items()]
    total = sum(peer[name][1] for name in steps)
    rows.append(["all", "", "", "", f"{total:.1f}"])
    ratios = [
        [
            f"{one.model}, {one.workers} worker{'s' * (one.workers > 1)}",
            f"{one.each / total:.3g}",
            f"{total / one.each:.0f}",
        ]
        for one in makings
    ]
    parts += [
        f"""The usual pipeline for one such event with line integrals, in the same run, with {threads} threads. How its users
write the steps around DiffDRR is assumed: the rods as masks on a whole grid, the parallel projections by turning the volume
(with torch's `grid_sample`, not compared with other ways). Where DiffDRR takes longer for a view
than in the first table, other work slowed this run. It stores {peer["bytes"][0] / 1e6:.0f} MB an event.""",
        report._table(["step", "by", "measured", "s", "s for an event"], rows),
        report._table(["mphDRR's time by the pipeline's", "ratio", "times as fast"], ratios),
    ]
    return "\n\n".join(parts) + "\n"


HEADING = report.EVENTS


def write(text: str, path: Path) -> None:
    """Write the section at the end of the page, in place of the previous one."""
    page = path.read_text(encoding="utf-8") if path.is_file() else "# Benchmarks\n"
    path.write_text(f"{page.partition(HEADING)[0].rstrip()}\n\n{text}", encoding="utf-8")
    say(str(path))


def main() -> None:
    """Measure, and write the section."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="few events of half as many voxels and pixels: a minute")
    parser.add_argument(
        "--events", type=int, help="made by several workers (default 50, with --quick 4); one makes a fifth"
    )
    parser.add_argument("--voxels", type=int, help="along each side of the cube (default 256)")
    parser.add_argument("--pixels", type=int, help="along each side of the image (default 256)")
    parser.add_argument("--output", type=Path, help="folder (default docs, with --quick out)")
    parser.add_argument("--no-pipeline", action="store_true", help="without DiffDRR")
    chosen = parser.parse_args()
    size = 128 if chosen.quick else 256
    voxels, pixels = chosen.voxels or size, chosen.pixels or size
    count = chosen.events or (4 if chosen.quick else 50)
    output = chosen.output or ROOT / ("out" if chosen.quick else "docs")
    output.mkdir(parents=True, exist_ok=True)
    load, started = os.getloadavg()[0] if hasattr(os, "getloadavg") else 0.0, time.monotonic()
    views, angles = (2, 4) if chosen.quick else (4, 16)
    with tempfile.TemporaryDirectory(prefix="mphdrr-bench-") as folder:
        makings = [  # of one worker a fifth is enough to compare
            made(model, workers, count if workers > 1 else max(2, count // 5), voxels, pixels, folder)
            for model in MODELS
            for workers in sorted({1, len(cores())})
        ]
        peer = None if chosen.no_pipeline else pipeline(voxels, pixels, views, angles, folder)
    for one in makings:
        if peer is not None and one.workers == len(cores()) and one.model == "line integrals":
            theirs = sum(seconds for name, (_, seconds) in peer.items() if name != "bytes")
            work = f"an event: {voxels}³, 80 views of {pixels}², 352 parallel views"
            tell("events", work, one.each, "scripts with DiffDRR", theirs, "scaled from some views")
    minutes = (time.monotonic() - started) / 60
    write(section(makings, peer, views, angles, voxels, pixels, load, minutes), output / "benchmarks.md")


def say(words: str) -> None:
    """Print at once."""
    print(words, flush=True)


if __name__ == "__main__":
    main()
