"""The one driver of rays: cuts images into what a backend takes at once, and runs it on several threads."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..arrays import Array, ArrayOrTensor, Floats, cast_like, to_caller, zeros
from ..geometry.grid import Grid
from ..memory import available
from . import ray_gradients
from .backends import Backend
from .bundles import Bundles, Part
from .lattices import Lattices, filled_lattices
from .parallel import in_order, run_all, sum_of
from .ray_geometry import Attenuation, Rays, window

# Rays of a task: with fewer, starting it takes longer than tracing them.
_FEWEST_RAYS = 2**12

# Rays of a task: between tasks a job can stop.
_MOST_RAYS = 2**18

# Rays that the threads of a backprojection trace before they wait for each other.
_RAYS_OF_A_ROUND = 2**19

# Threads of a backprojection, each with a volume of its own: more would gain little and take much memory.
_MOST_VOLUMES = 8

# Finding the filled part of a volume, and copying it, takes the time of so many steps along rays for each voxel.
_STEPS_OF_A_VOXEL = 4

# Adds values to a volume along rays: ``add(volume, values, rays, attenuation)``.
Add = Callable[[ArrayOrTensor, ArrayOrTensor, Rays, Attenuation | None], None]
Report = Callable[[int], None]


@dataclass(eq=False)
class _Task:
    """Several whole images, or a block of one: some rows and columns, the `last` ones or not."""

    images: range
    block: tuple[slice, slice] | None = None
    last: bool = True
    result: ArrayOrTensor = None


@dataclass(frozen=True, eq=False)
class Execution:
    """A backend at work on the rays through one volume; nothing is checked."""

    backend: Backend
    grid: Grid  # the volume's voxels
    mu_grid: Grid | None = None  # the voxels of mu, where that has its own
    float64: bool = False  # whether arrays are float64, not float32
    threads: int = 1  # on which a backend without threads of its own is called
    # whether few rays are traced through the whole volume; if not, a view's rounding is the same beside whatever others
    whole_for_few: bool = False

    def images(self, volume: ArrayOrTensor, bundles: Bundles, mu: ArrayOrTensor = None) -> Iterator[ArrayOrTensor]:
        """The images one by one, as the backend computes them: integrals, value x mm, weighted and summed."""
        lattices = self._lattices(volume, mu, bundles)
        forward = self.backend.functions.forward

        def run(task: _Task) -> _Task:
            for part in self._parts(task, bundles):
                integrals = forward(lattices.volume, *part.in_index_space(lattices))
                part.add_to(task.result, task.images.start, integrals)
            return task

        def tasks() -> Iterator[_Task]:
            result = None
            for task in self._tasks(bundles, lattices, self.workers):
                if result is None:
                    result = zeros((len(task.images), *bundles.image_shape), lattices.volume)
                task.result = result
                if task.last:
                    result = None
                yield task

        for task in in_order(run, tasks(), self.workers):
            if task.last:
                yield from task.result

    def derivatives(
        self, volume: ArrayOrTensor, bundles: Bundles, mu: ArrayOrTensor, images: Array
    ) -> list[tuple[Part, Floats]]:
        """The backend's derivatives, part by part, (7 or 14, rays); the integrals are added to `images`."""
        lattices = self._lattices(volume, mu, bundles)
        derivatives = self.backend.functions.derivatives

        def run(task: _Task) -> list[tuple[Part, Floats]]:
            results = []
            for part in self._parts(task, bundles):
                own = to_caller(derivatives(lattices.volume, *part.in_index_space(lattices)), np.empty(0)).T
                part.add_to(images, 0, ray_gradients.integrals(part, own))
                results.append((part, own))
            return results

        tasks = self._tasks(bundles, lattices, self.workers)
        return [result for results in in_order(run, tasks, self.workers) for result in results]

    def backproject(
        self, images: ArrayOrTensor, bundles: Bundles, mu: ArrayOrTensor = None, report: Report | None = None
    ) -> ArrayOrTensor:
        """`images` carried back along their rays, with the weights of `images`, into a volume as the backend computes it.

        ``report(n)`` is called when n images are done.
        """
        images = self.to_backend(images)
        add: Add = self.backend.functions.backproject
        lattices = filled_lattices(self.grid, None, None if mu is None else cast_like(mu, images), self.mu_grid)
        return self._accumulated(add, self.grid, images, bundles, lattices, report)

    def mu_gradient(
        self, images: ArrayOrTensor, bundles: Bundles, volume: ArrayOrTensor, mu: ArrayOrTensor
    ) -> ArrayOrTensor:
        """The gradient by mu of the sum of `images` times the projections of `volume`, as the backend computes it."""
        images, lattices = self.to_backend(images), self._lattices(volume, mu, bundles, whole_mu=True)
        gradient_of = self.backend.functions.mu_gradient

        def add(gradient: ArrayOrTensor, *values_and_rays: Any) -> None:
            gradient_of(gradient, lattices.volume, *values_and_rays)

        return self._accumulated(add, self.mu_grid or self.grid, images, bundles, lattices)

    def _accumulated(
        self,
        add: Add,
        grid: Grid,
        images: ArrayOrTensor,
        bundles: Bundles,
        lattices: Lattices,
        report: Report | None = None,
    ) -> ArrayOrTensor:
        """What `add` adds to a volume on `grid` for all rays of the images."""
        workers = min(self.workers, _MOST_VOLUMES, max(1, available() // (2 * images.itemsize * grid.n_voxels)))
        volumes = list(in_order(lambda _: zeros(grid.shape, images), range(workers), workers))
        for tasks in self._rounds(bundles, lattices, workers):

            def work(worker: int, tasks: list[_Task] = tasks) -> None:
                # A volume always gets the same parts in the same order, so the result is always the same.
                for task in tasks[worker::workers]:
                    for part in self._parts(task, bundles):
                        add(volumes[worker], part.values(images), *part.in_index_space(lattices))

            run_all(work, range(workers), workers)
            if report is not None:
                for task in tasks:
                    for number in task.images if task.last else ():
                        report(number + 1)
        return sum_of(volumes, workers)

    def _rounds(self, bundles: Bundles, lattices: Lattices, workers: int) -> Iterator[list[_Task]]:
        """Tasks after which the threads wait for each other: seldom, but often enough to say how far the work is."""
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
        """All images, in order: small ones several at once, large ones in blocks of rows."""
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
            # Blocks as large as the cache allows, but enough of them for all threads, and none that takes long.
            enough = max(pixels // -(-2 * workers // n), _FEWEST_RAYS // bundle.rays_of_a_pixel)
            most = min(self.backend.rays_at_once, _MOST_RAYS // bundle.rays_of_a_pixel)
            size = max(1, min(enough, most) // max(1, width))
            for row in range(rows.start, max(rows.stop, rows.start + 1), size):
                end = min(row + size, rows.stop)
                yield _Task(range(first, first + 1), (slice(row, end), columns), end == rows.stop)

    def _images_at_once(self, bundles: Bundles) -> int:
        """How many small images are traced in one call; 1 for large ones."""
        if bundles[0].ends is not None:
            return 1
        n, rays = len(bundles), max(1, bundles[0].n_rays())
        wanted = max(_FEWEST_RAYS // rays, n // (2 * self.workers))
        return max(1, min(self.backend.rays_of_images // rays, wanted))

    def _parts(self, task: _Task, bundles: Bundles) -> Iterable[Part]:
        """The rays of a task, as many at once as the backend takes."""
        return bundles.parts(task.images, task.block, self.backend.rays_at_once)

    def _lattices(self, volume: ArrayOrTensor, mu: ArrayOrTensor, bundles: Bundles, whole_mu: bool = False) -> Lattices:
        """The filled parts of volume and mu, as the backend computes with them, or the whole volume."""
        volume = self.to_backend(volume)
        maybe_few, longest = self.whole_for_few and mu is None and len(bundles) > 0, sum(self.grid.shape)
        if maybe_few and longest * bundles[0].n_rays() * len(bundles) < _STEPS_OF_A_VOXEL * self.grid.n_voxels:
            return Lattices(self.grid, volume)
        mu = None if mu is None else cast_like(mu, volume)
        return filled_lattices(self.grid, volume, mu, self.mu_grid, whole_mu)

    def to_backend(self, x: ArrayOrTensor) -> ArrayOrTensor:
        """`x` as the backend computes with it."""
        return self.backend.to_backend(x, self.float64)

    @property
    def workers(self) -> int:
        """On how many threads the backend is called."""
        return self.backend.workers(self.threads)
