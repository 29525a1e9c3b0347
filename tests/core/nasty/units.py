"""Units: in headings, in rows above and below them, in merged cells, in number formats, in notes, in names."""

from __future__ import annotations

from .case import DOUBTED, READ_OR_REFUSED, REFUSED, RIGHT, Catalogue
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
    scaled,
    typed,
    users,
    users_map,
    with_cells,
    with_format,
    with_gap,
)
from .sheets import Book, Formula, Rich

CASES = Catalogue("units", place=("Geometry!",), columns=one_sheet_map())
NO_SUCH_UNIT = "the unit has none of a map's names; the numbers have to be converted first"
ALL = "".join(ONE_SHEET_COLUMNS.values())
CELLS = [f"{column}{row}" for column in ALL for row in range(2, 6)]
POSITION = {"x1": "cm", "y1": "cm", "z1": "cm"}


def _headed(form: str, unit: str, names: dict[str, str] = SYMBOLS) -> Book:
    """All headings of one sheet in the form "{} (cm)", its numbers in `unit`."""
    return one_sheet(BIG, {name: form.format(names[name]) for name in ONE_SHEET_COLUMNS}, unit)


def _in_headings() -> None:
    # The plain way of writing each unit that the reader knows: read without a map.
    for text, unit in {**{unit: unit for unit in ("mm", "cm", "m", "in", "um")}, "μm": "um"}.items():
        CASES.add(f"heading {{}} ({text})", _headed(f"{{}} ({text})", unit), BIG, RIGHT)
    CASES.add("description {} [cm]", _headed("{} [cm]", "cm", DESCRIPTIONS), BIG, RIGHT)
    # Other ways of writing them: read or refused.
    for form, unit in {
        "{}_mm": "mm",
        "{}, mm": "mm",
        "{} in cm": "cm",
        "cm {}": "cm",
        "{} (cms)": "cm",
        '{} (")': "in",
        "{} (\N{SQUARE CM})": "cm",
        "{}\N{ZERO WIDTH SPACE}(cm)": "cm",
        "{} (c\N{SOFT HYPHEN}m)": "cm",
        "{} (厘米)": "cm",
        "{} (cm) nominal": "cm",
        "{} (10 mm)": "cm",
        "{} ×10 (mm)": "cm",
        "{} (mm, not cm)": "mm",
        "{} (mm) in cm": "cm",
    }.items():
        CASES.add(f"heading {form}", _headed(form, unit), BIG, *READ_OR_REFUSED, columns=one_sheet_map(unit))
    # Units that no heading may have; a column map may have some.
    for text, factor, unit in (
        ("dm", 100, "dm"),
        ("0,1 mm", 0.1, "0.1 mm"),
        ("mils", 0.0254, "mil"),
        ("'", 304.8, None),
        ("mm × 0.1", 0.1, None),
        ("voxels", 4.0, None),
        ("%", 2.0, None),
        ("Mm", 1e9, None),
        ("cm²", 10.0, None),
        ("?", 10.0, None),
    ):
        known = {"columns": one_sheet_map(unit)} if unit else {"unmappable": NO_SUCH_UNIT}
        CASES.add(f"unit ({text})", scaled(_headed(f"{{}} ({text})", "mm"), 1 / factor, CELLS), BIG, REFUSED, **known)


