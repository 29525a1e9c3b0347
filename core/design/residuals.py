"""What a calibration leaves of each module's spots, drawn."""

import numpy as np

from ..runs.display import DIVERGING, Display
from ..runs.mosaic import Sheet, sheet
from .calibration import Calibration

_MOST = 5.0  # standard deviations at the ends of the colours


def residual_sheet(found: Calibration) -> Sheet:
    """The residuals of all modules, ring by ring: noise without a pattern where the geometry fits."""
    display = Display(colors=DIVERGING, low=-_MOST, high=_MOST)
    residuals = found.residuals.astype(np.float32)
    return sheet(residuals, found.system.numbers, found.system.rings(), "standard deviations", display)
