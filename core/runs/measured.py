"""Measured counts become a run of a scanner: which frame is which module, how it lies on the crystal, and how long it took.

The first two are never guessed, not even where the number of frames is that of the modules: whoever imports the counts says
them. Times are the files', where they have them.
"""

import math
import operator
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..arrays import Array, ArrayLike
from ..errors import InputError, expecting, naming, number_ranges, warn
from ..files import read_text
from ..geometry.scanner import Detector, Scanner
from ..memory import require
from ..models.model import checked_background, checked_times, with_image_axes
from ..progress import Stages
from ..validation import instance, one_of, real_numbers, require_finite, shape_text
from .counting import live_shares_of, recipe_efficiency, scaled
from .frame_checks import warn_of_frames
from .frame_files import Counts, differs, read_counts
from .orientations import ORIENTATIONS, on_crystal
from .recipe import Recipe, recorded_recipe
from .run import ProjectionRun
from .scatter_windows import ScatterWindows

_MOST_NUMBERS = 1 << 20  # in a list of frames
_MOST_EXACT = 1 << 24  # whole numbers above are rounded in float32
_KEPT = ("system.", "attenuation.", "counts.", "model.", "detector.", "compute.")


def counts_run(
    counts: ArrayLike,
    system: Scanner,
    frames: str | Sequence[int | None] | None = None,
    orientation: str | Sequence[str] | None = None,
    time: ArrayLike | None = None,
    *,
    start: ArrayLike | None = None,
    efficiency: ArrayLike | None = None,
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
        Exposure, s: one number, or those of the modules (M,). None: the files' own. What contradicts them is refused.
    start
        When the first of the frames that are used began, s after the reference time of the activity, by default the
        recipe's, or 0; frames that the files say began later are so much later by themselves. Or the starts of the modules
        (M,); what contradicts the files' differences is refused.
    efficiency
        As in `Emission`, of the run's images; by default the recipe's. Dead pixels, 0, are left out of reconstructions.
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
        A run of counts without a volume, its modules in the order of `system`. Warnings name, by frame and module, what is
        hardly measured: dead modules and pixels that `efficiency` does not declare, bright pixels, equal frames.
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
    recipe = recipe or Recipe()
    used = _in_order(numbers, system)
    called = [f"frame {k + 1} (module {number})" for k, number in enumerate(numbers)]
    time = _times(time, found, used, called)
    start = _starts(recipe["model.start"] if start is None else start, found, used, called)
    _require_counts(array, expected)
    require(4.0 * array.size, f"counts of {shape_text(array.shape)}")
    turned = [on_crystal(frame, word) for frame, word in zip(array, words, strict=True)]
    if len({image.shape for image in turned}) > 1:
        raise InputError("orientation (--orientation): frames that are not square cannot lie both upright and turned")
    frames_of = {"peak": used}
    for word, own in {} if scatter is None else scatter.frames.items():
        with naming(f"{word}_frames (--{word}-frames)"):
            frames_of[word] = _in_order(frame_numbers(own, len(array), system), system)
    of_windows = {word: np.stack([turned[k] for k in own]).astype(np.float32) for word, own in frames_of.items()}
    if detector == "virtual":  # upright, the crystal's image point-inverted
        of_windows = {word: images[:, ::-1, ::-1] for word, images in of_windows.items()}
    images = of_windows["peak"]
    n_v, n_u = images.shape[1:]
    views = system.views((n_v, n_u), detector, magnification, pitch)
    given = {key: value for key, value in recipe.given.items() if key.startswith(_KEPT)}
    given |= {"model.kind": "emission", "model.time": time, "model.start": start, "detector.plane": detector}
    if efficiency is not None and np.ndim(efficiency) < 2:
        given["model.efficiency"] = np.asarray(efficiency).tolist()
    given |= {"detector.rows": n_v, "detector.columns": n_u, "detector.magnification": float(magnification)}
    record = {
        "counts": "measured", "frames": numbers, "orientation": words[0] if len(set(words)) == 1 else words,
        "detector": detector, "magnification": float(magnification),
        "pitch_mm": None if pitch is None else np.broadcast_to(pitch, 2).tolist(), "model": "emission",
        **(settings or {}), "recipe": (made := recorded_recipe(Recipe(given))).tables(),
    }  # fmt: skip
    efficiency = recipe_efficiency(recipe) if efficiency is None else efficiency
    efficiency = checked_background(efficiency, "efficiency (--efficiency)", len(system), (n_v, n_u))
    estimate: Any = None
    if scatter is not None:
        estimate, record["scatter"] = scatter.estimate(of_windows, frames_of, found, efficiency)
    background = scaled(made["model.background"], live_shares_of(made, images, record))
    background = background if estimate is None else with_image_axes(background) + estimate
    known: Any = {"settings": record, "background": background, "efficiency": efficiency}
    run = ProjectionRun(images, system, views, unit="counts", **known)
    _warn_of_others(found, used, words, run)
    warn_of_frames(array, used, called, found.name, time, _declared(run, words, used, array.shape))
    return run


def recipe_counts(recipe: Recipe, system: Scanner, stages: Stages = lambda stage: None) -> ProjectionRun:
    """The run of the measured counts that a recipe names; warns where a file has another pixel size."""
    raw: Any = {name: recipe[f"counts.raw_{name}"] for name in ("shape", "type", "big_endian")}
    found = read_counts(recipe["counts.files"], dataset=recipe["counts.dataset"], **raw, progress=stages("reading"))
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
    if given[:2] == [None, None]:
        return None
    photons = [recipe["model.isotope"], recipe["model.energy_fwhm"]] if recipe["counts.scatter_tails"] else []
    return ScatterWindows(*given, *photons)


def require_given(frames: Any, orientation: Any, time: Any, found: Counts) -> None:
    """Refuse missing arguments; the message names them all, and what is known of the counts."""
    count, rows, columns = found.shape
    texts = {
        "which module each frame is of (--frames, such as 1-80 or 3,1,2)": frames,
        f"how frames lie on the crystal (--orientation, one of {', '.join(ORIENTATIONS)})": orientation,
        "the exposure time in seconds (--time)": found.exposures() or time,
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
    with expecting(f"frames (--frames): expected the modules' numbers, got {values!r:.40}", TypeError):
        return [None if value is None else operator.index(value) for value in values]


def _times(time: Any, found: Counts, used: list[int], called: list[str]) -> float | list[float]:
    """The exposures, s, of the modules whose frames are `used`: one number where they are the same."""
    own = found.about[used, 0]
    if time is None:
        for k, seconds in zip(used, own, strict=True):
            if math.isnan(seconds):
                advice = "say it (--time)"
                raise InputError(f"{found.name}: {called[k]}: the file says no time, of others it does; {advice}")
        return _one_or_all(own)
    given = np.broadcast_to(checked_times(time, "time (--time)", len(used)), len(used))
    wrong = [(k, said, taken) for k, said, taken in zip(used, own, given, strict=True) if differs(said, taken)]
    for k, said, taken in wrong[:1]:
        more = f", and others of {len(wrong) - 1} frames more" if len(wrong) > 1 else ""
        hint = "leave it out to take the file's"
        pair = f"the file says {said:g} s, the time (--time) is {taken:g} s"
        raise InputError(f"{found.name}: {called[k]}: {pair}{more}; {hint}")
    return _one_or_all(given)


def _starts(start: Any, found: Counts, used: list[int], called: list[str]) -> float | list[float]:
    """When the frames `used` started, s after the reference time: one number where they are the same."""
    given = checked_times(start, "start (--start-time)", len(used), is_positive=False)
    first = int(np.argmin(found.about[used, 4]))  # of any that is not known
    said = found.about[used, 4] - found.about[used[first], 4]
    if np.isnan(said).any():
        return _one_or_all(np.broadcast_to(given, len(used)))
    if not isinstance(given, np.ndarray):
        return _one_or_all(given + said)
    taken = given - given[first]
    off = np.abs(said - taken)
    if (off > 1e-3 * (1 + said)).any():
        worst = int(np.argmax(off))
        pair = f"{said[worst]:g} s after {called[used[first]]}, the starts (--start-time) {taken[worst]:g} s"
        hint = "give that of the first frame alone to take the file's"
        raise InputError(f"{found.name}: {called[used[worst]]}: the file says {pair}; {hint}")
    return _one_or_all(given)


def _one_or_all(values: Array) -> float | list[float]:
    return float(values[0]) if np.all(values == values[0]) else values.tolist()


def _declared(run: ProjectionRun, words: list[str], used: list[int], shape: tuple[int, ...]) -> Array:
    """Which numbers of frames (frames, rows, columns) are of pixels that a run's efficiency declares dead."""
    found = np.zeros(shape, bool)
    if np.all(run.efficiency):
        return found
    living = np.broadcast_to(with_image_axes(run.efficiency) > 0, run.projections.shape)
    if run.settings["detector"] == "virtual":
        living = living[:, ::-1, ::-1]
    for k, lives in zip(used, living, strict=True):
        places = on_crystal(np.arange(found[k].size).reshape(shape[1:]), words[k])
        found[k].flat[places[~lives]] = True
    return found


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
    """Warn where the files say another pixel size of the frames `used`, or that they are of several windows."""
    if len(windows := np.unique(found.about[used, 3])) > 1 and np.isfinite(windows).all():
        several = " and ".join(f"{number:g}" for number in windows.tolist())
        what = f"frames of the energy windows {several} are used"
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


def _listed(numbers: Sequence[int]) -> str:
    """Numbers as ranges: "1-3, 7"."""
    texts = number_ranges(numbers)
    return ", ".join(texts if len(texts) <= 6 else [*texts[:5], "…"])