def _of_one_column() -> None:
    # One column in another unit, the others in mm without a word.
    for name, unit in (("x1", "cm"), ("d", "in"), ("l", "m")):
        CASES.add(f"only {name} in {unit}", one_sheet(BIG, {name: f"{name} ({unit})"}, {name: unit}), BIG, RIGHT)
    units = dict(zip(ONE_SHEET_COLUMNS, ("mm", "cm", "m", "in") * 2, strict=True))
    headings = {name: f"{SYMBOLS[name]} ({unit})" for name, unit in units.items()}
    CASES.add("every column in a unit of its own", one_sheet(BIG, headings, units), BIG, RIGHT)
    CASES.add(
        "x1 without a unit between columns in cm",
        one_sheet(BIG, {q: f"{SYMBOLS[q]} (cm)" for q in ONE_SHEET_COLUMNS if q != "x1"}, "cm"),
        BIG,
        *DOUBTED,
        columns=one_sheet_map("cm"),
    )
    # Symbol and description, each with a unit, or only one of them.
    for name, symbol, description, unit, allowed in (
        ("the symbol", "{} (cm)", "{}", "cm", READ_OR_REFUSED),
        ("both alike", "{} (cm)", "{} (cm)", "cm", READ_OR_REFUSED),
        ("both, at odds", "{} (mm)", "{} (cm)", "cm", (REFUSED,)),
        ("description, not known", "{}", "{} (Zoll)", "in", (REFUSED,)),
        ("symbol mm, description with other words", "{} (mm)", "{}, in cm!", "cm", (REFUSED,)),
    ):
        book = one_sheet(BIG, {q: description.format(DESCRIPTIONS[q]) for q in ONE_SHEET_COLUMNS}, unit, top=2)
        book.sheets[0].put("B1", [[symbol.format(SYMBOLS[q]) for q in ONE_SHEET_COLUMNS]])
        CASES.add(f"unit in {name}", book, BIG, *allowed, columns=one_sheet_map(unit, 3, 6))


def _row_of_units(text: str, unit: str, where: str) -> Book:
    if where == "below":
        book, row = with_gap(one_sheet(BIG, unit=unit)), 2
    elif where == "between":
        book, row = one_sheet(BIG, DESCRIPTIONS, unit, top=3), 2
        book.sheets[0].put("B1", [[SYMBOLS[q] for q in ONE_SHEET_COLUMNS]])
    else:
        book, row = one_sheet(BIG, unit=unit, top=2 if where == "above" else 3), 1
    book.sheets[0].put(f"B{row}", [[text] * len(ONE_SHEET_COLUMNS)])
    return book


