"""The whole command line: ``mphdrr`` as a program, and ``blender --command mphdrr`` in the application.

The commands without Blender are in `core.cli`; those here import bpy only when they run. `main` runs a command line. To add
a command that needs Blender, write a module here with `add_parser`, and add its line to `COMMANDS`.
"""

from collections.abc import Sequence

from ...core import cli

COMMANDS = {
    f"{__name__}.figure": "draw a figure as papers show them, of a scanner, a phantom or projections",
    f"{__name__}.scene": "make a Blender scene of the scanner, with a volume and projections",
    f"{__name__}.demo": "run the main job: workbook, phantom, 80 projections, scene, pictures and dataset",
}
"""Summaries of the commands that need Blender, by module."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command line (by default the program's own) and return its exit status."""
    return cli.main(argv, COMMANDS)
