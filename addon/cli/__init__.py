"""The whole command line: ``mphdrr`` as a program, and ``blender --command mphdrr`` in the application.

The commands without Blender are in `core.cli`; those here import bpy only when they run.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from typing import NoReturn

from ...core import cli
from . import demo, scene


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command line (by default the program's own) and return its exit status."""
    return cli.main(argv, more_commands=(scene.add_parser, demo.add_parser))


def program() -> NoReturn:
    """The ``mphdrr`` program: run the command line and end the process with its exit status."""
    status = main()
    sys.stdout.flush()
    sys.stderr.flush()
    if "bpy" in sys.modules:
        # After some work bpy 4.5's static destructors wait for ever on a thread of its own: leave without them.
        os._exit(status)
    sys.exit(status)
