"""What docs/tutorial.md says, step by step, in the window; `make tutorial` takes its pictures anew."""

import contextlib
import io
import json
import re
from pathlib import Path

SCRIPT = Path(__file__).with_name("window_tutorial.py")
PAGE = Path(__file__).resolve().parents[2] / "docs" / "tutorial.md"


def test_tutorial(blender_window, work_folder, monkeypatch):
    blender_window(SCRIPT.read_text(encoding="utf-8"), work_folder)
    said = json.loads((work_folder / "said.json").read_text())
    assert said.pop("ok", False), said
    sections = re.split(r"^## ", PAGE.read_text(encoding="utf-8"), flags=re.MULTILINE)
    texts = {picture: text for text in sections for picture in re.findall(r"images/tutorial/(\w+)\.webp", text)}
    assert list(said) == list(texts), "a step for each picture"
    missing = {name: [words for words in said[name] if words not in " ".join(texts[name].split())] for name in said}
    assert not any(missing.values()), f"what was seen is not what the page says: {missing}"

    code, printed = re.findall(r"```(?:python|text)\n(.*?)```", "".join(sections), flags=re.DOTALL)
    monkeypatch.chdir(work_folder)
    with contextlib.redirect_stdout(io.StringIO()) as output:
        exec(code, {})
    assert output.getvalue() == printed
