"""Warnings for the user, recorded: in any thread, and in whatever order recorders begin and end.

`warnings.catch_warnings` puts back, when it ends, what it found when it began. Of two that overlap, as those of two threads
do, the one that ends last so brings back the other's record, long given up, and all later warnings go there. Here nothing is
put back until no recorder is left, and a warning goes to the recorder of the thread that gives it.
"""

from __future__ import annotations

import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from .errors import InputWarning

_lock = threading.Lock()
_recorders: list[tuple[int, list[str]]] = []  # thread and record, in the order they began
_filters: list[Any] = []  # the lists that `_ALWAYS` was put into
_ALWAYS = ("always", None, InputWarning, None, 0)


@contextmanager
def recorded_warnings() -> Iterator[list[str]]:
    """The texts of every `InputWarning` that this thread gives in the block, as they come; other warnings go on as before.

    Of several recorders in one thread the one that began last takes them.
    """
    mine = (threading.get_ident(), list[str]())
    with _lock:
        _install()
        _recorders.append(mine)
    try:
        yield mine[1]
    finally:
        with _lock:
            _recorders[:] = [other for other in _recorders if other is not mine]
            if not _recorders:
                _uninstall()


class _Route:
    """In place of `warnings.showwarning`: to the recorder of the thread, or on to what was there before."""

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


def _install() -> None:
    if not isinstance(warnings.showwarning, _Route):  # else another recorder's serves
        warnings.showwarning = _Route(warnings.showwarning)
    warnings.simplefilter("always", InputWarning)  # Python shows a warning once for each place otherwise
    _filters.append(warnings.filters)


def _uninstall() -> None:
    # Where another program has put its own in its place, it is that one's to put back, and passes on what reaches it.
    if isinstance(warnings.showwarning, _Route):
        warnings.showwarning = warnings.showwarning.before
    for filters in (*_filters, warnings.filters):  # `catch_warnings` of other programs works on copies
        while _ALWAYS in filters:
            filters.remove(_ALWAYS)
    _filters.clear()
