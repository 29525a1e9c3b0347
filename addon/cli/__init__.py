"""The whole command line: ``mphdrr`` as a program, and ``blender --command mphdrr`` in the application.

The commands without Blender are in `core.cli`; those here import bpy only when they run.
"""

from collections.abc import Sequence

from ...core import cli
from . import demo, figure, scene


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command line (by default the program's own) and return its exit status."""
    return cli.main(argv, more_commands=(figure.add_parser, scene.add_parser, demo.add_parser))
