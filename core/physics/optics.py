"""Pinhole sensitivity law: the fraction of decays at a point that are detected, through hole, edge, septa and crystal.

Sensitivity, resolution, maps, pixels of projections and cameras in torch all take the law from here.

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
"""Units of the attributes that are numbers above 0."""
_NUMBERS = (*_UNITS, "intrinsic_fwhm")


@dataclass(frozen=True, eq=False)
class Optics:
    """Properties of modules that decide how many photons they detect: hole, edge, walls, cone, crystal and photons.

    The attributes are keywords of `Emission`, which explains them. A number holds for all modules, or is an array (M,) with
    one number for each, or a tensor of either shape, whose graph then contains all results.

    Attributes
    ----------
    aperture_mu, crystal_mu
        Attenuation coefficients, 1/mm. None: no photon penetrates the aperture, the crystal stops all photons.
    opening_angle
        Full angle alpha of the knife edge's double cone, rad.
    edge : str
        Model of the edge: ``"paix"``, a larger effective diameter, or ``"path"``, attenuation along each path.
    depth_layers : int
        Number of depths in the crystal at which photons are recorded.
    plate_thickness
        Thickness of the aperture plate, mm, with edge ``"path"``. None: infinite.
    intrinsic_fwhm
        FWHM of the detector's blur, mm on the crystal.
    photons_per_decay
        Number of photons per decay that are counted.
    within_crystal, within_walls, within_cone : bool
        Whether photons are lost outside the crystal's side, the collimator's walls, or the cone of the knife edge.

    Raises
    ------
    InputError
        If settings do not go together.
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

    library = np  # NumPy or torch, whose functions take the numbers; set again when numbers are set

    def __post_init__(self) -> None:
        for name in _NUMBERS:
            object.__setattr__(self, name, _check_number(getattr(self, name), name))
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
        """Return the attributes that are pickled and copied: all but `library`, since a Python module cannot be pickled."""
        return {name: value for name, value in self.__dict__.items() if name != "library"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore pickled attributes, and `library`."""
        self.__dict__.update(state, library=namespace(*state.values()))

    @classmethod
    def of(cls, system: PinholeSystem, lines: Sequence[tuple[float, float]] = (), **settings: Any) -> Self:
        """Return the optics of a system's modules for photons of these `lines`: energies, keV, and numbers per decay.

        `settings` are attributes, but the attenuation coefficients may be names of materials (`module_coefficients`). The
        default of `photons_per_decay` is the number of all photons of the lines; without lines, one per decay.
        """
        names = "aperture_mu", "crystal_mu"
        angle = _check_number(settings.get("opening_angle", OPENING_ANGLE), "opening_angle")
        aperture, crystal = map(settings.get, names)
        coefficients = module_coefficients(aperture, crystal, lines, system, angle)
        if settings.get("photons_per_decay") is None:
            settings["photons_per_decay"] = sum(photons for _, photons in lines) if lines else 1.0
        return cls(**{**settings, **dict(zip(names, coefficients, strict=True))}).of_modules(slice(None), len(system))

    @property
    def numbers(self) -> dict[str, ArrayOrTensor]:
        """Attributes that are numbers, by name, without those that are None."""
        return {name: getattr(self, name) for name in _NUMBERS if getattr(self, name) is not None}

    def with_numbers(self, numbers: Mapping[str, ArrayOrTensor]) -> Self:
        """Return a copy with other `numbers`, by attribute, which are not checked."""
        changed = copy.copy(self)
        changed.__dict__.update(numbers, library=namespace(*{**self.numbers, **numbers}.values()))
        return changed

    def promoted(self, *values: ArrayOrTensor) -> tuple[Any, ...]:
        """Return the optics and the `values`, all as tensors of one type and device if any is a tensor."""
        arrays = {name: value for name, value in self.numbers.items() if not isinstance(value, float)}
        promoted = promote(*values, *arrays.values())
        optics = self.with_numbers(dict(zip(arrays, promoted[len(values) :], strict=True)))
        optics.__dict__["library"] = namespace(*promoted)
        return optics, *promoted[: len(values)]

    def of_modules(self, which: Any, n: int) -> Self:
        """Return the optics of the modules `which` (an index, indices or a slice) of `n`.

        Raises `InputError` if an attribute has numbers for another number of modules.
        """
        arrays = {name: value for name, value in self.numbers.items() if np.ndim(value)}
        for name, value in arrays.items():
            if value.shape != (n,):
                got = shape_text(value.shape)
                raise InputError(f"{name}: expected one number, or one for each of {n} modules, got {got}")
        return self.with_numbers({name: value[which] for name, value in arrays.items()})

    @property
    def tangent(self) -> ArrayOrTensor:
        """Slope ``tan(alpha / 2)`` of the knife edge's cone."""
        angle = self.opening_angle
        return edge_slope(angle) if isinstance(angle, float) else self.library.tan(angle / 2)

    def effective_diameter(self, diameter: ArrayOrTensor) -> ArrayOrTensor:
        """Return the effective diameter d_e, mm, of holes of diameter d, mm.

        An opaque hole of this diameter lets as many photons pass along the axis. It is ``d_e^2 = d (d + 2 / mu tan(alpha /
        2))`` (Paix); with edge ``"path"`` there is a further term ``2 / mu^2 tan^2(alpha / 2)``.
        """
        if self.aperture_mu is None:
            return diameter
        widening = 2 / self.aperture_mu * self.tangent
        squared = diameter * (diameter + widening) + (widening**2 / 2 if self.edge == "path" else 0.0)
        return squared**0.5

    def half_value_diameter(self, diameter: ArrayOrTensor) -> ArrayOrTensor:
        """Return the diameter, mm, at which a knife edge transmits half of the axial photons.

        It is ``d + ln(2) / mu tan(alpha / 2)``. At radius r the edge is ``2 (r - d / 2) / tan(alpha / 2)`` thick. So this is
        the full width at half maximum of the hole's shadow: Accorsi and Metzler's resolution-equivalent diameter.
        """
        return diameter if self.aperture_mu is None else diameter + math.log(2) / self.aperture_mu * self.tangent

    def openings(self, diameter: ArrayOrTensor, n: int = 1) -> list[Opening]:
        """Return the openings that represent a hole of this `diameter`, mm: `n` points in it, and points in its edge."""
        if self.edge == "paix":
            return openings(n, self.effective_diameter(diameter))
        return openings(n, diameter, self.knife(diameter))

    def through_plate(self, built: Collimator) -> float:
        """Return the ratio of axial photons that pass the solid plate beside the hole to those through the hole, at most.

        `built` is the module's collimator.
        """
        if self.plate_thickness is None:
            return 0.0
        widest = max(radius for _, radius in built.hole_profile)
        plate_area = (2 * built.front_half_width) ** 2 - math.pi * widest**2
        hole_area = math.pi / 4 * self.effective_diameter(built.diameter) ** 2
        return float(math.exp(-self.aperture_mu * self.plate_thickness) * plate_area / hole_area)

    def knife(self, diameter: ArrayOrTensor) -> KnifeEdge:
        """Return the knife edge of a hole of this `diameter`, mm."""
        return KnifeEdge(diameter / 2, self.aperture_mu, self.tangent, self.plate_thickness)

    def depths(self, thickness: ArrayOrTensor) -> list[ArrayOrTensor]:
        """Return the depths in a crystal of this `thickness`, mm, at which photons are recorded, from front to back."""
        return [thickness * (layer / max(1, self.depth_layers - 1)) for layer in range(self.depth_layers)]

    def counted(
        self, slope_u: ArrayOrTensor, slope_v: ArrayOrTensor, opening: Opening, thickness: ArrayOrTensor, layer: int = 0
    ) -> tuple[ArrayOrTensor, ArrayOrTensor]:
        """Return the sensitivity law for one opening and one depth layer, mm^2, and the cosine of the angle to the axis.

        The law's value c is defined by its use: a square millimetre normal to the axis, at the distance D behind the hole,
        records ``c / D^2`` photons of a line source with one decay per mm. For the hole's area pi d^2 / 4 it is
        ``photons_per_decay d^2 cos^4(psi) / 16``, with the angle psi to the axis, times the fractions of the photons that
        pass the cone and are stopped by the crystal.

        Parameters
        ----------
        slope_u, slope_v
            Slopes of the photons' paths, mm along u and v per mm along the axis.
        opening
            Point of the hole, with the area that it represents.
        thickness
            Thickness of the crystal, mm.
        layer
            Index of the depth layer in `depths`.
        """
        squared_secant = 1 + slope_u**2 + slope_v**2
        cosine = 1 / squared_secant**0.5
        squared_cosine = cosine * cosine  # many times faster than a power
        area, depths = opening.area(slope_u, slope_v, self.library), self.depths(thickness)
        counted = self.photons_per_decay / (4 * math.pi) * (squared_cosine * squared_cosine) * area
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
        """Return each pixel's weight for rays through one opening: expected counts per unit line integral.

        The unit of the line integral is decays / mm^3 x mm.

        Parameters
        ----------
        along
            Positions along u and v at which the rays end on the crystal, mm from its middle and point-inverted.
        pitch
            Size of the pixels on the crystal, mm along u and v.
        length, side, thickness
            Collimator length l, and the crystal's side and thickness, mm.
        opening, layer
            Point of the hole and index of the depth layer, as in `counted`.
        cells
            Number of rays along each side of a pixel. A ray represents 1 / `cells` of the side where the crystal or a wall
            cuts the pixel.
        """
        distance = length + self.depths(thickness)[layer]
        starts = opening.x, opening.y
        slope_u, slope_v = ((end + start) / distance for end, start in zip(along, starts, strict=True))
        counted, _ = self.counted(slope_u, slope_v, opening, thickness, layer)
        weights = counted * (pitch[0] * pitch[1] / distance**2)
        for end, size, start in zip(along, pitch, starts, strict=True):
            if self.within_crystal:
                weights = weights * share_inside(end, size / cells, side)
            if self.within_walls:
                shrink = length / distance  # scales a position at the layer's depth back to the crystal's front
                weights = weights * share_inside(shrink * end - (1 - shrink) * start, shrink * size / cells, side)
        return weights


def _check_number(value: Any, name: str) -> Any:
    """Return the attribute `name` as a float, an array or a tensor; None stays None where it is allowed.

    Raises `InputError` if a number is out of range.
    """
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
"""Optics without penetration that count all photons that pass the hole, one per decay."""


def chosen_optics(optics: Optics | None, settings: Mapping[str, Any]) -> Optics:
    """Return `optics`, by default ideal ones, with the attributes in `settings` changed."""
    return replace(optics or IDEAL, **settings) if settings else optics or IDEAL
