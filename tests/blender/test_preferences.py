"""The preferences: what computes here, threads, the cache, links."""

from __future__ import annotations

from unittest.mock import MagicMock

import bpy
import pytest

from mphdrr.addon import preferences
from mphdrr.addon.blender import storage
from mphdrr.core.rays import backends, parallel


@pytest.fixture(autouse=True)
def missing(monkeypatch, request) -> set[str]:
    """Pretend that backends are missing; to find out what this machine has, torch and warp would be loaded."""
    names = getattr(request, "param", {"torch", "cuda"})

    def require(backend: backends.Backend) -> None:
        if backend.name in names:
            raise ImportError(f"no {backend.name} here")

    monkeypatch.setattr(backends, "_require", require)
    backends.states.cache_clear()
    yield names
    backends.states.cache_clear()


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setattr(bpy.utils, "extension_path_user", lambda package, path="": str(tmp_path / path), raising=False)
    return tmp_path / "cache"


@pytest.fixture
def user(scene):
    """Yield the preferences of the add-on, enabled for a moment."""
    addon = bpy.context.preferences.addons.new()
    addon.module = preferences.PACKAGE
    yield addon.preferences
    parallel.set_usual_threads(None)
    bpy.context.preferences.addons.remove(addon)


def drawn() -> list[str]:
    page = MagicMock(threads=0)
    preferences.MPHDRR_Preferences.draw(page, bpy.context)
    return [str(call) for call in page.layout.mock_calls]


@pytest.mark.parametrize(
    ("missing", "used"), [({"torch", "cuda"}, "cpu"), ({"cpu", "torch"}, "numpy")], indirect=["missing"]
)
def test_the_page_says_what_computes_and_why_the_others_do_not(missing, used):
    states, page = backends.states(), drawn()
    assert [name for name, state in states.items() if "automatically" in state] == [used]
    assert {name for name, state in states.items() if state == f"not found: no {name} here"} == missing
    for name, state in states.items():
        assert any(backends.BACKENDS[name].label in call for call in page)
        assert any(state[1:] in call for call in page)


def test_threads_are_those_of_projections_that_do_not_say(user):
    every = parallel.thread_count(None)
    user.threads = every + 3
    assert (parallel.thread_count(None), parallel.thread_count(2)) == (every + 3, 2)
    parallel.set_usual_threads(None)
    preferences.apply()  # as in the next session
    assert parallel.thread_count(None) == every + 3
    user.threads = 0
    assert parallel.thread_count(None) == every


def test_save_as_copies_files_unless_the_preferences_share_them(user):
    assert storage.copies and user.copies
    user.copies = False
    assert not storage.copies
    user.copies = True
    assert storage.copies


def test_the_cache_is_measured_and_cleaned(cache):
    assert preferences.cache_size() == 0 and not bpy.ops.mphdrr.clean_cache.poll()
    (cache / "kernels").mkdir(parents=True)
    (cache / "kernels" / "a.bin").write_bytes(bytes(1000))
    assert any(str(cache) in call for call in drawn())
    assert bpy.ops.mphdrr.clean_cache() == {"FINISHED"}
    assert preferences.cache_size() == 0 and cache.parent.is_dir()


def test_without_an_extension_there_is_no_cache_to_show():
    assert preferences.own_folder() is None and not any("Compiled" in call for call in drawn())
