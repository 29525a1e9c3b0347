"""``mphdrr geometry ACTION``: an action is a module here with ``add_parser(actions)``."""

from ..options import add_actions
from . import calibrate, check, epipolar, export, fit, generate, map, performance, set, show


def add_parser(subparsers) -> None:  # type: ignore[no-untyped-def]
    """Add the command."""
    actions = add_actions(subparsers, "geometry", "mphdrr geometry check scanner.xlsx")
    for action in (show, check, performance, map, epipolar, set, export, fit, calibrate, generate):
        action.add_parser(actions)
