"""Runs of measured counts: frames become the images of modules, with their orientation on the crystal and their exposure.

The module of each frame and its orientation are never guessed, not even if there are as many frames as modules: the user
gives them. Exposures are those of the files, if these state them.
"""

import math
import operator
import re
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from ..arrays import Array, ArrayLike
from ..errors import InputError, expecting, naming, number_ranges, several, warn
from ..files import read_text
from ..geometry.scanner import Detector, Scanner
from ..memory import require
from ..models.model import checked_background, checked_times, with_image_axes
from ..progress import Stages
from ..validation import instance, one_of, real_numbers, require_finite, shape_text
from .counting import recipe_efficiency, recorded_shares, scale_by_module
from .frame_checks import warn_of_frames
from .frame_files import Counts, differs, read_counts
from .orientations import ORIENTATIONS, on_crystal
from .recipe import Recipe, recorded_recipe
from .run import ProjectionRun
from .scatter_windows import ScatterWindows

_MAX_FRAMES = 1 << 20  # length of the longest list of frames
_MAX_EXACT = 1 << 24  # largest number up to which float32 holds all whole numbers
_RECORDED = ("system.", "attenuation.", "counts.", "model.", "detector.", "compute.")  # settings that a run records


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
    """Return the run of a scanner that has measured `counts`.

    Parameters
    ----------
    counts : array of three axes
        Frames (frames, rows, columns) of whole numbers as in the file (`read_counts`): one for each module, and unused ones.
    system
        Scanner with the M modules.
    frames
        Numbers of the modules in the order of the frames, as a list, or as a text such as ``"1-80"``, ``"80-1"`` or
        ``"3,1,2"``; None, in a text ``none``, for an unused frame, such as one of another energy window
        (``"1-80, none*80"``).
    orientation
        Orientation of the frames on the crystals, one of `ORIENTATIONS`, or one for each frame. ``"front+v"``: a frame,
        drawn with row 0 at the top and column 0 at the left, is the crystal as seen from the pinhole with +v at the top.
    time
        Exposure, s: one number, or one for each module (M,). None for the exposures in the files, which a number must not
        contradict.
    start
        Start of the first used frame, s after the reference time of the activity; by default the recipe's start, or 0.
        Later starts that the files state are added. Or the starts of the modules (M,), which must not contradict the files.
    efficiency
        Detection efficiency of the images as in `Emission`; by default the recipe's. Reconstructions leave out dead pixels,
        whose efficiency is 0.
    expected
        Whether the numbers are expected counts, which may be fractions.
    detector, magnification, pitch
        Detector of the run's images, see `PinholeSystem.views`; `pitch` on the real detector is the size of the crystal's
        pixels, by default the crystal's side divided by their number.
    recipe
        Recipe with the rest of the model, for reconstruction: isotope, aperture, crystal, attenuation.
    settings
        Further entries of the run's record.
    scatter
        Frames of other energy windows, from which scatter is estimated and added to the run's background.

    Returns
    -------
    ProjectionRun
        Run of counts without a volume, with the modules in the order of `system`.

    Warns
    -----
    InputWarning
        Frames that are hardly measured, by frame and module: dead modules and pixels that `efficiency` does not declare,
        bright pixels, equal frames.
    """
    instance(system, Scanner, "counts: system")
    array = real_numbers(counts, "counts")
    if array.ndim != 3 or not array.size or array.dtype.kind not in "fiu":
        got = f"{array.dtype} {shape_text(array.shape)}"
        raise InputError(f"counts: expected numbers (frames, rows, columns), got {got}")
    frames_read = np.asanyarray(counts).view(Counts)
    _require_arguments(frames, orientation, time, frames_read)
    numbers = frame_numbers(frames, len(array), system)
    words = _orientations(orientation, len(array))
    recipe = recipe or Recipe()
    used = _module_frames(numbers, system)
    labels = [f"frame {k + 1} (module {number})" for k, number in enumerate(numbers)]
    time = _exposures(time, frames_read, used, labels)
    start = _frame_starts(recipe["model.start"] if start is None else start, frames_read, used, labels)
    _require_counts(array, expected)
    require(4.0 * array.size, f"counts of {shape_text(array.shape)}")
    turned = [on_crystal(frame, word) for frame, word in zip(array, words, strict=True)]
    if len({image.shape for image in turned}) > 1:
        raise InputError("orientation (--orientation): frames that are not square cannot lie both upright and turned")
    indices = {"peak": used}
    for word, modules in {} if scatter is None else scatter.frames.items():
        with naming(f"{word}_frames (--{word}-frames)"):
            indices[word] = _module_frames(frame_numbers(modules, len(array), system), system)
    window_images = {word: np.stack([turned[k] for k in ks]).astype(np.float32) for word, ks in indices.items()}
    if detector == "virtual":  # upright: the image on the crystal, point-inverted
        window_images = {word: images[:, ::-1, ::-1] for word, images in window_images.items()}
    images = window_images["peak"]
    n_v, n_u = images.shape[1:]
    views = system.views((n_v, n_u), detector, magnification, pitch)
    values = {key: value for key, value in recipe.given.items() if key.startswith(_RECORDED)}
    values |= {"model.kind": "emission", "model.time": time, "model.start": start, "detector.plane": detector}
    if efficiency is not None and np.ndim(efficiency) < 2:
        values["model.efficiency"] = np.asarray(efficiency).tolist()
    values |= {"detector.rows": n_v, "detector.columns": n_u, "detector.magnification": float(magnification)}
    record = {
        "counts": "measured", "frames": numbers, "orientation": words[0] if len(set(words)) == 1 else words,
        "detector": detector, "magnification": float(magnification),
        "pitch_mm": None if pitch is None else np.broadcast_to(pitch, 2).tolist(), "model": "emission",
        **(settings or {}), "recipe": (model_recipe := recorded_recipe(Recipe(values))).tables(),
    }  # fmt: skip
    efficiency = recipe_efficiency(recipe) if efficiency is None else efficiency
    efficiency = checked_background(efficiency, "efficiency (--efficiency)", len(system), (n_v, n_u))
    estimate: Any = None
    if scatter is not None:
        estimate, record["scatter"] = scatter.estimate(window_images, indices, frames_read, efficiency)
    background = scale_by_module(model_recipe["model.background"], recorded_shares(model_recipe, images, record))
    background = background if estimate is None else with_image_axes(background) + estimate
    fields: Any = {"settings": record, "background": background, "efficiency": efficiency}
    run = ProjectionRun(images, system, views, unit="counts", **fields)
    _warn_of_contradictions(frames_read, used, words, run)
    warn_of_frames(array, used, labels, frames_read.name, time, _declared_dead(run, words, used, array.shape))
    return run


