"""Learned reconstruction: networks that know the geometry of their scanner, and their judge.

Files of this room import torch, MONAI and Lightning only in their own modules; this one imports none of them, so that
commands and panels can say what is missing. `read_model`, `read_recipe` and `train` are imported when they are asked for.
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
