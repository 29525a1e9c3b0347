"""All projections of a run in one figure, ring by ring."""

from dataclasses import replace
from functools import partial

import numpy as np

from ..runs import letters
from ..runs.mosaic import as_seen, places
from ..runs.resizing import resized
from .page import Page, box
from .parts import INK, bar_width, color_bar, heading
from .subject import Subject

_ON_IMAGE, _UNDER_IT = "#ffffff", "#000000"


def _draw(page: Page, subject: Subject, wide: bool) -> None:
    run, em = subject.run, page.em
    assert run is not None
    system = subject.chosen(run.system)
    images = run.projections[np.isin(run.system.numbers, system.numbers)]
    images = replace(subject.display, half=not wide).part(images)
    rows, columns = images.shape[1:]
    what = "Wide FOV: whole images" if wide else "FOV: the central half of each image"
    of_what = f" of {subject.name}" if subject.name else ""
    top = heading(page, f"Projections{of_what}", [f"{what}, {rows} × {columns} pixels"])
    window = subject.display.window(images)
    bar = bar_width(page, subject.display, window, run.unit)
    rings = system.rings()
    margin, gap = round(em), max(1, round(0.12 * em))
    names = round(letters.width(f"Ring {rings.max() + 1}", 0.85 * em) + 0.8 * em)
    left, width = margin + names, page.width - 3 * margin - names - bar
    height = page.height - top - margin

    def scale(across: int) -> float:
        """Pixels of the page to one of the images, for rows of so many images."""
        down = int(places(rings, across)[:, 0].max()) + 1
        return min((width / across - gap) / columns, (height / down - gap) / rows)

    longest = int(np.bincount(rings).max())
    across = max(sorted({-(-longest // parts) for parts in range(1, longest + 1)}, reverse=True), key=scale)
    at = places(rings, across)
    tile = max(1, int(rows * scale(across))), max(1, int(columns * scale(across)))
    corners = at * (np.array(tile) + gap)
    used = corners.max(axis=0) + tile
    left += max(0, (width - int(used[1])) // 2)
    top += max(0, (height - int(used[0])) // 2)
    sheet = np.full((*used, 3), 255, np.uint8)
    pictures = subject.display.colored(resized(as_seen(images).transpose(1, 2, 0), *tile), window)
    for m, (row, column) in enumerate(corners):
        sheet[row : row + tile[0], column : column + tile[1]] = pictures[:, :, m]
    page.image(sheet, left, top, int(used[1]), int(used[0]))
    size = min(0.85 * em, max(0.17 * tile[0], 0.4 * em))
    for (row, column), number in zip(corners.tolist(), system.numbers.tolist(), strict=True):
        x, y = left + column, top + row
        page.area(box(x, y, letters.width(str(number), size) + 0.5 * size, 1.2 * size), _UNDER_IT, 0.5)
        page.text(str(number), x + 0.25 * size, y + 0.95 * size, size, _ON_IMAGE)
    for ring in np.unique(rings):
        row = corners[rings == ring, 0].min() + tile[0] / 2
        page.text(f"Ring {ring + 1}", left - 0.6 * em, top + row + 0.3 * em, 0.85 * em, INK, "end")
    color_bar(page, subject.display, window, run.unit, left + int(used[1]) + margin, top, int(used[0]))


draw_fov = partial(_draw, wide=False)
draw_wide_fov = partial(_draw, wide=True)
