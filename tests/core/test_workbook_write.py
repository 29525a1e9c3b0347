"""The workbook writer: the system can be read back, formulas stay and are right, and nothing else changes."""

from __future__ import annotations

import json
import re
import sys
import warnings
import zipfile
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import openpyxl
import pytest
from openpyxl.utils.cell import coordinate_to_tuple

import mphdrr.core as mph
from mphdrr.core.workbook.book import Book

from . import libreoffice
from .nasty.layouts import Layout, random_centers, system_of
from .test_workbook import VARIATIONS
from .workbooks import (
    DIMENSIONS,
    TemplateLayout,
    by_design,
    content_of,
    edited,
    plain,
    random_change,
    read_quietly,
    saved_template,
    template_workbook,
    values_of,
    with_centers,
    write_quietly,
)

try:
    from hypothesis import HealthCheck, example, given, settings
    from hypothesis import strategies as st
except ImportError:  # the property tests skip
    st = None

QUIET = pytest.mark.filterwarnings("ignore::mphdrr.core.errors.InputWarning")
OFFICE = libreoffice.program()
CORE, ROOMS = f"{mph.__name__}.", Path(mph.__file__).parent


def assert_same(back: mph.PinholeSystem, system: mph.PinholeSystem, numbered: bool = True) -> None:
    assert len(back) == len(system)
    if numbered:
        np.testing.assert_array_equal(back.numbers, system.numbers)
    for name in ("centers", "collimator_length", *DIMENSIONS.values()):
        np.testing.assert_allclose(getattr(back, name), getattr(system, name), rtol=1e-9, atol=0, err_msg=name)


def write_changed(folder, layout: TemplateLayout, seed: int):
    """Return a template of the layout, a change of its system, and the written result."""
    template = folder / "template.xlsx"
    template.write_bytes(content_of(template_workbook(layout)))
    system = random_change(np.random.default_rng(seed), read_quietly(template), layout)
    return system, write_quietly(system, folder / "written.xlsx", template)


def assert_in_order(path) -> None:
    """Rows and cells occur once each and in order, formulas before values, as spreadsheet programs require."""
    main = "{http://schemas.openxmlformats.org/spreadsheetml/2006/main}"
    with zipfile.ZipFile(path) as archive:
        for name in archive.namelist():
            if not name.startswith("xl/worksheets/sheet"):
                continue
            rows = ElementTree.fromstring(archive.read(name)).findall(f"{main}sheetData/{main}row")
            numbers = [int(row.get("r")) for row in rows]
            assert numbers == sorted(set(numbers))
            for number, row in zip(numbers, rows, strict=True):
                places = [coordinate_to_tuple(cell.get("r")) for cell in row]
                assert places == sorted(set(places))
                assert {r for r, _ in places} <= {number}
                for cell in row:
                    tags = [e.tag.removeprefix(main) for e in cell]
                    assert tags in ([], ["f"], ["v"], ["is"], ["f", "v"])


def notes_of(path, system: mph.PinholeSystem) -> dict[int, object]:
    """Return the note in each module's row."""
    values = values_of(path)
    row_of = {value: cell for (_, cell), value in values.items() if str(value).startswith("note of")}
    notes = {"".join(filter(str.isdigit, cell)): note for note, cell in row_of.items()}
    back = read_quietly(path)
    rows = [str(row) for row in next(c for c in back.source.cells if c.quantity == "x1").rows]
    return {int(number): notes.get(row) for number, row in zip(back.numbers, rows, strict=True)}


# Laws


if st is None:

    def test_any_change_of_any_layout_comes_back():
        pytest.skip("hypothesis is not installed")

