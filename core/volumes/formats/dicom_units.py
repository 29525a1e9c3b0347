"""Units of the values of DICOM images: DICOM's own codes, and those of UCUM in real world value maps (C.7.6.16.2.11)."""

import math
import re
from typing import Any, NamedTuple

import numpy as np

from ...errors import InputError

_PREFIXES = {"": 1e-3, "k": 1.0, "M": 1e3, "G": 1e6}  # kBq for each of these Bq
_BECQUEREL = re.compile(r"([kMG]?)bq([/.])(ml|cm3|cc)(-1)?|([kMG]?)bq(ml)")
_INVERSE_LENGTHS = {"cm": 0.1, "mm": 1.0, "m": 1e-3}
_COUNTS = ("{counts}", "{count}", "counts", "cnts", "ct", "1", "{propcounts}")


class DicomUnit(NamedTuple):
    """Unit of stored values: the quantity that it is of, and the factor to that quantity's unit of ours."""

    quantity: str
    factor: float


def unit_of(code: str) -> DicomUnit | None:
    """Return the unit of a code such as "BQML", "kBq/mL", "1/cm", "HU" or "{counts}" ("counts"); None for others."""
    text = code.strip().replace(" ", "")
    lower = text[:1] + text[1:].lower() if text[:1] in _PREFIXES and text[1:3].lower() == "bq" else text.lower()
    if match := _BECQUEREL.fullmatch(lower):
        return DicomUnit("activity", _PREFIXES[match[1] or match[5] or ""])
    if lower in ("hu", "[hnsf'u]", "hnsf'u"):
        return DicomUnit("hu", 1.0)
    if match := re.fullmatch(r"1?/(mm|cm|m)|(mm|cm|m)-1|1(cm|mm)", lower):
        return DicomUnit("mu", _INVERSE_LENGTHS[match[1] or match[2] or match[3]])
    return DicomUnit("counts", 1.0) if lower in _COUNTS else None


class RealWorldValues(NamedTuple):
    """Rescaling of stored values to a unit: value = slope x stored value + intercept."""

    slope: float
    intercept: float
    code: str
    """Code of the unit as in the file."""
    first: float = -math.inf
    """Smallest stored value that is mapped."""
    last: float = math.inf
    """Largest stored value that is mapped."""

    def __str__(self) -> str:
        return f"{self.slope:g} x value + {self.intercept:g} {self.code}"


def real_world_values(header: Any) -> RealWorldValues | None:
    """Return the rescaling of a header or frame by RealWorldValueMappingSequence; None where it has none.

    Of several maps the one to a known unit is taken. `InputError` for a table of values, and for maps that differ.
    """
    maps = []
    for item in header.get("RealWorldValueMappingSequence") or ():
        codes = [str(code.get("CodeValue") or "") for code in item.get("MeasurementUnitsCodeSequence") or ()]
        if "RealWorldValueSlope" not in item:
            raise InputError("RealWorldValueMapping: values by a table are not read; expected RealWorldValueSlope")
        slope, intercept = float(item.RealWorldValueSlope), float(item.get("RealWorldValueIntercept") or 0)
        if not (math.isfinite(slope) and slope != 0 and math.isfinite(intercept)):
            raise InputError(f"RealWorldValueSlope: expected a number other than 0, got {slope:g}")
        first, last = (item.get(f"RealWorldValue{name}ValueMapped") for name in ("First", "Last"))
        limits = -math.inf if first is None else float(first), math.inf if last is None else float(last)
        maps.append(RealWorldValues(slope, intercept, codes[0] if codes else "", *limits))
    known_maps = [mapping for mapping in maps if unit_of(mapping.code)] or maps
    if known_maps and not agree(known_maps):
        raise InputError(f"RealWorldValueMapping: {'; '.join(map(str, known_maps))}; expected one of them")
    return known_maps[0] if known_maps else None


def agree(maps: list[RealWorldValues]) -> bool:
    """Return whether maps are to one quantity, or all to unknown ones, and give the same values."""
    units = [unit_of(mapping.code) or DicomUnit("", 1.0) for mapping in maps]
    values = [np.multiply(mapping[:2], unit.factor) for mapping, unit in zip(maps, units, strict=True)]
    return len({unit.quantity for unit in units}) == 1 and np.allclose(values, values[0], rtol=1e-6, atol=1e-12)
