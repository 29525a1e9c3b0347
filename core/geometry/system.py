"""Systems of pinhole modules with their common isocentre."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array, ArrayLike, Floats, Integers
from ..errors import InputError, expecting, naming, warn
from ..system_source import SystemSource
from ..validation import lengths, one_of, positive, real_array, whole_shape
from .collimator import COLLIMATORS, Collimator, Construction
from .columns import ColumnTable, Values
from .design_formulas import roi_radius_seen
from .frames import affine_matrix, module_frames, module_poses, tilt_frames, tilt_vectors
from .module_parts import ModulePart, collimator_solid, crystal_solid
from .pinhole_columns import PINHOLE_COLUMNS
from .scanner import Detector, Fault, Scanner, first_equal_row, first_true, repeated_rows, rings_along_z
from .views import Views

LENGTHS = {name: column.help for name, column in PINHOLE_COLUMNS.scalars.items() if column.kind == "length"}
"""Descriptions of the modules' dimensions by fields of `PinholeSystem`."""

# Pinholes that differ in z by less than this fraction of the crystal's side belong to one ring.
_RING_GAP = 0.2
_SAME_PLACE = 1e-6
"""Distance, mm, up to which two pinholes in a workbook are taken for one."""


AnyScanner = TypeVar("AnyScanner", bound=Scanner)