def recipe_counts(recipe: Recipe, system: Scanner, stages: Stages = lambda stage: None) -> ProjectionRun:
    """Return the run of the measured counts that a recipe names; warn of a file with another pixel size."""
    raw: Any = {name: recipe[f"counts.raw_{name}"] for name in ("shape", "type", "big_endian")}
    counts = read_counts(recipe["counts.files"], dataset=recipe["counts.dataset"], **raw, progress=stages("reading"))
    frames, orientation = recipe["counts.frames"], recipe["counts.orientation"]
    if recipe["counts.frames_file"] is not None:
        frames = read_text(recipe["counts.frames_file"])
    with naming(counts.name):
        run = counts_run(
            counts, system, frames, orientation[0] if orientation and len(orientation) == 1 else orientation,
            recipe.given.get("model.time"), expected=recipe["counts.expected"],
            detector=recipe.given.get("detector.plane", "real"), magnification=recipe["detector.magnification"],
            pitch=recipe["detector.pitch"], recipe=recipe, settings={"counts": counts.name}, scatter=_windows(recipe),
        )  # fmt: skip
    _require_pixels(recipe, run, counts.name)
    return run


def _windows(recipe: Recipe) -> ScatterWindows | None:
    """Return the energy windows of a recipe from which scatter is estimated; None if it names none."""
    names = "lower_frames", "upper_frames", "window_widths", "scatter_fwhm"
    arguments = [recipe[f"counts.{name}"] for name in names]
    if arguments[:2] == [None, None]:
        return None
    photons = [recipe["model.isotope"], recipe["model.energy_fwhm"]] if recipe["counts.scatter_tails"] else []
    return ScatterWindows(*arguments, *photons)


def _require_arguments(frames: Any, orientation: Any, time: Any, counts: Counts) -> None:
    """Raise `InputError` for missing arguments of `counts_run`; the message names them all, and describes the counts."""
    n_frames, rows, columns = counts.shape
    texts = {
        "which module each frame is of (--frames, such as 1-80 or 3,1,2)": frames,
        f"how frames lie on the crystal (--orientation, one of {', '.join(ORIENTATIONS)})": orientation,
        "the exposure time in seconds (--time)": counts.exposures() or time,
    }
    if missing := [text for text, value in texts.items() if value is None]:
        kind = f" ({counts.kind})" if counts.kind else ""
        summary = f"{n_frames} frame{'s' * (n_frames > 1)} of {rows} x {columns} pixels{kind}"
        raise InputError(f"{summary}; say {', and '.join(missing)}")


