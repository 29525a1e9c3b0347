"""``mphdrr events status SET``."""

import argparse
from dataclasses import asdict

from ... import events
from ...errors import number_ranges
from ...memory import readable_size
from ..options import add_set_action, counted, print_answer


def add_parser(actions) -> None:  # type: ignore[no-untyped-def]
    """Add the action."""
    add_set_action(actions, "status", _run)


def _run(arguments: argparse.Namespace) -> None:
    """Say how many events a set has, and which are missing.

    mphdrr events status set
    """
    found = events.status(arguments.folder)
    lines = [f"{found.made} of {found.asked} events, {readable_size(found.size)}"]
    for name, counts in (("phantoms", found.phantoms), ("splits", found.splits)):
        if counts:
            lines.append(f"{name}: " + ", ".join(f"{key} {count}" for key, count in counts.items()))
    if found.shards:
        lines.append(f"in {counted(found.shards, 'shard')}")
    if len(found.builds) > 1:
        builds = ", ".join(f"{build or 'of version 0.1'} {count}" for build, count in found.builds.items())
        lines.append(f"builds of mphDRR: {builds}; events of two may differ in their last digits")
    if found.missing:
        lines.append(f"missing: {numbers_text(found.missing)}; mphdrr events make {arguments.folder} makes them")
    print_answer(arguments, asdict(found), lines)


def numbers_text(numbers: list[int]) -> str:
    """Whole numbers in order, such as "0-7, 12, 30-99"."""
    texts = number_ranges(numbers)
    return ", ".join(texts if len(texts) <= 10 else [*texts[:10], f"… ({len(numbers)} in all)"])
