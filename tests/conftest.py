"""What all tests share."""

from __future__ import annotations

import atexit
import functools
import gc
import os
import shutil
import sys
from pathlib import Path

import pytest

from mphdrr.core.phantoms import painting
from mphdrr.core.workbook import reader

# Python's search for garbage among a million objects of imported libraries, again and again, would be a sixth of the
# tests' time: it rests while they are collected, comes less often, and does not look again at what stays after a file of
# tests.
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
    gc.set_threshold(50_000)
    gc.enable()


def pytest_runtest_setup(item: pytest.Item) -> None:
    global _file
    if item.path != _file:
        _file = item.path
        gc.collect()
        gc.freeze()
        vars(painting).update(SHIPPED if getattr(item.module, "AS_SHIPPED", False) else FEWER)


# A phantom's voxels take a hundredth of their samples. A file of tests of just such numbers, or that compares with another
# process, says AS_SHIPPED = True.
FEWER = {
    "_MIN_SAMPLES": 16,
    "_MAX_SAMPLES": 1 << 7,
    "_SAMPLES_OF_MIXED": 1 << 14,
    "_SAMPLES_OF_FEW": 1 << 6,
    "_SAMPLES_OF_OVERLAP": 1 << 13,
}
SHIPPED = {name: getattr(painting, name) for name in FEWER}


# Workbooks are read thousands of times in a process: the cells of those read last are kept, and all that two of them give,
# wherever they are, which cannot be changed, but a kind's columns can.
def _content(path: str | os.PathLike[str]) -> bytes:
    return Path(path).read_bytes() if os.path.isfile(path) else b""  # of a pipe nothing would come


ROOT = Path(__file__).parents[1]
KNOWN = {_content(ROOT / name) for name in ("examples/dc-spect-80.xlsx", "tests/core/data/first-24-modules.xlsx")}
_Book, _read = reader.Book, reader._read
_kept_book = functools.lru_cache(32)(lambda path, content: _Book(path))
_kept_system = functools.cache(lambda path, content, kind, columns: _read(path, kind, None))
reader.Book = lambda path: _kept_book(Path(path), content) if (content := _content(path)) else _Book(path)
reader._read = lambda path, kind, columns: (
    _kept_system(Path(path), content, kind, tuple(kind.columns))
    if columns is None and (content := _content(path)) in KNOWN
    else _read(path, kind, columns)
)


def pytest_sessionfinish(exitstatus: int) -> None:
    if bpy := sys.modules.get("bpy"):
        # It lists forty lines of leaked functions when Python ends, and may wait for a thread of its own for ever.
        atexit.register(os._exit, int(exitstatus))
        atexit.register(shutil.rmtree, bpy.app.tempdir, ignore_errors=True)
