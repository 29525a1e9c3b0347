"""Workbooks to be written into, random changes of their systems, and what other programs read from files."""

from __future__ import annotations

import contextlib
import io
import warnings
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import openpyxl
from openpyxl.utils import get_column_letter
from openpyxl.workbook import Workbook

from mphdrr.core import PinholeSystem, WrittenWorkbook, collimator_length, read_system, write_system

from .nasty.layouts import (
    DERIVED_AND_LENGTH,
    PLAIN,
    POSITION,
    SCANNER,
    TYPED,
    Draft,
    Layout,
    laid_out,
    quantity,
    random_centers,
    scanner,
)
from .nasty.sheets import Formula, Sheet, openpyxl_workbook

DIMENSIONS = {"d": "pinhole_diameter", "R": "roi_radius", "Ld": "detector_side", "Td": "detector_thickness"}


def by_design(system: PinholeSystem) -> PinholeSystem:
    """Return the system with the collimator lengths of the design formula."""
    s = system
    length = collimator_length(s.pinhole_distance, s.pinhole_diameter, s.detector_side, s.roi_radius)
    return replace(s, collimator_length=length)


def with_centers(system: PinholeSystem, part, values) -> PinholeSystem:
    """Return the system with `values` in place of `system.centers[part]`, and its collimators designed for them."""
    centers = system.centers.copy()
    centers[part] = values
    return by_design(replace(system, centers=centers))


def read_quietly(path) -> PinholeSystem:
    """Return the system in a file, without its warnings."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return read_system(path)


def write_quietly(system, path, template) -> WrittenWorkbook:
    """Write a system into a template, without its warnings."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return write_system(system, path, template)


def plain(centers: np.ndarray = SCANNER.centers) -> Workbook:
    """Return a workbook in the users' layout, its formulas without values: modules in rows 3, 4, ..."""
    return openpyxl_workbook(laid_out(PLAIN, scanner(centers)).book)


@dataclass(frozen=True)
class TemplateLayout:
    """The layout of a workbook to be written into."""

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


def template_workbook(template: TemplateLayout) -> Workbook:
    """Return a workbook with notes, a column of users and sheets of formulas that depend on the table."""
    names = (*POSITION, *DERIVED_AND_LENGTH, "note", "ratio", *DIMENSIONS)
    letters = {name: get_column_letter(template.left + 2 + k) for k, name in enumerate(names)}
    pinned = names if template.one_sheet else names[:-4]
    layout = Layout(
        modules=template.n,
        seed=3 * template.seed,  # of which the numbers rise
        second="" if template.one_sheet else "sheet",
        main_first=True,
        top=template.top + 1,
        left=template.left,
        order=TYPED[:-1] if template.length == "absent" else TYPED,
        columns=tuple((name, letters[name]) for name in pinned),
        labels=("numbers", "numbers") if template.numbered else ("", ""),
        once="cells" if template.shared else "",
        formulas="unstored",
    )
    draft = laid_out(layout)
    table, system = draft.tables[0], draft.system
    sheet, rows = table.sheet, table.rows
    for i, row in enumerate(rows):
        cell = {name: f"{column}{row}" for name, column in letters.items()}
        if template.length != "formula" and "l" in layout.order:
            sheet[cell["l"]] = float(system.collimator_length[i]) if template.length == "typed" else None
        if template.derived != "formula" and template.length == "formula":
            text = sheet[cell["l"]].text.replace(cell["b"], f"({sheet[cell['b']].text})")
            sheet[cell["l"]] = Formula(text)
        for name in layout.derived:
            if template.derived == "absent" or (template.length == "blank" and name in ("H", "x2", "y2", "z2")):
                sheet[cell[name]] = None
            elif template.derived == "typed":
                sheet[cell[name]] = float(quantity(system, name)[i] * (180 / np.pi if name == "azimuth" else 1))
        if template.derived == "formula":
            sheet[cell["azimuth"]] = Formula(f"DEGREES{sheet[cell['azimuth']].text}")
        sheet[cell["note"]] = f"note of {i}"
        sheet[cell["ratio"]] = Formula(f'IF({cell["z1"]}>0,"up","down")&ROUND({cell["x1"]}/{cell["y1"]},2)')
    for name in layout.derived:
        text = "pinhole azimuth (degrees)" if name == "azimuth" else sheet[draft.heading(name)]
        sheet[draft.heading(name)] = None if template.derived == "absent" else text
    sheet[f"{letters['note']}{table.row}"], sheet[f"{letters['ratio']}{table.row}"] = "note", "ratio"
    if template.inputs:
        sheet[f"{letters['note']}{rows[-1] + 20}"] = float(system.centers[0, 2])
        sheet[draft.at("z1", 0)] = Formula(f"${letters['note']}${rows[-1] + 20}*1")
        draft.table("Td").sheet[draft.at("Td", 0)] = Formula(f"2*{float(system.detector_thickness[0]) / 2!r}")
    _add_summaries(draft)
    return openpyxl_workbook(draft.book)


