"""A small event recipe for tests: eight modules, 16^3 voxels, two kinds of phantoms."""

from __future__ import annotations

from pathlib import Path

from mphdrr.core.events import EventRecipe, read_recipe

WORKBOOK = Path(__file__).parent / "data" / "eight-modules.xlsx"  # of the example: read in a tenth of the time

TEXT = f"""
version = 1
seed = 5

[system]
file = {str(WORKBOOK)!r}
modules = "1-4,21-24"

[detector]
rows = 14
columns = 16

[truth]
voxels = 16
spacing = 6.0

[[phantoms]]
kind = "derenzo"
radius = {{ from = 30, to = 36 }}
rod_diameters = [10, {{ from = 8, to = 9 }}, 0, 0, 0, 0]
activity = {{ from = 50.0, to = 100.0 }}

[phantoms.pose]
position = [{{ from = -8, to = 8 }}, 0, {{ from = -5, to = 5 }}]
euler_degrees = [{{ from = 0, to = 360 }}, {{ from = 0, to = 180 }}, {{ from = 0, to = 360 }}]

[[phantoms]]
kind = "points"
odds = 0.5
counts = [{{ from = 1, to = 3 }}, 2, 1]
spacing_of_points = [20, 20, 20]

[models.lines]
kind = "transmission"

[models.emission]
kind = "emission"
time = 100
hole = "point"
pixel_points = 1
tolerance = 1e6
background = 0.25

[radon]
angles = [6, 8]

[noise]
levels = [1.0, 0.25]

[splits]
train = 0.8
test = 0.2
"""


def with_phantoms(entries: str, text: str = TEXT) -> str:
    """Return the recipe with other phantoms."""
    return text[: text.index("[[phantoms]]")] + entries + "\n" + text[text.index("[models.lines]") :]


def small_recipe(folder: Path, text: str = TEXT) -> EventRecipe:
    """Write the recipe into a file of a folder, and return what is read of it."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "small.toml").write_text(text, encoding="utf-8")
    return read_recipe(folder / "small.toml")
