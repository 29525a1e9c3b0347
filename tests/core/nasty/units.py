"""Units: in headings, in rows above and below them, in merged cells, in number formats, in notes, in names."""

from __future__ import annotations

from .case import REFUSED, RIGHT, WARNED_OF, Catalogue
from .scanners import (
    BIG,
    DESCRIPTIONS,
    ONE_SHEET_COLUMNS,
    SCANNER,
    SYMBOLS,
    USERS_COLUMNS,
    formulas_of,
    one_sheet,
    one_sheet_map,
    typed,
    users,
    users_map,
)
from .sheets import Book, Formula, Rich

CASES = Catalogue("units")
NO_SUCH_UNIT = "the unit has none of a map's names; the numbers have to be converted first"
HEADINGS = tuple(f"Geometry!{column}1" for column in ONE_SHEET_COLUMNS.values())
READ_OR_MAP = (RIGHT, REFUSED)


def _headed(form: str, unit: str, names: dict[str, str] = SYMBOLS) -> Book:
    """All headings of one sheet in the form "{} (cm)", its numbers in `unit`."""
    return one_sheet(BIG, {name: form.format(names[name]) for name in ONE_SHEET_COLUMNS}, unit)


def _in_headings() -> None:
    # The plain way of writing each unit that the reader knows: read without a map.
    for text, unit in {
        "mm": "mm",
        "cm": "cm",
        "m": "m",
        "in": "in",
        "um": "um",
        "µm": "um",
        "\N{GREEK SMALL LETTER MU}m": "um",
    }.items():
        for form in ("{} (%s)", "{} [%s]"):
            form = form % text
            CASES.add(f"heading {form}", _headed(form, unit), BIG, RIGHT)
        form = f"{{}} ({text})"
        CASES.add(f"description {form}", _headed(form, unit, DESCRIPTIONS), BIG, RIGHT)
    # Other ways of writing them: read or refused.
    for form, unit in {
        **{f"{{}}{join}": "mm" for join in (", mm", "/mm", "_mm", " mm", ": mm")},
        **{f"{{}}{join}": "cm" for join in (" / cm", " cm", " in cm", "(cm)", " - cm")},
        "cm {}": "cm",
        "(cm) {}": "cm",
        "{}\n(cm)": "cm",
        "{}_in_cm": "cm",
        "{} {{cm}}": "cm",
        "{} (millimetres)": "mm",
        "{} (centimetres)": "cm",
        "{} (cms)": "cm",
        "{} (metres)": "m",
        "{} (inches)": "in",
        '{} (")': "in",
        "{} (MM)": "mm",
        "{} (cm.)": "cm",
        "{} ( cm )": "cm",
        "{} (\N{FULLWIDTH LATIN SMALL LETTER C}\N{FULLWIDTH LATIN SMALL LETTER M})": "cm",
        "{} (\N{SQUARE CM})": "cm",
        "{}\N{NO-BREAK SPACE}(cm)": "cm",
        "{}\N{ZERO WIDTH SPACE}(cm)": "cm",
        "{} (c\N{SOFT HYPHEN}m)": "cm",
        "{}\N{FULLWIDTH LEFT PARENTHESIS}cm\N{FULLWIDTH RIGHT PARENTHESIS}": "cm",
        "{} (centimètres)": "cm",
        "{} (см)": "cm",
        "{} (厘米)": "cm",
        "{} (pouces)": "in",
        "{}″": "in",
        "{} (microns)": "um",
        "{} (in)": "in",
        "{} (Meter)": "m",
        "{} (cm, from isocentre)": "cm",
        "{} (cm) nominal": "cm",
        "{} (unit: cm)": "cm",
        "{} (values in cm)": "cm",
        "{} (10 mm)": "cm",
        "{} (mm*10)": "cm",
        "{} [10^-2 m]": "cm",
        "{} ×10 (mm)": "cm",
        "{} (mm·10⁻³)": "m",
        "{} (cm ≙ 10 mm)": "cm",
        "{} (mm, not cm)": "mm",
        "{} (not mm: cm)": "cm",
        "{} (mm) in cm": "cm",
    }.items():
        key = f"heading {form}"
        if key not in CASES.cases:
            CASES.add(key, _headed(form, unit), BIG, *READ_OR_MAP, place=HEADINGS, columns=one_sheet_map(unit))
    # Units that no heading may have; a column map may have some.
    of_maps = {"mils": "mil", "0,1 mm": "0.1 mm", "1/10 mm": "0.1 mm"}
    of_maps |= {unit: unit for unit in ("dm", "ft", "mil", "0.1 mm")}
    for text, factor in {
        "dm": 100,
        "0.1 mm": 0.1,
        "0,1 mm": 0.1,
        "mil": 0.0254,
        "mils": 0.0254,
        "ft": 304.8,
        "'": 304.8,
        "km": 1e6,
        "Å": 1e-7,
        "1/10 mm": 0.1,
        "mm × 0.1": 0.1,
        "px": 0.5,
        "voxels": 4.0,
        "units of R": 150.0,
        "%": 2.0,
        "half mm": 0.5,
        "寸": 33.3,
        "Mm": 1e9,
        "µ": 1e-3,
        "cm²": 10.0,
        "cm^-1": 10.0,
        "steps of 5 µm": 5e-3,
        "m m": 1000.0,
        "mmm": 1.0,
        "?": 10.0,
    }.items():

        def book(text: str = text, factor: float = factor) -> Book:
            made = _headed(f"{{}} ({text})", "mm")
            for at, value in made.sheets[0].cells.items():
                if isinstance(value, float):
                    made.sheets[0][at] = float(f"{value / factor:.15g}")
            return made

        known = {"columns": one_sheet_map(of_maps[text])} if text in of_maps else {"unmappable": NO_SUCH_UNIT}
        CASES.add(f"unit ({text})", book, BIG, REFUSED, place="Geometry!", **known)


