"""Histories of photons, by the C kernels: collisions in a body, and what each module sees of them."""

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from ..arrays import Array, Floats, Floats32, Integers
from ..errors import InputError
from ..geometry.grid import Grid
from ..progress import Progress, tell
from ..rays.parallel import in_order, run_all
from ..volumes.volume import Volume
from .body import Body, coefficients, momentum_tables

_STEPS = (1 / 1.1347241384015194) ** np.arange(1, 6)  # 5 dimensions: powers of the root of x^6 = x + 1
_HISTORIES_AT_ONCE = 2048  # of a piece of work: its collisions are a MB


@dataclass(frozen=True, eq=False)
class PhotonSource:
    """Photons that begin in the voxels of a volume of activity, to all sides."""

    grid: Grid
    voxels: Integers
    """Indices (n, 3) of the voxels with activity, neighbours close to one another."""
    until: Floats
    """Shares (n,) of the photons up to each voxel."""
    photons: float
    """Photons per s of all voxels and lines."""
    lines: Floats
    """Energies, keV, and shares of the photons up to each line (2, n)."""

    @classmethod
    def of(cls, activity: Volume, lines: Sequence[tuple[float, float]]) -> "PhotonSource":
        """Return the source of a volume of activity, kBq/mL, and photon lines: energies, keV, and photons per decay."""
        values = activity.array.astype(np.float64)
        if values.min(initial=0.0) < 0:
            raise InputError(f"scatter: activity: expected 0 or more, got {values.min():g}")
        voxels = np.argwhere(values)
        bits = np.arange(max(activity.grid.shape).bit_length())
        interleaved = ((voxels[:, None, :] >> bits[:, None] & 1) << (3 * bits[:, None] + np.array([2, 1, 0]))).sum(
            axis=(1, 2)
        )
        voxels = voxels[np.argsort(interleaved)]  # G. M. Morton's order
        until = np.cumsum(values[tuple(voxels.T)])
        activity_sum = float(until[-1]) if len(until) else 0.0
        energies, photons = np.array(lines, np.float64).T
        total = activity_sum * activity.grid.voxel_volume * photons.sum()
        shares = np.cumsum(photons) / photons.sum()
        return cls(activity.grid, voxels, until / (activity_sum or 1.0), float(total), np.array([energies, shares]))

    def starts(self, first: int, end: int, seed: int, all_first: int) -> Array:
        """Return the photons from number `first` to `end` of those from `all_first` on, as `rays.backends.cpu.START`.

        Places, directions, energies and first collisions are `quasi_random`.
        """
        from ..rays.backends.cpu import START

        shares = quasi_random(first, end, seed, all_first)
        inside = np.random.default_rng([seed, first, 2]).random((end - first, 3)) - 0.5
        if not len(self.voxels):
            return np.empty(0, START)
        voxels = self.voxels[np.minimum(np.searchsorted(self.until, shares[:, 0], side="right"), len(self.voxels) - 1)]
        starts = np.empty(end - first, START)
        affine = self.grid.affine
        starts["place"] = (voxels + inside) @ affine[:3, :3].T + affine[:3, 3]
        cosine, azimuth = 2 * shares[:, 1] - 1, 2 * np.pi * shares[:, 2]
        sine = np.sqrt(1 - cosine**2)
        starts["direction"] = np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), cosine], axis=-1)
        energies, until = self.lines
        starts["energy"] = energies[np.minimum(np.searchsorted(until, shares[:, 4], side="right"), len(energies) - 1)]
        starts["collides_at"] = shares[:, 3]
        starts["weight"] = 1.0
        return starts


def quasi_random(first: int, end: int, seed: int, all_first: int) -> Floats:
    """Return points (n, 5), numbers above 0 and below 1, for the photons from `first` to `end` of those from `all_first` on.

    They are points of a Kronecker sequence that `seed` and `all_first` shift at random, so that each set of them is an
    unbiased sample of its own.
    """
    shift = np.random.default_rng([seed, all_first, 1]).random(len(_STEPS))
    points = (np.arange(first - all_first, end - all_first)[:, None] * _STEPS + shift) % 1
    return np.clip(points, 1e-12, 1 - 1e-12)


class Beginnings(Protocol):
    """Photons that begin, such as those of a `PhotonSource`."""

    def starts(self, first: int, end: int, seed: int, all_first: int) -> Array:
        """Return the photons from number `first` to `end` of those from `all_first` on, as `rays.backends.cpu.START`."""


