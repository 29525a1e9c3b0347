"""Measured counts become a run of a scanner: which frame is which module, how it lies on the crystal, and how long it took.

None of these is guessed, not even where the number of frames is that of the modules: whoever imports the counts says it.
"""

import operator
import re
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import Array
from ..errors import InputError, naming, warn
from ..files import read_text
from ..geometry.scanner import Detector, Scanner
from ..memory import require
from ..progress import Stages
from ..validation import instance, one_of, positive, real_numbers, require_finite, shape_text
from .frame_files import Counts, Layout, differs, read_frames
from .orientations import ORIENTATIONS, on_crystal
from .recipe import Recipe, recorded_recipe
from .run import ProjectionRun
from .scatter_windows import ScatterWindows

_MOST_NUMBERS = 1 << 20  # in a list of frames
_FEW = 10
"""Counts of a frame, and pixels: with more, chance leaves hardly a frame empty, or two frames equal."""
_BRIGHT = 100
"""Times as many counts as its neighbours has no pixel by hole and crystal, whose blur reaches them."""
_MOST_EXACT = 1 << 24  # whole numbers above are rounded in float32
_KEPT = ("system.", "attenuation.", "counts.", "model.", "detector.", "compute.")


def counts_run(
    counts: ArrayLike,
    system: Scanner,
    frames: str | Sequence[int | None] | None = None,
    orientation: str | Sequence[str] | None = None,
    time: float | None = None,
    *,
    expected: bool = False,
    detector: Detector = "real",
    magnification: float = 10.0,
    pitch: ArrayLike | None = None,
    recipe: Recipe | None = None,
    settings: Mapping[str, Any] | None = None,
    scatter: ScatterWindows | None = None,
) -> ProjectionRun:
    """The run of a scanner that has measured `counts`.

    Parameters
    ----------
    counts : array of three axes
        A frame for each module, of whole numbers, as they are in the file (`read_counts`), and others that are not used.
    system
        The M modules.
    frames
        Which module each frame is of: the modules' numbers in the frames' order, as a list, or a text such as ``"1-80"``,
        ``"80-1"`` or ``"3,1,2"``; None, in a text ``none``, of a frame that is not used, such as one of another energy
        window (``"1-80, none*80"``).
    orientation
        How the frames lie on the crystals, one of `ORIENTATIONS`, or one for each frame: ``"front+v"`` where a frame, drawn
        with row 0 at the top and column 0 at the left, is the crystal as seen from the pinhole with +v at the top.
    time
        Exposure, s.
    expected
        Whether the numbers are expected means, which may be fractions.
    detector, magnification, pitch
        Where the run's images are taken, see `PinholeSystem.views`; a `pitch` on the real detector is the size of the
        crystal's pixels, by default the crystal's side divided by their number.
    recipe
        Says the rest of the model, for reconstruction: isotope, aperture, crystal, attenuation.
    settings
        More to record in the run.
    scatter
        Frames of other energy windows, from which the scatter in `frames` is estimated: it is added to the run's background.

    Returns
    -------
    ProjectionRun
        A run of counts without a volume, its modules in the order of `system`.
    """
    instance(system, Scanner, "counts: system")
    array = real_numbers(counts, "counts")
    if array.ndim != 3 or not array.size or array.dtype.kind not in "fiu":
        got = f"{array.dtype} {shape_text(array.shape)}"
        raise InputError(f"counts: expected numbers (frames, rows, columns), got {got}")
    found = np.asanyarray(counts).view(Counts)
    require_given(frames, orientation, time, found)
    numbers = frame_numbers(frames, len(array), system)
    words = _words(orientation, len(array))
    time = positive(time, "time (--time)", "s")
    _require_counts(array, expected)
    require(4.0 * array.size, f"counts of {shape_text(array.shape)}")
    turned = [on_crystal(frame, word) for frame, word in zip(array, words, strict=True)]
    if len({image.shape for image in turned}) > 1:
        raise InputError("orientation (--orientation): frames that are not square cannot lie both upright and turned")
    used = {"peak": _in_order(numbers, system)}
    for word, own in {} if scatter is None else scatter.frames.items():
        with naming(f"{word}_frames (--{word}-frames)"):
            used[word] = _in_order(frame_numbers(own, len(array), system), system)
    of_windows = {word: np.stack([turned[k] for k in own]).astype(np.float32) for word, own in used.items()}
    if detector == "virtual":  # upright, the crystal's image point-inverted
        of_windows = {word: images[:, ::-1, ::-1] for word, images in of_windows.items()}
    images = of_windows["peak"]
    n_v, n_u = images.shape[1:]
    views = system.views((n_v, n_u), detector, magnification, pitch)
    given = {key: value for key, value in (recipe or Recipe()).given.items() if key.startswith(_KEPT)}
    given |= {"model.kind": "emission", "model.time": time, "detector.plane": detector}
    given |= {"detector.rows": n_v, "detector.columns": n_u, "detector.magnification": float(magnification)}
    record = {
        "counts": "measured", "frames": numbers, "orientation": words[0] if len(set(words)) == 1 else words,
        "detector": detector, "magnification": float(magnification),
        "pitch_mm": None if pitch is None else np.broadcast_to(pitch, 2).tolist(), "model": "emission",
        **(settings or {}), "recipe": recorded_recipe(Recipe(given)).tables(),
    }  # fmt: skip
    background = given.get("model.background", 0.0)
    if scatter is not None:
        estimate, record["scatter"] = scatter.estimate(of_windows, used, found)
        background = background + estimate
    run = ProjectionRun(images, system, views, unit="counts", settings=record, background=background)
    _warn_of_others(found, used["peak"], words, run)
    _warn_of_frames(array, used["peak"], numbers, found.name)
    return run


