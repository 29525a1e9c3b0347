"""Errors and warnings about the user's input."""

from __future__ import annotations


class InputError(ValueError):
    """The user's input cannot be used: one line that names the place, what was found and what was expected."""


class InputWarning(UserWarning):
    """The user's input was used, but something about it should be checked."""
