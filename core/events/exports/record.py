"""What is known of an event besides its arrays, for programs that read JSON."""

from typing import Any

from ..event_set import Event
from .layout import Chosen


def record(chosen: Chosen, event: Event) -> dict[str, Any]:
    """The event's number, split, phantom, settings, pose, seeds, and the place of its truth: all that JSON can say."""
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
        "units": {model: event.unit(model) for model in chosen.models},
        "noise_seed": chosen.seed(event),
        "level": chosen.level,
    }
