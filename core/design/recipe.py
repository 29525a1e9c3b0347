"""Recipes of designs: which numbers are free, what is wanted, what must hold, and how the gain is judged, in TOML."""

import hashlib
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

from ..arrays import Array
from ..errors import InputError, naming
from ..files import read_bytes
from ..geometry.grid import Grid
from ..geometry.system import PinholeSystem, chosen_modules
from ..phantoms.language import parse_phantom, read_phantom
from ..phantoms.phantom import ShapePhantom
from ..projector import Emission, Projector
from ..recipes.settings import Setting, choice_setting, settings_by_key, table_names, word_labels
from ..recipes.tables import check_entries, read_table, require_value, table_entries
from ..recipes.toml import read_toml
from ..recipes.values import Values
from ..runs.recipe import Recipe
from ..runs.run_recipe import recipe_model
from ..runs.settings import SETTINGS
from ..validation import one_of
from ..workbook import read_system
from .objectives import Detail, Lesion, Regions, Sensitivity, ball_points
from .parameters import Parameters, parameters, workbook
from .penalties import Clearance, Constraint, CrystalArea, FieldOfView, Overlap, Sight, SmallestHole
from .solvers import SOLVERS

VERSION = 1
TEMPLATE = Path(__file__).parent / "templates" / "design.toml"
_POINTS = (
    Setting("radius", float, None, "Of the ball whose points are looked at", "the largest ROI", unit="mm", least=0),
    Setting("points", int, 33, "How many points of it", least=1),
)
_BODIES = (
    Setting("body", str, None, "Phantom (.toml), or its text: what is there besides; several are cases", sizes=()),
    Setting("parts", str, None, "Phantom (.toml), or its text, whose shapes are the lesions or the regions"),
    Setting("worst", bool, False, "The worst case counts, not the mean"),
)
_OBJECTIVES: Mapping[str, tuple[Setting, ...]] = {
    "sensitivity": (Setting("resolution", float, None, "Of the image that is wanted", unit="mm", above=0), *_POINTS),
    "detail": (Setting("size", float, None, "Of rods or stripes", unit="mm", above=0), *_POINTS,
               Setting("hole", str, "disc", "How the hole blurs", words=word_labels(("disc", "gaussian")))),
    "lesion": _BODIES,
    "regions": _BODIES,
}  # fmt: skip
"""The kinds of objectives, and their settings."""
_OPTICS = "time isotope window energy_fwhm aperture_mu opening_angle_degrees crystal_mu intrinsic_fwhm background"
_ROWS = settings_by_key((
    *(SETTINGS[f"model.{name}"].with_key(f"model.{name}") for name in _OPTICS.split()),
    Setting("imaging.voxels", int, 32, "Voxels along x, y and z", least=1),
    Setting("imaging.spacing", float, 5.0, "Voxel size", unit="mm", above=0),
    Setting("imaging.pixels", int, 32, "Pixels along each side of a crystal", least=2),
    Setting("constraints.gap", float, 0.5, "Between modules", unit="mm", least=0),
    Setting("constraints.bore", float, None, "Radius of a bore along z that no module enters", unit="mm", above=0),
    Setting("constraints.body", float, None, "Semi-axes of an elliptic cylinder along z that no module enters; and x and y "
            "of its middle, where that is not the isocentre", unit="mm", sizes=(2, 4)),
    Setting("constraints.smallest_hole", float, None, "Diameter", unit="mm", above=0),
    Setting("constraints.crystal_area", float, None, "Of all crystals together, at most", unit="mm2", above=0),
    Setting("search.starts", int, 3, "Starts: that of the recipe, and others at random", least=1),
    Setting("search.seed", int, 0, "Of the random starts", least=0),
    Setting("search.coarse", int, 2, "The first search has voxels and pixels so many times as large", least=1),
    Setting("search.coarse_steps", int, 15, "Steps from each start", least=1),
    Setting("search.steps", int, 15, "Steps of each of the three rounds that follow, with ever harder penalties", least=1),
    *choice_setting("search.solver", SOLVERS, "Algorithm of the search"),
    Setting("pareto.entry", str, None, "The entry that varies, such as generator.modules or objectives.resolution"),
    Setting("pareto.values", float, (), "What it is in turn", sizes=()),
    Setting("pareto.x", str, "resolution", "The column of the table that is across the plot"),
    Setting("pareto.y", str, "sensitivity", "The column of the table that is upward"),
    Setting("evaluation.body", str, None, "Phantom (.toml), or its text, that is imaged and reconstructed"),
    Setting("evaluation.lesion", str, None, "A lesion in it, whose SNR is the score", "the score is NRMSE"),
    Setting("evaluation.draws", int, 20, "Draws of noise", least=2),
    Setting("evaluation.iterations", int, 10, "Of OSEM", least=1),
    Setting("evaluation.subsets", int, None, "Of OSEM", "as many as suit", least=1),
    Setting("evaluation.seed", int, 0, "Of the noise", least=0),
))  # fmt: skip
_TABLES = table_names(_ROWS)


