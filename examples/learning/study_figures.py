"""Tables and picture of docs/learning-study.md, from the judgements in a folder: python study_figures.py FOLDER."""

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import mphdrr.core as mph
from mphdrr.core.events import EventSet
from mphdrr.core.figures.page import Page
from mphdrr.core.figures.parts import FAINT, INK, Axes, heading
from mphdrr.core.learning.judging.records import Records
from mphdrr.core.learning.judging.statistics import ratio_of_means
from mphdrr.core.runs.display import Display, ticks

NAMES = {
    "after-osem": "1 U-Net after OSEM",
    "after-osem-short": "1, as many steps as 2 and 4",
    "hour": "1, for seven minutes",
    "cameras-begun": "2 camera nets, begun with 1",
    "unrolled-begun": "4 unrolled, begun with 1",
    "unrolled-through": "4, begun with 1, gradients through the operators",
    "unrolled": "4 unrolled, from scratch",
    "unrolled-permuted": "4, permuted poses",
    "channels": "views as channels, no geometry",
}
COLORS = {"after-osem": "#b8433a", "cameras-begun": "#2b6ca3", "unrolled-begun": "#2f8a4b", "unrolled": "#8a6d2f",
          "unrolled-permuted": "#8a5aa0", "channels": "#777777"}  # fmt: skip
STEP = {"after-osem": 0.058, "cameras-begun": 0.33, "unrolled-begun": 0.29, "unrolled": 0.29, "unrolled-permuted": 0.29,
        "channels": 0.037}  # fmt: skip
"""Seconds of one thread for a step, measured by itself: two trainings at once wait for each other."""
BEFORE = 1500
"""Steps of the U-Net that others begin with."""
SIZE = 190

Row = dict[str, Any]