else:
    layouts = st.builds(
        TemplateLayout,
        n=st.integers(1, 6),
        numbered=st.booleans(),
        one_sheet=st.booleans(),
        shared=st.booleans(),
        length=st.sampled_from(["formula", "typed", "blank", "absent"]),
        derived=st.sampled_from(["formula", "typed", "absent"]),
        inputs=st.booleans(),
        top=st.integers(0, 4),
        left=st.integers(0, 2),
        seed=st.integers(0, 1000),
    )

    def check_a_change_comes_back(folder, layout, seed):
        system, written = write_changed(folder, layout, seed)
        assert_same(read_quietly(written.path), system, layout.numbered)
        assert_in_order(written.path)
        again = mph.write_system(read_quietly(written.path), folder / "again.xlsx", written.path)
        assert again.path.read_bytes() == written.path.read_bytes()
        assert (again.changed, again.recalculated) == ((), {})
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            mph.read_system(written.path)
        assert not [w for w in caught if "the formula's is used" in str(w.message)]
        template = read_quietly(folder / "template.xlsx")
        before = notes_of(folder / "template.xlsx", template)
        for number, note in notes_of(written.path, system).items():
            assert not layout.numbered or note == before.get(number) or number >= 1000, number

    @settings(max_examples=8, derandomize=True, deadline=None, suppress_health_check=list(HealthCheck))
    @given(layouts, st.integers(0, 10**6))
    # One module becomes three; one cell for all modules becomes one for each, to which formulas of H do not refer.
    @example(TemplateLayout(n=1, numbered=False), 2)
    @example(TemplateLayout(n=4, one_sheet=True, shared=True, inputs=True, top=2, seed=739), 197743)
    # The first of the modules without numbers is removed, and the one cell for all becomes one for each.
    @example(TemplateLayout(n=4, numbered=False, shared=True, derived="absent"), 97)
    def test_any_change_of_any_layout_comes_back(tmp_path_factory, layout, seed):
        check_a_change_comes_back(tmp_path_factory.mktemp("w"), layout, seed)

    @pytest.mark.long
    @settings(max_examples=75, deadline=None, suppress_health_check=list(HealthCheck))
    @given(layouts, st.integers(0, 10**6))
    def test_many_changes_of_many_layouts_come_back(tmp_path_factory, layout, seed):
        check_a_change_comes_back(tmp_path_factory.mktemp("w"), layout, seed)

    @settings(max_examples=6, derandomize=True, deadline=None, suppress_health_check=list(HealthCheck))
    @given(st.integers(1, 12), st.integers(0, 10**6), st.booleans())
    def test_workbooks_without_template_come_back(tmp_path_factory, n, seed, scaled):
        rng = np.random.default_rng(seed)
        system = system_of(Layout(modules=n, seed=seed))
        if scaled:
            factors = np.where(rng.random(n) < 0.5, 1.05, 1)
            system = replace(system, collimator_length=system.collimator_length * factors)
        path = tmp_path_factory.mktemp("w") / "new.xlsx"
        mph.write_system(system, path)
        back = mph.read_system(path) if not scaled else read_quietly(path)
        assert_same(back, system)
        np.testing.assert_array_equal(back.collimator_length, system.collimator_length)


