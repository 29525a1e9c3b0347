"""Base class of all phantoms, and phantoms that users define by a list of shapes."""

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..arrays import ArrayLike, Floats, Floats32
from ..errors import InputError, naming, warn
from ..geometry.frames import checked_affine, moved
from ..geometry.grid import Grid
from ..geometry.views import Views
from ..memory import require
from ..progress import Progress
from ..validation import freeze, instance, one_of, positive, real_array
from ..volumes.volume import UNITS, Volume
from .painting import Layer, line_integrals, mean_changes, paint_voxels, points_inside, values_at
from .settings import check_settings
from .shapes import Shape

QUANTITIES = ("activity", "mu")
_ENDS = ((-1.0, 1.0),) * 3
_FRACTION_IN_GRID = 0.98  # a warning is given if a smaller fraction of the phantom lies in the grid


class PhantomMesh(NamedTuple):
    """Closed mesh of one shape of a phantom."""

    name: str
    """Name of the shape, or its kind and number."""
    vertices: Floats
    """Vertices (V, 3), mm, in the phantom's frame."""
    faces: NDArray[np.int32]
    """Triangles (F, 3), counter-clockwise as seen from outside."""
    activity: float | None
    """Activity concentration, kBq/mL, or None."""
    mu: float | None
    """Linear attenuation coefficient, 1/mm, or None."""


class Phantom:
    """Shapes painted one over the other, with exact line integrals, voxels on any grid, and meshes.

    The frame's origin is the phantom's centre; `pose` is world-from-phantom (4, 4), mm, any invertible affine (default:
    identity), see `euler_pose`. The `quantity` is ``"activity"`` (kBq/mL) or ``"mu"`` (1/mm, at `mu_energy`).
    A kind of phantom is a derived dataclass that defines `shapes`; its fields are its settings, each with its unit and help.
    """

    mu_energy: float = 140.5
    """Energy, keV, at which mu holds."""

    @property
    def shapes(self) -> Sequence[Shape]:
        """Shapes of the phantom, from bottom to top."""
        raise NotImplementedError

    title: str = "phantom"
    """Name of the phantom in messages."""

    def __post_init__(self) -> None:
        check_settings(self, self.title)
        with naming(self.title):
            len(self.shapes)  # made now, so that settings that cannot be built are refused here

    @property
    def total_activity(self) -> float:
        """Activity of the whole phantom, kBq, from the shapes' volumes.

        Partial overlaps are measured at sample points, to about 1/1000 of the smaller shape's content.
        """
        return self._volume_integral("activity") * 1e-3  # kBq/mL times mm^3

    @property
    def extent(self) -> float:
        """Diameter, mm, of a ball around the origin that contains the phantom in every orientation."""
        return 2 * max(math.hypot(*shape.position) + shape.ball_radius for shape in self.shapes)

    @cached_property
    def box(self) -> tuple[Floats, Floats]:
        """Lowest and highest corner (3,), mm, of a box along the axes of the phantom's frame that contains it."""
        low, high = np.full(3, np.inf), np.full(3, -np.inf)
        for shape in self.shapes:
            # A cut may leave little of a shape. The vertices of its mesh, slightly inside its surface, tell how much.
            corners = shape.surface()[0] if shape.cut else np.array(list(itertools.product(*_ENDS))) * shape.half_box
            points = moved(shape.pose, corners)
            low, high = np.minimum(low, points.min(axis=0)), np.maximum(high, points.max(axis=0))
        return freeze(low), freeze(high)

    def voxelize(
        self, grid: Grid, pose: ArrayLike | None = None, progress: Progress | None = None, quantity: str = "activity"
    ) -> Volume:
        """Return the phantom as a `Volume` on any `grid`, each voxel with the mean over its volume.

        Parts of the phantom outside the grid are cut off, with a warning. `progress` is called as
        ``progress(done, total)`` and may raise `Cancelled`.
        """
        instance(grid, Grid, "voxelize")
        image = paint_voxels(grid, self._layers(quantity, pose), self._mean_changes(quantity), progress)
        scale = 1.0 if pose is None else abs(float(np.linalg.det(np.asarray(pose)[:3, :3])))
        total = self._volume_integral(quantity) * scale
        fraction = float(image.sum(dtype=np.float64)) * grid.voxel_volume / total if total > 0 else 1.0
        if fraction < _FRACTION_IN_GRID:
            warn(f"{1 - fraction:.0%} of the {self.title} lies outside the grid: take larger or more voxels", 2)
        return Volume(freeze(image), grid, quantity)

    def line_integrals(
        self, sources: ArrayLike, targets: ArrayLike, pose: ArrayLike | None = None, quantity: str = "activity"
    ) -> Floats:
        """Return exact integrals (N,) along lines, value x mm, in closed form.

        `sources` and `targets` are the ends of the lines, (N, 3) each, or (3,) for a point that all lines share; world mm.
        """
        layers = self._layers(quantity, pose)
        starts, ends = (
            real_array(np.atleast_2d(real_array(points, name, None)), name, (None, 3))
            for points, name in ((sources, "sources"), (targets, "targets"))
        )
        if len(starts) != len(ends) and 1 not in (len(starts), len(ends)):
            raise InputError(f"line_integrals: {len(starts)} sources but {len(ends)} targets")
        starts, ends = np.broadcast_arrays(starts, ends)
        return line_integrals(layers, starts, ends)

    def project(self, views: Views, pose: ArrayLike | None = None, quantity: str = "activity") -> Floats32:
        """Return exact line integrals from the sources of all `views` to their pixels' centres, (M, n_v, n_u), value x mm.

        Images of `Projector` with `Transmission` converge to them as voxels get smaller.
        """
        instance(views, Views, "project")
        require(4.0 * len(views) * math.prod(views.shape), "a set of projections")
        images = np.empty((len(views), *views.shape), np.float32)
        for m, image in enumerate(images):
            image[...] = self.line_integrals(*views.rays(m), pose, quantity).reshape(views.shape)
        return images

    def values(self, points: ArrayLike, pose: ArrayLike | None = None, quantity: str = "activity") -> Floats:
        """Return the phantom's values (N,) at world `points` (N, 3), mm."""
        return values_at(self._layers(quantity, pose), real_array(points, "points", (None, 3)).T)

    def meshes(self) -> list[PhantomMesh]:
        """Return a closed mesh of every shape, in the phantom's frame, from bottom to top.

        Curved surfaces become polyhedra.
        """
        meshes = []
        for i, shape in enumerate(self.shapes, 1):
            vertices, faces = shape.surface()
            name = shape.name or f"{shape.KIND} {i}"
            vertices = freeze(moved(shape.pose, vertices))
            meshes.append(PhantomMesh(name, vertices, freeze(faces), shape.activity, shape.mu))
        return meshes

    def _volume_integral(self, quantity: str) -> float:
        """Return the integral of the quantity over the whole phantom, value x mm^3, in the phantom's frame."""
        layers = self._layers(quantity)
        return sum(layer.volume * change for layer, change in zip(layers, self._mean_changes(quantity), strict=True))

    def _mean_changes(self, quantity: str) -> list[float]:
        """Return `mean_changes` of the layers of a quantity, computed once: they do not depend on the pose."""
        cache: dict[str, list[float]] = vars(self).setdefault("_cached_changes", {})
        if quantity not in cache:
            cache[quantity] = mean_changes(self._layers(quantity))
        return cache[quantity]

    def _layers(self, quantity: str, pose: ArrayLike | None = None) -> list[Layer]:
        """Return layers of the shapes that have the quantity, from bottom to top, placed in the world by `pose`."""
        one_of(quantity, QUANTITIES, "quantity")
        world = np.eye(4) if pose is None else checked_affine(pose, "phantom pose")
        return [
            Layer(shape, world @ shape.pose, value)
            for shape in self.shapes
            if (value := getattr(shape, quantity)) is not None
        ]


