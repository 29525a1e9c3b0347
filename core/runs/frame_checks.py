"""Checks of frames of measured counts: warnings of improbable numbers, which name frame and pixel."""

import numpy as np

from ..arrays import Array, ArrayLike
from ..errors import warn

_FEW = 10
"""Expected counts of a frame, and pixels with counts, above which chance makes no frame empty and no two frames equal."""
_BRIGHT = 100
"""Ratio of a pixel's counts to its neighbours' that the blur of hole and crystal does not allow."""
_WELL = 25
"""Median counts around a pixel, with which a live pixel is empty by chance once in 7e10."""
_SIDE = 5  # side of the neighbourhood of a pixel, in pixels


def warn_of_frames(
    array: Array, used: list[int], labels: list[str], name: str, times: ArrayLike, declared_dead: Array
) -> None:
    """Warn of frames that modules have hardly measured: empty frames, equal frames, empty pixels and bright pixels.

    Parameters
    ----------
    array
        Counts (frames, rows, columns).
    used, labels
        Indices of the frames to check, and the names of all frames in messages.
    name
        Name of the files, with which messages begin.
    times
        Exposures of the frames `used`, s, one number or one for each; rates are compared.
    declared_dead
        Mask (frames, rows, columns) of pixels that are known to be dead and are not checked.
    """
    seconds = dict(zip(used, np.broadcast_to(times, len(used)).tolist(), strict=True))
    counts = {k: np.where(declared_dead[k], 0, array[k]) if declared_dead[k].any() else array[k] for k in used}
    rates = {k: float(counts[k].sum(dtype=float)) / seconds[k] for k in used}
    usual_rate = float(np.median([rate for rate in rates.values() if rate] or [0.0]))
    if empty := [k for k in used if not rates[k] and usual_rate * seconds[k] > _FEW and not declared_dead[k].all()]:
        typical = usual_rate * float(np.median(list(seconds.values())))
        warn(f"{name}: no counts in {_some([labels[k] for k in empty])}, {typical:g} in others")
    first_frames: dict[bytes, int] = {}
    pairs = [(first_frames.setdefault(counts[k].tobytes(), k), k) for k in used if np.count_nonzero(counts[k]) > _FEW]
    if equal := [f"{labels[first]} and {labels[k]}" for first, k in pairs if first != k]:
        warn(f"{name}: equal in every pixel: {_some(equal)}")
    if dead := [(k, *place) for k in sorted(used) for place in _empty_pixels(counts[k], declared_dead[k])]:
        listed = _some([f"{labels[k]}, row {row + 1}, column {column + 1}" for k, row, column in dead])
        warn(f"{name}: no counts in {listed}, {_WELL} and more around; if they are dead, say so (--efficiency)")
    usual_peak_rate = sorted([0.0, *(float(counts[k].max()) / seconds[k] for k in used)])[len(used) // 2]
    for k in used:
        row, column = divmod(int(counts[k].argmax()), array.shape[2])
        neighborhood = counts[k][max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]
        *neighbors, peak = np.sort(neighborhood, axis=None).tolist()
        if peak > _BRIGHT * max(1, usual_peak_rate * seconds[k], *neighbors):
            text = f"{labels[k]}, row {row + 1}, column {column + 1}: {peak:g} counts"
            comparison = f"at most {max(neighbors, default=0):g} in the pixels around it"
            warn(f"{name}: {text}, {comparison} and {usual_peak_rate * seconds[k]:g} in others")


def _empty_pixels(counts: Array, declared_dead: Array) -> list[tuple[int, int]]:
    """Return row and column of pixels without counts in a frame, around which most pixels have `_WELL` counts or more."""
    half = _SIDE // 2
    padded = np.pad(np.where(declared_dead, np.nan, counts), half, constant_values=np.nan)
    places = np.argwhere((counts == 0) & ~declared_dead)
    neighborhoods = np.lib.stride_tricks.sliding_window_view(padded, (_SIDE, _SIDE))[tuple(places.T)]
    neighborhoods = neighborhoods.reshape(len(places), _SIDE**2)
    is_likely = np.nansum(neighborhoods, axis=1) >= _WELL * (1 + half) ** 2 / 2
    places, neighborhoods = places[is_likely], neighborhoods[is_likely]
    if not len(places):
        return []
    return [(int(row), int(column)) for row, column in places[np.nanmedian(neighborhoods, axis=1) >= _WELL]]


def _some(texts: list[str]) -> str:
    """Return the first three texts, and the number of the others."""
    return "; ".join([*texts[:3], *([f"and {len(texts) - 3} more"] if len(texts) > 3 else [])])
