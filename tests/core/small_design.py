"""A small recipe of a design, and phantoms for it."""

from __future__ import annotations

from copy import deepcopy
from pathlib import Path
from typing import Any

from mphdrr.core.design.recipe import DesignRecipe, design_recipe
from mphdrr.core.recipes.toml import parse_toml

BODY = '[[shape]]\nkind = "sphere"\nradius = 20\nactivity = 50\n'
PARTS = (
    '[[shape]]\nkind = "sphere"\nradius = 7\nposition = [8, 0, 3]\nactivity = 20\n'
    '[[shape]]\nkind = "sphere"\nradius = 6\nposition = [-9, 5, -4]\nactivity = 30\n'
)
TEXT = """
version = 1

[generator]
kind = "ellipse"
modules = 3
semi_axes = [150, 140]
center = [4, -3]
start = 10
end = 250
z = [-28, 31]
pinhole_diameter = 4
collimator_length = 60
detector_side = 50
detector_thickness = 8
roi_radius = 26

[free]
semi_axes = [[110, 200], [110, 200]]
z = [[-60, -20], [20, 60]]
start = [0, 30]
pinhole_diameter = [1, 9]
collimator_length = [40, 90]

[[objectives]]
kind = "detail"
size = 8
points = 5

[model]
intrinsic_fwhm = 2
time = 60
background = 0.01

[imaging]
voxels = 12
spacing = 5
pixels = 8

[search]
starts = 2
coarse_steps = 4
steps = 1
"""
RECIPE: dict[str, Any] = parse_toml(TEXT, "recipe")


def small_design(folder: Path = Path(), **tables: Any) -> DesignRecipe:
    """Return the recipe with other tables."""
    return design_recipe({**deepcopy(RECIPE), **tables}, folder)
