"""The judge's table, in Markdown and JSON, and its picture."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ...figures.page import Page
from ...figures.parts import FAINT, INK, Axes, heading, number
from ...files import write_bytes
from ...runs.display import Display
from ...volumes.volume import Volume
from .judgement import BASELINE, METHOD, ORACLE, Judgement
from .records import write_json

_WIDTH, _ROW, _LINE = 1800, 330, 26  # pixels: the page, a row of slices, a ratio
_COLORS = {BASELINE: FAINT, ORACLE: "#a06c10", METHOD: "#b8433a"}

Row = dict[str, Any]


def _interval(name: str, digits: int = 3) -> Callable[[Row], str]:
    def text(row: Row) -> str:
        value, low, high = row[name]
        return f"{value:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"

    return text


def _ratio(name: str) -> Callable[[Row], str]:
    return lambda row: _interval("ratio", 3)(row[name])


def _plain(name: str, form: str) -> Callable[[Row], str]:
    return lambda row: format(row[name], form)


_COLUMNS: tuple[tuple[str, str, Callable[[Row], str]], ...] = (
    ("NRMSE", "nrmse", _plain("nrmse", ".3f")),
    ("by the best baseline", "best_baseline", _ratio("best_baseline")),
    ("by the best tuned on the set", "best_on_itself", _ratio("best_on_itself")),
    ("SSIM", "ssim", _plain("ssim", ".3f")),
    ("bias", "bias", _plain("bias", ".3f")),
    ("SD", "deviation", _plain("deviation", ".3f")),
    ("contrast", "contrast", _plain("contrast", ".2f")),
    ("rods seen", "sensitivity", _interval("sensitivity")),
    ("false rods", "false_rods", _interval("false_rods")),
    ("AUC", "auc", _interval("auc")),
    ("observer's SNR", "snr", _plain("snr", ".2f")),
    ("deviance", "deviance", _plain("deviance", ".3f")),
    ("s", "seconds", _plain("seconds", ".2f")),
    ("MB", "megabytes", _plain("megabytes", ".0f")),
)
_LEGEND = """NRMSE: root mean square error by the truth's root mean square. SSIM: in three dimensions, a Gaussian window of
1.5 voxels, 11 wide; range: the truth's. Bias, SD: over draws of noise, root mean squares by the truth's. Contrast: 1 is the
truth's. Rods seen, false rods: shares of sites with and without a rod where more than half of its contrast is (Wilson). AUC:
channelised Hotelling observer, 5 Laguerre-Gauss channels, ten folds. Deviance: of the counts from the volume's images, by
its mean for true means: 1 is right. Intervals are of 95 %; ratios are of mean NRMSE on the same events (paired bootstrap).
"""


def write_report(found: Judgement, folder: Path) -> None:
    """Write the table, ``judgement.md`` and ``.json``, and the picture, ``judgement.png``."""
    write_json(folder / "judgement.json", found.record)
    write_bytes(folder / "judgement.md", markdown(found).encode())
    picture(found).write(folder / "judgement.png")


def markdown(found: Judgement) -> str:
    """The table."""
    columns = [column for column in _COLUMNS if any(column[1] in row for row in found.rows)]
    heads = ["test", "counts", "method", *(head for head, _, _ in columns)]
    lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for row in found.rows:
        name = row["method"] + (f", {ORACLE}" if row["kind"] == ORACLE else "")
        cells = [row["test"], f"{row['level']:g}", name]
        cells += [text(row) if key in row else "" for _, key, text in columns]
        lines.append(f"| {' | '.join(cells)} |")
    sets = [f"- {name}: {test['events']} events, set {test['set']}" for name, test in found.tests.items()]
    sets += [f"- {name}: methods are told {test['believed']}" for name, test in found.tests.items() if test["believed"]]
    notes = dict.fromkeys(f"- {row['test']}: {note}" for row in found.rows for note in row["notes"])
    return "\n".join([*lines, "", _LEGEND, *sets, *notes, ""])


def picture(found: Judgement) -> Page:
    """Slices of truth, best baseline and methods, and the ratios of NRMSE with their intervals."""
    ratios = [row for row in found.rows if "best_baseline" in row and row["kind"] != BASELINE]
    page = Page(_WIDTH, 120 + _ROW * len(found.pictures) + (120 + _LINE * len(ratios) if ratios else 0))
    top = heading(page, "Judgement", ["Middle slices across z; NRMSE by that of the best baseline, 95 % intervals"])
    for title, volumes in found.pictures:
        _slices(page, title, volumes, top)
        top += _ROW
    if ratios:
        _ratios(page, ratios, top + 40)
    return page


def _slices(page: Page, title: str, volumes: list[tuple[str, Volume]], top: int) -> None:
    side = min(_ROW - 50, (page.width - 100) // len(volumes) - 20)
    display, truth = Display("inferno"), volumes[0][1].array
    window = display.window(truth)
    page.text(title, 40, top + side / 2 + 30, page.em, INK, "middle", upward=True)
    for column, (name, volume) in enumerate(volumes):
        left = 70 + column * (side + 20)
        page.text(name, left, top + 20, min(0.7 * page.em, 1.6 * side / len(name)), INK)
        values = volume.array[:, :, volume.array.shape[2] // 2]
        page.image(display.colored(values.T[::-1], window), left, top + 30, side, side)


def _ratios(page: Page, rows: list[Row], top: int) -> None:
    ends = [end for row in rows for end in row["best_baseline"]["ratio"]]
    low, high = min(0.7, *ends), max(1.1, *ends)
    axes = Axes(page, (700, top, page.width - 800, _LINE * len(rows)), (low, high), (len(rows), 0), page.em)
    marks = [mark for mark in np.arange(0.1, 10, 0.1) if low <= mark <= high]
    axes.draw(marks if len(marks) < 20 else [1.0], [])
    page.line([axes.to(1.0, 0), axes.to(1.0, len(rows))], FAINT, 1.5, 6)
    for place, row in enumerate(rows):
        (value, start, end), color, y = row["best_baseline"]["ratio"], _COLORS[row["kind"]], place + 0.5
        page.line([axes.to(start, y), axes.to(end, y)], color, 3)
        x, middle = axes.to(value, y)
        page.area([(x - 5, middle), (x, middle - 5), (x + 5, middle), (x, middle + 5)], color)
        text = f"{row['test']}, {number(row['level'])} of the counts: {row['method']}"
        page.text(text, 680, middle + 5, 0.65 * page.em, INK, "end")
