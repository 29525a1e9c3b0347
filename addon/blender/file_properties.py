"""Properties that are paths: of operators, which Blender's file browser sets or reads, and of what the .blend keeps."""

from collections.abc import Iterable
from typing import Any

import bpy
from bpy.props import CollectionProperty, StringProperty


def file_property(description: str) -> Any:
    """The `filepath` of an operator."""
    return StringProperty(name="File", description=description, subtype="FILE_PATH", options={"SKIP_SAVE"})


def files_property(description: str) -> Any:
    """The `files` of an operator that takes several, which are in its `directory`."""
    return CollectionProperty(description=description, type=bpy.types.OperatorFileListElement, options={"SKIP_SAVE"})


def path_property(name: str, description: str, *options: str, subtype: str = "FILE_PATH", **more: Any) -> Any:
    """A path that the .blend keeps, which may be relative to it."""
    every = {"PATH_SUPPORTS_BLEND_RELATIVE", *options}
    return StringProperty(name=name, description=description, subtype=subtype, options=every, **more)


DIRECTORY = StringProperty(description="Where the files are", subtype="DIR_PATH", options={"SKIP_SAVE"})


def shown_files(endings: Iterable[str]) -> Any:
    """The `filter_glob` of an operator: which files the browser shows, by the endings of their names."""
    return StringProperty(default=";".join(f"*{ending}" for ending in endings), options={"HIDDEN"})
