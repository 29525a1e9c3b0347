"""How good the reconstruction of a simulated run is: the scores that its truth allows, in words."""

from ..phantoms.derenzo import DerenzoRods
from ..progress import Progress
from ..reconstruction.scores.derenzo import derenzo_score
from ..reconstruction.scores.images import nrmse
from ..volumes.resampling import resample
from ..volumes.volume import Volume
from .run import ProjectionRun
from .run_recipe import phantom_pose, recipe_phantom


def score_lines(run: ProjectionRun, volume: Volume, progress: Progress | None = None) -> list[tuple[str, str]]:
    """What a volume is worth beside that which a run was made from: names and values, in words; none of a measured run.

    The normalised error of the voxels; of a Derenzo phantom also, for each size of rods, the share of neighbouring pairs
    that are resolved, and the mean valley by the mean peak (`derenzo_score`).
    """
    if run.volume is None:
        return []
    truth = resample(run.volume, volume.grid, "mean", progress=progress)
    lines = [("NRMSE", f"{nrmse(volume, truth):.3g}")]
    recipe = run.recipe
    if any(f"phantom.{name}" in recipe.given for name in ("kind", "text", "file")):
        phantom = recipe_phantom(recipe)
        if any(isinstance(shape, DerenzoRods) for shape in phantom.shapes):
            for sector in derenzo_score(volume, phantom, phantom_pose(recipe)):
                said = f"{sector.resolved:.0%} resolved, valley/peak {sector.valley_to_peak:.2f}"
                lines.append((f"{sector.rod_diameter:g} mm rods", sector.note or said))
    return lines
