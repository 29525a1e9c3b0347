"""What core says to the user, as Blender's reports."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager

import bpy

from ..core.errors import InputWarning

_MOST = 5  # more lines than that nobody reads


@contextmanager
def warnings_reported(operator: bpy.types.Operator) -> Iterator[None]:
    """Report every `InputWarning` of the block as {'WARNING'}, even if it raises; others pass through."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", InputWarning)
        try:
            yield
        finally:
            ours = [w for w in caught if issubclass(w.category, InputWarning)]
            for warning in ours[:_MOST]:
                operator.report({"WARNING"}, str(warning.message))
            if len(ours) > _MOST:
                operator.report({"WARNING"}, f"... and {len(ours) - _MOST} more warnings of this kind")
    for warning in caught:
        if warning not in ours:
            warnings.warn_explicit(warning.message, warning.category, warning.filename, warning.lineno)
