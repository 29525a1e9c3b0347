"""Back-projections of a run's images, for ``mphdrr backproject`` and Blender's panel."""

from typing import Any

import numpy as np

from ..arrays import Floats, Floats32
from ..errors import InputError
from ..geometry.grid import Grid
from ..models.model import with_image_axes
from ..perspective.backprojection import HOW, backproject
from ..progress import Stages
from ..validation import instance, one_of
from ..volumes.volume import Volume
from .recipe import Recipe
from .reconstructing import line_integrals, reconstruction_grid, reconstruction_recipe
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
        Simulated or measured run with a recipe.
    how : str
        "sum", "product" (the geometric mean) or "minimum", see `backproject`.
    recipe : Recipe
        Recipe with the volume's voxels: ``reconstruction.voxels``, ``spacing`` and ``center``; by default the run's own.
    grid : Grid
        Grid of the volume, in place of the recipe's.
    stages
        Function that begins the stage "back-projecting".

    Returns
    -------
    Volume
        Volume of the quantity "backprojection", in the unit of line integrals: kBq/mL mm from counts, none from radiographs.

    Raises
    ------
    InputError
        A product or minimum of images with pixels that detect nothing, such as pixels beside the crystals, is asked for.
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
    """Return the default grid of `backproject_run`, that of a reconstruction of the run."""
    return reconstruction_grid(run, reconstruction_recipe(run, recipe))


def run_line_integrals(run: ProjectionRun) -> Floats32:
    """Return the images of a run as line integrals along the pixels' rays, comparable from module to module.

    Counts minus the expected background are divided by the pixel weight: the expected counts per unit line integral through
    the centre of an ideal hole, from acquisition time, photons per decay, the hole's effective area, the pixel's size and
    angle, and the crystal's absorption. Effects that no single ray has remain: the blur of hole and crystal, attenuation,
    and noise, which may make line integrals negative. Line integrals of radiographs, and of counts through an ideal pinhole
    without attenuation, are exact.

    Parameters
    ----------
    run : ProjectionRun
        Simulated or measured run with a recipe.

    Returns
    -------
    array (M, n_v, n_u) of float32
        Line integrals, kBq/mL mm from counts; from radiographs without a unit, or in the volume's unit times mm. They are 0
        at pixels that detect nothing.

    Raises
    ------
    InputError
        The model is "inverse-square", whose images are no line integrals.
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
    """Return the pixel weights (M, n_v, n_u): expected counts per unit line integral through the hole's centre."""
    model: Any = recipe_model(run.recipe, run.system, run=run)
    point_model = model.without_blur()
    any_grid = Grid.centered((1, 1, 1), 1.0)  # the weights do not depend on the grid
    every = slice(None)  # every layer, row and column
    return with_image_axes(model.efficiency) * np.array([
        sum(beam.weights(every, every, every).sum(axis=0) for beam in point_model.beams(run.views, m, any_grid))  # type: ignore[misc]
        for m in range(len(run.views))
    ])  # fmt: skip


def _require_all_count(run: ProjectionRun) -> None:
    """Raise `InputError` for images with pixels that detect nothing, which would make products and minima 0."""
    if run.recipe["model.kind"] == "emission" and not _pixel_weights(run).all():
        raise InputError(
            "the images reach beyond the crystals or have dead pixels, which count nothing, and products and minima would "
            "be 0: take the sum, or project onto pixels that lie on the crystals"
        )
