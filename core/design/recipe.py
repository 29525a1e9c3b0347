"""Recipes of designs, in TOML: generator, free parameters, objectives, constraints, and evaluation of the gain."""

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
from ..volumes.volume import Volume
from ..workbook import read_system
from .objectives import Detail, Lesion, Regions, Sensitivity, ball_points
from .parameters import FreeParameters, check_generator, displacement_parameters, free_parameters
from .penalties import Clearance, Constraint, CrystalArea, FieldOfView, LineOfSight, ModuleSeparation, SmallestHole
from .solvers import SOLVERS

VERSION = 1
TEMPLATE = Path(__file__).parent / "templates" / "design.toml"
_POINTS = (
    Setting("radius", float, None, "Radius of the ball with the points", "the largest ROI", unit="mm", least=0),
    Setting("points", int, 33, "Number of points in the ball", least=1),
)
_BODIES = (
    Setting("body", str, None, "Phantom (.toml), or its text, of the background; several are cases", sizes=()),
    Setting("parts", str, None, "Phantom (.toml), or its text, whose shapes are the lesions or the regions"),
    Setting("worst", bool, False, "Value of the worst case instead of the mean"),
)
_OBJECTIVES: Mapping[str, tuple[Setting, ...]] = {
    "sensitivity": (Setting("resolution", float, None, "Resolution of the image", unit="mm", above=0), *_POINTS),
    "detail": (Setting("size", float, None, "Size of rods or stripes", unit="mm", above=0), *_POINTS,
               Setting("hole", str, "disc", "Shape of the hole's blur", words=word_labels(("disc", "gaussian")))),
    "lesion": _BODIES,
    "regions": _BODIES,
}  # fmt: skip
"""Settings of each kind of objective."""
_OPTICS = "time isotope window energy_fwhm aperture_mu opening_angle_degrees crystal_mu intrinsic_fwhm background"
_ROWS = settings_by_key((
    *(SETTINGS[f"model.{name}"].with_key(f"model.{name}") for name in _OPTICS.split()),
    Setting("imaging.voxels", int, 32, "Voxels along x, y and z", least=1),
    Setting("imaging.spacing", float, 5.0, "Voxel size", unit="mm", above=0),
    Setting("imaging.pixels", int, 32, "Pixels along each side of a crystal", least=2),
    Setting("constraints.gap", float, 0.5, "Gap between modules", unit="mm", least=0),
    Setting("constraints.bore", float, None, "Radius of a bore along z that no module enters", unit="mm", above=0),
    Setting("constraints.body", float, None, "Semi-axes of an elliptic cylinder along z that no module enters; and x and y "
            "of its centre, if that is not the isocentre", unit="mm", sizes=(2, 4)),
    Setting("constraints.smallest_hole", float, None, "Smallest diameter of a hole", unit="mm", above=0),
    Setting("constraints.crystal_area", float, None, "Largest area of all crystals together", unit="mm2", above=0),
    Setting("search.starts", int, 3, "Starts: that of the recipe, and others at random", least=1),
    Setting("search.seed", int, 0, "Seed of the random starts", least=0),
    Setting("search.coarse", int, 2, "Factor of the size of voxels and pixels in the first searches", least=1),
    Setting("search.coarse_steps", int, 15, "Steps from each start", least=1),
    Setting("search.steps", int, 15, "Steps of each of the three rounds that follow, with increasing penalties", least=1),
    *choice_setting("search.solver", SOLVERS, "Algorithm of the search"),
    Setting("pareto.entry", str, None, "Entry that varies, such as generator.modules or objectives.resolution"),
    Setting("pareto.values", float, (), "Values of this entry", sizes=()),
    Setting("pareto.x", str, "resolution", "Column of the table for the plot's horizontal axis"),
    Setting("pareto.y", str, "sensitivity", "Column of the table for the plot's vertical axis"),
    Setting("evaluation.body", str, None, "Phantom (.toml), or its text, that is imaged and reconstructed"),
    Setting("evaluation.lesion", str, None, "A lesion in it, whose SNR is the score", "the score is NRMSE"),
    Setting("evaluation.scatter", str, "none", "Photons that the body scatters", words={
        "none": ("None", "The body neither scatters nor attenuates"),
        "body": ("In the Body", "By the body's mu; reconstructions know both"),
    }),
    Setting("evaluation.draws", int, 20, "Draws of noise", least=2),
    Setting("evaluation.iterations", int, 10, "Iterations of OSEM", least=1),
    Setting("evaluation.subsets", int, None, "Subsets of OSEM", "as many as suit", least=1),
    Setting("evaluation.seed", int, 0, "Seed of the noise", least=0),
))  # fmt: skip
_TABLES = table_names(_ROWS)