@dataclass(frozen=True)
class ShapePhantom(Phantom):
    """A phantom of your own shapes in the order of painting: later shapes replace, or add to, those beneath them.

    Shapes with negative values must not make the sum negative anywhere.

    Examples
    --------
    >>> water = Cylinder(radius=100, height=200, activity=5, mu=0.0154)
    >>> hot = Sphere(radius=10, position=(50, 0, 0), activity=40)
    >>> ShapePhantom([water, hot]).voxelize(Grid.centered(128, 2.0), quantity="mu")
    """

    shapes: Sequence[Shape] = ()
    """Shapes of the phantom, from bottom to top."""
    name: str = ""
    """Name of the phantom in messages and files."""
    mu_energy: float = 140.5
    """Energy, keV, at which mu holds."""

    def __post_init__(self) -> None:
        if isinstance(self.shapes, Shape) or not isinstance(self.shapes, Iterable):
            raise InputError(f"phantom: expected a list of shapes, got {type(self.shapes).__name__}")
        if not (shapes := tuple(self.shapes)):
            raise InputError("phantom: expected one shape or more, got none")
        for i, shape in enumerate(shapes, 1):
            if not isinstance(shape, Shape):
                raise InputError(f"phantom: expected shapes, got {type(shape).__name__} as number {i}")
        if not isinstance(self.name, str):
            raise InputError(f"phantom name: expected a text, got {self.name!r}")
        object.__setattr__(self, "shapes", shapes)
        object.__setattr__(self, "mu_energy", positive(self.mu_energy, "mu_energy", "keV"))
        object.__setattr__(self, "title", self.name or self.title)
        for quantity in QUANTITIES:
            layers = self._layers(quantity)
            largest = max((abs(layer.value) for layer in layers), default=0.0)
            for layer in layers:
                if layer.value >= 0:
                    continue
                points = next(points_inside(layer))
                values = values_at(layers, points)
                if values.size and (lowest := float(values.min())) < -1e-9 * largest:
                    number = next(i for i, shape in enumerate(shapes, 1) if shape is layer.shape)
                    name = f"shape {number}" + (f" {layer.shape.name!r}" if layer.shape.name else "")
                    place = " ".join(f"{x:.4g}" for x in points[:, values.argmin()])
                    sum_text = f"{layer.value:g} {UNITS[quantity]} added leaves {lowest:g} at {place} mm"
                    raise InputError(f"{name}: {quantity}: {sum_text}; expected 0 or more")
