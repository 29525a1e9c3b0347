"""The depth-dependent pinhole response of all views as a linear map from a volume to images.

A point at depth h before the pinhole's plane is seen on the crystal as a disc of diameter ``d (1 + l / h)``. Here the image
of a voxel is made in two steps, each of which is a sparse matrix whose transpose is the adjoint. First the voxel is shared
out among 3 x 3 cells of a fine image, around the point where the line through the hole's centre meets it, with the weights
of a quadratic B-spline, and between the two planes of depth beside it. Then each pixel sums the cells around it with the
plane's kernel: the disc, the voxel's shadow and the pixel's area, convolved, less the blur of the B-spline. An oblique voxel
is smeared along its depth: it is two points or more along that direction. No voxel is so small that it is missed.

References
----------
C. E. Metz, F. B. Atkins, R. N. Beck, "The geometric transfer function component for scintillation camera collimators with
straight parallel holes", Physics in Medicine and Biology 25 (1980) 1059-1070: the response of a hole as a convolution of
discs. M. Unser, A. Aldroubi, M. Eden, "B-spline signal processing", IEEE Transactions on Signal Processing 41 (1993)
821-833: kernels that make up for the spline.
"""

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np

from ..arrays import Array, cropped
from ..rays import backends
from ..rays.execution import Report
from ..rays.parallel import in_order, run_all
from ..volumes.volume import Volume
from .depth_response import Block, DepthResponse, Index
from .depth_zone import ViewNumbers
from .pinhole_views import PinholeViews
from .transmittance import ArrayOnGrid, VoxelTransmittance
from .zone_gradient import ResponseGradient, zone_gradient
from .zone_response import zone_response

BoxResponse = tuple[DepthResponse, Block]
"""Response to a box of the volume, and the rows and columns of pixels that may see it."""

# Voxels of a slab of whole layers, which one thread adds to before it takes the next; bytes of the views' cells in memory.
_SLAB_VOXELS, _CELL_BYTES = 2**14, 2**28
# Boxes, on average, whose responses are stored for a view: the whole volume, and what a volume fills. They share its
# numbers.
_BOXES_PER_VIEW = 2
# Bytes of transmittances that are stored from call to call.
_TRANSMITTANCE_BYTES = 2**30