def _around() -> None:
    """Units in cells of their own."""
    for where, start in {"below": 3, "above": 3, "two above": 4, "between": 4}.items():
        for text, unit in (("mm", "mm"), ("cm", "cm"), ("in cm", "cm")):
            mapped = one_sheet_map(unit, start, start + 3)
            book = _row_of_units(text, unit, where)
            CASES.add(f"units row {where}: {text}", book, BIG, *READ_OR_REFUSED, columns=mapped)
    inches = _row_of_units("inch", "in", "below")
    CASES.add("units row below: inch", inches, BIG, *READ_OR_REFUSED, columns=one_sheet_map("in", 3, 6))
    CASES.add("units row below: dm", _row_of_units("dm", "cm", "below"), None, REFUSED)
    differs = one_sheet(BIG, unit={"z1": "cm"}, top=2)
    differs.sheets[0].put("B1", [["mm", "mm", "cm", "mm", "mm", "mm", "mm", "mm"]])
    mapped = one_sheet_map({"z1": "cm"}, 3, 6)
    CASES.add("units row above: mm, one cm", differs, BIG, *READ_OR_REFUSED, columns=mapped)

    # A sentence above or beside, in merged cells or not.
    for text, unit in {"all lengths in cm": "cm", "Unit = inch": "in", "1 unit = 10 mm": "cm"}.items():
        for place, at, top in (("above", "B1", 3), ("at the far right", "L1", 1)):
            book = with_cells(one_sheet(BIG, unit=unit, top=top), **{at: text})
            CASES.add(f"{text!r} {place}", book, BIG, *DOUBTED, columns=one_sheet_map(unit, top + 1, top + 4))
    for text in ("all lengths in mm", "Units: mm"):
        book = with_cells(one_sheet(BIG, top=3), A1=text)
        CASES.add(f"{text!r} above", book, BIG, *READ_OR_REFUSED, columns=one_sheet_map("mm", 4, 7))
    for left, unit in (("Units:", "cm"), ("Units:", "mm"), ("length", "in")):
        book = with_cells(one_sheet(BIG, unit=unit, top=3), A1=left, B1=unit)
        CASES.add(f"{left} | {unit}", book, BIG, *READ_OR_REFUSED, columns=one_sheet_map(unit, 4, 7))
    for text, unit in (("cm", "cm"), ("mm", "mm"), ("Positions [cm]", "cm"), ("in inches", "in")):
        for area, where in (("B1:D1", "the coordinates"), ("A1:I1", "all columns")):
            units = dict.fromkeys(POSITION, unit) if area == "B1:D1" else unit
            book = with_cells(one_sheet(BIG, unit=units, top=2), **{area.split(":")[0]: text})
            book.sheets[0].merged.append(area)
            name = f"{text!r} merged over {where}"
            CASES.add(name, book, BIG, *READ_OR_REFUSED, columns=one_sheet_map(units, 3, 6))
    # Not merged, but centred across the columns to the right of its cell.
    centred = with_cells(one_sheet(BIG, unit=POSITION, top=2), C1="cm")
    CASES.add("'cm' over y1 alone, meant for x1 to z1", centred, BIG, REFUSED, columns=one_sheet_map(POSITION, 3, 6))

    # Said elsewhere: below the table, in columns beside it, in a note of the cell, in the sheet's name.
    for name, cells in {
        "below": {"A7": "All lengths in cm."},
        "far below, in short": {"A12": "cm"},
        "in a column of its own": {"K1": "unit", **{f"K{row}": "cm" for row in range(2, 6)}},
    }.items():
        book = with_cells(one_sheet(BIG, unit="cm"), **cells)
        CASES.add(f"unit {name}", book, BIG, *DOUBTED, columns=one_sheet_map("cm"))
    for sheet, unit in (("Geometry (cm)", "cm"), ("Geometry_in_inches", "in")):
        book, mapped = one_sheet(BIG, unit=unit, sheet=sheet), one_sheet_map(unit, sheet=sheet)
        CASES.add(f"unit in the sheet's name: {sheet}", book, BIG, *DOUBTED, place=sheet, columns=mapped)
    for text, unit, allowed in (
        ("in cm", "cm", DOUBTED),
        ("measured in mm by CMM, 2021", "mm", READ_OR_REFUSED),
        ("J. Smith: checked 2021-03-04", "mm", (RIGHT,)),
    ):
        noted = one_sheet(BIG, unit=unit)
        noted.sheets[0].notes["B1"] = text
        CASES.add(f"note of the heading: {text}", noted, BIG, *allowed, columns=one_sheet_map(unit))


def _in_number_formats() -> None:
    for code, unit in {
        '0.000" cm"': "cm",
        "0.00\\ \\c\\m": "cm",
        '0.0##\\"': "in",
        '0.0" Zoll"': "in",
        '0.00" cm";-0.00" cm"': "cm",
        '[>100]0.0" cm";0.000" cm"': "cm",
        "[$cm] 0.00": "cm",
        '0.00" mm"': "mm",
        "0.0\\ \\m\\m": "mm",
    }.items():
        book = with_format(one_sheet(BIG, unit=unit), code, ALL)
        CASES.add(f"number format {code}", book, BIG, *READ_OR_REFUSED, columns=one_sheet_map(unit))
    alone = with_format(one_sheet(BIG, unit={"d": "cm"}), '0.00" cm"', "E")
    mapped = one_sheet_map({"d": "cm"})
    CASES.add("number format in cm of d alone", alone, BIG, *READ_OR_REFUSED, columns=mapped)
    one = with_cells(one_sheet(BIG), E4=0.4)
    one.sheets[0].formats["E4"] = '0.0" cm"'
    CASES.add("number format in cm of one cell", one, None, REFUSED, place="Geometry!E4")
    odds = with_format(one_sheet(BIG, {"x1": "x1 (mm)"}), '0.00" cm"', "B")
    CASES.add("heading (mm), number format cm", odds, None, REFUSED)
    same = with_format(one_sheet(BIG, {"x1": "x1 (cm)"}, {"x1": "cm"}), '0.00" cm"', "B")
    mapped = one_sheet_map({"x1": "cm"})
    CASES.add("heading (cm), number format cm", same, BIG, *READ_OR_REFUSED, columns=mapped)
    # Numbers that are shown otherwise than they are: what is shown is what a person reads.
    for code in ('"-"0.00', "0.00,", '0.00" k"', "0.00%", "mm:ss"):
        CASES.add(f"shown by {code}", with_format(one_sheet(BIG), code, "B"), None, *DOUBTED)
    # Formats without a unit, though some hold its letters.
    for code in ("0.00", "0.0_m", "[Red]0.0;[Blue]-0.0", "@"):
        CASES.add(f"plain number format {code}", with_format(one_sheet(BIG), code, "BCDEI"), BIG, RIGHT)
    for code in ('0.00" mm";-0.00" cm"', '0.00" mm (cm)"'):
        CASES.add(f"number format {code}", with_format(one_sheet(BIG), code, "BCD"), None, REFUSED)


