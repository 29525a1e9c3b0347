"""Designs for several values of one entry of a recipe: what one merit costs of another, as a table and as a plot."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from ..figures.page import Page
from ..figures.parts import INK, Axes, heading, ticks
from ..files import AnyPath, require_ending, write_bytes
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
        ending = require_ending(path, (".csv", ".json", ".png", ".svg"))
        if ending == ".json":
            write_bytes(path, json.dumps(list(self.rows), indent=1).encode())
        elif ending == ".csv":
            text = io.StringIO()
            table = csv.DictWriter(text, list(self.rows[0]))
            table.writeheader()
            table.writerows(self.rows)
            write_bytes(path, text.getvalue().encode())
        else:
            self._page().write(path)

    def _page(self) -> Page:
        page = Page(900, 600)
        em, (xs, ys) = page.em, ([float(row[name]) for row in self.rows] for name in (self.x, self.y))
        (left, right), (low, high) = ((min(v) - 0.1 * _span(v), max(v) + 0.1 * _span(v)) for v in (xs, ys))
        top = heading(page, f"{self.y} against {self.x}", [f"each design for one {next(iter(self.rows[0]))}"])
        axes = Axes(
            page, (7 * em, top + em, page.width - 10 * em, page.height - top - 6 * em), (left, right), (low, high), em
        )
        axes.draw(ticks(left, right, 8), ticks(low, high, 6), below=self.x)
        order = np.argsort(xs)
        axes.curve(np.array(xs)[order], np.array(ys)[order], "#2f6fb3", 0.16)
        for x, y, row in zip(xs, ys, self.rows, strict=True):
            at = axes.to(x, y)
            words = f"{next(iter(row.values())):g}" + ("" if row["passes"] else " fails")
            page.text(words, at[0] + 0.4 * em, at[1] - 0.4 * em, 0.9 * em, INK)
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
    columns = list(_row(recipe, entry, 0.0, recipe.parameters.build(recipe.parameters.start)))
    for key in ("pareto.x", "pareto.y"):
        one_of(recipe[key], [*columns, *recipe.names, "passes"], key)
    designs, rows = list[Design](), list[Mapping[str, Any]]()
    for number, (value, own) in enumerate(zip(values, changed, strict=True)):
        state = None if folder is None else Path(folder) / f"design-{number + 1}.json"
        designs.append(found := optimize(own, part_of(progress, number, len(values)), state))
        worth = {name: float(pair[1]) for name, pair in found.values.items()}
        rows.append({**_row(own, entry, value, found.system), **worth, "passes": found.ok})
    return Front(designs, rows, recipe["pareto.x"], recipe["pareto.y"])


def _row(recipe: DesignRecipe, entry: str, value: float, system: Any) -> dict[str, Any]:
    points, optics = ball_points(system.region_radius(), 33), recipe.model(system).optics
    counts = sensitivity(system, points, optics=optics)
    squared = np.nan_to_num(resolution(system, points, optics=optics)) ** 2
    seen = {
        "sensitivity": 1e6 * counts.sum() / len(points),
        "resolution": ((counts * squared).sum() / counts.sum()) ** 0.5,
    }
    area = float((system.detector_side**2).sum())
    return {entry: value, **{k: float(v) for k, v in seen.items()}, "modules": len(system), "crystal area": area}


def _span(values: Sequence[float]) -> float:
    return (max(values) - min(values)) or abs(values[0]) or 1.0
