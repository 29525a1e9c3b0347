"""Some of a system's modules, chosen by their numbers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .system import PinholeSystem


def chosen_modules(system: PinholeSystem, text: str | None, name: str = "--modules") -> PinholeSystem:
    """The modules of `system` whose numbers `text` lists ("1-40", "1-20,41", "60-"); all for None.

    Parameters
    ----------
    system, text
        The modules, and which of them.
    name
        What messages call the text.

    Raises
    ------
    InputError
        The text is no list of ranges, or a range has no module.
    """
    if text is None:
        return system
    wanted: list[NDArray[np.int64]] = []
    for part in text.split(","):
        first, dash, last = part.strip().partition("-")
        try:
            low = int(first) if first or not dash else int(system.numbers.min())
            high = int(last) if last else int(system.numbers.max()) if dash else low
        except ValueError:
            raise InputError(f"{name} {text!r}: expected numbers such as 1-40 or 1-20,41") from None
        found = np.flatnonzero((system.numbers >= low) & (system.numbers <= high))
        if high < low:
            raise InputError(f"{name} {text!r}: {part.strip()} ends before it begins")
        if len(found) == 0:
            raise InputError(
                f"{name} {text!r}: no module {part.strip()}; there are {system.numbers.min()} to {system.numbers.max()}"
            )
        wanted.append(found)
    return system[np.unique(np.concatenate(wanted))]
