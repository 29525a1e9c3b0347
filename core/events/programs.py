"""The programs that event sets are exported for, one line each; what writes for them is imported when it is wanted."""

from __future__ import annotations

import inspect
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .exports.layout import Layout


@dataclass(frozen=True)
class Program:
    """A program, or a layout, that sets are exported for."""

    name: str  # on the command line
    title: str  # what is written, in one line
    of: str  # its layout's class, in the module of `exports` that is called alike

    @property
    def layout(self) -> type[Layout]:
        """Made of what is chosen, with the program's options as keyword-only parameters."""
        return getattr(import_module(f".exports.{self.of.lower()}", __package__), self.of)

    @property
    def options(self) -> tuple[str, ...]:
        """Names of its options."""
        parameters = inspect.signature(self.layout).parameters.values()
        return tuple(p.name for p in parameters if p.kind is p.KEYWORD_ONLY)


_PROGRAMS = (
    Program(
        "legacy", "truth_i.pt, Projections_i.pt by slots, ProjRadonN_i.pt, RunTranslate.npy, RunRotate.npy", "Legacy"
    ),
    Program("3dunet", "pytorch-3dunet: an HDF5 file an event with raw and label, in a folder for each split", "Unet3d"),
    Program("webdataset", "tar archives for WebDataset, of one split each", "WebDataset"),
    Program("npz", "an archive of numpy an event, with all that is known of it", "Npz"),
)
PROGRAMS: dict[str, Program] = {program.name: program for program in _PROGRAMS}
