"""Headings: words that change what a column holds, second candidates, other languages, odd characters."""

from __future__ import annotations

from .case import DOUBTED, READ_OR_REFUSED, REFUSED, RIGHT, WARNED, Catalogue
from .scanners import (
    BIG,
    DESCRIPTIONS,
    ONE_SHEET_COLUMNS,
    SCANNER,
    SYMBOLS,
    USERS_COLUMNS,
    one_sheet,
    one_sheet_map,
    quantity,
    scaled,
    typed,
    users,
    users_map,
    with_cells,
    with_gap,
)
from .sheets import Book, Formula, Raw, Rich, Sheet

CASES = Catalogue("headings", place=("Geometry", "scanner.xlsx"), columns=one_sheet_map())
GEOMETRY = ("Geometry!",)
OF_USERS = {"place": ("Main!", "Coordinates!"), "columns": users_map()}
ROWS = range(2, 6)


def _words_in_a_heading() -> None:
    # The column contains another quantity and must not be read. A map does not help: the numbers are different.
    for name, heading, factor in (
        ("d", "d/2", 0.5),
        ("d", "radius of pinhole", 0.5),
        ("d", "outer diameter of pinhole insert", 4.0),
        ("d", "d²", 4.0),
        ("d", "d (±)", 0.01),
        ("R", "r", 0.9),
        ("R", "range", 1.1),
        ("R", "ROI diameter", 2.0),
        ("R", "radius of detector ring", 1.5),
        ("Ld", "area of detector crystal", 1.3),
        ("Ld", "length of detector crystal diagonal", 1.4142),
        ("Td", "thickness of pinhole plate", 0.5),
        ("Td", "tolerance of thickness of detector crystal", 0.01),
        ("x1", "x1²", 1.2),
        ("x1", "-x1", -1.0),
        ("x1", "x1/b", 0.9),
        ("x1", "x1 nominal", 1.01),
        ("x1", "x1, mirrored", -1.0),
        ("x1", "x10", 1.1),
        ("x1", "x coordinate value at center of detector", 1.3),
        ("x1", "x coordinate value at center of hole (old)", 1.05),
    ):
        # Without l, which would tell on it.
        book = scaled(one_sheet(BIG, {name: heading}, length=False), factor, _cells_of(name))
        CASES.add(f"{name}: {heading}", book, None, REFUSED)
    # An unknown column is no l, which is then by design.
    without_l = one_sheet_map(columns={"l": ""})
    for heading, factor in (("length of collimator + detector", 1.1), ("l (max)", 1.1)):
        book = scaled(one_sheet(BIG, {"l": heading}), factor, _cells_of("l"))
        CASES.add(f"l: {heading}", book, BIG, REFUSED, WARNED, RIGHT, place=GEOMETRY, columns=without_l)


def _cells_of(name: str) -> list[str]:
    return [f"{ONE_SHEET_COLUMNS[name]}{row}" for row in ROWS]