def _of_the_users_workbook() -> None:
    """Units in the workbook of two sheets, formulas and stored values among them."""

    def converted(form: str, unit: str, factor: float) -> Book:
        made = users(BIG)
        for sheet in made.sheets:
            for at, value in list(sheet.cells.items()):
                if at[0] in "FVWA":
                    continue
                if isinstance(value, float):
                    sheet[at] = float(f"{value / factor:.15g}")
                elif isinstance(value, Formula):
                    sheet[at] = Formula(value.text, float(f"{value.stored / factor:.15g}"))
            for column in USERS_COLUMNS.values():
                if isinstance(text := sheet[f"{column}1"], str):
                    sheet[f"{column}1"] = form.format(text)
        return made

    for unit, factor in (("cm", 10.0), ("in", 25.4), ("m", 1000.0)):
        made = with_cells(converted(f"{{}} ({unit})", unit, factor), Coordinates_U2=f"pinhole range ({unit})")
        CASES.add(f"users' workbook in {unit}", made, BIG, RIGHT)
    for unit, factor in (("cm", 10.0), ("in", 25.4)):
        said = f"all in {unit}"
        made = with_cells(converted("{}", unit, factor), Coordinates_A1=said, Main_A1=said)
        name = f"users' workbook, {said!r} above"
        CASES.add(name, made, BIG, *DOUBTED, place="!A1", columns=users_map(unit))
    # Main alone in another unit: the formulas of the other sheet would mix them, so its values are typed.
    made = typed(users(BIG))
    for at, value in made["Main"].cells.items():
        if isinstance(value, float):
            made["Main"][at] = float(f"{value / 10:.15g}")
    for column in "PQST":
        made["Main"][f"{column}1"] += " (cm)"
    CASES.add("users' workbook, Main in cm", made, BIG, RIGHT)
    degrees = with_cells(
        users(), Coordinates_V2="pinhole azimuth (degrees)", Coordinates_W2="pinhole elevation (degrees)"
    )
    for at, formula in formulas_of(degrees["Coordinates"]).items():
        if at[0] in "VW":
            value = float(formula.stored) * 180 / 3.141592653589793
            degrees["Coordinates"][at] = Formula(f"DEGREES({formula.text})", value)
    CASES.add("angles in degrees, said so", degrees, SCANNER, RIGHT)
    fonts = '<r><t>x</t></r><r><rPr><vertAlign val="subscript"/></rPr><t>1</t></r><r><t> (cm)</t></r>'
    rich = typed(with_cells(users(), Coordinates_B1=Rich(fonts)))
    for i in range(3, 7):
        rich["Coordinates"][f"B{i}"] /= 10
    mapped = users_map({"x1": "cm"})
    name = "unit in a heading of several fonts"
    CASES.add(name, rich, SCANNER, *READ_OR_REFUSED, place="Coordinates!B1", columns=mapped)


_in_headings()
_of_one_column()
_around()
_in_number_formats()
_of_the_users_workbook()
