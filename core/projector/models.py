"""What a ray measures."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Transmission:
    """The line integral of the volume from source to target, value x mm: a digitally reconstructed radiograph."""
