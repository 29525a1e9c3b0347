"""Errors and warnings about the user's input."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager


class InputError(ValueError):
    """The user's input cannot be used: one line that names the place, what was found and what was expected."""


class InputWarning(UserWarning):
    """The user's input was used, but something about it should be checked."""


def warn(text: str, stacklevel: int = 3) -> None:
    """Give an `InputWarning`; where a function of users gives it itself, not by a helper, the `stacklevel` is 2."""
    warnings.warn(text, InputWarning, stacklevel=stacklevel + 1)


@contextmanager
def refusing(place: object, what: str) -> Iterator[None]:
    """Make what the system refuses an input error: of which `place`, such as a file, and that it "cannot be written"."""
    try:
        yield
    except OSError as error:
        raise InputError(f"{place}: {what} ({error.strerror or error})") from error


@contextmanager
def naming(name: object) -> Iterator[None]:
    """Put a name, such as a file's, before the messages of input errors."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{name}: {error}") from None
