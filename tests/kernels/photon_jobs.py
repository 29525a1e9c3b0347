"""Jobs of photons that scatter in small bodies: at borders, along axes, with modules inside, with nothing to meet."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from mphdrr.core.geometry.grid import Grid
from mphdrr.core.rays.backends.cpu import MODULE, MOST_COLLISIONS, START, PhotonJob
from mphdrr.core.scatter.body import Body
from mphdrr.core.scatter.histories import Histories, PhotonSource
from mphdrr.core.volumes.volume import Volume

from .jobs import Array, Made, Read, packed

JOBS, PHOTONS = 300, 60
_ENERGIES = np.linspace(30.0, 150.0, 16)


def photon_jobs() -> Iterator[Made]:
    """Yield jobs, of which nearly all must give the sums of the kernels that Python calls.

    Rounding sends a photon that just meets something elsewhere, now and then.
    """
    rng, alike = np.random.default_rng(22), []
    for number in range(JOBS):
        yield _job(rng, number, alike)


def _starts(rng: np.random.Generator, size: Array) -> Array:
    """Return photons from places in, on and outside a box of this size, some of them along axes and within faces."""
    starts = np.zeros(PHOTONS, START)
    place = rng.uniform(-0.8, 0.8, (PHOTONS, 3)) * size
    starts["place"] = np.where(rng.random((PHOTONS, 3)) < 0.3, rng.choice([-0.5, 0.0, 0.5], (PHOTONS, 3)) * size, place)
    direction = rng.normal(size=(PHOTONS, 3)) * (rng.random((PHOTONS, 3)) < 0.7)
    direction[~direction.any(axis=1)] = [0.0, 0.0, 1.0]
    starts["direction"] = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    starts["energy"] = rng.choice([30.0, 60.0, 140.5, 150.0], PHOTONS)
    starts["collides_at"] = rng.choice([1e-12, 1e-6, 0.5, 1 - 1e-12], PHOTONS)
    starts["weight"] = rng.choice([0.5, 1.0, 2.0], PHOTONS)
    return starts


def _modules(rng: np.random.Generator, size: Array) -> Array:
    """Return modules around and in the body that see much, a little or nothing."""
    modules = np.zeros(rng.integers(1, 4), MODULE)
    for module in modules:
        u, v, axis = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        slope = rng.choice([0.0, 0.2, 3.0])
        place = -axis * rng.choice([0.0, 1.0, 3.0]) * size.max()
        module["hole"], module["u"], module["v"], module["axis"] = place, u, v, axis
        module["slopes"], module["margin"], module["area"] = (-slope, slope, -slope, slope), 1.0, 1.0
        module["least"] = rng.choice([0.0, 1e-6])
    return modules


def _job(rng: np.random.Generator, number: int, alike: list[bool]) -> Made:
    shape = tuple(int(n) for n in rng.integers(1, rng.choice([2, 4, 9]), 3, endpoint=True))
    grid = Grid.centered(shape, float(rng.choice([0.1, 5.0, 80.0])))
    mu = rng.choice([0.0, 0.005, 0.0153, 0.03], shape) * (rng.random(shape) < 0.8)
    mu.flat[0] = mu.flat[-1] = 0.0153  # keeps the grid
    body = Body.of(Volume(mu.astype(np.float32), grid, "mu"), 140.5)
    modules, windows, orders = (
        _modules(rng, np.array(shape) * grid.spacing),
        int(rng.integers(1, 3)),
        int(rng.integers(1, 3)),
    )
    accepted = rng.random((len(modules), windows, len(_ENERGIES))).astype(np.float32)
    cells = int(rng.integers(1, 5))
    cell_of = rng.integers(0, cells, shape).astype(np.int32)
    nothing = PhotonSource.of(
        Volume(np.zeros((1, 1, 1), np.float32), Grid.centered(1, 1.0), "activity"), [(150.0, 1.0)]
    )
    histories = Histories(
        body, nothing, modules, _ENERGIES, accepted, cell_of, cells, orders, number, 1, bool(number % 2)
    )  # fmt: skip
    starts, numbers = _starts(rng, np.array(shape) * grid.spacing), np.zeros(2, np.int64)
    job = PhotonJob(
        **histories._settings, all_first=0, first=0, last=PHOTONS, starts=starts.ctypes.data, last_module=len(modules),
        followed=numbers.ctypes.data, n_collisions=numbers[1:].ctypes.data,
        capacity=int(rng.choice([MOST_COLLISIONS, MOST_COLLISIONS + 1, 2000])),
    )  # fmt: skip
    densities, *tables, _, shares, worth, cells_of, _, _ = histories._arrays
    data = packed("photons", number // 6, job, densities, *tables, starts, modules, shares, worth, cells_of)
    collisions, total = _computed(histories, job)

    def check(read: Read) -> None:
        counted = int(read(np.int64, (1,))[0])
        seen = read(np.float32, histories.seen.shape)
        assert np.isfinite(seen).all() and (seen >= 0).all()
        assert abs(counted - collisions) <= 8 + 0.1 * collisions
        alike.append(counted == collisions and abs(seen.sum(dtype=float) - total) <= 1e-3 * total)
        if number == JOBS - 1:
            share = np.mean(alike)
            alike.clear()
            assert share > 0.8

    return Made(data, check)


def _computed(histories: Histories, job: PhotonJob) -> tuple[int, float]:
    """Return the number of a job's collisions, and the sum of what is seen, as Python's library computes them."""
    from mphdrr.core.rays.backends.cpu import COLLISION, level, library

    collisions = np.empty(job.capacity, COLLISION)
    job.collisions, count = collisions.ctypes.data, 0
    numbers = np.zeros(2, np.int64)
    job.followed, job.n_collisions = numbers.ctypes.data, numbers[1:].ctypes.data
    while job.first < job.last:
        library.follow(level, job)
        library.see(level, job)
        job.first, count = int(numbers[0]), count + int(numbers[1])
    return count, float(histories.seen.sum(dtype=float))
