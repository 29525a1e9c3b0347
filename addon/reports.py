"""What core says to the user, as Blender's reports."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import bpy

from ..core.recording import recorded_warnings

_MOST = 5  # more lines than that nobody reads


@contextmanager
def warnings_reported(operator: bpy.types.Operator) -> Iterator[None]:
    """Report every `InputWarning` of the block as {'WARNING'}, even if it raises; others pass through."""
    with recorded_warnings() as caught:
        try:
            yield
        finally:
            for text in caught[:_MOST]:
                operator.report({"WARNING"}, text)
            if len(caught) > _MOST:
                operator.report({"WARNING"}, f"... and {len(caught) - _MOST} more warnings of this kind")
