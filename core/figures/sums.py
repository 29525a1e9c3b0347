"""Figure of a volume's orthogonal sums: its line integrals along x, y and z."""

import numpy as np

from ..arrays import Bytes, Floats, Floats32
from ..runs.display import Display, ticks
from ..runs.display import number_text as number
from ..volumes.volume import LINE_INTEGRALS, Volume, require_quantity
from .page import Page
from .parts import INK, PLANES, Axes, arrange, bar_width, color_bar, heading
from .subject import FigureSubject

_ROWS_OF_PANELS = (((0, 1, 2),), ((0,), (1, 2)), ((0,), (1,), (2,)))  # possible arrangements
_Frame = tuple[int, int, int, int]  # left, top, width, height


def orthogonal_sum(volume: Volume, axis: int) -> tuple[Floats32, Floats]:
    """Return a volume's line integrals along world x, y or z (`axis` 0, 1, 2), value x mm, and the box (2, 3) around it, mm.

    The array's indices run along the other two axes, in their order. Its pixels are about as large as the smallest voxel
    edge: on a grid along the axes with cubic voxels each pixel is one row of voxels, so that the values are the array's
    exact sums.
    """
    require_quantity(volume.quantity, LINE_INTEGRALS, "orthogonal sums")
    corners = volume.grid.corners()
    box = np.stack([corners.min(axis=0), corners.max(axis=0)])
    right, up = (a for a in range(3) if a != axis)
    n_pixels = np.maximum(np.rint((box[1] - box[0]) / volume.grid.spacing.min()), 1).astype(int)
    positions = [box[0, a] + (np.arange(n_pixels[a]) + 0.5) * (box[1, a] - box[0, a]) / n_pixels[a] for a in range(3)]
    ends = np.empty((2, n_pixels[right], n_pixels[up], 3))
    ends[..., right], ends[..., up] = positions[right][:, None], positions[up]
    ends[0, ..., axis], ends[1, ..., axis] = box[:, axis] + [-1.0, 1.0]
    from ..rays.tracing import trace_rays  # slow to import, and not needed to list figures

    sums = trace_rays(volume, ends[0].reshape(-1, 3), ends[1].reshape(-1, 3))
    return np.asarray(sums, np.float32).reshape(n_pixels[right], n_pixels[up]), box


def draw(page: Page, subject: FigureSubject) -> None:
    """Draw the three sums in a common colour window, with axes in mm, and the phantom's translation and rotation."""
    volume = subject.volume
    assert volume is not None
    sums = [orthogonal_sum(volume, axis) for axis, _, _ in PLANES]
    display = Display("inferno" if volume.quantity == "activity" else "grey")
    window = display.window(np.concatenate([values.ravel() for values, _ in sums]))
    unit = f"{volume.unit} mm"
    em = page.em
    top = heading(page, f"Orthogonal sums{': ' if subject.name else ''}{subject.name}", _grid_lines(subject))
    bar = bar_width(page, display, window, unit)
    room = 0.0, float(top), page.width - round(4.0 * em) - bar, page.height - top - round(0.5 * em)
    box = sums[0][1]
    extent = (box[1] - box[0]).tolist()
    sizes = [(extent[right], extent[up]) for _, right, up in PLANES]
    scale, corners = arrange(sizes, (4.2 * em, 1.9 * em, 1.2 * em, 3.8 * em), room, *_ROWS_OF_PANELS)
    for panel, ((x, y), (width, height)) in enumerate(zip(corners, sizes, strict=True)):
        frame = round(x), round(y), max(1, round(width * scale)), max(1, round(height * scale))
        _panel(page, panel, display.colored(sums[panel][0].T[::-1], window), box, frame)
    top_row = min(y for _, y in corners)
    bottom_row = max(y + size[1] * scale for (_, y), size in zip(corners, sizes, strict=True))
    color_bar(page, display, window, unit, round(room[2] + 1.5 * em), round(top_row), round(bottom_row - top_row))


def _grid_lines(subject: FigureSubject) -> list[str]:
    """Return lines of text with the volume's position and rotation, and its number and size of voxels."""
    assert subject.volume is not None
    grid, pose = subject.volume.grid, subject.pose
    if pose is None:
        lines = [f"Grid's centre ({_numbers(grid.center)}) mm"]
    else:
        from ..runs.run_recipe import euler_degrees

        angles = euler_degrees(pose)
        rotation = "with a change of size" if angles is None else f"({_numbers(angles)})°"
        lines = [f"T = ({_numbers(pose[:3, 3])}) mm    R = (φ, θ, ψ) = {rotation}"]
    shape, spacing = " × ".join(map(str, grid.shape)), " × ".join(number(s) for s in grid.spacing)
    return [*lines, f"{shape} voxels of {spacing} mm"]


def _numbers(values: object) -> str:
    """Return numbers as text, rounded to three decimals and separated by commas."""
    return ", ".join(number(round(float(value), 3) + 0.0) for value in np.asarray(values))


def _panel(page: Page, panel: int, picture: Bytes, box: Floats, frame: _Frame) -> None:
    """Draw the picture of one sum with its title and axes into `frame` (left, top, width, height)."""
    em, (left, top, width, height) = page.em, frame
    axis, right, up = PLANES[panel]
    page.image(picture, left, top, width, height)
    axes = Axes(page, frame, tuple(box[:, right]), tuple(box[:, up]), em)
    xs, ys = ticks(*axes.x, min(6, int(width / (3.5 * em)))), ticks(*axes.y, min(6, int(height / (2.5 * em))))
    axes.draw(xs, ys, f"Sum along {'xyz'[axis]}", f"{'xyz'[right]}, mm")
    page.text(f"{'xyz'[up]}, mm", left - 2.9 * em, top + height / 2, 0.85 * em, INK, "middle", upward=True)
