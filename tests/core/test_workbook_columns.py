"""A new typed column of the workbook is one entry in the table of quantities, and a field of `PinholeSystem`."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]

ENTRY = """
    Quantity(
        "Ns", "septa", ("Ns", "number of septa"), "Main!U", role="optional", kind="number", hints="septa",
        plausible=(0, 20), blank=2.0,
    ),
"""
SETTING = """
        object.__setattr__(self, "septa", freeze(one_for_all(self.septa, "septa", n)))
"""
USE = """
import sys, warnings
from pathlib import Path
import numpy as np, openpyxl
import mphdrr.core as mph
from mphdrr.core.errors import InputError

def refusal(use, *arguments, **more):
    try:
        use(*arguments, **more)
    except InputError as error:
        return str(error)

assert Path(mph.__file__).is_relative_to(sys.argv[1])
warnings.simplefilter("error")
system = mph.read_system(sys.argv[2])  # without such a column
assert np.all(system.septa == 2)
system = mph.PinholeSystem(**{**vars(system), "septa": np.arange(80) % 5 + 1})
mph.write_system(system, "new.xlsx")
book = openpyxl.load_workbook("new.xlsx")
assert [book["Main"][f"U{row}"].value for row in range(1, 6)] == ["Ns", "number of septa", 1, 2, 3]
assert np.all(mph.read_system("new.xlsx").septa == system.septa)

(cells,) = [cells for cells in mph.read_system("new.xlsx").source.cells if cells.quantity == "Ns"]
assert (cells.sheet, cells.column, cells.rows[0]) == ("Main", "U", 3)
draft = mph.draft_column_map("new.xlsx")
assert not draft.questions and np.all(mph.read_system("new.xlsx", draft.columns).septa == system.septa)
tables = draft.columns.from_toml(draft.columns.to_toml()).tables
assert "Ns" in [column.quantity for table in tables for column in table.columns]

other = mph.PinholeSystem(**{**vars(system), "septa": np.where(system.numbers == 2, 7, system.septa)})
assert mph.write_system(other, "copy.xlsx", template="new.xlsx").changed == ("Main!U4",)
assert mph.read_system("copy.xlsx").septa[1] == 7
book["Main"]["U4"], book["Main"]["U5"] = None, 0
book.save("blank.xlsx")
blank = mph.read_system("blank.xlsx")
assert blank.septa[:4].tolist() == [1, 2, 0, 4]
assert mph.write_system(blank, "kept.xlsx", template="blank.xlsx").changed == ()

for value, said in (("many", "Main!U4 holds the text 'many', expected Ns of module 2, a number"), (50.0, "Ns = 50, which")):
    book["Main"]["U4"] = value
    book.save("odd.xlsx")
    try:
        mph.read_system("odd.xlsx")
        raise AssertionError("was taken")
    except (InputError, mph.InputWarning) as error:
        assert said in str(error), error
assert "no column headed Ns for the septa of module 1, 1, which is not 2" in refusal(
    mph.write_system, system, "out.xlsx", template=sys.argv[2]
)
book["Main"]["U1"] = book["Main"]["U2"] = "septa"
book["Main"]["U4"] = None
book.save("unclear.xlsx")
assert "which is not understood and may mean Ns" in refusal(mph.read_system, "unclear.xlsx")
"""


@pytest.mark.long
def test_a_typed_column_is_one_entry_and_one_field(workbook, tmp_path):
    package = tmp_path / "mphdrr"
    shutil.copytree(ROOT / "core", package / "core", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "__init__.py", package)
    put(package / "core/workbook/quantities.py", ")\nQUANTITIES = ", ENTRY)
    system = package / "core/geometry/system.py"
    put(system, "    source: SystemSource | None = None\n", "    septa: NDArray[np.float64] = 2.0\n")
    put(system, "        for name in LENGTHS:\n", SETTING)
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    command = [sys.executable, "-c", USE, str(tmp_path), str(workbook)]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def put(path: Path, before: str, text: str) -> None:
    """Put a text into a file, before what is there once."""
    content = path.read_text(encoding="utf-8")
    assert content.count(before) == 1
    path.write_text(content.replace(before, text + before), encoding="utf-8")