def _of_one_column() -> None:
    # One column in another unit, the others in mm without a word.
    for name in ONE_SHEET_COLUMNS:
        for unit in ("cm", "in", "m"):
            headings = {name: f"{SYMBOLS[name]} ({unit})"}
            CASES.add(f"only {name} in {unit}", one_sheet(BIG, headings, {name: unit}), BIG, RIGHT)
    units = dict(zip(ONE_SHEET_COLUMNS, ("mm", "cm", "m", "in") * 2, strict=True))
    headings = {name: f"{SYMBOLS[name]} ({unit})" for name, unit in units.items()}
    CASES.add("every column in a unit of its own", one_sheet(BIG, headings, units), BIG, RIGHT)
    CASES.add(
        "x1 without a unit between columns in cm",
        one_sheet(BIG, {q: f"{SYMBOLS[q]} (cm)" for q in ONE_SHEET_COLUMNS if q != "x1"}, "cm"),
        BIG,
        REFUSED,
        WARNED_OF,
        place=("Geometry!",),
        columns=one_sheet_map("cm"),
    )
    # Symbol and description, each with a unit, or only one of them.
    for name, symbol, description, unit, allowed in (
        ("the symbol", "{} (cm)", "{}", "cm", (RIGHT, REFUSED)),
        ("the description", "{}", "{} (cm)", "cm", (RIGHT, REFUSED)),
        ("both alike", "{} (cm)", "{} (cm)", "cm", (RIGHT, REFUSED)),
        ("both, at odds", "{} (mm)", "{} (cm)", "cm", (REFUSED,)),
        ("description, not known", "{}", "{} (Zoll)", "in", (REFUSED,)),
        ("symbol mm, description with other words", "{} (mm)", "{}, in cm!", "cm", (REFUSED,)),
    ):

        def book(symbol: str = symbol, description: str = description, unit: str = unit) -> Book:
            made = one_sheet(BIG, {q: description.format(DESCRIPTIONS[q]) for q in ONE_SHEET_COLUMNS}, unit, top=2)
            made.sheets[0].put("B1", [[symbol.format(SYMBOLS[q]) for q in ONE_SHEET_COLUMNS]])
            return made

        CASES.add(f"unit in {name}", book, BIG, *allowed, place=("Geometry!",), columns=one_sheet_map(unit, 3, 6))


