"""Scatter in a body, estimated from the volume while that is reconstructed."""

from typing import Any

import numpy as np

from ..arrays import Array, Bools, Floats32
from ..errors import InputError
from ..physics.ct_numbers import hu_to_mu
from ..physics.materials import attenuation
from ..progress import Progress
from ..projector import Projector
from ..scatter.images import scatter_images, scattering_body, strongest_line
from ..validation import one_of
from ..volumes.resampling import resample
from ..volumes.volume import Volume
from .arguments import argument

SCATTER = {
    "none": ("Not Estimated", "What the background says"),
    "body": ("In the Body", "Photons scattered in the attenuating body, simulated from the volume as it becomes known"),
}
"""Ways to estimate scatter, each with its label and its description."""
_PRECISION = 0.01  # of each module's total: the noise of two estimates is then no change by 1 %
_IN_AIR = 0.05  # share of water's mu up to which a voxel is air: noise of a CT, less than lungs
_NEEDED = {
    "mu": "mu (attenuation.file, --mu)",
    "isotope": "isotope (--set model.isotope=Tc-99m)",
    "energy_fwhm": "energy_fwhm (--set model.energy_fwhm=0.1)",
}


@argument("scatter", str, "Scatter that is estimated and added to the background", words=SCATTER)
def scatter_body(scatter: str, A: Projector) -> tuple[Volume, Bools] | None:
    """Return the body of mu in which a model's photons scatter, and the projector's voxels in it; None for "none".

    Raise `InputError` for another word, and unless the model has a body and knows the photons' energies.
    """
    one_of(scatter, SCATTER, "scatter")
    if scatter == "none":
        return None
    model: Any = A.model
    if missing := [text for name, text in _NEEDED.items() if getattr(model, name, None) is None]:
        raise InputError(f"scatter: body needs {', '.join(missing)}, which the model has not")
    body, energy = scattering_body(model), strongest_line(model)
    body = hu_to_mu(body, energy) if body.quantity == "hu" else body
    return body, resample(body, A.grid).array > _IN_AIR * attenuation("water", energy)


def estimate_scatter(
    A: Projector, body: Volume, inside: Bools, values: Array, expected: float, progress: Progress | None
) -> Floats32:
    """Return the expected scatter (M, n_v, n_u) in a body of activity like `values` in the voxels `inside` it.

    Its size is such that the images of all `values` and the scatter together are the `expected` counts of all pixels. So
    the size of a volume that still explains scatter does not matter.
    """
    model: Any = A.model
    activity = Volume(np.where(inside, values, np.float32(0)), A.grid, "activity")
    scatter = scatter_images(
        activity, body, A.views, model, precision=_PRECISION, threads=A.threads, progress=progress
    ).images[0]
    total = np.sum(A(values), dtype=float) + np.sum(scatter, dtype=float)
    return scatter * np.float32(max(0.0, expected) / max(total, 1e-30))
