"""Action ``mphdrr events status SET``: number of events, size and missing events of a set."""

import argparse
from dataclasses import asdict

from ... import events
from ...errors import number_ranges, several
from ...memory import readable_size
from ..options import add_set_action, count_text, print_answer


def add_parser(actions) -> None:  # type: ignore[no-untyped-def]
    """Add the action ``events status``."""
    add_set_action(actions, "status", _run)


def _run(arguments: argparse.Namespace) -> None:
    """Show the number of events of a set, and which are missing.

    mphdrr events status set
    """
    status = events.status(arguments.folder)
    lines = [f"{status.made} of {status.asked} events, {readable_size(status.size)}"]
    for name, counts in (("phantoms", status.phantoms), ("splits", status.splits)):
        if counts:
            lines.append(f"{name}: " + ", ".join(f"{key} {count}" for key, count in counts.items()))
    if status.shards:
        lines.append(f"in {count_text(status.shards, 'shard')}")
    if len(status.builds) > 1:
        builds = ", ".join(f"{build or 'of version 0.1'} {count}" for build, count in status.builds.items())
        lines.append(f"builds of mphDRR: {builds}; events of two may differ in their last digits")
    if status.missing:
        missing = several(number_ranges(status.missing), 10)
        lines.append(f"missing: {missing}; mphdrr events make {arguments.folder} makes them")
    print_answer(arguments, asdict(status), lines)
