"""Event sets: thousands of phantoms with their images, for training, each made from a recipe, a seed and its number.

>>> recipe = mph.events.read_recipe("derenzo.toml")
>>> events = mph.events.make(recipe, "set", 1000, workers=2)
>>> events[0].truth, events[0].images("emission", noise_seed=1), events[0].radon(96)
"""

from typing import TYPE_CHECKING

from ..lazy import public

if TYPE_CHECKING:
    from .checking import Fault, Status, check, repair, status
    from .event_maker import EventArrays, EventMaker
    from .event_set import Event, EventSet
    from .exports import export_events
    from .planning import PlannedEvent, plan
    from .recipe import EventRecipe, read_recipe
    from .training import torch_dataset
    from .work import Made, make, making

__getattr__, __dir__, __all__ = public(__name__)
