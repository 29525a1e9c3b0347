"""What all tests share."""

from __future__ import annotations

import atexit
import functools
import gc
import os
from pathlib import Path

import pytest

from mphdrr.core.workbook import reader

# No test cuts the power: to wait until each small file is on the disk would be most of what some of them take.
os.fsync = lambda descriptor: None

# Python's search for garbage among a million objects of imported libraries, again and again, would be a sixth of the
# tests' time: it rests while they are collected, and what stays after a file of tests is not looked at again.
gc.disable()
_file: Path | None = None


def pytest_addoption(parser: pytest.Parser) -> None:
    text = "of what needs neither Blender nor files, each test in its first case: for a second Python"
    parser.addoption("--once", action="store_true", help=text)


@pytest.hookimpl(trylast=True)  # after the long ones are left out
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if not config.getoption("--once"):
        return
    first = {item.nodeid.partition("[")[0]: item for item in reversed(items)}
    every = [item for item in items if not {"scene", "tmp_path"}.isdisjoint(item.fixturenames)]  # type: ignore[attr-defined]
    kept = {*every, *first.values()}
    config.hook.pytest_deselected(items=[item for item in items if item not in kept])
    items[:] = [item for item in items if item in kept]


def pytest_collection_finish() -> None:
    gc.freeze()
    gc.enable()


def pytest_runtest_setup(item: pytest.Item) -> None:
    global _file
    if item.path != _file:
        _file = item.path
        gc.collect()
        gc.freeze()


# The users' workbook is read hundreds of times in a process; what it gives cannot be changed, but a kind's columns can.
WORKBOOK = Path(__file__).parents[1] / "examples" / "dc-spect-80.xlsx"
_read = reader._read
_read_workbook = functools.cache(lambda kind, columns: _read(WORKBOOK, kind, None))
reader._read = lambda path, kind, columns: (
    _read_workbook(kind, tuple(kind.columns))
    if columns is None and Path(path) == WORKBOOK
    else _read(path, kind, columns)
)


@atexit.register
def _silence_blender() -> None:
    """Let pytest's summary be the last words: Blender's modules list forty lines of leaked functions when Python ends."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
