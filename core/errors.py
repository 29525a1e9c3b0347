"""Errors and warnings about the user's input, and the exception that cancels work.

The context managers turn the exceptions of libraries and of the operating system into an `InputError` with one line that
names the place.
"""

import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from typing import Any


class InputError(ValueError):
    """Refusal of the user's input, in one line that names the place, what was expected and what was found.

    Every public function raises it for an argument of another kind or shape, not finite, or out of its range. A docstring
    has a section "Raises" only for refusals that are particular to its function.
    """


class Cancelled(Exception):
    """Exception by which a progress callback stops the work. Nothing half-done is left behind."""

    reconstruction: Any = None
    """The `Reconstruction` after the last whole iteration of a cancelled reconstruction, which can be resumed; else None."""
    design: Any = None
    """The best `Design` that a cancelled search had found; else None."""


class InputWarning(UserWarning):
    """Warning about input that was used, but that the user should check."""


def warn(text: str, stacklevel: int = 3) -> None:
    """Issue an `InputWarning` that names the line `stacklevel` calls up.

    The `stacklevel` is 2 in a public function that warns itself, and 3 in a helper that a public function calls.
    """
    warnings.warn(text, InputWarning, stacklevel=stacklevel + 1)


@contextmanager
def refusing(place: object, problem: str) -> Iterator[None]:
    """Turn an `OSError` of the block into an `InputError`: "PLACE: PROBLEM (the system's reason)".

    `place` is a file, for instance, and `problem` says that it "cannot be written".
    """
    try:
        yield
    except OSError as error:
        raise InputError(f"{place}: {problem} ({error.strerror or error})") from error


@contextmanager
def expecting(refusal: str, *kinds: type[Exception]) -> Iterator[None]:
    """Turn exceptions of these `kinds`, by default `ValueError`, into an `InputError` with the message `refusal`.

    An example is the `ValueError` of a text that is no number.
    """
    expected = kinds or (ValueError,)
    try:
        yield
    except expected:
        raise InputError(refusal) from None


@contextmanager
def naming(name: object) -> Iterator[None]:
    """Put `name`, such as a file's, before the message of an `InputError` of the block that does not begin with it."""
    try:
        yield
    except InputError as error:
        if str(error).startswith(f"{name}: "):
            raise
        raise InputError(f"{name}: {error}") from None


@contextmanager
def reading(name: object, kind: str) -> Iterator[None]:
    """Turn any exception that a library raises on a damaged file into an `InputError`.

    The message begins with the file's `name` and says that the file cannot be read as this `kind`, such as "HDF5". Input
    errors of the block get the `name` as in `naming`; `Cancelled` passes unchanged.
    """
    with naming(name):
        try:
            yield
        except (InputError, Cancelled):
            raise
        except Exception as error:
            raise InputError(f"cannot be read as {kind} ({first_line(error)})") from error


@contextmanager
def needing(requirement: str = "", feature: str = "") -> Iterator[None]:
    """Turn the failed import of a package into an `InputError` that says how to install it.

    `requirement` is what pip is told to install, such as "mphdrr[design]"; by default the package. `feature` is what needs
    the package, and begins the message if it is given.
    """
    try:
        yield
    except ImportError as error:
        package = (error.name or requirement).partition(".")[0]
        problem = f"{package} is missing: {install_advice(requirement or package)}"
        raise InputError(f"{feature}: {problem}" if feature else problem) from None


def install_advice(requirement: str) -> str:
    """Return how to install `requirement`: pip's command, or in Blender's extension the page that explains it."""
    if __name__.startswith("bl_ext."):  # the package's name if Blender runs it as an extension
        return 'see "Packages that Blender does not bring" in docs/first-steps.md'
    return f'pip install "{requirement}"' if "[" in requirement else f"pip install {requirement}"


def first_line(error: BaseException) -> str:
    """Return the first line of a library's error message that is not blank, or else the error's class name."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[0] if lines else type(error).__name__


def number_ranges(numbers: Sequence[int]) -> list[str]:
    """Return the ranges of whole `numbers`, given in rising order, as texts such as "1-3" and "7"."""
    cuts = [0, *(i for i in range(1, len(numbers)) if numbers[i] != numbers[i - 1] + 1), len(numbers)]
    ranges = [(numbers[start], numbers[stop - 1]) for start, stop in pairwise(cuts)]
    return [f"{first}-{last}" if last > first else str(first) for first, last in ranges]


def numbers_text(numbers: Sequence[int]) -> str:
    """Return whole `numbers`, given in rising order, as text with at most ten ranges, such as "0-7, 12, 30-99"."""
    texts = number_ranges(numbers)
    return ", ".join(texts if len(texts) <= 10 else [*texts[:10], f"… ({len(numbers)} in all)"])


def several(items: Iterable[object], limit: int = 3) -> str:
    """Return the first `limit` items, joined by commas, and the number of the others: "a, b, c and 2 more"."""
    texts = [str(item) for item in items]
    return ", ".join(texts[:limit]) + (f" and {len(texts) - limit} more" if len(texts) > limit else "")
