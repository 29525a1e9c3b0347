"""Views that are of a system's modules."""

import numpy as np

from ..errors import InputError
from ..geometry.system import PinholeSystem
from ..geometry.views import Views

# Views may differ from their system by a file's rounding (mm; sine of an angle).
_SAME_PLACE = 1e-3
_SAME_DIRECTION = 1e-6


def require_views_of(system: PinholeSystem, views: Views, name: str) -> None:
    """Raise `InputError` unless `views` are those of the system's modules, in their order; `name` is what asks."""
    if len(views) != len(system):
        raise InputError(f"{name}: {len(system)} modules but {len(views)} views; give the system whose views they are")
    views.require_pinholes(name)
    u, v, k = system.frames().transpose(1, 0, 2)
    moved = np.linalg.norm(views.sources - system.centers, axis=1) > _SAME_PLACE
    turned = np.zeros(len(views), dtype=bool)
    for steps, axis in ((views.u_steps, u), (views.v_steps, v)):
        sine = np.linalg.norm(np.cross(steps, axis), axis=1) / np.linalg.norm(steps, axis=1)
        turned |= sine > _SAME_DIRECTION
    behind = np.einsum("mi,mi->m", views.detector_centers - views.sources, k) <= 0
    for bad, why in (
        (moved, "its source is not the module's pinhole"),
        (turned, "its pixels do not lie along the module's u and v"),
        (behind, "its detector is not in front of the pinhole (see PinholeSystem.views)"),
    ):
        if bad.any():
            raise InputError(f"{name}: view {int(np.argmax(bad))}: {why}")
