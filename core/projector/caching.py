"""Where compiled kernels are kept."""

from __future__ import annotations

import os
import sys
from pathlib import Path


def cache_folder(compiler: str) -> Path:
    """The folder of this user in which mphDRR may keep what `compiler` can make again."""
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local"
    elif sys.platform == "darwin":
        base = Path.home() / "Library" / "Caches"
    else:
        base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "mphdrr" / compiler