@dataclass(eq=False)
class PinholeOperator(PinholeViews):
    """Linear map from a volume to the images of all views, through the whole holes of their modules.

    Each view has a response for every zone of depth, made when it is first needed.
    """

    def __post_init__(self) -> None:
        self._responses: dict[tuple[int, float, type], DepthResponse] = {}
        self._zone_limits: dict[int, list[tuple[float, float]]] = {}
        self._boxes: dict[tuple[int, Index, Index, type], list[BoxResponse]] = {}
        self._transmittances: dict[int, tuple[Index, Array]] = {}
        self._free_bytes = _TRANSMITTANCE_BYTES

    def images(self, volume: Array, backend: ModuleType, workers: int, mu: ArrayOnGrid | None) -> Iterator[Array]:
        """Yield the images (n_v, n_u) of `volume` one by one.

        `backend` is the module that `depth_backend` returns; `mu` attenuates in place of the operator's own, if it is not
        None.
        """
        (filled,), origin = cropped(volume)
        filled, dtype = np.ascontiguousarray(filled), volume.dtype.type

        def image(m: int) -> Array:
            """Return the image (n_v, n_u) of view m."""
            image = np.zeros(self.views.shape, volume.dtype)
            responses = self._box_responses(m, origin, filled.shape, dtype)
            transmittance = self._transmittance(m, origin, filled, mu) if responses else None
            for response, pixels in responses:
                cells = backend.voxels_to_cells(filled, response, transmittance)
                image[pixels] += backend.cells_to_pixels(cells, response)
            return image

        return in_order(image, range(len(self.views)), workers)

    def backproject(
        self, images: Array, backend: ModuleType, workers: int, report: Report, mu: ArrayOnGrid | None = None
    ) -> Array:
        """Return the adjoint of `images` (M, n_v, n_u), a volume; ``report(n)`` is called when n images are done.

        Each thread has a slab of the volume, so the result does not depend on their number.
        """
        volume = np.zeros(self.grid.shape, images.dtype)
        layers = max(1, _SLAB_VOXELS // math.prod(volume.shape[1:]))
        slabs = [slice(x, x + layers) for x in range(0, len(volume), layers)]
        box = (0, 0, 0), self.grid.shape, images.dtype.type

        def to_cells(m: int) -> tuple[Array | None, list[tuple[DepthResponse, Array]]]:
            """Return the voxels' transmittance in view m, and its image shared out to the cells of each response."""
            responses = self._box_responses(m, *box)
            cells = [(response, backend.pixels_to_cells(images[m][pixels], response)) for response, pixels in responses]
            return self._transmittance(m, box[0], volume, mu) if cells else None, cells

        n, first = len(images), 0
        while first < n:
            size = sum(4 * math.prod(response.shape) for response, _ in self._box_responses(first, *box))
            last = min(first + max(workers, _CELL_BYTES // max(size, 1)), n)
            views = list(in_order(to_cells, range(first, last), workers))

            def to_voxels(slab: slice, views: list[Any] = views) -> None:
                """Add the cells of these `views` to the voxels of a slab of the volume."""
                for transmittance, responses in views:
                    for response, cells in responses:
                        backend.cells_to_voxels(volume, cells, response, transmittance, slab)

            run_all(to_voxels, slabs, workers)
            first = last
            report(first)
        return volume

    def gradient(
        self, volumes: Array, images: Array, backend: ModuleType, workers: int
    ) -> tuple[Array, Array, dict[str, Array]]:
        """Return the gradient of sum(images * A(volumes)) by the geometry.

        Parameters
        ----------
        volumes, images
            (n, n_x, n_y, n_z) and (n, M, n_v, n_u), of one type.
        backend, workers
            The module that `depth_backend` returns, and the number of threads.

        Returns
        -------
        centers, frames, numbers
            By the pinholes' centres (M, 3), by the modules' frames (M, 3, 3), and by `length`, `diameter`, `first` and
            `pitch` of `ViewNumbers`, each with the axis M first; the pitch changes around the image's middle.
        """
        filled, origin = cropped(*volumes)
        dtype = images.dtype.type
        shape, affine = filled[0].shape, self.grid.affine[:3]

        def view_gradient(m: int) -> tuple[Array, Array, ViewNumbers]:
            """Return the gradients of view m by the pinhole's centre (3,), the frame (3, 3) and the view's numbers."""
            pinhole, frame, *_ = self.module(m)
            numbers = ViewNumbers.zero()
            d_transmittance: Array = np.zeros(shape, dtype)
            responses = self._box_responses(m, origin, shape, dtype)
            transmittance = self._transmittance(m, origin, filled[0], None) if responses else None
            for (response, pixels), limits in zip(responses, self._reached_zones(m, origin, shape), strict=True):
                total = None
                for volume, image in zip(filled, images[:, m], strict=True):
                    part = np.ascontiguousarray(image[pixels])
                    gradient, d_cells = ResponseGradient.of_product(volume, part, response, transmittance, backend)
                    total = gradient if total is None else total.plus(gradient)
                    if transmittance is not None:
                        d_voxels = np.zeros(shape, dtype)
                        backend.cells_to_voxels(d_voxels, d_cells, response, None, slice(None))
                        d_transmittance += d_voxels * volume
                if total is not None:
                    numbers = numbers.plus(zone_gradient(self.zone(m, *limits), response, pixels, origin, total))
            d_camera = numbers.to_camera
            d_center: Array = -(d_camera[:, 3] @ frame)
            d_frame: Array = d_camera[:, :3] @ affine[:, :3].T + np.outer(d_camera[:, 3], affine[:, 3] - pinhole)
            if transmittance is not None and self.mu is not None:
                rays = self._voxel_transmittance(m, self.mu, origin, filled[0])
                d_center = d_center + rays.pinhole_gradient(d_transmittance)
            return d_center, d_frame, numbers

        views = in_order(view_gradient, range(len(self.views)), workers)
        centers, frames, numbers = zip(*views, strict=True)
        names = ("length", "diameter", "first", "pitch")
        gradients = {name: np.array([getattr(of_view, name) for of_view in numbers]) for name in names}
        gradients["pitch"] -= (np.array(self.views.shape) - 1) / 2 * gradients["first"]
        return np.array(centers), np.array(frames), gradients

    def mu_gradient(self, volume: Array, images: Array, backend: ModuleType, workers: int, mu: ArrayOnGrid) -> Array:
        """Return the gradient of sum(images * A(volume)) by `mu`, on its grid."""
        (filled,), origin = cropped(volume)
        filled = np.ascontiguousarray(filled)

        def view_gradient(m: int) -> Array:
            """Return the gradient of view m by mu, on mu's grid."""
            d_transmittance = np.zeros_like(filled)
            for response, pixels in self._box_responses(m, origin, filled.shape, volume.dtype.type):
                cells = backend.pixels_to_cells(np.ascontiguousarray(images[m][pixels]), response)
                backend.cells_to_voxels(d_transmittance, cells, response, None, slice(None))
            return self._voxel_transmittance(m, mu, origin, filled).mu_gradient(d_transmittance * filled)

        total = np.zeros(mu.array.shape, volume.dtype)
        for gradient in in_order(view_gradient, range(len(self.views)), workers):
            total += gradient
        return total

    def _box_responses(self, m: int, origin: Index, shape: Index, dtype: type) -> list[BoxResponse]:
        """Return view m's responses to a box of the volume, one for each zone that it reaches into, with their pixels."""
        key = m, origin, shape, dtype
        if (responses := self._boxes.get(key)) is None:
            zones = self._reached_zones(m, origin, shape)
            responses = [self._response(m, *zone, dtype).restrict_to_box(origin, shape) for zone in zones]
            if len(self._boxes) >= _BOXES_PER_VIEW * len(self.views):
                self._boxes.clear()
            self._boxes[key] = responses
        return responses

    def _reached_zones(self, m: int, origin: Index, shape: Index) -> list[tuple[float, float]]:
        """Return the depths (far, near), mm, of the zones of view m that a box of the volume reaches into."""
        row = self.depth_row(m)
        depths = [row @ (*np.add(origin, corner), 1) for corner in itertools.product(*((0, n - 1) for n in shape))]
        if m not in self._zone_limits:
            self._zone_limits[m] = self.zone_limits(m)
        return [(far, near) for far, near in self._zone_limits[m] if max(depths) > near and min(depths) <= far]

    def _response(self, m: int, far: float, near: float, dtype: type) -> DepthResponse:
        """Return view m's response to a zone of depth, made once."""
        if (m, far, dtype) not in self._responses:
            self._responses[m, far, dtype] = zone_response(self.zone(m, far, near), dtype)
        return self._responses[m, far, dtype]

    def _transmittance(self, m: int, origin: Index, box: Array, mu: ArrayOnGrid | None) -> Array | None:
        """Return the transmittance from each voxel of a box, an array of whose shape is given, to view m's pinhole.

        None without attenuation. Transmittances of the operator's own mu are stored as long as there is room, also for
        smaller boxes.
        """
        if mu is None and self.mu is None:
            return None
        if mu is not None:
            return self._voxel_transmittance(m, mu, origin, box).transmittance
        stored_origin, stored = self._transmittances.get(m, (origin, None))
        first = np.subtract(origin, stored_origin)
        fits = stored is not None and stored.dtype == box.dtype and first.min() >= 0
        if not fits or (first + box.shape > stored.shape).any():  # type: ignore[union-attr]
            self._free_bytes += self._transmittances.pop(m)[1].nbytes if m in self._transmittances else 0
            rays = self._voxel_transmittance(m, self.mu, origin, box)  # type: ignore[arg-type]
            first, stored = np.zeros(3, int), rays.transmittance
            if stored.nbytes <= self._free_bytes:
                self._free_bytes -= stored.nbytes
                self._transmittances[m] = origin, stored
        inside = tuple(slice(a, a + n) for a, n in zip(first.tolist(), box.shape, strict=True))
        return np.ascontiguousarray(stored[inside])  # type: ignore[index]

    def _voxel_transmittance(self, m: int, mu: Volume | ArrayOnGrid, origin: Index, box: Array) -> VoxelTransmittance:
        """Return the rays from view m's pinhole through a box of the volume, an array of whose shape is given."""
        _, frame, l, d = self.module(m)
        margin = d / 2 * (1 / l + 1 / self.depth_limits(m)[1])
        grid = self.grid.box(origin, box.shape)
        return VoxelTransmittance(mu, self.grid, grid, self.views, m, frame, margin, box.dtype.type)


def depth_backend(name: str = "auto") -> ModuleType:
    """Return the module that works with a `DepthResponse`: `compiled`, or `reference` for numpy and without C kernels."""
    if name != "numpy" and backends.choose("auto").name == "cpu":
        from . import compiled

        return compiled
    from . import reference

    return reference