@pytest.mark.skipif(OFFICE is None, reason="LibreOffice is not installed")
@pytest.mark.long
def test_libreoffice_finds_the_values_that_are_stored(tmp_path):
    """Every cell of every sheet, after LibreOffice has recalculated the written files."""
    rng = np.random.default_rng(4)
    choices = [
        TemplateLayout(
            n=int(rng.integers(2, 6)),
            numbered=bool(rng.random() < 0.7),
            one_sheet=bool(rng.random() < 0.4),
            shared=bool(rng.random() < 0.3),
            length=str(rng.choice(["formula", "formula", "typed", "blank"])),
            derived=str(rng.choice(["formula", "formula", "typed"])),
            inputs=bool(rng.random() < 0.5),
            top=int(rng.integers(0, 3)),
            seed=seed,
        )
        for seed in range(16)
    ]
    templates = [content_of(template_workbook(layout)) for layout in choices]
    saved = libreoffice.recalculated(templates[8:])
    assert None not in saved
    templates[8:] = saved  # half of them as a spreadsheet program saves them
    systems, written = [], []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for i, (content, layout) in enumerate(zip(templates, choices, strict=True)):
            template = tmp_path / f"t{i}.xlsx"
            template.write_bytes(content)
            system = random_change(rng, mph.read_system(template), layout)
            written.append(mph.write_system(system, tmp_path / f"w{i}.xlsx", template))
            systems.append(system)
    recalculated = libreoffice.recalculated([w.path.read_bytes() for w in written])
    compared = 0
    for one, system, content, layout in zip(written, systems, recalculated, choices, strict=True):
        theirs, formulas = values_of(content), values_of(one.path, data_only=False)
        ours = values_of(one.path)
        (tmp_path / "theirs.xlsx").write_bytes(content)
        assert_same(read_quietly(tmp_path / "theirs.xlsx"), system, layout.numbered)
        for place, formula in formulas.items():
            if place not in ours:  # those without a value: never there, or cleared
                assert str(formula).startswith("="), place
                assert f"{place[0]}!{place[1]}" not in one.recalculated
                continue
            value, wanted = ours[place], theirs.get(place)
            if isinstance(value, (int, float)):
                assert value == pytest.approx(wanted, rel=1e-9, abs=1e-11), (one.path.name, place, formula)
            else:
                assert value == wanted, (one.path.name, place, formula)
            compared += str(formula).startswith("=")
    assert compared > 400


# The real workbook


def test_real_workbook_unchanged_is_the_same_file(workbook, tmp_path):
    written = mph.write_system(mph.read_system(workbook), tmp_path / "copy.xlsx", workbook)
    assert written.path.read_bytes() == workbook.read_bytes()
    assert (written.changed, written.recalculated, written.cleared) == ((), {}, ())


def test_a_moved_pinhole_changes_its_row_alone(workbook, tmp_path):
    system = mph.read_system(workbook)
    moved = with_centers(system, 3, system.centers[3] + [1.0, -2.0, 1 / 3])
    written = mph.write_system(moved, tmp_path / "moved.xlsx", workbook)
    assert written.changed == ("Coordinates!B6", "Coordinates!C6", "Coordinates!D6")
    assert set(written.recalculated) == {f"Coordinates!{c}6" for c in "EFGHIJKUVW"}
    values = values_of(written.path)
    assert written.recalculated == {place: values[tuple(place.split("!"))] for place in written.recalculated}
    np.testing.assert_array_equal(mph.read_system(written.path).centers, moved.centers)
    before, after = (values_of(p, data_only=False) for p in (workbook, written.path))
    assert {p for p in before if before[p] != after[p]} == {("Coordinates", f"{c}6") for c in "BCD"}
    distance = moved.pinhole_distance[3] + moved.collimator_length[3] + 10
    assert values["Coordinates", "H6"] == pytest.approx(distance, rel=1e-12)


# New workbooks


@pytest.mark.filterwarnings("error")
def test_new_workbook_is_laid_out_as_the_real_one(workbook, scanner, tmp_path):
    mph.write_system(scanner, tmp_path / "new.xlsx")
    for data_only in (False, True):
        real, new = (values_of(path, data_only) for path in (workbook, tmp_path / "new.xlsx"))
        assert real.keys() == new.keys()
        for place, value in real.items():
            same = value if isinstance(value, str) else pytest.approx(value, rel=1e-12)
            assert new[place] == same, place
    mph.write_system(scanner, tmp_path / "again.xlsx")
    assert (tmp_path / "again.xlsx").read_bytes() == (tmp_path / "new.xlsx").read_bytes()


