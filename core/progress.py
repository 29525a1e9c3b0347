"""Progress of long work, and how it is stopped."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[int, int], None]
"""Called as ``progress(done, total)`` between the steps of long work; may raise `Cancelled` to stop it."""


class Cancelled(Exception):
    """Raised by a progress callback to stop the work; nothing half-done is left behind."""
