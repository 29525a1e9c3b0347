"""The networks that reconstruct, one file each, by their names in recipes."""

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from ...errors import needing


@dataclass(frozen=True)
class Kind:
    """A network: its class is ``file.Model``, whose arguments are the settings ``network.<name>``."""

    label: str
    text: str  # one line of help
    file: str  # beside this one

    def load(self) -> Any:
        """Its class; `InputError` where torch or MONAI is missing."""
        with needing("mphdrr[learning]"):
            return import_module(f".{self.file}", __name__).Model


NETWORKS: Mapping[str, Kind] = {
    "after-osem": Kind("U-Net after OSEM", "Corrects volumes by OSEM", "after_osem"),
    "cameras": Kind("Camera nets", "Each camera's own estimate in (u, v, k), weighed by content", "cameras"),
    "parallel": Kind("Parallel projections", "Infers parallel projections, then FBP", "parallel"),
    "unrolled": Kind("Unrolled", "Steps through the exact operators", "unrolled"),
    "channels": Kind("Views as channels", "Is told no geometry: for comparison", "channels"),
}  # fmt: skip
"""The networks by their names in recipes. A new one is a file here and a row."""
