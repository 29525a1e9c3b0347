"""Columns in Blender: column maps, which the scene keeps for writing back, and columns that are added to the table."""

from __future__ import annotations

import dataclasses
import functools
import json
import re
from pathlib import Path

import bpy
import numpy as np
import openpyxl
import pytest

from mphdrr.addon import registration
from mphdrr.addon.scanner import column_maps, scanner
from mphdrr.core.errors import InputError
from mphdrr.core.geometry.columns import LENGTH_UNITS, Column
from mphdrr.core.geometry.system import PinholeSystem
from mphdrr.core.workbook import ColumnMap, draft_column_map, read_system

from .conftest import Drawn, assert_same, refused, reopened, update

CM = {"x1": "Mitte x (Zentimeter)", "y1": "Mitte y (Zentimeter)", "z1": "Mitte z (Zentimeter)"}


@pytest.fixture
def unread(small_workbook, tmp_path) -> Path:
    """Write the small workbook with its coordinates in cm under headings that the reader does not know."""
    book = openpyxl.load_workbook(small_workbook, data_only=True)
    sheet = book["Coordinates"]
    for column in range(sheet.max_column, 4, -1):
        if column != 7:
            sheet.delete_cols(column)  # columns that follow from the others
    sheet["E1"], sheet["E2"] = "l", None
    for column, text in enumerate(CM.values(), start=2):
        sheet.cell(1, column, text)
        sheet.cell(2, column).value = None
        for row in range(3, 19):
            sheet.cell(row, column).value /= 10
    path = tmp_path / "own.xlsx"
    book.save(path)
    return path


@pytest.fixture
def small(small_workbook) -> PinholeSystem:
    return read_system(small_workbook)


@pytest.fixture
def columns(unread) -> ColumnMap:
    """Return the column map that a person would give."""
    return ColumnMap.from_toml(
        """
        [[tables]]
        sheet = "Coordinates"
        header_row = 1
        first_row = 3
        last_row = 18
        number = "A"
        columns.x1 = { column = "B", unit = "cm" }
        columns.y1 = { column = "C", unit = "cm" }
        columns.z1 = { column = "D", unit = "cm" }
        columns.l = { column = "E", unit = "mm" }
        [[tables]]
        sheet = "Main"
        header_row = 1
        first_row = 3
        last_row = 18
        rows = "by number"
        number = "A"
        columns.d = { column = "P", unit = "mm" }
        columns.R = { column = "Q", unit = "mm" }
        columns.Ld = { column = "S", unit = "mm" }
        columns.Td = { column = "T", unit = "mm" }
        """
    )


@pytest.fixture
def form():
    return bpy.context.window_manager.mphdrr_columns


def quantity(form, name):
    return next(quantity for quantity in form.quantities if quantity.name == name)


assert_equal = functools.partial(assert_same, tolerance=1e-9)


# The settings


def test_the_draft_of_an_understood_workbook_needs_no_more(form, workbook):
    assert not column_maps.fill(form, workbook)
    assert form.refusal == "" and json.loads(form.doubts) == []
    assert column_maps.column_map(form) == draft_column_map(workbook).columns
    assert_equal(read_system(workbook, column_maps.accept(form)), read_system(workbook))


def test_settings_say_what_the_map_says(form, unread, columns):
    pinholes, dimensions = columns.tables
    one = dataclasses.replace(dimensions, first_row=9, last_row=9, rows="one for all", number=None)
    odd = ColumnMap((dataclasses.replace(pinholes, skip_rows=(5, 9, 10), header_row=None), one))
    for column_map in (columns, odd):
        assert column_maps.fill(form, unread, column_map)
        assert column_maps.column_map(form) == column_map
        assert form.refusal == "" and json.loads(form.preview)[0][0] == "Module"


