"""A small training for tests: a network of one convolution after OSEM, and a set of small events."""

from __future__ import annotations

import shutil
from pathlib import Path

import torch
from torch import nn

from mphdrr.core.learning.model_file import TrainedNetwork
from mphdrr.core.learning.networks import NETWORKS, NetworkKind
from mphdrr.core.learning.recipe import TrainingRecipe, read_recipe

from .small_recipes import TRAINING


class Toy(nn.Module):
    """Network that corrects OSEM's last volume by a convolution."""

    may_be_0 = ()

    def __init__(
        self, channels: int = 2, kernels: tuple[int, ...] = (3,), leaky: bool = True, *, volumes: int = 1
    ) -> None:
        super().__init__()
        self.first = nn.Conv3d(volumes, channels, kernels[0], padding=kernels[0] // 2)
        self.last = nn.Conv3d(channels, 1, 3, padding=1)
        self.leaky = leaky

    @classmethod
    def fixed(cls, setup) -> dict[str, int]:
        return {"volumes": len(setup.after)}

    def forward(self, setup, sample) -> list[torch.Tensor]:
        middle = nn.functional.leaky_relu(self.first(sample.osem), 0.1 if self.leaky else 0.0)
        noise = 1e-3 * torch.randn(1) if self.training else 0.0
        found = sample.osem[:, -1:] + self.last(middle) + noise
        return [found, 0.5 * (found + sample.osem[:, :1])]


class ToyKind(NetworkKind):
    """Row of `NETWORKS` for the toy network."""

    def load(self) -> type:
        return Toy


TOY = ToyKind("Toy", "One convolution", "toy")


def add_toy() -> None:
    """Put the toy into the table of networks, for a process of its own."""
    NETWORKS["toy"] = TOY  # type: ignore[index]


def small_training(folder: Path, events: Path, text: str = TRAINING) -> TrainingRecipe:
    """Write the recipe of a training into a folder, with a copy of its set of events."""
    shutil.copytree(events, folder / "set")
    (folder / "training.toml").write_text(text, encoding="utf-8")
    return read_recipe(folder / "training.toml")


def same_weights(first: TrainedNetwork, second: TrainedNetwork) -> bool:
    """Return whether the weights of two networks are the same bit for bit."""
    a, b = first.contents.weights, second.contents.weights
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)
