"""Table of the programs for which event sets are exported; the class that writes for one is imported on first use."""

from __future__ import annotations

import inspect
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .exports.layout import ExportLayout


@dataclass(frozen=True)
class Program:
    """A program, or a layout of files, for which event sets are exported."""

    name: str
    """Name on the command line."""
    title: str
    """Description of the written files, in one line."""
    class_name: str
    """Name of the `ExportLayout` class, whose module in `exports` has the same name in lower case."""

    @property
    def layout(self) -> type[ExportLayout]:
        """The class that writes the files: called with an `ExportSelection` and the program's options as keywords."""
        return getattr(import_module(f".exports.{self.class_name.lower()}", __package__), self.class_name)

    @property
    def options(self) -> tuple[str, ...]:
        """The names of the program's options."""
        parameters = inspect.signature(self.layout).parameters.values()
        return tuple(p.name for p in parameters if p.kind is p.KEYWORD_ONLY)


_PROGRAMS = (
    Program(
        "legacy", "truth_i.pt, Projections_i.pt by slots, ProjRadonN_i.pt, RunTranslate.npy, RunRotate.npy", "Legacy"
    ),
    Program("3dunet", "pytorch-3dunet: an HDF5 file per event with raw and label, in a folder per split", "Unet3d"),
    Program("webdataset", "tar archives for WebDataset, of one split each", "WebDataset"),
    Program("npz", "one NumPy archive per event, with all its arrays, settings and poses", "Npz"),
)
PROGRAMS: dict[str, Program] = {program.name: program for program in _PROGRAMS}
