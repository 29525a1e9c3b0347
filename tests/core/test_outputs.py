"""What is written is never what is read: outputs that are inputs are refused before work begins, and leave them whole."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.addon.cli import main
from mphdrr.core import files

from .conftest import FEWER_MODULES as WORKBOOK
from .conftest import refused_command

BOTH, TWICE = "is both an input and an output", "is the name of two outputs"
FLOOD = "expected another file than that of the flood"  # the window says it, too
SMALL = "--voxels 4 --spacing 20"


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """Return a folder with a workbook, a volume, a run of counts, its recipe, a reconstruction's state and a flood."""
    folder = tmp_path_factory.mktemp("made")
    shutil.copy(WORKBOOK, folder / "scanner.xlsx")
    typed(folder, "phantom derenzo --voxels 8 -o volume.npz")
    typed(folder, "phantom derenzo -o shapes.toml")
    model = "--set model.kind=emission --hole point --pixel-points 1 --time 10 --modules 1-4 --size 4 4"
    typed(folder, f"project scanner.xlsx --volume volume.npz {model} -o run.h5")
    typed(folder, f"project scanner.xlsx --volume volume.npz {model} --write-recipe how.toml")
    typed(folder, f"reconstruct run.h5 {SMALL} --iterations 1 --subsets 1 -o o.npz --save-state state.h5")
    np.save(folder / "flood.npy", np.full((4, 4, 4), 100.0))
    return folder


@pytest.fixture
def place(made, tmp_path, monkeypatch) -> Path:
    """Return a copy of that folder, as the current one."""
    folder = tmp_path / "place"
    shutil.copytree(made, folder)
    monkeypatch.chdir(folder)
    return folder


def typed(folder: Path, command: str) -> None:
    """Run a command, in which names with an ending are files of the folder."""
    words = [str(folder / word) if Path(word).suffix.lower() in ENDINGS else word for word in command.split()]
    assert main(words) == 0, command


ENDINGS = (".xlsx", ".npz", ".npy", ".h5", ".toml", ".png", ".pt")

COMMANDS = {
    "backproject run.h5 -o OUT": "run.h5",
    f"backproject run.h5 {SMALL} -o o.npz --views-that-see OUT": "run.h5",
    f"reconstruct run.h5 {SMALL} -o OUT": "run.h5",
    f"reconstruct run.h5 {SMALL} -o o2.npz --save-state OUT": "run.h5",
    f"reconstruct run.h5 {SMALL} -o OUT --start volume.npz": "volume.npz",
    f"reconstruct run.h5 {SMALL} -o o2.npz --resume state.h5 --save-state OUT": "state.h5",
    "reconstruct run.h5 --recipe how.toml --write-recipe OUT": "how.toml",
    "export run.h5 -o OUT": "run.h5",
    "export run.h5 --mosaic OUT": "run.h5",
    "volume convert volume.npz --pad 1 -o OUT": "volume.npz",
    "phantom file shapes.toml -o OUT": "shapes.toml",
    "project run.h5 --noise 1 -o OUT": "run.h5",
    "project how.toml -o OUT": "volume.npz",
    "project how.toml -o new.h5 --mosaic OUT": "scanner.xlsx",
    "project how.toml --noise 1 --write-recipe OUT": "how.toml",
    "project scanner.xlsx --volume volume.npz --size 4 4 -o OUT": "volume.npz",
    "counts flood flood.npy -o OUT": "flood.npy",
    "geometry generate xray-arc --into scanner.xlsx -o OUT": "scanner.xlsx",
}


def hard(target: Path, link: Path) -> Path:
    """Make a second name of a file."""
    os.link(target, link)
    return link


def soft(target: Path, link: Path) -> Path:
    """Make a link to a file."""
    link.symlink_to(target)
    return link


