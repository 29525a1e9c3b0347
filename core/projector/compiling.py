"""Compile a numba kernel, kept on disk for the next start."""

from __future__ import annotations

import functools
import hashlib
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from numba import config, njit

from .caching import cache_folder

SOURCES = ("siddon_numba.py", "lanes.py")

_kernels: dict[tuple[Callable[..., Any], Any], Any] = {}
_lock = threading.Lock()


def compiled(function: Callable[..., Any], signature: Any) -> Any:
    """`function` compiled for `signature`, without the GIL, once: from the cache on disk where that is possible.

    A folder that cannot be written, a full disk or a damaged cache cost the time of compiling,
    nothing else.
    """
    with _lock:
        key = function, signature
        if key not in _kernels:
            kernel = njit(nogil=True)(function)
            try:
                _enable_caching(kernel)
                kernel.compile(signature)
            except Exception:
                if not kernel.overloads:  # else it was compiled and only could not be saved
                    kernel = njit(nogil=True)(function)
                    kernel.compile(signature)
            kernel.disable_compile()  # one signature: never compile for writable arrays where read-only ones do
            _kernels[key] = kernel
        return _kernels[key]


def _enable_caching(kernel: Any) -> None:
    """Cache `kernel` in NUMBA_CACHE_DIR if the user has set it, else in `cache_folder`."""
    users = config.CACHE_DIR
    # numba looks at this setting once, when caching is enabled; other users of numba keep theirs.
    config.CACHE_DIR = str(Path(users or cache_folder("numba")) / _fingerprint())
    try:
        kernel.enable_caching()
    finally:
        config.CACHE_DIR = users


@functools.cache
def _fingerprint() -> str:
    """Of all that kernels are made of: numba looks only at a kernel's own file to know that what it kept is stale."""
    sources = sorted(Path(__file__).with_name(name).read_bytes() for name in SOURCES)
    return hashlib.sha256(b"".join(sources)).hexdigest()[:12]