def test_what_is_missing_is_asked_for_and_then_read(form, unread, small):
    """From the draft to the scanner, step by step as a user."""
    assert column_maps.fill(form, unread)
    assert any("x1" in doubt for doubt in json.loads(form.doubts))
    assert form.refusal and form.preview == ""
    with pytest.raises(InputError, match="column map: "):
        column_maps.accept(form)
    for name, column in zip(CM, "BCD", strict=True):
        quantity(form, name).table, quantity(form, name).column = 1, column
    form.n_tables = 2
    first, second = form.tables
    first.sheet, first.first_row, first.last_row, first.number, first.header_row = "Coordinates", 3, 18, "a", 1
    second.sheet, second.first_row, second.last_row, second.number = "Main", 3, 18, "A"
    second.rows = "BY_NUMBER"
    for name, column in zip(("d", "R", "Ld", "Td"), "PQST", strict=True):
        quantity(form, name).table, quantity(form, name).column = 2, column
    quantity(form, "l").table, quantity(form, "l").column = 1, "E"
    form.unit = "mm"
    for name in CM:
        quantity(form, name).unit = "cm"
    assert form.refusal == ""
    assert form.n_modules == 16
    assert quantity(form, "x1").seen == f"{CM['x1']}: 27.7002"
    heads, *rows = json.loads(form.preview)
    assert [row[0] for row in rows] == ["1", "2", "3", "...", "16"]
    assert float(rows[0][heads.index("x1")]) == pytest.approx(small.centers[0, 0], abs=1e-3)
    assert float(rows[-1][heads.index("l")]) == pytest.approx(small.collimator_length[-1], abs=1e-3)
    assert_equal(read_system(unread, column_maps.accept(form)), small)


def test_every_unit_can_be_chosen_for_all_lengths(form, small_workbook):
    column_maps.fill(form, small_workbook)
    for unit in LENGTH_UNITS:
        form.unit = unit
        units = {c.quantity: c.unit for table in column_maps.column_map(form).tables for c in table.columns}
        assert units.pop("azimuth") == units.pop("elevation") == "rad"
        assert set(units.values()) == {unit}


def test_a_setting_that_cannot_be_is_refused_at_once_and_can_be_taken_back(form, unread, columns):
    column_maps.fill(form, unread, columns)
    x1, (first, second) = quantity(form, "x1"), form.tables
    for group, name, value, expected in (
        (x1, "unit", "NONE", "table 1.x1: unit ''"),
        (x1, "column", "", "has no column x1"),
        (x1, "column", "C", "column C is table 1.x1 too"),
        (x1, "table", 3, "x1 is in table 3, expected 1 to 2"),
        (first, "sheet", "Haupt", "has no sheet Haupt.*Main, Coordinates"),
        (first, "last_row", 19, "Coordinates!A19 is blank"),
        (first, "skip_rows", "forty", "table 1: skip rows 'forty', expected numbers"),
        (first, "skip_rows", "90", "skip_rows has 90"),
        (second, "rows", "IN_ORDER", ""),
        (second, "number", "", "by number' without number"),
    ):
        before = getattr(group, name)
        setattr(group, name, value)
        assert bool(form.refusal) == bool(expected)
        assert bool(form.preview) != bool(expected)
        assert re.search(expected, form.refusal), form.refusal
        setattr(group, name, before)
        assert form.refusal == "" and form.preview


def test_a_wrong_unit_is_warned_of_beside_the_numbers(form, unread, columns):
    column_maps.fill(form, unread, columns)
    assert json.loads(form.remarks) == []
    for name in CM:
        quantity(form, name).unit = "m"
    assert form.preview and any("b = " in remark for remark in json.loads(form.remarks))


def test_a_map_is_saved_once_and_never_over_a_file(form, unread, columns):
    column_maps.fill(form, unread, columns)
    form.save_as = "map.toml"
    assert column_maps.accept(form) == columns
    assert ColumnMap.read(unread.with_name("map.toml")) == columns
    with pytest.raises(InputError, match=r"map\.toml: exists already"):
        column_maps.accept(form)
    form.save_as = "map.txt"
    with pytest.raises(InputError, match=r"ending in \.toml"):
        column_maps.accept(form)


