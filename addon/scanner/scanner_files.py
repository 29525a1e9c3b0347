"""Scanners written to workbooks and to the files of other programs."""

import hashlib
import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ...core import recording, workbook
from ...core.errors import InputError, warn
from ...core.exchange import FORMATS, write_geometry
from ...core.geometry.scanner import Detector, Scanner, first_true
from ...core.progress import Progress, stages_of
from ..blender import decimals, ids, jobs, storage
from . import module_values, pinholes, scanner

WORKBOOK_SUFFIXES = (".xlsx", ".xlsm")
"""Endings of the names of workbooks."""


def export_workbook_job(collection: bpy.types.Collection, path: Path, use_template: bool = True) -> jobs.Job:
    """Return the job that writes the scanner as it stands in the scene to a workbook, which becomes its source.

    With `use_template` it is written into a copy of the scanner's present workbook, by the column map with which that was
    read; a new one is made where that workbook has gone (`InputWarning`). Raises InputError, and leaves the scanner as it
    was, where the file cannot be written.
    """
    system = scanner.read_scanner(collection)
    template = _template_workbook(collection) if use_template else None
    source = scanner.source(collection) if template is not None else None
    columns, name = source.columns if source is not None else None, collection.name

    def work(progress: Progress) -> Scanner:
        """Write the workbook, read it back to verify it, and return the system with the workbook as its source."""
        stages_of(progress)("writing the workbook")
        written_columns = workbook.write_system(system, path, template, columns).columns
        with recording.recorded_warnings():  # the writer has already warned of the template's doubts
            written = workbook.read_scanner(path, system.kind, written_columns)
        if difference := _difference(system, written):
            problem = f"was written, but reads back differently ({difference})"
            raise InputError(f"{path}: {problem}; the scene keeps its numbers")
        # The scene keeps its own float64 numbers, from which the workbook's may differ in the last digit.
        return system.replace(source=written.source)

    def finish(written: Scanner) -> str:
        """Store that the scene's scanner is that of the workbook, and return the line to report."""
        if (collection := bpy.data.collections.get(name)) is not None:
            scanner.store_saved_state(collection, written)
        return f"Wrote {ids.counted(len(written), 'module')} of {name!r} to {path}"

    return jobs.Job("Exporting the workbook", work, finish)


def export_program_job(
    collection: bpy.types.Collection,
    path: Path,
    format: str,
    shape: tuple[int, int],
    detector: Detector = "virtual",
    magnification: float = 10.0,
) -> jobs.Job:
    """Return the job that writes the scanner as it stands in the scene in one of `FORMATS`, collimators included.

    `path` is a new folder for formats of several files; the images described are `system.views(shape, detector, ...)`.
    Raises InputError where the format cannot express the scanner.
    """
    construction = pinholes.construction(collection.mphdrr_scanner, module_values.kind_of(collection))
    options = {} if construction is None else asdict(construction)
    if construction is not None:
        options["opening_degrees"] = decimals.typed(math.degrees(options.pop("opening_angle")))
    name = collection.name
    system: Any = scanner.read_scanner(collection)  # `write_geometry` refuses kinds that the format cannot express
    views = system.views(shape, detector, magnification=magnification)
    arguments = {name: value for name, value in options.items() if name in FORMATS[format].options}

    def work(progress: Progress) -> None:
        """Write the geometry in the program's format."""
        stages_of(progress)("writing the file")
        write_geometry(system, path, format, views=views, **arguments)

    return jobs.Job(
        "Exporting the geometry", work, lambda _: f"Wrote {ids.counted(len(system), 'module')} of {name!r} to {path}"
    )


def _template_workbook(collection: bpy.types.Collection) -> Path | None:
    """Return the scanner's present workbook, with a warning if it has changed; None, with a warning, if it is gone."""
    properties = collection.mphdrr_scanner
    if not properties.workbook:
        return None
    path = storage.absolute(properties.workbook)
    if not path.is_file():
        warn(f"{path} has gone: made a new workbook instead of a copy of it")
        return None
    if properties.sha256 and hashlib.sha256(path.read_bytes()).hexdigest() != properties.sha256:
        effect = "the modules' cells are overwritten, all else is kept as it is now"
        warn(f"{path} has changed since the scanner was read from it: {effect}")
    return path


def _difference(system: Scanner, written: Scanner) -> str:
    """Return in words the first difference between two systems; "" for none."""
    if not np.array_equal(system.numbers, written.numbers):
        return "the modules' numbers"
    for column in (system.columns[name] for name in system.columns.typed):
        for i in first_true(~column.agree(column.values(written), column.values(system))):
            return f"{column.title} of module {system.numbers[i]}"
    return ""