class Findings:
    """The rows of all judgements, by test, level, training and seed."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.rows, self.baselines = folder, dict[tuple[str, float, str, int], Row](), list[Row]()
        for judge in sorted(path.parent for path in folder.glob("judge-*/judgement.json")):
            found = json.loads((judge / "judgement.json").read_text())
            for row in found["rows"]:
                row["file"] = (
                    judge / "scores" / (f"{found['tests'][row['test']]['fingerprint']}-{row['fingerprint'][:16]}.jsonl")
                )
                if row["kind"] == "method":
                    kind, _, seed = row["method"].rpartition("-")
                    self.rows[row["test"], row["level"], kind, int(seed)] = row
                else:
                    self.baselines.append(row)

    def of(self, test: str, kind: str, level: float = 1.0) -> list[Row]:
        """Return the rows of all seeds."""
        return [row for (*key, _), row in sorted(self.rows.items()) if key == [test, level, kind]]

    def errors(self, row: Row) -> Any:
        """Return the NRMSE of each event of a row."""
        events = EventSet(self.folder / "sets" / self.sets[row["test"]])
        kept = Records(row["file"])
        return np.array(
            [kept[e.recipe.fingerprint, e.number, row["level"], 0]["nrmse"] for e in events][: row["events"]]
        )

    sets = {
        "derenzo": "derenzo", "unseen": "unseen", "pairs": "pairs", "sixteen-modules": "sixteen",
        "moved-10-mm": "moved", "wider-holes": "holes", "misaligned": "misaligned",
        "penetration": "physics", "scatter": "physics", "fewer-counts": "derenzo",
    }  # fmt: skip


def interval(values: Sequence[float]) -> str:
    """Format a value with its interval."""
    return "{:.3f} [{:.3f}, {:.3f}]".format(*values)


def over_seeds(rows: list[Row], name: str = "best_baseline") -> str:
    """Format mean and SD over training seeds of the ratio of NRMSE; for one seed, its interval."""
    values = [row[name]["ratio"][0] for row in rows if name in row]
    if len(values) < 2:
        return interval(rows[0][name]["ratio"]) if values else ""
    return f"{np.mean(values):.3f} ± {np.std(values, ddof=1):.3f}, first {interval(rows[0][name]['ratio'])}"


def table(heads: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """Format a table in Markdown."""
    return "\n".join(f"| {' | '.join(line)} |" for line in (heads, ["---"] * len(heads), *lines)) + "\n"


def known(found: Findings) -> str:
    """Return the table of the scanner of the trainings."""
    lines = []
    for row in found.baselines:
        if row["test"] == "derenzo":
            lines.append([row["method"], "", f"{row['nrmse']:.3f}", interval(row["best_baseline"]["ratio"]), "",
                          f"{row['deviance']:.2f}", f"{row['sensitivity'][0]:.2f}", f"{row['seconds']:.1f}"])  # fmt: skip
    for kind, name in NAMES.items():
        rows, unseen = found.of("derenzo", kind), found.of("unseen", kind)
        if rows:
            curve = json.loads((found.folder / f"{rows[0]['method']}-training" / "curve.json").read_text())[-1]
            lines.append([
                name, f"{curve['step']}", f"{np.mean([row['nrmse'] for row in rows]):.3f}", over_seeds(rows),
                over_seeds(unseen, "best_on_itself"), f"{rows[0]['deviance']:.2f}",
                f"{rows[0]['sensitivity'][0]:.2f}", f"{rows[0]['seconds']:.1f}",
            ])  # fmt: skip
    heads = ("method", "steps", "NRMSE, rods", "by the best baseline", "unseen kinds, by the best tuned on them", "deviance",
             "rods seen", "s")  # fmt: skip
    return table(heads, lines)


def unknown(found: Findings) -> str:
    """Return the table of other scanners, physics and counts: by the best baseline, and by method 1 of the same seed."""
    lines = []
    for test, level in dict.fromkeys((test, level) for test, level, *_ in found.rows):
        if test in ("derenzo", "unseen", "draws", "pairs"):
            continue
        for kind in ("after-osem", "cameras-begun", "unrolled-begun"):
            rows, beside = found.of(test, kind, level), found.of(test, "after-osem", level)
            if not rows:
                continue
            ratios = [
                ratio_of_means(found.errors(row), found.errors(other), 0)
                for row, other in zip(rows, beside, strict=True)
                if kind != "after-osem"
            ]
            lines.append([test, f"{level:g}", NAMES[kind], over_seeds(rows), "; ".join(map(interval, ratios))])
    return table(("test", "counts", "method", "by the best baseline", "by method 1, each seed"), lines)


def pairs(found: Findings) -> str:
    """Return the table of rods left out or added."""
    rows = [row for row in found.baselines if row["test"] == "pairs"]
    rows += [row for (test, *_), row in found.rows.items() if test == "pairs"]
    lines = [[row["method"], interval(row["sensitivity"]), interval(row["false_rods"])] for row in rows]
    return table(("method", "added rods seen", "false rods"), lines)


def picture(found: Findings) -> Page:
    """Draw middle slices of two events, and the learning curves by time and by events."""
    methods = ("after-osem", "cameras-begun", "unrolled-begun", "unrolled", "unrolled-permuted", "channels")
    page = Page(1660, 1130)
    text = "Middle slices of one event each; below, the NRMSE of validation events while they are trained, three seeds"
    top = heading(page, "Do networks need to know where the cameras are?", [text])
    for test in ("derenzo", "unseen"):
        event = EventSet(found.folder / "sets" / test)[2]
        run = event.run("emission", event.noise_seed)
        grid = mph.learning.read_model(found.folder / "after-osem-0.pt").contents.grid
        shown = [("truth", mph.resample(event.truth, grid, "mean"))]
        shown += [(NAMES[kind], mph.learning.read_model(found.folder / f"{kind}-0.pt").judged(kind).function(run))
                  for kind in methods]  # fmt: skip
        display = Display("inferno")
        window = display.window(shown[0][1].array)
        for column, (name, volume) in enumerate(shown):
            left = 60 + column * (SIZE + 35)
            page.text(name, left, top + 20, 0.62 * page.em, INK)
            values = volume.array[:, :, volume.array.shape[2] // 2]
            page.image(display.colored(values.T[::-1], window), left, top + 30, SIZE, SIZE)
        top += SIZE + 60
    for column, (name, text) in enumerate({"seconds": "seconds of training", "events": "events seen"}.items()):
        curves(found, page, (110 + column * 800, top + 40, 660, 330), name, text, methods)
    return page


def curves(found: Findings, page: Page, frame: Any, name: str, text: str, methods: Sequence[str]) -> None:
    """Draw the learning curves of all seeds."""
    read = {(kind, path.parent.name): curve(path, kind, name) for kind in methods
            for path in sorted(found.folder.glob(f"{kind}-?-training/curve.json"))}  # fmt: skip
    most = max(x for xs, _ in read.values() for x in xs)
    axes = Axes(page, frame, (0, most), (0.25, 0.9), page.em)
    axes.draw(ticks(0, most, 6), ticks(0.25, 0.9, 6), "", text)
    for (kind, _), (xs, ys) in read.items():
        axes.curve(xs, ys, COLORS[kind], 0.1)
    for place, kind in enumerate(methods):
        x, y = frame[0] + frame[2] - 300, frame[1] + 130 + 24 * place
        page.line([(x, y - 5), (x + 30, y - 5)], COLORS[kind], 3)
        page.text(NAMES[kind], x + 40, y, 0.7 * page.em, FAINT)


def curve(path: Path, kind: str, name: str) -> tuple[list[float], list[float]]:
    """Return seconds or events, and the NRMSE of validation events."""
    rows, before = json.loads(path.read_text()), kind.endswith("-begun")
    own, first = (STEP[kind], BEFORE * STEP["after-osem"]) if name == "seconds" else (1.0, BEFORE)
    return [first * before + own * row["step"] for row in rows], [min(row["validation"], 0.9) for row in rows]


def main(folder: Path) -> None:
    """Write study.md and study.png."""
    found = Findings(folder)
    (folder / "study.md").write_text("\n".join([known(found), unknown(found), pairs(found)]), encoding="utf-8")
    picture(found).write(folder / "study.png")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
