"""The free numbers of a design, within limits: arguments of what makes its scanner."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..arrays import Floats
from ..errors import InputError, naming
from ..geometry.design_formulas import collimator_length as designed_length
from ..geometry.generators import ellipse_rings, plate_rings, regular_polygon
from ..geometry.system import PinholeSystem
from ..validation import one_of, real_array
from .numbers import rows_of

_STEP = 1e-5  # of central differences, as a share of what a number may change by


@dataclass(frozen=True, eq=False)
class Parameters:
    """K free numbers: names, start and limits (K,), in the units of the recipe, and the scanner that they make."""

    names: tuple[str, ...]
    start: Floats
    low: Floats
    high: Floats
    build: Callable[[Floats], PinholeSystem]

    def __post_init__(self) -> None:
        for name, start, low, high in zip(self.names, self.start, self.low, self.high, strict=True):
            if not low < high or not low <= start <= high:
                raise InputError(f"free.{name}: expected two rising limits around {start:g}, got {low:g} and {high:g}")

    def jacobian(self, values: Floats) -> Floats:
        """Derivatives (M, 15, K) of the modules' numbers by the free ones.

        By central differences in double, of any generator: they are cheap and smooth, so that 1e-9 is exact enough.
        """
        shifts = np.diag(_STEP * (self.high - self.low))
        found = [(rows_of(self.build(values + s)) - rows_of(self.build(values - s))) / (2 * s.sum()) for s in shifts]
        return np.stack(found, axis=2)


def polygon_rings(modules: Any, sides: int, apothem: float, z: Any, *, rotation: float = 0.0, **sizes: Any) -> Any:
    """`plate_rings` of a regular polygon, its plates `apothem` mm from the isocentre, the first at `rotation`, rad."""
    return plate_rings(modules, regular_polygon(sides, apothem, rotation), z, **sizes)


def moved_modules(
    system: PinholeSystem,
    group: Any,
    length: str,
    radial: Any,
    along: Any,
    z: Any,
    tilt: Any,
    diameter: Any,
    longer: Any,
) -> PinholeSystem:
    """The modules of a system, moved, tilted and with other holes and lengths: see `workbook`."""
    n, numbers = group.max() + 1, (radial, along, z, diameter, longer)
    out, around, up, wider, lengthened = (np.broadcast_to(each, n)[group] for each in numbers)
    angle = np.arctan2(system.centers[:, 1], system.centers[:, 0])
    x, y = out * np.cos(angle) - around * np.sin(angle), out * np.sin(angle) + around * np.cos(angle)
    centers, d = system.centers + np.column_stack([x, y, up]), system.pinhole_diameter * wider
    l = system.collimator_length * lengthened
    if length == "formula":
        l = designed_length(np.linalg.norm(centers, axis=1), d, system.detector_side, system.roi_radius)
    turned = system.tilt + np.broadcast_to(tilt, (n, 3))[group]
    return replace(system, centers=centers, tilt=turned, pinhole_diameter=d, collimator_length=l, source=None)


def workbook(system: PinholeSystem, by: str = "module", length: str = "own", **given: Any) -> dict[str, Any]:
    """Arguments of `moved_modules`, at which the modules of a system are as they are.

    Each ``"module"``, each ``"ring"``, or the ``"scanner"`` as a whole (`by`) has its own. Pinholes move by `radial`,
    `along` and `z` mm: away from the z axis, around it, and along it. `tilt` is the change of the rotation vector about u, v
    and k; `diameter` and `longer` are factors of d and of l. With `length` ``"formula"`` l follows the design formula.
    """
    one_of(length, ("own", "formula"), "generator.length")
    groups = {"module": np.arange(len(system)), "ring": system.rings(), "scanner": np.zeros(len(system), np.int64)}
    one_of(by, groups, "generator.by")
    n = int(groups[by].max()) + 1
    still = {name: np.zeros(n) for name in ("radial", "along", "z")}
    same = {"tilt": np.zeros((n, 3)), "diameter": np.ones(n), "longer": np.ones(n)}
    return {"system": system, "group": groups[by], "length": length, **still, **same, **given}


GENERATORS: Mapping[str, Callable[..., PinholeSystem]] = {
    "ellipse": ellipse_rings,
    "polygon": polygon_rings,
    "workbook": moved_modules,
}
"""What makes a scanner of numbers, by its word in recipes."""
_DEGREES = ("start", "end", "rotation", "tilt")


def parameters(kind: str, given: Mapping[str, Any], free: Mapping[str, Any]) -> Parameters:
    """Free numbers of a generator with the arguments `given`, angles in degrees.

    `free` has the limits by an argument's name: two numbers for all of its numbers, or two for each of them.
    """
    one_of(kind, GENERATORS, "generator.kind")
    names, starts, limits = list[str](), dict[str, Floats](), list[Floats]()
    for name, two in free.items():
        if name not in given:
            raise InputError(f"free.{name}: expected generator.{name}, at which it starts")
        starts[name] = start = real_array(given[name], f"generator.{name}", None)
        own = real_array(two, f"free.{name}", None)
        if own.shape not in ((2,), (*start.shape, 2)):
            raise InputError(f"free.{name}: expected two limits, or two for each of its {start.size} numbers")
        names += [f"{name} {i + 1}" for i in range(start.size)] if start.ndim else [name]
        limits.append(np.broadcast_to(own, (*start.shape, 2)).reshape(-1, 2))
    if not names:
        raise InputError("free: expected the limits of one number or more")

    def build(values: Floats) -> PinholeSystem:
        ends = np.cumsum([start.size for start in starts.values()])
        parts = zip(starts.items(), np.split(values, ends[:-1]), strict=True)
        made = {**given, **{name: part.reshape(start.shape) for (name, start), part in parts}}
        made |= {name: np.radians(made[name]) for name in _DEGREES if name in made}
        with naming("generator"):
            try:
                return GENERATORS[kind](**made)
            except TypeError as error:  # an argument is missing, or unknown: Python names it
                raise InputError(str(error).partition("() ")[2]) from None

    low, high = np.concatenate(limits).T
    return Parameters(tuple(names), np.concatenate([start.ravel() for start in starts.values()]), low, high, build)