def recipe_counts(recipe: Recipe, system: Scanner, stages: Stages = lambda stage: None) -> ProjectionRun:
    """The run of the measured counts that a recipe names; warns where a file has another exposure time or pixel size."""
    layout = Layout(*(recipe[f"counts.{name}"] for name in ("dataset", "raw_shape", "raw_type", "raw_big_endian")))
    found = read_frames(recipe["counts.files"], layout, stages("reading"))
    frames, orientation = recipe["counts.frames"], recipe["counts.orientation"]
    if recipe["counts.frames_file"] is not None:
        frames = read_text(recipe["counts.frames_file"])
    with naming(found.name):
        run = counts_run(
            found, system, frames, orientation[0] if orientation and len(orientation) == 1 else orientation,
            recipe.given.get("model.time"), expected=recipe["counts.expected"],
            detector=recipe.given.get("detector.plane", "real"), magnification=recipe["detector.magnification"],
            pitch=recipe["detector.pitch"], recipe=recipe, settings={"counts": found.name}, scatter=_scatter(recipe),
        )  # fmt: skip
    _require_size(recipe, run, found.name)
    return run


def _scatter(recipe: Recipe) -> ScatterWindows | None:
    """The windows of a recipe from which scatter is estimated."""
    names = "lower_frames", "upper_frames", "window_widths", "scatter_fwhm"
    given = [recipe[f"counts.{name}"] for name in names]
    return None if given[:2] == [None, None] else ScatterWindows(*given)


def require_given(frames: Any, orientation: Any, time: Any, found: Counts) -> None:
    """Refuse missing arguments; the message names them all, and what is known of the counts."""
    count, rows, columns = found.shape
    times = found.exposures()
    confirm = f"; the file says {_and(times)} s: confirm it" if times else ""
    texts = {
        "which module each frame is of (--frames, such as 1-80 or 3,1,2)": frames,
        f"how frames lie on the crystal (--orientation, one of {', '.join(ORIENTATIONS)})": orientation,
        f"the exposure time in seconds (--time{confirm})": time,
    }
    if missing := [text for text, value in texts.items() if value is None]:
        kind = f" ({found.kind})" if found.kind else ""
        what = f"{count} frame{'s' * (count > 1)} of {rows} x {columns} pixels{kind}"
        raise InputError(f"{what}; say {', and '.join(missing)}")