def frame_numbers(frames: Any, n_frames: int, system: Scanner) -> list[int | None]:
    """Return the modules' numbers in the order of the frames, None for an unused frame; each module must have one frame."""
    result = _parse_numbers(frames) if isinstance(frames, str) else _whole_numbers(frames)
    name = "frames (--frames)"
    if len(result) != n_frames:
        hint = "; say none for a frame that is not used, none*80 for 80 of them" if len(result) < n_frames else ""
        raise InputError(f"{name}: expected the modules of {n_frames} frames, got {len(result)} numbers{hint}")
    numbers = [number for number in result if number is not None]
    if repeated := sorted({number for number in numbers if numbers.count(number) > 1}):
        raise InputError(f"{name}: module {_ranges(repeated)} has several frames")
    modules = set(map(int, system.numbers))
    if unknown := sorted(set(numbers) - modules):
        raise InputError(f"{name}: the scanner has no module {_ranges(unknown)}; it has {_ranges(sorted(modules))}")
    if unused := sorted(modules - set(numbers)):
        raise InputError(f"{name}: module {_ranges(unused)} has no frame; leave such modules out with --modules")
    return result


def _module_frames(numbers: list[int | None], system: Scanner) -> list[int]:
    """Return the indices of the frames of the system's modules."""
    return [numbers.index(int(number)) for number in system.numbers]


def _parse_numbers(text: str) -> list[int | None]:
    """Return the numbers of a text such as "1-20, 45, 40-21, none*2", None for "none"."""
    numbers: list[int | None] = []
    for part in filter(None, re.split(r"[\s,;]+", re.sub(r"\s*([-*])\s*", r"\1", text.strip().lower()))):
        if (match := re.fullmatch(r"(?:(\d+)(?:-(\d+))?|none(?:\*(\d+))?)", part)) is None:
            raise InputError(f"frames (--frames): {part!r} is no number, no range such as 1-20 or 20-1, and not none")
        first, last = int(match[1] or 1), int(match[2] or match[1] or match[3] or 1)
        if abs(last - first) + len(numbers) >= _MAX_FRAMES:
            raise InputError(f"frames (--frames): {part} is more than a scanner has modules")
        step = 1 if last >= first else -1
        numbers += [number if match[1] else None for number in range(first, last + step, step)]
    return numbers


def _whole_numbers(values: Any) -> list[int | None]:
    """Return a sequence of whole numbers and None as a list."""
    with expecting(f"frames (--frames): expected the modules' numbers, got {values!r:.40}", TypeError):
        return [None if value is None else operator.index(value) for value in values]


def _exposures(time: Any, counts: Counts, used: list[int], labels: list[str]) -> float | list[float]:
    """Return the exposures, s, of the modules whose frames are `used`, one number if they are equal.

    `time` is the user's, one number or one per module, or None for the file's; `labels` name the frames in messages. Raises
    `InputError` if an exposure is missing, or contradicts the file's.
    """
    exposures = counts.about[used, 0]
    if time is None:
        for k, seconds in zip(used, exposures, strict=True):
            if math.isnan(seconds):
                advice = "say it (--time)"
                raise InputError(f"{counts.name}: {labels[k]}: the file says no time, of others it does; {advice}")
        return _one_or_list(exposures)
    times = np.broadcast_to(checked_times(time, "time (--time)", len(used)), len(used))
    triples = zip(used, exposures, times, strict=True)
    contradictions = [(k, stated, seconds) for k, stated, seconds in triples if differs(stated, seconds)]
    for k, stated, seconds in contradictions[:1]:
        rest = f", and others of {len(contradictions) - 1} frames more" if len(contradictions) > 1 else ""
        hint = "leave it out to take the file's"
        pair = f"the file says {stated:g} s, the time (--time) is {seconds:g} s"
        raise InputError(f"{counts.name}: {labels[k]}: {pair}{rest}; {hint}")
    return _one_or_list(times)


def _frame_starts(start: Any, counts: Counts, used: list[int], labels: list[str]) -> float | list[float]:
    """Return the starts of the frames `used`, s after the reference time, one number if they are equal.

    Raises `InputError` if starts contradict the files' differences.
    """
    starts = checked_times(start, "start (--start-time)", len(used), is_positive=False)
    first = int(np.argmin(counts.about[used, 4]))  # any frame with an unknown start
    stated = counts.about[used, 4] - counts.about[used[first], 4]
    if np.isnan(stated).any():
        return _one_or_list(np.broadcast_to(starts, len(used)))
    if not isinstance(starts, np.ndarray):
        return _one_or_list(starts + stated)
    offsets = starts - starts[first]
    deviation = np.abs(stated - offsets)
    if (deviation > 1e-3 * (1 + stated)).any():
        worst = int(np.argmax(deviation))
        pair = f"{stated[worst]:g} s after {labels[used[first]]}, the starts (--start-time) {offsets[worst]:g} s"
        hint = "give that of the first frame alone to take the file's"
        raise InputError(f"{counts.name}: {labels[used[worst]]}: the file says {pair}; {hint}")
    return _one_or_list(starts)