def _around() -> None:
    """Units in cells of their own."""

    def rows(text: str, unit: str, where: str) -> Book:
        if where == "below":
            book = one_sheet(BIG, unit=unit)
            sheet = book.sheets[0]
            sheet.cells = {at if at.endswith("1") else f"{at[0]}{int(at[1:]) + 1}": v for at, v in sheet.cells.items()}
            row = 2
        elif where == "above":
            book, row = one_sheet(BIG, unit=unit, top=2), 1
        elif where == "two above":
            book, row = one_sheet(BIG, unit=unit, top=3), 1
        else:
            book = one_sheet(BIG, DESCRIPTIONS, unit, top=3)
            book.sheets[0].put("B1", [[SYMBOLS[q] for q in ONE_SHEET_COLUMNS]])
            row = 2
        book.sheets[0].put(f"B{row}", [[text] * len(ONE_SHEET_COLUMNS)])
        return book

    first = {"below": 3, "above": 3, "two above": 4, "between": 4}
    for where, start in first.items():
        mapped = {u: one_sheet_map(u, start, start + 3) for u in ("mm", "cm", "in")}
        CASES.add(f"units row {where}: mm", rows("mm", "mm", where), BIG, *READ_OR_MAP, columns=mapped["mm"])
        for text, unit in (("cm", "cm"), ("[cm]", "cm"), ("inch", "in"), ("in cm", "cm")):
            CASES.add(
                f"units row {where}: {text}",
                rows(text, unit, where),
                BIG,
                *READ_OR_MAP,
                place=("Geometry!",),
                columns=mapped[unit],
            )
    CASES.add("units row below: Zoll", rows("Zoll", "in", "below"), BIG, REFUSED, columns=one_sheet_map("in", 3, 6))
    CASES.add("units row below: dm", rows("dm", "cm", "below"), None, REFUSED, place=("Geometry!",))
    CASES.add(
        "units row above: mm, one cm",
        *_one_unit_differs(),
        *READ_OR_MAP,
        place="Geometry!",
        columns=one_sheet_map({"z1": "cm"}, 3, 6),
    )

    # A sentence above, beside or below, in merged cells or not.
    sentences = {
        "all lengths in cm": "cm",
        "All dimensions are in centimetres unless noted otherwise": "cm",
        "Units: cm": "cm",
        "Unit = inch": "in",
        "cm": "cm",
        "Alle Maße in cm": "cm",
        "1 unit = 10 mm": "cm",
        "values x10 = mm": "cm",
    }
    for text, unit in sentences.items():
        for place, at, top in (("above", "B1", 3), ("above the number", "A1", 3), ("at the far right", "L1", 1)):

            def book(text: str = text, unit: str = unit, at: str = at, top: int = top) -> Book:
                made = one_sheet(BIG, unit=unit, top=top)
                made.sheets[0][at] = text
                return made

            CASES.add(
                f"{text!r} {place}",
                book,
                BIG,
                REFUSED,
                WARNED_OF,
                place=("Geometry!",),
                columns=one_sheet_map(unit, top + 1, top + 4),
            )
    for text in ("all lengths in mm", "Units: mm", "[mm]"):

        def millimetres(text: str = text) -> Book:
            made = one_sheet(BIG, top=3)
            made.sheets[0]["A1"] = text
            return made

        CASES.add(
            f"{text!r} above", millimetres, BIG, *READ_OR_MAP, place="Geometry!", columns=one_sheet_map("mm", 4, 7)
        )

    def units_cell(unit: str, left: str = "Units:", at: str = "A1") -> Book:
        made = one_sheet(BIG, unit=unit, top=3)
        made.sheets[0].put(at, [[left, unit]])
        return made

    CASES.add(
        "Units: | cm", units_cell("cm"), BIG, REFUSED, RIGHT, place="Geometry!", columns=one_sheet_map("cm", 4, 7)
    )
    CASES.add("Units: | mm", units_cell("mm"), BIG, *READ_OR_MAP, place="Geometry!", columns=one_sheet_map("mm", 4, 7))
    CASES.add(
        "length | in",
        units_cell("in", "length"),
        BIG,
        REFUSED,
        RIGHT,
        place="Geometry!",
        columns=one_sheet_map("in", 4, 7),
    )
    CASES.add(
        "Units: | cm, at the right",
        units_cell("cm", at="K1"),
        BIG,
        REFUSED,
        WARNED_OF,
        place="Geometry!",
        columns=one_sheet_map("cm", 4, 7),
    )

    for text, unit in (
        ("cm", "cm"),
        ("mm", "mm"),
        ("Positions [cm]", "cm"),
        ("Positions (mm)", "mm"),
        ("in inches", "in"),
    ):
        for area, where in (("B1:D1", "the coordinates"), ("A1:I1", "all columns"), ("B1:I1", "all quantities")):

            def merged(text: str = text, unit: str = unit, area: str = area) -> Book:
                units = {"x1": unit, "y1": unit, "z1": unit} if area == "B1:D1" else unit
                made = one_sheet(BIG, unit=units, top=2)
                made.sheets[0][area.split(":")[0]] = text
                made.sheets[0].merged.append(area)
                return made

            units = {"x1": unit, "y1": unit, "z1": unit} if area == "B1:D1" else unit
            CASES.add(
                f"{text!r} merged over {where}",
                merged,
                BIG,
                *READ_OR_MAP,
                place=("Geometry!",),
                columns=one_sheet_map(units, 3, 6),
            )
    # Not merged, but centred across the columns to the right of its cell.
    CASES.add(
        "'cm' over y1 alone, meant for x1 to z1",
        lambda: _with(one_sheet(BIG, unit={"x1": "cm", "y1": "cm", "z1": "cm"}, top=2), C1="cm"),
        BIG,
        REFUSED,
        place="Geometry!",
        columns=one_sheet_map({"x1": "cm", "y1": "cm", "z1": "cm"}, 3, 6),
    )

    # Said elsewhere: below the table, in a note of the cell, in the sheet's name.
    for name, text in (("below", "All lengths in cm."), ("below, in short", "unit: cm"), ("far below", "cm")):
        row = 12 if name == "far below" else 7
        CASES.add(
            f"unit {name}",
            _with(one_sheet(BIG, unit="cm"), **{f"A{row}": text}),
            BIG,
            REFUSED,
            WARNED_OF,
            place=("Geometry!",),
            columns=one_sheet_map("cm"),
        )
    CASES.add(
        "unit to the right of the first row",
        _with(one_sheet(BIG, unit="cm"), K2="<- in cm"),
        BIG,
        REFUSED,
        WARNED_OF,
        place="Geometry!",
        columns=one_sheet_map("cm"),
    )
    CASES.add(
        "unit in a column of its own",
        _with(one_sheet(BIG, unit="cm"), K1="unit", K2="cm", K3="cm", K4="cm", K5="cm"),
        BIG,
        REFUSED,
        WARNED_OF,
        place="Geometry!",
        columns=one_sheet_map("cm"),
    )
    CASES.add(
        "a column of units beside each quantity",
        lambda: _with(one_sheet(BIG, unit={"l": "cm"}), J1="unit", J2="cm", J3="cm", J4="cm", J5="cm"),
        BIG,
        REFUSED,
        WARNED_OF,
        place="Geometry!",
        columns=one_sheet_map({"l": "cm"}),
    )
    for sheet in ("Geometry (cm)", "Geometry_in_inches"):
        unit = "in" if "in" in sheet.split("_") else "cm"
        CASES.add(
            f"unit in the sheet's name: {sheet}",
            one_sheet(BIG, unit=unit, sheet=sheet),
            BIG,
            REFUSED,
            WARNED_OF,
            place=(sheet,),
            columns=one_sheet_map(unit, sheet=sheet),
        )

    def noted(text: str, unit: str) -> Book:
        made = one_sheet(BIG, unit=unit)
        made.sheets[0].notes["B1"] = text
        return made

    for text, unit in (("in cm", "cm"), ("All in inches!", "in")):
        CASES.add(
            f"unit in a note of the heading: {text}",
            noted(text, unit),
            BIG,
            REFUSED,
            WARNED_OF,
            place="Geometry!",
            columns=one_sheet_map(unit),
        )
    CASES.add(
        "note of the heading: measured in mm",
        noted("measured in mm by CMM, 2021", "mm"),
        BIG,
        *READ_OR_MAP,
        columns=one_sheet_map(),
    )
    CASES.add("note of the heading: who and when", noted("J. Smith: checked 2021-03-04", "mm"), BIG, RIGHT)


