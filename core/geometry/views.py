"""Views: the rays of images, given by sources, detector centres and pixel steps."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..arrays import Floats
from ..errors import InputError
from ..validation import freeze, real_array, whole_shape

VECTORS = ("sources", "detector_centers", "u_steps", "v_steps")
"""Names of the arrays of `Views`."""


@dataclass(frozen=True, eq=False)
class Views:
    """Geometry of M images of one shape, described like ASTRA's cone_vec geometries, in world mm.

    Pixel (row i, column j) of view m has its centre at
    ``detector_centers[m] + (j - (n_u - 1)/2) u_steps[m] + (i - (n_v - 1)/2) v_steps[m]``; its ray runs from
    ``sources[m]`` to that centre. The arrays are (M, 3), mm. A source must not lie in its detector's plane.

    If `parallel`, the sources are at infinity: the rays of view m are whole lines through its pixels, all in the direction
    from ``sources[m]`` to ``detector_centers[m]``; the distance between these two does not matter.
    """

    sources: Floats  # pinholes, or X-ray sources
    detector_centers: Floats
    u_steps: Floats  # steps from one pixel to the next along a row (column index + 1)
    v_steps: Floats  # steps from one pixel to the next along a column (row index + 1)
    shape: tuple[int, int]  # numbers of pixels (n_v, n_u): rows, columns
    parallel: bool = False  # whether the sources of all views are at infinity

    def __post_init__(self) -> None:
        object.__setattr__(self, "shape", whole_shape(self.shape, "image shape", 2))
        if not isinstance(self.parallel, bool | np.bool_):
            raise InputError(f"parallel: expected True or False, got {self.parallel!r}")
        object.__setattr__(self, "parallel", bool(self.parallel))
        for name in VECTORS:
            n = None if name == "sources" else len(self.sources)
            object.__setattr__(self, name, freeze(real_array(getattr(self, name), name, (n, 3))))
        axes = self._axes()
        lengths = np.linalg.norm(axes, axis=1, keepdims=True)
        with np.errstate(invalid="ignore", divide="ignore"):
            flat = ~(np.abs(np.linalg.det(axes / lengths)) > 1e-12)
        if flat.any():
            problem = "its source lies in the detector's plane, or its pixel steps are parallel"
            raise InputError(f"view {int(np.argmax(flat))}: {problem}")

    def __len__(self) -> int:
        return len(self.sources)

    def __getitem__(self, index: int | slice | NDArray[np.integer]) -> Views:
        """Return some of the views; `index` is an index, a slice or an array of indices."""
        chosen = np.atleast_1d(np.arange(len(self))[index])
        return replace(self, **{name: getattr(self, name)[chosen] for name in VECTORS})

    def finer(self, parts: int) -> Views:
        """Return the views of the same images with pixels whose sides are divided into a number of `parts`."""
        n_v, n_u = self.shape
        shape = parts * n_v, parts * n_u
        return replace(self, u_steps=self.u_steps / parts, v_steps=self.v_steps / parts, shape=shape)

    def rays(self, m: int) -> tuple[Floats, Floats]:
        """Return the ends of view m's rays: sources and targets, each (n_v * n_u, 3) in mm, row by row.

        All sources are the same point (a read-only view). Parallel rays begin in the plane through ``sources[m]`` that is
        parallel to the detector; the projector extends them through its whole grid.
        """
        n_v, n_u = self.shape
        column = (np.arange(n_u) - (n_u - 1) / 2)[None, :, None]
        row = (np.arange(n_v) - (n_v - 1) / 2)[:, None, None]
        targets = self.detector_centers[m] + row * self.v_steps[m] + column * self.u_steps[m]
        targets = targets.reshape(-1, 3)
        if self.parallel:
            return targets + (self.sources[m] - self.detector_centers[m]), targets
        return np.broadcast_to(self.sources[m], (n_v * n_u, 3)), targets

    def fields(self, poses: Floats) -> Floats:
        """Return the position and size of each image before a camera at `poses` (M, 4, 4), columns u, v and k: (M, 5), mm.

        The five numbers are x, y and distance of the image's middle, and its width and height, in camera space: X = -u,
        Y = v, Z = -k. Width and height are negative if the image is upside down, as on a pinhole's real detector.
        """
        u, v, k = np.moveaxis(poses[:, :3, :3], 2, 0)
        to_middle = self.detector_centers - self.sources
        n_v, n_u = self.shape
        width, height = n_u * np.sum(self.u_steps * u, axis=1), n_v * np.sum(self.v_steps * v, axis=1)
        middles = [-np.sum(to_middle * u, axis=1), np.sum(to_middle * v, axis=1), np.sum(to_middle * k, axis=1)]
        return np.stack([*middles, width, height], axis=1)

    def projection_matrices(self) -> Floats:
        """Return the matrices (M, 3, 4) from homogeneous world points, mm, to ``(column, row, 1)`` times a factor.

        Columns and rows are in pixels, 0 at the centre of pixel 0. The factor is the depth in units of the distance from
        source to detector: 1 on the detector, positive on its side of the source. For parallel views it is 1 everywhere: the
        last row of their matrices is 0 0 0 1.
        """
        n_v, n_u = self.shape
        from_detector = np.array([[1.0, 0.0, (n_u - 1) / 2], [0.0, 1.0, (n_v - 1) / 2], [0.0, 0.0, 1.0]])
        # x - source = t (a u_step + b v_step + (center - source)): solve for t (a, b, 1).
        solve = np.linalg.inv(self._axes())
        if self.parallel:  # x - center = a u_step + b v_step + t (center - source): (a, b, 1)
            solve[:, 2] = 0.0
        linear = from_detector @ solve
        offset = -np.einsum("mij,mj->mi", linear, self.detector_centers if self.parallel else self.sources)
        if self.parallel:
            offset += from_detector[:, 2]
        return np.concatenate([linear, offset[:, :, None]], axis=2)

    def perspective_matrices(self) -> Floats:
        """Return the matrices (M, 4, 4) from homogeneous world points, mm, to ``(column, row, k, 1)`` times a factor.

        Columns, rows and the factor are those of `projection_matrices`. ``k = D / depth`` is the magnification: D is the
        distance from the source to the detector's plane, and the depth is measured normal to that plane. The magnification
        is 1 on the detector and grows towards the source. Straight lines stay straight, and the inverse matrix maps back.
        For parallel views k is 1 everywhere, and their matrices have no inverse: a `PerspectiveGrid` has the depth in place
        of k.
        """
        column, row, factor = np.moveaxis(self.projection_matrices(), 1, 0)
        return np.stack([column, row, np.broadcast_to([0.0, 0.0, 0.0, 1.0], factor.shape), factor], axis=1)

    def require_pinholes(self, name: str) -> None:
        """Raise `InputError`, which begins with `name`, if the views are parallel."""
        if self.parallel:
            raise InputError(f"{name}: expected views with a source each; parallel views have theirs at infinity")

    def _axes(self) -> Floats:
        """Return the matrices (M, 3, 3) whose columns are u_step, v_step and the vector from source to detector centre."""
        return np.stack([self.u_steps, self.v_steps, self.detector_centers - self.sources], axis=2)
