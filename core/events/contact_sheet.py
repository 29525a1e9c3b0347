"""A picture of some events, one in a row: slices of the truth, the images of all modules, a Radon view, a sinogram."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..arrays import Bytes, Floats, Floats32, Integers
from ..errors import InputError
from ..figures.page import LARGEST, Page, box
from ..figures.parts import number
from ..runs import letters
from ..runs.display import Display, resize_picture, unit_text
from ..runs.mosaic import COLUMNS, as_seen, tile_places
from ..volumes.volume import Volume
from .event_set import Event

_PAPER, _INK, _FAINT, _RULE, _CROSS = "#14161a", "#eceef2", "#98a2b0", "#2b3038", "#ffffff"
_SIDE, _GAP, _GROUP, _MARGIN = 320, 8, 36, 44  # pixels: of a slice; between slices, groups, and to the page's edge
_HEADING, _TITLE, _TEXT = 30.0, 21.0, 15.0  # size of text, pixels
_HEAD, _ABOVE, _BELOW = 96, 66, 50  # pixels above all rows, and above and below a row's pictures
_WIDEST = 1.7  # of a mosaic's width by its height
_SHARE = 0.9995  # of the numbers are not brighter than the last colour: single hot pixels do not darken the others
_NEAR = 0.06  # of the grid's sides: a slice may be so far from the middle where more is to be seen
_MIDDLES, _NEARLY_ALL = (0.5, 0.625, 0.75, 1.0), 0.998
"""Shares of the images' sides: the smallest is shown that has nearly all that there is in every event."""

# The axis across a slice, and those to the right and upward: seen from the head, from the front and from the left.
_SLICES = ((2, 0, 1), (1, 0, 2), (0, 1, 2))


@dataclass(frozen=True, eq=False)
class ShownEvent:
    """What a row of the sheet shows."""

    title: str
    line: str  # beside it
    truth: Volume  # on a grid along the world's axes
    middle: Floats  # (3,), mm: where the slices meet
    model: str = ""
    unit: str = ""
    images: Floats32 | None = None  # (M, n_v, n_u); None for none
    rings: Integers | None = None  # (M,), of the images
    radon: Floats32 | None = None  # (n, n_v, n_u); None for none
    radon_degrees: float = 180.0


def contact_sheet(events: Sequence[Event], model: str | None = None, title: str = "", lines: str = "") -> Page:
    """A page with a row for each event; `title` and `lines` stand above them.

    Parameters
    ----------
    events
        One or more, such as ``[events[0], events[7]]``.
    model
        Whose images are shown; by default the recipe's first.

    Raises
    ------
    InputError
        No events, more than a page holds, or no such model.
    """
    return drawn([shown_event(event, model) for event in events], title, lines)


def shown_event(event: Event, model: str | None = None) -> ShownEvent:
    """What a sheet shows of an event."""
    recipe = event.recipe
    names = [name for name in recipe.models if name in event.models]
    found: dict[str, Any] = {}
    if model is not None or names:
        name = names[0] if model is None else model
        found = {"model": name, "images": event.images(name), "unit": event.unit(name), "rings": event.system.rings()}
    if recipe.radon is not None:
        found |= {"radon": event.radon(max(recipe.radon.counts)), "radon_degrees": recipe.radon.degrees}
    mirrored = ", mirrored" if event.attributes["mirror"] else ""
    line = f"({_listed(event.position)}) mm    (φ, θ, ψ) = ({_listed(event.euler_degrees)})°{mirrored}"
    title = "  ·  ".join(filter(None, (f"Event {event.number}", event.name, event.split)))
    return ShownEvent(title, line, event.truth, event.position, **found)


def drawn(events: Sequence[ShownEvent], title: str = "", lines: str = "") -> Page:
    """The page of what is shown of some events; `InputError` for none, or more than a page holds."""
    row = _ABOVE + _SIDE + _BELOW
    most = (LARGEST - _HEAD) // row
    if not 1 <= len(events) <= most:
        raise InputError(f"contact sheet: expected 1 to {most} events, got {len(events)}")
    share = max((_share(event.images) for event in events if event.images is not None), default=1.0)
    rows = [_panels(event, share) for event in events]
    width = 2 * _MARGIN + max(sum(panel.room for panel in panels) for panels in rows) - _GROUP
    page = Page(width, _HEAD + row * len(rows), _PAPER)
    page.text(title, _MARGIN, 54, _HEADING, _INK)
    page.text(lines, page.width - _MARGIN, 54, _TEXT, _FAINT, "end")
    for index, (event, panels) in enumerate(zip(events, rows, strict=True)):
        top = _HEAD + index * row
        page.line([(_MARGIN, top - 14), (page.width - _MARGIN, top - 14)], _RULE, 1.5)
        page.text(event.title, _MARGIN, top + 20, _TITLE, _INK)
        page.text(event.line, _MARGIN + letters.width(event.title, _TITLE) + 28, top + 20, _TEXT, _FAINT)
        left = _MARGIN
        for panel in panels:
            _draw(page, panel, left, top + _ABOVE)
            left += panel.room
    return page


