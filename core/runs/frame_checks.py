"""What frames of measured counts hardly are, by their numbers: warnings that name frame and pixel."""

import numpy as np

from ..arrays import Array, ArrayLike
from ..errors import warn

_FEW = 10
"""Counts of a frame, and pixels: with more, chance leaves hardly a frame empty, or two frames equal."""
_BRIGHT = 100
"""Times as many counts as its neighbours has no pixel by hole and crystal, whose blur reaches them."""
_WELL = 25
"""Counts in most pixels around one: chance leaves it empty once in 7e10."""
_AROUND = 5  # pixels, the side of what is around one


def warn_of_frames(
    array: Array, used: list[int], called: list[str], name: str, times: ArrayLike, declared: Array
) -> None:
    """Warn of frames that hardly are what modules have counted: empty ones, equal ones, empty and bright pixels.

    Those `used` took `times`, s: rates are compared. Pixels that are `declared` dead are not looked at.
    """
    seconds = dict(zip(used, np.broadcast_to(times, len(used)).tolist(), strict=True))
    counts = {k: np.where(declared[k], 0, array[k]) if declared[k].any() else array[k] for k in used}
    rates = {k: float(counts[k].sum(dtype=float)) / seconds[k] for k in used}
    usual = float(np.median([rate for rate in rates.values() if rate] or [0.0]))
    empty = [k for k in used if not rates[k] and usual * seconds[k] > _FEW and not declared[k].all()]
    if empty:
        others = usual * float(np.median(list(seconds.values())))
        warn(f"{name}: no counts in {_some([called[k] for k in empty])}, {others:g} in others")
    known: dict[bytes, int] = {}
    pairs = [(known.setdefault(counts[k].tobytes(), k), k) for k in used if np.count_nonzero(counts[k]) > _FEW]
    if equal := [f"{called[one]} and {called[k]}" for one, k in pairs if one != k]:
        warn(f"{name}: equal in every pixel: {_some(equal)}")
    dead = [(k, *place) for k in sorted(used) for place in _empty_pixels(counts[k], declared[k])]
    if dead:
        places = _some([f"{called[k]}, row {row + 1}, column {column + 1}" for k, row, column in dead])
        warn(f"{name}: no counts in {places}, {_WELL} and more around; if they are dead, say so (--efficiency)")
    usual = sorted([0.0, *(float(counts[k].max()) / seconds[k] for k in used)])[len(used) // 2]
    for k in used:
        row, column = divmod(int(counts[k].argmax()), array.shape[2])
        near = counts[k][max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]
        *others_near, peak = np.sort(near, axis=None).tolist()
        if peak > _BRIGHT * max(1, usual * seconds[k], *others_near):
            text = f"{called[k]}, row {row + 1}, column {column + 1}: {peak:g} counts"
            around = f"at most {max(others_near, default=0):g} in the pixels around it"
            warn(f"{name}: {text}, {around} and {usual * seconds[k]:g} in others")


def _empty_pixels(counts: Array, declared: Array) -> list[tuple[int, int]]:
    """Row and column of pixels without counts, around which most pixels have many."""
    side = _AROUND // 2
    known = np.pad(np.where(declared, np.nan, counts), side, constant_values=np.nan)
    places = np.argwhere((counts == 0) & ~declared)
    around = np.lib.stride_tricks.sliding_window_view(known, (_AROUND, _AROUND))[tuple(places.T)]
    around = around.reshape(len(places), _AROUND**2)
    likely = np.nansum(around, axis=1) >= _WELL * (1 + side) ** 2 / 2
    places, around = places[likely], around[likely]
    if not len(places):
        return []
    return [(int(row), int(column)) for row, column in places[np.nanmedian(around, axis=1) >= _WELL]]


def _some(texts: list[str]) -> str:
    return "; ".join([*texts[:3], *([f"and {len(texts) - 3} more"] if len(texts) > 3 else [])])
