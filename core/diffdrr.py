"""DiffDRR's interface under the name that programs written for DiffDRR import; the code is `core.exchange.diffdrr`."""

from .exchange.diffdrr import *  # noqa: F403
from .exchange.diffdrr import __all__ as __all__