@dataclass(frozen=True, eq=False)
class PinholeSystem(Scanner):
    """System of M pinhole modules around the isocentre, which is the world's origin.

    `centers` (M, 3) are the pinholes' centres, world mm. Each of d, l, Ld, Td and R (M,) is in mm, and one number holds for
    all modules. `numbers` (M,) are the modules' numbers in the workbook (default 1, 2, ...), and `source` is the workbook
    that the system was read from. A module looks at the isocentre unless it has a `tilt` (M, 3), rad: a rotation vector
    about its nominal u, v and k. `crystal_material` (M,) names the crystals' materials; "" leaves the choice to the model.

    d must be below Ld, pinholes must be outside the ROI, and no two modules may have the same number or place.
    """

    kind: ClassVar[str] = "pinhole"
    columns: ClassVar[ColumnTable] = PINHOLE_COLUMNS

    centers: Floats
    pinhole_diameter: Floats  # d
    collimator_length: Floats  # l
    detector_side: Floats  # Ld
    detector_thickness: Floats  # Td
    roi_radius: Floats  # R
    numbers: Integers = None  # type: ignore[assignment]  # an array after __init__
    source: SystemSource | None = None
    tilt: Floats = 0.0  # type: ignore[assignment]  # an array after __init__
    crystal_material: NDArray[np.str_] = ""  # type: ignore[assignment]
    more: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "centers", real_array(self.centers, "pinhole centres", (None, 3)))
        super().__post_init__()
        wide = "pinhole_diameter {pinhole_diameter:g} mm must be less than detector_side {detector_side:g} mm"
        self._refuse(self.pinhole_diameter >= self.detector_side, wide)
        inside = "its pinhole is {pinhole_distance:g} mm from the isocentre, inside the ROI of {roi_radius:g} mm"
        self._refuse(self.pinhole_distance <= self.roi_radius, inside)
        self._refuse(repeated_rows(self.centers), "another module has the same pinhole centre")

    @classmethod
    def faults(cls, values: Values, numbers: Sequence[int], place: Callable[[str, int], str]) -> Iterator[Fault]:
        """Yield the first module of each fault: hole wider than crystal, pinhole in the ROI, too far away, or repeated."""
        d, side, roi = values["d"], values["Ld"], values["R"]
        for i in first_true(d >= side):
            yield "d", i, f"has d = {d[i]:g} mm, expected less than Ld = {side[i]:g} mm in {place('Ld', i)}"
        centers = np.stack([values[name] for name in ("x1", "y1", "z1")], axis=1)
        with np.errstate(over="ignore"):
            b = np.linalg.norm(centers, axis=1)
        subject = "and y1, z1 put the pinhole of module"
        for i in first_true(b == 0):
            yield "x1", i, f"{subject} {numbers[i]} at the isocentre, expected outside the ROI"
        for i in first_true(np.isinf(b)):
            yield "x1", i, f"{subject} {numbers[i]} too far away to compute, expected millimetres"
        for i in first_true(b <= roi):
            outside = f"expected outside the ROI of {roi[i]:g} mm in {place('R', i)}"
            yield "x1", i, f"{subject} {numbers[i]} {b[i]:g} mm from the isocentre, {outside}"
        first_there = first_equal_row(np.round(centers / _SAME_PLACE))
        for i in first_true(first_there < np.arange(len(first_there))):
            twin = f"at the place of module {numbers[first_there[i]]} ({place('x1', int(first_there[i]))})"
            yield "x1", i, f"{subject} {numbers[i]} {twin}, expected another place"

    def __repr__(self) -> str:
        sizes = {"b": self.pinhole_distance, "l": self.collimator_length}
        b, l = (f"{name} {x.min():.4g} to {x.max():.4g} mm" for name, x in sizes.items())
        return f"PinholeSystem({len(self)} modules, {b}, {l})"

    @property
    def pinhole_distance(self) -> Floats:
        """Distance b (M,), mm, from pinhole centre to isocentre."""
        return np.linalg.norm(self.centers, axis=1)

    @property
    def principal_rays(self) -> Floats:
        """Axes k (M, 3) of the modules, unit vectors that point from pinhole to isocentre if there is no tilt."""
        return self.frames()[:, 2]

    def frames(self) -> Floats:
        """Return the module frames (M, 3, 3), rows u, v, k: those of `core.geometry.frames.module_frames`, tilted."""
        return tilt_frames(module_frames(self.centers), self.tilt)

    def isocentres(self) -> Floats:
        """Return the isocentre (M, 3), mm from each pinhole along the module's u, v and k: (0, 0, b) without tilt."""
        is_tilted = np.any(self.tilt, axis=1)[:, None]
        aimed = self.pinhole_distance[:, None] * [0.0, 0.0, 1.0]
        return np.where(is_tilted, -np.einsum("mij,mj->mi", self.frames(), self.centers), aimed)

    def roi_radius_seen(self) -> Floats:
        """Return the radius (M,), mm, of the largest sphere at the isocentre in each module's field of view, or 0."""
        u, v, height = self.isocentres().T
        sizes = self.pinhole_diameter, self.detector_side, self.collimator_length
        radius = roi_radius_seen(np.where(height > 0, height, 1.0), *sizes, aside=np.maximum(abs(u), abs(v)))
        return np.where(height > 0, radius, 0.0)

    def poses(self) -> Floats:
        """Return the poses (M, 4, 4), world from module: columns u, v, k and the pinhole centre, mm."""
        return affine_matrix(self.frames().transpose(0, 2, 1), self.centers)

    def attributes_at(self, poses: Floats) -> dict[str, Array]:
        """Return the pinhole centres and the tilts of modules at these poses (M, 4, 4)."""
        centers = poses[:, :3, 3]
        return {"centers": centers, "tilt": tilt_vectors(module_frames(centers), poses[:, :3, :3].transpose(0, 2, 1))}

    @classmethod
    def aimed(cls, places: Floats) -> Floats:
        """Return the poses (M, 4, 4) of untilted modules whose pinholes are at `places` (M, 3), mm."""
        return module_poses(places)

    def fields(self) -> Floats:
        """Return the field of view of each module's camera, (M, 5), mm: the crystal mirrored to the front of the pinhole."""
        zeros, side = np.zeros(len(self)), self.detector_side
        return np.stack([zeros, zeros, self.collimator_length, side, side], axis=1)

    def collimators(self, construction: Construction | None = None, shape: str = "square") -> list[Collimator]:
        """Return the collimator of each module, of a shape in `COLLIMATORS`.

        Raises `InputError`, which names the module, if a collimator cannot be built.
        """
        one_of(shape, COLLIMATORS, "shape")
        collimators = []
        sizes = (self.pinhole_diameter, self.collimator_length, self.detector_side)
        for number, d, l, side in zip(self.numbers.tolist(), *(size.tolist() for size in sizes), strict=True):
            with naming(f"module {number}"):
                collimators.append(COLLIMATORS[shape](d, l, side, construction or Construction()))
        return collimators

    def parts(self, construction: Construction | None = None) -> list[ModulePart]:
        """Return collimator and crystal of each module, module by module.

        Raises `InputError`, which names the module, if a collimator cannot be built.
        """
        collimators, poses = self.collimators(construction), self.poses()
        poses[:, :3, [0, 2]] *= -1  # camera space is X = -u, Y = v, Z = -k
        width = max(2, len(str(self.numbers.max())))
        parts = []
        modules = zip(self.numbers.tolist(), poses, collimators, self.detector_thickness.tolist(), strict=True)
        for number, pose, collimator, thickness in modules:
            name = f"Module {number:0{width}d}"
            crystal = crystal_solid(collimator.length, collimator.detector_side, thickness)
            parts.append(ModulePart(number, "collimator", f"{name} collimator", collimator_solid(collimator), pose))
            parts.append(ModulePart(number, "crystal", f"{name} crystal", crystal, pose))
        return parts

    def region_radius(self) -> float:
        """Return the largest of the modules' ROI radii, mm."""
        return float(self.roi_radius.max())

    def roi_radii(self) -> Floats:
        """Return the radii (M,), mm, of the modules' regions of interest."""
        return self.roi_radius

    def derived_lengths(self) -> dict[str, Floats]:
        """Return the pinhole distances b (M,), mm, by name, for files."""
        return {"pinhole_distance": self.pinhole_distance}

    def rings(self) -> Integers:
        """Return the index (M,) of each module's ring, from 0 along +z; pinholes at about the same z form a ring."""
        return rings_along_z(self.centers[:, 2], _RING_GAP * self.detector_side)

    def views(
        self,
        shape: tuple[int, int] = (256, 256),
        detector: Detector = "virtual",
        magnification: float = 10.0,
        pitch: ArrayLike | None = None,
        offset: ArrayLike = (0.0, 0.0),
    ) -> Views:
        """Return the views of the modules' images of `shape` (n_v, n_u), n_v rows and n_u columns.

        Both detectors use the same rays, from the pinhole to the virtual detector's plane at ``magnification * l`` in
        front of it: the crystal point (-u, -v)/magnification and the virtual pixel (u, v) lie on the same ray. The real
        detector is the crystal's front face behind the pinhole, so its image is point-inverted.

        `pitch` is the distance between pixels on the chosen detector, mm, one number or (pitch_u, pitch_v). By default the
        image covers the crystal (Ld / n on the real, magnification * Ld / n on the virtual detector); an `InputWarning`
        names pixels that cover more than the detector's side, or less than half of it. `offset` is the position (x0, y0) of
        the image's middle on the chosen detector, mm along u and v.
        """
        n_v, n_u = whole_shape(shape, "image shape", 2)
        magnification = positive(magnification, "magnification")
        if detector not in ("virtual", "real"):
            raise InputError(f"detector {detector!r}: expected 'virtual' or 'real'")
        # A length on the real detector is -magnification times as long on the virtual one.
        to_virtual = 1.0 if detector == "virtual" else -magnification
        side = abs(magnification / to_virtual) * self.detector_side[:, None]
        pitches = side / np.array([n_u, n_v])
        if pitch is not None:
            pitches = np.broadcast_to(lengths(pitch, "pixel pitch", 2), (len(self), 2))
            warn_of_size((n_u, n_v), pitches, side, f"{detector} detector's side")
        x0, y0 = real_array(offset, "image offset", (2,)) * to_virtual
        u, v, k = self.frames().transpose(1, 0, 2)
        distance = magnification * self.collimator_length[:, None]
        middles = self.centers + distance * k + x0 * u + y0 * v
        pitch_u, pitch_v = to_virtual * pitches[:, :1], to_virtual * pitches[:, 1:]
        return Views(self.centers, middles, pitch_u * u, pitch_v * v, (n_v, n_u))


