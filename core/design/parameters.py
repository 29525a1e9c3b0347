"""The free numbers of a design, within limits: arguments of what makes its scanner."""

import inspect
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
    by: str = "module",
    length: str = "own",
    radial: Any = 0.0,
    along: Any = 0.0,
    z: Any = 0.0,
    tilt: Any = (0.0, 0.0, 0.0),
    diameter: Any = 1.0,
    lengthening: Any = 1.0,
) -> PinholeSystem:
    """The modules of a system, moved, tilted and with other holes and lengths.

    Parameters
    ----------
    system
        The modules.
    by
        What has numbers of its own: each ``"module"``, each ``"ring"``, or the ``"scanner"`` as a whole.
    length
        ``"own"``, or ``"formula"``: l follows the design formula.
    radial, along, z
        mm by which pinholes move away from the z axis, around it, and along it: one number, or one for each of those.
    tilt
        Change of the rotation vector about u, v and k, rad: (3,), or (…, 3).
    diameter, lengthening
        Factors of d and of l.
    """
    n, group = _groups(system, by)
    given = (("radial", radial), ("along", along), ("z", z), ("diameter", diameter), ("lengthening", lengthening))
    out, around, up, wider, longer = (np.broadcast_to(real_array(x, name, None), n)[group] for name, x in given)
    angle = np.arctan2(system.centers[:, 1], system.centers[:, 0])
    x, y = out * np.cos(angle) - around * np.sin(angle), out * np.sin(angle) + around * np.cos(angle)
    centers, d = system.centers + np.column_stack([x, y, up]), system.pinhole_diameter * wider
    l = system.collimator_length * longer
    if length == "formula":
        l = designed_length(np.linalg.norm(centers, axis=1), d, system.detector_side, system.roi_radius)
    turned = system.tilt + np.broadcast_to(real_array(tilt, "tilt", None), (n, 3))[group]
    return replace(system, centers=centers, tilt=turned, pinhole_diameter=d, collimator_length=l, source=None)


def _groups(system: PinholeSystem, by: str) -> tuple[int, Any]:
    """How many things have numbers of their own, and which of them each module (M,) belongs to."""
    group = {"module": np.arange(len(system)), "ring": system.rings(), "scanner": np.zeros(len(system), np.int64)}
    one_of(by, group, "generator.by")
    return int(group[by].max()) + 1, group[by]


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
    own, start = inspect.signature(GENERATORS[kind]).parameters, dict(given)
    known = {**inspect.signature(plate_rings).parameters, **own} if kind == "polygon" else own
    for name in given:
        if name not in known:
            raise InputError(f"generator.{name}: {kind} has no such argument; expected {', '.join(known)}")
    limits, names = [np.empty((0, 2))], list[str]()
    for name, two in free.items():
        if kind == "workbook" and name in own and name not in ("system", "by", "length"):
            n, _ = _groups(start["system"], start.get("by", "module"))
            whole = start.get(name, own[name].default)
            start[name] = np.broadcast_to(whole, (n, 3) if name == "tilt" else n)
        if name not in start:
            raise InputError(f"free.{name}: expected generator.{name}, at which it starts")
        values, own_limits = real_array(start[name], f"generator.{name}", None), real_array(two, f"free.{name}", None)
        if own_limits.shape not in ((2,), (*values.shape, 2)):
            raise InputError(f"free.{name}: expected two limits, or two for each of its {values.size} numbers")
        start[name] = values
        names += [f"{name} {i + 1}" for i in range(values.size)] if values.size > 1 else [name]
        limits.append(np.broadcast_to(own_limits, (*values.shape, 2)).reshape(-1, 2))
    low, high = np.concatenate(limits).T
    if not names:
        raise InputError("free: expected the limits of one number or more")

    def build(values: Floats) -> PinholeSystem:
        made, ends = dict(start), np.cumsum([np.size(start[name]) for name in free])
        for name, part in zip(free, np.split(values, ends[:-1]), strict=True):
            made[name] = part.reshape(np.shape(start[name]))
        made |= {name: np.radians(made[name]) for name in _DEGREES if name in made}
        with naming("generator"):
            try:
                return GENERATORS[kind](**made)
            except TypeError as error:  # an argument is missing, which Python names
                raise InputError(str(error).partition("() ")[2]) from None

    return Parameters(tuple(names), np.concatenate([np.ravel(start[name]) for name in free]), low, high, build)
