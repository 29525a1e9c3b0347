"""Figures of all projections of a run, ring by ring."""

from dataclasses import replace
from functools import partial

import numpy as np

from ..runs import letters
from ..runs.display import resize_picture
from ..runs.mosaic import as_seen, tile_places
from .page import Page, box
from .parts import INK, bar_width, color_bar, heading
from .subject import FigureSubject

_NUMBER, _UNDER_NUMBER = "#ffffff", "#000000"  # colours of module numbers, and of the patches below them


def _draw(page: Page, subject: FigureSubject, wide: bool) -> None:
    """Draw the run's projections as numbered tiles in rows by ring; `wide` shows whole images, else their central half."""
    run, em = subject.run, page.em
    assert run is not None
    system = subject.select_modules(run.system)
    images = run.projections[np.isin(run.system.numbers, system.numbers)]
    images = replace(subject.display, region="whole" if wide else "half").part(images)
    rows, columns = images.shape[1:]
    contents = "Wide FOV: whole images" if wide else "FOV: the central half of each image"
    suffix = f" of {subject.name}" if subject.name else ""
    top = heading(page, f"Projections{suffix}", [f"{contents}, {rows} × {columns} pixels"])
    window = subject.display.window(images)
    colors_width = bar_width(page, subject.display, window, run.unit)
    rings = system.rings()
    margin, gap = round(em), max(1, round(0.12 * em))
    label_width = round(letters.width(f"Ring {rings.max() + 1}", 0.85 * em) + 0.8 * em)
    left, width = margin + label_width, page.width - 3 * margin - label_width - colors_width
    height = page.height - top - margin

    def scale(per_row: int) -> float:
        """Return the page's pixels per image pixel if rows hold `per_row` images."""
        n_rows = int(tile_places(rings, per_row)[:, 0].max()) + 1
        return min((width / per_row - gap) / columns, (height / n_rows - gap) / rows)

    longest = int(np.bincount(rings).max())
    per_row = max(sorted({-(-longest // n_parts) for n_parts in range(1, longest + 1)}, reverse=True), key=scale)
    cells = tile_places(rings, per_row)
    tile = max(1, int(rows * scale(per_row))), max(1, int(columns * scale(per_row)))
    corners = cells * (np.array(tile) + gap)
    extent = corners.max(axis=0) + tile
    left += max(0, (width - int(extent[1])) // 2)
    top += max(0, (height - int(extent[0])) // 2)
    sheet = np.full((*extent, 3), 255, np.uint8)
    pictures = subject.display.colored(resize_picture(as_seen(images).transpose(1, 2, 0), *tile), window)
    for m, (row, column) in enumerate(corners):
        sheet[row : row + tile[0], column : column + tile[1]] = pictures[:, :, m]
    page.image(sheet, left, top, int(extent[1]), int(extent[0]))
    size = min(0.85 * em, max(0.17 * tile[0], 0.4 * em))
    for (row, column), number in zip(corners.tolist(), system.numbers.tolist(), strict=True):
        x, y = left + column, top + row
        page.area(box(x, y, letters.width(str(number), size) + 0.5 * size, 1.2 * size), _UNDER_NUMBER, 0.5)
        page.text(str(number), x + 0.25 * size, y + 0.95 * size, size, _NUMBER)
    for ring in np.unique(rings):
        row = corners[rings == ring, 0].min() + tile[0] / 2
        page.text(f"Ring {ring + 1}", left - 0.6 * em, top + row + 0.3 * em, 0.85 * em, INK, "end")
    color_bar(page, subject.display, window, run.unit, left + int(extent[1]) + margin, top, int(extent[0]))


draw_fov = partial(_draw, wide=False)
"""Function that draws the central half of each projection, ``draw_fov(page, subject)``."""
draw_wide_fov = partial(_draw, wide=True)
"""Function that draws the whole projections, ``draw_wide_fov(page, subject)``."""
