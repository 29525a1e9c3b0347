"""What in a table or around it may give its numbers another meaning than the headings say."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator

from .headed_table import HeadedTable, is_number
from .headings import UNIT_WORDS, heading_of, may_mean, quoted, shows_as_stored, unit_of, units_mentioned
from .quantities import LENGTH_UNITS, QUANTITIES
from .sheet_xml import At


def doubts_about(table: HeadedTable, quantities: set[str]) -> Iterator[str]:
    """The doubts about a table that these quantities are read from, each as the text of a message."""
    used = [table.columns[name] for name in table.columns if name in quantities]
    lengths = {unit for _, unit in used if unit in LENGTH_UNITS}
    yield from _headings(table)
    for at, text in table.unknown():
        for name in [name for name in may_mean(text) if name in quantities][:1]:
            yield f"{table.sheet.place(*at)} is headed {quoted(text)}, which is not understood and may mean {name}"
    numbers = [table.sheet.place(*at) for at in table.number_columns.values()]
    if len(numbers) > 1:
        yield f"{numbers[0]} and {numbers[1]} both head the modules' numbers, expected one such column"
    yield from _other_tables(table)
    yield from _texts_between_modules(table)
    yield from _notes_with_units(table, lengths)
    yield from _columns(table, used)


def listed(units: set[str]) -> str:
    """Units as messages list them."""
    return " and ".join(sorted(units))


def _headings(table: HeadedTable) -> Iterator[str]:
    """Columns with the same quantity, or with headings that say different things or more than a quantity and unit."""
    for column, said in sorted(table.headings.items()):
        quantity, place = table.quantity(column), table.heading_place(column)
        for at, text in table.head.items():
            if at[1] != column:
                continue
            heading = said.get(at[0])
            if heading is None and unit_of(text) not in QUANTITIES[quantity].units:
                yield (
                    f"{table.sheet.place(*at)} holds {quoted(text)} in the heading of {quantity}, expected its name and a "
                    "unit alone"
                )
            if heading is not None and heading.quantity != quantity:
                yield (
                    f"{table.sheet.place(*at)} is headed as {heading.quantity} but {place} as {quantity}, expected "
                    "one of them"
                )
        units = [(unit, table.sheet.place(*at)) for unit, at in table.units(column).items()]
        if len(units) > 1:
            (unit, cell), (other, its) = units[:2]
            yield f"{cell} says {unit} but {its} {other}, expected one unit of {quantity}"
        for area in table.sheet.merged:
            if area.left < area.right and area.left <= column <= area.right and area.top in said:
                yield f"{table.sheet.place(area.top, area.left)} heads several columns as {quantity}, merged"
        first, _ = table.columns[quantity]
        if first != column:
            yield f"{table.heading_place(first)} and {place} are both headed as {quantity}, expected one such column"


def _other_tables(table: HeadedTable) -> Iterator[str]:
    """Headings apart from the table's: a second table, or a second heading."""
    apart: dict[int, dict[str, int]] = defaultdict(dict)
    for (row, column), text in table.sheet.texts.items():
        heading = heading_of(text)
        if heading is not None and not table.first_heading <= row < table.first_row:
            apart[row][heading.quantity] = column
    for row, found in sorted(apart.items()):
        over_numbers = any(is_number(table.sheet, row + 1, column) for column in found.values())
        if row < table.first_heading or len(found) > 1 or over_numbers:
            name, column = next(iter(found.items()))
            yield (
                f"{table.sheet.place(row, column)} is headed as {name}, apart from the headings in row "
                f"{table.first_heading}, expected one table"
            )
            return


def _texts_between_modules(table: HeadedTable) -> Iterator[str]:
    """Texts or sums between the modules' rows: what follows may be another table."""
    if not table.rows:
        return
    columns = {*table.headings, table.label_column or min(table.headings)}
    between = set(range(table.rows[0], table.rows[-1])).difference(table.rows)
    found = {row: at for row, at in table.summaries.items() if row in between}
    for row, column in table.sheet.texts:
        if row in between and min(columns) <= column <= max(columns):
            found.setdefault(row, (row, column))
    for row, at in sorted(found.items()):
        place = table.sheet.place(*at)
        if row in table.summaries:
            yield f"{place} sums up its column between rows of modules, expected sums below the last module"
        else:
            yield f"{place} holds {quoted(table.sheet.texts[at])} between rows of modules, expected one table"
        return


def _notes_with_units(table: HeadedTable, lengths: set[str]) -> Iterator[str]:
    """Units in the sheet's name, in its notes and in comments on the headings that are not those of the headings."""
    sheet, headings_say = table.sheet, f"where the headings say {listed(lengths)}"
    for unit in units_mentioned(sheet.name.replace("_", " ")):
        if lengths != {unit}:
            yield f"the name of sheet {sheet.name} speaks of {unit}, {headings_say}"
    modules = set(table.rows)
    texts_of_row: dict[int, list[At]] = defaultdict(list)
    for at in sheet.texts:
        texts_of_row[at[0]].append(at)
    for at, text in sheet.texts.items():
        row, column = at
        if at in table.head and (column in table.headings or _heads_its_own_numbers(table, at)):
            continue
        for unit in units_mentioned(text, alone=row in modules):
            others = (sheet.texts[other] for other in texts_of_row[row] if other != at)
            explained = unit in UNIT_WORDS and any(map(units_mentioned, others))
            if lengths != {unit} and not explained:
                yield f"{sheet.place(*at)} holds {quoted(text)}, {headings_say}: expected one unit"
    for at, text in sheet.book.workbook.comments(sheet.name).items():
        if at[0] < table.first_row and any(lengths != {unit} for unit in units_mentioned(text)):
            yield f"{sheet.place(*at)} has the comment {quoted(text)}, {headings_say}: expected one unit"


def _heads_its_own_numbers(table: HeadedTable, at: At) -> bool:
    """Whether a text heads a column of other numbers: its unit is theirs alone."""
    only_a_unit = len(table.other_heads[at[1]]) == 1 and units_mentioned(table.head[at], alone=True)
    return at[1] in table.numeric - {table.label_column} and not only_a_unit


def _columns(table: HeadedTable, used: list[tuple[int, str]]) -> Iterator[str]:
    """Number formats, merged cells and texts above a heading that give the numbers in `used` columns another meaning."""
    sheet = table.sheet
    for column, unit in used:
        for row in table.rows:
            shown = sheet.number_format(row, column)
            if not sheet.is_date(row, column) and not shows_as_stored(shown, unit):
                place = sheet.place(row, column)
                yield f"{place} is shown as {quoted(shown)}, where its heading says {unit}: expected one unit"
                break
    for area in sheet.merged:
        below = [(row, c) for c, _ in used for row in table.rows if area.contains(row, c)]
        for at in below:
            if at != (area.top, area.left) and sheet.value(*at) is not None:
                yield f"{sheet.place(*at)} is hidden under a merged cell, expected a visible number"
                break
    for column, _ in used:
        above = next(iter(table.headings[column])) - 1, column
        at = next(((area.top, area.left) for area in sheet.merged if area.contains(*above)), above)
        if at in sheet.texts and at not in table.head:
            text = quoted(sheet.texts[at])
            yield f"{sheet.place(*at)} holds {text} right above a heading, expected nothing, or a row between"
            break
