"""``mphdrr events ACTION``: an action is a module here with ``add_parser(actions)``."""

from ..options import add_actions
from . import check, export, make, new, pack, show, status


def add_parser(subparsers) -> None:  # type: ignore[no-untyped-def]
    """Add the command."""
    actions = add_actions(subparsers, "events", "mphdrr events make set -n 1000 --recipe derenzo.toml")
    for action in (new, make, status, check, show, pack, export):
        action.add_parser(actions)
