"""Headings: words that change what a column holds, second candidates, other languages, odd characters."""

from __future__ import annotations

from .case import REFUSED, RIGHT, WARNED, WARNED_OF, Catalogue
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
    typed,
    users,
    users_map,
)
from .sheets import Book, Formula, Raw, Rich, Sheet

CASES = Catalogue("headings")
GEOMETRY = ("Geometry!",)
USERS = ("Main!", "Coordinates!")


def _wrong(book: Book, name: str, factor: float = 1.1, column: str | None = None) -> Book:
    """The column's numbers times `factor`, or those times `factor` in another column: what nobody means by `name`."""
    sheet, source = book.sheets[0], ONE_SHEET_COLUMNS[name]
    for row in range(2, 6):
        sheet[f"{column or source}{row}"] = sheet[f"{source}{row}"] * factor
    return book


def _words_in_a_heading() -> None:
    # The column contains another quantity and must not be read. A map does not help: the numbers are different.
    for name, heading, factor in (
        ("d", "d/2", 0.5),
        ("d", "radius of pinhole", 0.5),
        ("d", "outer diameter of pinhole insert", 4.0),
        ("d", "tolerance of diameter of pinhole", 0.01),
        ("d", "effective diameter of pinhole", 1.1),
        ("d", "d_eff", 1.1),
        ("d", "d²", 4.0),
        ("d", "2d", 2.0),
        ("d", "Δd", 0.01),
        ("d", "d tol", 0.01),
        ("d", "d (±)", 0.01),
        ("d", "area of pinhole", 3.1),
        ("d", "max diameter of pinhole", 1.2),
        ("R", "r", 0.9),
        ("R", "range", 1.1),
        ("R", "ROI diameter", 2.0),
        ("R", "2R", 2.0),
        ("R", "R²", 1.3),
        ("R", "radius of detector ring", 1.5),
        ("R", "R max", 1.2),
        ("R", "resolution", 0.1),
        ("Ld", "Ld/2", 0.5),
        ("Ld", "length of side of detector window", 1.2),
        ("Ld", "area of detector crystal", 1.3),
        ("Ld", "length of detector crystal diagonal", 1.4142),
        ("Ld", "L", 0.9),
        ("Td", "thickness of detector window", 0.1),
        ("Td", "thickness of pinhole plate", 0.5),
        ("Td", "tolerance of thickness of detector crystal", 0.01),
        ("Td", "temperature of detector", 1.1),
        ("l", "length of collimator + detector", 1.1),
        ("l", "inner length of collimator", 0.95),
        ("l", "l (max)", 1.1),
        ("l", "l/b", 0.3),
        ("x1", "x1²", 1.2),
        ("x1", "|x1|", 1.2),
        ("x1", "-x1", -1.0),
        ("x1", "dx1", 0.01),
        ("x1", "x1/b", 0.9),
        ("x1", "x1 rel. to couch", 0.9),
        ("x1", "x1 - 5", 0.99),
        ("x1", "σ(x1)", 0.01),
        ("x1", "x1 (from left edge)", 1.3),
        ("x1", "x1 nominal", 1.01),
        ("x1", "x1 (old)", 1.05),
        ("x1", "x1, mirrored", -1.0),
        ("x1", "x1?", 1.1),
        ("x1", "x10", 1.1),
        ("x1", "x", 1.1),
        ("x1", "x coordinate value at end of hole", 1.1),
        ("x1", "x coordinate value at center of pinhole plate", 1.1),
        ("x1", "x coordinate value at center of detector", 1.3),
        ("x1", "x coordinate value at center of hole (old)", 1.05),
        ("x1", "x coordinate value at center of hole relative to plate", 0.5),
        ("x1", "x and y coordinate value at center of hole", 0.9),
    ):

        def book(name: str = name, heading: str = heading, factor: float = factor) -> Book:
            # Without l, which would tell on it.
            return _wrong(one_sheet(BIG, {name: heading}, length=name == "l"), name, factor)

        if name == "l":
            allowed, truth = (REFUSED, WARNED, RIGHT), BIG  # an unknown column is no l, which is then by design

            def book_l(heading: str = heading, factor: float = factor) -> Book:
                return _wrong(one_sheet(BIG, {"l": heading}), "l", factor)

            CASES.add(
                f"l: {heading}", book_l, truth, *allowed, place=GEOMETRY, columns=one_sheet_map(columns={"l": ""})
            )
        else:
            CASES.add(f"{name}: {heading}", book, None, REFUSED, place=("Geometry", "scanner.xlsx"))


