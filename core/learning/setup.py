"""What a network is told of the scanner: exact operators of one geometry, grid and model."""

import hashlib
import json
import time
from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from ..errors import InputError, naming
from ..perspective.perspective_maps import PerspectiveMaps
from ..projector import Emission, Projector
from ..reconstruction.snapshots import Snapshots

_KEPT = 2**24
"""Bytes of the last scans' volumes by OSEM that are kept, besides those of one scan."""


class Sample(NamedTuple):
    """A batch of B scans by one scanner, as tensors. Volumes are in units of each scan's `scale`."""

    counts: torch.Tensor
    """Measured counts (B, M, n_v, n_u)."""
    background: torch.Tensor
    """Counts expected besides those of the volume, of the same shape."""
    osem: torch.Tensor
    """Volumes (B, S, n_x, n_y, n_z) by OSEM after `Setup.after` iterations, divided by `scale`."""
    scale: torch.Tensor
    """(B,): root mean square of the middle one of these volumes, such as kBq/mL."""
    truth: torch.Tensor
    """What is to be found (B, n_x, n_y, n_z), divided by `scale`; zeros where nobody knows it."""


class Setup:
    """Operators of one scanner, grid and model, made once and used for all scans by it.

    Parameters
    ----------
    A : Projector
        Of emission.
    subsets : int
        Of OSEM.
    after : sequence of int
        Iterations of OSEM whose volumes networks get.
    permuted : int, optional
        The poses are permuted among the modules by this seed: for the ablation that asks what true poses are worth.

    Attributes
    ----------
    A : Projector
    sensitivity : tensor (n_x, n_y, n_z)
        Counts that one unit of activity in each voxel gives.
    uniform : tensor (M, n_v, n_u)
        Counts of one unit of activity in all voxels.
    saved : float
        Seconds that the last sample would have taken more, had it not been made for another network before.
    """

    def __init__(self, A: Projector, subsets: int, after: Sequence[int] = (2, 8, 16), permuted: int | None = None):
        model = A.model
        if not isinstance(model, Emission):
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
        """See the class."""
        return self.A.T(torch.ones(self.A.shape_out))

    @cached_property
    def uniform(self) -> torch.Tensor:
        """See the class."""
        return self.A(torch.ones(self.A.shape_in))

    @cached_property
    def maps(self) -> PerspectiveMaps:
        """Maps between the grid and the coordinates (u, v, k) of each view."""
        return PerspectiveMaps(self.A.views, self.A.grid)

    @cached_property
    def _snapshots(self) -> Snapshots:
        with naming("osem"):
            return Snapshots(self.A, self.subsets)

    def sample(
        self, counts: NDArray[np.float32], background: NDArray[np.float32], truth: NDArray[np.float32]
    ) -> Sample:
        """A batch of one: counts and background (M, n_v, n_u), the truth (n_x, n_y, n_z) on the grid."""
        osem = self._osem(counts, background)
        scale = float(np.sqrt(np.mean(np.square(osem[len(osem) // 2])))) or 1.0
        arrays = (counts, background, osem / scale, scale, truth / scale)
        return Sample(*(torch.as_tensor(np.asarray(array, np.float32))[None] for array in arrays))

    def _osem(self, counts: NDArray[np.float32], background: NDArray[np.float32]) -> NDArray[np.float32]:
        """OSEM's volumes; those of the last scans are kept, since several networks may be asked for them."""
        key, begun = hashlib.sha256(counts.tobytes() + background.tobytes()).digest(), time.perf_counter()
        self.saved = self._scans[key][1] if key in self._scans else 0.0
        if key not in self._scans:
            volumes = self._snapshots(counts, self.after, background)
            self._scans[key] = volumes, time.perf_counter() - begun
        found = self._scans[key][0]
        while len(self._scans) > max(1, _KEPT // found.nbytes):
            del self._scans[next(iter(self._scans))]
        return found

    @cached_property
    def scanner(self) -> str:
        """SHA-256 of views and modules, numbers to 1e-6 mm or rad: what a model was trained for, and what it is told now."""
        views, modules = self.A.views, self._modules.values().values()
        numbers = (views.sources, views.detector_centers, views.u_steps, views.v_steps)
        told = [np.round(a, 6) + 0.0 for a in (*numbers, *(a for a in modules if a.dtype.kind == "f"))]
        texts = [a.tolist() for a in modules if a.dtype.kind != "f"]
        return hashlib.sha256(b"".join(a.tobytes() for a in told) + repr((views.shape, texts)).encode()).hexdigest()

    @cached_property
    def physics(self) -> str:
        """The model's record as JSON."""
        return json.dumps(self.A.model.record(), sort_keys=True, default=str)