def _second_candidates() -> None:
    def beside(name: str, first: str, second: str, right: str) -> tuple[Book, str]:
        """Two columns for one quantity; `right` of the two headings has the truth."""
        made = with_cells(one_sheet(BIG, {name: first}, length=name == "l"), J1=second)
        sheet, own = made.sheets[0], ONE_SHEET_COLUMNS[name]
        for row in ROWS:
            sheet[f"J{row}"] = sheet[f"{own}{row}"]
            sheet[f"{'J' if right == first else own}{row}"] *= 1.01
        columns = {name: own if right == first else "J"}
        return made, one_sheet_map(columns={**columns, **({} if name == "l" else {"l": ""})})

    for name, first, second in (
        ("x1", "x1", "x1"),
        ("x1", "x1", "x1 [mm]"),
        ("x1", "x1 (mm)", "x1 (cm)"),
        ("x1", "x1 old", "x1 new"),
        ("x1", "x1", "x coordinate value at center of hole (surveyed)"),
        ("y1", "y1 (CAD)", "y1 (CMM)"),
        ("d", "d", "d measured"),
        ("R", "R", "ROI radius"),
        ("Ld", "Ld", "Ld*"),
        ("l", "l", "l new"),
        ("l", "l", "length of collimator"),
    ):
        for right in dict.fromkeys((second, first)):
            book, mapped = beside(name, first, second, right)
            what = f"{first!r} beside {second!r}, {right!r} is meant"
            CASES.add(what, book, BIG, REFUSED, place=GEOMETRY, columns=mapped)
    # Columns whose names look like another's, all needed ones there as well.
    for other, value in (
        ("D", 500.0),
        ("B", 1.0),
        ("x2", None),
        ("x1 error", 0.1),
        ("half diameter of pinhole", 2.0),
        ("material of collimator", 11.3),
        ("side", "left"),
        ("note", "10 cm lead behind"),
        ("z1 limit (cm)", 12.0),
    ):
        values = quantity(BIG, "x2").tolist() if value is None else [value] * 4
        book = with_cells(one_sheet(BIG), J1=other, **{f"J{2 + i}": v for i, v in enumerate(values)})
        CASES.add(f"a column {other!r} as well", book, BIG, RIGHT, WARNED, REFUSED, place=GEOMETRY)
    serial = with_cells(one_sheet(BIG), J1="serial", J2="W-7", J3="W-8", J4="W-9", J5="W-10")
    CASES.add("a column 'serial' of texts as well", serial, BIG, RIGHT)


def _symbols_and_descriptions() -> None:
    def of(column: str, text: object, row: int = 2) -> dict[str, object]:
        return {f"{'Main' if column in 'PQST' else 'Coordinates'}_{column}{row}": text}

    for name, cells in {
        "x1 described as y": of("B", DESCRIPTIONS["y1"]),
        "x1 described with another reference": of("B", "x coordinate value at center of plate"),
        "l described as Ld": of("G", DESCRIPTIONS["Ld"]),
        "d described as radius": of("P", "radius of pinhole"),
        "symbol y1 over the description of x1": of("B", "y1", 1),
        "symbol r over the description of d": of("P", "r", 1),
        "symbol Td over the description of Ld": of("S", "Td", 1),
    }.items():
        CASES.add(name, with_cells(users(), **cells), SCANNER, REFUSED, **OF_USERS)
    # A person understands these; no word of them is a quantity's.
    for name, cells in {
        "a typing error": of("G", "lenght of collimator"),
        "center spelt centre, in capitals": of("B", DESCRIPTIONS["x1"].replace("center", "centre").upper()),
        "several lines": of("P", "diameter\nof pinhole"),
        "a colon": of("B", "x1:", 1),
        "blanks around, one that does not break": of("B", f"  {DESCRIPTIONS['x1']}\N{NO-BREAK SPACE} "),
        "a subscript, in capitals": of("B", "X₁", 1),
        "underscores": of("B", "x_1", 1),
        "quotes": of("H", "'l + b+Td'", 1),
        "a numbered footnote": of("B", "x1 ¹⁾", 1),
        "no description of x1": of("B", None),
        "no symbol of x1": of("B", None, 1),
        "a comment as description": of("B", "see drawing 12"),
        "a zero-width space": of("B", "x1\N{ZERO WIDTH SPACE}", 1),
        "full-width letters": of("B", "ｘ１", 1),
        "a Cyrillic x": of("B", "х1", 1),
        "a letter l for the digit 1": of("B", "xl", 1),
        "D for d": of("P", "D", 1),
        "angles without a unit": {**of("V", "pinhole azimuth"), **of("W", "pinhole elevation")},
    }.items():
        CASES.add(f"understood: {name}", with_cells(users(), **cells), SCANNER, *READ_OR_REFUSED, **OF_USERS)
    struck_out = "<r><rPr><strike/></rPr><t>y</t></r><r><t>x1</t></r>"
    for name, value in {
        "fonts": Rich('<r><t>x</t></r><r><rPr><vertAlign val="subscript"/></rPr><t>1</t></r>'),
        "fonts, a letter struck out": Rich(struck_out),
        "a reading of Japanese": Rich('<t>x1</t><rPh sb="0" eb="2"><t>エックスいち</t></rPh><phoneticPr fontId="1"/>'),
        "text in the cell, of fonts": Raw('<c r="B1" t="inlineStr"><is><r><t>x</t></r><r><t>1</t></r></is></c>'),
        "a formula": Formula('"x"&1', "x1"),
        "a formula that names another cell": Formula("AA1", "x1"),
        "CDATA": Raw('<c r="B1" t="inlineStr"><is><t><![CDATA[x1]]></t></is></c>'),
        "Excel's escape": Raw('<c r="B1" t="inlineStr"><is><t>x_x0031_</t></is></c>'),
    }.items():
        made = with_cells(users(), Coordinates_B1=value, Coordinates_AA1="x1" if "another cell" in name else None)
        CASES.add(f"heading by {name}", made, SCANNER, *READ_OR_REFUSED, **OF_USERS)
    stale = {"B1": Formula('"y"&1', "x1"), "C1": Formula('"x"&1', "y1"), "B2": None, "C2": None}
    unstored = with_cells(users(), **{f"Coordinates_{at}": value for at, value in stale.items()})
    unstored.calculation = '<calcPr calcId="191029" fullCalcOnLoad="1"/>'
    CASES.add("headings by stale formulas", unstored, None, *DOUBTED)


