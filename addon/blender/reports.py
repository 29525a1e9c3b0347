"""What core says to the user, as Blender's reports."""

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import bpy

from ...core.errors import InputError
from ...core.recording import recorded_warnings
from ...core.runs.settings import SETTINGS

_OPTIONS = re.compile(r" \((?:--|mphdrr )[^()]*\)|, --[a-z-]+ [^;,)]+|, `mphdrr [^`]*`")
_CLAUSES = re.compile(r"[;:,] [^;:,]*(?:--[a-z]|\bmphdrr [a-z])[^;]*")  # that speak of an option or a command
_KEYS = "|".join(map(re.escape, sorted(SETTINGS, key=len, reverse=True)))
_KEY = re.compile(rf"\b({_KEYS})(?![\w.])(?:\s?=\s?\"?([\w-]+)\"?)?")
_MOST = 5  # nobody reads more lines than that

Need = tuple[Callable[[bpy.types.Context], Any], str]
"""What an operator needs of the context, and the tooltip's words where that is not so."""


def in_window(text: object) -> str:
    """What core says, without the options of the command line, and with the window's words for a recipe's keys.

    Of a recipe's file, which is a text with these keys, they stay.
    """

    def labelled(found: re.Match[str]) -> str:
        setting, word = SETTINGS[found[1]], found[2]
        label = setting.label.partition(" (")[0]
        return label if word is None else f"{label} {setting.words.get(word, (word,))[0]}"

    said = _CLAUSES.sub("", _OPTIONS.sub("", str(text)))
    return said if ".toml" in said else _KEY.sub(labelled, said)


@contextmanager
def warnings_reported(operator: bpy.types.Operator) -> Iterator[None]:
    """Report every `InputWarning` of the block as {'WARNING'}, even if it raises; others pass through."""
    with recorded_warnings() as caught:
        try:
            yield
        finally:
            for text in caught[:_MOST]:
                operator.report({"WARNING"}, in_window(text))
            if len(caught) > _MOST:
                operator.report({"WARNING"}, f"... and {len(caught) - _MOST} more warnings of this kind")


def needs(*every: Need) -> Any:
    """The `poll` of an operator: whether every need is met; the tooltip shows the first that is not."""

    def poll(operator: type[bpy.types.Operator], context: bpy.types.Context) -> bool:
        unmet = next((text for is_met, text in every if not is_met(context)), None)
        if unmet is not None:
            operator.poll_message_set(unmet)
        return unmet is None

    return classmethod(poll)


class Reported:
    """Mix into an operator that does `act`, and reports the line that this returns, if it does, or what it raises."""

    bl_options = {"REGISTER", "UNDO"}

    def execute(self: Any, context: bpy.types.Context) -> set[str]:
        """Act and report."""
        return run_reported(self, lambda: self.act(context))


def run_reported(operator: bpy.types.Operator, action: Callable[[], str | None]) -> set[str]:
    """Run an operator's work; report its warnings, and the line that it returns, or an `InputError` as {'ERROR'}."""
    try:
        with warnings_reported(operator):
            text = action()
    except (InputError, MemoryError) as error:
        operator.report({"ERROR"}, in_window(error) or "not enough memory")
        return {"CANCELLED"}
    if text:
        operator.report({"INFO"}, text)
    return {"FINISHED"}


def ask_to_remove(
    operator: bpy.types.Operator, context: bpy.types.Context, event: bpy.types.Event, title: str, message: str
) -> set[str]:
    """Open the dialog whose button removes something; for an operator's `invoke`."""
    return context.window_manager.invoke_confirm(
        operator, event, title=title, message=message, confirm_text="Remove", icon="WARNING"
    )
