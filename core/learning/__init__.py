"""Learned reconstruction: networks that use the geometry of their scanner, their training, and the judge of methods.

Entry points: `read_recipe` and `train` (a network from an event set), `read_model` (a trained network, which is called
with a run), `judge` (scores of methods with confidence intervals). They are imported on first use: modules of this room
import torch, MONAI and Lightning, this file imports none of them, so that commands and panels can tell what is missing.

To add a network, see `networks`. To add a setting of trainings, add a row to `_ROWS` in recipe.py and a line to
templates/training.toml, and use it in data.py (samples; extend `Source.fingerprint` then) or training.py. To add an entry
of model files, add a field to `ModelContents` in model_file.py, filled by `_model_contents` in training.py; a change that
earlier versions cannot read raises `_VERSION`. An optimiser of torch is a row of `OPTIMIZERS` in recipe.py: with a second
row the choice is the setting ``training.optimizer``. To add a score, see `judging`.
"""

from typing import TYPE_CHECKING

from ..lazy import public

if TYPE_CHECKING:
    from .judging.judge import judge as judge
    from .judging.recipe import read_judge_recipe as read_judge_recipe
    from .model_file import TrainedNetwork as TrainedNetwork
    from .model_file import read_model as read_model
    from .model_file import with_judgement as with_judgement
    from .recipe import read_recipe as read_recipe
    from .training import train as train

__getattr__, __dir__, _ = public(__name__, "mphdrr[learning]")
