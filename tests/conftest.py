"""What all tests share."""

from __future__ import annotations

import atexit
import os

# Each of several processes leaves the other cores to the others; BLAS and torch would wait for theirs, busily.
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


@atexit.register
def _silence_blender() -> None:
    """Let pytest's summary be the last words: Blender's modules list forty lines of leaked functions when Python ends."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
