"""What mphDRR says when the user's input cannot be used, or should be looked at."""

from __future__ import annotations


class InputError(ValueError):
    """The user's input cannot be used: one line naming the place, what was found and what was expected."""


class InputWarning(UserWarning):
    """The user's input was used, but something about it should be looked at."""
