"""``mphdrr events show SET -o sheet.png``."""

from __future__ import annotations

import argparse
from collections import Counter
from pathlib import Path
from typing import Any

from ... import events
from ...errors import InputError
from ...figures.page import SUFFIXES
from ..options import add_set_action, output_path, print_answer

_ON_SHEET = 4
"""Events on a sheet by default."""
_COLUMNS = ("x_mm", "y_mm", "z_mm", "phi_degrees", "theta_degrees", "psi_degrees")


def add_parser(actions) -> None:  # type: ignore[no-untyped-def]
    """Add the action."""
    parser = add_set_action(actions, "show", _run)
    add = parser.add_argument
    text = f"numbers of the events; default: the first {_ON_SHEET} for a sheet, all for a list"
    add("--events", type=int, nargs="+", metavar="I", help=text)
    add("--model", metavar="NAME", help="whose images are drawn; default: the recipe's first")
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
    whole = events.EventSet(arguments.folder)
    if not whole:
        raise InputError(f"{arguments.folder}: it holds no events yet; mphdrr events make makes them")
    chosen = _chosen(whole, arguments.events, None if path is None else _ON_SHEET)
    rows = [event.row for event in chosen]
    if path is None:
        print_answer(arguments, rows, _table(rows))
        return
    name = Path(arguments.folder).absolute().name
    contact_sheet(list(chosen), arguments.model, name, _summary(whole)).write(path)
    print_answer(arguments, rows, [f"{path}: events {', '.join(map(str, chosen.numbers))} of {len(whole)}"])


def _chosen(whole: events.EventSet, numbers: list[int] | None, most: int | None) -> events.EventSet:
    """The events with these numbers; without any, the first ones."""
    if numbers is None:
        return whole[:most]
    there = whole.numbers
    for number in numbers:
        if number not in there:
            raise InputError(f"--events {number}: no such event; there are {len(there)}, {there[0]} to {there[-1]}")
    return whole.where(lambda row: row["event"] in numbers)


def _summary(whole: events.EventSet) -> str:
    """How many events a set has, by phantom and split."""
    parts = [f"{len(whole)} events"]
    for column in ("phantom", "split"):
        counts = Counter(row[column] for row in whole.index if row[column])
        if len(counts) > 1 or column == "split":
            parts.append(", ".join(f"{name} {count}" for name, count in counts.items()))
    return "   ·   ".join(filter(None, parts))


def _table(rows: list[dict[str, Any]]) -> list[str]:
    """A line for each event, and one above them."""
    names = max(7, *(len(str(row["phantom"])) for row in rows))
    splits = max(5, *(len(row["split"] or "") for row in rows))
    heading = f"{'event':>6}  {'phantom':<{names}}  {'split':<{splits}}" + "".join(
        f"{text:>9}" for text in ("x mm", "y mm", "z mm", "phi °", "theta °", "psi °")
    )
    lines = [heading]
    for row in rows:
        numbers = "".join(f"{row[column]:9.2f}" for column in _COLUMNS)
        lines.append(f"{row['event']:6d}  {row['phantom']:<{names}}  {row['split'] or '':<{splits}}{numbers}")
    return lines
