"""What all tests share."""

from __future__ import annotations

import atexit
import os


@atexit.register
def _silence_blender() -> None:
    """Let pytest's summary be the last words: Blender's modules list forty lines of leaked functions when Python ends."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
