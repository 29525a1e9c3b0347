"""Command ``mphdrr geometry ACTION``: actions on a geometry workbook, such as ``show``, ``set`` and ``export``.

An action is a module here with ``add_parser(actions)``, named in the list below. There, `add_action` (in `arguments`) makes
the parser of an action that reads a workbook, and `options.add_run` that of any other; the docstring of the function that
runs the action is its help. `arguments` also has the options that several actions share: views, materials, knife edge.
"""

from ..options import add_actions
from . import calibrate, check, epipolar, export, fit, generate, map, performance, set, show


def add_parser(subparsers) -> None:  # type: ignore[no-untyped-def]
    """Add the command ``mphdrr geometry`` with its actions."""
    actions = add_actions(subparsers, "geometry", "mphdrr geometry check scanner.xlsx")
    for action in (show, check, performance, map, epipolar, set, export, fit, calibrate, generate):
        action.add_parser(actions)
