"""Report of the judge: its table in Markdown and JSON, and its picture."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ...figures.page import Page
from ...figures.parts import FAINT, INK, Axes, heading
from ...files import write_bytes
from ...reconstruction.scores.summary import JUDGED_SCORES
from ...runs.display import Display
from ...runs.display import number_text as number
from ...volumes.volume import Volume
from .records import write_json

BASELINE, ORACLE, METHOD = "baseline", "tuned on the set", "method"
"""Kinds of rows of the table."""
_WIDTH, _ROW, _LINE = 1800, 330, 26  # pixels: width of the page, height of a row of slices, height of a ratio
_COLORS = {BASELINE: FAINT, ORACLE: "#a06c10", METHOD: "#b8433a"}

_COLUMNS = (
    ("NRMSE", "nrmse", "{:.3f}"),
    ("by the best baseline", "best_baseline", "{[ratio]}"),
    ("by the best tuned on the set", "best_on_itself", "{[ratio]}"),
    *((row.label, row.name, f"{{:{row.form}}}") for row in JUDGED_SCORES),
    ("bias", "bias", "{:.3f}"),
    ("SD", "deviation", "{:.3f}"),
    ("contrast", "contrast", "{:.2f}"),
    ("rods seen", "sensitivity", "{}"),
    ("false rods", "false_rods", "{}"),
    ("AUC", "auc", "{}"),
    ("observer's SNR", "snr", "{:.2f}"),
    ("deviance", "deviance", "{:.3f}"),
    ("s", "seconds", "{:.2f}"),
    ("MB", "megabytes", "{:.0f}"),
)
"""Columns of the table: heading, key of a row, format of its value; an `Estimate` formats itself."""
_LEGEND = """NRMSE: root mean square error by the truth's root mean square. SSIM: in three dimensions, a Gaussian window of
1.5 voxels, 11 wide; range: the truth's. Bias, SD: over draws of noise, root mean squares by the truth's. Contrast: 1 is the
truth's. Rods seen, false rods: shares of sites with and without a rod where more than half of its contrast is (Wilson). AUC:
channelised Hotelling observer, 5 Laguerre-Gauss channels, ten folds. Deviance: of the counts from the volume's images, by
its mean for true means: 1 is right. Intervals are of 95 %; ratios are of mean NRMSE on the same events (paired bootstrap).
"""


@dataclass(frozen=True, eq=False)
class Judgement:
    """Result of the judge."""

    rows: list[dict[str, Any]]
    """Rows of the table, one for each test, level and method."""
    tests: dict[str, dict[str, Any]]
    """Data of the tests by name: hash of the set, number of events, scoring, what methods are told."""
    tuning: dict[str, Any]
    """Choice of each family of baselines for each level."""
    pictures: list[tuple[str, list[tuple[str, Volume]]]] = field(default_factory=list)
    """Titles, and volumes by name, the truth first, of the first event of some tests."""

    @property
    def record(self) -> dict[str, Any]:
        """All data but the pictures, as JSON values; intervals are lists of value, low and high."""
        return {"version": 1, "tests": self.tests, "tuning": self.tuning, "rows": self.rows}


def write_report(judgement: Judgement, folder: Path) -> None:
    """Write the table, ``judgement.md`` and ``.json``, and the picture, ``judgement.png``, into a folder."""
    write_json(folder / "judgement.json", judgement.record)
    write_bytes(folder / "judgement.md", markdown_table(judgement).encode())
    draw_picture(judgement).write(folder / "judgement.png")


def markdown_table(judgement: Judgement) -> str:
    """Return the table with its legend and notes, in Markdown."""
    columns = [column for column in _COLUMNS if any(column[1] in row for row in judgement.rows)]
    heads = ["test", "counts", "method", *(head for head, _, _ in columns)]
    lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for row in judgement.rows:
        name = row["method"] + (f", {ORACLE}" if row["kind"] == ORACLE else "")
        cells = [row["test"], f"{row['level']:g}", name]
        cells += [form.format(row[key]) if key in row else "" for _, key, form in columns]
        lines.append(f"| {' | '.join(cells)} |")
    sets = [f"- {name}: {test['events']} events, set {test['set']}" for name, test in judgement.tests.items()]
    sets += [f"- {name}: methods are told {t['believed']}" for name, t in judgement.tests.items() if t["believed"]]
    notes = dict.fromkeys(f"- {row['test']}: {note}" for row in judgement.rows for note in row["notes"])
    return "\n".join([*lines, "", _LEGEND, *sets, *notes, ""])


def draw_picture(judgement: Judgement) -> Page:
    """Draw slices of truth, first baseline and methods, and the ratios of NRMSE with their intervals."""
    ratios = [row for row in judgement.rows if "best_baseline" in row and row["kind"] != BASELINE]
    page = Page(_WIDTH, 120 + _ROW * len(judgement.pictures) + (120 + _LINE * len(ratios) if ratios else 0))
    top = heading(page, "Judgement", ["Middle slices across z; NRMSE by that of the best baseline, 95 % intervals"])
    for title, volumes in judgement.pictures:
        _draw_slices(page, title, volumes, top)
        top += _ROW
    if ratios:
        _draw_ratios(page, ratios, top + 40)
    return page


def _draw_slices(page: Page, title: str, volumes: list[tuple[str, Volume]], top: int) -> None:
    """Draw the middle slices of a test's volumes in a row, in the truth's colour window."""
    side = min(_ROW - 50, (page.width - 100) // len(volumes) - 20)
    display, truth = Display("inferno"), volumes[0][1].array
    window = display.window(truth)
    page.text(title, 40, top + side / 2 + 30, page.em, INK, "middle", upward=True)
    for column, (name, volume) in enumerate(volumes):
        left = 70 + column * (side + 20)
        page.text(name, left, top + 20, min(0.7 * page.em, 1.6 * side / len(name)), INK)
        values = volume.array[:, :, volume.array.shape[2] // 2]
        page.image(display.colored(values.T[::-1], window), left, top + 30, side, side)


def _draw_ratios(page: Page, rows: list[dict[str, Any]], top: int) -> None:
    """Draw the ratios of NRMSE to the best baseline's with their intervals, one line per row of the table."""
    ends = [end for row in rows for end in row["best_baseline"]["ratio"]]
    low, high = min(0.7, *ends), max(1.1, *ends)
    axes = Axes(page, (700, top, page.width - 800, _LINE * len(rows)), (low, high), (len(rows), 0), page.em)
    marks = [mark for mark in np.arange(0.1, 10, 0.1) if low <= mark <= high]
    axes.draw(marks if len(marks) < 20 else [1.0], [])
    page.line([axes.point(1.0, 0), axes.point(1.0, len(rows))], FAINT, 1.5, 6)
    for index, row in enumerate(rows):
        (value, start, end), color, y = row["best_baseline"]["ratio"], _COLORS[row["kind"]], index + 0.5
        page.line([axes.point(start, y), axes.point(end, y)], color, 3)
        x, y_page = axes.point(value, y)
        page.area([(x - 5, y_page), (x, y_page - 5), (x + 5, y_page), (x, y_page + 5)], color)
        text = f"{row['test']}, {number(row['level'])} of the counts: {row['method']}"
        page.text(text, 680, y_page + 5, 0.65 * page.em, INK, "end")