def test_values_in_a_new_workbook_are_those_of_its_formulas(system, tmp_path):
    """Also on the axes, where spreadsheets divide by 0, and with lengths that are not the design formula's."""
    odd = with_centers(system, slice(3), [[0, 0, 240], [0, 240, 15], [-240, 0, 15]])
    odd = replace(odd, collimator_length=odd.collimator_length * np.where(np.arange(len(odd)) == 5, 1.25, 1))
    written = mph.write_system(odd, tmp_path / "new.xlsx")
    book = Book(written.path)
    formulas = {book.workbook.address_text(place): (place, cell) for place, cell in book.workbook.formulas.items()}
    assert written.recalculated == {name: cell.value for name, (_, cell) in formulas.items()}
    for name, (place, cell) in formulas.items():
        computed = book.calculation.value(place)
        assert computed == (cell.value if isinstance(cell.value, str) else pytest.approx(cell.value, rel=1e-12)), name
    undefined = [name for name, value in written.recalculated.items() if value == "#DIV/0!"]
    assert undefined == ["Coordinates!V3", "Coordinates!F3", "Coordinates!F4"]
    assert "Coordinates!G8" not in written.recalculated
    assert_same(read_quietly(written.path), odd)


def test_a_new_workbook_is_written_in_one_pass(scanner, tmp_path):
    """Few rooms of the core have a part in it (its own files count as one), and nothing that reads workbooks."""
    entered = set()

    def profile(frame, event: str, _argument: object) -> None:
        if event == "call" and (module := frame.f_globals.get("__name__", "")).startswith(CORE):
            entered.add(module.removeprefix(CORE))

    sys.setprofile(profile)
    try:
        mph.write_system(scanner, tmp_path / "new.xlsx")
    finally:
        sys.setprofile(None)
    rooms = {name.partition(".")[0] if (ROOMS / name.partition(".")[0]).is_dir() else "" for name in entered}
    assert len(rooms) <= 6, rooms
    within = {name for name in entered if name.startswith("workbook.")}
    assert within == {"workbook.writer", "workbook.new_workbook", "workbook.sheet_xml"}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"numbers": [1, 2**53, 3]}, "number of module 9007199254740992 is 9.0072e+15, expected at most"),
        ({"collimator_length": 1.7e308, "detector_thickness": 1.7e308}, "H of module 1 is inf, expected at most"),
    ],
)
def test_what_no_cell_can_hold_is_refused(change, message, scanner, tmp_path):
    with pytest.raises(mph.InputError, match=f"^the new workbook cannot hold this system: {re.escape(message)}"):
        mph.write_system(replace(scanner[:3], **change), tmp_path / "new.xlsx")
    assert not (tmp_path / "new.xlsx").exists()


# Rows


@pytest.fixture
def template(tmp_path):
    """Four modules with formulas everywhere; the stored values do not matter."""
    return saved_template(tmp_path / "template.xlsx", seed=3)


@QUIET
def test_removed_modules_leave_their_rows_empty(template, tmp_path):
    system = mph.read_system(template)
    mph.write_system(system[[0, 2, 3]], tmp_path / "o.xlsx", template)
    book = openpyxl.load_workbook(tmp_path / "o.xlsx")
    for sheet in ("Coordinates", "Main"):
        assert [cell.value for cell in book[sheet][4]] == [None] * book[sheet].max_column
    assert values_of(tmp_path / "o.xlsx")["Coordinates", "O3"] == "note of 0"
    assert values_of(tmp_path / "o.xlsx")["Coordinates", "O5"] == "note of 2"
    assert_same(mph.read_system(tmp_path / "o.xlsx"), system[[0, 2, 3]])


def test_added_modules_get_the_formulas_and_none_of_the_notes(template, tmp_path):
    system = mph.read_system(template)
    more = more_of(system, 2)
    with pytest.warns(mph.InputWarning) as caught:
        mph.write_system(more, tmp_path / "o.xlsx", template)
    (message,) = [str(w.message) for w in caught if "left out" in str(w.message)]
    places = "the name all_x, Theta!A1, Theta!A5 and 2 more"
    assert message.startswith(f"template.xlsx: {places} end at row 6 of sheet Coordinates")
    cells = values_of(tmp_path / "o.xlsx", data_only=False)
    assert cells["Coordinates", "E8"] == "=SQRT(SUMSQ(B8,C8,D8))"
    assert cells["Coordinates", "A8"] == cells["Main", "A8"] == more.numbers[-1]
    assert ("Coordinates", "O8") not in cells
    assert_same(mph.read_system(tmp_path / "o.xlsx"), more)