def frame_numbers(frames: Any, count: int, system: Scanner) -> list[int | None]:
    """The modules' numbers in the order of `count` frames, None for a frame that is not used; each module has one frame."""
    found = _parsed(frames) if isinstance(frames, str) else _whole(frames)
    name = "frames (--frames)"
    if len(found) != count:
        hint = "; say none for a frame that is not used, none*80 for 80 of them" if len(found) < count else ""
        raise InputError(f"{name}: expected the modules of {count} frames, got {len(found)} numbers{hint}")
    numbers = [number for number in found if number is not None]
    if twice := sorted({number for number in numbers if numbers.count(number) > 1}):
        raise InputError(f"{name}: module {_listed(twice)} has several frames")
    own = set(map(int, system.numbers))
    if unknown := sorted(set(numbers) - own):
        raise InputError(f"{name}: the scanner has no module {_listed(unknown)}; it has {_listed(sorted(own))}")
    if without := sorted(own - set(numbers)):
        raise InputError(f"{name}: module {_listed(without)} has no frame; leave such modules out with --modules")
    return found


def _in_order(numbers: list[int | None], system: Scanner) -> list[int]:
    """The frames of the system's modules."""
    return [numbers.index(int(number)) for number in system.numbers]


def _parsed(text: str) -> list[int | None]:
    """The numbers of a text such as "1-20, 45, 40-21, none*2"."""
    numbers: list[int | None] = []
    for part in filter(None, re.split(r"[\s,;]+", re.sub(r"\s*([-*])\s*", r"\1", text.strip().lower()))):
        found = re.fullmatch(r"(?:(\d+)(?:-(\d+))?|none(?:\*(\d+))?)", part)
        if found is None:
            raise InputError(f"frames (--frames): {part!r} is no number, no range such as 1-20 or 20-1, and not none")
        first, last = int(found[1] or 1), int(found[2] or found[1] or found[3] or 1)
        if abs(last - first) + len(numbers) >= _MOST_NUMBERS:
            raise InputError(f"frames (--frames): {part} is more than a scanner has modules")
        step = 1 if last >= first else -1
        numbers += [number if found[1] else None for number in range(first, last + step, step)]
    return numbers


def _whole(values: Any) -> list[int | None]:
    try:
        return [None if value is None else operator.index(value) for value in values]
    except TypeError:
        raise InputError(f"frames (--frames): expected the modules' numbers, got {values!r:.40}") from None


def _words(orientation: Any, count: int) -> list[str]:
    words = [orientation] * count if isinstance(orientation, str) else list(orientation)
    if len(words) != count:
        raise InputError(f"orientation (--orientation): expected 1 or {count} words, got {len(words)}")
    for word in words:
        one_of(word, ORIENTATIONS, "orientation (--orientation)")
    return words


def _require_counts(array: Array, expected: bool) -> None:
    """Refuse numbers that are no counts; the message names frame, row and column, from 1."""
    if array.dtype.kind == "f":
        require_finite(array, "counts")
    for wrong, what in (
        (array < 0, "is below 0"),
        (array > _MOST_EXACT, "is more than a pixel can hold exactly"),
        (array != np.rint(array) if array.dtype.kind == "f" and not expected else None, "is no whole number of counts"),
    ):
        if wrong is not None and wrong.any():
            frame, row, column = np.unravel_index(int(np.argmax(wrong)), array.shape)
            hint = "; for expected means say so (--expected)" if "whole" in what else ""
            where = f"frame {frame + 1}, row {row + 1}, column {column + 1}"
            raise InputError(f"counts: {array[frame, row, column]:g} {what} ({where}){hint}")


