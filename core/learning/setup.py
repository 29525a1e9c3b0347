"""Inputs of networks: samples of scans, and the exact operators of one scanner, grid and model."""

import hashlib
import json
import time
from collections.abc import Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from ..errors import InputError, naming
from ..perspective.perspective_maps import PerspectiveMaps
from ..projector import Projector
from ..reconstruction.snapshots import Snapshots

_CACHE_BYTES = 2**24
"""Size, bytes, of the cache of the last scans' OSEM volumes; the last scan's are always in it."""


class Sample(NamedTuple):
    """A batch of B scans by one scanner, as tensors; volumes are in units of each scan's `scale`."""

    counts: torch.Tensor
    """Measured counts (B, M, n_v, n_u)."""
    background: torch.Tensor
    """Expected counts (B, M, n_v, n_u) besides those of the volume."""
    osem: torch.Tensor
    """OSEM volumes (B, S, n_x, n_y, n_z) after the S iterations of `ScannerSetup.after`, divided by `scale`."""
    scale: torch.Tensor
    """Root mean square (B,) of the middle one of the OSEM volumes, such as kBq/mL."""
    truth: torch.Tensor
    """True volumes (B, n_x, n_y, n_z), divided by `scale`; zeros if unknown."""


class ScannerSetup:
    """Operators of one scanner, grid and model, made once and used for all scans by this scanner.

    Parameters
    ----------
    A : Projector
        A projector of emission.
    subsets : int
        Number of OSEM subsets.
    after : sequence of int
        Iterations of OSEM whose volumes networks get.
    permuted : int, optional
        Seed by which the poses are permuted among the modules: for the ablation that asks what true poses are worth.

    Attributes
    ----------
    A : Projector
    sensitivity : tensor (n_x, n_y, n_z)
        Expected counts per unit of activity in each voxel, ``A^T 1``.
    uniform : tensor (M, n_v, n_u)
        Expected counts of one unit of activity in all voxels, ``A 1``.
    saved : float
        Seconds by which the last sample would have taken longer if its OSEM volumes had not been in the cache.
    """

    def __init__(self, A: Projector, subsets: int, after: Sequence[int] = (2, 8, 16), permuted: int | None = None):
        model: Any = A.model
        if not model.has_times:
            raise InputError(f"learned reconstruction: expected a projector of emission, got one of {model.name}")
        if permuted is not None:
            order = np.random.default_rng(permuted).permutation(len(A.views))
            model = model.of_views(order)
            A = Projector(A.grid, A.views[order], model, A.backend, A.threads)
        self.A, self.subsets, self.after, self._modules = A, subsets, tuple(after), model.system
        self.saved = 0.0
        self._scans: dict[bytes, tuple[NDArray[np.float32], float]] = {}

    @cached_property
    def sensitivity(self) -> torch.Tensor:
        """Expected counts (n_x, n_y, n_z) per unit of activity in each voxel, ``A^T 1``."""
        return self.A.T(torch.ones(self.A.shape_out))

    @cached_property
    def uniform(self) -> torch.Tensor:
        """Expected counts (M, n_v, n_u) of one unit of activity in all voxels, ``A 1``."""
        return self.A(torch.ones(self.A.shape_in))

    @cached_property
    def maps(self) -> PerspectiveMaps:
        """Maps between the grid and the coordinates (u, v, k) of each view."""
        return PerspectiveMaps(self.A.views, self.A.grid)

    @cached_property
    def _snapshots(self) -> Snapshots:
        """OSEM that returns the volumes of several iterations."""
        with naming("osem"):
            return Snapshots(self.A, self.subsets)

    def sample(
        self, counts: NDArray[np.float32], background: NDArray[np.float32], truth: NDArray[np.float32]
    ) -> Sample:
        """Return a batch of one scan: counts and background (M, n_v, n_u), and the truth (n_x, n_y, n_z) on the grid."""
        osem = self._osem(counts, background)
        scale = float(np.sqrt(np.mean(np.square(osem[len(osem) // 2])))) or 1.0
        arrays = (counts, background, osem / scale, scale, truth / scale)
        return Sample(*(torch.as_tensor(np.asarray(array, np.float32))[None] for array in arrays))

    def _osem(self, counts: NDArray[np.float32], background: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the OSEM volumes of a scan; those of the last scans are cached, since several networks may need them."""
        key, start = hashlib.sha256(counts.tobytes() + background.tobytes()).digest(), time.perf_counter()
        self.saved = self._scans[key][1] if key in self._scans else 0.0
        if key not in self._scans:
            volumes = self._snapshots(counts, self.after, background)
            self._scans[key] = volumes, time.perf_counter() - start
        volumes = self._scans[key][0]
        while len(self._scans) > max(1, _CACHE_BYTES // volumes.nbytes):
            del self._scans[next(iter(self._scans))]
        return volumes

    @cached_property
    def scanner(self) -> str:
        """SHA-256 of views and modules, rounded to 1e-6 mm or rad, to tell whether a model was trained for this scanner."""
        views, modules = self.A.views, self._modules.values().values()
        numbers = (views.sources, views.detector_centers, views.u_steps, views.v_steps)
        rounded = [np.round(a, 6) + 0.0 for a in (*numbers, *(a for a in modules if a.dtype.kind == "f"))]
        texts = [a.tolist() for a in modules if a.dtype.kind != "f"]
        return hashlib.sha256(b"".join(a.tobytes() for a in rounded) + repr((views.shape, texts)).encode()).hexdigest()

    @cached_property
    def physics(self) -> str:
        """Record of the projector's model as JSON."""
        return json.dumps(self.A.model.record(), sort_keys=True, default=str)
