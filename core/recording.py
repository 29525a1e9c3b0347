"""Recording of warnings for the user, by thread.

`warnings.catch_warnings` is not safe for threads: of two that overlap, the one that ends last restores the other's
record, and all later warnings go there. Here each warning goes to a recorder of its own thread, and the original state
is restored when no recorder is left.
"""

import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from .errors import InputWarning, warn

T = TypeVar("T")

_lock = threading.Lock()
_recorders: list[tuple[int, list[str]]] = []  # thread and record, oldest first
_filters: list[Any] = []  # the lists that `_ALWAYS` was put into
_ALWAYS = ("always", None, InputWarning, None, 0)


@contextmanager
def recorded_warnings() -> Iterator[list[str]]:
    """Collect the texts of all `InputWarning` that this thread gives in the block; other warnings are shown as usual.

    Of nested recorders in a thread the innermost collects them.
    """
    mine = (threading.get_ident(), list[str]())
    with _lock:
        if not isinstance(warnings.showwarning, _Route):
            warnings.showwarning = _Route(warnings.showwarning)
        warnings.simplefilter("always", InputWarning)  # by default Python shows each only once
        _filters.append(warnings.filters)
        _recorders.append(mine)
    try:
        yield mine[1]
    finally:
        with _lock:
            _recorders[:] = [other for other in _recorders if other is not mine]
            if not _recorders:
                _restore()


@dataclass(frozen=True, eq=False)
class Remembered(Generic[T]):
    """What was made once for several uses, and the warnings that were given when it was made."""

    value: T
    warnings: list[str]

    def again(self) -> T:
        """The value, with the warnings of its making."""
        for text in self.warnings:
            warn(text)
        return self.value


def remembered(make: Callable[[], T]) -> Remembered[T]:
    """What `make` makes, and its warnings, which nobody sees before they are asked for."""
    with recorded_warnings() as warnings:
        return Remembered(make(), warnings)


class _Route:
    """Replaces `warnings.showwarning`: passes warnings to the thread's recorder, or to what was there before."""

    def __init__(self, before: Callable[..., Any]) -> None:
        self.before = before

    def __call__(self, message: Warning | str, category: type[Warning], *where: Any, **more: Any) -> None:
        if issubclass(category, InputWarning):
            thread = threading.get_ident()
            with _lock:
                record = next((record for owner, record in reversed(_recorders) if owner == thread), None)
            if record is not None:
                record.append(str(message))
                return
        self.before(message, category, *where, **more)


def _restore() -> None:
    # If another program has replaced it since, that program restores it.
    if isinstance(warnings.showwarning, _Route):
        warnings.showwarning = warnings.showwarning.before
    for filters in (*_filters, warnings.filters):  # catch_warnings of others works on copies
        while _ALWAYS in filters:
            filters.remove(_ALWAYS)
    _filters.clear()
