"""Back-projections of 80 views: sum, product and minimum beside scipy's interpolation, the fastest of some turns each.

    python benchmarks/perspective.py [--pixels 128] [--voxels 128 128 64] [--threads 2] [--turns 5]

scipy (`map_coordinates`, a view at a time, as the usual script does it) has one thread; it is left out where it is not
installed. Memory is the peak beyond images and result.
"""

import argparse
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from beside import tell

WORKBOOK = Path(__file__).parents[1] / "examples" / "dc-spect-80.xlsx"
SIDE = 150.0  # mm, of the volume


def scipys_sum(images: np.ndarray, views: Any, grid: Any) -> Callable[[], np.ndarray]:
    """Return the call that back-projects the sum over views with scipy."""
    from scipy.ndimage import map_coordinates

    def call() -> np.ndarray:
        index = np.indices(grid.shape, np.float32).reshape(3, -1)
        total = np.zeros(index.shape[1], np.float32)
        for image, matrix in zip(images, views.projection_matrices() @ grid.affine, strict=True):
            column, row, depth = matrix[:, :3] @ index + matrix[:, 3:]
            place = np.stack([row / depth, column / depth])
            sees = ((place >= -0.5) & (np.array(image.shape) - 0.5 >= place.T).T).all(axis=0) & (depth > 0)
            total += sees * map_coordinates(image, place, np.float32, order=1, mode="nearest")
        return total.reshape(grid.shape)

    return call


def main() -> None:
    """Print times and memory."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    for name, default in (("pixels", 128), ("threads", 2), ("turns", 5)):
        parser.add_argument(f"--{name}", type=int, default=default)
    parser.add_argument("--voxels", type=int, nargs=3, default=(128, 128, 64))
    chosen = parser.parse_args()
    import mphdrr.core as mph
    from mphdrr.core.rays.parallel import set_usual_threads

    set_usual_threads(chosen.threads)
    views = mph.read_system(WORKBOOK).views((chosen.pixels, chosen.pixels))
    grid = mph.Grid.centered(chosen.voxels, SIDE / np.array(chosen.voxels))
    images = np.random.default_rng(1).random((len(views), *views.shape), dtype=np.float32)
    calls: dict[str, Callable[[], Any]] = {
        how: lambda how=how: mph.backproject(images, views, grid, how).array for how in ("sum", "product", "minimum")
    }
    calls["views that see"] = lambda: mph.views_that_see(views, grid).array
    try:
        calls["sum by scipy"] = scipys_sum(images, views, grid)
    except ImportError as error:
        print(f"scipy is left out: {error}")
    results = {name: call() for name, call in calls.items()}
    best = dict.fromkeys(calls, np.inf)
    for _ in range(chosen.turns):
        for name, call in calls.items():
            begun = time.perf_counter()
            call()
            best[name] = min(best[name], time.perf_counter() - begun)
    for name, call in calls.items():
        tracemalloc.start()
        call()
        peak = tracemalloc.get_traced_memory()[1] / (4 * grid.n_voxels) - 1
        tracemalloc.stop()
        print(f"{name}: {best[name]:.3g} s; {peak:.2g} volumes beyond images and result")
    if "sum by scipy" in calls:
        work = f"back-projection, 80 views of {chosen.pixels}², {' x '.join(map(str, grid.shape))}"
        tell("perspective", work, best["sum"], "scipy", best["sum by scipy"], "scipy has one thread")
        apart = np.abs(results["sum by scipy"] - results["sum"]) / results["sum"].max()
        print(f"the sums differ by {np.quantile(apart, 0.999):.1g} of the largest, in all but 0.1 % of the voxels")


if __name__ == "__main__":
    main()