def test_settings_are_emptied(form, unread, columns):
    empty = column_maps.column_map(form)
    column_maps.fill(form, unread, columns)
    column_maps.clear(form)
    assert column_maps.column_map(form) == empty == ColumnMap(())
    assert (form.workbook, form.preview, form.unit) == ("", "", "NONE")


# The import


@pytest.fixture
def map_file(tmp_path, columns) -> Path:
    columns.write(tmp_path / "map.toml")
    return tmp_path / "map.toml"


def test_a_refused_workbook_names_the_way_and_a_map_reads_it(scene, unread, map_file, columns, small):
    """Also when it is repeated by Adjust Last Operation, which runs the operator with the properties that it had."""
    for words, arguments in (
        (r"a column map can say what is meant \(columns='map\.toml'", {}),
        (r"set columns to a column map \(\.toml\) instead", {"choose_columns": True}),  # no dialog without a window
        (r"none\.toml: no such file", {"columns": str(map_file.with_name("none.toml"))}),
    ):
        refused(bpy.ops.mphdrr.import_geometry, words, filepath=str(unread), **arguments)
    assert scanner.scanners(scene) == []
    for arguments in ({"columns": str(map_file)}, {"choose_columns": True, "chosen_columns": columns.to_toml()}):
        assert bpy.ops.mphdrr.import_geometry(filepath=str(unread), replace=True, **arguments) == {"FINISHED"}
        collection = scanner.active_scanner(scene)
        assert_equal(scanner.read_scanner(collection), small)
        assert scanner.read_scanner(collection).source.columns == columns


# Writing back


@pytest.fixture
def collection(scene, unread, map_file):
    bpy.ops.mphdrr.import_geometry(filepath=str(unread), columns=str(map_file))
    return scanner.active_scanner(scene)


def test_an_unchanged_scanner_writes_the_same_file(collection, unread, tmp_path):
    assert bpy.ops.mphdrr.export_geometry(filepath=str(tmp_path / "same.xlsx")) == {"FINISHED"}
    assert (tmp_path / "same.xlsx").read_bytes() == unread.read_bytes()


@pytest.mark.parametrize("saved", [False, True])
def test_a_changed_scanner_is_written_by_its_map_in_the_files_unit(saved, collection, scene, tmp_path):
    if saved:
        collection = scanner.active_scanner(reopened(tmp_path / "scene.blend"))
    scanner.module(collection, 7).location.x += 3.0
    scanner.module(collection, 9).mphdrr_module.pinhole_diameter = 2.5
    path = tmp_path / "edited.xlsx"
    assert bpy.ops.mphdrr.export_geometry(filepath=str(path)) == {"FINISHED"}
    own = scanner.source(collection).columns
    written = read_system(path, own)
    assert_equal(written, scanner.read_scanner(collection))
    sheet = openpyxl.load_workbook(path)["Coordinates"]
    assert sheet["B9"].value == pytest.approx(written.centers[6, 0] / 10, rel=1e-12)
    assert sheet["B1"].value == CM["x1"]

    # And again, now that the scene's workbook is the one written.
    scanner.module(collection, 9).mphdrr_module.pinhole_diameter = 2.6
    assert bpy.ops.mphdrr.export_geometry(filepath=str(path)) == {"FINISHED"}
    assert read_system(path, scanner.source(collection).columns).pinhole_diameter[8] == pytest.approx(2.6, rel=1e-6)


def test_the_scene_keeps_the_map_of_the_rows_that_are_written(collection, tmp_path):
    bpy.data.objects.remove(scanner.module(collection, 16))
    bpy.data.objects.remove(scanner.module(collection, 10))
    path = tmp_path / "fewer.xlsx"
    assert bpy.ops.mphdrr.export_geometry(filepath=str(path)) == {"FINISHED"}
    own = scanner.source(collection).columns
    assert [(t.first_row, t.last_row, t.skip_rows) for t in own.tables] == [(3, 17, (12,))] * 2
    assert_equal(read_system(path, own), scanner.read_scanner(collection))


