"""The counting law: what share of its decays a place's photons are counted of, through the hole and in the crystal.

Sensitivity, resolution, maps, pixels of projections and cameras in torch all take it from here.

References
----------
D. Paix, "Pinhole imaging of gamma rays", Physics in Medicine and Biology 12 (1967) 489-500.
S. D. Metzler, J. E. Bowsher, M. F. Smith, R. J. Jaszczak, "Analytic determination of pinhole collimator sensitivity
with penetration", IEEE Transactions on Medical Imaging 20 (2001) 730-741.
R. Accorsi, S. D. Metzler, "Analytic determination of the resolution-equivalent effective diameter of a pinhole
collimator", IEEE Transactions on Medical Imaging 23 (2004) 750-763.
"""

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, Self

import numpy as np

from ..arrays import ArrayOrTensor, is_tensor, namespace, promote, require_numbers
from ..errors import InputError
from ..geometry.collimator import OPENING_ANGLE, Collimator, edge_slope
from ..geometry.system import PinholeSystem
from ..validation import freeze, real_array, shape_text, strict_whole
from .aperture import KnifeEdge, Opening, openings, within_cone
from .crystal import absorbed_share, share_inside
from .materials import module_coefficients

Edge = Literal["paix", "path"]

_UNITS = {
    "aperture_mu": "1/mm", "opening_angle": "rad", "crystal_mu": "1/mm", "photons_per_decay": "", "plate_thickness": "mm",
}  # fmt: skip
"""Numbers above 0."""
_NUMBERS = (*_UNITS, "intrinsic_fwhm")


