"""Back-projections of a run's images: the job of ``mphdrr backproject``."""

from dataclasses import replace
from typing import Any

import numpy as np

from ..arrays import Floats, Floats32
from ..errors import InputError
from ..geometry.grid import Grid
from ..models.model import with_image_axes
from ..perspective.backprojection import HOW, backproject
from ..progress import Stages
from ..projector import Emission
from ..validation import instance, one_of
from ..volumes.volume import Volume
from .recipe import Recipe
from .reconstructing import line_integrals, recipe_of, reconstruction_grid
from .run import ProjectionRun
from .run_recipe import recipe_model


def backproject_run(
    run: ProjectionRun,
    how: str = "sum",
    recipe: Recipe | None = None,
    grid: Grid | None = None,
    stages: Stages = lambda stage: None,
) -> Volume:
    """Back-project the images of a run, as line integrals (`run_line_integrals`).

    Parameters
    ----------
    run : ProjectionRun
        Simulated or measured, with a recipe.
    how : str
        "sum", "product" (the geometric mean) or "minimum", the argument of `backproject`.
    recipe : Recipe
        Its voxels, ``reconstruction.voxels``, ``spacing`` and ``center``, are those of the volume; by default the run's own.
    grid : Grid
        Instead of these.
    stages
        Begins the stage: back-projecting.

    Returns
    -------
    Volume
        Its quantity is "backprojection", in the unit of line integrals: of counts kBq/mL mm, of radiographs none. Products
        and minima of images that reach beyond the crystals, where pixels count nothing, are refused.
    """
    one_of(how, HOW, "how")
    images = run_line_integrals(run)
    if how != "sum":
        _require_all_count(run)
        images = np.maximum(images, 0)
    if grid is None:
        grid = backprojection_grid(run, recipe)
    volume = backproject(images, run.views, grid, how, progress=stages("back-projecting"))
    assert isinstance(volume, Volume)
    return volume


def backprojection_grid(run: ProjectionRun, recipe: Recipe | None = None) -> Grid:
    """The voxels on which `backproject_run` is by default: those of a reconstruction."""
    return reconstruction_grid(run, recipe_of(run, recipe))


def run_line_integrals(run: ProjectionRun) -> Floats32:
    """The images of a run as line integrals along the pixels' rays, comparable from module to module.

    Counts, less the expected background, are divided by what each pixel counts of a line integral of 1 through the middle
    of an ideal hole: time, photons per decay, the hole's effective area, the pixel's size and its angle, the crystal's
    share. What does not belong to a single ray stays in them: the blur of hole and crystal, attenuation, and noise, so that
    some may be below 0. Of the counts of an ideal pinhole without attenuation, and of radiographs, the line integrals are
    exact.

    Parameters
    ----------
    run : ProjectionRun
        Simulated or measured, with a recipe.

    Returns
    -------
    array (M, n_v, n_u) of float32
        In kBq/mL mm of counts; of radiographs without unit, or the volume's times mm. 0 where a pixel counts nothing.
        Images of the model "inverse-square" are no line integrals, and refused.
    """
    instance(run, ProjectionRun, "run_line_integrals")
    recipe = run.recipe
    kind = recipe["model.kind"]
    if kind in ("transmission", "spectral"):
        return line_integrals(run, recipe)
    if kind != "emission":
        known = "transmission, spectral or emission"
        raise InputError(f"model.kind: the images of {kind} are no line integrals; expected {known}")
    background = run.background
    if isinstance(background, np.ndarray) and background.ndim == 1:
        background = background[:, None, None]
    weights = _pixel_weights(run)
    counts = run.projections - background
    return np.divide(counts, weights, out=np.zeros(counts.shape), where=weights > 0).astype(np.float32)


def _pixel_weights(run: ProjectionRun) -> Floats:
    """What pixels (M, n_v, n_u) count of a line integral of 1 along their rays through the middle of the hole."""
    model: Any = recipe_model(run.recipe, run.system, run=run)
    assert isinstance(model, Emission)
    middle = replace(model, hole="point", aperture_points=None, aperture_tolerance=None, pixel_points=1, depth_layers=1)
    anywhere = Grid.centered((1, 1, 1), 1.0)  # weights do not depend on it
    every = slice(None)
    return with_image_axes(model.efficiency) * np.array([
        sum(beam.weights(every, every, every).sum(axis=0) for beam in middle.beams(run.views, m, anywhere))  # type: ignore[misc]
        for m in range(len(run.views))
    ])  # fmt: skip


def _require_all_count(run: ProjectionRun) -> None:
    """Refuse images with pixels that count nothing: they would make products and minima 0."""
    if run.recipe["model.kind"] == "emission" and not _pixel_weights(run).all():
        raise InputError(
            "the images reach beyond the crystals or have dead pixels, which count nothing, and products and minima would "
            "be 0: take the sum, or project onto pixels that lie on the crystals"
        )
