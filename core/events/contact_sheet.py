"""Contact sheet of events, one per row: slices of the truth, images of all modules, a Radon view, a sinogram."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..arrays import Bytes, Floats, Floats32, Integers
from ..errors import InputError
from ..figures.page import LARGEST, Page, box
from ..runs import letters
from ..runs.display import Display, resize_picture, unit_text
from ..runs.display import number_text as number
from ..runs.mosaic import COLUMNS, as_seen, tile_places
from ..volumes.volume import Volume
from .event_set import Event

_PAPER, _INK, _FAINT, _RULE, _CROSS = "#14161a", "#eceef2", "#98a2b0", "#2b3038", "#ffffff"
_SIDE, _GAP, _GROUP, _MARGIN = 320, 8, 36, 44  # pixels: side of a slice; gaps between slices and groups; page margin
_HEADING, _TITLE, _TEXT = 30.0, 21.0, 15.0  # size of text, pixels
_HEAD, _ABOVE, _BELOW = 96, 66, 50  # pixels above all rows, and above and below a row's pictures
_WIDEST = 1.7  # largest ratio of a mosaic's width to its height
_QUANTILE = 0.9995  # quantile of the values at the last colour, so that single hot pixels do not darken the others
_SEARCH = 0.06  # fraction of the grid's side within which a slice with more contrast than the central one is searched
_CENTRAL_FRACTIONS, _ENOUGH = (0.5, 0.625, 0.75, 1.0), 0.998
"""Fractions of the images' sides that may be shown, and the fraction of the counts that the shown part must hold."""

# Axes across a slice, to the right and upward, for views from the head, from the front and from the left.
_SLICES = ((2, 0, 1), (1, 0, 2), (0, 1, 2))


@dataclass(frozen=True, eq=False)
class SheetRow:
    """Content of a row of the contact sheet: texts and arrays of one event."""

    title: str
    """Heading of the row."""
    line: str
    """Text beside the heading."""
    truth: Volume
    """True volume, on a grid along the world's axes."""
    center: Floats
    """Point (3,), mm, near which the three slices intersect."""
    model: str = ""
    """Name of the images' model."""
    unit: str = ""
    """Unit of the images."""
    images: Floats32 | None = None
    """Images (M, n_v, n_u); None for a row without images."""
    rings: Integers | None = None
    """Index (M,) of each module's ring."""
    radon: Floats32 | None = None
    """Parallel projections (n, n_v, n_u), value x mm; None for a row without them."""
    radon_degrees: float = 180.0
    """Range of the projections' angles, degrees."""


def contact_sheet(events: Sequence[Event], model: str | None = None, title: str = "", lines: str = "") -> Page:
    """Draw a page with a row for each event, below `title` and `lines`.

    Parameters
    ----------
    events
        One or more events, such as ``[events[0], events[7]]``.
    model
        Name of the model whose images are shown; by default the recipe's first.

    Raises
    ------
    InputError
        There are no events, more than a page holds, or there is no such model.
    """
    return draw_sheet([sheet_row(event, model) for event in events], title, lines)


def sheet_row(event: Event, model: str | None = None) -> SheetRow:
    """Return the row of an event, with the images of a model, by default the recipe's first."""
    recipe = event.recipe
    names = [name for name in recipe.models if name in event.models]
    fields: dict[str, Any] = {}
    if model is not None or names:
        name = names[0] if model is None else model
        fields = {"model": name, "images": event.images(name), "unit": event.unit(name), "rings": event.system.rings()}
    if recipe.radon is not None:
        fields |= {"radon": event.radon(max(recipe.radon.counts)), "radon_degrees": recipe.radon.degrees}
    mirrored = ", mirrored" if event.attributes["mirror"] else ""
    line = f"({_numbers_text(event.position)}) mm    (φ, θ, ψ) = ({_numbers_text(event.euler_degrees)})°{mirrored}"
    title = "  ·  ".join(filter(None, (f"Event {event.number}", event.name, event.split)))
    return SheetRow(title, line, event.truth, event.position, **fields)


