"""Stable numbers by which .blend files and Blender's preferences store choices.

Blender stores the number of an enumeration's item, by default its position: an isotope inserted between two others would
make every saved scene simulate another isotope. So every item has a number of its own: in the tables below, the one that it
had in version 0.1.0; for a later item, a checksum of its identifier. Later items need no change here.
"""

import zlib
from collections.abc import Iterable, Mapping

Items = tuple[tuple[str, str, str, int], ...]
"""Identifier, label, description and number of each choice, as `EnumProperty` takes them."""

PARTS = {"NONE": 0, "CAMERA": 1, "COLLIMATOR": 2, "CRYSTAL": 3, "ROI": 4}
QUANTITIES = {
    "activity": 0, "mu": 1, "hu": 2, "sensitivity": 3, "modules": 4, "resolution": 5, "completeness": 6,
}  # fmt: skip
READ_AS = {"AUTO": 0} | {name: number + 1 for name, number in QUANTITIES.items()}
MAPS = {"sensitivity": 0, "modules": 1, "resolution": 2, "completeness": 3}
KINDS = {
    "VOLUME": 0, "DERENZO": 1, "NEMA": 2, "JASZCZAK": 3, "DEFRISE": 4, "SHEPP_LOGAN": 5, "POINTS": 6, "TORSO": 7,
    "FILE": 1000,
}  # fmt: skip
PHANTOM_WORDS = {"modified": 0, "original": 1}  # words offered by `core.phantoms.settings.choice`
ISOTOPES = {
    "NONE": 0, "F-18": 1, "Ga-67": 2, "Tc-99m": 3, "In-111": 4, "I-123": 5, "I-131": 6, "Xe-133": 7, "Lu-177": 8,
    "Tl-201": 9,
}  # fmt: skip
APERTURES = {"NUMBER": 0, "tungsten": 1, "lead": 2, "gold": 3, "uranium": 4}
CRYSTALS = {"NUMBER": 0, "NaI": 1, "CsI": 2, "CZT": 3, "CdTe": 4, "BGO": 5, "LYSO": 6, "GAGG": 7}
MODELS = {"TRANSMISSION": 0, "EMISSION": 1, "INVERSE_SQUARE": 2}
EDGES = {"PAIX": 0, "PATH": 1}
DETECTORS = {"VIRTUAL": 0, "REAL": 1}
BACKENDS = {"AUTO": 0, "CPU": 1, "TORCH": 2, "NUMPY": 3, "CUDA": 4}
JOINED = {"BY_NUMBER": 0, "IN_ORDER": 1, "ONE_FOR_ALL": 2}
UNITS = {
    "NONE": 0, "mm": 1, "cm": 2, "m": 3, "in": 4, "µm": 5, "rad": 6, "deg": 7, "dm": 8, "ft": 9, "mil": 10, "0.1 mm": 11,
}  # fmt: skip


_MASK = 0xFFFFFF
"""The largest checksum: Blender's buttons that show choices side by side keep numbers as float32, exact up to here."""


def items(numbers: Mapping[str, int], rows: Iterable[tuple[str, str, str]]) -> Items:
    """Return items (identifier, label, description, number); numbers come from a table above, else from a checksum."""
    return tuple((name, label, tip, numbers.get(name, zlib.crc32(name.encode()) & _MASK)) for name, label, tip in rows)
