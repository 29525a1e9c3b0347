"""Event sets: thousands of phantoms with their images, for training, each made from a recipe, a seed and its number.

>>> recipe = mph.events.read_recipe("derenzo.toml")
>>> events = mph.events.make(recipe, "set", 1000, workers=2)
>>> events[0].truth, events[0].images("emission", noise_seed=1), events[0].radon(96)

- Making: planning.py (parameters of event i), event_maker.py (its arrays), event_files.py (its file), writing.py (an
  event), pool.py (several processes), work.py (the missing events), store.py, folders.py and index.py (the set's folder).
- Reading: event_set.py, checking.py, contact_sheet.py, training.py and torch_events.py (torch's `Dataset`), `exports`.

To add a setting, add a row to `_ROWS` in recipe.py (of phantoms in entries.py), a `DrawnSetting` (draws.py) where it may
be a range or a choice, and use it in planning.py (with a column of the index in `FIXED_COLUMNS`, of texts in `_TEXTS` of
index.py) or in event_maker.py; a setting of the models is a row of `core/runs/settings.py` alone. A new table of the
recipe stands in its `_ENTRIES`, a file's name in `_replace_file_names`. If the model differs from event to event, change
`EventMaker._imagings`, which all events share, `Event._run_recipe` and the attributes in event_files.py. What an event's
file holds is written by `pack` (event_files.py) and read in event_set.py.

A template of recipes is a file in templates and a line in templates.py; a picture of the contact sheet is a `_Panel`. A
new warning of images is a line of the table in tests/core/test_event_warnings.py.
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
