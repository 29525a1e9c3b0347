"""A first column map for a person to check, and what the cells of a workbook show."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace

from ..errors import InputError
from ..recording import recorded_warnings
from .book import HEADING_ROWS, Book, Outdated, Sheet, Uncomputed
from .column_map import ColumnMap, Joined, MappedColumn, MappedTable
from .headings import heading_of, is_number_heading, may_mean
from .layout import Layout, column_map_of
from .quantities import DIMENSIONS, NEEDED, POSITION
from .recognition import recognize, recognized_layout
from .sheet_seen import SheetSeen

_LONGEST = 40


@dataclass(frozen=True)
class ColumnMapDraft:
    """A best guess at a workbook's column map.

    Attributes
    ----------
    columns : ColumnMap
        For a person to check; units that nothing states are empty, and what was not found is missing.
    questions : tuple of str
        What is not certain or missing, a line each; none where the headings are understood.
    """

    columns: ColumnMap
    questions: tuple[str, ...]

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write the map as TOML, the questions as comments above it."""
        lines = ["What the workbook's cells hold, as far as it was seen. Check every line.", *self.questions]
        self.columns.write(path, "\n".join(lines))


def draft_column_map(path: str | os.PathLike[str]) -> ColumnMapDraft:
    """A best guess at a workbook's column map, for a person to check.

    Parameters
    ----------
    path
        An .xlsx or .xlsm file.

    Returns
    -------
    ColumnMapDraft
        For a workbook that `read_system` understands, the map that says the same.

    Raises
    ------
    InputError
        Not a workbook.

    Examples
    --------
    >>> draft = draft_column_map("scanner.xlsx")    # doctest: +SKIP
    >>> draft.write("map.toml")                     # doctest: +SKIP
    """
    book = Book(path)
    recognized = recognize(book)
    try:
        with recorded_warnings():  # said when the workbook is read
            return _certain(recognized_layout(book))
    except InputError as error:
        doubts = [doubt.removeprefix(f"{book.path.name}: ") for doubt in recognized.doubts or [str(error)]]
    tables: list[MappedTable] = []
    coordinates = recognized.taken.get("x1")
    for seen in dict.fromkeys([coordinates, *recognized.taken.values()] if coordinates else recognized.taken.values()):
        if seen is not None:
            tables += _tables(seen, [n for n, of in recognized.taken.items() if of is seen], coordinates)
    missing = [name for name in (*NEEDED, "l") if name not in recognized.taken]
    guessed = _guessed(recognized.sheets, missing, tables)
    if missing and not tables and not guessed:
        sheet = next(iter(book.sheets), "Coordinates")
        guessed = [MappedTable(sheet, 2, 2, ())]
    tables = _merged(tables, guessed)
    columns = ColumnMap(tuple(tables))
    return ColumnMapDraft(columns, tuple(dict.fromkeys([*doubts, *columns.faults()])))


def _certain(layout: Layout) -> ColumnMapDraft:
    """The map of a layout that is heading_of, without optional columns that are not filled: a map's cells must be."""
    values = {
        name: [column.table.sheet.value(row, column.column) for row in column.rows]
        for name, column in layout.columns.items()
    }
    kept = {name for name in values if name in NEEDED or not _has_gaps(values[name])}
    questions = []
    if "l" in values and "l" not in kept and any(value is not None for value in values["l"]):
        questions.append("l stands in some rows only and is left out here: the design formula is then used for all")
    columns = {name: column for name, column in layout.columns.items() if name in kept}
    return ColumnMapDraft(column_map_of(replace(layout, columns=columns)), tuple(questions))


def _has_gaps(values: list[object]) -> bool:
    return any(value is None or isinstance(value, Uncomputed) for value in values)


def preview_workbook(
    path: str | os.PathLike[str], rows: int = 20, columns: int = 26
) -> dict[str, tuple[tuple[str, ...], ...]]:
    """What the first cells of each sheet show, as short texts.

    Parameters
    ----------
    path
        An .xlsx or .xlsm file.
    rows, columns
        How many from the top left; a sheet with fewer gives what it has.

    Returns
    -------
    dict
        Sheet -> rows of texts, the first being row 1 and column A; a blank cell is an empty text.

    Raises
    ------
    InputError
        Not a workbook.
    """
    return {name: _preview(sheet, rows, columns) for name, sheet in Book(path).sheets.items()}


def _preview(sheet: Sheet, rows: int, columns: int) -> tuple[tuple[str, ...], ...]:
    filled = [at for at, cell in sheet.cells.items() if not cell.blank]
    bottom = min(rows, max((row for row, _ in filled), default=0))
    right = min(columns, max((column for _, column in filled), default=0))
    return tuple(
        tuple(_text(sheet.value(row, column)) for column in range(1, right + 1)) for row in range(1, bottom + 1)
    )