def draw_sheet(rows: Sequence[SheetRow], title: str = "", lines: str = "") -> Page:
    """Draw a page of these rows, below `title` and `lines`; `InputError` for no rows, or more than a page holds."""
    row_height = _ABOVE + _SIDE + _BELOW
    max_rows = (LARGEST - _HEAD) // row_height
    if not 1 <= len(rows) <= max_rows:
        raise InputError(f"contact sheet: expected 1 to {max_rows} events, got {len(rows)}")
    fraction = max((_central_fraction(row.images) for row in rows if row.images is not None), default=1.0)
    panels_by_row = [_row_panels(row, fraction) for row in rows]
    width = 2 * _MARGIN + max(sum(panel.width_with_gap for panel in panels) for panels in panels_by_row) - _GROUP
    page = Page(width, _HEAD + row_height * len(panels_by_row), _PAPER)
    page.text(title, _MARGIN, 54, _HEADING, _INK)
    page.text(lines, page.width - _MARGIN, 54, _TEXT, _FAINT, "end")
    for index, (row, panels) in enumerate(zip(rows, panels_by_row, strict=True)):
        top = _HEAD + index * row_height
        page.line([(_MARGIN, top - 14), (page.width - _MARGIN, top - 14)], _RULE, 1.5)
        page.text(row.title, _MARGIN, top + 20, _TITLE, _INK)
        page.text(row.line, _MARGIN + letters.width(row.title, _TITLE) + 28, top + 20, _TEXT, _FAINT)
        left = _MARGIN
        for panel in panels:
            _draw_panel(page, panel, left, top + _ABOVE)
            left += panel.width_with_gap
    return page


@dataclass(frozen=True, eq=False)
class _Panel:
    """A picture of a row, with texts above and below."""

    picture: Bytes  # (h, w, 3), colours
    width: int  # page pixels
    height: int  # page pixels
    above: str = ""  # text above the picture
    below: str = ""  # text below the picture
    pixels_per_mm: float = 0.0  # scale of the scale bar; 0: no bar
    cross: tuple[float, float] | None = None  # crossing of the other slices, page pixels from the upper left corner
    gap: int = _GROUP  # page pixels between this panel and the next
    frame: int = _SIDE  # page columns of the frame, `_SIDE` rows high, in which the picture is centred

    @property
    def width_with_gap(self) -> int:
        """The page columns that the panel takes, its gap included."""
        return self.frame + self.gap


def _row_panels(row: SheetRow, fraction: float) -> list[_Panel]:
    """Return the panels of a row, from left to right; of the images, the central `fraction` of their sides is shown."""
    panels = _slice_panels(row)
    if row.images is not None and row.rings is not None:
        panels.append(_mosaic_panel(row, row.images, row.rings, fraction))
    if row.radon is not None:
        panels += _radon_panels(row, row.radon)
    return panels