@QUIET
def test_reordered_modules_take_their_rows_along(template, tmp_path):
    system = mph.read_system(template)[[2, 0, 3, 1]]
    mph.write_system(system, tmp_path / "o.xlsx", template)
    values = values_of(tmp_path / "o.xlsx", data_only=False)
    assert [values["Coordinates", f"O{row}"] for row in range(3, 7)] == [f"note of {i}" for i in (2, 0, 3, 1)]
    assert values["Coordinates", "E3"] == "=SQRT(SUMSQ(B3,C3,D3))"
    assert_same(mph.read_system(tmp_path / "o.xlsx"), system)


@QUIET
@pytest.mark.parametrize("order", [[1, 2, 3], [3, 1, 2, 0]])
def test_a_summary_beside_the_table_stays_where_it_is(template, tmp_path, order):
    with edited(template) as book:
        sheet = book["Coordinates"]
        first = sheet.max_column + 1
        sheet.cell(3, first).value, sheet.cell(3, first + 1).value = "highest", "=MAX(B3:B6)"
    system = read_quietly(template)[order]
    mph.write_system(system, tmp_path / "o.xlsx", template)
    cells, values = (openpyxl.load_workbook(tmp_path / "o.xlsx", data_only=d)["Coordinates"] for d in (False, True))
    assert (cells.cell(3, first).value, cells.cell(3, first + 1).value) == ("highest", "=MAX(B3:B6)")
    assert values.cell(3, first + 1).value == pytest.approx(system.centers[:, 0].max(), rel=1e-12)


@QUIET
def test_renumbered_modules_keep_their_rows(template, tmp_path):
    system = mph.read_system(template)
    system = replace(system, numbers=system.numbers + 1000)
    written = mph.write_system(system, tmp_path / "o.xlsx", template)
    assert written.changed == tuple(f"{sheet}!A{row}" for sheet in ("Main", "Coordinates") for row in range(3, 7))
    assert_same(mph.read_system(tmp_path / "o.xlsx"), system)


def test_a_cell_in_the_way_of_added_modules_is_named(template, tmp_path):
    with edited(template) as book:
        book["Coordinates"]["A8"] = "note: all in mm"
    system = mph.read_system(template)
    more = more_of(system, 3)
    with pytest.raises(mph.InputError, match=r"^template.xlsx: Coordinates!A8 is not blank"):
        mph.write_system(more, tmp_path / "o.xlsx", template)
    assert not (tmp_path / "o.xlsx").exists()


def more_of(system, n):
    rng = np.random.default_rng(1)
    dimensions = {name: getattr(system, name) for name in DIMENSIONS.values()}
    arrays = {name: np.append(values, np.resize(values, n)) for name, values in dimensions.items()}
    centers = np.concatenate([system.centers, random_centers(rng, n)])
    numbers = np.append(system.numbers, system.numbers.max() + 1 + np.arange(n))
    return by_design(mph.PinholeSystem(centers, collimator_length=1.0, numbers=numbers, **arrays))


# Formulas


@QUIET
@pytest.mark.parametrize("formula", ["=270+7", "=Main!$H$9*1"])
def test_a_formula_that_does_not_give_the_number_is_replaced_with_a_warning(template, tmp_path, formula):
    with edited(template) as book:
        book["Main"]["H9"] = 277
        book["Coordinates"]["B3"] = formula
    system = with_centers(read_quietly(template), (0, 0), 280.5)
    with pytest.warns(mph.InputWarning, match=r"template.xlsx: Coordinates!B3: the formula was replaced .*gives 277"):
        mph.write_system(system, tmp_path / "o.xlsx", template)
    assert values_of(tmp_path / "o.xlsx", data_only=False)["Coordinates", "B3"] == 280.5


