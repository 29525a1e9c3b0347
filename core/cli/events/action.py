"""What the parsers of actions on event sets share."""

import argparse
from collections.abc import Callable
from typing import Any

from ..options import add_run


def add_action(actions: Any, name: str, run: Callable[[argparse.Namespace], None]) -> argparse.ArgumentParser:
    """The parser of an action on a set, with SET and ``--json``; its help is the docstring of `run`."""
    parser = add_run(actions, name, run)
    parser.add_argument("folder", metavar="SET", help="folder of the set")
    parser.add_argument("--json", action="store_true", help="print the answer as JSON")
    return parser
