"""What core says to the user, as Blender's reports."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import bpy

from ..core.errors import InputError
from ..core.recording import recorded_warnings

_MOST = 5  # nobody reads more lines than that


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


def polled(operator: type[bpy.types.Operator], is_met: bool, need: str) -> bool:
    """An operator's answer to `poll`: whether its `need` is met, which the tooltip shows where it is not."""
    if not is_met:
        operator.poll_message_set(need)
    return is_met


def run_reported(operator: bpy.types.Operator, action: Callable[[], str]) -> set[str]:
    """Run an operator's work; report its warnings, and the line that it returns or an `InputError` as {'ERROR'}."""
    try:
        with warnings_reported(operator):
            text = action()
    except (InputError, MemoryError) as error:
        operator.report({"ERROR"}, str(error) or "not enough memory")
        return {"CANCELLED"}
    operator.report({"INFO"}, text)
    return {"FINISHED"}
