"""Learned reconstruction: networks that know the geometry of their scanner, and their judge.

Files of this room import torch, MONAI and Lightning only in their own modules; this one imports none of them, so that
commands and panels can say what is missing. `read_model`, `read_recipe` and `train` are imported when they are asked for.
"""

from importlib import import_module
from typing import Any

from ..errors import needing

_PUBLIC = {
    "read_model": "model_file",
    "TrainedNetwork": "model_file",
    "with_judgement": "model_file",
    "read_recipe": "recipe",
    "train": "training",
    "read_judge_recipe": "judging.recipe",
    "judge": "judging.judge",
}


def __getattr__(name: str) -> Any:
    if name not in _PUBLIC:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    with needing("mphdrr[learning]"):
        return getattr(import_module(f".{_PUBLIC[name]}", __name__), name)


def __dir__() -> list[str]:
    return sorted(_PUBLIC)
