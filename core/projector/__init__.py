"""Line integrals of volumes along rays, and their exact adjoint.

`operator` has the projector, `linear_operator` its adjoint, `tracing` rays given by their ends or as fans. Both describe
their rays as `bundles`, which `execution` cuts up and gives to one of the `backends` on several threads. `rays` maps rays
into index space, `lattices` crops volumes to what is filled, `autograd` makes steps of torch's graph. torch is not imported
before it is needed.
"""

from .emission import Emission
from .frames import FrameProjector
from .geometry_gradient import GeometryGradient, geometry_gradient
from .inverse_square import InverseSquareSum
from .linear_operator import Adjoint
from .models import Model, Transmission, intensity
from .operator import Projector
from .tracing import trace_rays