SPELLINGS: dict[str, Callable[[Path], object]] = {
    "same": lambda path: path.name,
    "absolute": lambda path: path,
    "around": lambda path: path.parent / ".." / path.parent.name / path.name,
    "link": lambda path: soft(path, path.with_name(f"link{path.suffix}")),
    "hard link": lambda path: hard(path, path.with_name(f"hard{path.suffix}")),
}


@pytest.mark.parametrize("command", COMMANDS)
def test_outputs_that_are_inputs_are_refused(place, capsys, command):
    source = place / COMMANDS[command]
    before = {path.name: path.read_bytes() for path in place.iterdir()}
    for name, spelled in SPELLINGS.items():
        output = str(spelled(source))
        line = refused_command(capsys, *command.replace("OUT", output).split())
        assert BOTH in line or FLOOD in line, (command, name, line)
        assert {file: (place / file).read_bytes() for file in before} == before, (command, name)
    kept = {*before, f"link{source.suffix}", f"hard{source.suffix}"}
    assert {path.name for path in place.iterdir()} == kept, command


def test_names_beside_the_inputs_are_written(place):
    for command in (
        f"backproject run.h5 {SMALL} -o a.npz",
        "volume convert volume.npz -o b.npz",
        "export run.h5 -o c.npz --mosaic c.png",
        "project run.h5 --noise 1 -o d.h5",
    ):
        assert main(command.split()) == 0, command
        assert main(command.split()) == 0, command  # what the command wrote before is no input


def test_an_output_of_another_letter_case_is_refused_where_case_does_not_matter(place, capsys, monkeypatch):
    exact = os.stat

    def of_any_case(path, **options):
        folder, name = os.path.split(path)
        return exact(os.path.join(folder, name.lower()), **options)

    monkeypatch.setattr(files.os, "stat", of_any_case)
    assert BOTH in refused_command(capsys, "backproject", "run.h5", "-o", "RUN.H5")


def test_states_of_one_project_are_not_replaced_by_its_runs(place, capsys):
    for number in (1, 2):
        shutil.copy("volume.npz", f"state-{number}.npz")
    words = "project scanner.xlsx --states state-1.npz state-2.npz --size 4 4 --modules 1 -o state.npz"
    before = Path("state-2.npz").read_bytes()
    assert "state-1.npz: is both" in refused_command(capsys, *words.split())
    assert Path("state-2.npz").read_bytes() == before


def test_a_workbook_is_changed_in_place_as_documented(place):
    assert main(["geometry", "set", "scanner.xlsx", "--modules", "1", "--diameter", "2", "-o", "scanner.xlsx"]) == 0
    assert mph.read_system("scanner.xlsx").pinhole_diameter[0] == 2


def test_two_outputs_of_one_name_are_refused(place, capsys):
    for command in (
        f"backproject run.h5 {SMALL} -o a.npz --views-that-see ./a.npz",
        f"reconstruct run.h5 {SMALL} -o a.h5 --save-state {place}/a.h5",
        "export run.h5 -o a.npz -o a.npz",
    ):
        assert TWICE in refused_command(capsys, *command.split()), command
        assert not Path("a.npz").exists()


def test_slices_of_a_series_are_not_replaced_but_what_lies_beside_them_is(place, capsys):
    assert main(["volume", "convert", "volume.npz", "-o", "one.dcm"]) == 0
    for _ in range(2):  # the second time a.nii.gz is a file of the same folder
        assert main(["volume", "convert", "one.dcm", "-o", "a.nii.gz"]) == 0
    assert BOTH in refused_command(capsys, *["volume", "convert", "one.dcm", "-o", "one.dcm"])


def test_exports_into_the_set_that_they_read_are_refused(event_set, capsys, tmp_path):
    folder = event_set[0].path.parents[1]
    before = sorted(folder.rglob("*"))
    link = soft(folder, tmp_path / "link")
    for output in (folder, folder / "export", link / "events" / "new"):
        line = refused_command(capsys, "events", "export", folder, "--to", "npz", "-o", output)
        assert "is in the folder of the set" in line
    assert sorted(folder.rglob("*")) == before