@dataclass(frozen=True, eq=False)
class Optics:
    """Hole, edge, walls, cone, crystal and photons of modules, as keywords of `Emission`, which explains them.

    Numbers are of all modules together, or arrays (M,) with one for each, or tensors of either shape: then all that is
    computed with them is part of their graph.

    Attributes
    ----------
    aperture_mu, crystal_mu
        Attenuation coefficients, 1/mm; None: nothing penetrates the aperture, the crystal stops all photons.
    opening_angle
        Full angle of the knife edge's double cone, rad.
    edge : str
        ``"paix"`` or ``"path"``.
    depth_layers : int
        Depths in the crystal at which photons are recorded.
    plate_thickness
        The aperture plate's, mm, with edge ``"path"``; None: infinite.
    intrinsic_fwhm
        FWHM of the detector's blur, mm on the crystal.
    photons_per_decay
        That are counted.
    within_crystal, within_walls, within_cone : bool
        What stops photons, beside the hole.

    Raises
    ------
    InputError
        Settings do not go together.
    """

    aperture_mu: ArrayOrTensor = None
    opening_angle: ArrayOrTensor = OPENING_ANGLE
    edge: Edge = "paix"
    crystal_mu: ArrayOrTensor = None
    depth_layers: int = 1
    intrinsic_fwhm: ArrayOrTensor = 0.0
    photons_per_decay: ArrayOrTensor = 1.0
    within_crystal: bool = False
    within_walls: bool = False
    within_cone: bool = False
    plate_thickness: ArrayOrTensor = None

    library = np  # whose functions take the numbers, and all that is computed with them: set where values enter

    def __post_init__(self) -> None:
        for name in _NUMBERS:
            object.__setattr__(self, name, _checked(getattr(self, name), name))
        if self.edge not in ("paix", "path"):
            raise InputError(f"edge: expected 'paix' or 'path', got {self.edge!r}")
        if self.edge == "path" and self.aperture_mu is None:
            raise InputError("edge 'path' needs aperture_mu, of the aperture's material")
        if self.plate_thickness is not None and self.edge != "path":
            raise InputError("plate_thickness is of edge 'path'")
        object.__setattr__(self, "depth_layers", strict_whole(self.depth_layers, "depth_layers", "1 or more"))
        if self.depth_layers > 1 and self.crystal_mu is None:
            raise InputError("depth_layers needs crystal_mu, of the crystal's material")
        for name in ("within_crystal", "within_walls", "within_cone"):
            object.__setattr__(self, name, bool(getattr(self, name)))
        object.__setattr__(self, "library", namespace(*self.numbers.values()))

    def __getstate__(self) -> dict[str, Any]:
        """What is pickled and copied: a module cannot be."""
        return {name: value for name, value in self.__dict__.items() if name != "library"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state, library=namespace(*state.values()))

    @classmethod
    def of(cls, system: PinholeSystem, lines: Sequence[tuple[float, float]] = (), **settings: Any) -> Self:
        """The optics of a system's modules for photons of these `lines`: energies, keV, and numbers per decay.

        `settings` are the attributes, but coefficients may be names of materials (`module_coefficients`), and without
        `photons_per_decay` all photons of the lines are counted; of no lines, one per decay.
        """
        names = "aperture_mu", "crystal_mu"
        angle = _checked(settings.get("opening_angle", OPENING_ANGLE), "opening_angle")
        aperture, crystal = map(settings.get, names)
        coefficients = module_coefficients(aperture, crystal, lines, system, angle)
        if settings.get("photons_per_decay") is None:
            settings["photons_per_decay"] = sum(photons for _, photons in lines) if lines else 1.0
        return cls(**{**settings, **dict(zip(names, coefficients, strict=True))}).of_modules(slice(None), len(system))

    @property
    def numbers(self) -> dict[str, ArrayOrTensor]:
        """The attributes that are numbers, by name, without those that are None."""
        return {name: getattr(self, name) for name in _NUMBERS if getattr(self, name) is not None}

    def with_numbers(self, numbers: Mapping[str, ArrayOrTensor]) -> Self:
        """The same with other numbers, which are not checked."""
        changed = copy.copy(self)
        changed.__dict__.update(numbers, library=namespace(*{**self.numbers, **numbers}.values()))
        return changed

    def promoted(self, *values: ArrayOrTensor) -> tuple[Any, ...]:
        """The optics and `values`, their numbers as tensors of one type and device if any is a tensor."""
        own = {name: value for name, value in self.numbers.items() if not isinstance(value, float)}
        promoted = promote(*values, *own.values())
        optics = self.with_numbers(dict(zip(own, promoted[len(values) :], strict=True)))
        optics.__dict__["library"] = namespace(*promoted)
        return optics, *promoted[: len(values)]

    def of_modules(self, which: Any, n: int) -> Self:
        """The optics of the modules `which` (an index, indices or a slice) of `n`; `InputError` if they are not of `n`."""
        arrays = {name: value for name, value in self.numbers.items() if np.ndim(value)}
        for name, value in arrays.items():
            if value.shape != (n,):
                got = shape_text(value.shape)
                raise InputError(f"{name}: expected one number, or one for each of {n} modules, got {got}")
        return self.with_numbers({name: value[which] for name, value in arrays.items()})

    @property
    def tangent(self) -> ArrayOrTensor:
        """``tan(alpha / 2)`` of the knife edge's cone."""
        angle = self.opening_angle
        return edge_slope(angle) if isinstance(angle, float) else self.library.tan(angle / 2)

    def effective_diameter(self, diameter: ArrayOrTensor) -> ArrayOrTensor:
        """d_e, mm, of holes of a diameter d, mm: opaque holes that let as many photons pass along the axis.

        ``d_e^2 = d (d + 2 / mu tan(alpha / 2))`` (Paix); with edge ``"path"`` it is ``2 / mu^2 tan^2(alpha / 2)`` more.
        """
        if self.aperture_mu is None:
            return diameter
        depth = 2 / self.aperture_mu * self.tangent
        squared = diameter * (diameter + depth) + (depth**2 / 2 if self.edge == "path" else 0.0)
        return squared**0.5

    def half_value_diameter(self, diameter: ArrayOrTensor) -> ArrayOrTensor:
        """Diameter ``d + ln(2) / mu tan(alpha / 2)``, mm, at which a knife edge transmits half of the axial photons.

        At radius r the edge is ``2 (r - d / 2) / tan(alpha / 2)`` thick. So this is the full width at half maximum of the
        hole's shadow: Accorsi and Metzler's resolution-equivalent diameter.
        """
        return diameter if self.aperture_mu is None else diameter + math.log(2) / self.aperture_mu * self.tangent

    def openings(self, diameter: ArrayOrTensor, n: int = 1) -> list[Opening]:
        """Where photons cross the plane of a hole of a diameter, mm: n points of the hole, and those of its edge."""
        if self.edge == "paix":
            return openings(n, self.effective_diameter(diameter))
        return openings(n, diameter, self.knife(diameter))

    def through_plate(self, built: Collimator) -> float:
        """Photons that pass the solid plate beside a module's hole, by those through the hole, along the axis; at most."""
        if self.plate_thickness is None:
            return 0.0
        widest = max(radius for _, radius in built.hole_profile)
        beside = (2 * built.front_half_width) ** 2 - math.pi * widest**2
        hole = math.pi / 4 * self.effective_diameter(built.diameter) ** 2
        return float(math.exp(-self.aperture_mu * self.plate_thickness) * beside / hole)

    def knife(self, diameter: ArrayOrTensor) -> KnifeEdge:
        """The knife edge of a hole of a diameter, mm."""
        return KnifeEdge(diameter / 2, self.aperture_mu, self.tangent, self.plate_thickness)

    def depths(self, thickness: ArrayOrTensor) -> list[ArrayOrTensor]:
        """Depths in a crystal, mm, at which photons are recorded, from its front to its back."""
        return [thickness * (layer / max(1, self.depth_layers - 1)) for layer in range(self.depth_layers)]

    def counted(
        self,
        slope_u: ArrayOrTensor,
        slope_v: ArrayOrTensor,
        opening: Opening,
        thickness: ArrayOrTensor,
        layer: int = 0,
    ) -> tuple[ArrayOrTensor, ArrayOrTensor]:
        """The law: what of a decay's photons pass one point of the hole and are recorded in one layer, and their cosine.

        It is in mm^2: a square millimetre that lies across the axis, `distance` mm behind the hole, records
        ``counted / distance^2`` photons of a decay that is spread over a mm of line. With the hole's area pi d^2 / 4 it is
        ``photons_per_decay d^2 cos^4(psi) / 16``, psi being the angle to the axis, times what cone and crystal leave.

        Parameters
        ----------
        slope_u, slope_v
            Slopes of the photons' lines, mm along u and v per mm along the axis.
        opening
            The point.
        thickness
            The crystal's, mm.
        layer
            Which of `depths`.
        """
        squared_secant = 1 + slope_u**2 + slope_v**2
        cosine = 1 / squared_secant**0.5
        squared = cosine * cosine  # many times faster than a power
        area, depths = opening.area(slope_u, slope_v, self.library), self.depths(thickness)
        counted = self.photons_per_decay / (4 * math.pi) * (squared * squared) * area
        if self.crystal_mu is not None:
            counted = counted * absorbed_share(cosine, self.crystal_mu, thickness, depths, layer, self.library)
        if self.within_cone:
            counted = counted * within_cone(slope_u, slope_v, self.tangent, self.library)
        return counted, cosine

    def pixel_weights(
        self,
        along: Sequence[ArrayOrTensor],
        pitch: tuple[ArrayOrTensor, ArrayOrTensor],
        length: ArrayOrTensor,
        side: ArrayOrTensor,
        thickness: ArrayOrTensor,
        opening: Opening,
        layer: int = 0,
        cells: int = 1,
    ) -> ArrayOrTensor:
        """What pixels count per (decay / mm^3 mm) along rays that start from one point of the hole.

        Parameters
        ----------
        along
            Where in the pixels the rays end on the crystal along u and v, mm from its middle and point-inverted.
        pitch
            The pixels' size on the crystal, mm along u and v.
        length, side, thickness
            Collimator length l, and the crystal's side and thickness, mm.
        opening, layer
            The same as in `counted`.
        cells
            Rays of a pixel: along each side, a ray stands for this part of it where the crystal or a wall ends.
        """
        distance = length + self.depths(thickness)[layer]
        starts = opening.x, opening.y
        slope_u, slope_v = ((place + start) / distance for place, start in zip(along, starts, strict=True))
        counted, _ = self.counted(slope_u, slope_v, opening, thickness, layer)
        weights = counted * (pitch[0] * pitch[1] / distance**2)
        for place, size, start in zip(along, pitch, starts, strict=True):
            if self.within_crystal:
                weights = weights * share_inside(place, size / cells, side)
            if self.within_walls:
                shrink = length / distance  # back to where the rays cross the crystal's front
                weights = weights * share_inside(shrink * place - (1 - shrink) * start, shrink * size / cells, side)
        return weights


