"""Scatter in a body, estimated from the volume while that is reconstructed."""

from typing import Any

import numpy as np

from ..arrays import Array, Floats32
from ..errors import InputError
from ..models.photon_lines import mu_volumes
from ..progress import Progress
from ..projector import Projector
from ..scatter.images import scatter_images
from ..validation import one_of
from ..volumes.volume import Volume
from .arguments import argument

SCATTER = {
    "none": ("Not Estimated", "What the background says"),
    "body": ("In the Body", "Photons scattered in the attenuating body, simulated from the volume as it becomes known"),
}
"""Ways to estimate scatter, each with its label and its description."""
_PRECISION = 0.005  # of each module's total
_NEEDED = {
    "mu": "mu (attenuation.file, --mu)",
    "isotope": "isotope (--set model.isotope=Tc-99m)",
    "energy_fwhm": "energy_fwhm (--set model.energy_fwhm=0.1)",
}


@argument("scatter", str, "Scatter that is estimated and added to the background", words=SCATTER)
def scatter_body(scatter: str, A: Projector) -> Volume | None:
    """Return the body, CT numbers or mu at the main line, in which a model's photons scatter; None for `scatter` "none".

    Raise `InputError` for another word, and unless the model has a body and knows the photons' energies.
    """
    one_of(scatter, SCATTER, "scatter")
    if scatter == "none":
        return None
    model: Any = A.model
    if missing := [text for name, text in _NEEDED.items() if getattr(model, name, None) is None]:
        raise InputError(f"scatter: body needs {', '.join(missing)}, which the model has not")
    main = max(model.isotope.lines_within(*model.window), key=lambda line: line[1])[0]
    volumes = mu_volumes(model.mu)
    return volumes[[energy for energy, _ in model.photon_lines].index(main)] if len(volumes) > 1 else volumes[0]


def estimate_scatter(
    A: Projector, body: Volume, values: Array, images: Array, expected: float, progress: Progress | None
) -> Floats32:
    """Return the expected scatter (M, n_v, n_u) of activity like `values`, whose images without scatter are `images`.

    Its size is such that both together are the `expected` counts of all pixels. So it hardly depends on how far the volume
    has already become smaller, since it need no longer explain the scatter.
    """
    activity, model = Volume(values, A.grid, "activity"), A.model
    scatter: Any = scatter_images(
        activity, body, A.views, model, precision=_PRECISION, threads=A.threads, progress=progress
    )
    total = images.sum(dtype=float) + scatter.images.sum(dtype=float)
    return scatter.images[0] * np.float32(max(0.0, expected) / max(total, 1e-30))