def _slice_panels(row: SheetRow) -> list[_Panel]:
    """Return the panels of the three orthogonal slices through the truth."""
    grid, array = row.truth.grid, row.truth.array
    display = Display("inferno" if row.truth.quantity == "activity" else "grey")
    window = 0.0, _upper_limit(array[array > 0])
    index = list(_slice_indices(row))
    point = (grid.affine @ [*index, 1.0])[:3]
    extent = grid.spacing * grid.shape
    scale = _SIDE / float(extent.max())
    low = grid.center - extent / 2
    panels: list[_Panel] = []
    for axis, right, up in _SLICES:
        size = max(1, round(float(extent[right]) * scale)), max(1, round(float(extent[up]) * scale))
        across, upward = (float(point[a] - low[a]) * scale for a in (right, up))
        picture = display.colored(array.take([index[axis]], axis).squeeze(axis).T[::-1], window)
        above, bar = ("", 0.0) if panels else (f"Truth, {_range_text(window, row.truth.unit)}", scale)
        below = f"{'xyz'[right]} {'xyz'[up]},  {'xyz'[axis]} = {number(round(float(point[axis]), 1))} mm"
        cross, gap = (across, size[1] - upward), _GROUP if axis == 0 else _GAP
        panels.append(_Panel(picture, *size, above, below, bar, cross, gap, max(size[0], _SIDE // 2)))
    return panels


def _slice_indices(row: SheetRow) -> Iterator[int]:
    """Yield the index of the slice along each axis: the one nearest to the row's centre with enough contrast.

    Contrast is the standard deviation of a slice; enough is 80 % of the largest within `_SEARCH` of the grid's side.
    """
    grid, array = row.truth.grid, row.truth.array
    center_index = np.rint((grid.index_from_world @ [*row.center, 1.0])[:3]).astype(int)
    for axis, n in enumerate(grid.shape):
        center, reach = int(np.clip(center_index[axis], 0, n - 1)), round(_SEARCH * n)
        candidates = list(range(max(0, center - reach), min(n, center + reach + 1)))
        contrasts = [float(array.take(i, axis).std()) for i in candidates]
        promising = [i for i, s in zip(candidates, contrasts, strict=True) if s >= 0.8 * max(contrasts)]
        yield min(promising, key=lambda i: abs(i - center))


def _central_part(images: Floats32, fraction: float) -> Floats32:
    """Return the central part of images (M, n_v, n_u), a fraction of their sides."""
    margin_v, margin_u = (round(n * (1 - fraction) / 2) for n in images.shape[1:])
    return images[:, margin_v : images.shape[1] - margin_v, margin_u : images.shape[2] - margin_u]


def _central_fraction(images: Floats32) -> float:
    """Return the smallest of `_CENTRAL_FRACTIONS` whose central part holds `_ENOUGH` of the images' sum."""
    total = float(np.abs(images).sum(dtype=float))
    sums = ((f, float(np.abs(_central_part(images, f)).sum(dtype=float))) for f in _CENTRAL_FRACTIONS)
    return next((f for f, part_sum in sums if part_sum >= _ENOUGH * total), 1.0)


def _mosaic_panel(row: SheetRow, images: Floats32, rings: Integers, fraction: float) -> _Panel:
    """Return the panel of all images, ring by ring; a long ring takes several rows, so that the panel fits the page."""
    full_shape = images.shape[1:]
    images = _central_part(images, fraction)
    n_v, n_u = images.shape[1:]
    longest = int(np.bincount(rings).max())

    def mosaic_size(columns: int) -> tuple[float, int, int]:
        """Return the width of a mosaic of height 1, and its numbers of tiles down and across."""
        positions = tile_places(rings, columns)
        n_down, n_across = int(positions[:, 0].max()) + 1, int(positions[:, 1].max()) + 1
        tile = _SIDE / n_down / n_v  # page pixels per image pixel
        return n_across * n_u * tile / _SIDE, n_down, n_across

    choices = sorted({-(-longest // n_rows) for n_rows in range(1, longest + 1)} & set(range(1, COLUMNS + 1)))
    fitting = [columns for columns in choices if mosaic_size(columns)[0] <= _WIDEST]
    columns = max(fitting, default=choices[0])
    _, n_down, n_across = mosaic_size(columns)
    tile_side = min(_SIDE // n_down, int(_WIDEST * _SIDE) // n_across)
    tall = max(1, tile_side - 2)
    wide = max(1, min(round(tall * n_u / n_v), int(_WIDEST * _SIDE) // n_across))
    window = 0.0, _upper_limit(images)
    display = Display("inferno")
    tiles = display.colored(resize_picture(as_seen(images).transpose(1, 2, 0), tall, wide), window)
    sheet = np.empty((n_down * (tall + 2) - 2, n_across * (wide + 2) - 2, 3), np.uint8)
    sheet[:] = list(bytes.fromhex(_PAPER.removeprefix("#")))
    for m, (tile_row, tile_column) in enumerate(tile_places(rings, columns)):
        top, left = tile_row * (tall + 2), tile_column * (wide + 2)
        sheet[top : top + tall, left : left + wide] = tiles[:, :, m]
    size = sheet.shape[1], sheet.shape[0]
    above = f"{row.model}: {len(images)} views, {_range_text(window, row.unit)}"
    cropping = "" if fraction == 1.0 else f"middle {n_v} × {n_u} of "
    below = f"{cropping}{full_shape[0]} × {full_shape[1]} pixels, ring by ring"
    return _Panel(sheet, *size, above, below, frame=size[0])


def _radon_panels(row: SheetRow, radon: Floats32) -> list[_Panel]:
    """Return two panels: the Radon image at the first angle, and the sinogram of the pixel row with the largest sum."""
    n_angles, n_v, n_u = radon.shape
    window = 0.0, _upper_limit(radon)
    display = Display("inferno" if row.truth.quantity == "activity" else "grey")
    scale = _SIDE / max(n_v, n_u)
    size = max(1, round(n_u * scale)), max(1, round(n_v * scale))
    brightest_row = int(radon.sum(axis=(0, 2), dtype=float).argmax())
    cross_height = (n_v - brightest_row - 0.5) * scale
    above = f"Radon, {n_angles} angles, {_range_text(window, f'{row.truth.unit} mm')}"
    view = display.colored(as_seen(radon[0]), window)
    sinogram = display.colored(radon[:, brightest_row, ::-1], window)
    return [
        _Panel(view, *size, above, f"at 0°, {n_v} × {n_u} pixels", cross=(-1.0, cross_height), gap=_GAP, frame=size[0]),
        _Panel(sinogram, size[0], _SIDE, "", f"sinogram, 0 to {row.radon_degrees:g}°", frame=size[0]),
    ]


def _draw_panel(page: Page, panel: _Panel, left: int, top: int) -> None:
    """Draw a panel with its texts, cross ticks and scale bar, its frame's upper left corner at (left, top)."""
    x, y = left + (panel.frame - panel.width) // 2, top + (_SIDE - panel.height) // 2
    page.image(panel.picture, x, y, panel.width, panel.height)
    if panel.cross is not None:
        (across, down), tick = panel.cross, 12
        if 0 <= down <= panel.height:
            for start in (x, x + panel.width - tick):
                page.line([(start, y + down), (start + tick, y + down)], _CROSS, 1.2)
        if 0 <= across <= panel.width:
            for start in (y, y + panel.height - tick):
                page.line([(x + across, start), (x + across, start + tick)], _CROSS, 1.2)
    if panel.pixels_per_mm:
        extent = panel.width / panel.pixels_per_mm
        length = [step for step in (1, 2, 5, 10, 20, 50, 100, 200, 500) if step <= max(1.0, extent / 3)][-1]
        page.area(box(x + 10, y + panel.height - 14, length * panel.pixels_per_mm, 4), _CROSS)
        page.text(f"{length} mm", x + 10, y + panel.height - 20, _TEXT, _CROSS)
    page.text(panel.above, left, top - 10, _TEXT, _INK)
    page.text(panel.below, left, top + _SIDE + 20, _TEXT, _FAINT)


def _upper_limit(values: Floats32) -> float:
    """Return the value that gets the last colour: the quantile `_QUANTILE` of the values."""
    return max(float(np.quantile(values, _QUANTILE)) if values.size else 0.0, 1e-12)


def _range_text(window: tuple[float, float], unit: str) -> str:
    """Return the text of a range of values, such as "0 to 12.3 counts"."""
    largest = f"{window[1]:.0f}" if window[1] >= 1000 else number(window[1], 3)
    return f"0 to {largest} {unit_text(unit)}".rstrip()


def _numbers_text(values: Floats) -> str:
    """Return the text of numbers rounded to 0.1, with commas between."""
    return ", ".join(number(round(float(value), 1)) for value in values)
