"""Recording of warnings for the user, separately for each thread.

`warnings.catch_warnings` is not safe for threads: when two blocks overlap, the one that ends last restores the other's
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
_recorders: list[tuple[int, list[str]]] = []  # thread and recorded texts, oldest first
_filters: list[Any] = []  # the filter lists of `warnings` into which `_ALWAYS` was put
_ALWAYS = ("always", None, InputWarning, None, 0)


@contextmanager
def recorded_warnings() -> Iterator[list[str]]:
    """Yield a list that collects the texts of all `InputWarning` that this thread issues in the block.

    Other warnings are shown as usual. If a thread has nested recorders, the innermost collects the warnings.
    """
    recorder = (threading.get_ident(), list[str]())
    with _lock:
        if not isinstance(warnings.showwarning, _Route):
            warnings.showwarning = _Route(warnings.showwarning)
        warnings.simplefilter("always", InputWarning)  # by default Python shows each only once
        _filters.append(warnings.filters)
        _recorders.append(recorder)
    try:
        yield recorder[1]
    finally:
        with _lock:
            _recorders[:] = [entry for entry in _recorders if entry is not recorder]
            if not _recorders:
                _restore()


@dataclass(frozen=True, eq=False)
class Remembered(Generic[T]):
    """Value that is made once for several uses, with the warnings that were issued when it was made."""

    value: T
    warnings: list[str]

    def again(self) -> T:
        """Issue the recorded warnings and return the value."""
        for text in self.warnings:
            warn(text)
        return self.value


def remembered(make: Callable[[], T]) -> Remembered[T]:
    """Call `make`, record its warnings instead of showing them, and return both as a `Remembered`."""
    with recorded_warnings() as warnings:
        return Remembered(make(), warnings)


class _Route:
    """Substitute for `warnings.showwarning`, which passes a warning to the thread's recorder, else to the `original`."""

    def __init__(self, original: Callable[..., Any]) -> None:
        self.original = original

    def __call__(self, message: Warning | str, category: type[Warning], *place: Any, **options: Any) -> None:
        if issubclass(category, InputWarning):
            thread = threading.get_ident()
            with _lock:
                record = next((record for owner, record in reversed(_recorders) if owner == thread), None)
            if record is not None:
                record.append(str(message))
                return
        self.original(message, category, *place, **options)


def _restore() -> None:
    """Restore the state of `warnings` from before the first recorder."""
    # If another program has replaced `showwarning` in the meantime, that program restores it.
    if isinstance(warnings.showwarning, _Route):
        warnings.showwarning = warnings.showwarning.original
    for filters in (*_filters, warnings.filters):  # `catch_warnings` of another program works on copies
        while _ALWAYS in filters:
            filters.remove(_ALWAYS)
    _filters.clear()
