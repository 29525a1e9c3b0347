"""The three-dimensional Shepp-Logan head phantom: ten ellipsoids whose values add up."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from ..physics.materials import WATER_MU
from .phantom import Phantom
from .settings import choice, setting
from .shapes import Ellipsoid, Shape

# Rows: half axes and centre in units of `half_size`, rotation about z in degrees, density (original contrast), and value
# with modified contrast.
_ELLIPSOIDS = (
    ((0.6900, 0.920, 0.810), (0.0, 0.0, 0.0), 0.0, 2.00, 1.0),
    ((0.6624, 0.874, 0.780), (0.0, -0.0184, 0.0), 0.0, -0.98, -0.8),
    ((0.1100, 0.310, 0.220), (0.22, 0.0, 0.0), -18.0, -0.02, -0.2),
    ((0.1600, 0.410, 0.280), (-0.22, 0.0, 0.0), 18.0, -0.02, -0.2),
    ((0.2100, 0.250, 0.410), (0.0, 0.35, -0.15), 0.0, 0.01, 0.1),
    ((0.0460, 0.046, 0.050), (0.0, 0.1, 0.25), 0.0, 0.01, 0.1),
    ((0.0460, 0.046, 0.050), (0.0, -0.1, 0.25), 0.0, 0.01, 0.1),
    ((0.0460, 0.023, 0.050), (-0.08, -0.605, 0.0), 0.0, 0.01, 0.1),
    ((0.0230, 0.023, 0.020), (0.0, -0.606, 0.0), 0.0, 0.01, 0.1),
    ((0.0230, 0.046, 0.020), (0.06, -0.605, 0.0), 0.0, 0.01, 0.1),
)
CONTRASTS = ("modified", "original")


@dataclass(frozen=True)
class SheppLogan(Phantom):
    """The Shepp-Logan head in three dimensions: ellipsoids whose values add up.

    The ellipses of L. A. Shepp and B. F. Logan, IEEE Transactions on Nuclear Science 21 (1974) 21-43 (A. C. Kak and
    M. Slaney, "Principles of Computerized Tomographic Imaging", 1988, section 3.1; one at -0.606 instead of -0.605, as in
    MATLAB), with the third half axes and heights of M. Schabel's ``phantom3d`` (MATLAB Central 9416), but without its psi
    of 10 degrees, which would turn the ventricles about z a second time. Kak and Slaney's own ellipsoids for three
    dimensions differ. Modified values: P. Toft, "The Radon Transform", thesis, 1996, p. 199.

    The head measures 1.38 x 1.84 x 1.62 of `half_size`. The contrast of the activity is ``"modified"`` (visible) or
    ``"original"`` (1 % between the parts of the brain); mu always has the original densities.
    """

    half_size: float = setting(75.0, "mm", "unit of length of the tables; the head is 1.84 times as long")
    activity: float = setting(100.0, "kBq/mL", "activity where the table's value is 1", 0.0)
    mu: float = setting(WATER_MU, "1/mm", "attenuation coefficient where the density is 1", 0.0)
    contrast: str = choice("modified", CONTRASTS, "contrast of the activity")

    title = "Shepp-Logan phantom"

    @cached_property
    def shapes(self) -> Sequence[Shape]:
        """Ellipsoids in the order of the table."""
        return [
            Ellipsoid(
                radii=[self.half_size * r for r in radii],
                position=[self.half_size * c for c in center],
                euler=(math.radians(degrees), 0.0, 0.0),
                mode="add",
                name=f"ellipsoid {i}",
                activity=self.activity * (modified if self.contrast == "modified" else density),
                mu=self.mu * density,
            )
            for i, (radii, center, degrees, density, modified) in enumerate(_ELLIPSOIDS, 1)
        ]