def warn_of_size(pixels: tuple[int, int], pitches: Floats, sides: Floats, name: str) -> None:
    """Warn if images cover clearly more than the detector's side, or clearly less than half of it.

    `pixels` are (n_u, n_v), `pitches` (2,) or (M, 2) and `sides` (M, 1) are in mm, and `name` is what the message calls the
    side. Half of a side is covered on purpose, as "FOV", and a little more than all of it results from round numbers.
    """
    covered = np.array(pixels) * pitches + 0 * sides
    for m, axis in np.argwhere((covered < 0.45 * sides) | (covered > 1.1 * sides))[:1]:
        image = f"{pixels[axis]} pixels of {covered[m, axis] / pixels[axis]:g} mm are {covered[m, axis]:g} mm"
        warn(f"{image}, but the {name} is {sides[m, 0]:g} mm")


def chosen_modules(system: AnyScanner, text: str | None, name: str = "--modules") -> AnyScanner:
    """Return the modules of `system` whose numbers `text` lists, such as "1-40", "1-20,41" or "60-"; all if it is None.

    `name` is what messages call the text.
    """
    return system if text is None else system[chosen_indices(system.numbers, text, name)]


def chosen_indices(numbers: Integers, text: str, name: str) -> Integers:
    """Return the indices of those module `numbers` (M,) that `text` lists; arguments are those of `chosen_modules`."""
    chosen: list[Integers] = []
    lowest, highest = int(numbers.min()), int(numbers.max())
    for part in text.split(","):
        first, dash, last = part.strip().partition("-")
        with expecting(f"{name} {text!r}: expected numbers such as 1-40 or 1-20,41"):
            low = int(first) if first or not dash else lowest
            high = int(last) if last else highest if dash else low
        indices = np.flatnonzero((numbers >= low) & (numbers <= high))
        if high < low:
            raise InputError(f"{name} {text!r}: {part.strip()} ends before it begins")
        if len(indices) == 0:
            raise InputError(f"{name} {text!r}: no module {part.strip()}; there are {lowest} to {highest}")
        chosen.append(indices)
    return np.unique(np.concatenate(chosen))
