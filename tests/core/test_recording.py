"""Recorders of warnings: each records its own thread, whatever the order of begin and end, and none leaves a trace."""

from __future__ import annotations

import itertools
import re
import threading
import warnings
from pathlib import Path

import pytest

from mphdrr.core.errors import InputWarning
from mphdrr.core.recording import recorded_warnings


@pytest.fixture(autouse=True)
def shown(monkeypatch):
    """Yield the warnings shown without a recorder; afterwards everything is as before."""
    shown: list[str] = []

    def show(message, category, *where, **more):
        shown.append(str(message))

    with warnings.catch_warnings():
        warnings.simplefilter("always")
        warnings.showwarning = show
        before = list(warnings.filters)
        yield shown
        shown.clear()
        assert warnings.showwarning is show and list(warnings.filters) == before
        _say("afterwards")
        assert shown == ["afterwards"]


def _say(text: str) -> None:
    warnings.warn(text, InputWarning, stacklevel=2)


@pytest.mark.parametrize("order", list(itertools.permutations(range(3))))
@pytest.mark.parametrize("fails", [False, True])
def test_recorders_may_end_in_any_order(order, fails, shown):
    recorders = [recorded_warnings() for _ in range(3)]
    records = []
    for k, recorder in enumerate(recorders):
        records.append(recorder.__enter__())
        _say(f"{k}")  # the one that began last takes it
    left = [0, 1, 2]
    for k in order:
        if fails:
            assert not recorders[k].__exit__(KeyError, KeyError(k), None)  # it goes on
        else:
            recorders[k].__exit__(None, None, None)
        left.remove(k)
        _say(f"after {k}")
        assert (records[left[-1]] if left else shown)[-1] == f"after {k}"
    assert [record[0] for record in records] == ["0", "1", "2"] and shown == [f"after {order[-1]}"]


@pytest.mark.parametrize("first_to_end", [0, 1])
def test_threads_record_their_own(first_to_end, shown):
    steps = [[threading.Event() for _ in range(2)] for _ in range(2)]
    records: list[list[str]] = [[], []]

    def work(k: int) -> None:
        with recorded_warnings() as records[k]:
            _say(f"{k} begins")
            steps[k][0].set()
            steps[k][1].wait(5)
            _say(f"{k} ends")

    threads = [threading.Thread(target=work, args=(k,)) for k in range(2)]
    for k, thread in enumerate(threads):
        thread.start()
        assert steps[k][0].wait(5)
    _say("main, unrecorded")
    with recorded_warnings() as mine:
        for k in (first_to_end, 1 - first_to_end):
            steps[k][1].set()
            threads[k].join(5)
            _say(f"main after {k}")
    assert records == [[f"{k} begins", f"{k} ends"] for k in range(2)]
    assert mine == [f"main after {first_to_end}", f"main after {1 - first_to_end}"] and shown == ["main, unrecorded"]


def test_many_threads_lose_nothing(shown):
    records: list[list[str]] = [[] for _ in range(8)]

    def work(k: int) -> None:
        for turn in range(50):
            with recorded_warnings() as caught:
                _say(f"{k} {turn}")
            records[k] += caught

    threads = [threading.Thread(target=work, args=(k,)) for k in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(30)
    assert records == [[f"{k} {turn}" for turn in range(50)] for k in range(8)] and shown == []


@pytest.mark.parametrize("ends_first", ["ours", "Python's"])
@pytest.mark.parametrize("begins_first", ["ours", "Python's"])
def test_pythons_own_recorder_may_overlap(begins_first, ends_first, shown):
    ours, pythons = recorded_warnings(), warnings.catch_warnings(record=True)
    records = {}
    for name in (begins_first, "ours" if begins_first == "Python's" else "Python's"):
        records[name] = (ours if name == "ours" else pythons).__enter__()
    warnings.simplefilter("always")
    _say("both")
    for name in (ends_first, "ours" if ends_first == "Python's" else "Python's"):
        (ours if name == "ours" else pythons).__exit__(None, None, None)
    _say("neither")
    assert shown == ["neither"]
    assert [*records["ours"], *(str(w.message) for w in records["Python's"])] == ["both"]
    # The overlap may leave a hook that passes everything on; the next recorder removes it.
    with recorded_warnings() as caught:
        _say("again")
    assert caught == ["again"]


def test_every_warning_is_recorded_and_others_go_on(shown):
    warnings.simplefilter("ignore", InputWarning)
    with recorded_warnings() as caught:
        for _ in range(3):
            _say("the same line")
            warnings.warn("of another", UserWarning, stacklevel=1)
    assert caught == ["the same line"] * 3 and shown == ["of another"] * 3
    warnings.filters.pop(0)  # the "ignore" of this test


def test_an_error_in_the_block_is_raised_and_its_warnings_are_kept():
    with pytest.raises(KeyError), recorded_warnings() as caught:
        _say("before it")
        raise KeyError
    assert caught == ["before it"]


def test_input_warnings_are_recorded_in_one_way_only():
    """Other recorders of them would overlap with these."""
    root = Path(__file__).parents[2]
    found = [
        path.relative_to(root).as_posix()
        for part in ("core", "addon", "operators", "panels")
        for path in (root / part).rglob("*.py")
        if re.search(r"simplefilter\(.*InputWarning", path.read_text(encoding="utf-8"))
    ]
    assert sorted(found) == ["core/cli/__init__.py", "core/recording.py"]
