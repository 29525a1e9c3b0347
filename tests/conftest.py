"""What all tests share. They run the product as users get it: nothing of it is replaced here."""

from __future__ import annotations

import atexit
import gc
import os
import shutil
import sys
from pathlib import Path

import pytest

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


def pytest_sessionfinish(exitstatus: int) -> None:
    if bpy := sys.modules.get("bpy"):
        # It lists forty lines of leaked functions when Python ends, and may wait for a thread of its own for ever.
        atexit.register(os._exit, int(exitstatus))
        atexit.register(shutil.rmtree, bpy.app.tempdir, ignore_errors=True)
