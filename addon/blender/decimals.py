"""Blender's float32 numbers, read as they were typed."""

import numpy as np


def typed(value: float) -> float:
    """Return the shortest decimal number that a float32 stands for: 0.1, not 0.10000000149."""
    return float(str(np.float32(value)))
