"""Action ``mphdrr events check SET``: every byte of an event set, and its repair."""

import argparse
import time
from dataclasses import asdict

from ... import events
from ...errors import InputError
from ..options import add_set_action, count_text, print_answer, progress_bar, say
from .make import run_with_reports

_MAX_CHECKS, _CHECK_INTERVAL = 10, 0.5
"""Largest number of checks of a faulty index, and the time between two of them, s."""


def add_parser(actions) -> None:  # type: ignore[no-untyped-def]
    """Add the action ``events check``."""
    parser = add_set_action(actions, "check", _run)
    text = "make missing and damaged events anew; foreign files move to the folder SET-foreign; the rest is not touched"
    parser.add_argument("--repair", action="store_true", help=text)
    parser.add_argument("--workers", type=int, default=1, metavar="N", help="processes that make events anew")


def _run(arguments: argparse.Namespace) -> None:
    """List the faults of a set: events that are missing, cut, changed or of another recipe, and foreign files.

    mphdrr events check set
    mphdrr events check set --repair --workers 2
    """
    from ...events.checking import index_faults
    from ...events.folders import SetFolder
    from ...events.work import Making

    folder = arguments.folder
    faults = events.check(folder, progress_bar("checking"))
    lines = [fault.text for fault in faults]
    record = [{**asdict(fault), "path": str(fault.path)} for fault in faults]
    if not arguments.repair or not faults:
        if not faults:
            lines = [f"{folder}: {sum(map(len, SetFolder(folder).requested))} events, every byte as it was written"]
        print_answer(arguments, record, lines)
        if faults:
            raise InputError(f"{folder}: {count_text(len(faults), 'fault')}; --repair mends what can be mended")
        return
    for line in lines:
        say(line)
    missing_again = events.repair(folder, faults)
    n_made = run_with_reports(Making(SetFolder(folder), missing_again, arguments.workers), quiet=True)
    remaining = events.check(folder, progress_bar("checking again"))
    for _ in range(_MAX_CHECKS):  # another process that ends now may be writing the index
        if {fault.kind for fault in remaining} != {"index"}:
            break
        time.sleep(_CHECK_INTERVAL)
        events.repair(folder, remaining)
        remaining = index_faults(folder)
    record = [{**asdict(fault), "path": str(fault.path)} for fault in remaining]
    mended = f"{folder}: {count_text(len(faults), 'fault')} mended, {n_made} events made anew"
    print_answer(arguments, record, [fault.text for fault in remaining] or [mended])
    if remaining:
        raise InputError(f"{folder}: {len(remaining)} of its faults are left")
