"""Pareto fronts: designs for several values of one entry of a recipe, as a table and as a plot of two of its columns."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from ..figures.page import SUFFIXES, Page
from ..figures.parts import INK, Axes, heading
from ..files import AnyPath, require_ending, write_bytes
from ..geometry.system import PinholeSystem
from ..physics.performance import resolution, sensitivity
from ..progress import Progress, part_of
from ..runs.display import ticks
from ..validation import one_of
from .objectives import ball_points
from .optimising import Design, optimize
from .recipe import DesignRecipe, read_design_recipe


@dataclass(frozen=True, eq=False)
class Front:
    """Designs of `pareto`, with a table of their properties.

    Columns are the varied entry, the mean sensitivity in the ROI (cps/MBq), the resolution in the ROI (FWHM, mm, root mean
    square weighted by counts), the number of modules, the crystals' area (mm^2), the objectives, and whether the design
    passes all checks.
    """

    designs: Sequence[Design]
    """Best design for each value of the entry."""
    rows: Sequence[Mapping[str, Any]]
    """Row of the table for each design, by column."""
    x: str
    """Column of the plot's horizontal axis."""
    y: str
    """Column of the plot's vertical axis."""

    def write(self, path: AnyPath) -> None:
        """Write the table (.csv, .json) or the plot (.png, .svg)."""
        if (ending := require_ending(path, (".csv", ".json", *SUFFIXES))) in SUFFIXES:
            self._draw_plot().write(path)
            return
        cells = [list(self.rows[0]), *(list(row.values()) for row in self.rows)]
        text = "\n".join(",".join(map(str, line)) for line in cells)
        write_bytes(path, (json.dumps(self.rows, indent=1) if ending == ".json" else text + "\n").encode())

    def _draw_plot(self) -> Page:
        """Draw column y against column x, each design marked with its value of the entry."""
        page = Page(900, 600)
        em, rows = page.em, sorted(self.rows, key=lambda row: float(row[self.x]))
        xs, ys = ([float(row[name]) for row in rows] for name in (self.x, self.y))
        top = heading(page, f"{self.y} against {self.x}, of designs for {next(iter(rows[0]))}")
        x_limits, y_limits = ((min(v) - 0.1 * _span(v), max(v) + 0.1 * _span(v)) for v in (xs, ys))
        axes = Axes(page, (7 * em, top + em, page.width - 10 * em, page.height - top - 6 * em), x_limits, y_limits, em)
        axes.draw(ticks(*x_limits, 8), ticks(*y_limits, 6), below=self.x)
        axes.curve(xs, ys, "#2f6fb3", 0.16)
        for x, y, row in zip(xs, ys, rows, strict=True):
            label = f"{next(iter(row.values())):g}" + ("" if row["passes"] else " fails")
            page.text(label, axes.point(x, y)[0] + 0.4 * em, axes.point(x, y)[1] - 0.4 * em, 0.9 * em, INK)
        return page


def pareto(recipe: DesignRecipe | AnyPath, progress: Progress | None = None, folder: AnyPath | None = None) -> Front:
    """Find the best design for each of ``pareto.values`` of ``pareto.entry``, such as numbers of modules or resolutions.

    `recipe` is a recipe or the path of its file, `progress` is called with (steps done, steps). The state of each design is
    written to `folder`, so that the same call continues a stopped search. Raises `InputError` if the recipe has no such
    entry, or its table no such column.
    """
    recipe = recipe if isinstance(recipe, DesignRecipe) else read_design_recipe(recipe)
    entry, values = recipe["pareto.entry"], recipe["pareto.values"]
    if entry is None or not values:
        raise InputError("pareto: expected an entry, such as generator.modules, and its values")
    recipes = [recipe.changed(entry, value) for value in values]
    for key in ("pareto.x", "pareto.y"):
        one_of(recipe[key], (entry, *_COLUMNS, *recipe.goals), key)
    designs, rows = list[Design](), list[Mapping[str, Any]]()
    for number, (value, changed_recipe) in enumerate(zip(values, recipes, strict=True)):
        state = None if folder is None else Path(folder) / f"design-{number + 1}.json"
        designs.append(design := optimize(changed_recipe, part_of(progress, number, len(values)), state))
        objectives = {name: float(pair[1]) for name, pair in design.values.items()}
        rows.append({entry: value, **_properties(changed_recipe, design.system), **objectives, "passes": design.ok})
    return Front(designs, rows, recipe["pareto.x"], recipe["pareto.y"])


_COLUMNS = ("sensitivity", "resolution", "modules", "crystal area")


def _properties(recipe: DesignRecipe, system: PinholeSystem) -> dict[str, float]:
    """Return the properties `_COLUMNS` of a system, with the recipe's model of emission."""
    points, optics = ball_points(system.region_radius(), 33), recipe.model(system).optics
    counts, fwhm = (function(system, points, optics=optics) for function in (sensitivity, resolution))
    mean_fwhm = np.sqrt((counts * np.nan_to_num(fwhm) ** 2).sum() / counts.sum())
    numbers = 1e6 * counts.sum() / len(points), mean_fwhm, len(system), (system.detector_side**2).sum()
    return dict(zip(_COLUMNS, map(float, numbers), strict=True))


def _span(values: Sequence[float]) -> float:
    """Return the range of values, or a substitute above 0 if all are equal."""
    return (max(values) - min(values)) or abs(values[0]) or 1.0
