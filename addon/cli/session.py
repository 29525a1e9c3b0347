"""A Blender session for commands: the bpy package, or the application that runs the command."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from ...core.errors import InputError

if TYPE_CHECKING:
    import bpy


def new_scene() -> bpy.types.Scene:
    """An empty scene in an empty file, with the extension registered.

    Raises
    ------
    InputError
        There is no Blender to be had.
    """
    try:
        import bpy
    except ModuleNotFoundError:
        raise InputError(
            "this command needs Blender: pip install 'mphdrr[blender]', or run blender --command mphdrr"
        ) from None
    except ImportError as error:  # a shared library is missing
        raise InputError(
            f"Blender's bpy package does not load ({error}); on Debian and Ubuntu install libx11-6 libxi6 libxfixes3 "
            "libxrender1 libxkbcommon0 libsm6 libgl1"
        ) from None
    from .. import ids, registration

    bpy.ops.wm.read_homefile(use_empty=True)
    if not hasattr(bpy.types.Object, ids.OBJECT_MODULE):
        registration.register()
    scene = bpy.context.scene
    if scene.world is None:
        scene.world = bpy.data.worlds.new("World")
    return scene


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Keep what Blender itself prints on standard output, a line for every tile and file, out of sight."""
    sys.stdout.flush()
    kept = os.dup(1)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 1)
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)
        os.close(nowhere)


def save_scene(path: Path) -> None:
    """Save the file as `path`; Blender itself writes beside it and renames.

    Raises
    ------
    InputError
        It cannot be written.
    """
    import bpy

    try:
        # No .blend1 beside the result of a command.
        bpy.context.preferences.filepaths.save_version = 0
        with quiet():
            bpy.ops.wm.save_as_mainfile(filepath=os.path.abspath(path), check_existing=False)
    except RuntimeError as error:
        raise InputError(f"{path}: cannot be written ({str(error).strip().splitlines()[0]})") from error