def test_a_new_workbook_needs_no_map(collection, tmp_path):
    path = tmp_path / "new.xlsx"
    bpy.ops.mphdrr.export_geometry(filepath=str(path), use_template=False)
    assert scanner.source(collection).columns is None
    assert_equal(read_system(path), scanner.read_scanner(collection))


ADDED = (
    Column("shim", "shim_thickness", help="shim under the crystal", blank=0.1, plausible=(0.01, 5)),
    Column("coat", "hole_coating", kind="choice", choices=("none", "gold"), blank="none", help="coating of the hole"),
    Column("batch", "crystal_batch", kind="text", blank="", help="batch of the crystal"),
)


@pytest.fixture
def typed(scene, ring_system, monkeypatch):
    """Yield a scanner whose table has three more columns, one of each module's own values."""
    registration.unregister()
    monkeypatch.setattr(PinholeSystem, "columns", PinholeSystem.columns.with_columns(*ADDED))
    registration.register()
    system = ring_system.replace(
        shim_thickness=np.linspace(0.1, 0.2, 8) / 3, crystal_batch=[f"B {n}" for n in range(8)], hole_coating="gold"
    )
    made = scanner.build_scanner(scene, system)
    update()
    yield made
    registration.unregister()
    monkeypatch.undo()
    registration.register()
    assert "shim_thickness" not in bpy.types.Object.bl_rna.properties["mphdrr_module"].fixed_type.properties


def test_they_are_properties_with_their_limits_and_words(typed):
    properties = scanner.module(typed, 1).mphdrr_module.bl_rna.properties
    shim, coat, batch = (properties[name] for name in ("shim_thickness", "hole_coating", "crystal_batch"))
    assert (shim.type, shim.name, shim.soft_max) == ("FLOAT", "Shim Thickness", 5.0) and "in mm" in shim.description
    assert coat.type == "ENUM" and [item.identifier for item in coat.enum_items] == ["none", "gold"]
    assert batch.type == "STRING" and "batch of the crystal" in batch.description


def test_they_are_drawn(typed):
    module = scanner.module(typed, 1).mphdrr_module
    for all_at_once, owner in ((False, module), (True, typed.mphdrr_scanner)):
        bpy.context.scene.mphdrr_geometry.all_at_once = all_at_once
        owners = Drawn("MPHDRR_PT_design").properties
        for name in ("shim_thickness", "hole_coating", "crystal_batch", "crystal_material", "pinhole_diameter"):
            assert owners[name] == owner, name


def test_they_are_read_exactly_edited_and_kept(typed, tmp_path):
    expected = np.linspace(0.1, 0.2, 8) / 3
    read = scanner.read_scanner(typed)
    assert np.array_equal(read.shim_thickness, expected) and read.hole_coating.tolist() == ["gold"] * 8
    module = scanner.module(typed, 3).mphdrr_module
    module.shim_thickness, module.hole_coating, module.crystal_batch = 0.7, "none", "Ü 7"
    module.crystal_material = "CsI"
    expected[2] = 0.7
    opened = scanner.active_scanner(reopened(tmp_path / "columns.blend"))
    read = scanner.read_scanner(opened)
    assert np.array_equal(read.shim_thickness, expected)
    assert read.hole_coating.tolist() == ["gold"] * 2 + ["none"] + ["gold"] * 5
    assert read.crystal_batch[2] == "Ü 7" and read.crystal_batch[3] == "B 3"
    assert read.crystal_material.tolist() == ["", "", "CsI", *[""] * 5]
    assert scanner.losses(opened) == ["module 3 with changed numbers"]
    assert "hole_coating" in opened.mphdrr_scanner.mixed.split()
    opened.mphdrr_scanner.crystal_batch = "all"
    assert scanner.read_scanner(opened).crystal_batch.tolist() == ["all"] * 8
    scanner.module(opened, 5).mphdrr_module.shim_thickness = 0.0
    assert "shim_thickness must be more than 0" in scanner.module(opened, 5).mphdrr_module.problem
    with pytest.raises(InputError, match="module 5"):
        scanner.read_scanner(opened)