def _add_summaries(draft: Draft) -> None:
    """Add sheets whose formulas depend on the table directly, through each other, names and whole columns."""
    table, name = draft.tables[0], draft.tables[0].sheet.name
    (x, y, z), first, last = (table.columns[q] for q in POSITION), table.rows[0], table.rows[-1]
    theta, values = Sheet("Theta"), Sheet("It's values")
    draft.book.sheets += [theta, values]
    draft.book.names |= {"first_x": f"{name}!${x}${first}", "all_x": f"{name}!${x}${first}:${x}${last}"}
    for i, formula in enumerate(
        [
            f"SUM({name}!{x}{first}:{x}{last})",
            f"AVERAGE({name}!{y}:{y})",
            "first_x*2",
            "SUMSQ(all_x)",
            f"INDEX({name}!{z}{first}:{z}{last},2)",
            f"IFERROR(MATCH({name}!{x}{first + 1},all_x,0),-1)",
            f"MAX({name}!{x}{first}:{z}{last})-MIN({name}!{x}{first}:{z}{last})",
            f"IF(AND(A1>0,{name}!{x}{first}<>0),1/{name}!{x}{first},COUNT(all_x))",
            f'COUNTIF(all_x,">0")+MOD({name}!{y}{first},7)',
            f"STDEV({name}!{x}{first}:{x}{last})+INT({name}!{z}{first})+SIGN({name}!{y}{first})",
            'SUM(INDIRECT("A1:A4"))',
        ],
        start=1,
    ):
        theta[f"A{i}"] = Formula(formula)
        values[f"B{i}"] = Formula(f"Theta!A{i}*2+1")
    values["D1"], values["D2"] = Formula("SUM(B1:B10)"), Formula("PI()*10")


def random_change(rng, system: PinholeSystem, layout: TemplateLayout) -> PinholeSystem:
    """Return a system with moved, removed, added, reordered or renumbered modules and other dimensions."""
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
        changed_system = replace(changed_system, collimator_length=changed_system.collimator_length * factor)
    return changed_system


def content_of(book: Workbook) -> bytes:
    """Return the bytes of a workbook's file."""
    file = io.BytesIO()
    book.save(file)
    return file.getvalue()


def template_content(**layout) -> bytes:
    """Return the bytes of a workbook to be written into."""
    return content_of(template_workbook(TemplateLayout(**layout)))


def saved_template(path: Path, **layout) -> Path:
    """Write the file of a workbook to be written into, and return its path."""
    path.write_bytes(template_content(**layout))
    return path


def repacked(content: bytes, edit: Callable[[str, bytes], bytes]) -> bytes:
    """Return a workbook with the members' bytes that `edit(name, data)` returns."""
    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as old, zipfile.ZipFile(out, "w") as new:
        for info in old.infolist():
            new.writestr(info, edit(info.filename, old.read(info)))
    return out.getvalue()


@contextlib.contextmanager
def edited(path: Path) -> Iterator[Workbook]:
    """Yield a file's workbook, which is saved again."""
    book = openpyxl.load_workbook(path)
    yield book
    book.save(path)


def values_of(content: bytes | Path, data_only: bool = True) -> dict[tuple[str, str], object]:
    """Return (sheet, cell) -> what openpyxl reads."""
    book = openpyxl.load_workbook(io.BytesIO(content) if isinstance(content, bytes) else content, data_only=data_only)
    return {
        (sheet.title, cell.coordinate): cell.value
        for sheet in book.worksheets
        for row in sheet.iter_rows()
        for cell in row
        if cell.value is not None
    }
