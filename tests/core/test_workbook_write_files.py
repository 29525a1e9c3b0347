"""The written file: everything unchanged is byte for byte the template's, whatever its XML looks like."""

from __future__ import annotations

import io
import os
import re
import signal
import subprocess
import sys
import time
import zipfile
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import openpyxl
import pytest
from openpyxl.chart import LineChart, Reference
from openpyxl.comments import Comment
from openpyxl.drawing.image import Image
from openpyxl.formatting.rule import ColorScaleRule
from openpyxl.worksheet.datavalidation import DataValidation
from openpyxl.worksheet.formula import ArrayFormula
from openpyxl.worksheet.table import Table

import mphdrr
import mphdrr.core as mph

from .workbooks import (
    TemplateLayout,
    by_design,
    content_of,
    read_quietly,
    repacked,
    saved_template,
    template_content,
    template_workbook,
    values_of,
    with_centers,
    write_quietly,
)

SIZES = ("pinhole_diameter", "detector_side", "detector_thickness", "roi_radius")
SHEETS = "xl/worksheets/sheet"
SPREADSHEET = "http://schemas.openxmlformats.org/spreadsheetml/2006/main"


def members_of(path: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(path) as archive:
        return {info.filename: archive.read(info) for info in archive.infolist()}


def infos_of(path: Path) -> list[tuple]:
    with zipfile.ZipFile(path) as archive:
        return [
            (i.filename, i.date_time, i.compress_type, i.comment, i.extra, i.external_attr, i.create_system)
            for i in archive.infolist()
        ]


def moved(system: mph.PinholeSystem) -> mph.PinholeSystem:
    return with_centers(system, 1, system.centers[1] * 1.03)


def write_template(folder: Path, content: bytes, name: str, edit: Callable[[bytes], bytes]) -> Path:
    """Write a workbook, its members whose names begin with `name` edited, and return its path."""
    path = folder / "t.xlsx"
    path.write_bytes(repacked(content, lambda member, data: edit(data) if member.startswith(name) else data))
    return path


@pytest.fixture
def rich(tmp_path) -> Path:
    """Return a workbook with all that openpyxl loses or rewrites, and macros."""
    book = template_workbook(TemplateLayout(seed=5))
    table = book["Coordinates"]
    chart = LineChart()
    chart.add_data(Reference(table, min_col=2, min_row=2, max_row=6), titles_from_data=True)
    table.add_chart(chart, "P2")
    from PIL import Image as Picture

    picture = tmp_path / "p.png"
    Picture.new("RGB", (8, 8), (200, 30, 30)).save(picture)
    table.add_image(Image(picture), "P30")
    table["B3"].comment = Comment("measured twice", "N. N.")
    table.conditional_formatting.add("B3:B6", ColorScaleRule("min", None, "FF0000", "max", None, "00FF00"))
    validation = DataValidation(type="decimal", operator="between", formula1="-400", formula2="400")
    table.add_data_validation(validation)
    validation.add("B3:D6")
    table.column_dimensions["C"].hidden = True
    table.merge_cells("P40:R41")
    table.freeze_panes = "B3"
    content = content_of(book)
    picture.unlink()

    def with_macros(name: str, data: bytes) -> bytes:
        if name == "[Content_Types].xml":
            data = data.replace(
                b"openxmlformats-officedocument.spreadsheetml.sheet.main", b"ms-excel.sheet.macroEnabled.main"
            )
            extra = b'<Default Extension="bin" ContentType="application/vnd.ms-office.vbaProject"/></Types>'
            return data.replace(b"</Types>", extra)
        if name == "xl/workbook.xml":
            return data.replace(b' fullCalcOnLoad="1"', b"")
        if name == "xl/_rels/workbook.xml.rels":
            kind = "http://schemas.microsoft.com/office/2006/relationships/vbaProject"
            extra = f'<Relationship Id="rIdV" Type="{kind}" Target="vbaProject.bin"/></Relationships>'
            return data.replace(b"</Relationships>", extra.encode())
        return data

    out = io.BytesIO(repacked(content, with_macros))
    with zipfile.ZipFile(out, "a") as archive:
        info = zipfile.ZipInfo("xl/vbaProject.bin", (1999, 12, 31, 23, 59, 58))
        info.external_attr, info.comment, info.create_system = 0, b"macros", 0
        archive.writestr(info, bytes(range(256)) * 9)
        archive.writestr("customXml/item1.xml", "<mine>ünï</mine>", zipfile.ZIP_DEFLATED)
        archive.comment = b"of the archive"
    path = tmp_path / "rich.xlsm"
    path.write_bytes(out.getvalue())
    return path


def test_every_other_member_is_the_same(rich, tmp_path):
    written = write_quietly(moved(read_quietly(rich)), tmp_path / "o.xlsm", rich)
    before, after = members_of(rich), members_of(written.path)
    assert list(before) == list(after)
    assert infos_of(rich) == infos_of(written.path)
    differing = {name for name in before if before[name] != after[name]}
    sheets = {f"xl/worksheets/sheet{i}.xml" for i in (2, 3, 4)}
    assert differing == {"xl/workbook.xml", *sheets}
    assert b'fullCalcOnLoad="1"' in after["xl/workbook.xml"]
    with zipfile.ZipFile(written.path) as archive:
        assert archive.comment == b"of the archive"
    for kind in ("charts/chart1.xml", "media/image1.png", "vbaProject.bin", "drawings/drawing1.xml"):
        assert f"xl/{kind}" in after


def test_of_a_changed_sheet_only_the_changed_cells_differ(rich, tmp_path):
    written = write_quietly(moved(read_quietly(rich)), tmp_path / "o.xlsm", rich)
    cells = re.compile(rb'<c r="([A-Z]+\d+)"[^>]*?(?:/>|>.*?</c>)')
    touched = {*written.changed, *written.recalculated, *written.cleared}
    for number, sheet in enumerate(("Coordinates", "Theta", "It's values"), start=2):
        before, after = (members_of(p)[f"xl/worksheets/sheet{number}.xml"] for p in (rich, written.path))
        assert cells.sub(b"", before) == cells.sub(b"", after)
        old, new = ({m[1]: m[0] for m in cells.finditer(xml)} for xml in (before, after))
        assert old.keys() == new.keys()
        assert {f"{sheet}!{name.decode()}" for name in old if old[name] != new[name]} <= touched


@pytest.mark.filterwarnings("ignore::mphdrr.core.errors.InputWarning")
def test_charts_and_names_that_leave_added_modules_out_are_warned_of(rich, tmp_path):
    system = read_quietly(rich)
    with pytest.warns(mph.InputWarning, match=r"all_x, the chart xl/charts/chart1.xml, .* end at row 6 of"):
        mph.write_system(_edit(system)[[0, 1, 2, 3]], tmp_path / "o.xlsm", rich)


def test_nothing_changed_is_the_same_file(rich, tmp_path):
    written = write_quietly(read_quietly(rich), tmp_path / "o.xlsm", rich)
    assert written.path.read_bytes() == rich.read_bytes()


def test_macros_need_their_suffix(rich, tmp_path):
    with pytest.raises(mph.InputError, match=r"has macros, expected a name ending in \.xlsm"):
        mph.write_system(read_quietly(rich), tmp_path / "o.xlsx", rich)


# Odd XML


def _prefixed(xml: str) -> str:
    xml = re.sub(r"<(/?)(?=[a-zA-Z])", r"<\1x:", xml)
    return xml.replace(f'xmlns="{SPREADSHEET}"', f'xmlns:x="{SPREADSHEET}"')


def _without_places(xml: str) -> str:
    """No attribute r if a cell or row directly follows the previous one."""
    xml = re.sub(r'<c r="A(\d+)"', r"<c", xml)
    return re.sub(r'<row r="([23456])"', "<row", xml) if '<row r="1"' in xml else xml


ODD = {
    "prefix": _prefixed,
    "no places": _without_places,
    "CRLF": lambda xml: xml.replace("<v></v>", "<v/>").replace("><", ">\r\n<"),
    "comments": lambda xml: xml.replace("<sheetData>", "<!-- <c r='A1'> > --><sheetData ><?pi <row> ?>"),
    "single quotes": lambda xml: re.sub("<[^>]*>", lambda tag: tag[0].replace('"', "'"), xml),
    "empty cells": lambda xml: re.sub(r"(<c [^>]*)/>", r"\1></c>", xml),
    "rows' attributes": lambda xml: xml.replace("<row ", '<row spans="1:3" ht="15" customHeight="1" '),
    "spaces around numbers": lambda xml: re.sub("<v>([^<]+)</v>", r"<v> \1\n</v>", xml),
    "BOM": lambda xml: "\ufeff" + xml,
    "no size": lambda xml: re.sub("<dimension[^>]*/>", "", xml),
    "wrong size": lambda xml: re.sub('ref="[^"]*"', 'ref="A1"', xml, count=1),
}
UNREADABLE = {
    "UTF-16": lambda xml: xml.encode("utf-16"),
    "Latin-1": lambda xml: ('<?xml version="1.0" encoding="ISO-8859-1"?><!-- \xb5 -->' + xml).encode("latin-1"),
}


def _edit(system: mph.PinholeSystem) -> mph.PinholeSystem:
    """Return the system with one module moved, one removed, one added."""
    part = moved(system)[[0, 1, 3]]
    arrays = {name: np.append(getattr(part, name), getattr(part, name)[0]) for name in SIZES}
    centers = np.concatenate([part.centers, [[7.0, 210.0, 33.125]]])
    return by_design(mph.PinholeSystem(centers, numbers=np.append(part.numbers, 999), collimator_length=1.0, **arrays))


@pytest.fixture(scope="module")
def plain_written(tmp_path_factory):
    """Return a system, and the result of writing it into a workbook with usual XML."""
    folder = tmp_path_factory.mktemp("plain")
    plain = folder / "plain.xlsx"
    plain.write_bytes(template_content(seed=11))
    system = _edit(read_quietly(plain))
    return system, write_quietly(system, folder / "written.xlsx", plain)


@pytest.mark.parametrize("odd", ODD)
def test_odd_xml_is_patched_in_place(odd, plain_written, tmp_path):
    system, expected = plain_written
    template = write_template(
        tmp_path, template_content(seed=11), SHEETS, lambda data: ODD[odd](data.decode()).encode()
    )
    written = write_quietly(system, tmp_path / "o.xlsx", template)
    for data_only in (True, False):
        assert values_of(written.path, data_only) == values_of(expected.path, data_only)
    assert written.changed == expected.changed


@pytest.mark.parametrize("encoding", UNREADABLE)
def test_xml_in_another_encoding_than_utf_8_is_refused(encoding, tmp_path):
    content = template_content(seed=11)
    template = write_template(tmp_path, content, SHEETS, lambda data: UNREADABLE[encoding](data.decode()))
    with pytest.raises(mph.InputError, match="not readable XML"):
        mph.read_system(template)


def test_a_list_of_sheets_of_another_kind_is_refused(tmp_path):
    content, spreadsheet = template_content(seed=11), SPREADSHEET.encode()
    template = write_template(
        tmp_path, content, "xl/workbook.xml", lambda data: data.replace(spreadsheet, b"urn:other")
    )
    with pytest.raises(mph.InputError, match=r"t\.xlsx: .* its sheets are none"):
        write_quietly(moved(read_quietly(template)), tmp_path / "o.xlsx", template)


def test_texts_that_were_numbers_in_formulas_and_cells_of_any_type_become_numbers(tmp_path):
    def edit(data: bytes) -> bytes:
        data = re.sub(rb'<c r="A3"[^>]*><v>(\d+)</v></c>', rb'<c r="A3" t="inlineStr"><is><t>\1</t></is></c>', data)
        data = re.sub(rb'<c r="A4"[^>]*><v>(\d+)</v></c>', rb'<c r="A4" t="str"><f>"\1"</f><v>\1</v></c>', data)
        return re.sub(rb'<c r="B3"[^>]*><v>([^<]*)</v></c>', rb'<c r="B3" t="n"><f>\1+0</f><v>\1</v></c>', data)

    content = template_content(seed=2, derived="absent", length="absent")
    template = write_template(tmp_path, content, f"{SHEETS}2", edit)
    system = read_quietly(template)
    copy = write_quietly(system, tmp_path / "o.xlsx", template)
    assert copy.path.read_bytes() == template.read_bytes()
    other = replace(moved(system), numbers=system.numbers + 1)
    write_quietly(other, tmp_path / "o.xlsx", template)
    assert values_of(tmp_path / "o.xlsx")["Coordinates", "A3"] == system.numbers[0] + 1
    np.testing.assert_array_equal(read_quietly(tmp_path / "o.xlsx").numbers, system.numbers + 1)


def test_the_other_cells_keep_a_shared_formula(tmp_path):
    """x1 = 3, 5 and so on by one shared formula whose first cell, then second, is overwritten."""

    def edit(data: bytes) -> bytes:
        for row in range(3, 7):
            formula = b"<f t='shared' ref='B3:B6' si='0'>100+C3*0.5</f>" if row == 3 else b'<f t="shared" si="0"/>'
            y = float(re.search(rb'<c r="C%d"[^>]*><v>([^<]*)' % row, data)[1])
            new = b'<c r="B%d">%b<v>%b</v></c>' % (row, formula, repr(100 + y * 0.5).encode())
            data = re.sub(rb'<c r="B%d"[^>]*><v>[^<]*</v></c>' % row, new, data)
        return data

    template = write_template(tmp_path, template_content(seed=2), f"{SHEETS}2", edit)
    system = read_quietly(template)
    shifted = with_centers(system, (0, 0), system.centers[0, 0] + 1)
    written = write_quietly(shifted, tmp_path / "o.xlsx", template)
    formulas = values_of(written.path, data_only=False)
    assert [formulas["Coordinates", f"B{row}"] for row in range(4, 7)] == [f"=100+C{row}*0.5" for row in range(4, 7)]
    # And sorted, and removed.
    part = read_quietly(written.path)[[3, 1]]
    write_quietly(part, tmp_path / "p.xlsx", written.path)
    np.testing.assert_allclose(read_quietly(tmp_path / "p.xlsx").centers, part.centers, rtol=1e-12)


def test_cells_of_array_formulas_do_not_change_alone(tmp_path):
    book = template_workbook(TemplateLayout(seed=2, length="absent", derived="absent"))
    book["Coordinates"]["B3"] = ArrayFormula("B3:B4", "=Z3:Z4*1")
    stored = partial(re.sub, rb'(<c r="B3".*?</f>)<v ?/?>(</v>)?', rb"\g<1><v>150.5</v>")
    template = write_template(tmp_path, content_of(book), f"{SHEETS}2", stored)
    system = read_quietly(template)
    with pytest.raises(mph.InputError, match=r"Coordinates!B4 is one cell of the array formula or data table B3:B4"):
        mph.write_system(moved(system), tmp_path / "o.xlsx", template)


def test_the_chain_of_calculation_goes_when_formulas_do(tmp_path):
    content = template_content(seed=2)
    kind = "http://schemas.openxmlformats.org/officeDocument/2006/relationships/calcChain"

    def edit(name: str, data: bytes) -> bytes:
        if name == "[Content_Types].xml":
            chain = b'<Override PartName="/xl/calcChain.xml" ContentType="application/vnd.x.calcChain+xml"/></Types>'
            return data.replace(b"</Types>", chain)
        if name == "xl/_rels/workbook.xml.rels":
            chain = f'<Relationship Id="rIdC" Type="{kind}" Target="calcChain.xml"/></Relationships>'
            return data.replace(b"</Relationships>", chain.encode())
        return data

    out = io.BytesIO(repacked(content, edit))
    with zipfile.ZipFile(out, "a") as archive:
        archive.writestr("xl/calcChain.xml", f'<calcChain xmlns="{SPREADSHEET}"><c r="E3" i="2"/></calcChain>')
    template = tmp_path / "t.xlsx"
    template.write_bytes(out.getvalue())
    system = read_quietly(template)
    kept = write_quietly(moved(system), tmp_path / "kept.xlsx", template)
    before = members_of(template)
    for name in ("xl/calcChain.xml", "[Content_Types].xml", "xl/_rels/workbook.xml.rels"):
        assert members_of(kept.path)[name] == before[name]
    dropped = write_quietly(system[:3], tmp_path / "dropped.xlsx", template)
    after = members_of(dropped.path)
    assert "xl/calcChain.xml" not in after
    assert b"alcChain" not in after["[Content_Types].xml"] + after["xl/_rels/workbook.xml.rels"]
    assert openpyxl.load_workbook(dropped.path)


def test_formulas_stay_through_names_sheets_and_whole_columns(tmp_path):
    template = saved_template(tmp_path / "t.xlsx", seed=8)
    system = moved(read_quietly(template))
    written = write_quietly(system, tmp_path / "o.xlsx", template)
    values, x, y, z = values_of(written.path), *system.centers.T
    assert values["Theta", "A1"] == pytest.approx(x.sum(), rel=1e-12)
    assert values["Theta", "A2"] == pytest.approx(y.mean(), rel=1e-12)
    assert values["Theta", "A4"] == pytest.approx((x**2).sum(), rel=1e-12)
    assert values["Theta", "A5"] == z[1]
    assert values["Theta", "A6"] == 2
    assert values["It's values", "B1"] == pytest.approx(2 * x.sum() + 1, rel=1e-12)
    assert "Coordinates!B3" not in written.changed
    assert values["Theta", "A3"] == 2 * x[0]  # it did not move, but had no value
    beyond = [f"{sheet}{row}" for sheet in ("Theta!A", "It's values!B") for row in (9, 10, 11)]
    assert set(written.cleared) == {*beyond, "It's values!D1"}


def test_formulas_of_tables_store_no_value_if_the_table_changes(tmp_path):
    """References to the columns of Excel's tables, one of the modules and one that has nothing to do with them."""
    content = template_content(n=5, seed=12)
    book = openpyxl.load_workbook(io.BytesIO(content))
    sheet, other = book["Coordinates"], book.create_sheet("Other")
    for column in range(1, sheet.max_column + 1):
        sheet.cell(2, column).value = str(sheet.cell(2, column).value or f"no {column}")
    sheet.add_table(Table(displayName="Pins", ref=f"A2:{sheet.cell(7, sheet.max_column).coordinate}"))
    for row in ("k", "a [b]"), (1, 2), (3, 4):
        other.append(row)
    other.add_table(Table(displayName="Apart", ref="A1:B3"))
    other["D1"], other["D2"], other["D3"] = "=SUM(Apart[a '[b']])", "=SUM(Pins[x1])", "=D2+1"
    stored = partial(re.sub, rb"(<f>(SUM|D2).*?</f>)<v ?(/>|></v>)", rb"\1<v>77</v>")
    template = write_template(tmp_path, content_of(book), SHEETS, stored)
    written = write_quietly(moved(read_quietly(template)), tmp_path / "o.xlsx", template)
    values = values_of(written.path)
    assert values["Other", "D1"] == 77  # as stored before: nothing that it refers to has changed
    assert {"Other!D2", "Other!D3"} <= set(written.cleared)
    assert ("Other", "D2") not in values
    assert values_of(written.path, data_only=False)["Other", "D2"] == "=SUM(Pins[x1])"


# Killed


_LOOP = """
import sys, warnings, numpy as np
import mphdrr.core as mph
warnings.simplefilter("ignore")
path, a, b = sys.argv[1:]
systems = [mph.read_system(a), mph.read_system(b)]
print("ready", flush=True)
i = 0
while True:
    i += 1
    mph.write_system(systems[i % 2], path, path)
"""


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="this system has no SIGKILL")
@pytest.mark.parametrize("times", [1, pytest.param(8, marks=pytest.mark.long)])
def test_killed_at_any_moment_the_old_or_the_new_file_is_whole(times, tmp_path, rng):
    workbook = saved_template(tmp_path / "a.xlsx", seed=6)
    a = read_quietly(workbook)
    b = with_centers(a, (slice(None), 0), a.centers[:, 0] + 0.5)
    write_quietly(b, tmp_path / "b.xlsx", workbook)
    path = tmp_path / "master.xlsx"
    path.write_bytes(workbook.read_bytes())
    package = str(Path(mphdrr.__file__).parents[1]) if mphdrr.__file__ else ""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([package, *sys.path])}
    for _ in range(times):
        process = subprocess.Popen(
            [sys.executable, "-c", _LOOP, str(path), str(workbook), str(tmp_path / "b.xlsx")],
            env=environment,
            stdout=subprocess.PIPE,
        )
        assert process.stdout.readline() == b"ready\n"
        time.sleep(float(rng.uniform(0.02, 1.0)))
        process.kill()
        process.wait()
        process.stdout.close()
        back = read_quietly(path)
        is_a, is_b = (np.array_equal(back.centers, s.centers) for s in (a, b))
        assert is_a or is_b
        assert values_of(path, data_only=False).keys() == values_of(workbook, data_only=False).keys()
    leftovers = [p.name for p in tmp_path.iterdir() if p.name not in ("a.xlsx", "b.xlsx", "master.xlsx")]
    assert all(name.startswith(".") for name in leftovers)
