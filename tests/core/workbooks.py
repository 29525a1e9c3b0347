"""Workbooks of random layouts, random changes of their systems, and what other programs read from files."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import openpyxl
from openpyxl.utils import get_column_letter as letter
from openpyxl.workbook import Workbook
from openpyxl.workbook.defined_name import DefinedName

from mphdrr.core import PinholeSystem, WrittenWorkbook, collimator_length, read_system, write_system

DIMENSIONS = {"d": "pinhole_diameter", "R": "roi_radius", "Ld": "detector_side", "Td": "detector_thickness"}


def designed(centers, d, R, Ld, Td, numbers=None, length=None) -> PinholeSystem:
    if length is None:
        length = collimator_length(np.linalg.norm(centers, axis=1), d, Ld, R)
    return PinholeSystem(centers, d, length, Ld, Td, R, numbers)


def by_design(system: PinholeSystem) -> PinholeSystem:
    s = system
    return dataclasses.replace(
        s, collimator_length=collimator_length(s.pinhole_distance, s.pinhole_diameter, s.detector_side, s.roi_radius)
    )


def read_quietly(path) -> PinholeSystem:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return read_system(path)


def write_quietly(system, path, template) -> WrittenWorkbook:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return write_system(system, path, template)


def random_centers(rng, n: int) -> np.ndarray:
    directions = rng.normal(size=(n, 3))
    return np.round(directions / np.linalg.norm(directions, axis=1)[:, None] * rng.uniform(120, 300, (n, 1)), 4)


def random_system(rng, n: int, shared: bool) -> PinholeSystem:
    many = 1 if shared else n
    d, R, Ld, Td = (np.resize(np.round(rng.uniform(*r, many), 2), n) for r in ((1, 4), (50, 80), (40, 60), (5, 12)))
    numbers = np.sort(rng.choice(np.arange(1, 400), n, replace=False))
    return designed(random_centers(rng, n), d, R, Ld, Td, numbers)


@dataclasses.dataclass(frozen=True)
class Layout:
    """The layout of a random workbook."""

    n: int = 4
    numbered: bool = True
    one_sheet: bool = False
    shared: bool = False  # one row of dimensions for all
    length: str = "formula"  # or typed, blank, absent
    derived: str = "formula"  # or typed, absent
    inputs: bool = False  # some of them formulas
    top: int = 0
    left: int = 0
    seed: int = 0


def laid_out(layout: Layout) -> Workbook:
    """A workbook with the layout, and sheets of formulas that depend on each other and on the table."""
    rng = np.random.default_rng(layout.seed)
    system = random_system(rng, layout.n, layout.shared)
    book = Workbook()
    main, table = book.active, book.create_sheet("Coordinates")
    main.title = "Main"
    if layout.one_sheet:
        book.remove(main)
        main = table
    top, left, n = layout.top, layout.left, layout.n
    first, last = top + 3, top + 2 + n
    number, x, y, z = (letter(left + i) for i in (1, 2, 3, 4))
    column = {name: letter(left + i) for i, name in enumerate(("b", "l", "H", "x2", "azimuth", "elevation"), start=5)}
    note, user = letter(left + 11), letter(left + 12)
    dims_left = left + (20 if layout.one_sheet else 0)
    dim = {name: letter(dims_left + i) for i, name in enumerate(DIMENSIONS, start=2)}
    prefix = "" if layout.one_sheet else "Main!"

    def dimension(name: str, row: int) -> str:
        return f"{prefix}${dim[name]}${first}" if layout.shared else f"{prefix}{dim[name]}{row}"

    headings = {x: "x1", y: "y1", z: "z1", note: "note", user: "ratio"}
    if layout.length != "absent":
        headings[column["l"]] = "length of collimator"
    if layout.derived != "absent":
        headings |= {column["b"]: "b", column["H"]: "l + b+Td", column["x2"]: "x2"}
        headings |= {column["azimuth"]: "pinhole azimuth (degrees)", column["elevation"]: "pinhole elevation"}
    for at, text in headings.items():
        table[f"{at}{top + 2}"] = text
    for name, at in dim.items():
        main[f"{at}{top + 2}"] = name
    b_formula = f"SQRT(SUMSQ({x}#,{y}#,{z}#))"
    expected = {name: PinholeSystem.columns[name].values(system) for name in PinholeSystem.columns.derived}
    for i in range(n):
        row = first + i
        if layout.numbered:
            table[f"{number}{row}"] = main[f"{letter(left + 1)}{row}"] = int(system.numbers[i])
        for at, value in zip((x, y, z), system.centers[i], strict=True):
            table[f"{at}{row}"] = float(value)
        table[f"{note}{row}"] = f"note of {i}"
        if not layout.shared or i == 0:
            for name, attribute in DIMENSIONS.items():
                main[f"{dim[name]}{row}"] = float(getattr(system, attribute)[i])
        d, R, Ld, Td = (dimension(name, row) for name in DIMENSIONS)
        b = f"{column['b']}{row}" if layout.derived == "formula" else f"({b_formula.replace('#', str(row))})"
        if layout.length == "formula":
            table[f"{column['l']}{row}"] = f"=({Ld}-{d})*({b}^2-{R}^2)/({b}*{d}+2*{R}*SQRT({b}^2-{R}^2+{d}^2/4))"
        elif layout.length == "typed":
            table[f"{column['l']}{row}"] = float(system.collimator_length[i])
        length = f"{column['l']}{row}" if layout.length == "formula" else str(float(system.collimator_length[i]))
        if layout.derived == "formula":
            table[f"{column['b']}{row}"] = "=" + b_formula.replace("#", str(row))
            table[f"{column['azimuth']}{row}"] = f"=DEGREES(ATAN2({x}{row},{y}{row}))"
            table[f"{column['elevation']}{row}"] = f"=ASIN({z}{row}/{column['b']}{row})"
            if layout.length == "formula":
                table[f"{column['H']}{row}"] = f"={b}+{length}+{Td}"
                table[f"{column['x2']}{row}"] = f"={x}{row}*{column['H']}{row}/{b}"
        elif layout.derived == "typed":
            for name in ("b", "H", "x2", "azimuth", "elevation"):
                value = expected[name][i] * (180 / np.pi if name == "azimuth" else 1)
                table[f"{column[name]}{row}"] = float(value)
        table[f"{user}{row}"] = f'=IF({z}{row}>0,"up","down")&ROUND({x}{row}/{y}{row},2)'
    if layout.inputs:
        table[f"{note}{last + 20}"] = float(system.centers[0, 2])
        table[f"{z}{first}"] = f"=${note}${last + 20}*1"
        main[f"{dim['Td']}{first}"] = f"=2*{float(system.detector_thickness[0]) / 2!r}"
    _summaries(book, table.title, x, y, z, first, last)
    return book


def _summaries(book: Workbook, name: str, x: str, y: str, z: str, first: int, last: int) -> None:
    """Sheets whose formulas depend on the table directly, through each other, names and whole columns."""
    theta, values = book.create_sheet("Theta"), book.create_sheet("It's values")
    book.defined_names["first_x"] = DefinedName("first_x", attr_text=f"{name}!${x}${first}")
    book.defined_names["all_x"] = DefinedName("all_x", attr_text=f"{name}!${x}${first}:${x}${last}")
    for i, formula in enumerate(
        [
            f"=SUM({name}!{x}{first}:{x}{last})",
            f"=AVERAGE({name}!{y}:{y})",
            "=first_x*2",
            "=SUMSQ(all_x)",
            f"=INDEX({name}!{z}{first}:{z}{last},2)",
            f"=IFERROR(MATCH({name}!{x}{first + 1},all_x,0),-1)",
            f"=MAX({name}!{x}{first}:{z}{last})-MIN({name}!{x}{first}:{z}{last})",
            f"=IF(AND(A1>0,{name}!{x}{first}<>0),1/{name}!{x}{first},COUNT(all_x))",
            f'=COUNTIF(all_x,">0")+MOD({name}!{y}{first},7)',
            f"=STDEV({name}!{x}{first}:{x}{last})+INT({name}!{z}{first})+SIGN({name}!{y}{first})",
            '=SUM(INDIRECT("A1:A4"))',
        ],
        start=1,
    ):
        theta[f"A{i}"] = formula
        values[f"B{i}"] = f"=Theta!A{i}*2+1"
    values["D1"] = "=SUM(B1:B10)"
    values["D2"] = "=PI()*10"


def random_change(rng, system: PinholeSystem, layout: Layout) -> PinholeSystem:
    """A system with moved, removed, added, reordered or renumbered modules and other dimensions."""
    n = len(system)
    order = np.arange(n)
    if rng.random() < 0.4:
        order = rng.permutation(n)
    if rng.random() < 0.5:
        order = order[rng.random(n) < 0.7]
    if len(order) == 0:
        order = np.array([n - 1])
    part = system[order]
    arrays = {name: getattr(part, name).copy() for name in ("centers", *DIMENSIONS.values(), "numbers")}
    arrays["collimator_length"] = part.collimator_length.copy()
    if rng.random() < 0.7:
        moved = rng.random(len(part)) < 0.5
        arrays["centers"][moved] = random_centers(rng, int(moved.sum()))
    for name in DIMENSIONS.values():
        if rng.random() < 0.3:
            arrays[name] *= rng.uniform(0.9, 1.1) if rng.random() < 0.5 else rng.uniform(0.9, 1.1, len(part))
    added = int(rng.integers(0, 4)) if rng.random() < 0.5 else 0
    if added:
        for name, array in arrays.items():
            arrays[name] = np.concatenate([array, np.resize(array, (added, *array.shape[1:]))])
        arrays["centers"][-added:] = random_centers(rng, added)
        arrays["numbers"][-added:] = 500 + np.arange(added)
        if rng.random() < 0.3:
            order = rng.permutation(len(arrays["numbers"]))
            arrays = {name: array[order] for name, array in arrays.items()}
    if rng.random() < 0.2:
        arrays["numbers"] = arrays["numbers"] + 1000
    changed_system = by_design(PinholeSystem(**arrays))
    if layout.length in ("formula", "typed", "blank") and rng.random() < 0.3:
        factor = np.where(rng.random(len(changed_system)) < 0.5, 1.1, 1.0)
        changed_system = dataclasses.replace(
            changed_system, collimator_length=changed_system.collimator_length * factor
        )
    return changed_system


def content_of(book: Workbook) -> bytes:
    file = io.BytesIO()
    book.save(file)
    return file.getvalue()


def saved_layout(path: Path, **layout) -> Path:
    """The file of a workbook with this layout."""
    path.write_bytes(content_of(laid_out(Layout(**layout))))
    return path


@contextlib.contextmanager
def edited(path: Path) -> Iterator[Workbook]:
    """A file's workbook, which is saved again."""
    book = openpyxl.load_workbook(path)
    yield book
    book.save(path)


def values_of(content: bytes | Path, data_only: bool = True) -> dict[tuple[str, str], object]:
    """(sheet, cell) -> what openpyxl reads."""
    book = openpyxl.load_workbook(io.BytesIO(content) if isinstance(content, bytes) else content, data_only=data_only)
    return {
        (sheet.title, cell.coordinate): cell.value
        for sheet in book.worksheets
        for row in sheet.iter_rows()
        for cell in row
        if cell.value is not None
    }