def _with(book: Book, **cells: object) -> Book:
    for at, value in cells.items():
        book.sheets[0][at] = value
    return book


def _one_unit_differs():
    def book() -> Book:
        made = one_sheet(BIG, unit={"z1": "cm"}, top=2)
        made.sheets[0].put("B1", [["mm", "mm", "cm", "mm", "mm", "mm", "mm", "mm"]])
        return made

    return book, BIG


def _in_number_formats() -> None:
    def formatted(code: str, unit: str = "mm", names: tuple[str, ...] = tuple(ONE_SHEET_COLUMNS)) -> Book:
        made = one_sheet(BIG, unit=dict.fromkeys(names, unit))
        for name in names:
            for row in range(2, 6):
                made.sheets[0].formats[f"{ONE_SHEET_COLUMNS[name]}{row}"] = code
        return made

    cells = ("Geometry!",)
    for code, unit in {
        '0.000" cm"': "cm",
        "0.00\\ \\c\\m": "cm",
        '0.0##\\"': "in",
        '0.0" Zoll"': "in",
        "0.000\\m": "m",
        '0.0" µm"': "um",
        '0.00" cm";-0.00" cm"': "cm",
        '[Blue]0.00" cm"': "cm",
        '[>100]0.0" cm";0.000" cm"': "cm",
        'General" cm"': "cm",
        "[$cm] 0.00": "cm",
    }.items():
        CASES.add(
            f"number format {code}", formatted(code, unit), BIG, *READ_OR_MAP, place=cells, columns=one_sheet_map(unit)
        )
    for name in ("x1", "d", "l"):
        CASES.add(
            f"number format in cm of {name} alone",
            formatted('0.00" cm"', "cm", (name,)),
            BIG,
            *READ_OR_MAP,
            place=cells,
            columns=one_sheet_map({name: "cm"}),
        )

    def of_one_cell() -> Book:
        made = one_sheet(BIG)
        made.sheets[0]["E4"] = 0.4
        made.sheets[0].formats["E4"] = '0.0" cm"'
        return made

    CASES.add("number format in cm of one cell", of_one_cell, None, REFUSED, place=("Geometry!E4",))
    CASES.add(
        "heading (mm), number format cm",
        _formats(one_sheet(BIG, {"x1": "x1 (mm)"}), '0.00" cm"', "B"),
        None,
        REFUSED,
        place=cells,
    )
    CASES.add(
        "heading (cm), number format cm",
        _formats(one_sheet(BIG, {"x1": "x1 (cm)"}, {"x1": "cm"}), '0.00" cm"', "B"),
        BIG,
        *READ_OR_MAP,
        place=cells,
        columns=one_sheet_map({"x1": "cm"}),
    )
    # Numbers that are shown otherwise than they are: what is shown is what a person reads.
    for code in (
        '"-"0.00',
        "0.00,",
        '0.00" k"',
        "0.00%",
        '"1"0.00',
        "mm:ss",
        "yyyy-mm-dd",
    ):
        CASES.add(f"shown by {code}", _formats(one_sheet(BIG), code, "B"), None, REFUSED, WARNED_OF, place=cells)
    # Formats without a unit, though some hold its letters.
    for code in (
        "0.00",
        "0.00E+00",
        "# ?/?",
        "0.0_m",
        "[Red]0.0;[Blue]-0.0",
        "_-* #,##0.00_-",
        "@",
    ):
        CASES.add(f"plain number format {code}", _formats(one_sheet(BIG), code, "BCDEI"), BIG, RIGHT)
    for code in ('0.00" mm"', "0.0\\ \\m\\m", "[$mm]0.0"):
        CASES.add(
            f"number format {code}",
            _formats(one_sheet(BIG), code, "BCDEFGHI"),
            BIG,
            RIGHT,
            REFUSED,
            place=cells,
            columns=one_sheet_map(),
        )
    for code in ('0.00" mm";-0.00" cm"', '0.00" mm (cm)"'):
        CASES.add(f"number format {code}", _formats(one_sheet(BIG), code, "BCD"), None, REFUSED, place=cells)


