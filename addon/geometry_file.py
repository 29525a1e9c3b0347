"""The scanner of the scene as a workbook."""

from __future__ import annotations

import hashlib
import warnings
from dataclasses import replace
from pathlib import Path

import bpy
import numpy as np

from ..core.errors import InputError, InputWarning
from ..core.geometry.system import PinholeSystem
from ..core.recording import recorded_warnings
from . import scanner, storage
from .module_values import LENGTHS

_EQUAL = 1e-9  # mm, or share of a length above 1 mm


def export_scanner(collection: bpy.types.Collection, path: Path, use_template: bool = True) -> PinholeSystem:
    """Write the scanner as it stands in the scene to a workbook, which from now on is the one it was imported from.

    Parameters
    ----------
    collection
        The scanner.
    path
        The workbook to write, .xlsx or .xlsm.
    use_template
        Write into a copy of the workbook that the scanner comes from, while it is there: all else in it stays. One that
        was read by a column map is written by it, and the scene keeps the new file's own.
        Otherwise, or where it has gone (`InputWarning`), a complete workbook is made.

    Returns
    -------
    PinholeSystem
        What the workbook says.

    Raises
    ------
    InputError
        A camera does not aim at the isocentre, the modules make no system, or the file cannot be written. The scanner
        stays as it was.
    """
    from ..core.workbook import read_system, write_system

    scanner.refresh_scanner(collection)
    system = scanner.read_scanner(collection, aimed=True)
    template = _template(collection) if use_template else None
    source = scanner.source(collection)
    columns = source.columns if source is not None and template is not None else None
    own = write_system(system, path, template, columns).columns
    with recorded_warnings():  # the writer has said what there is to say of the template
        written = read_system(path, own)
    different = _difference(system, written)
    if different:
        raise InputError(f"{path}: was written, but reads back differently ({different}); the scene keeps its numbers")
    # The scene's own float64 numbers: they may differ in the last digit.
    written = replace(system, source=written.source)
    scanner.remember_source(collection, written)
    return written


def _template(collection: bpy.types.Collection) -> Path | None:
    properties = collection.mphdrr_scanner
    if not properties.workbook:
        return None
    path = storage.absolute(properties.workbook)
    if not path.is_file():
        warnings.warn(f"{path} has gone: made a complete workbook instead of a copy of it", InputWarning, stacklevel=3)
        return None
    if properties.sha256 and hashlib.sha256(path.read_bytes()).hexdigest() != properties.sha256:
        warnings.warn(
            f"{path} has changed since the scanner was read from it: the modules' cells are overwritten, all else is "
            "kept as it is now",
            InputWarning,
            stacklevel=3,
        )
    return path


def _difference(one: PinholeSystem, other: PinholeSystem) -> str:
    """Where two systems differ, in words."""
    if not np.array_equal(one.numbers, other.numbers):
        return "the modules' numbers"
    for name in ("centers", *LENGTHS):
        a, b = (getattr(system, name).reshape(len(one), -1) for system in (one, other))
        wrong = (np.abs(a - b) > _EQUAL * np.maximum(1.0, np.abs(a))).any(axis=1)
        if wrong.any():
            return f"{name} of module {one.numbers[int(wrong.argmax())]}"
    return ""
