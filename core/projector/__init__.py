"""Line integrals of volumes along rays, and their exact adjoint.

`operator` holds what is the same for every backend: checks, the loop over views, threads, memory. `tracing` takes rays
by their ends, or as fans, instead of as views. `rays` maps rays into index space, once for all backends. Each
``siddon_*`` module integrates along such rays, spreads values back along them and tells how the integrals move with the
rays' ends; `backends` chooses among them, `autograd` makes them steps of torch's graph. torch is not imported before it
is needed.
"""

from __future__ import annotations

from .emission import Emission
from .inverse_square import InverseSquareSum
from .models import Model, Transmission, intensity
from .operator import AdjointProjector, Projector
from .tracing import trace_rays

__all__ = [
    "AdjointProjector",
    "Emission",
    "InverseSquareSum",
    "Model",
    "Projector",
    "Transmission",
    "intensity",
    "trace_rays",
]
