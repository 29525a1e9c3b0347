"""Execution of rays: images cut into the tasks that a backend takes at once, on several threads."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..arrays import Array, ArrayOrTensor, Floats, cast_like, to_caller, zeros
from ..geometry.grid import Grid
from ..memory import available
from . import ray_gradients
from .backends import Backend
from .bundles import Batch, Bundles
from .lattices import Lattices, filled_lattices
from .parallel import in_order, run_all, sum_volumes
from .ray_geometry import Attenuation, Rays, window

# Smallest number of rays of a task: to start a task takes as long as tracing these.
_FEWEST_RAYS = 2**12
# Largest number of rays of a task: between tasks a job can stop.
_MOST_RAYS = 2**18
# Rays that the threads of a backprojection trace before they wait for each other.
_RAYS_OF_A_ROUND = 2**19
# Threads of a backprojection, each with a volume of its own: more would gain little and take much memory.
_MOST_VOLUMES = 8
# Time, in steps along rays for each voxel, of finding and copying the filled part of a volume.
_STEPS_OF_A_VOXEL = 4

Add = Callable[[ArrayOrTensor, ArrayOrTensor, Rays, Attenuation | None], None]
"""Function that adds values to a volume along rays: ``add(volume, values, rays, attenuation)``."""
Report = Callable[[int], None]
"""Function that is called with the number of images that are done."""


@dataclass(eq=False)
class _Task:
    """Several whole images, or a block of one image."""

    images: range
    """Numbers of the images."""
    block: tuple[slice, slice] | None = None
    """Rows and columns of the block; None for whole images."""
    is_last: bool = True
    """Whether the images are complete with this task."""
    result: ArrayOrTensor = None
    """Images that the task adds to."""


@dataclass(frozen=True, eq=False)
class Execution:
    """A backend at work on the rays through one volume; nothing is checked."""

    backend: Backend
    """Backend that traces the rays."""
    grid: Grid
    """Grid of the volume."""
    mu_grid: Grid | None = None
    """Grid of mu; None if it is the volume's."""
    float64: bool = False
    """Whether arrays are float64, not float32."""
    threads: int = 1
    """Number of threads that call a backend without threads of its own."""
    whole_for_few: bool = False
    """Whether few rays go through the whole volume; without it a view's rounding does not depend on the other views."""

    def images(self, volume: ArrayOrTensor, bundles: Bundles, mu: ArrayOrTensor = None) -> Iterator[ArrayOrTensor]:
        """Yield the images one by one, as the backend computes them: line integrals, value x mm, weighted and summed."""
        lattices = self._lattices(volume, mu, bundles)
        forward = self.backend.functions.forward

        def run(task: _Task) -> _Task:
            """Add the integrals of a task's rays to its result, and return the task."""
            for batch in self._batches(task, bundles):
                integrals = forward(lattices.volume, *batch.in_index_space(lattices))
                batch.add_to(task.result, task.images.start, integrals)
            return task

        def tasks() -> Iterator[_Task]:
            """Yield the tasks; those of the same images share one array for the result."""
            result = None
            for task in self._tasks(bundles, lattices, self.workers):
                if result is None:
                    result = zeros((len(task.images), *bundles.image_shape), lattices.volume)
                task.result = result
                if task.is_last:
                    result = None
                yield task

        for task in in_order(run, tasks(), self.workers):
            if task.is_last:
                yield from task.result

    def derivatives(
        self, volume: ArrayOrTensor, bundles: Bundles, mu: ArrayOrTensor, images: Array
    ) -> list[tuple[Batch, Floats]]:
        """Return the backend's derivatives (7 or 14, rays) of each batch of rays; add the integrals to `images`."""
        lattices = self._lattices(volume, mu, bundles)
        derivatives = self.backend.functions.derivatives

        def run(task: _Task) -> list[tuple[Batch, Floats]]:
            """Return the batches of a task with their derivatives, and add their integrals to the images."""
            results = []
            for batch in self._batches(task, bundles):
                rows = to_caller(derivatives(lattices.volume, *batch.in_index_space(lattices)), np.empty(0)).T
                batch.add_to(images, 0, ray_gradients.integrals(batch, rows))
                results.append((batch, rows))
            return results

        tasks = self._tasks(bundles, lattices, self.workers)
        return [result for results in in_order(run, tasks, self.workers) for result in results]

    def backproject(
        self, images: ArrayOrTensor, bundles: Bundles, mu: ArrayOrTensor = None, report: Report | None = None
    ) -> ArrayOrTensor:
        """Return the volume, as the backend computes it, of `images` back-projected along their rays, the adjoint.

        ``report(n)`` is called when n images are done.
        """
        images = self.to_backend(images)
        add: Add = self.backend.functions.backproject
        lattices = filled_lattices(self.grid, None, None if mu is None else cast_like(mu, images), self.mu_grid)
        return self._accumulated(add, self.grid, images, bundles, lattices, report)

    def mu_gradient(
        self, images: ArrayOrTensor, bundles: Bundles, volume: ArrayOrTensor, mu: ArrayOrTensor
    ) -> ArrayOrTensor:
        """Return the gradient by mu of the sum of `images` times the projections of `volume`, as the backend computes it."""
        images, lattices = self.to_backend(images), self._lattices(volume, mu, bundles, whole_mu=True)
        add_gradient = self.backend.functions.mu_gradient

        def add(gradient: ArrayOrTensor, *values_and_rays: Any) -> None:
            """Add the gradient by mu of a batch of rays to `gradient`."""
            add_gradient(gradient, lattices.volume, *values_and_rays)

        return self._accumulated(add, self.mu_grid or self.grid, images, bundles, lattices, None)

    def _accumulated(
        self, add: Add, grid: Grid, images: ArrayOrTensor, bundles: Bundles, lattices: Lattices, report: Report | None
    ) -> ArrayOrTensor:
        """Return a volume on `grid` with all that `add` adds for the rays of the images."""
        workers = min(self.workers, _MOST_VOLUMES, max(1, available() // (2 * images.itemsize * grid.n_voxels)))
        volumes = list(in_order(lambda _: zeros(grid.shape, images), range(workers), workers))
        for tasks in self._rounds(bundles, lattices, workers):

            def work(worker: int, tasks: list[_Task] = tasks) -> None:
                """Add the batches of every `workers`-th task to the volume of this worker."""
                # A volume gets the same batches in the same order each time, so the result is the same each time.
                for task in tasks[worker::workers]:
                    for batch in self._batches(task, bundles):
                        add(volumes[worker], batch.values(images), *batch.in_index_space(lattices))

            run_all(work, range(workers), workers)
            if report is not None:
                for task in tasks:
                    for number in task.images if task.is_last else ():
                        report(number + 1)
        return sum_volumes(volumes, workers)

    def _rounds(self, bundles: Bundles, lattices: Lattices, workers: int) -> Iterator[list[_Task]]:
        """Yield lists of tasks after which the threads wait for each other: seldom, but often enough to report progress."""
        tasks: list[_Task] = []
        rays = 0
        for task in self._tasks(bundles, lattices, workers):
            tasks.append(task)
            rays += sum(bundles[number].n_rays(task.block) for number in task.images)
            if rays >= _RAYS_OF_A_ROUND and len(tasks) >= workers:
                yield tasks
                tasks, rays = [], 0
        if tasks:
            yield tasks

    def _tasks(self, bundles: Bundles, lattices: Lattices, workers: int) -> Iterator[_Task]:
        """Yield the tasks of all images, in order: of several small images, or of a block of rows of a large one."""
        n = len(bundles)
        at_once = self._images_at_once(bundles) if n else 1
        corners = lattices.corners()
        for first in range(0, n, at_once):
            if at_once > 1:
                yield _Task(range(first, min(first + at_once, n)))
                continue
            bundle = bundles[first]
            rows, columns = (slice(0, size) for size in bundle.shape)
            if bundle.ends is None:
                rows, columns = window([beam.rays for beam in bundle.beams], corners)
            width = columns.stop - columns.start
            pixels = (rows.stop - rows.start) * width
            # Blocks are as large as the cache allows, but there are enough for all threads, and none takes long.
            shared = max(pixels // -(-2 * workers // n), _FEWEST_RAYS // bundle.rays_of_a_pixel)
            limit = min(self.backend.rays_at_once, _MOST_RAYS // bundle.rays_of_a_pixel)
            size = max(1, min(shared, limit) // max(1, width))
            for row in range(rows.start, max(rows.stop, rows.start + 1), size):
                end = min(row + size, rows.stop)
                yield _Task(range(first, first + 1), (slice(row, end), columns), end == rows.stop)

    def _images_at_once(self, bundles: Bundles) -> int:
        """Return the number of small images that are traced in one call, 1 for large ones."""
        if bundles[0].ends is not None:
            return 1
        n, rays = len(bundles), max(1, bundles[0].n_rays())
        enough = max(_FEWEST_RAYS // rays, n // (2 * self.workers))
        return max(1, min(self.backend.rays_of_images // rays, enough))

    def _batches(self, task: _Task, bundles: Bundles) -> Iterable[Batch]:
        """Return the rays of a task in batches, each of as many as the backend takes at once."""
        return bundles.batches(task.images, task.block, self.backend.rays_at_once)

    def _lattices(self, volume: ArrayOrTensor, mu: ArrayOrTensor, bundles: Bundles, whole_mu: bool = False) -> Lattices:
        """Return the filled parts of volume and mu, as the backend computes with them; for few rays the whole volume."""
        volume = self.to_backend(volume)
        if self.whole_for_few and mu is None and len(bundles) > 0:
            steps = sum(self.grid.shape) * bundles[0].n_rays() * len(bundles)
            if steps < _STEPS_OF_A_VOXEL * self.grid.n_voxels:
                return Lattices(self.grid, volume)
        mu = None if mu is None else cast_like(mu, volume)
        return filled_lattices(self.grid, volume, mu, self.mu_grid, whole_mu)

    def to_backend(self, x: ArrayOrTensor) -> ArrayOrTensor:
        """Return `x` as an array or tensor that the backend computes with."""
        return self.backend.to_backend(x, self.float64)

    @property
    def workers(self) -> int:
        """Number of threads that call the backend."""
        return self.backend.workers(self.threads)