def _other_headings() -> None:
    """Whole rows of headings that a person understands and no vocabulary needs to have."""
    rows = {
        "Chinese": "孔中心 x|孔中心 y|孔中心 z|孔径|感兴趣区半径|晶体边长|晶体厚度|准直器长度",
        "short words": "x|y|z|diameter|ROI|crystal|thickness|length",
        "positions": "x position of hole|y position of hole|z position of hole|hole diameter|radius of ROI|detector size"
        "|detector thickness|pinhole to crystal",
    }
    sets = {name: dict(zip(ONE_SHEET_COLUMNS, row.split("|"), strict=True)) for name, row in rows.items()}
    sets["descriptions only"] = DESCRIPTIONS
    for name, names in sets.items():
        CASES.add(f"headings: {name}", one_sheet(BIG, names), BIG, *READ_OR_REFUSED)
    for number in ("", "Nr.", "pinhole", "serial"):
        CASES.add(f"numbers headed {number!r}", one_sheet(BIG, number=number), BIG, *READ_OR_REFUSED)
    # Headings in two rows, a common word merged over three letters.
    for words, names, scale, allowed in (
        (("pinhole", "crystal"), "xyz", 1.3, READ_OR_REFUSED),
        (("hole centre", "detector end"), "xyz", 1.3, READ_OR_REFUSED),
        (("nominal", "measured"), ("x1", "y1", "z1"), 1.01, (REFUSED,)),
    ):
        made = one_sheet(BIG, dict(zip(("x1", "y1", "z1"), names, strict=True)), top=2)
        sheet = with_cells(made, B1=words[0], J1=words[1]).sheets[0]
        sheet.merged += ["B1:D1", "J1:L1"]
        sheet.put("J2", [["x", "y", "z"], *(BIG.centers * scale).tolist()])
        what = f"x y z under {words[0]!r} and under {words[1]!r}"
        CASES.add(what, made, BIG, *allowed, place=GEOMETRY, columns=one_sheet_map("mm", 3, 6))
    # What changes no number, a title may say of the whole.
    for word, harmless in (("OBSOLETE", (RIGHT,)), ("mirrored: swap the sign of x", ())):
        titled = with_cells(one_sheet(BIG, top=2), B1=word)
        titled.sheets[0].merged.append("B1:I1")
        name = f"{word!r} merged above all headings"
        CASES.add(name, titled, BIG, *harmless, *DOUBTED, place=GEOMETRY, columns=one_sheet_map("mm", 3, 6))
    for word in ("nominal", "× 0.1"):
        for where, made in (
            ("above", with_cells(one_sheet(BIG, top=2), E1=word)),
            ("below", with_cells(with_gap(one_sheet(BIG)), E2=word)),
        ):
            mapped = one_sheet_map("mm", 3, 6)
            CASES.add(f"{word!r} {where} d", made, BIG, REFUSED, place=GEOMETRY, columns=mapped)
    title = with_cells(one_sheet(BIG, top=3), A1="DC-SPECT, 80 modules, 2021-03-04")
    mapped = one_sheet_map("mm", 4, 7)
    CASES.add("a title above the table", title, BIG, *READ_OR_REFUSED, place=GEOMETRY, columns=mapped)
    far = one_sheet(BIG, top=60)
    CASES.add("headings far down", far, BIG, *READ_OR_REFUSED, columns=one_sheet_map("mm", 61, 64))
    right = one_sheet(BIG)
    right.sheets[0].moved(right=700)
    CASES.add("headings far to the right", right, BIG, *READ_OR_REFUSED, unmappable="tested without")
    swapped = users()
    for sheet in swapped.sheets:
        for column in [*USERS_COLUMNS.values(), "F", "U", "V", "W", "A"]:
            sheet[f"{column}1"], sheet[f"{column}2"] = sheet[f"{column}2"], sheet[f"{column}1"]
    CASES.add("descriptions above symbols", swapped, SCANNER, *READ_OR_REFUSED, **OF_USERS)
    three = typed(users())
    for sheet in three.sheets:
        sheet.moved(down=1)
        sheet["B1"] = "all about the scanner"
    what = "a sentence above symbols and descriptions"
    CASES.add(what, three, SCANNER, *READ_OR_REFUSED, columns=users_map("mm", 4, 7))
    for what, order, truth in (("repeated", "x1 y1", BIG), ("in another order", "y1 x1", None)):
        made = with_gap(one_sheet(BIG), below=3)
        made.sheets[0].put("A4", [["No.", *order.split(), "z1", "d", "R", "Ld", "Td", "l"]])
        allowed = READ_OR_REFUSED if truth else (REFUSED,)
        name = f"headings {what} on the next page"
        CASES.add(name, made, truth, *allowed, place=GEOMETRY, unmappable="a row in the middle is none")
    down = one_sheet(BIG, top=2)
    for column in ONE_SHEET_COLUMNS.values():
        down.sheets[0][f"{column}1"] = down.sheets[0].cells.pop(f"{column}2")
        down.sheets[0].merged.append(f"{column}1:{column}2")
    CASES.add("heading merged down", down, BIG, *READ_OR_REFUSED, columns=one_sheet_map("mm", 3, 6))
    across = with_cells(one_sheet(BIG), C1=None)
    across.sheets[0].merged.append("B1:C1")
    CASES.add("heading merged across", across, BIG, REFUSED)
    CASES.add("heading missing", one_sheet(BIG, {"y1": ""}), BIG, REFUSED)
    CASES.add("no headings at all", one_sheet(BIG, dict.fromkeys(ONE_SHEET_COLUMNS, ""), number=""), BIG, REFUSED)
    transposed = Sheet("Geometry")
    rows_of = [[SYMBOLS.get(q, "No."), *map(float, quantity(BIG, q))] for q in ("number", *ONE_SHEET_COLUMNS)]
    transposed.put("A1", rows_of)
    CASES.add("modules in columns", Book([transposed]), BIG, REFUSED, unmappable="a map is of columns")


_words_in_a_heading()
_second_candidates()
_symbols_and_descriptions()
_other_headings()
