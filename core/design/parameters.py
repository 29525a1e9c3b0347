"""Free parameters of a design within limits: arguments of the generator that makes its scanner."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from inspect import signature
from typing import Any

import numpy as np

from ..arrays import Floats
from ..errors import InputError, naming
from ..geometry.design_formulas import collimator_length as designed_length
from ..geometry.generators import ellipse_rings, plate_rings, regular_polygon
from ..geometry.system import PinholeSystem
from ..validation import one_of, real_array
from .numbers import module_rows

_STEP = 1e-5  # step of central differences, as a fraction of the range between a parameter's limits


@dataclass(frozen=True, eq=False)
class FreeParameters:
    """K free parameters of a design, in the units of the recipe."""

    names: tuple[str, ...]
    """Names of the parameters, such as "z 1"."""
    start: Floats
    """Values (K,) at the start."""
    low: Floats
    """Lower limits (K,)."""
    high: Floats
    """Upper limits (K,)."""
    build: Callable[[Floats], PinholeSystem]
    """Function that makes the scanner of values (K,); raises `InputError` where there is no such scanner."""

    def __post_init__(self) -> None:
        for name, start, low, high in zip(self.names, self.start, self.low, self.high, strict=True):
            if not low < high or not low <= start <= high:
                raise InputError(f"free.{name}: expected two rising limits around {start:g}, got {low:g} and {high:g}")

    def jacobian(self, values: Floats) -> Floats:
        """Return the derivatives (M, 15, K) of the modules' rows by the free parameters, at `values` (K,).

        Generators are cheap and smooth, so that central differences in float64, of any generator, are exact to 1e-9.
        """
        shifts = np.diag(_STEP * (self.high - self.low))
        pairs = [(module_rows(self.build(values + s)), module_rows(self.build(values - s))) for s in shifts]
        return np.stack([(high - low) / (2 * s.sum()) for (high, low), s in zip(pairs, shifts, strict=True)], axis=2)


def polygon_rings(modules: Any, sides: int, apothem: float, z: Any, *, rotation: float = 0.0, **sizes: Any) -> Any:
    """Return `plate_rings` on a regular polygon, its plates `apothem` mm from the isocentre, the first at `rotation` rad."""
    return plate_rings(modules, regular_polygon(sides, apothem, rotation), z, **sizes)


def moved_modules(
    system: PinholeSystem, group: Any, length: str,
    radial: Any, along: Any, z: Any, tilt: Any, diameter: Any, longer: Any,
) -> PinholeSystem:  # fmt: skip
    """Return a system with its modules displaced, tilted, and with other holes and lengths.

    `group` (M,) is the number of each module's group, from 0. The other arguments are those of `displacement_parameters`,
    one number for each group.
    """
    n, per_group = group.max() + 1, (radial, along, z, diameter, longer)
    radial, along, z, diameter, longer = (np.broadcast_to(numbers, n)[group] for numbers in per_group)
    angle = np.arctan2(system.centers[:, 1], system.centers[:, 0])
    x, y = radial * np.cos(angle) - along * np.sin(angle), radial * np.sin(angle) + along * np.cos(angle)
    centers, d = system.centers + np.column_stack([x, y, z]), system.pinhole_diameter * diameter
    l = system.collimator_length * longer
    if length == "formula":
        l = designed_length(np.linalg.norm(centers, axis=1), d, system.detector_side, system.roi_radius)
    tilt = system.tilt + np.broadcast_to(tilt, (n, 3))[group]
    return replace(system, centers=centers, tilt=tilt, pinhole_diameter=d, collimator_length=l, source=None)


def displacement_parameters(
    system: PinholeSystem, by: str = "module", length: str = "own", **overrides: Any
) -> dict[str, Any]:
    """Return arguments of `moved_modules` that leave the modules of a system as they are, updated by `overrides`.

    Each ``"module"``, each ``"ring"``, or the whole ``"scanner"`` (`by`) has its own numbers. Pinholes move by `radial`,
    `along` and `z`, mm: away from the z axis, around it, and along it. `tilt` (n, 3) is added to the rotation vector about
    u, v and k, rad; `diameter` and `longer` are factors of d and l. With `length` ``"formula"``, l follows the design
    formula instead.
    """
    one_of(length, ("own", "formula"), "generator.length")
    groups = {"module": np.arange(len(system)), "ring": system.rings(), "scanner": np.zeros(len(system), np.int64)}
    one_of(by, groups, "generator.by")
    n = int(groups[by].max()) + 1
    shifts = {name: np.zeros(n) for name in ("radial", "along", "z")}
    neutral = {**shifts, "tilt": np.zeros((n, 3)), "diameter": np.ones(n), "longer": np.ones(n)}
    return {"system": system, "group": groups[by], "length": length, **neutral, **overrides}


GENERATORS: Mapping[str, Callable[..., PinholeSystem]] = {
    "ellipse": ellipse_rings,
    "polygon": polygon_rings,
    "workbook": moved_modules,
}
"""Functions that make a scanner from numbers, by their names in recipes."""
_DERIVED = {"sizes", "vertices", "system", "group", "overrides"}  # arguments that follow from others
# Arguments that are angles: degrees in recipes, rad in the generators.
_DEGREES = ("start", "end", "rotation", "tilt")


def check_generator(generator: Mapping[str, Any], free: Mapping[str, Any]) -> None:
    """Raise `InputError` for entries of a recipe's tables ``[generator]`` and ``[free]`` that its kind does not have."""
    kind = generator.get("kind", "ellipse")
    one_of(kind, GENERATORS, "generator.kind")
    functions: Mapping[str, Callable[..., Any]] = {"polygon": plate_rings, "workbook": displacement_parameters}
    inner = functions.get(kind, ellipse_rings)
    names = ["kind", *signature(GENERATORS[kind]).parameters, *signature(inner).parameters]
    names += ["file", "modules"] if kind == "workbook" else []
    expected = [name for name in dict.fromkeys(names) if name not in _DERIVED]
    for table, entries in (("generator", generator), ("free", free)):
        for name in entries:
            if name not in expected:
                raise InputError(f"{table}.{name}: no such entry; {kind} has {', '.join(expected)}")


