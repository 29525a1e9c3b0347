"""A projection run: the images, and everything they were made from."""

import contextlib
import platform
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import metadata
from typing import Any

import numpy as np

from ..arrays import Floats, Floats32, checked
from ..errors import InputError
from ..geometry.scanner import Scanner
from ..geometry.views import Views
from ..models.model import checked_background
from ..validation import freeze, real_numbers
from ..version import VERSION
from ..volumes.volume import Volume
from .recipe import Recipe, recipe_of_tables


def versions() -> dict[str, str]:
    """Versions of mphDRR, Python and what the numbers depend on; "cpu" is the level of the compiled kernels."""
    found = {"mphdrr": VERSION, "python": platform.python_version(), "numpy": np.__version__}
    with contextlib.suppress(metadata.PackageNotFoundError):
        found["torch"] = metadata.version("torch")
    with contextlib.suppress(ImportError, OSError):  # there is none for this platform
        from ..rays.backends import cpu

        found["cpu"] = cpu.levels()[cpu.level]
    return found


@dataclass(frozen=True, eq=False)
class ProjectionRun:
    """The images of one run, with geometry, volume and provenance; `InputError` where the parts do not fit together.

    A measured run (`counts_run`) has no volume: nobody knows what was in the scanner.
    """

    projections: Floats32  # (M, n_v, n_u), column index along +u, row index along +v
    system: Scanner  # the M modules
    views: Views  # the M images' rays
    volume: Volume | None = None  # what was projected; None where the images were measured
    unit: str = ""  # of the projections, such as "kBq/mL mm"
    settings: Mapping[str, Any] = field(default_factory=dict)  # how they were made: anything JSON can hold
    seed: int | None = None  # of the noise; None where the projections have none
    workbook: str = ""  # name of the geometry workbook, and its SHA-256; empty where there is none
    workbook_sha256: str = ""
    versions: Mapping[str, str] = field(default_factory=versions)  # of mphDRR and what it ran on
    background: float | Floats = 0.0  # besides the volume, as in `Emission`: (), (M,) or images
    efficiency: float | Floats = 1.0  # of the pixels, in the same forms

    def __post_init__(self) -> None:
        self.views.require_pinholes("run")
        if len(self.views) != len(self.system):
            raise InputError(f"run: {len(self.system)} modules, but {len(self.views)} views")
        shape = (len(self.views), *self.views.shape)
        name = "run: projections"
        projections = checked(real_numbers(self.projections, name), name, shape, False)
        object.__setattr__(self, "projections", freeze(projections.view()))
        for form in ("background", "efficiency"):
            found = checked_background(getattr(self, form), f"run: {form}", len(self.views), self.views.shape)
            object.__setattr__(self, form, found)
        if not self.unit:
            if self.volume is None:
                raise InputError("run: without a volume, say the unit of the projections, such as counts")
            object.__setattr__(self, "unit", f"{self.volume.unit} mm")
        source = self.system.source
        if source is not None and not self.workbook_sha256:
            object.__setattr__(self, "workbook", source.path.name)
            object.__setattr__(self, "workbook_sha256", source.sha256)

    @property
    def is_measured(self) -> bool:
        """Whether the images are counts of a real or another simulator's scanner."""
        return "frames" in self.settings

    @property
    def recipe(self) -> Recipe:
        """What was asked for; `InputError` where the run holds no recipe, as those of version 0.1.0."""
        if "recipe" not in self.settings:
            raise InputError("the run holds no recipe: give its model, as by --set model.kind=emission or --recipe")
        return recipe_of_tables(self.settings["recipe"], recorded=True)

    def intrinsics(self) -> Floats:
        """Camera matrices K (M, 3, 3), pixels: ``K @ (x_u, x_v, x_k)`` is a multiple of ``(column, row, 1)``.

        (x_u, x_v, x_k) is a point in the module's frame, mm from the pinhole.
        """
        rotations = self.system.poses()[:, :3, :3]
        matrices = self.views.projection_matrices()[:, :, :3] @ rotations
        return matrices / matrices[:, 2:, 2:]
