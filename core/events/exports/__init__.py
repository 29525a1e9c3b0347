"""Exports of event sets for other programs.

To add a program, write its `Layout` in a module here, and list it in `events/programs.py`; `mphdrr events export` takes it
from there.
"""

from collections.abc import Sequence
from typing import Any

from ...errors import InputError
from ...files import AnyPath, folder_path
from ...progress import Progress
from ...validation import instance, one_of, positive
from ..event_set import EventSet
from ..fields import field_shapes
from ..noise_choice import NoiseChoice, checked_noise, require_counted
from ..programs import PROGRAMS, Program
from .layout import Chosen
from .writing import Plan, plan_export

__all__ = ["PROGRAMS", "Plan", "Program", "export_events", "planned_export"]


def planned_export(
    events: EventSet,
    folder: AnyPath,
    program: str,
    *,
    models: str | Sequence[str] | None = None,
    noise: NoiseChoice = None,
    level: float = 1.0,
    **options: Any,
) -> Plan:
    """What `export_events` would write, and how much of it is there already: `Plan.says`, and `Plan.write` to do it."""
    instance(events, EventSet, "export")
    one_of(program, PROGRAMS, "program")
    chosen_program = PROGRAMS[program]
    options = {name: value for name, value in options.items() if value is not None}
    for name in sorted(options.keys() - set(chosen_program.options)):
        had = ", ".join(chosen_program.options) or "none"
        raise InputError(f"{program}: no option {name!r}, it has {had}")
    _ = field_shapes(events)  # of all joined sets
    known = tuple(events.recipe.models)
    names = known if models is None else (models,) if isinstance(models, str) else tuple(models)
    for name in names:
        one_of(name, known, "model")
    noise = checked_noise(noise)
    level = positive(level, "level")
    if level != 1 and noise is None:
        raise InputError("level: it is of the noise; choose noise as well, or leave it out")
    if noise is not None:
        require_counted(events, names)
    chosen = Chosen(events, tuple(dict.fromkeys(names)), noise, level)
    layout = chosen_program.layout(chosen, **options)
    return plan_export(layout, chosen, folder_path(folder), program, {**options, **layout.contained()})


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
    """Write a set, or a part of one, for another program.

    Parameters
    ----------
    events : EventSet
        For instance ``set.split("train")``.
    folder
        A new or empty one, or one that holds the beginning of the same export, which is gone on with. Besides the
        program's files it has ``events.csv``: which event each number of the files' names is.
    program
        A name of `PROGRAMS`.
    models
        Whose images are written, a name or several; default: all. "legacy" and "3dunet" take one.
    noise
        None: the mean images. "own": with the noise of each event's own seed. A whole number: another noise of that seed.
    level
        Share of the acquisition time, with noise.
    progress
        Called as ``progress(done, total)`` after each event; what it raises stops the work, which can be gone on with.
    options
        The program's own: ``PROGRAMS[program].options``.

    Raises
    ------
    InputError
        For an unknown program, model or option, a set that the program cannot hold, and a folder that holds something else
        or cannot be written.
    """
    plan = planned_export(events, folder, program, models=models, noise=noise, level=level, **options)
    plan.write(progress)
