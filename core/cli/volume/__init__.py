"""``mphdrr volume ACTION``: an action is a module here with ``add_parser(actions)``."""

from __future__ import annotations

from ..options import add_command
from . import convert, from_mesh, info, to_mesh


def add_parser(subparsers) -> None:  # type: ignore[no-untyped-def]
    """Add the command."""
    volume = add_command(subparsers, "volume", "look at volumes and convert them", "mphdrr volume info ct.nii.gz")
    actions = volume.add_subparsers(metavar="ACTION", required=True)
    for action in (info, convert, from_mesh, to_mesh):
        action.add_parser(actions)