@QUIET
def test_a_formula_that_gives_the_new_number_stays(template, tmp_path):
    with edited(template) as book:
        book["Coordinates"]["B4"] = "=-B3"
    system = with_centers(read_quietly(template), (slice(2), 0), [280.5, -280.5])
    written = mph.write_system(system, tmp_path / "o.xlsx", template)
    cells = values_of(tmp_path / "o.xlsx", data_only=False)
    assert (cells["Coordinates", "B3"], cells["Coordinates", "B4"]) == (280.5, "=-B3")
    assert values_of(tmp_path / "o.xlsx")["Coordinates", "B4"] == -280.5
    assert "Coordinates!B4" in written.recalculated


def test_a_formula_that_comes_to_refer_to_itself_is_replaced_alone(template, tmp_path):
    """Sorted as by a spreadsheet, =B$3 of another row moves to B3 itself; cells that depend on it stay formulas."""
    with edited(template) as book:
        for row in range(4, 7):
            book["Main"][f"B{row}"] = "=B$3"
        book["Main"]["B3"] = 2.25
    system = by_design(replace(read_quietly(template), pinhole_diameter=2.25))
    with pytest.warns(mph.InputWarning) as caught:
        mph.write_system(system[[3, 0, 1, 2]], tmp_path / "o.xlsx", template)
    replaced = [str(w.message) for w in caught if "the formula was replaced" in str(w.message)]
    assert replaced == [
        "template.xlsx: Main!B3: the formula was replaced by the system's number (it refers back to itself)"
    ]
    cells = values_of(tmp_path / "o.xlsx", data_only=False)
    assert [cells["Main", f"B{row}"] for row in range(3, 7)] == [2.25, 2.25, "=B$3", "=B$3"]
    assert str(cells["Coordinates", "G3"]).startswith("=")
    assert_same(mph.read_system(tmp_path / "o.xlsx"), system[[3, 0, 1, 2]])


def test_what_nobody_can_calculate_stores_no_value(template, tmp_path):
    with edited(template) as book:
        del book["Theta"], book["It's values"]
        other = book.create_sheet("Other")
        other["A1"], other["A2"], other["A3"] = "=FOO(Coordinates!B3)", "=A1+1", "=FOO(1)"
    system = read_quietly(template)
    larger = by_design(replace(system, centers=system.centers * 1.1))
    with pytest.warns(mph.InputWarning, match=r"Other!A1 and 1 more: the formula's new value could not be calculated"):
        written = mph.write_system(larger, tmp_path / "o.xlsx", template)
    assert written.cleared == ("Other!A1", "Other!A2")


def test_a_system_is_read_back_from_formulas_without_values(template, tmp_path):
    """SUMPRODUCT is beyond the evaluator: H stores no value, and the formula of an l that must be right is replaced."""
    with edited(template) as book:
        table = book["Coordinates"]
        columns = {cell.value: cell.column_letter for cell in table[2] if cell.value}
        length, end = columns["l"], columns["l + b+Td"]
        for row in range(3, 7):
            table[f"{end}{row}"] = f"=SUMPRODUCT({length}{row}:{length}{row})+{columns['b']}{row}+Main!E{row}"
        table[f"{length}4"] = table[f"{length}4"].value + "*SUMPRODUCT(1)"
    system = read_quietly(template)
    system = by_design(replace(system, centers=system.centers * 1.1))
    with pytest.warns(mph.InputWarning) as caught:
        written = mph.write_system(system, tmp_path / "o.xlsx", template)
    replaced, cleared = sorted(str(w.message) for w in caught)
    assert replaced.startswith(f"template.xlsx: Coordinates!{length}4: the formula was replaced by the system's number")
    assert cleared.startswith(f"template.xlsx: Coordinates!{end}3 and ")
    assert {f"Coordinates!{end}{row}" for row in range(3, 7)} <= set(written.cleared)
    assert_same(mph.read_system(written.path), system)


