"""What shells offer after the Tab key, through argcomplete."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("argcomplete")

RUN = "import sys; from mphdrr.addon.cli import main; sys.argv = ['mphdrr']; main()"


def offered(line: str, folder: Path, code: str = RUN) -> list[str]:
    """What is offered for a line that is typed so far."""
    answer = folder / "answer"
    asked = {"_ARGCOMPLETE": "1", "_ARGCOMPLETE_IFS": "\n", "_ARGCOMPLETE_STDOUT_FILENAME": str(answer)}
    asked |= {"COMP_LINE": line, "COMP_POINT": str(len(line)), "COMP_TYPE": "9"}
    subprocess.run([sys.executable, "-c", code], env=os.environ | asked, cwd=folder, check=True, capture_output=True)
    return [word.strip() for word in answer.read_text().split("\n") if word]


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("mphdrr rec", {"reconstruct"}),
        ("mphdrr geometry ", {"show", "check", "calibrate"}),
        ("mphdrr geometry set --cr", {"--crystal-material"}),
        ("mphdrr project --preset tc99m-tungsten-", {"tc99m-tungsten-czt", "tc99m-tungsten-nai"}),
        ("mphdrr phantom derenzo --rad", {"--radius"}),
        ("mphdrr events new --like ", {"derenzo", "cardiac", "mixed", "files"}),
        ("mphdrr volume info my", {"my\\ volume.nii"}),
    ],
)
def test_commands_options_and_their_words_are_offered(line: str, expected: set[str], tmp_path: Path):
    (tmp_path / "my volume.nii").touch()
    assert expected <= set(offered(line, tmp_path))


def test_commands_are_offered_without_what_they_work_with(tmp_path: Path):
    code = f"import sys; sys.modules['numpy'] = None; {RUN}"  # whoever imports it fails
    assert {"geometry", "project", "demo"} <= set(offered("mphdrr ", tmp_path, code))
    assert offered("mphdrr learn tr", tmp_path, code) == ["train"]
