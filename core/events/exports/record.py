"""Record of an event besides its arrays, for programs that read JSON."""

from typing import Any

from ..event_set import Event
from .layout import ExportSelection


def event_record(selection: ExportSelection, event: Event) -> dict[str, Any]:
    """Return an event's number, split, phantom, settings, poses, truth's affine, units and noise, as JSON can hold them."""
    return {
        "number": event.number,
        "split": event.split or "",
        "name": event.name,
        "settings": event.settings,
        "position_mm": event.position.tolist(),
        "euler_degrees": event.euler_degrees.tolist(),
        "pose": event.pose.tolist(),
        "placement": event.placement.tolist(),
        "truth_affine": event.recipe.grid.affine.tolist(),
        "truth_quantity": event.recipe.quantity,
        "units": {model: event.unit(model) for model in selection.models},
        "noise_seed": selection.noise_seed(event),
        "level": selection.level,
    }
