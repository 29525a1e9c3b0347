"""Warnings and errors of core as Blender's reports."""

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from importlib.util import find_spec
from typing import Any

import bpy

from ...core.errors import InputError, install_advice
from ...core.recording import recorded_warnings
from ...core.runs.settings import SETTINGS

_OPTIONS = re.compile(r" \((?:--|mphdrr )[^()]*\)|, --[a-z-]+ [^;,)]+|, `mphdrr [^`]*`")
_CLAUSES = re.compile(r"[;:,] [^;:,]*(?:--[a-z]|\bmphdrr [a-z])[^;]*")  # clauses with an option or a command
_KEYS = "|".join(map(re.escape, sorted(SETTINGS, key=len, reverse=True)))
_KEY = re.compile(rf"\b({_KEYS})(?![\w.])(?:\s?=\s?\"?([\w-]+)\"?)?")
_MAX_WARNINGS = 5  # lines; nobody reads more

Need = tuple[Callable[[bpy.types.Context], Any], str]
"""Requirement of an operator: a test of the context, and the tooltip's text where the test fails."""


def in_window(text: object) -> str:
    """Return a message of core in the window's words: without command-line options, with labels in place of recipe keys.

    A message about a .toml recipe keeps the keys, since the recipe's text has them.
    """

    def labelled(match: re.Match[str]) -> str:
        """Return the label in Blender of the option that was matched."""
        setting, word = SETTINGS[match[1]], match[2]
        label = setting.label.partition(" (")[0]
        return label if word is None else f"{label} {setting.words.get(word, (word,))[0]}"

    message = _CLAUSES.sub("", _OPTIONS.sub("", str(text)))
    return message if ".toml" in message else _KEY.sub(labelled, message)


@contextmanager
def warnings_reported(operator: bpy.types.Operator) -> Iterator[None]:
    """Report every `InputWarning` of the block as {'WARNING'}, even if it raises; other warnings pass through."""
    with recorded_warnings() as warnings:
        try:
            yield
        finally:
            for text in warnings[:_MAX_WARNINGS]:
                operator.report({"WARNING"}, in_window(text))
            if len(warnings) > _MAX_WARNINGS:
                operator.report({"WARNING"}, f"... and {len(warnings) - _MAX_WARNINGS} more warnings of this kind")


def needs(*requirements: Need) -> Any:
    """Return the `poll` of an operator: whether all requirements are met; the tooltip shows the first unmet one."""

    def poll(operator: type[bpy.types.Operator], context: bpy.types.Context) -> bool:
        unmet = next((text for is_met, text in requirements if not is_met(context)), None)
        if unmet is not None:
            operator.poll_message_set(unmet)
        return unmet is None

    return classmethod(poll)


@cache
def has(package: str) -> bool:
    """Return whether Blender finds a Python package, without importing it."""
    return find_spec(package) is not None


def package(name: str) -> Need:
    """Return the requirement of an operator that works with a Python package."""
    return lambda _: has(name), f"{name} is missing: {install_advice(name)}"


class Reported:
    """Mix-in of an operator with a method `act(context)`, whose returned line, if any, or raised error is reported."""

    bl_options = {"REGISTER", "UNDO"}

    def execute(self: Any, context: bpy.types.Context) -> set[str]:
        """Act and report."""
        return run_reported(self, lambda: self.act(context))


def run_reported(operator: bpy.types.Operator, action: Callable[[], str | None]) -> set[str]:
    """Run an operator's work and report its warnings, and the line that it returns, or an `InputError` as {'ERROR'}."""
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
    """Open a dialog whose button confirms a removal; for an operator's `invoke`."""
    return context.window_manager.invoke_confirm(
        operator, event, title=title, message=message, confirm_text="Remove", icon="WARNING"
    )