def free_parameters(kind: str, fixed: Mapping[str, Any], free: Mapping[str, Any]) -> FreeParameters:
    """Return the free parameters of a generator of `GENERATORS`.

    `fixed` has the generator's arguments by name, angles in degrees; free ones start at their value there. `free` has the
    limits by the argument's name: two numbers for all numbers of the argument, or two for each of them.
    """
    one_of(kind, GENERATORS, "generator.kind")
    names, starts, limits = list[str](), dict[str, Floats](), list[Floats]()
    for name, pair in free.items():
        if name not in fixed:
            raise InputError(f"free.{name}: expected generator.{name}, at which it starts")
        starts[name] = start = real_array(fixed[name], f"generator.{name}", None)
        pairs = real_array(pair, f"free.{name}", None)
        if pairs.shape not in ((2,), (*start.shape, 2)):
            raise InputError(f"free.{name}: expected two limits, or two for each of its {start.size} numbers")
        names += [f"{name} {i + 1}" for i in range(start.size)] if start.ndim else [name]
        limits.append(np.broadcast_to(pairs, (*start.shape, 2)).reshape(-1, 2))
    if not names:
        raise InputError("free: expected the limits of one number or more")

    def build(values: Floats) -> PinholeSystem:
        """Make the scanner of the free parameters' `values` (K,)."""
        ends = np.cumsum([start.size for start in starts.values()])
        pieces = zip(starts.items(), np.split(values, ends[:-1]), strict=True)
        arguments = {**fixed, **{name: piece.reshape(start.shape) for (name, start), piece in pieces}}
        with naming("generator"):
            angles = {name: real_array(arguments[name], name, None) for name in _DEGREES if name in arguments}
            arguments |= {name: np.radians(angle) for name, angle in angles.items()}
            try:
                return GENERATORS[kind](**arguments)
            except TypeError as error:  # an argument is missing: Python names it
                raise InputError(str(error).partition("() ")[2]) from None

    low, high = np.concatenate(limits).T
    return FreeParameters(tuple(names), np.concatenate([start.ravel() for start in starts.values()]), low, high, build)
