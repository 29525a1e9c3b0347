"""The projector: the linear map from a volume to the images of a scanner's modules, and its exact adjoint.

`Projector` (`operator.py`) joins a grid, views and a model of what a pixel measures; ``A(x)`` are images, ``A.T(y)`` is
the adjoint (`Projector._run_back`, which is also torch's gradient). `FrameProjector` (`frames.py`) has a volume and
images for each frame of a scan. `geometry_gradient` gives the derivatives of counts by the modules' geometry;
`torch_cameras.py` makes images from poses, part of torch's graph. Voxels too close for the pinhole response are added by
rays in `operator.py`.

Nothing is added here for a new model (`core.models`) or a new way to trace rays (`core.rays`): the projector asks both.
torch is not imported before it is needed.
"""

from ..lazy import deprecated_modules
from ..models.emission import Emission
from ..models.inverse_square import InverseSquareSum
from ..models.model import Model, Transmission, intensity
from ..rays.linear_operator import Adjoint
from ..rays.tracing import trace_rays
from .frames import FrameProjector
from .geometry_gradient import GeometryGradient, geometry_gradient
from .operator import Projector

deprecated_modules(__name__, {
    "autograd": "rays.autograd", "backends": "rays.backends", "backends.cpu": "rays.backends.cpu",
    "backends.cuda": "rays.backends.cuda", "backends.reference": "rays.backends.reference",
    "emission": "models.emission", "inverse_square": "models.inverse_square",
    "linear_operator": "rays.linear_operator", "models": "models.model", "parallel": "rays.parallel",
    "photon_lines": "models.photon_lines", "pixel_points": "models.pixel_points",
    "pose_search": "exchange.diffdrr.pose_search", "poses": "projector.torch_cameras", "rays": "rays.ray_geometry",
    "tracing": "rays.tracing",
})  # fmt: skip