class ObjectiveSettings(Values):
    """Settings of one of a recipe's ``[[objectives]]``."""

    @property
    def rows(self) -> Mapping[str, Setting]:
        """Settings of this kind of objective, by key."""
        one_of(self.given.get("kind"), _OBJECTIVES, "kind")
        weight = Setting("weight", float, 1.0, "Weight, each objective being 1 at the start", above=0)
        kind = Setting("kind", str, None, "Kind of objective")
        return settings_by_key((kind, weight, *_OBJECTIVES[self.given["kind"]]))

    def __post_init__(self) -> None:
        super().__post_init__()
        for key in ("resolution", "size", "body", "parts"):
            if key in self.rows:
                require_value(self[key], key, f"expected {self.rows[key].text}")


@dataclass(frozen=True)
class DesignRecipe(Values):
    """Recipe of a design: values of settings by their keys, such as "search.starts", and three tables.

    Made by `design_recipe` or `read_design_recipe`; `InputError` names the entry that cannot be understood.
    """

    generator: Mapping[str, Any] = field(default_factory=dict)
    """Table ``[generator]``: its kind, and its arguments at the start of the design."""
    free: Mapping[str, Any] = field(default_factory=dict)
    """Table ``[free]``: limits of the free arguments of the generator."""
    objectives: Sequence[Mapping[str, Any]] = ()
    """Tables ``[[objectives]]``."""
    folder: Path = Path()
    """Folder to which the paths in the recipe are relative."""

    rows = _ROWS  # type: ignore[assignment]

    def __post_init__(self) -> None:
        super().__post_init__()
        are_tables = isinstance(self.objectives, list) and all(isinstance(entry, dict) for entry in self.objectives)
        if not are_tables or not self.objectives:
            raise InputError("objectives: expected one [[objectives]] or more")
        check_generator(self.generator, self.free)
        _ = self.goals  # refuses settings that cannot be understood

    @cached_property
    def goals(self) -> dict[str, ObjectiveSettings]:
        """Settings of the objectives, by the names of their columns in tables, such as "detail 1"."""
        goals = {}
        for number, entry in enumerate(self.objectives, 1):
            with naming(f"objectives {number}"):
                goals[f"{entry.get('kind')} {number}"] = ObjectiveSettings(entry)
        return goals

    @cached_property
    def parameters(self) -> FreeParameters:
        """Free parameters of the design."""
        values = dict(self.generator)
        kind = values.pop("kind", "ellipse")
        if kind == "workbook":
            file = require_value(values.pop("file", None), "generator.file", "name the workbook")
            system = chosen_modules(read_system(self.folder / file), values.pop("modules", None), "generator.modules")
            values = displacement_parameters(system, **values)
        return free_parameters(kind, values, self.free)

    @property
    def constraints(self) -> list[Constraint]:
        """Constraints of the search: field of view, separation and line of sight, and those with a limit in the recipe."""
        bore, area = self["constraints.bore"], self["constraints.crystal_area"]
        limits = ((Clearance, bore and (bore, bore)), (Clearance, self["constraints.body"]),
                  (SmallestHole, self["constraints.smallest_hole"]), (CrystalArea, area and area**0.5))  # fmt: skip
        always = [FieldOfView(margin=0.0), ModuleSeparation(margin=self["constraints.gap"]), LineOfSight()]
        return [*always, *(kind(limit) for kind, limit in limits if limit is not None)]

    def model(self, system: PinholeSystem) -> Emission:
        """Return the emission model of `system` with the recipe's ``model.*`` settings."""
        entries = {key: value for key, value in self.given.items() if key.startswith("model.")}
        return recipe_model(Recipe({"model.kind": "emission", "model.hole": "depth", **entries}), system)  # type: ignore[return-value]

    def grid(self, coarse: int = 1) -> Grid:
        """Return the grid of the imaged volumes, with voxels about `coarse` times as large as in the recipe."""
        n = self["imaging.voxels"]
        n_coarse = -(-n // coarse)
        return Grid.centered(n_coarse, self["imaging.spacing"] * n / n_coarse)

    def projector(self, system: PinholeSystem, coarse: int = 1, mu: Volume | None = None) -> Projector:
        """Return the projector of a system, whose images cover the whole crystals, with pixels `coarse` times as large."""
        n = max(2, self["imaging.pixels"] // coarse)
        return Projector(self.grid(coarse), system.views((n, n), "real"), replace(self.model(system), mu=mu))

    def volumes(self, phantom: str, apart: bool = False, coarse: int = 1, quantity: str = "activity") -> list[Array]:
        """Return the voxels of a phantom, named by its file or given as text: the whole, or `apart` each of its shapes."""
        parsed = parse_phantom(phantom, "phantom") if "\n" in phantom else read_phantom(self.folder / phantom)
        phantoms = [ShapePhantom([shape]) for shape in parsed.shapes] if apart else [parsed]
        return [item.voxelize(self.grid(coarse), quantity=quantity).array for item in phantoms]

    def wanted(self, coarse: int = 1) -> list[Any]:
        """Return the objectives as functions of a system, with voxels and pixels `coarse` times as large."""
        return [self._make_objective(goal, goal["kind"], coarse) for goal in self.goals.values()]

    def _make_objective(self, goal: ObjectiveSettings, kind: str, coarse: int) -> Any:
        """Return the objective of these settings as a function of a system."""
        if kind in ("lesion", "regions"):
            bodies = [volume for body in goal["body"] for volume in self.volumes(body, coarse=coarse)]
            make_projector, signals = partial(self.projector, coarse=coarse), self.volumes(goal["parts"], True, coarse)
            return (Lesion if kind == "lesion" else Regions)(make_projector, bodies, signals, goal["worst"])
        start, radius = self.parameters.build(self.parameters.start), goal["radius"]
        points = ball_points(start.region_radius() if radius is None else radius, goal["points"])
        if kind == "sensitivity":
            return Sensitivity(self.model, points, goal["resolution"])
        return Detail(self.model, points, goal["size"], goal["hole"])

    def changed(self, entry: str, value: float) -> "DesignRecipe":
        """Return the recipe with another number in the entry TABLE.NAME, of objectives in all that have it."""
        table_name, _, name = entry.partition(".")
        number = int(value) if float(value).is_integer() else value
        if entry in self.rows:
            return replace(self, given={**self.given, entry: number})
        if table_name == "generator" and name in self.generator:
            return replace(self, generator={**self.generator, name: number})
        if table_name != "objectives" or not any(name in goal for goal in self.objectives):
            raise InputError(f"pareto.entry: expected one of the recipe, such as generator.modules, got {entry!r}")
        return replace(self, objectives=[{**goal, name: number} if name in goal else goal for goal in self.objectives])

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 of all entries that determine the design, and of the contents of the files that they name."""
        # The tables pareto and evaluation do not change the design.
        entries = sorted(entry for entry in self.given.items() if not entry[0].startswith(("pareto.", "evaluation.")))
        image_goals = [goal for goal in self.goals.values() if "parts" in goal.rows]
        # A phantom is given by its text, or by the name of its file.
        phantoms = [phantom for goal in image_goals for phantom in (*goal["body"], goal["parts"])]
        file_names = [name for name in (self.generator.get("file"), *phantoms) if name and "\n" not in name]
        contents = [read_bytes(self.folder / name) for name in file_names]
        content = repr((entries, self.generator, self.free, self.objectives, contents))
        return hashlib.sha256(content.encode()).hexdigest()


def design_recipe(values: Mapping[str, Any], folder: Path = Path()) -> DesignRecipe:
    """Return the recipe of a design from nested tables, as TOML has them; paths in it are relative to `folder`."""
    tables = {name: read_table(values, name) for name in ("generator", "free")}
    check_entries(values, VERSION, ("version", *tables, "objectives", *_TABLES))
    return DesignRecipe(table_entries(values, _ROWS), **tables, objectives=values.get("objectives", []), folder=folder)


def read_design_recipe(path: str | os.PathLike[str]) -> DesignRecipe:
    """Read the recipe of a design from a TOML file; paths in it are relative to its folder.

    `InputError` names the entry that cannot be understood.
    """
    with naming(path):
        return design_recipe(read_toml(path), Path(path).absolute().parent)
