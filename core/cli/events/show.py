"""Action ``mphdrr events show SET -o sheet.png``: a contact sheet, or a list, of events."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ... import events
from ...errors import InputError
from ...figures.page import SUFFIXES
from ..options import add_set_action, output_path, print_answer

_EVENTS_PER_SHEET = 4
"""Default number of events on a sheet."""
_COLUMNS = ("x_mm", "y_mm", "z_mm", "phi_degrees", "theta_degrees", "psi_degrees")


def add_parser(actions) -> None:  # type: ignore[no-untyped-def]
    """Add the action ``events show``."""
    add = add_set_action(actions, "show", _run).add_argument
    text = f"numbers of the events; default: the first {_EVENTS_PER_SHEET} for a sheet, all for a list"
    add("--events", type=int, nargs="+", metavar="I", help=text)
    add("--model", metavar="NAME", help="model whose images are drawn; default: the recipe's first")
    add("-o", "--output", metavar="FILE", help=f"the sheet: {', '.join(SUFFIXES)}; default: a list as text")


def _run(arguments: argparse.Namespace) -> None:
    """Draw events of a set: slices of the truth, all images, a Radon view and a sinogram; or list them.

    mphdrr events show set -o sheet.png
    mphdrr events show set --events 0 7 12 --model emission -o some.svg
    """
    from ...events.contact_sheet import contact_sheet

    path = None if arguments.output is None else output_path(arguments.output, SUFFIXES)
    if path is None and arguments.model is not None:
        raise InputError("--model says what is drawn: give -o FILE, too")
    if not (event_set := events.EventSet(arguments.folder)):
        raise InputError(f"{arguments.folder}: it holds no events yet; mphdrr events make makes them")
    chosen = _choose_events(event_set, arguments.events, None if path is None else _EVENTS_PER_SHEET)
    rows = [event.row for event in chosen]
    if path is None:
        print_answer(arguments, rows, _table(rows))
        return
    name = Path(arguments.folder).absolute().name
    contact_sheet(list(chosen), arguments.model, name, _summary(event_set)).write(path)
    print_answer(arguments, rows, [f"{path}: events {', '.join(map(str, chosen.numbers))} of {len(event_set)}"])


def _choose_events(event_set: events.EventSet, numbers: list[int] | None, max_count: int | None) -> events.EventSet:
    """Return the events with these numbers, or without numbers the first `max_count` events, all if that is None."""
    if numbers is None:
        return event_set[:max_count]
    stored = event_set.numbers
    for number in numbers:
        if number not in stored:
            raise InputError(f"--events {number}: no such event; there are {len(stored)}, {stored[0]} to {stored[-1]}")
    return event_set.where(lambda row: row["event"] in numbers)


def _summary(event_set: events.EventSet) -> str:
    """Return the number of events of a set, in all and by phantom and split, as text."""
    texts = [f"{len(event_set)} events"]
    for column in ("phantom", "split"):
        counts = Counter(row[column] for row in event_set.index if row[column])
        if len(counts) > 1 or column == "split":
            texts.append(", ".join(f"{name} {count}" for name, count in counts.items()))
    return "   ·   ".join(filter(None, texts))


def _table(rows: list[dict[str, Any]]) -> Iterator[str]:
    """Yield a line of text for each event, below a heading."""
    names = max(7, *(len(str(row["phantom"])) for row in rows))
    splits = max(5, *(len(row["split"] or "") for row in rows))
    titles = "".join(f"{text:>9}" for text in ("x mm", "y mm", "z mm", "phi °", "theta °", "psi °"))
    yield f"{'event':>6}  {'phantom':<{names}}  {'split':<{splits}}{titles}"
    for row in rows:
        numbers = "".join(f"{row[column]:9.2f}" for column in _COLUMNS)
        yield f"{row['event']:6d}  {row['phantom']:<{names}}  {row['split'] or '':<{splits}}{numbers}"
