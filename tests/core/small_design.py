"""Small recipes of designs, and phantoms for them."""

from __future__ import annotations

from copy import deepcopy
from pathlib import Path
from typing import Any

from mphdrr.core.design.recipe import DesignRecipe, design_recipe

BODY = '[[shape]]\nkind = "sphere"\nradius = 20\nactivity = 50\n'
PARTS = (
    '[[shape]]\nkind = "sphere"\nradius = 7\nposition = [8, 0, 3]\nactivity = 20\n'
    '[[shape]]\nkind = "sphere"\nradius = 6\nposition = [-9, 5, -4]\nactivity = 30\n'
)

RECIPE: dict[str, Any] = {
    "version": 1,
    "generator": {
        "kind": "ellipse", "modules": 3, "semi_axes": [150.0, 140.0], "center": [4.0, -3.0], "start": 10.0, "end": 250.0,
        "z": [-28.0, 31.0], "pinhole_diameter": 4.0, "collimator_length": 60.0, "detector_side": 50.0,
        "detector_thickness": 8.0, "roi_radius": 26.0,
    },
    "free": {
        "semi_axes": [[110.0, 200.0], [110.0, 200.0]], "z": [[-60.0, -20.0], [20.0, 60.0]], "start": [0.0, 30.0],
        "pinhole_diameter": [1.0, 9.0], "collimator_length": [40.0, 90.0],
    },
    "objectives": [{"kind": "detail", "size": 8.0, "points": 5}],
    "model": {"intrinsic_fwhm": 2.0, "time": 60.0, "background": 0.01},
    "imaging": {"voxels": 12, "spacing": 5.0, "pixels": 8},
    "search": {"starts": 2, "coarse_steps": 6, "steps": 4},
}  # fmt: skip


def small_design(folder: Path = Path(), **tables: Any) -> DesignRecipe:
    """The recipe with other tables."""
    return design_recipe({**deepcopy(RECIPE), **tables}, folder)