def _one_or_list(values: Array) -> float | list[float]:
    """Return numbers as a list, or the one number that they all are."""
    return float(values[0]) if np.all(values == values[0]) else values.tolist()


def _declared_dead(run: ProjectionRun, words: list[str], used: list[int], shape: tuple[int, ...]) -> Array:
    """Return the mask (frames, rows, columns) of frames' pixels that the efficiency of a run declares dead."""
    mask = np.zeros(shape, bool)
    if np.all(run.efficiency):
        return mask
    is_alive = np.broadcast_to(with_image_axes(run.efficiency) > 0, run.projections.shape)
    if run.settings["detector"] == "virtual":
        is_alive = is_alive[:, ::-1, ::-1]
    for k, alive in zip(used, is_alive, strict=True):
        indices = on_crystal(np.arange(mask[k].size).reshape(shape[1:]), words[k])
        mask[k].flat[indices[~alive]] = True
    return mask


def _orientations(orientation: Any, n_frames: int) -> list[str]:
    """Return the orientation of each frame; raise `InputError` for an unknown word or another number of words."""
    words = [orientation] * n_frames if isinstance(orientation, str) else list(orientation)
    if len(words) != n_frames:
        raise InputError(f"orientation (--orientation): expected 1 or {n_frames} words, got {len(words)}")
    for word in words:
        one_of(word, ORIENTATIONS, "orientation (--orientation)")
    return words


def _require_counts(array: Array, expected: bool) -> None:
    """Raise `InputError` for numbers that are no counts; the message names frame, row and column, from 1."""
    if array.dtype.kind == "f":
        require_finite(array, "counts")
    for is_wrong, problem in (
        (array < 0, "is below 0"),
        (array > _MAX_EXACT, "is more than a pixel can hold exactly"),
        (array != np.rint(array) if array.dtype.kind == "f" and not expected else None, "is no whole number of counts"),
    ):
        if is_wrong is not None and is_wrong.any():
            frame, row, column = np.unravel_index(int(np.argmax(is_wrong)), array.shape)
            hint = "; for expected means say so (--expected)" if "whole" in problem else ""
            place = f"frame {frame + 1}, row {row + 1}, column {column + 1}"
            raise InputError(f"counts: {array[frame, row, column]:g} {problem} ({place}){hint}")


def _require_pixels(recipe: Recipe, run: ProjectionRun, names: str) -> None:
    """Raise `InputError` if a recipe gives another number of pixels than the frames have."""
    for name, n_pixels in zip(("rows", "columns"), run.views.shape, strict=True):
        value = recipe.given.get(f"detector.{name}", n_pixels)
        if value != n_pixels:
            raise InputError(f"detector.{name}: {value}, but the images of {names} have {n_pixels}")


def _warn_of_contradictions(counts: Counts, used: list[int], words: list[str], run: ProjectionRun) -> None:
    """Warn if the files state another pixel size for the frames `used`, or several energy windows."""
    if len(windows := np.unique(counts.about[used, 3])) > 1 and np.isfinite(windows).all():
        several = " and ".join(f"{number:g}" for number in windows.tolist())
        summary = f"frames of the energy windows {several} are used"
        warn(f"{counts.name}: {summary}; say none (--frames) for those that are not meant")
    steps = np.linalg.norm([run.views.u_steps, run.views.v_steps], axis=2) / run.settings["magnification"]
    for k, along_u, along_v in zip(used, *steps, strict=True):
        size, pitch = counts.about[k, 1:3], (along_u, along_v)
        pitch = pitch[::-1] if words[k].endswith("u") else pitch  # along the rows of the frame, and down its columns
        if any(map(partial(differs, is_rounded=True), size, pitch)):
            stated, assumed = (" x ".join(f"{x:.4g}" for x in sizes) for sizes in (size, pitch))
            covering = "so that they cover the crystal; if the file is right, give their size (--pitch)"
            reason = covering if run.settings["pitch_mm"] is None else "as given"
            warn(f"{counts.name}: the file says pixels of {stated} mm; taken as {assumed} mm, {reason}")
            return


def _ranges(numbers: Sequence[int]) -> str:
    """Return numbers as ranges: "1-3, 7"."""
    return several(number_ranges(numbers), 6)
