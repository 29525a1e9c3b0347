"""Compile a numba kernel, kept on disk for the next start."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

from numba import config, njit

from .caching import cache_folder

_kernels: dict[Callable[..., Any], Any] = {}
_lock = threading.Lock()


def compiled(function: Callable[..., Any], signature: Any) -> Any:
    """`function` compiled for `signature`, without the GIL, once: from the cache on disk where that is possible.

    Everything a kernel calls must be in its own file: numba knows that a cached kernel is stale from that
    file alone. A folder that cannot be written, a full disk or a damaged cache cost the time of compiling,
    nothing else.
    """
    with _lock:
        if function not in _kernels:
            kernel = njit(nogil=True)(function)
            try:
                _enable_caching(kernel)
                kernel.compile(signature)
            except Exception:
                if not kernel.overloads:  # else it was compiled and only could not be saved
                    kernel = njit(nogil=True)(function)
                    kernel.compile(signature)
            kernel.disable_compile()  # one signature: never compile for writable arrays where read-only ones do
            _kernels[function] = kernel
        return _kernels[function]


def _enable_caching(kernel: Any) -> None:
    """Cache `kernel` in NUMBA_CACHE_DIR if the user has set it, else in `cache_folder`."""
    users = config.CACHE_DIR
    # numba looks at this setting once, when caching is enabled; other users of numba keep theirs.
    config.CACHE_DIR = users or str(cache_folder("numba"))
    try:
        kernel.enable_caching()
    finally:
        config.CACHE_DIR = users
