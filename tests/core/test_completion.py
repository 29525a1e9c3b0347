"""What shells offer after the Tab key, through argcomplete."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

import pytest

pytest.importorskip("argcomplete")

LINES = {
    "mphdrr rec": {"reconstruct"},
    "mphdrr geometry ": {"show", "check", "calibrate"},
    "mphdrr geometry set --cr": {"--crystal-material"},
    "mphdrr project --preset tc99m-tungsten-": {"tc99m-tungsten-czt", "tc99m-tungsten-nai"},
    "mphdrr phantom derenzo --rad": {"--radius"},
    "mphdrr events new --like ": {"derenzo", "cardiac", "mixed", "files"},
    "mphdrr volume info my": {"my\\ volume.nii"},
}


def offered(lines: Iterable[str], folder: Path, code: str = "") -> list[list[str]]:
    """Return the completions of each line that is typed so far; each time Python would end."""
    code = f"""
import os, sys
{code}
from mphdrr.addon.cli import main
def end(status): raise SystemExit(status)
os._exit, sys.argv = end, ["mphdrr"]
for number, line in enumerate({list(lines)}):
    os.environ |= {{"COMP_LINE": line, "COMP_POINT": str(len(line)), "_ARGCOMPLETE_STDOUT_FILENAME": f"answer-{{number}}"}}
    assert main() == 0
"""
    asked = {"_ARGCOMPLETE": "1", "_ARGCOMPLETE_IFS": "\n", "COMP_TYPE": "9"}
    subprocess.run([sys.executable, "-c", code], env=os.environ | asked, cwd=folder, check=True, capture_output=True)
    answers = sorted(folder.glob("answer-*"))
    return [[word.strip() for word in answer.read_text().split("\n") if word] for answer in answers]


def test_commands_options_and_their_words_are_offered(tmp_path: Path):
    (tmp_path / "my volume.nii").touch()
    for (line, expected), words in zip(LINES.items(), offered(LINES, tmp_path), strict=True):
        assert expected <= set(words), line


def test_commands_are_offered_without_what_they_work_with(tmp_path: Path):
    commands, trained = offered(
        ("mphdrr ", "mphdrr learn tr"), tmp_path, "sys.modules['numpy'] = None"
    )  # who imports it fails
    assert {"geometry", "project", "demo"} <= set(commands) and trained == ["train"]