class Objective(Values):
    """The settings of what is wanted."""

    @property
    def rows(self) -> Mapping[str, Setting]:
        """Those of its kind."""
        one_of(self.given.get("kind"), _OBJECTIVES, "kind")
        weight = Setting("weight", float, 1.0, "Its share, each objective being 1 at the start", above=0)
        return settings_by_key((Setting("kind", str, None, "What is wanted"), weight, *_OBJECTIVES[self.given["kind"]]))

    def __post_init__(self) -> None:
        super().__post_init__()
        for key in ("resolution", "size", "body", "parts"):
            if key in self.rows:
                require_value(self[key], key, f"expected {self.rows[key].text}")


@dataclass(frozen=True)
class DesignRecipe(Values):
    """A design that is wanted: values of settings by their keys, such as "search.starts", and three tables.

    Made by `design_recipe` or `read_design_recipe`; `InputError` names the entry that cannot be understood.
    """

    generator: Mapping[str, Any] = field(default_factory=dict)
    free: Mapping[str, Any] = field(default_factory=dict)
    objectives: Sequence[Mapping[str, Any]] = ()
    folder: Path = Path()

    rows = _ROWS  # type: ignore[assignment]

    def __post_init__(self) -> None:
        super().__post_init__()
        are_tables = isinstance(self.objectives, list) and all(isinstance(entry, dict) for entry in self.objectives)
        if not are_tables or not self.objectives:
            raise InputError("objectives: expected one [[objectives]] or more")
        _ = self.goals

    @cached_property
    def goals(self) -> dict[str, Objective]:
        """The settings of what is wanted, by the names that tables call it."""
        found = {}
        for number, entry in enumerate(self.objectives, 1):
            with naming(f"objectives {number}"):
                found[f"{entry.get('kind')} {number}"] = Objective(entry)
        return found

    @cached_property
    def parameters(self) -> Parameters:
        """The free numbers, and the scanner that they make."""
        given = dict(self.generator)
        kind = given.pop("kind", "ellipse")
        if kind == "workbook":
            file = require_value(given.pop("file", None), "generator.file", "name the workbook")
            system = chosen_modules(read_system(self.folder / file), given.pop("modules", None), "generator.modules")
            given = workbook(system, **given)
        return parameters(kind, given, self.free)

    @property
    def constraints(self) -> list[Constraint]:
        """What must hold."""
        bore, area = self["constraints.bore"], self["constraints.crystal_area"]
        limits = ((Clearance, bore and (bore, bore)), (Clearance, self["constraints.body"]),
                  (SmallestHole, self["constraints.smallest_hole"]), (CrystalArea, area and area**0.5))  # fmt: skip
        always = [FieldOfView(margin=0.0), Overlap(margin=self["constraints.gap"]), Sight()]
        return [*always, *(kind(limit) for kind, limit in limits if limit is not None)]

    def model(self, system: PinholeSystem) -> Emission:
        """How a scanner counts."""
        own = {key: value for key, value in self.given.items() if key.startswith("model.")}
        return recipe_model(Recipe({"model.kind": "emission", "model.hole": "depth", **own}), system)  # type: ignore[return-value]

    def grid(self, coarse: int = 1) -> Grid:
        """The voxels of what is imaged, or fewer and larger ones."""
        n = self["imaging.voxels"]
        fewer = -(-n // coarse)
        return Grid.centered(fewer, self["imaging.spacing"] * n / fewer)

    def projector(self, system: PinholeSystem, coarse: int = 1) -> Projector:
        """The images of a scanner: those of the crystals, whole."""
        n = max(2, self["imaging.pixels"] // coarse)
        return Projector(self.grid(coarse), system.views((n, n), "real"), self.model(system))

    def volumes(self, phantom: str, apart: bool = False, coarse: int = 1) -> list[Array]:
        """The phantom in a file or a text, voxelized: as a whole, or each of its shapes by itself."""
        found = parse_phantom(phantom, "phantom") if "\n" in phantom else read_phantom(self.folder / phantom)
        whole = [ShapePhantom([shape]) for shape in found.shapes] if apart else [found]
        return [one.voxelize(self.grid(coarse)).array for one in whole]

    def wanted(self, coarse: int = 1) -> list[Any]:
        """The objectives as functions of a system, with voxels and pixels so many times as large."""
        return [self._wanted(own, own["kind"], coarse) for own in self.goals.values()]

    def _wanted(self, own: Objective, kind: str, coarse: int) -> Any:
        if kind in ("lesion", "regions"):
            bodies = [volume for body in own["body"] for volume in self.volumes(body, coarse=coarse)]
            images, parts = partial(self.projector, coarse=coarse), self.volumes(own["parts"], True, coarse)
            return (Lesion if kind == "lesion" else Regions)(images, bodies, parts, own["worst"])
        start, radius = self.parameters.build(self.parameters.start), own["radius"]
        points = ball_points(start.region_radius() if radius is None else radius, own["points"])
        if kind == "sensitivity":
            return Sensitivity(self.model, points, own["resolution"])
        return Detail(self.model, points, own["size"], own["hole"])

    def changed(self, entry: str, value: float) -> "DesignRecipe":
        """The recipe with another number in an entry TABLE.NAME; of objectives in all that have it."""
        first, _, name = entry.partition(".")
        number = int(value) if float(value).is_integer() else value
        if entry in self.rows:
            return replace(self, given={**self.given, entry: number})
        if first == "generator" and name in self.generator:
            return replace(self, generator={**self.generator, name: number})
        if first != "objectives" or not any(name in goal for goal in self.objectives):
            raise InputError(f"pareto.entry: expected one of the recipe, such as generator.modules, got {entry!r}")
        return replace(self, objectives=[{**goal, name: number} if name in goal else goal for goal in self.objectives])

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 of all that decides over the design, with the contents of the files that it names."""
        others = ("pareto.", "evaluation.")
        own = sorted((key, value) for key, value in self.given.items() if not key.startswith(others))
        bodies = [
            text for goal in self.goals.values() if "parts" in goal.rows for text in (*goal["body"], goal["parts"])
        ]
        files = [text for text in (self.generator.get("file"), *bodies) if text and "\n" not in text]
        contents = [read_bytes(self.folder / name) for name in files]
        return hashlib.sha256(repr((own, self.generator, self.free, self.objectives, contents)).encode()).hexdigest()


def design_recipe(values: Mapping[str, Any], folder: Path = Path()) -> DesignRecipe:
    """The recipe of a design in tables, as TOML gives them; paths in it are relative to `folder`."""
    own = {name: read_table(values, name) for name in ("generator", "free")}
    check_entries(values, VERSION, ("version", *own, "objectives", *_TABLES))
    return DesignRecipe(table_entries(values, _ROWS), **own, objectives=values.get("objectives", []), folder=folder)


def read_design_recipe(path: str | os.PathLike[str]) -> DesignRecipe:
    """The recipe of a design in a TOML file; paths in it are relative to its folder. `InputError` names the entry."""
    with naming(path):
        return design_recipe(read_toml(path), Path(path).absolute().parent)
