"""A second kind of scanner in a workbook: two X-ray sources with panels, on a sheet of their own beside the pinholes."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
import openpyxl
import pytest
from numpy.typing import NDArray

import mphdrr.core as mph
from mphdrr.core.geometry.columns import Column, ColumnTable
from mphdrr.core.geometry.scanner import SCANNERS, Scanner
from mphdrr.core.workbook import draft_column_map, kinds_in, read_scanner

from .workbooks import edited, values_of

pytestmark = pytest.mark.filterwarnings("error")


@pytest.fixture(scope="module")
def xray():
    """Return the class of the toy kind, known while this file's tests run."""
    columns = ColumnTable(
        [
            *(
                Column(f"{axis}s", "sources", i, headings=(f"{axis}s", f"{axis} of source"), place=f"Toy!{'BCD'[i]}")
                for i, axis in enumerate("xyz")
            ),
            Column("D", "distance", headings=("D", "source to panel"), place="Toy!E", plausible=(10, 5000)),
            Column("kV", "voltage", kind="whole", headings=("kV", "tube voltage"), place="Toy!F", blank=80.0),
            Column("anode", "anode", kind="choice", choices=("W", "Mo"), headings=("anode",), place="Toy!G", blank="W"),
            Column(
                "r",
                derived=lambda s: np.linalg.norm(s.sources, axis=1),
                headings=("r", "source to isocentre"),
                place="Toy!H",
                formula="=SQRT(SUMSQ({xs},{ys},{zs}))",
            ),
        ]
    )

    @dataclass(frozen=True, eq=False)
    class XRay(Scanner):
        kind: ClassVar[str] = "toy x-ray"
        sheet: ClassVar[str] = "Toy"
        columns: ClassVar[ColumnTable]

        sources: NDArray[np.float64]
        distance: NDArray[np.float64]
        voltage: NDArray[np.int64] = 80.0
        anode: NDArray[np.str_] = "W"
        numbers: NDArray[np.int64] = None
        source: Any = None
        more: Mapping[str, Any] = field(default_factory=dict)

        def poses(self) -> NDArray[np.float64]:
            poses = np.tile(np.eye(4), (len(self), 1, 1))
            poses[:, :3, 3] = self.sources
            return poses

        def attributes_at(self, poses: NDArray[np.float64]) -> dict[str, Any]:
            return {"sources": poses[:, :3, 3]}

        def views(self, shape: tuple[int, int]) -> mph.Views:
            raise NotImplementedError

    XRay.columns = columns
    yield XRay
    del SCANNERS[XRay.kind]


@pytest.fixture
def two(xray):
    return xray([[300.0, 0, 5], [0, -300.5, 5]], [600.0, 650.0], [80, 120], ["W", "Mo"])


@pytest.fixture
def both(workbook, two, tmp_path):
    """Return the users' workbook with the sheet of the second kind added."""
    written = mph.write_system(two, tmp_path / "both.xlsx", workbook)
    assert {name.partition("!")[0] for name in written.changed} == {"Toy"}
    assert written.recalculated["Toy!H3"] == pytest.approx(np.hypot(300, 5))
    return written.path


def assert_same(back, system) -> None:
    assert type(back) is type(system)
    for name in ("sources", "distance", "voltage", "anode", "numbers"):
        np.testing.assert_array_equal(getattr(back, name), getattr(system, name), err_msg=name)


def test_a_kind_has_a_new_workbook_of_its_own(two, tmp_path):
    path = mph.write_system(two, tmp_path / "new.xlsx").path
    assert kinds_in(path) == (two.kind,)
    assert openpyxl.load_workbook(path).sheetnames == ["Toy"]
    assert_same(read_scanner(path, two.kind), two)
    with pytest.raises(mph.InputError, match="no sheet has a column headed x1"):
        mph.read_system(path)


def test_a_kind_is_added_to_the_pinholes_workbook(both, workbook, two):
    assert kinds_in(both) == ("pinhole", two.kind)
    assert kinds_in(workbook) == ("pinhole",)
    with pytest.raises(mph.InputError, match="has no sheet Toy, which holds a scanner of the kind toy x-ray"):
        read_scanner(workbook, two.kind)
    assert_same(read_scanner(both, two.kind), two)
    np.testing.assert_array_equal(mph.read_system(both).centers, mph.read_system(workbook).centers)
    with zipfile.ZipFile(workbook) as old, zipfile.ZipFile(both) as new:
        changed = {"xl/workbook.xml", "xl/_rels/workbook.xml.rels", "[Content_Types].xml"}
        assert all(old.read(name) == new.read(name) for name in set(old.namelist()) - changed)
    before, after = values_of(workbook), values_of(both)
    assert before == {place: value for place, value in after.items() if place[0] != "Toy"}


def test_each_kind_is_edited_and_leaves_the_other_alone(both, two, tmp_path):
    other = two.replace(distance=np.array([600.0, 700.0]), anode=["W", "W"])
    written = mph.write_system(other, tmp_path / "x.xlsx", both)
    assert written.changed == ("Toy!E4", "Toy!G4")
    assert_same(read_scanner(written.path, two.kind), other)
    before, after = values_of(both, data_only=False), values_of(written.path, data_only=False)
    assert {place for place in before if before[place] != after[place]} == {("Toy", "E4"), ("Toy", "G4")}
    pinholes = mph.read_system(both)
    moved = pinholes[:79]
    back = mph.write_system(moved, tmp_path / "p.xlsx", both)
    assert not any(name.startswith("Toy") for name in (*back.changed, *back.recalculated))
    assert_same(read_scanner(back.path, two.kind), two)
    swapped = mph.write_system(two[[1, 0]], tmp_path / "s.xlsx", both)
    assert_same(read_scanner(swapped.path, two.kind), two[[1, 0]])


@pytest.mark.parametrize(
    ("cell", "value", "message"),
    [
        ("F4", 80.5, "Toy!F4 is 80.5, expected kV of module 2, a whole number"),
        ("G3", "Rh", "Toy!G3 holds the text 'Rh', expected anode of module 1, one of W, Mo"),
        ("E3", -600, "Toy!E3 has D = -600 mm, expected more than 0"),
        ("E1", "D (old)", "Toy!E1 holds 'D (old)' in the heading of D"),
        ("B4", None, "Toy!B4 is blank, expected xs of module 2, a number"),
    ],
)
def test_a_kinds_cells_are_checked_as_the_pinholes_are(cell, value, message, both, two):
    with edited(both) as book:
        book["Toy"][cell] = value
    with pytest.raises(mph.InputError) as refusal:
        read_scanner(both, two.kind)
    assert message in str(refusal.value)


def test_a_kind_has_column_maps(both, two, tmp_path):
    draft = draft_column_map(both, two.kind)
    assert not draft.questions
    assert draft.columns.faults()  # of pinholes
    assert_same(read_scanner(both, two.kind, draft.columns), two)
    system = read_scanner(both, two.kind, draft.columns)
    other = system.replace(voltage=np.array([100, 110]))
    written = mph.write_system(other, tmp_path / "o.xlsx", both)
    assert_same(read_scanner(written.path, two.kind, written.columns), other)


def test_an_unknown_kind_is_refused(workbook):
    with pytest.raises(mph.InputError, match="kind of scanner 'ct': expected one of"):
        read_scanner(workbook, "ct")
