"""New numbers for a scanner's modules: 1, 2, ... in an order, in the properties and in the names."""

from __future__ import annotations

import json
import re
from typing import Literal

import bpy
import numpy as np

from ..core.errors import InputError
from ..core.geometry.ring_fits import ring_order
from ..core.recording import recorded_warnings
from . import copies, design, ids, scanner

Order = Literal["RINGS", "LIST"]

_OURS = re.compile(r"(Module|Collimator|Crystal) \d+(\.\d+)?")  # a name that the extension gave


def renumber(collection: bpy.types.Collection, order: Order = "RINGS") -> int:
    """Number a scanner's modules 1, 2, ...; in that order they are listed, projected and exported from now on.

    Names that the extension gave follow; names of the user's own stay.

    Parameters
    ----------
    collection
        The scanner.
    order
        ``"RINGS"``: as `core.geometry.ring_fits.ring_order` has them; ``"LIST"``: as they are listed now.

    Returns
    -------
    int
        How many modules have another number than before.

    Raises
    ------
    InputError
        Copies or left-overs are to be tidied first, or the modules make no system. The scanner stays as it was.
    """
    untidy = copies.untidy_text(collection)
    if untidy:
        raise InputError(f"scanner '{collection.name}': {untidy}: press Tidy Modules in the Design panel first")
    with recorded_warnings():  # where a camera looks is no matter here
        system = scanner.read_scanner(collection)
    found = scanner.modules(collection)
    places = ring_order(system) if order == "RINGS" else np.arange(len(found))
    parts = design.parts_of(collection, found)
    names: list[tuple[bpy.types.ID, str]] = []
    with design.writing():
        for index, camera in enumerate(found[place] for place in places):
            camera.mphdrr_module.number, camera.mphdrr_module.index = index + 1, index
            name = ids.module_name(index + 1, len(found))
            names += [(camera, name), (camera.data, name)]
            for part in parts[camera]:
                part.mphdrr_module.number = index + 1
                part_name = ids.part_name(name, part.mphdrr_module.part)
                names += [(part, part_name), (part.data, part_name)]
        ordered = scanner.read_scanner(collection)
        if np.any(np.diff(places) < 0):
            collection.mphdrr_scanner.source = ""  # the workbook has another order
        collection.mphdrr_scanner.quick_ranges = json.dumps(scanner.quick_ranges(ordered))
    names = [(item, name) for item, name in names if item.name != name and _OURS.fullmatch(item.name)]
    for item, name in names:
        item.name = f"{name} renumbered"  # what another has now is free afterwards
    for item, name in names:
        item.name = name
    scanner.refresh_scanner(collection)
    return int(np.count_nonzero(system.numbers[places] != ordered.numbers))