def _second_candidates() -> None:
    def beside(name: str, first: str, second: str, right: str) -> tuple:
        """Two columns for one quantity; `right` of the two headings has the truth."""

        def book() -> Book:
            made = one_sheet(BIG, {name: first})
            made.sheets[0]["J1"] = second
            column = "J" if right == first else ONE_SHEET_COLUMNS[name]
            for row in range(2, 6):
                made.sheets[0][f"J{row}"] = made.sheets[0][f"{ONE_SHEET_COLUMNS[name]}{row}"]
                made.sheets[0][f"{column}{row}"] *= 1.01
            if name != "l":
                made.sheets[0].cells = {at: v for at, v in made.sheets[0].cells.items() if at[0] != "I"}
            return made

        columns = {name: ONE_SHEET_COLUMNS[name] if right == first else "J"}
        return book, one_sheet_map(columns={**columns, **({} if name == "l" else {"l": ""})})

    for name, first, second in (
        ("x1", "x1", "x1"),
        ("x1", "x1", "X1"),
        ("x1", "x1", "x1 new"),
        ("x1", "x1", "x1 (corrected)"),
        ("x1", "x1", "x1 [mm]"),
        ("x1", "x1 (mm)", "x1 (cm)"),
        ("x1", "x1 old", "x1 new"),
        ("x1", "x1", "x coordinate value at center of hole"),
        ("x1", "x1", "x coordinate value at center of hole (surveyed)"),
        ("y1", "y1 (CAD)", "y1 (CMM)"),
        ("d", "d", "d measured"),
        ("d", "d", "diameter of pinhole"),
        ("R", "R", "ROI radius"),
        ("Ld", "Ld", "Ld*"),
        ("Td", "Td", "Td (2022)"),
        ("l", "l", "l new"),
        ("l", "l", "length of collimator"),
    ):
        for right in (first, second) if first != second else (second,):
            book, mapped = beside(name, first, second, right)
            which = "the first" if right == first else "the second"
            CASES.add(
                f"{first!r} beside {second!r}, {which} is meant", book, BIG, REFUSED, place=GEOMETRY, columns=mapped
            )
            if first == second:
                break
    # Columns whose names look like another's, all needed ones there as well.
    for other, values in (
        ("D", 500.0),
        ("B", 1.0),
        ("x2", None),
        ("x", 5.0),
        ("x1 error", 0.1),
        ("d tolerance", 0.05),
        ("thickness of detector window", 1.0),
        ("half diameter of pinhole", 2.0),
        ("radius of detector ring", 700.0),
        ("material of collimator", 11.3),
        ("side", "left"),
        ("T", 25.0),
        ("l1", 25.0),
        ("mu", 0.0154),
        ("note", "10 cm lead behind"),
        ("comment", "x1 checked, d not"),
        ("date", "2021-03-04"),
        ("angle (deg)", 12.5),
        ("z1 limit (cm)", 12.0),
    ):

        def extra(other: str = other, values: object = values) -> Book:
            made = one_sheet(BIG)
            made.sheets[0]["J1"] = other
            for i, row in enumerate(range(2, 6)):
                made.sheets[0][f"J{row}"] = float(quantity(BIG, "x2")[i]) if values is None else values
            return made

        CASES.add(
            f"a column {other!r} as well", extra, BIG, RIGHT, WARNED, REFUSED, place=GEOMETRY, columns=one_sheet_map()
        )
    for other in ("serial", "material", "ring"):

        def plain_extra(other: str = other) -> Book:
            made = one_sheet(BIG)
            made.sheets[0].put("J1", [[other], ["W-7"], ["W-8"], ["W-9"], ["W-10"]])
            return made

        CASES.add(f"a column {other!r} of texts as well", plain_extra, BIG, RIGHT)