@QUIET
def test_one_cell_for_all_modules_is_changed_or_spread(tmp_path):
    template = saved_template(tmp_path / "template.xlsx", shared=True, length="absent", derived="absent")
    system = read_quietly(template)
    written = mph.write_system(by_design(replace(system, pinhole_diameter=3.3)), tmp_path / "o.xlsx", template)
    assert written.changed == ("Main!B3",)
    different = by_design(replace(system, pinhole_diameter=[1.0, 2.0, 3.0, 4.0]))
    mph.write_system(different, tmp_path / "o.xlsx", template)
    values = values_of(tmp_path / "o.xlsx")
    assert [values.get(("Main", f"B{row}")) for row in range(3, 7)] == [1, 2, 3, 4]
    assert [values.get(("Main", f"C{row}")) for row in range(4, 7)] == [None] * 3
    assert_same(mph.read_system(tmp_path / "o.xlsx"), different)


def test_without_a_column_of_lengths_only_designed_ones_are_held(tmp_path):
    template = saved_template(tmp_path / "template.xlsx", length="absent")
    system = read_quietly(template)
    with pytest.raises(mph.InputError, match="no column headed l for the collimator length of module"):
        mph.write_system(replace(system, collimator_length=99.0), tmp_path / "o.xlsx", template)


def test_numbers_that_the_sheet_cannot_say_are_warned_of(tmp_path):
    template = saved_template(tmp_path / "template.xlsx", numbered=False, length="absent", derived="absent")
    system = read_quietly(template)
    with pytest.warns(mph.InputWarning, match="has no column of the modules' numbers"):
        mph.write_system(replace(system, numbers=[5, 6, 7, 8]), tmp_path / "o.xlsx", template)
    assert (tmp_path / "o.xlsx").read_bytes() == template.read_bytes()


def test_a_workbook_may_replace_itself(template):
    system = read_quietly(template)
    write_quietly(by_design(replace(system, centers=system.centers * 1.01)), template, template)
    np.testing.assert_array_equal(read_quietly(template).centers, system.centers * 1.01)
    assert [p.name for p in template.parent.iterdir()] == ["template.xlsx"]


@pytest.mark.parametrize("edit", VARIATIONS, ids=lambda edit: edit.__name__.strip("_"))
@QUIET
def test_every_layout_that_is_read_can_be_written(edit, tmp_path, rng):
    book = plain()
    edit(*book.worksheets[:2])
    template = tmp_path / "t.xlsx"
    book.save(template)
    system = read_quietly(template)
    other = by_design(replace(system, centers=random_centers(rng, 4), pinhole_diameter=rng.uniform(1, 3, 4)))
    wanted = more_of(other[[3, 0, 1]], 2)
    if edit.__name__ == "_blank_rows_and_notes":
        with pytest.raises(mph.InputError, match="Coordinates!A11 is not blank"):  # a note
            mph.write_system(wanted, tmp_path / "o.xlsx", template)
        wanted = wanted[:4]
    mph.write_system(wanted, tmp_path / "o.xlsx", template)
    assert_same(read_quietly(tmp_path / "o.xlsx"), wanted, numbered="without_numbers" not in edit.__name__)


def test_formulas_filled_down_are_taken_for_added_modules(template, tmp_path):
    book = openpyxl.load_workbook(template)
    for row in range(7, 30):
        book["Coordinates"][f"E{row}"] = f"=SQRT(SUMSQ(B{row},C{row},D{row}))"
    book.save(template)
    more = more_of(read_quietly(template), 2)
    with pytest.warns(mph.InputWarning):
        mph.write_system(more, tmp_path / "o.xlsx", template)
    assert_same(mph.read_system(tmp_path / "o.xlsx"), more)
    book["Coordinates"]["E7"] = "=AVERAGE(E3:E6)"
    book.save(template)
    with pytest.raises(mph.InputError, match="Coordinates!E7 is not blank"):
        mph.write_system(more, tmp_path / "o.xlsx", template)