class Histories:
    """Histories of the photons of a source in a body, and what modules or a panel see of them.

    Parameters
    ----------
    body, source
        Where photons scatter, and where they begin.
    modules : array (M,)
        Holes and what they see, of the type `rays.backends.cpu.MODULE`; or one panel, of the type `PANEL` there.
    energies : array (n,)
        Evenly spaced energies, keV, of the tables; photons below the first are not followed.
    accepted : array (M, W, n)
        Shares of the photons of these energies that are counted in each window.
    cell_of, cells
        Numbers of the cells of the body's voxels, and of all cells; of a panel its bins are the cells.
    orders : int
        Number of orders of scattering that are kept apart; the last has all from it on.
    seed, threads : int
        Seed of the random numbers, and number of threads. Results do not depend on the threads.
    spectra : bool
        Whether to keep the spectra of the photons that pass the holes.
    """

    def __init__(
        self,
        body: Body,
        source: Beginnings,
        modules: Array,
        energies: Floats,
        accepted: Floats32,
        cell_of: Array,
        cells: int,
        orders: int,
        seed: int,
        threads: int,
        spectra: bool,
    ) -> None:
        self._kernels, self._threads = _kernels(), threads
        self._source = source
        self.seen = np.zeros((orders, accepted.shape[1], cells, len(modules)), np.float32)
        self.totals = np.zeros((accepted.shape[1], len(modules)))  # photons that pass the holes and are counted
        self.spectra = np.zeros((len(modules), len(energies))) if spectra else None
        self.followed = 0
        tables = momentum_tables()
        to_index = body.grid.index_from_world[:3].copy()
        to_index[:, 3] += 0.5  # voxel i fills [i, i + 1)
        self._arrays = [
            body.densities, coefficients(energies), tables.incoherent, tables.coherent, tables.coherent_until,
            modules, np.ascontiguousarray(accepted, np.float32), _worth(accepted, spectra),
            np.ascontiguousarray(cell_of, np.int32), self.seen, self.totals,
        ]  # fmt: skip  # they live as long as the jobs that point at them
        names = (
            *("body", "coefficients", "incoherent", "coherent", "coherent_until"),
            *(
                "panel" if modules.dtype == self._kernels.PANEL else "holes",
                "accepted",
                "worth",
                "cell_of",
                "seen",
                "totals",
            ),
        )
        numbers = {name: array.ctypes.data for name, array in zip(names, self._arrays, strict=True)}
        step = float(energies[1] - energies[0])
        self._settings: dict[str, Any] = numbers | {
            "n": body.grid.shape, "index_from_world": tuple(to_index.ravel()), "energies": len(energies),
            "lowest": float(energies[0]), "energies_per_kev": 1 / step, "momenta": tables.incoherent.shape[1],
            "momenta_per_root": tables.per_root, "seed": seed,
            "modules": len(modules), "windows": accepted.shape[1], "orders": orders, "cells": cells,
            "spectra": None if self.spectra is None else self.spectra.ctypes.data,
        }  # fmt: skip

    def run(self, count: int, progress: Progress | None = None) -> None:
        """Compute so many further histories, and add what the modules see of their collisions to `seen`."""
        first, end = self.followed, self.followed + count
        pieces = [(a, min(a + _HISTORIES_AT_ONCE, end)) for a in range(first, end, _HISTORIES_AT_ONCE)]
        modules = self._settings["modules"]
        size = -(-modules // self._threads)
        parts = [(a, min(a + size, modules)) for a in range(0, modules, size)]
        jobs = in_order(lambda piece: self._follow(*piece, first), pieces, self._threads)
        for n_done, collisions in enumerate(jobs, 1):
            for job in collisions:
                run_all(lambda part, job=job: self._see(job, *part), parts, self._threads)  # type: ignore[misc]
            tell(progress, n_done, len(pieces))
        self.followed = end

    def collisions(self, count: int) -> Array:
        """Return the collisions of so many further histories, of the type `rays.backends.cpu.COLLISION`."""
        first, self.followed = self.followed, self.followed + count
        jobs = self._follow(first, self.followed, first)
        return np.concatenate([arrays[0][: arrays[1][1]] for _, arrays in jobs])

    def _follow(self, first: int, end: int, all_first: int) -> list[tuple[Any, tuple[Array, ...]]]:
        """Return the collisions of the histories from `first` to `end`, as jobs for `_see` with their arrays."""
        jobs: list[tuple[Any, tuple[Array, ...]]] = []
        starts = self._source.starts(first, end, self._settings["seed"], all_first)
        end = first + len(starts)  # none where nothing is active
        begins = first
        while first < end:
            collisions = np.empty(3 * (end - first) + self._kernels.MOST_COLLISIONS, self._kernels.COLLISION)
            numbers = np.zeros(2, np.int64)
            followed, n_collisions = (numbers[i:].ctypes.data for i in (0, 1))
            job = self._kernels.PhotonJob(
                **self._settings, all_first=begins, first=first, last=end, starts=starts.ctypes.data,
                collisions=collisions.ctypes.data, capacity=len(collisions), followed=followed, n_collisions=n_collisions,
            )  # fmt: skip
            self._kernels.library.follow(self._kernels.level, ctypes.byref(job))
            first = int(numbers[0])
            jobs.append((job, (collisions, numbers, starts)))
        return jobs

    def _see(self, job_with_arrays: tuple[Any, Any], first: int, end: int) -> None:
        """Add what the modules from `first` to `end` see of the collisions."""
        job = self._kernels.PhotonJob.from_buffer_copy(job_with_arrays[0])
        job.first_module, job.last_module = first, end
        see = self._kernels.library.see_panel if job.panel else self._kernels.library.see
        see(self._kernels.level, ctypes.byref(job))


def _worth(accepted: Floats32, spectra: bool) -> Floats32:
    """Return how much photons (M, n) matter: the largest share that is counted at their energy or at its neighbours."""
    largest = np.ones_like(accepted[:, 0]) if spectra else accepted.max(axis=1)
    edges = np.pad(largest, ((0, 0), (1, 1)), "edge")
    return np.ascontiguousarray(np.maximum(np.maximum(edges[:, :-2], edges[:, 2:]), largest), np.float32)


def _kernels() -> Any:
    """Return the binding of the C kernels; raise `InputError` where there are none."""
    try:
        from ..rays.backends import cpu
    except ImportError as error:
        raise InputError(f"scatter needs the compiled kernels: {error}") from error
    return cpu
