"""Projection run: the images, and everything that they were made from."""

import contextlib
import platform
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from importlib import metadata
from typing import Any

import numpy as np

from ..arrays import Floats, Floats32, checked
from ..errors import InputError
from ..geometry.scanner import Scanner
from ..geometry.views import Views
from ..models.model import checked_background
from ..validation import freeze, one_of, real_numbers
from ..version import VERSION
from ..volumes.volume import Volume
from .recipe import Recipe, recipe_from_tables


def versions() -> dict[str, str]:
    """Return the versions of mphDRR, Python, NumPy and torch, and as "cpu" the level of the compiled kernels."""
    numbers = {"mphdrr": VERSION, "python": platform.python_version(), "numpy": np.__version__}
    with contextlib.suppress(metadata.PackageNotFoundError):
        numbers["torch"] = metadata.version("torch")
    with contextlib.suppress(ImportError, OSError):  # this platform may have no compiled kernels
        from ..rays.backends import cpu

        numbers["cpu"] = cpu.levels()[cpu.level]
    return numbers


PHOTONS = {"all": "All", "primary": "Primary", "scatter": "Scatter"}
"""Parts of a run's images by the photons in them, see `ProjectionRun.of_photons`, with their labels."""


@dataclass(frozen=True, eq=False)
class ProjectionRun:
    """Images of one run with their geometry, volume and provenance; raises `InputError` if these do not fit together.

    A measured run (`counts_run`) has no volume: the activity in the scanner is unknown.
    """

    projections: Floats32
    """Images (M, n_v, n_u): column index along +u, row index along +v."""
    system: Scanner
    """Scanner with the M modules."""
    views: Views
    """Rays of the M images."""
    volume: Volume | None = None
    """Volume that was projected; None for measured images."""
    unit: str = ""
    """Unit of the projections, such as "kBq/mL mm"."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Record of how the images were made, with values that JSON can hold."""
    seed: int | None = None
    """Seed of the noise; None for images without drawn noise."""
    workbook: str = ""
    """Name of the geometry workbook's file; empty for a scanner without a workbook."""
    workbook_sha256: str = ""
    """SHA-256 of the workbook's file, hexadecimal."""
    versions: Mapping[str, str] = field(default_factory=versions)
    """Versions of mphDRR and of the programs that it ran on."""
    background: float | Floats = 0.0
    """Expected counts besides the volume's: one number, one for each module (M,), or images (M, n_v, n_u)."""
    efficiency: float | Floats = 1.0
    """Detection efficiency of the pixels, in one of the same forms."""
    scatter: Floats32 | None = None
    """Expected counts (M, n_v, n_u) of simulated scattered photons in `projections`; None where none were simulated."""

    def __post_init__(self) -> None:
        self.views.require_pinholes("run")
        if len(self.views) != len(self.system):
            raise InputError(f"run: {len(self.system)} modules, but {len(self.views)} views")
        shape = (len(self.views), *self.views.shape)
        name = "run: projections"
        projections = checked(real_numbers(self.projections, name), name, shape, False)
        object.__setattr__(self, "projections", freeze(projections.view()))
        for form in ("background", "efficiency"):
            values = checked_background(getattr(self, form), f"run: {form}", len(self.views), self.views.shape)
            object.__setattr__(self, form, values)
        if self.scatter is not None:
            name = "run: scatter"
            scatter = checked(real_numbers(self.scatter, name), name, shape, False)
            object.__setattr__(self, "scatter", freeze(scatter.view()))
        if not self.unit:
            if self.volume is None:
                raise InputError("run: without a volume, say the unit of the projections, such as counts")
            object.__setattr__(self, "unit", f"{self.volume.unit} mm")
        if (source := self.system.source) is not None and not self.workbook_sha256:
            object.__setattr__(self, "workbook", source.path.name)
            object.__setattr__(self, "workbook_sha256", source.sha256)

    @property
    def is_measured(self) -> bool:
        """Whether the images are counts that a real scanner, or another simulator, has recorded."""
        return "frames" in self.settings

    @property
    def recipe(self) -> Recipe:
        """Recipe of the run; `InputError` is raised for a run without one, such as those of version 0.1.0."""
        if "recipe" not in self.settings:
            raise InputError("the run holds no recipe: give its model, as by --set model.kind=emission or --recipe")
        return recipe_from_tables(self.settings["recipe"], recorded=True)

    def of_photons(self, part: str) -> "ProjectionRun":
        """Return the run with the images of one of `PHOTONS` alone: "scatter", or "primary" with all else.

        Of drawn counts primary is what remains without the expected scatter. Raises `InputError` for a run without scatter.
        """
        one_of(part, PHOTONS, "photons")
        if part == "all":
            return self
        if self.scatter is None:
            raise InputError(f"photons = {part}: the run holds no scatter; make it with --scatter body")
        images = self.scatter if part == "scatter" else self.projections - self.scatter
        return replace(self, projections=images, scatter=None)

    def intrinsics(self) -> Floats:
        """Return the camera matrices K (M, 3, 3), pixels: ``K @ (x_u, x_v, x_k)`` is a multiple of ``(column, row, 1)``.

        (x_u, x_v, x_k) is a point in the module's frame, mm from the pinhole.
        """
        matrices = self.views.projection_matrices()[:, :, :3] @ self.system.poses()[:, :3, :3]
        return matrices / matrices[:, 2:, 2:]
