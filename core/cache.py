"""The folder of mphDRR's cache, for files that can be made again, such as kernels compiled for a GPU."""

import os
import sys
from pathlib import Path

_chosen: Path | None = None


def keep_in(folder: Path | None) -> None:
    """Set the cache's folder; None restores the default, the folder where this user's programs keep their caches."""
    global _chosen
    _chosen = folder


def folder() -> Path:
    """Return the cache's folder, which may not exist yet."""
    if _chosen is not None:
        return _chosen
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local"
    elif sys.platform == "darwin":
        base = Path.home() / "Library" / "Caches"
    else:
        base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "mphdrr"