def _text(value: object) -> str:
    if value is None:
        return ""
    if isinstance(value, Uncomputed):
        return "(no value)"
    if isinstance(value, Outdated):
        return f"{_text(value.stored)} (outdated: {_text(value.computed)})"
    text = f"{value:.9g}" if type(value) is float else " ".join(str(value).split())
    return text if len(text) <= _LONGEST else text[: _LONGEST - 1] + "…"


def _tables(seen: SheetSeen, names: list[str], coordinates: SheetSeen | None) -> list[MappedTable]:
    """A sheet's part in the map: its rows, and apart from these what one row holds for all modules."""
    from openpyxl.utils import get_column_letter as letters

    rows = seen.rows or (seen.first_row,)
    found = []
    single = {
        name
        for name in names
        if name in DIMENSIONS
        and [row for row in rows if seen.sheet.value(row, seen.columns[name][0]) is not None] == [rows[0]]
        and (len(rows) > 1 or seen is not coordinates)
    }
    number = None if seen.label_column is None else letters(seen.label_column)
    own_labels = coordinates is not None and coordinates.label_column is not None
    joined = None if seen is coordinates else "by number" if number and own_labels else "in order"
    for chosen, how in (
        ([n for n in names if n not in single], joined),
        ([n for n in names if n in single], "one for all"),
    ):
        if not chosen:
            continue
        used = rows if how != "one for all" else rows[:1]
        columns = []
        for name in chosen:
            column, unit = seen.columns[name]
            stated = any(heading.unit for heading in seen.headings[column].values())
            columns.append(MappedColumn(name, letters(column), unit if stated else ""))
        found.append(
            MappedTable(
                sheet=seen.sheet.name,
                first_row=used[0],
                last_row=used[-1],
                columns=tuple(columns),
                number=number if how != "one for all" else None,
                rows=how,  # type: ignore[arg-type]
                header_row=seen.first_heading,
                skip_rows=tuple(sorted(set(range(used[0], used[-1])) - set(used))),
            )
        )
    return found


def _guessed(sheets: dict[str, Sheet], missing: list[str], tables: list[MappedTable]) -> list[MappedTable]:
    """For what has no heading that is heading_of, columns whose headings speak of it."""
    from openpyxl.utils import get_column_letter as letters

    used = {(table.sheet, c.column) for table in tables for c in table.columns}
    found: dict[tuple[str, int, int, int], list[MappedColumn]] = {}
    for name in missing:
        for title, sheet in sheets.items():
            for (row, column), text in sorted(sheet.texts.items()):
                place = (title, letters(column))
                if row > HEADING_ROWS or place in used or name not in may_mean(text) or heading_of(text) is not None:
                    continue
                below = [r for r in sheet.rows if r > row and type(sheet.value(r, column)) is float]
                if below:
                    used.add(place)
                    key = (title, row, below[0], below[-1])
                    found.setdefault(key, []).append(MappedColumn(name, letters(column), ""))
                    break
            else:
                continue
            break
    made = []
    for (title, row, first, last), columns in found.items():
        how = None if any(c.quantity in POSITION for c in columns) else "one for all" if first == last else "in order"
        number = None if how == "one for all" else _number_column(sheets[title], used)
        made.append(MappedTable(title, first, last, tuple(columns), number, how, row))  # type: ignore[arg-type]
    return made


def _number_column(sheet: Sheet, used: set[tuple[str, str]]) -> str | None:
    """Letters of the one column of a sheet that is headed as the modules' numbers."""
    from openpyxl.utils import get_column_letter as letters

    headed = {letters(c) for (r, c), text in sheet.texts.items() if r <= HEADING_ROWS and is_number_heading(text)}
    headed = {column for column in headed if (sheet.name, column) not in used}
    return headed.pop() if len(headed) == 1 else None


def _merged(tables: list[MappedTable], guessed: list[MappedTable]) -> list[MappedTable]:
    """All tables, those with coordinates first; guessed columns join the table whose rows they share."""
    found = list(tables)
    for table in guessed:
        for i, other in enumerate(found):
            if (other.sheet, other.first_row, other.last_row) == (table.sheet, table.first_row, table.last_row):
                found[i] = replace(other, columns=other.columns + table.columns)
                break
        else:
            found.append(table)
    found.sort(key=lambda table: not any(c.quantity in POSITION for c in table.columns))
    joined: Joined = "by number" if found and found[0].number else "in order"
    return [
        replace(table, rows=None)
        if i == 0
        else replace(table, rows=table.rows if table.rows == "one for all" else joined if table.number else "in order")
        for i, table in enumerate(found)
    ]
