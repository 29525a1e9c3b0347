"""Orthogonal sums of a volume: its line integrals along x, y and z."""

import numpy as np

from ..arrays import Bytes, Floats, Floats32
from ..runs.display import Display
from ..volumes.volume import LINE_INTEGRALS, Volume, require_quantity
from .page import Page
from .parts import INK, PLANES, Axes, arranged, bar_width, color_bar, heading, number, ticks
from .subject import Subject

_ARRANGED = (((0, 1, 2),), ((0,), (1, 2)), ((0,), (1,), (2,)))
_Frame = tuple[int, int, int, int]  # left, top, width, height


def orthogonal_sum(volume: Volume, axis: int) -> tuple[Floats32, Floats]:
    """Line integrals of a volume along world x, y or z (`axis` 0, 1, 2), value x mm, and the box (2, 3) around it, mm.

    The array's indices go along the other two axes, in their order. Its pixels are about as large as the smallest voxel: on
    a grid along the axes with cubic voxels each is one row of voxels, so that these are the array's exact sums.
    """
    require_quantity(volume.quantity, LINE_INTEGRALS, "orthogonal sums")
    corners = volume.grid.corners()
    box = np.stack([corners.min(axis=0), corners.max(axis=0)])
    right, up = (other for other in range(3) if other != axis)
    counts = np.maximum(np.rint((box[1] - box[0]) / volume.grid.spacing.min()), 1).astype(int)
    at = [box[0, a] + (np.arange(counts[a]) + 0.5) * (box[1, a] - box[0, a]) / counts[a] for a in range(3)]
    ends = np.empty((2, counts[right], counts[up], 3))
    ends[..., right], ends[..., up] = at[right][:, None], at[up]
    ends[0, ..., axis], ends[1, ..., axis] = box[:, axis] + [-1.0, 1.0]
    from ..rays.tracing import trace_rays  # takes a while, and the list of figures needs neither

    sums = trace_rays(volume, ends[0].reshape(-1, 3), ends[1].reshape(-1, 3))
    return np.asarray(sums, np.float32).reshape(counts[right], counts[up]), box


def draw(page: Page, subject: Subject) -> None:
    """The three sums in one window of colours, with axes in mm, and the phantom's translation and rotation."""
    volume = subject.volume
    assert volume is not None
    sums = [orthogonal_sum(volume, axis) for axis, _, _ in PLANES]
    display = Display("inferno" if volume.quantity == "activity" else "grey")
    window = display.window(np.concatenate([values.ravel() for values, _ in sums]))
    unit = f"{volume.unit} mm"
    em = page.em
    top = heading(page, f"Orthogonal sums{': ' if subject.name else ''}{subject.name}", _placed(subject))
    bar = bar_width(page, display, window, unit)
    room = 0.0, float(top), page.width - round(4.0 * em) - bar, page.height - top - round(0.5 * em)
    box = sums[0][1]
    extent = (box[1] - box[0]).tolist()
    sizes = [(extent[right], extent[up]) for _, right, up in PLANES]
    pixels, places = arranged(sizes, (4.2 * em, 1.9 * em, 1.2 * em, 3.8 * em), room, *_ARRANGED)
    for panel, ((x, y), (across, tall)) in enumerate(zip(places, sizes, strict=True)):
        frame = round(x), round(y), max(1, round(across * pixels)), max(1, round(tall * pixels))
        _panel(page, panel, display.colored(sums[panel][0].T[::-1], window), box, frame)
    first = min(y for _, y in places)
    last = max(y + size[1] * pixels for (_, y), size in zip(places, sizes, strict=True))
    color_bar(page, display, window, unit, round(room[2] + 1.5 * em), round(first), round(last - first))


def _placed(subject: Subject) -> list[str]:
    """Lines that say where the volume is and what its voxels are."""
    assert subject.volume is not None
    grid, pose = subject.volume.grid, subject.pose
    if pose is None:
        lines = [f"Grid's centre ({_numbers(grid.center)}) mm"]
    else:
        from ..runs.run_recipe import euler_degrees

        angles = euler_degrees(pose)
        turn = "with a change of size" if angles is None else f"({_numbers(angles)})°"
        lines = [f"T = ({_numbers(pose[:3, 3])}) mm    R = (φ, θ, ψ) = {turn}"]
    shape, spacing = " × ".join(map(str, grid.shape)), " × ".join(number(s) for s in grid.spacing)
    return [*lines, f"{shape} voxels of {spacing} mm"]


def _numbers(values: object) -> str:
    return ", ".join(number(round(float(value), 3) + 0.0) for value in np.asarray(values))


def _panel(page: Page, panel: int, picture: Bytes, box: Floats, frame: _Frame) -> None:
    """One sum with its title and axes."""
    em, (left, top, width, height) = page.em, frame
    axis, right, up = PLANES[panel]
    page.image(picture, left, top, width, height)
    axes = Axes(page, frame, tuple(box[:, right]), tuple(box[:, up]), em)
    xs, ys = ticks(*axes.x, min(6, int(width / (3.5 * em)))), ticks(*axes.y, min(6, int(height / (2.5 * em))))
    axes.draw(xs, ys, f"Sum along {'xyz'[axis]}", f"{'xyz'[right]}, mm")
    page.text(f"{'xyz'[up]}, mm", left - 2.9 * em, top + height / 2, 0.85 * em, INK, "middle", upward=True)
