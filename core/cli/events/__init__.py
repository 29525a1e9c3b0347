"""Command ``mphdrr events ACTION``: actions on sets of training events, such as ``make``, ``check`` and ``export``.

An action is a module here with ``add_parser(actions)``, named in the list below. The function that runs it has the
action's help, with its examples, as docstring; `make.run_with_reports` is the loop of the actions that make events.
"""

from ..options import add_actions
from . import check, export, make, new, pack, show, status


def add_parser(subparsers) -> None:  # type: ignore[no-untyped-def]
    """Add the command ``mphdrr events`` with its actions."""
    actions = add_actions(subparsers, "events", "mphdrr events make set -n 1000 --recipe derenzo.toml")
    for action in (new, make, status, check, show, pack, export):
        action.add_parser(actions)
