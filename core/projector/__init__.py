"""Line integrals of volumes along rays, and their exact adjoint.

`operator` holds what is the same for every backend: checks, the loop over views, threads, memory. `rays` maps
rays into index space, once for all backends. Each ``siddon_*`` module integrates along such rays and spreads
values back along them; `backends` chooses among them. Neither numba nor torch is imported before it is
needed.
"""

from __future__ import annotations

from .emission import Emission
from .models import Model, Transmission
from .operator import AdjointProjector, Projector, trace_rays

__all__ = ["AdjointProjector", "Emission", "Model", "Projector", "Transmission", "trace_rays"]
