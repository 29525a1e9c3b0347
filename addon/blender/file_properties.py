"""Properties of operators that Blender's file browser sets, or reads."""

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


DIRECTORY = StringProperty(description="Where the files are", subtype="DIR_PATH", options={"SKIP_SAVE"})


def shown_files(endings: Iterable[str]) -> Any:
    """The `filter_glob` of an operator: which files the browser shows, by the endings of their names."""
    return StringProperty(default=";".join(f"*{ending}" for ending in endings), options={"HIDDEN"})
