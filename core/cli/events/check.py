"""``mphdrr events check SET``."""

import argparse
import time
from dataclasses import asdict

from ... import events
from ...errors import InputError
from ..options import counted, print_answer, progress_bar, say
from .action import add_action
from .make import watched

_TIMES, _SECONDS = 10, 0.5
"""How often, and after which time, an index is looked at again that is not in order."""


def add_parser(actions) -> None:  # type: ignore[no-untyped-def]
    """Add the action."""
    parser = add_action(actions, "check", _run)
    text = "make missing and damaged events anew; foreign files move to the folder SET-foreign; the rest is not touched"
    parser.add_argument("--repair", action="store_true", help=text)
    parser.add_argument("--workers", type=int, default=1, metavar="N", help="processes that make events anew")


def _run(arguments: argparse.Namespace) -> None:
    """Read every byte of a set and say what is wrong: events that are missing, cut, changed or of another recipe, and
    foreign files.

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
            raise InputError(f"{folder}: {counted(len(faults), 'fault')}; --repair mends what can be mended")
        return
    for line in lines:
        say(line)
    again = events.repair(folder, faults)
    done = watched(Making(SetFolder(folder), again, arguments.workers), quiet=True)
    left = events.check(folder, progress_bar("checking again"))
    for _ in range(_TIMES):  # another work that ends now may be writing it
        if {fault.kind for fault in left} != {"index"}:
            break
        time.sleep(_SECONDS)
        events.repair(folder, left)
        left = index_faults(folder)
    record = [{**asdict(fault), "path": str(fault.path)} for fault in left]
    mended = f"{folder}: {counted(len(faults), 'fault')} mended, {done} events made anew"
    print_answer(arguments, record, [fault.text for fault in left] or [mended])
    if left:
        raise InputError(f"{folder}: {len(left)} of its faults are left")
