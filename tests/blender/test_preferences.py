"""The preferences: what computes here, threads, the cache, links."""

from __future__ import annotations

from unittest.mock import MagicMock

import bpy
import pytest

from mphdrr.addon import preferences
from mphdrr.core.projector import backends, parallel


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setattr(bpy.utils, "extension_path_user", lambda package, path="": str(tmp_path / path), raising=False)
    return tmp_path / "cache"


@pytest.fixture
def user(scene):
    """The preferences of the add-on, enabled for a moment."""
    addon = bpy.context.preferences.addons.new()
    addon.module = preferences.PACKAGE
    yield addon.preferences
    parallel.set_usual_threads(None)
    bpy.context.preferences.addons.remove(addon)


def drawn() -> list[str]:
    page = MagicMock(threads=0)
    preferences.MPHDRR_Preferences.draw(page, bpy.context)
    return [str(call) for call in page.layout.mock_calls]


def test_the_page_says_what_computes_and_why_the_others_do_not(monkeypatch):
    states = backends.states()
    assert states.keys() == backends.BACKENDS.keys()
    assert [name for name, state in states.items() if "automatically" in state] == [backends.choose("auto").name]
    for name, state in states.items():
        assert state.startswith("not found: ") == bool(backends._problem(name))
    monkeypatch.setattr(backends, "states", lambda: {"torch": "not found: No module named 'torch'"})
    assert any("PyTorch" in call for call in drawn()) and any("No module named" in call for call in drawn())


def test_threads_are_those_of_projections_that_do_not_say(user):
    every = parallel.thread_count(None)
    user.threads = every + 3
    assert (parallel.thread_count(None), parallel.thread_count(2)) == (every + 3, 2)
    parallel.set_usual_threads(None)
    preferences.apply()  # as in the next session
    assert parallel.thread_count(None) == every + 3
    user.threads = 0
    assert parallel.thread_count(None) == every


def test_the_cache_is_measured_and_cleaned(cache):
    assert preferences.cache_size() == 0 and not bpy.ops.mphdrr.clean_cache.poll()
    (cache / "kernels").mkdir(parents=True)
    (cache / "kernels" / "a.bin").write_bytes(bytes(1000))
    assert any(str(cache) in call for call in drawn())
    assert bpy.ops.mphdrr.clean_cache() == {"FINISHED"}
    assert preferences.cache_size() == 0 and cache.parent.is_dir()


def test_without_an_extension_there_is_no_cache_to_show():
    assert preferences.cache_folder() is None and not any("Compiled" in call for call in drawn())
