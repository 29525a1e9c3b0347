"""Networks that reconstruct, one file each, and the table of their names in recipes.

Entry points: `NETWORKS` (the table), `network.Network` (the interface: a network is called with a `ScannerSetup` and a
`Sample` and returns volumes), `network.UNet`.

To add a network, write a file with a class derived from `Network` and add a row to `NETWORKS` that names both. The
arguments of the class, with their defaults, are its settings in recipes (whole numbers are 1 or more, except those that
the class names in `may_be_0`); tests/core/test_networks.py wants small values of them in `SMALL`.
`network.relative_residual` and `network.normalized_backprojection` tell a network what the counts say about a volume.
Names of submodules are names of weights in model files: they stay.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from ...errors import needing


@dataclass(frozen=True)
class NetworkKind:
    """A kind of network: its texts and its class, whose arguments are the settings ``network.<name>``."""

    label: str  # name in messages and figures
    text: str  # one line of help
    path: str  # file in this folder and class, "after_osem.AfterOsem"

    def load(self) -> Any:
        """Import and return the class; raise `InputError` if torch or MONAI is missing."""
        file, name = self.path.split(".")
        with needing("mphdrr[learning]"):
            return getattr(import_module(f".{file}", __name__), name)


NETWORKS: Mapping[str, NetworkKind] = {
    "after-osem": NetworkKind("U-Net after OSEM", "Corrects volumes by OSEM", "after_osem.AfterOsem"),
    "cameras": NetworkKind("Camera nets", "One estimate per camera in (u, v, k), weighed by content", "cameras.CameraNets"),
    "parallel": NetworkKind("Parallel projections", "Infers parallel projections, then FBP", "parallel.ParallelProjections"),
    "unrolled": NetworkKind("Unrolled", "Steps through the exact operators", "unrolled.UnrolledEm"),
    "channels": NetworkKind("Views as channels", "Without geometry, for comparison", "channels.ViewsAsChannels"),
}  # fmt: skip
"""Kinds of networks by their names in recipes."""
