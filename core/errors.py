"""Errors and warnings about the user's input, and the exception of cancelled work."""

import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from typing import Any


class InputError(ValueError):
    """The user's input cannot be used: one line that names the place, what was found and what was expected.

    Every public function raises it where an argument is of another kind or shape, not finite or out of its range.
    Docstrings have a section "Raises" only for what is particular to a function.
    """


class Cancelled(Exception):
    """Raised by a progress callback to stop the work. Nothing half-done is left behind."""

    reconstruction: Any = None
    """Of an iterative reconstruction: the `Reconstruction` after its last whole iteration, which can be resumed."""
    design: Any = None
    """Of a search for a design: the best `Design` until then."""


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
def expecting(refusal: str, *kinds: type[Exception]) -> Iterator[None]:
    """Make errors of these kinds, by default a `ValueError` such as of a text that is no number, an input error."""
    expected = kinds or (ValueError,)
    try:
        yield
    except expected:
        raise InputError(refusal) from None


@contextmanager
def naming(name: object) -> Iterator[None]:
    """Put a name, such as a file's, before the messages of input errors that do not begin with it."""
    try:
        yield
    except InputError as error:
        if str(error).startswith(f"{name}: "):
            raise
        raise InputError(f"{name}: {error}") from None


@contextmanager
def reading(name: object, kind: str) -> Iterator[None]:
    """Make whatever a library raises on a damaged file an input error, and put the file's `name` before all of these."""
    with naming(name):
        try:
            yield
        except (InputError, Cancelled):
            raise
        except Exception as error:
            raise InputError(f"cannot be read as {kind} ({first_line(error)})") from error


@contextmanager
def needing(what: str = "", of: str = "") -> Iterator[None]:
    """Make the failed import of a package an input error that says how to install it, or `what` has it, such as an extra.

    Before it the error names what the package is needed by, if that is said.
    """
    try:
        yield
    except ImportError as error:
        package = (error.name or what).partition(".")[0]
        found = f"{package} is missing: {installing(what or package)}"
        raise InputError(f"{of}: {found}" if of else found) from None


def installing(what: str) -> str:
    """How to install packages: pip's command, or where it is told how they come into Blender's own Python."""
    if __name__.startswith("bl_ext."):  # an extension's name
        return 'see "Packages that Blender does not bring" in docs/first-steps.md'
    return f'pip install "{what}"' if "[" in what else f"pip install {what}"


def first_line(error: BaseException) -> str:
    """A library's error message, as one line."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[0] if lines else type(error).__name__


def number_ranges(numbers: Sequence[int]) -> list[str]:
    """Whole numbers in rising order as texts, such as "1-3" and "7"."""
    cuts = [0, *(i for i in range(1, len(numbers)) if numbers[i] != numbers[i - 1] + 1), len(numbers)]
    parts = [(numbers[a], numbers[b - 1]) for a, b in pairwise(cuts)]
    return [f"{a}-{b}" if b > a else str(a) for a, b in parts]


def several(things: Iterable[object], shown: int = 3) -> str:
    """The first few, and how many more."""
    texts = [str(thing) for thing in things]
    return ", ".join(texts[:shown]) + (f" and {len(texts) - shown} more" if len(texts) > shown else "")