@dataclass(frozen=True, eq=False)
class _Panel:
    """A picture with words above and below."""

    picture: Bytes  # (h, w, 3)
    width: int  # pixels on the page
    height: int
    above: str = ""
    below: str = ""
    pixels_per_mm: float = 0.0  # where it has a scale bar
    cross: tuple[float, float] | None = None  # pixels from the upper left corner: where the other slices cut it
    gap: int = _GROUP
    frame: int = _SIDE  # columns in whose middle it stands, between `_SIDE` rows

    @property
    def room(self) -> int:
        """Columns that it takes, with the gap that follows."""
        return self.frame + self.gap


def _panels(event: ShownEvent, share: float) -> list[_Panel]:
    """The pictures of an event, from left to right; of the images a share of their sides."""
    panels = _slices(event)
    if event.images is not None and event.rings is not None:
        panels.append(_mosaic(event, event.images, event.rings, share))
    if event.radon is not None:
        panels += _radon(event, event.radon)
    return panels


def _slices(event: ShownEvent) -> list[_Panel]:
    grid, array = event.truth.grid, event.truth.array
    display = Display("inferno" if event.truth.quantity == "activity" else "grey")
    window = 0.0, _bright(array[array > 0])
    index = _telling(event)
    middle = (grid.affine @ [*index, 1.0])[:3]
    extent = grid.spacing * grid.shape
    scale = _SIDE / float(extent.max())
    low = grid.center - extent / 2
    panels: list[_Panel] = []
    for axis, right, up in _SLICES:
        size = max(1, round(float(extent[right]) * scale)), max(1, round(float(extent[up]) * scale))
        across, upward = (float(middle[a] - low[a]) * scale for a in (right, up))
        picture = display.colored(array.take([index[axis]], axis).squeeze(axis).T[::-1], window)
        above, bar = ("", 0.0) if panels else (f"Truth, {_range(window, event.truth.unit)}", scale)
        below = f"{'xyz'[right]} {'xyz'[up]},  {'xyz'[axis]} = {number(round(float(middle[axis]), 1))} mm"
        cross, gap = (across, size[1] - upward), _GROUP if axis == 0 else _GAP
        panels.append(_Panel(picture, *size, above, below, bar, cross, gap, max(size[0], _SIDE // 2)))
    return panels


def _telling(event: ShownEvent) -> list[int]:
    """Indices of the slices: through the middle, or near it where those there have much less in them."""
    grid, array = event.truth.grid, event.truth.array
    place = np.rint((grid.index_from_world @ [*event.middle, 1.0])[:3]).astype(int)
    found = []
    for axis, n in enumerate(grid.shape):
        middle, reach = int(np.clip(place[axis], 0, n - 1)), round(_NEAR * n)
        near = list(range(max(0, middle - reach), min(n, middle + reach + 1)))
        spread = [float(array.take(i, axis).std()) for i in near]
        good = [i for i, s in zip(near, spread, strict=True) if s >= 0.8 * max(spread)]
        found.append(min(good, key=lambda i: abs(i - middle)))
    return found


def _middle(images: Floats32, share: float) -> Floats32:
    """The middle of images (M, n_v, n_u), a share of their sides."""
    off_v, off_u = (round(n * (1 - share) / 2) for n in images.shape[1:])
    return images[:, off_v : images.shape[1] - off_v, off_u : images.shape[2] - off_u]


def _share(images: Floats32) -> float:
    """The smallest of `_MIDDLES` that has nearly all there is."""
    total = float(np.abs(images).sum(dtype=float))
    parts = ((share, float(np.abs(_middle(images, share)).sum(dtype=float))) for share in _MIDDLES)
    return next((share for share, part in parts if part >= _NEARLY_ALL * total), 1.0)


def _mosaic(event: ShownEvent, images: Floats32, rings: Integers, share: float) -> _Panel:
    """All images, ring by ring; a ring takes several rows where that suits the page."""
    whole = images.shape[1:]
    images = _middle(images, share)
    n_v, n_u = images.shape[1:]
    longest = int(np.bincount(rings).max())

    def sides(columns: int) -> tuple[float, int, int]:
        at = tile_places(rings, columns)
        down, across = int(at[:, 0].max()) + 1, int(at[:, 1].max()) + 1
        tile = _SIDE / down / n_v  # pixels of the page to one of the images
        return across * n_u * tile / _SIDE, down, across

    choices = sorted({-(-longest // parts) for parts in range(1, longest + 1)} & set(range(1, COLUMNS + 1)))
    fitting = [columns for columns in choices if sides(columns)[0] <= _WIDEST]
    columns = max(fitting, default=choices[0])
    _, down, across = sides(columns)
    step = min(_SIDE // down, int(_WIDEST * _SIDE) // across)
    tall = max(1, step - 2)
    wide = max(1, min(round(tall * n_u / n_v), int(_WIDEST * _SIDE) // across))
    window = 0.0, _bright(images)
    colors = Display("inferno")
    tiles = colors.colored(resize_picture(as_seen(images).transpose(1, 2, 0), tall, wide), window)
    sheet = np.empty((down * (tall + 2) - 2, across * (wide + 2) - 2, 3), np.uint8)
    sheet[:] = list(bytes.fromhex(_PAPER.removeprefix("#")))
    for m, (row, column) in enumerate(tile_places(rings, columns)):
        top, left = row * (tall + 2), column * (wide + 2)
        sheet[top : top + tall, left : left + wide] = tiles[:, :, m]
    size = sheet.shape[1], sheet.shape[0]
    above = f"{event.model}: {len(images)} views, {_range(window, event.unit)}"
    part = "" if share == 1.0 else f"middle {n_v} × {n_u} of "
    below = f"{part}{whole[0]} × {whole[1]} pixels, ring by ring"
    return _Panel(sheet, *size, above, below, frame=size[0])


def _radon(event: ShownEvent, radon: Floats32) -> list[_Panel]:
    """The view at the first angle, and the sinogram of the row with most in it."""
    count, n_v, n_u = radon.shape
    window = 0.0, _bright(radon)
    display = Display("inferno" if event.truth.quantity == "activity" else "grey")
    scale = _SIDE / max(n_v, n_u)
    size = max(1, round(n_u * scale)), max(1, round(n_v * scale))
    row = int(radon.sum(axis=(0, 2), dtype=float).argmax())
    upper = (n_v - row - 0.5) * scale
    above = f"Radon, {count} angles, {_range(window, f'{event.truth.unit} mm')}"
    view = display.colored(as_seen(radon[0]), window)
    sinogram = display.colored(radon[:, row, ::-1], window)
    return [
        _Panel(view, *size, above, f"at 0°, {n_v} × {n_u} pixels", cross=(-1.0, upper), gap=_GAP, frame=size[0]),
        _Panel(sinogram, size[0], _SIDE, "", f"sinogram, 0 to {event.radon_degrees:g}°", frame=size[0]),
    ]


def _draw(page: Page, panel: _Panel, left: int, top: int) -> None:
    x, y = left + (panel.frame - panel.width) // 2, top + (_SIDE - panel.height) // 2
    page.image(panel.picture, x, y, panel.width, panel.height)
    if panel.cross is not None:
        across, down = panel.cross
        tick = 12
        if 0 <= down <= panel.height:
            for start in (x, x + panel.width - tick):
                page.line([(start, y + down), (start + tick, y + down)], _CROSS, 1.2)
        if 0 <= across <= panel.width:
            for start in (y, y + panel.height - tick):
                page.line([(x + across, start), (x + across, start + tick)], _CROSS, 1.2)
    if panel.pixels_per_mm:
        extent = panel.width / panel.pixels_per_mm
        length = [step for step in (1, 2, 5, 10, 20, 50, 100, 200, 500) if step <= max(1.0, extent / 3)][-1]
        wide = length * panel.pixels_per_mm
        page.area(box(x + 10, y + panel.height - 14, wide, 4), _CROSS)
        page.text(f"{length} mm", x + 10, y + panel.height - 20, _TEXT, _CROSS)
    page.text(panel.above, left, top - 10, _TEXT, _INK)
    page.text(panel.below, left, top + _SIDE + 20, _TEXT, _FAINT)


def _bright(values: Floats32) -> float:
    """The number that gets the last colour."""
    return max(float(np.quantile(values, _SHARE)) if values.size else 0.0, 1e-12)


def _range(window: tuple[float, float], unit: str) -> str:
    largest = f"{window[1]:.0f}" if window[1] >= 1000 else number(window[1], 3)
    return f"0 to {largest} {unit_text(unit)}".rstrip()


def _listed(values: Floats) -> str:
    return ", ".join(number(round(float(value), 1)) for value in values)
