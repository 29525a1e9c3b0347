"""``mphdrr geometry ACTION``: an action is a module here with ``add_parser(actions)``."""

from .. import COMMANDS
from ..options import add_command
from . import calibrate, check, epipolar, export, fit, generate, map, performance, set, show


def add_parser(subparsers) -> None:  # type: ignore[no-untyped-def]
    """Add the command."""
    geometry = add_command(subparsers, "geometry", COMMANDS["geometry"], "mphdrr geometry check scanner.xlsx")
    actions = geometry.add_subparsers(metavar="ACTION", required=True)
    for action in (show, check, performance, map, epipolar, set, export, fit, calibrate, generate):
        action.add_parser(actions)