# Refusals


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("o.xls", "expected a name ending in .xlsx or .xlsm"),
        ("o.xlsm", "is a workbook without macros, expected a name ending in .xlsx"),
        ("none/o.xlsx", "no such folder"),
        (".", "expected a name ending in"),
    ],
)
def test_impossible_places_are_refused(template, path, message):
    with pytest.raises(mph.InputError, match=message):
        mph.write_system(read_quietly(template), template.parent / path, template)
    with pytest.raises(mph.InputError):
        mph.write_system(read_quietly(template), template.parent / path)


def test_only_systems_are_written(tmp_path):
    with pytest.raises(mph.InputError, match="expected a Scanner, got str"):
        mph.write_system("scanner.xlsx", tmp_path / "o.xlsx")  # type: ignore[arg-type]
    with pytest.raises(mph.InputError, match="expected a Scanner, got str"):
        mph.write_geometry("scanner.xlsx", tmp_path / "o.json", "mphdrr")  # type: ignore[arg-type]


def test_bad_templates_are_refused_as_by_the_reader(template, tmp_path):
    system, damaged = read_quietly(template), tmp_path / "damaged.xlsx"
    with edited(template) as book:
        book["Coordinates"]["B4"] = "abc"
    damaged.write_bytes(b"x")
    for path, message in ((template, "B4 holds the text 'abc'"), (damaged, "not an .xlsx workbook")):
        with pytest.raises(mph.InputError, match=message):
            mph.write_system(system, tmp_path / "o.xlsx", path)


def test_a_system_that_would_be_refused_is_not_written(template, tmp_path):
    system = read_quietly(template)
    twice = with_centers(system, 1, system.centers[0] + 1e-9)  # the same position, in a workbook's precision
    for source, name in ((template, "template.xlsx"), (None, "the new workbook")):
        with pytest.raises(mph.InputError, match=f"^{name} cannot hold this system, with it: {name}: Coordinates!B4 "):
            mph.write_system(twice, tmp_path / "o.xlsx", source)
    assert not (tmp_path / "o.xlsx").exists()


# The command line


def test_geometry_set_changes_the_chosen_modules(workbook, tmp_path, capsys):
    from mphdrr.addon.cli import main

    eight, out = str(tmp_path / "eight.xlsx"), tmp_path / "o.xlsx"
    mph.write_system(mph.read_system(workbook)[:8], eight)
    options = ["--modules", "1-2", "--diameter", "2", "--move", "1", "0", "-2", "--remove", "8", "-o", str(out)]
    assert main(["geometry", "set", eight, *options]) == 0
    assert capsys.readouterr().out.startswith(f"{out}: ")
    old, new = mph.read_system(eight), mph.read_system(out)
    np.testing.assert_array_equal(new.centers[:2], old.centers[:2] + np.array([1, 0, -2]))
    np.testing.assert_array_equal(new.centers[2:], old.centers[2:7])
    np.testing.assert_array_equal(new.pinhole_diameter, np.repeat([2, 2.3], [2, 5]))
    np.testing.assert_allclose(new.collimator_length, by_design(new).collimator_length, rtol=1e-9)
    order = ",".join(map(str, new.numbers[::-1]))
    assert main(["geometry", "set", str(out), "--length", "60", "--order", order, "--json", "-o", str(out)]) == 0
    assert "Coordinates!G3" in json.loads(capsys.readouterr().out)["changed"]
    np.testing.assert_array_equal(read_quietly(out).centers, new.centers[::-1])
    np.testing.assert_array_equal(read_quietly(out).collimator_length, 60)
    for wrong in (["--length", "x"], ["--order", "1,2"], ["--roi", "500"], ["--modules", "900"]):
        assert main(["geometry", "set", eight, *wrong, "-o", str(tmp_path / "p.xlsx")]) == 1
        assert capsys.readouterr().err.startswith("mphdrr: ")
    for wrong in ("1-8", "9"):
        assert main(["geometry", "set", eight, "--remove", wrong, "-o", str(tmp_path / "p.xlsx")]) == 1
        assert capsys.readouterr().err.startswith(f"mphdrr: --remove '{wrong}': ")
    assert not (tmp_path / "p.xlsx").exists()
