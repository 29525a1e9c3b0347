"""All benchmarks beside peers, in one run: one table at the top of docs/benchmarks.md, one picture. `make bench-all`.

    python benchmarks/beside.py [--quick] [--output FOLDER]

Runs `SCRIPTS`, one after the other. Each tells with `tell` what it measured of ours and of a peer in the same work. Peers
that are not installed are left out.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from datetime import date
from pathlib import Path

from mphdrr.core import memory

ROOT = Path(__file__).parents[1]
HEADING = "## Beside peers"
_FILE = "MPHDRR_BENCHMARKS"
SCRIPTS = {
    "projector.py": ("--quick",),
    "drrs.py": ("--voxels", "128", "128", "64", "--pixels", "64"),
    "events.py": ("--quick",),
    "reconstruction.py": ("--voxels", "32", "--pixels", "32"),
    "fdk.py": ("--voxels", "64", "--views", "60"),
    "perspective.py": ("--voxels", "64", "64", "32", "--pixels", "64"),
}
"""What is run, and the arguments of a quick run."""
SLOWER = 1.05
"""How many times a peer's time is called slower: less is chance."""


@dataclass(frozen=True)
class Beside:
    """The times of one task by mphDRR and by a peer, s; `note` says where the two tasks differ."""

    chapter: str
    work: str
    ours: float
    peer: str
    theirs: float
    note: str = ""

    @property
    def ratio(self) -> float:
        """The time of mphDRR divided by the peer's."""
        return self.ours / self.theirs


def in_one_run() -> bool:
    """Return whether this script runs as a part of `make bench-all`, whose earlier parts are the machine's load."""
    return _FILE in os.environ


def tell(chapter: str, work: str, ours: float, peer: str, theirs: float, note: str = "") -> None:
    """Keep a comparison for the table of `make bench-all`; do nothing where no table is made."""
    if in_one_run():
        with open(os.environ[_FILE], "a", encoding="utf-8") as file:
            print(json.dumps(asdict(Beside(chapter, work, ours, peer, theirs, note))), file=file)


def section(found: list[Beside], missing: list[str], load: float, minutes: float, picture: str | None) -> str:
    """Return the page's section on peers: table, notes and picture."""
    head = ("chapter", "work", "mphDRR s", "peer", "peer s", "times as fast", "")
    lines = [f"| {' | '.join(head)} |", f"| {' | '.join(['---'] * len(head))} |"]
    for one in found:
        fast = f"{1 / one.ratio:.3g}"
        fast = f"**{fast}**" if one.ratio > SLOWER else fast
        lines.append(
            f"| {one.chapter} | {one.work} | {one.ours:.3g} | {one.peer} | {one.theirs:.3g} | {fast} | {one.note} |"
        )
    slower = [f"{one.work} than {one.peer}" for one in found if one.ratio > SLOWER]
    words = [
        f"Written by `make bench-all`, {date.today()}; do not edit. {minutes:.0f} minutes (load before: {load:.1f})"
        f" with {memory.cores()} threads, each pair on the same work, in turns. More on projector and event sets below.",
        f"Slower than a peer: {'; '.join(slower)}." if slower else "Nothing is slower than a peer.",
    ]
    if missing:
        words.append(f"Did not end well, so not in the table: {', '.join(missing)}.")
    words.append(
        "Not compared: networks, which are MONAI's in torch and see perspective through torch's `grid_sample`; and spectra,"
        " for which no peer here takes our rays."
    )
    parts = [HEADING, *words, "\n".join(lines)]
    if picture:
        parts.append(f"![How many times as fast as its peers](images/{picture})")
    return "\n\n".join(parts) + "\n"


def write(text: str, page: Path) -> None:
    """Insert the section after the page's head, in place of the previous one."""
    lines = page.read_text(encoding="utf-8").split("\n## ")
    others = [part for part in lines[1:] if not part.startswith(HEADING.removeprefix("## "))]
    page.write_text("\n## ".join([lines[0], text.removeprefix("## "), *others]), encoding="utf-8")


def draw(found: list[Beside], path: Path) -> bool:
    """Draw the ratios of all comparisons to `path`; return False where matplotlib is missing."""
    try:
        import matplotlib
    except ImportError:
        return False
    matplotlib.use("svg")
    import matplotlib.pyplot as plt

    matplotlib.rcParams.update({"svg.hashsalt": "mphdrr", "svg.fonttype": "none", "font.size": 9})
    figure, axes = plt.subplots(figsize=(8, 0.6 + 0.2 * len(found)), layout="constrained")
    chapters = list(dict.fromkeys(one.chapter for one in found))
    for at, one in enumerate(reversed(found)):
        axes.plot([1, 1 / one.ratio], [at, at], "-", color="#bbbbbb", linewidth=1)
        axes.plot(1 / one.ratio, at, "o", color=f"C{chapters.index(one.chapter)}", markersize=5)
    axes.set_yticks(range(len(found)), [f"{one.work}: {one.peer}".replace("`", "") for one in reversed(found)])
    axes.axvline(1, color="black", linewidth=0.8)
    axes.set_xscale("log")
    axes.set_xlabel("times as fast as the peer")
    figure.savefig(path, metadata={"Date": None})
    plt.close(figure)
    return True


def main() -> None:
    """Run all benchmarks, and write table and picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="small volumes and few views: some minutes")
    parser.add_argument("--output", type=Path, help="folder (default docs, with --quick out)")
    chosen = parser.parse_args()
    output = chosen.output or ROOT / ("out" if chosen.quick else "docs")
    (output / "images").mkdir(parents=True, exist_ok=True)
    load, begun, missing = os.getloadavg()[0] if hasattr(os, "getloadavg") else 0.0, time.monotonic(), []
    with tempfile.TemporaryDirectory(prefix="mphdrr-bench-") as folder:
        kept = Path(folder) / "found.jsonl"
        for script, quick in SCRIPTS.items():
            command = [sys.executable, str(Path(__file__).with_name(script)), *(quick if chosen.quick else ())]
            command += ["--output", str(output)] if script in ("projector.py", "events.py") else []
            print("===", script, flush=True)
            if subprocess.run(command, env={**os.environ, _FILE: str(kept)}).returncode != 0:
                missing.append(script)
        found = [Beside(**json.loads(line)) for line in kept.read_text().splitlines()] if kept.exists() else []
    drawn = draw(found, output / "images" / "peers.svg")
    minutes = (time.monotonic() - begun) / 60
    write(section(found, missing, load, minutes, "peers.svg" if drawn else None), output / "benchmarks.md")
    print(output / "benchmarks.md")
    raise SystemExit(1 if missing else 0)


if __name__ == "__main__":
    main()