def _symbols_and_descriptions() -> None:
    def users_with(**cells: object) -> Book:
        made = users()
        for at, value in cells.items():
            sheet, cell = at.split("_")
            made[{"M": "Main", "C": "Coordinates"}[sheet]][cell] = value
        return made

    at_odds = {
        "x1 described as y": {"C_B2": DESCRIPTIONS["y1"]},
        "x1 described as the detector's": {"C_B2": DESCRIPTIONS["x2"]},
        "x1 described with another reference": {"C_B2": "x coordinate value at center of plate"},
        "l described as Ld": {"C_G2": DESCRIPTIONS["Ld"]},
        "d described as radius": {"M_P2": "radius of pinhole"},
        "R described as diameter": {"M_Q2": "diameter of spherical region of interest"},
        "Ld described as window": {"M_S2": "length of side of detector window"},
        "symbol y1 over the description of x1": {"C_B1": "y1"},
        "symbol x2 over the description of x1": {"C_B1": "x2"},
        "symbol r over the description of d": {"M_P1": "r"},
        "symbol Td over the description of Ld": {"M_S1": "Td"},
    }
    for name, cells in at_odds.items():
        CASES.add(name, users_with(**cells), SCANNER, REFUSED, place=USERS, columns=users_map())
    # A person understands these; no word of them is a quantity's.
    understood = {
        "a typing error": {"C_G2": "lenght of collimator"},
        "center spelt centre": {
            f"C_{c}2": DESCRIPTIONS[q].replace("center", "centre")
            for q, c in zip(("x1", "y1", "z1"), "BCD", strict=True)
        },
        "descriptions in capitals": {
            f"C_{c}2": DESCRIPTIONS[q].upper() for q, c in zip(("x1", "y1", "z1"), "BCD", strict=True)
        },
        "descriptions of several lines": {
            "C_B2": "x coordinate value\nat center of hole",
            "M_P2": "diameter\nof pinhole",
        },
        "a colon": {"C_B1": "x1:", "C_B2": DESCRIPTIONS["x1"] + ":"},
        "blanks around": {"C_B1": "  x1 ", "C_B2": f" {DESCRIPTIONS['x1']}  "},
        "a no-break space": {"C_B2": DESCRIPTIONS["x1"].replace(" ", "\N{NO-BREAK SPACE}")},
        "a subscript": {"C_B1": "x₁", "C_C1": "y₁", "C_D1": "z₁"},
        "capital symbols": {"C_B1": "X1", "C_C1": "Y1", "C_D1": "Z1"},
        "underscores": {"C_B1": "x_1", "C_C1": "y_1", "C_D1": "z_1"},
        "a dash": {"C_B1": "x-1"},
        "quotes": {"C_H1": "'l + b+Td'"},
        "b+l+Td": {"C_H1": "b+l+Td"},
        "a numbered footnote": {"C_B1": "x1 ¹⁾"},
        "no description of x1": {"C_B2": None},
        "no symbol of x1": {"C_B1": None},
        "another letter over the description": {"C_B1": "p"},
        "a comment as description": {"C_B2": "see drawing 12"},
        "an empty text over the description": {"C_B1": ""},
        "a zero-width space": {"C_B1": "x1\N{ZERO WIDTH SPACE}"},
        "full-width letters": {"C_B1": "ｘ１"},
        "a Cyrillic x": {"C_B1": "х1"},
        "a letter l for the digit 1": {"C_B1": "xl"},
        "a script l": {"C_G1": "ℓ"},
        "ld and td": {"M_S1": "ld", "M_T1": "td"},
        "D for d": {"M_P1": "D"},
        "ø for d": {"M_P1": "ø"},
        "isocentre for heart": {"C_E2": "distance from center of hole to isocentre"},
        "angles without a unit": {"C_V2": "pinhole azimuth", "C_W2": "pinhole elevation"},
    }
    for name, cells in understood.items():
        CASES.add(f"understood: {name}", users_with(**cells), SCANNER, RIGHT, REFUSED, place=USERS, columns=users_map())
    of_other_kinds = {
        "fonts": Rich('<r><t>x</t></r><r><rPr><vertAlign val="subscript"/></rPr><t>1</t></r>'),
        "a reading of Japanese": Rich('<t>x1</t><rPh sb="0" eb="2"><t>エックスいち</t></rPh><phoneticPr fontId="1"/>'),
        "text in the cell": Raw('<c r="B1" t="inlineStr"><is><t>x1</t></is></c>'),
        "text in the cell, of fonts": Raw('<c r="B1" t="inlineStr"><is><r><t>x</t></r><r><t>1</t></r></is></c>'),
        "a formula": Formula('"x"&1', "x1"),
        "a formula that names another cell": Formula("AA1", "x1"),
        "CDATA": Raw('<c r="B1" t="inlineStr"><is><t><![CDATA[x1]]></t></is></c>'),
        "a character reference": Raw('<c r="B1" t="inlineStr"><is><t>&#120;1</t></is></c>'),
        "Excel's escape": Raw('<c r="B1" t="inlineStr"><is><t>x_x0031_</t></is></c>'),
    }
    for name, value in of_other_kinds.items():
        made = users_with(C_B1=value)
        if name == "a formula that names another cell":
            made["Coordinates"]["AA1"] = "x1"
        CASES.add(f"heading by {name}", made, SCANNER, RIGHT, REFUSED, place=USERS, columns=users_map())
    unstored = users_with(C_B1=Formula('"y"&1', "x1"), C_C1=Formula('"x"&1', "y1"))
    unstored["Coordinates"]["B2"] = unstored["Coordinates"]["C2"] = None
    unstored.calculation = '<calcPr calcId="191029" fullCalcOnLoad="1"/>'
    CASES.add("headings by stale formulas", unstored, None, REFUSED, WARNED_OF, place=("scanner.xlsx",))
    hidden_y = users_with(
        C_B2=Rich("<r><rPr><strike/></rPr><t>y</t></r><r><t>x coordinate value at center of hole</t></r>")
    )
    CASES.add("a letter struck out", hidden_y, SCANNER, RIGHT, REFUSED, place=USERS, columns=users_map())


