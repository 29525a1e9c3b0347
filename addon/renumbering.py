"""New numbers 1, 2, ... for a scanner's modules, in their properties and names."""

from __future__ import annotations

import json
import re
from typing import Literal

import bpy
import numpy as np

from ..core.errors import InputError
from ..core.geometry.generators import ring_order
from ..core.recording import recorded_warnings
from . import copies, following, ids, scanner

Order = Literal["RINGS", "LIST"]

_OURS = re.compile(r"(Module|Collimator|Crystal) \d+(\.\d+)?")  # a name that the extension gave


def renumber(collection: bpy.types.Collection, order: Order = "RINGS") -> int:
    """Number a scanner's modules 1, 2, ...; they are listed, projected and exported in that order from now on.

    Names that the extension gave follow; names that the user gave stay.

    Parameters
    ----------
    collection
        The scanner.
    order
        ``"RINGS"``: that of `core.geometry.generators.ring_order`; ``"LIST"``: the present one.

    Returns
    -------
    int
        How many modules have another number than before.

    Raises
    ------
    InputError
        The scanner is untidy (`copies.untidy_text`), or its numbers are impossible. It stays as it was.
    """
    untidy = copies.untidy_text(collection)
    if untidy:
        raise InputError(f"scanner '{collection.name}': {untidy}: press Tidy Modules in the Design panel first")
    with recorded_warnings():  # where the cameras look does not matter here
        system = scanner.read_scanner(collection)
    found = scanner.modules(collection)
    places = ring_order(system) if order == "RINGS" else np.arange(len(found))
    parts = following.parts_of(collection, found)
    names: list[tuple[bpy.types.ID, str]] = []
    with following.writing():
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
        item.name = f"{name} renumbered"  # so that the new names are free
    for item, name in names:
        item.name = name
    following.refresh(collection)
    return int(np.count_nonzero(system.numbers[places] != ordered.numbers))