def _formats(book: Book, code: str, columns: str) -> Book:
    for column in columns:
        for row in range(2, 6):
            book.sheets[0].formats[f"{column}{row}"] = code
    return book


def _of_the_users_workbook() -> None:
    """Units in the workbook of two sheets, formulas and stored values among them."""
    for unit, factor in (("cm", 10.0), ("in", 25.4), ("m", 1000.0)):

        def book(form: str, unit: str = unit, factor: float = factor, only: str = "") -> Book:
            made = users(BIG)
            for sheet in made.sheets:
                if only and sheet.name != only:
                    continue
                for at, value in list(sheet.cells.items()):
                    if at[0] in "FUVWA":
                        continue
                    if isinstance(value, float):
                        sheet[at] = float(f"{value / factor:.15g}")
                    elif isinstance(value, Formula):
                        sheet[at] = Formula(value.text, float(f"{value.stored / factor:.15g}"))
                for column in USERS_COLUMNS.values():
                    if isinstance(text := sheet[f"{column}1"], str):
                        sheet[f"{column}1"] = form.format(text)
            return made

        def in_planar(made: Book, factor: float = factor) -> Book:
            for at, formula in formulas_of(made["Coordinates"]).items():
                if at[0] == "U":
                    made["Coordinates"][at] = Formula(formula.text, formula.stored / factor)
            return made

        made = in_planar(book(f"{{}} ({unit})"))
        made["Coordinates"]["U2"] = f"pinhole range ({unit})"
        CASES.add(f"users' workbook in {unit}", made, BIG, RIGHT)
        made = in_planar(book("{}"))
        made["Coordinates"]["A1"] = made["Main"]["A1"] = f"all in {unit}"
        CASES.add(
            f"users' workbook, 'all in {unit}' above",
            made,
            BIG,
            REFUSED,
            WARNED_OF,
            place=("!A1",),
            columns=users_map(unit),
        )
        # Main alone in another unit: the formulas of the other sheet would mix them, so its values are typed.
        made = typed(users(BIG))
        for at, value in made["Main"].cells.items():
            if isinstance(value, float):
                made["Main"][at] = float(f"{value / factor:.15g}")
        for column in "PQST":
            made["Main"][f"{column}1"] += f" ({unit})"
        CASES.add(f"users' workbook, Main in {unit}", made, BIG, RIGHT)
    degrees = users()
    for at, formula in formulas_of(degrees["Coordinates"]).items():
        if at[0] in "VW":
            degrees["Coordinates"][at] = Formula(
                f"DEGREES({formula.text})", float(formula.stored) * 180 / 3.141592653589793
            )
    degrees["Coordinates"]["V2"] = "pinhole azimuth (degrees)"
    degrees["Coordinates"]["W2"] = "pinhole elevation (degrees)"
    CASES.add("angles in degrees, said so", degrees, SCANNER, RIGHT)
    rich = users()
    rich["Coordinates"]["B1"] = Rich(
        '<r><t>x</t></r><r><rPr><vertAlign val="subscript"/></rPr><t>1</t></r><r><t> (cm)</t></r>'
    )
    for i in range(3, 7):
        rich["Coordinates"][f"B{i}"] = rich["Coordinates"][f"B{i}"] / 10
    typed(rich)
    CASES.add(
        "unit in a heading of several fonts",
        rich,
        SCANNER,
        RIGHT,
        REFUSED,
        place="Coordinates!B1",
        columns=users_map({"x1": "cm"}),
    )


_in_headings()
_of_one_column()
_around()
_in_number_formats()
_of_the_users_workbook()
