"""Learned reconstruction: networks that know the geometry of their scanner, and their judge.

Files of this room import torch, MONAI and Lightning only in their own modules; this one imports none of them, so that
commands and panels can say what is missing. `read_model`, `read_recipe` and `train` are imported when they are asked for.
"""

from importlib import import_module
from pathlib import Path
from typing import Any

from ..errors import InputError
from ..reconstruction.methods import METHOD_FILES, Method

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
    try:
        return getattr(import_module(f".{_PUBLIC[name]}", __name__), name)
    except ModuleNotFoundError as error:
        raise InputError(f'{error.name} is missing: pip install "mphdrr[learning]"') from None


def __dir__() -> list[str]:
    return sorted(_PUBLIC)


def _network(path: Path) -> Method:
    found: Method = __getattr__("read_model")(path).method
    return found


METHOD_FILES[".pt"] = _network
