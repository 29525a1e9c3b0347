"""Properties that hold paths: those of operators, which the file browser sets or reads, and those kept in the .blend."""

from collections.abc import Iterable
from typing import Any

import bpy
from bpy.props import CollectionProperty, StringProperty


def file_property(description: str) -> Any:
    """Return the `filepath` property of an operator."""
    return StringProperty(name="File", description=description, subtype="FILE_PATH", options={"SKIP_SAVE"})


def files_property(description: str) -> Any:
    """Return the `files` property of an operator that takes several files of its `directory`."""
    return CollectionProperty(description=description, type=bpy.types.OperatorFileListElement, options={"SKIP_SAVE"})


def path_property(name: str, description: str, *options: str, subtype: str = "FILE_PATH", **keywords: Any) -> Any:
    """Return a property for a path that the .blend keeps, which may be relative to the .blend."""
    all_options = {"PATH_SUPPORTS_BLEND_RELATIVE", *options}
    return StringProperty(name=name, description=description, subtype=subtype, options=all_options, **keywords)


DIRECTORY = StringProperty(description="Folder of the files", subtype="DIR_PATH", options={"SKIP_SAVE"})


def shown_files(endings: Iterable[str]) -> Any:
    """Return the `filter_glob` property of an operator: the file browser shows only names with one of the `endings`."""
    return StringProperty(default=";".join(f"*{ending}" for ending in endings), options={"HIDDEN"})
