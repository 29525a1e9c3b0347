"""What around a table may make its numbers mean something else than the headings say."""

from __future__ import annotations

from collections import defaultdict

from .headings import UNIT_WORDS, heading_of, may_mean, quoted, shows_as_stored, units_mentioned
from .quantities import LENGTH_UNITS
from .sheet_seen import SheetSeen, is_number, several
from .sheet_xml import At


def look_around(seen: SheetSeen, quantities: set[str]) -> None:
    """Note what else in the sheet may concern `quantities`, which are taken from here."""
    for at, text in seen.unknown():
        about = [name for name in may_mean(text) if name in quantities]
        if about:
            seen.doubt(
                f"{seen.sheet.place(*at)} is headed {quoted(text)}, which is not understood and may mean {about[0]}"
            )
    _other_tables(seen)
    _texts_between(seen)
    used = [seen.columns[name] for name in seen.columns if name in quantities]
    lengths = {unit for _, unit in used if unit in LENGTH_UNITS}
    _notes(seen, lengths)
    _formats(seen, used)
    _hidden_under_merged(seen, used)
    _above_headings(seen, used)


def _hidden_under_merged(seen: SheetSeen, used: list[tuple[int, str]]) -> None:
    """Numbers that a merged cell covers, so that nobody sees them."""
    for area in seen.merged:
        for column, _ in used:
            for row in seen.rows:
                inside = area.top <= row <= area.bottom and area.left <= column <= area.right
                if inside and (row, column) != (area.top, area.left) and seen.sheet.value(row, column) is not None:
                    seen.doubt(f"{seen.sheet.place(row, column)} is hidden under a merged cell, expected it to be seen")
                    return


def _above_headings(seen: SheetSeen, used: list[tuple[int, str]]) -> None:
    """A text right above a heading, or merged over it, which may be part of what it says."""
    for column, _ in used:
        at = next(iter(seen.headings[column])) - 1, column
        over = [a for a in seen.merged if a.top <= at[0] <= a.bottom and a.left <= column <= a.right]
        at = (over[0].top, over[0].left) if over else at
        if at in seen.sheet.texts and at not in seen.above:
            text = quoted(seen.sheet.texts[at])
            seen.doubt(
                f"{seen.sheet.place(*at)} holds {text} right above a heading, expected nothing, or a row between"
            )
            return


def _other_tables(seen: SheetSeen) -> None:
    """Headings of what is needed that stand apart: a second table, or a second heading."""
    apart: dict[int, dict[str, int]] = defaultdict(dict)
    for (row, column), text in seen.sheet.texts.items():
        heading = heading_of(text)
        if heading is not None and not seen.first_heading <= row < seen.first_row:
            apart[row][heading.quantity] = column
    for row, found in sorted(apart.items()):
        over_numbers = any(is_number(seen.sheet, row + 1, column) for column in found.values())
        if row < seen.first_heading or len(found) > 1 or over_numbers:
            name, column = next(iter(found.items()))
            seen.doubt(
                f"{seen.sheet.place(row, column)} is headed as {name}, apart from the headings in row "
                f"{seen.first_heading}, expected one table"
            )
            return


def _texts_between(seen: SheetSeen) -> None:
    """Something between the modules' rows: what follows may be another table."""
    if not seen.rows:
        return
    columns = {*seen.headings, seen.label_column or min(seen.headings)}
    modules = set(seen.rows)
    for row in range(seen.rows[0], seen.rows[-1] + 1):
        if row in modules:
            continue
        if row in seen.summaries:
            place = seen.sheet.place(*seen.summaries[row])
            seen.doubt(f"{place} sums up its column between rows of modules, expected sums below the last module")
            return
        texts = [at for at in seen.texts_of_row.get(row, ()) if min(columns) <= at[1] <= max(columns)]
        if texts:
            text = quoted(seen.sheet.texts[texts[0]])
            seen.doubt(f"{seen.sheet.place(*texts[0])} holds {text} between rows of modules, expected one table")
            return


def _notes(seen: SheetSeen, lengths: set[str]) -> None:
    """Units in the sheet's name and in texts that are no heading, and that are not the headings' own."""
    for unit in units_mentioned(seen.sheet.name.replace("_", " ")):
        if lengths != {unit}:
            seen.doubt(
                f"the name of sheet {seen.sheet.name} speaks of {unit}, where the headings say {several(lengths)}"
            )
    modules = set(seen.rows)
    for at, text in seen.sheet.texts.items():
        row, column = at
        if at in seen.above and (column in seen.headings or _heads_its_own(seen, at)):
            continue
        for unit in units_mentioned(text, alone=row in modules):
            named = unit in UNIT_WORDS and any(
                units_mentioned(seen.sheet.texts[a]) for a in seen.texts_of_row[row] if a != at
            )
            if lengths != {unit} and not named:
                seen.doubt(
                    f"{seen.sheet.place(*at)} holds {quoted(text)}, where the headings say {several(lengths)}: "
                    "expected one unit"
                )
    for at, text in seen.sheet.comments.items():
        if at[0] < seen.first_row and any(lengths != {unit} for unit in units_mentioned(text)):
            seen.doubt(
                f"{seen.sheet.place(*at)} has the comment {quoted(text)}, where the headings say "
                f"{several(lengths)}: expected one unit"
            )


def _heads_its_own(seen: SheetSeen, at: At) -> bool:
    """Whether a text is the heading of numbers that are of no concern: its unit is theirs alone."""
    alone = len(seen.aside[at[1]]) == 1 and units_mentioned(seen.above[at], alone=True)
    return at[1] in seen.numeric - {seen.label_column} and not alone


def _formats(seen: SheetSeen, used: list[tuple[int, str]]) -> None:
    """Number formats that show another unit, or another number, than the cell's."""
    for column, unit in used:
        for row in seen.rows:
            if (row, column) not in seen.sheet.cells or seen.sheet.is_date(row, column):
                continue
            shown = seen.sheet.number_format(row, column)
            if not shows_as_stored(shown, unit):
                seen.doubt(
                    f"{seen.sheet.place(row, column)} is shown as {quoted(shown)}, where its heading says {unit}: "
                    "expected one unit"
                )
                break
