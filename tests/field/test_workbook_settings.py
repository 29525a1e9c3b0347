"""Texts with escaped characters, displayed precision, and encrypted workbooks.

https://github.com/exceljs/exceljs/pull/584 and https://github.com/pythonicrubyist/creek/pull/30 (``_x000D_``); ECMA-376
part 1, 18.2.2 and 22.9.2.19.
"""

from __future__ import annotations

import numpy as np
import pytest

import mphdrr.core as mph

from ..core.conftest import refused
from ..core.workbooks import edited, repacked, saved_template, values_of


@pytest.mark.parametrize("column, old", [("C", "x1"), ("D", "y1"), ("E", "z1")])
@pytest.mark.parametrize("text", ["{}_x000D_\n", "{}_x0020_", "_x000d_{}", "{:.1}_x0031_"])
def test_escaped_characters_are_those_characters(tmp_path, column, old, text):
    path = saved_template(tmp_path / "w.xlsx")
    expected = mph.read_system(path)
    with edited(path) as book:
        cells = [cell for sheet in book for row in sheet.iter_rows() for cell in row if cell.value == old]
        for cell in cells:
            cell.value = "ESCAPED"
    path.write_bytes(
        repacked(path.read_bytes(), lambda name, data: data.replace(b"ESCAPED", text.format(old).encode()))
    )
    assert cells
    np.testing.assert_array_equal(mph.read_system(path).centers, expected.centers)
    other = tmp_path / "other.xlsx"
    mph.write_system(expected.replace(centers=1.5 * expected.centers), other, path)
    headings = [value for value in values_of(other).values() if isinstance(value, str) and old[0] in value]
    assert any("_x" in value for value in headings) or "0031" in text, "the heading is as it was"
    np.testing.assert_allclose(mph.read_system(other).centers, 1.5 * expected.centers)


@pytest.mark.parametrize("setting", [b'fullPrecision="0"', b'fullPrecision="false"', b'iterate="1" fullPrecision="0"'])
def test_displayed_precision_is_refused_with_the_setting_to_change(tmp_path, setting):
    path = saved_template(tmp_path / "w.xlsx")
    content = repacked(
        path.read_bytes(),
        lambda name, data: data.replace(b"<calcPr", b"<calcPr " + setting) if "workbook" in name else data,
    )
    assert setting in content or content != path.read_bytes()
    path.write_bytes(content)
    refused(lambda: mph.read_system(path), 'switch off "Set precision as displayed"')


@pytest.mark.parametrize("stream", ["EncryptedPackage", "EncryptionInfo", ""])
def test_an_encrypted_workbook_is_called_that(tmp_path, stream):
    path = tmp_path / "secret.xlsx"
    path.write_bytes(bytes.fromhex("d0cf11e0a1b11ae1") + bytes(600) + stream.encode("utf-16-le"))
    refused(lambda: mph.read_system(path), "protected by a password")
    path.write_bytes(path.read_bytes() + "Workbook".encode("utf-16-le"))
    refused(lambda: mph.read_system(path), "an old Excel .xls file")
