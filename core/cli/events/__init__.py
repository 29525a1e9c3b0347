"""``mphdrr events ACTION``: an action is a module here with ``add_parser(actions)``."""

from .. import COMMANDS
from ..options import add_command
from . import check, export, make, new, pack, show, status


def add_parser(subparsers) -> None:  # type: ignore[no-untyped-def]
    """Add the command."""
    example = "mphdrr events make set -n 1000 --recipe derenzo.toml"
    events = add_command(subparsers, "events", COMMANDS["events"], example)
    actions = events.add_subparsers(metavar="ACTION", required=True)
    for action in (new, make, status, check, show, pack, export):
        action.add_parser(actions)
