"""Data of the benchmarks: views of the 80-module scanner, volumes, the float64 reference, and the rows of results."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

import mphdrr.core as mph

WORKBOOK = Path(__file__).parents[1] / "examples" / "dc-spect-80.xlsx"
SIDE = 256.0  # mm, of the cube of voxels

Array = np.ndarray


@dataclass(frozen=True)
class Case:
    """Views spread over the scanner's modules, and a cube of voxels around its isocentre.

    Attributes
    ----------
    folder : str
        Where `save_volumes` has put the volumes.
    voxels, pixels : int
        Along each side of the cube and of the image.
    n_views : int
        At most 80. With fewer than 80 they are taken from all rings: every tenth module for 8.
    """

    folder: str
    voxels: int = 256
    pixels: int = 256
    n_views: int = 8

    @cached_property
    def grid(self) -> mph.Grid:
        """The voxel grid, centred at the isocentre."""
        return mph.Grid.centered((self.voxels,) * 3, SIDE / self.voxels)

    @cached_property
    def system(self) -> mph.PinholeSystem:
        """The scanner of the chosen modules."""
        every = mph.read_system(WORKBOOK)
        return every[np.arange(self.n_views) * len(every) // max(8, self.n_views)]

    @cached_property
    def views(self) -> mph.Views:
        """The views of the images."""
        return self.system.views((self.pixels, self.pixels))

    def volume(self, name: str) -> Array:
        """Return the volume `name` that `save_volumes` has written, float32."""
        return np.load(volume_path(self.folder, name, self.voxels))

    @cached_property
    def images(self) -> Array:
        """The random images that the adjoint is applied to, (n_views, n_v, n_u)."""
        return np.random.default_rng(1).random((self.n_views, self.pixels, self.pixels), dtype=np.float32)

    @cached_property
    def emission_weights(self) -> Array:
        """Counts per attenuated integral, (n_views, n_v, n_u): d^2 p^2 cos^4(psi) / (16 l^2) for the ideal pinhole."""
        weights = np.empty((self.n_views, self.pixels, self.pixels))
        for m, (d, l) in enumerate(zip(self.system.pinhole_diameter, self.system.collimator_length, strict=True)):
            source, targets = self.views.rays(m)
            depth = np.linalg.norm(self.views.detector_centers[m] - source[0])
            pitch = np.linalg.norm(self.views.u_steps[m]) * l / depth  # on the crystal
            cosine = depth / np.linalg.norm(targets - source, axis=1)
            weights[m] = (d**2 * pitch**2 * cosine**4 / (16 * l**2)).reshape(self.views.shape)
        return weights


def volume_path(folder: str | Path, name: str, voxels: int) -> Path:
    """Return the path of the volume `name` with `voxels` voxels along each side."""
    return Path(folder) / f"{name}-{voxels}.npy"


def save_volumes(folder: str | Path, voxels: int, names: tuple[str, ...] = ("noise", "smooth", "mu")) -> None:
    """Write volumes of a `Case`.

    - noise: independent numbers from 0 to 1, the hardest to skip or to interpolate;
    - smooth: broad blobs, in which all models of the integral agree, so that a shift of the rays shows;
    - mu: attenuation, 0.005 to 0.015 1/mm;
    - small: noise in the middle eighth, 0 around it.
    """
    shape = (voxels,) * 3
    rng = np.random.default_rng(0)
    for name in names:
        if name == "smooth":
            at = (np.arange(voxels) + 0.5) / voxels - 0.5
            volume = np.zeros(shape, np.float32)
            for x, y, z, width in ((0.0, 0.05, -0.1, 0.16), (-0.15, 0.1, 0.1, 0.1), (0.12, -0.16, 0.05, 0.12)):
                blob = (np.exp(-((at - c) ** 2) / (2 * width**2)).astype(np.float32) for c in (x, y, z))
                volume += np.einsum("i,j,k->ijk", *blob)
        else:
            volume = rng.random(shape, dtype=np.float32)
        if name == "mu":
            volume = 0.005 + 0.01 * volume
        if name == "small":
            quarter = voxels // 4
            inside = np.zeros(shape, bool)
            inside[quarter:-quarter, quarter:-quarter, quarter:-quarter] = True
            volume *= inside
        np.save(volume_path(folder, name, voxels), volume)


@dataclass
class Row:
    """The measurements of one contender."""

    name: str
    threads: int
    n_views: int
    label: str = ""
    model: str = ""
    seconds: dict[str, float] = field(default_factory=dict)
    """Time of each task, per view."""
    processor: dict[str, float] = field(default_factory=dict)
    """The same in processor time, all threads together; other work on the machine disturbs it less."""
    memory: float = float("nan")
    """MB beyond volume and images, the largest of all tasks."""
    errors: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Reference:
    """Integrals in float64 at some pixels of each view.

    Attributes
    ----------
    pixels : int array (n_views, k)
        Which, counted row by row.
    values, by_column, by_row : array (n_views, k)
        The integrals, and how they change from pixel to pixel.
    """

    pixels: Array
    values: Array
    by_column: Array
    by_row: Array

    def error(self, images: Array) -> float:
        """Return the largest difference from the reference, relative to the largest integral."""
        return float(np.abs(self._seen(images) - self.values[: len(images)]).max() / self.values.max())

    def offset(self, images: Array) -> tuple[float, float]:
        """Return the displacement of the images, in pixels, and their relative excess brightness, by least squares."""
        n = len(images)
        expected = self.values[:n]
        terms = np.stack([expected, self.by_column[:n], self.by_row[:n]], axis=-1).reshape(-1, 3)
        difference = (self._seen(images) - expected).reshape(-1)
        scale, x, y = np.linalg.lstsq(terms, difference, rcond=None)[0]
        return float(np.hypot(x, y)), float(scale)

    def _seen(self, images: Array) -> Array:
        return np.take_along_axis(images.reshape(len(images), -1), self.pixels[: len(images)], axis=1)


def reference(case: Case, volume: str, k: int = 500) -> Reference:
    """Compute the integrals in float64 at `k` random pixels of each view, and their change from pixel to pixel."""
    rng = np.random.default_rng(2)
    pixels = np.stack([rng.choice(case.pixels**2, min(k, case.pixels**2), replace=False) for _ in range(case.n_views)])
    array, views = case.volume(volume), case.views
    sums = np.empty((5, *pixels.shape))
    for m in range(case.n_views):
        source, targets = views.rays(m)
        u, v = views.u_steps[m] / 2, views.v_steps[m] / 2
        ends = np.concatenate([targets[pixels[m]] + shift for shift in (0 * u, u, -u, v, -v)])
        sums[:, m] = mph.trace_rays(array, source[0], ends, "numpy", case.grid).reshape(5, -1)
    return Reference(pixels, sums[0], sums[1] - sums[2], sums[3] - sums[4])
