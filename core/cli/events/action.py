"""What the parsers of actions on event sets share."""

import argparse
from collections.abc import Callable
from typing import Any

from ..options import add_command


def add_action(
    actions: Any, name: str, run: Callable[[argparse.Namespace], None], summary: str, *examples: str
) -> argparse.ArgumentParser:
    """A parser of an action on a set, with SET and ``--json``."""
    parser = add_command(actions, name, summary, "\nexample: ".join(examples))
    parser.add_argument("folder", metavar="SET", help="folder of the set")
    parser.add_argument("--json", action="store_true", help="print the answer as JSON")
    parser.set_defaults(run=run)
    return parser