def _other_headings() -> None:
    """Whole rows of headings that a person understands and no vocabulary needs to have."""
    rows = {
        "French": "x du trou|y du trou|z du trou|diamètre du trou|rayon ROI|côté du cristal|épaisseur du cristal|longueur",
        "Chinese": "孔中心 x|孔中心 y|孔中心 z|孔径|感兴趣区半径|晶体边长|晶体厚度|准直器长度",
        "short words": "x|y|z|diameter|ROI|crystal|thickness|length",
        "code": "pinhole_x|pinhole_y|pinhole_z|pinhole_diameter|roi_radius|detector_side|detector_thickness|length",
        "positions": "x position of hole|y position of hole|z position of hole|hole diameter|radius of ROI|detector size"
        "|detector thickness|pinhole to crystal",
        "letters": "Px|Py|Pz|D|r_ROI|W|t|F",
    }
    sets = {name: dict(zip(ONE_SHEET_COLUMNS, row.split("|"), strict=True)) for name, row in rows.items()}
    sets["descriptions only"] = DESCRIPTIONS
    sets["mixed"] = {**SYMBOLS, "x1": DESCRIPTIONS["x1"], "d": DESCRIPTIONS["d"], "Ld": DESCRIPTIONS["Ld"]}
    for name, names in sets.items():
        CASES.add(
            f"headings: {name}",
            one_sheet(BIG, names),
            BIG,
            RIGHT,
            REFUSED,
            place=("scanner.xlsx",),
            columns=one_sheet_map(),
        )
    for number in (
        "",
        "Nr.",
        "Module",
        "pinhole",
        "ID",
        "index",
        "Definitions",
        "serial",
    ):
        CASES.add(
            f"numbers headed {number!r}",
            one_sheet(BIG, number=number),
            BIG,
            RIGHT,
            REFUSED,
            place=("scanner.xlsx",),
            columns=one_sheet_map(),
        )
    # Headings in two rows, a common word merged over three letters.
    for words, truth in (
        (("pinhole", "crystal"), True),
        (("hole centre", "detector end"), True),
        (("nominal", "measured"), False),
    ):

        def grouped(words: tuple[str, str] = words, truth: bool = truth) -> Book:
            made = one_sheet(
                BIG, {"x1": "x" if truth else "x1", "y1": "y" if truth else "y1", "z1": "z" if truth else "z1"}, top=2
            )
            sheet = made.sheets[0]
            names = ["x", "y", "z"] if truth else ["x1", "y1", "z1"]
            sheet["B1"], sheet["J1"] = words
            sheet.merged += ["B1:D1", "J1:L1"]
            sheet.put("J2", [names])
            for i in range(4):
                scale = 1.3 if truth else 1.01
                sheet.put(f"J{3 + i}", [[float(v * scale) for v in BIG.centers[i]]])
            return made

        CASES.add(
            f"x y z under {words[0]!r} and under {words[1]!r}",
            grouped,
            BIG,
            REFUSED,
            *([RIGHT] if truth else []),
            place=GEOMETRY,
            columns=one_sheet_map("mm", 3, 6),
        )
    for word in (
        "OBSOLETE",
        "DRAFT - not verified",
        "nominal values",
        "relative to the couch",
        "mirrored: swap the sign of x",
    ):

        def titled(word: str = word) -> Book:
            made = one_sheet(BIG, top=2)
            made.sheets[0]["B1"] = word
            made.sheets[0].merged.append("B1:I1")
            return made

        # What changes no number, a title may say of the whole.
        harmless = (RIGHT,) if word in ("OBSOLETE", "DRAFT - not verified", "nominal values") else ()
        CASES.add(
            f"{word!r} merged above all headings",
            titled,
            BIG,
            *harmless,
            REFUSED,
            WARNED_OF,
            place=GEOMETRY,
            columns=one_sheet_map("mm", 3, 6),
        )
    for word in ("nominal", "× 0.1", "radius"):

        def over_one(word: str = word) -> Book:
            made = one_sheet(BIG, top=2)
            made.sheets[0]["E1"] = word
            return made

        CASES.add(f"{word!r} above d", over_one, BIG, REFUSED, place=GEOMETRY, columns=one_sheet_map("mm", 3, 6))

        def under_one(word: str = word) -> Book:
            made = one_sheet(BIG)
            sheet = made.sheets[0]
            sheet.cells = {at if at.endswith("1") else f"{at[0]}{int(at[1:]) + 1}": v for at, v in sheet.cells.items()}
            sheet["E2"] = word
            return made

        CASES.add(f"{word!r} below d", under_one, BIG, REFUSED, place=GEOMETRY, columns=one_sheet_map("mm", 3, 6))
    for title in (
        "DC-SPECT, 80 modules",
        "Version 3, 2021-03-04, J. Smith",
        "Pinhole geometry",
    ):

        def with_title(title: str = title) -> Book:
            made = one_sheet(BIG, top=3)
            made.sheets[0]["A1"] = title
            return made

        CASES.add(
            f"title {title!r} above the table",
            with_title,
            BIG,
            RIGHT,
            REFUSED,
            place=GEOMETRY,
            columns=one_sheet_map("mm", 4, 7),
        )
    far = one_sheet(BIG, top=60)
    CASES.add(
        "headings far down", far, BIG, RIGHT, REFUSED, place=("scanner.xlsx",), columns=one_sheet_map("mm", 61, 64)
    )
    right = one_sheet(BIG)
    right.sheets[0].moved(right=700)
    CASES.add(
        "headings far to the right", right, BIG, RIGHT, REFUSED, place=("scanner.xlsx",), unmappable="tested without"
    )
    gap = users()
    for sheet in gap.sheets:
        sheet.cells = {at if at[1:] == "1" or at in ("A1",) else _down(at, 1): v for at, v in sheet.cells.items()}
    CASES.add(
        "a blank row between symbols and descriptions",
        typed(gap),
        SCANNER,
        RIGHT,
        REFUSED,
        place=("scanner.xlsx",),
        columns=users_map("mm", 4, 7),
    )
    swapped = users()
    for sheet in swapped.sheets:
        for column in [*USERS_COLUMNS.values(), "F", "U", "V", "W", "A"]:
            sheet[f"{column}1"], sheet[f"{column}2"] = sheet[f"{column}2"], sheet[f"{column}1"]
    CASES.add("descriptions above symbols", swapped, SCANNER, RIGHT, REFUSED, place=USERS, columns=users_map())
    three = users()
    for sheet in three.sheets:
        sheet.cells = {_down(at, 1): v for at, v in sheet.cells.items()}
        sheet["B1"] = "all about the scanner"
    CASES.add(
        "a sentence above symbols and descriptions",
        typed(three),
        SCANNER,
        RIGHT,
        REFUSED,
        place=USERS,
        columns=users_map("mm", 4, 7),
    )
    repeated = one_sheet(BIG)
    repeated.sheets[0].cells = {
        at if int(at[1:]) < 4 else _down(at, 1): v for at, v in repeated.sheets[0].cells.items()
    }
    repeated.sheets[0].put("A4", [["No.", "x1", "y1", "z1", "d", "R", "Ld", "Td", "l"]])
    CASES.add(
        "headings repeated on the next page",
        repeated,
        BIG,
        RIGHT,
        REFUSED,
        place=GEOMETRY,
        unmappable="a row in the middle is none",
    )
    changed = one_sheet(BIG)
    changed.sheets[0].cells = {at if int(at[1:]) < 4 else _down(at, 1): v for at, v in changed.sheets[0].cells.items()}
    changed.sheets[0].put("A4", [["No.", "y1", "x1", "z1", "d", "R", "Ld", "Td", "l"]])
    for row in (5, 6):
        sheet = changed.sheets[0]
        sheet[f"B{row}"], sheet[f"C{row}"] = sheet[f"C{row}"], sheet[f"B{row}"]
    CASES.add(
        "headings in another order on the next page",
        changed,
        BIG,
        REFUSED,
        place=GEOMETRY,
        unmappable="two tables in one",
    )
    for name, area in (("down", "B1:B2"), ("across", "B1:C1")):

        def merged(name: str = name, area: str = area) -> Book:
            made = one_sheet(BIG, top=2 if name == "down" else 1)
            sheet = made.sheets[0]
            if name == "down":
                for column in ONE_SHEET_COLUMNS.values():
                    sheet[f"{column}1"], sheet[f"{column}2"] = sheet[f"{column}2"], None
                    sheet.merged.append(f"{column}1:{column}2")
            else:
                sheet["C1"] = None
                sheet.merged.append(area)
            return made

        first = 3 if name == "down" else 2
        CASES.add(
            f"heading merged {name}",
            merged,
            BIG,
            *([RIGHT] if name == "down" else []),
            REFUSED,
            place=("scanner.xlsx",),
            columns=one_sheet_map("mm", first, first + 3),
        )
    CASES.add(
        "heading missing", one_sheet(BIG, {"y1": ""}), BIG, REFUSED, place=("scanner.xlsx",), columns=one_sheet_map()
    )
    CASES.add(
        "no headings at all",
        one_sheet(BIG, dict.fromkeys(ONE_SHEET_COLUMNS, ""), number=""),
        BIG,
        REFUSED,
        place=("scanner.xlsx",),
        columns=one_sheet_map(),
    )
    transposed = Sheet("Geometry")
    for i, name in enumerate(("number", *ONE_SHEET_COLUMNS), start=1):
        transposed.put(f"A{i}", [[name if name != "number" else "No.", *map(float, quantity(BIG, name))]])
    CASES.add(
        "modules in columns",
        Book([transposed]),
        BIG,
        REFUSED,
        place=("scanner.xlsx",),
        unmappable="a map is of columns",
    )
    shuffled = one_sheet(BIG)
    sheet = shuffled.sheets[0]
    sheet.cells = {f"{'IHGFEDCBA'['ABCDEFGHI'.index(at[0])]}{at[1:]}": v for at, v in sheet.cells.items()}
    CASES.add("columns from right to left", shuffled, BIG, RIGHT)


def _down(at: str, n: int) -> str:
    letters = at.rstrip("0123456789")
    return f"{letters}{int(at[len(letters) :]) + n}"


_words_in_a_heading()
_second_candidates()
_symbols_and_descriptions()
_other_headings()
