"""Designs for several values of one entry of a recipe: what one merit costs of another, as a table and as a plot."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from ..figures.page import SUFFIXES, Page
from ..figures.parts import INK, Axes, heading, ticks
from ..files import AnyPath, require_ending, write_bytes
from ..geometry.system import PinholeSystem
from ..physics.performance import resolution, sensitivity
from ..progress import Progress, part_of
from ..validation import one_of
from .objectives import ball_points
from .optimising import Design, optimize
from .recipe import DesignRecipe, read_design_recipe


@dataclass(frozen=True, eq=False)
class Front:
    """The designs of `pareto`, and a row of the table for each.

    Columns are the entry that varies, of the ROI the mean sensitivity (cps/MBq) and resolution (FWHM, mm, root mean square
    weighted by counts), the number of modules, the crystals' area (mm^2), the objectives, and whether it passes all checks.
    """

    designs: Sequence[Design]
    rows: Sequence[Mapping[str, Any]]
    x: str
    y: str

    def write(self, path: AnyPath) -> None:
        """Write the table (.csv, .json) or the plot (.png, .svg)."""
        ending = require_ending(path, (".csv", ".json", *SUFFIXES))
        if ending in SUFFIXES:
            self._page().write(path)
            return
        lines = [list(self.rows[0]), *(list(row.values()) for row in self.rows)]
        text = "\n".join(",".join(map(str, line)) for line in lines)
        write_bytes(path, (json.dumps(self.rows, indent=1) if ending == ".json" else text + "\n").encode())

    def _page(self) -> Page:
        """One column of the table against another, each design with its value of the entry."""
        page = Page(900, 600)
        em, rows = page.em, sorted(self.rows, key=lambda row: float(row[self.x]))
        xs, ys = ([float(row[name]) for row in rows] for name in (self.x, self.y))
        top = heading(page, f"{self.y} against {self.x}, of designs for {next(iter(rows[0]))}")
        spans = [(min(v) - 0.1 * _span(v), max(v) + 0.1 * _span(v)) for v in (xs, ys)]
        axes = Axes(page, (7 * em, top + em, page.width - 10 * em, page.height - top - 6 * em), spans[0], spans[1], em)
        axes.draw(ticks(*spans[0], 8), ticks(*spans[1], 6), below=self.x)
        axes.curve(xs, ys, "#2f6fb3", 0.16)
        for x, y, row in zip(xs, ys, rows, strict=True):
            words = f"{next(iter(row.values())):g}" + ("" if row["passes"] else " fails")
            page.text(words, axes.point(x, y)[0] + 0.4 * em, axes.point(x, y)[1] - 0.4 * em, 0.9 * em, INK)
        return page


def pareto(recipe: DesignRecipe | AnyPath, progress: Progress | None = None, folder: AnyPath | None = None) -> Front:
    """The best design for each of ``pareto.values`` of ``pareto.entry``, such as numbers of modules or resolutions.

    `recipe` and `progress` are as in `optimize`; in `folder` the state of each design is kept. `InputError` where the recipe
    has no such entry, or its table no such column.
    """
    recipe = recipe if isinstance(recipe, DesignRecipe) else read_design_recipe(recipe)
    entry, values = recipe["pareto.entry"], recipe["pareto.values"]
    if entry is None or not values:
        raise InputError("pareto: expected an entry, such as generator.modules, and its values")
    changed = [recipe.changed(entry, value) for value in values]
    for key in ("pareto.x", "pareto.y"):
        one_of(recipe[key], (entry, *_COLUMNS, *recipe.goals), key)
    designs, rows = list[Design](), list[Mapping[str, Any]]()
    for number, (value, own) in enumerate(zip(values, changed, strict=True)):
        state = None if folder is None else Path(folder) / f"design-{number + 1}.json"
        designs.append(found := optimize(own, part_of(progress, number, len(values)), state))
        worth = {name: float(pair[1]) for name, pair in found.values.items()}
        rows.append({entry: value, **_row(own, found.system), **worth, "passes": found.ok})
    return Front(designs, rows, recipe["pareto.x"], recipe["pareto.y"])


_COLUMNS = ("sensitivity", "resolution", "modules", "crystal area")


def _row(recipe: DesignRecipe, system: PinholeSystem) -> dict[str, float]:
    points, optics = ball_points(system.region_radius(), 33), recipe.model(system).optics
    counts, blur = (of(system, points, optics=optics) for of in (sensitivity, resolution))
    fwhm = np.sqrt((counts * np.nan_to_num(blur) ** 2).sum() / counts.sum())
    numbers = 1e6 * counts.sum() / len(points), fwhm, len(system), (system.detector_side**2).sum()
    return dict(zip(_COLUMNS, map(float, numbers), strict=True))


def _span(values: Sequence[float]) -> float:
    return (max(values) - min(values)) or abs(values[0]) or 1.0
