"""Settings of the Event Set panel: `Scene.mphdrr_events`."""

from typing import Any

import bpy
from bpy.props import IntProperty, PointerProperty, StringProperty

from ..blender.file_properties import path_property
from ..volumes import volumes
from . import event_notes


def _models(self: bpy.types.PropertyGroup, context: bpy.types.Context, typed: str) -> list[str]:
    """Return a set's models whose names contain the typed text."""
    return [name for name in event_notes.models(self.folder) if typed.lower() in name.lower()]


def recipe_property(update: Any = None) -> Any:
    """Return a property for a recipe's file."""
    text = "Text (.toml) with the phantoms, poses and models from which events are drawn"
    return path_property("Recipe", text, "SKIP_SAVE", update=update)


def _propose_folder(self: Any, context: bpy.types.Context) -> None:
    """Propose a folder beside a chosen recipe, with the recipe's name, unless the user has chosen another."""
    if self.recipe and self.folder == self.proposed:
        self.folder = self.proposed = self.recipe.removesuffix(".toml") + "-events"


RECIPE = recipe_property()
FOLDER = path_property(
    "Folder", "Folder of the event set: its recipe, index and a file for each event", "SKIP_SAVE", subtype="DIR_PATH"
)
COUNT = IntProperty(name="Events", description="Number of events of the whole set; existing ones stay as they are",
                    default=10, min=1, soft_max=10000, options={"SKIP_SAVE"})  # fmt: skip
MODEL = StringProperty(name="Model", description="Model whose projections are shown; empty: the recipe's first",
                       search=_models, search_options={"SUGGESTION"}, options={"SKIP_SAVE"})  # fmt: skip


def number_property(description: str) -> Any:
    """Return a property for an event's number."""
    return IntProperty(name="Event", description=description, min=0, soft_max=10000, options={"SKIP_SAVE"})


NEXT = number_property("Number of the event to try next: its draws depend on it and on the recipe alone")
OPENED = number_property("Number of the event to open, from 0")


class EventProperties(bpy.types.PropertyGroup):
    """Properties of the Event Set panel: recipe, folder, and the phantom on which events are tried."""

    recipe: recipe_property(_propose_folder)
    number: NEXT
    folder: FOLDER
    count: COUNT
    opened: OPENED
    model: MODEL
    phantom: PointerProperty(name="Phantom", description="Phantom on which events are tried", type=bpy.types.Object,
                             poll=lambda self, item: volumes.is_volume(item), options={"HIDDEN"})  # fmt: skip
    truth: PointerProperty(name="Truth", description="Truth of the event that was opened last", type=bpy.types.Object,
                           poll=lambda self, item: volumes.is_volume(item), options={"HIDDEN"})  # fmt: skip
    proposed: path_property("Proposed Folder", "Folder proposed for the recipe", "HIDDEN", subtype="DIR_PATH")
    tried: StringProperty(name="Tried", description="Event that the phantom in the scene shows", options={"HIDDEN"})


CLASSES = (EventProperties,)