def _require_size(recipe: Recipe, run: ProjectionRun, names: str) -> None:
    """Refuse a number of pixels, given in the recipe, that the frames do not have."""
    for name, found in zip(("rows", "columns"), run.views.shape, strict=True):
        given = recipe.given.get(f"detector.{name}", found)
        if given != found:
            raise InputError(f"detector.{name}: {given}, but the images of {names} have {found}")


def _warn_of_others(found: Counts, used: list[int], words: list[str], run: ProjectionRun) -> None:
    """Warn where the files say another time or pixel size of the frames `used`, or that they are of several windows."""
    time, times = run.recipe["model.time"], found.exposures(used)
    if any(differs(one, time) for one in times):
        what = "exposures" if len(times) > 1 else "an exposure"
        warn(f"{found.name}: the file says {what} of {_and(times)} s; taken as {time:g} s, as given")
    if len(windows := np.unique(found.about[used, 3])) > 1 and np.isfinite(windows).all():
        what = f"frames of the energy windows {_and(windows.tolist())} are used"
        warn(f"{found.name}: {what}; say none (--frames) for those that are not meant")
    steps = np.linalg.norm([run.views.u_steps, run.views.v_steps], axis=2) / run.settings["magnification"]
    for k, along_u, along_v in zip(used, *steps, strict=True):
        size, own = found.about[k, 1:3], (along_u, along_v)
        own = own[::-1] if words[k].endswith("u") else own  # along the frame's rows, and down its columns
        if any(map(differs, size, own)):
            recorded, taken = (" x ".join(f"{x:.4g}" for x in sizes) for sizes in (size, own))
            covering = "so that they cover the crystal; if the file is right, give their size (--pitch)"
            why = covering if run.settings["pitch_mm"] is None else "as given"
            warn(f"{found.name}: the file says pixels of {recorded} mm; taken as {taken} mm, {why}")
            return


def _warn_of_frames(array: Array, used: list[int], numbers: list[int | None], name: str) -> None:
    """Warn of frames that hardly are what modules have counted: empty ones, equal ones, single bright pixels."""
    called = [f"frame {k + 1} (module {number})" for k, number in enumerate(numbers)]
    sums = {k: float(array[k].sum(dtype=float)) for k in used}
    usual = float(np.median([total for total in sums.values() if total] or [0.0]))
    if usual > _FEW and (empty := [called[k] for k in used if not sums[k]]):
        warn(f"{name}: no counts in {_some(empty)}, {usual:g} in others")
    known: dict[bytes, int] = {}
    pairs = [(known.setdefault(array[k].tobytes(), k), k) for k in used if np.count_nonzero(array[k]) > _FEW]
    if equal := [f"{called[one]} and {called[k]}" for one, k in pairs if one != k]:
        warn(f"{name}: equal in every pixel: {_some(equal)}")
    usual = sorted([0.0, *(float(array[k].max()) for k in used)])[len(used) // 2]
    for k in used:
        row, column = divmod(int(array[k].argmax()), array.shape[2])
        near = array[k, max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]
        *others, peak = np.sort(near, axis=None).tolist()
        if peak > _BRIGHT * max(1, usual, *others):
            text = f"{called[k]}, row {row + 1}, column {column + 1}: {peak:g} counts"
            warn(f"{name}: {text}, at most {max(others, default=0):g} in the pixels around it and {usual:g} in others")


def _and(numbers: Sequence[float]) -> str:
    return " and ".join(f"{number:g}" for number in numbers)


def _some(texts: list[str]) -> str:
    return "; ".join([*texts[:3], *([f"and {len(texts) - 3} more"] if len(texts) > 3 else [])])


def _listed(numbers: Sequence[int]) -> str:
    """Numbers as ranges: "1-3, 7"."""
    cuts = [0, *(i for i in range(1, len(numbers)) if numbers[i] != numbers[i - 1] + 1), len(numbers)]
    parts = [(numbers[a], numbers[b - 1]) for a, b in pairwise(cuts)]
    texts = [f"{a}-{b}" if b > a else str(a) for a, b in parts]
    return ", ".join(texts if len(texts) <= 6 else [*texts[:5], "…"])