def _checked(value: Any, name: str) -> Any:
    """A number as a float, numbers as an array or tensor, None as it is; `InputError` where they are out of range."""
    if value is None and name in ("aperture_mu", "crystal_mu", "plate_thickness"):
        return None
    if is_tensor(value):
        require_numbers(value, name)
    numbers = real_array(value.detach().cpu().numpy() if is_tensor(value) else value, name, None)
    low = numbers.min(initial=np.inf)
    if low < 0 or (low == 0 and name in _UNITS):
        expected = f"more than 0 {_UNITS[name]}".rstrip() if name in _UNITS else "0 mm or more"
        raise InputError(f"{name}: expected {expected}, got {low:g}")
    if name == "opening_angle" and numbers.max(initial=0.0) >= math.pi:
        raise InputError(f"{name}: expected less than pi, got {numbers.max():g} rad")
    if is_tensor(value):
        return value
    return freeze(numbers) if numbers.ndim else float(numbers)


IDEAL = Optics()
"""Nothing penetrates, all photons that pass the hole are counted, one of each decay."""


def chosen_optics(optics: Optics | None, settings: Mapping[str, Any]) -> Optics:
    """`optics` with some attributes changed; without any, ideal ones."""
    return replace(optics or IDEAL, **settings) if settings else optics or IDEAL
