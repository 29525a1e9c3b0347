"""Exports of event sets as files that other programs read: pytorch-3dunet, WebDataset, NumPy, the users' own layout.

`export_events` writes a set for a program of `PROGRAMS`; `plan_export` first tells how much there is to write. A program is
an `ExportLayout` (`layout.py`): the files of an event and their contents, with the program's options.

To add a program, write a subclass of `ExportLayout` in a module here with the class's name in lower case, and add a line to
the table in `events/programs.py`, from which `mphdrr events export` takes it. Add new options to that command in
`core/cli/events/export.py`.
"""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ...errors import InputError
from ...files import AnyPath, folder_path
from ...progress import Progress
from ...validation import instance, one_of, positive
from ..event_set import EventSet
from ..fields import field_shapes
from ..noise_choice import NoiseChoice, checked_noise, require_counted
from ..programs import PROGRAMS, Program
from .layout import ExportSelection
from .writing import ExportPlan, make_plan

__all__ = ["PROGRAMS", "ExportPlan", "Program", "export_events", "plan_export"]


def plan_export(
    events: EventSet,
    folder: AnyPath,
    program: str,
    *,
    models: str | Sequence[str] | None = None,
    noise: NoiseChoice = None,
    level: float = 1.0,
    **options: Any,
) -> ExportPlan:
    """Return the plan of an export with the arguments of `export_events`: `summary` describes it, `write` writes it."""
    instance(events, EventSet, "export")
    one_of(program, PROGRAMS, "program")
    chosen_program = PROGRAMS[program]
    options = {name: value for name, value in options.items() if value is not None}
    for name in sorted(options.keys() - set(chosen_program.options)):
        available = ", ".join(chosen_program.options) or "none"
        raise InputError(f"{program}: no option {name!r}, it has {available}")
    _ = field_shapes(events)  # raises InputError where joined sets do not match
    all_models = tuple(events.recipe.models)
    names = all_models if models is None else (models,) if isinstance(models, str) else tuple(models)
    for name in names:
        one_of(name, all_models, "model")
    noise = checked_noise(noise)
    if (level := positive(level, "level")) != 1 and noise is None:
        raise InputError("level: needs noise; choose noise as well, or leave it out")
    if noise is not None:
        require_counted(events, names)
    selection = ExportSelection(events, tuple(dict.fromkeys(names)), noise, level)
    layout = chosen_program.layout(selection, **options)
    real_folder = Path(os.path.realpath(folder_path(folder)))
    for set_folder in {event.path.parents[1] for event in events}:
        if any(place.exists() and place.samefile(set_folder) for place in (real_folder, *real_folder.parents)):
            raise InputError(f"{folder}: is in the folder of the set that is exported; choose one outside it")
    return make_plan(layout, folder_path(folder), program, {**options, **layout.option_contents()})


def export_events(
    events: EventSet,
    folder: AnyPath,
    program: str,
    *,
    models: str | Sequence[str] | None = None,
    noise: NoiseChoice = None,
    level: float = 1.0,
    progress: Progress | None = None,
    **options: Any,
) -> None:
    """Write the events of a set for another program.

    Parameters
    ----------
    events : EventSet
        Events to export, for instance ``set.split("train")``.
    folder
        A new or empty folder, or one with the beginning of the same export, which is then continued. Besides the program's
        files it gets a table ``events.csv`` with the event of each number in the file names.
    program
        A name of `PROGRAMS`.
    models
        Name of the model whose images are written, or several names; default: all. "legacy" and "3dunet" take one.
    noise
        None: expected means. "own": noise of each event's own seed. A whole number: noise of that seed instead.
    level
        Fraction of the acquisition time, with noise.
    progress
        Called as ``progress(done, total)`` after each event; an exception of it stops the export, which can be continued.
    options
        Options of the program, listed in ``PROGRAMS[program].options``.

    Raises
    ------
    InputError
        The program, a model or an option is unknown, the program cannot represent the set, or the folder holds something
        else or cannot be written.
    """
    plan = plan_export(events, folder, program, models=models, noise=noise, level=level, **options)
    plan.write(progress)
