"""What commands do where their output, or the names that they are given, cannot be what they usually are."""

from __future__ import annotations

import argparse
import io
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import mphdrr.core as mph
from mphdrr.addon.cli import COMMANDS, main
from mphdrr.core.cli import build_parser

from .conftest import FEWER_MODULES as WORKBOOK
from .conftest import refused, refused_command, run_python


def parsers(
    parser: argparse.ArgumentParser, words: tuple[str, ...] = ()
) -> Iterator[tuple[tuple[str, ...], argparse.ArgumentParser]]:
    """Yield all commands, with the words that are typed for them."""
    yield words, parser
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for name, below in action.choices.items():
                yield from parsers(below, (*words, name))


ALL = dict(parsers(build_parser(COMMANDS)))
SHORT = [
    ("--version",), ("geometry", "show", str(WORKBOOK)), ("geometry", "show", str(WORKBOOK), "--json"),
    ("geometry", "check", str(WORKBOOK)), ("geometry", "performance", str(WORKBOOK)), ("events", "new"),
]  # fmt: skip


def test_commands_are_listed_with_what_they_say_of_themselves():
    full, quick = (build_parser(COMMANDS, only).format_help() for only in (None, ""))
    assert full == quick


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no /dev/full")
@pytest.mark.parametrize(("buffering", "every"), [(-1, 1), (1, 5)], ids=["in the end", "at once"])
def test_output_that_cannot_be_written_is_one_line_of_every_command(monkeypatch, capsys, buffering, every):
    for command in [(*words, "--help") for words in list(ALL)[::every]] + SHORT[:4] + SHORT[5:]:
        with open("/dev/full", "w", buffering) as full, monkeypatch.context() as patch:
            patch.setattr(sys, "stdout", full)
            status = main(command)
            assert full.closed
        said = capsys.readouterr().err
        assert (status, said) == (1, "mphdrr: output: No space left on device\n"), command


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no /dev/full")
def test_nothing_more_is_said_when_python_ends():
    for unbuffered, words in (("", ["geometry", "show", str(WORKBOOK), "--json"]), ("1", ["events", "new"])):
        said = run_python(
            f"import os, sys; os.dup2(os.open('/dev/full', os.O_WRONLY), 1)\n"
            f"from mphdrr.addon.cli import main; sys.exit(main({words}))",
            {"PYTHONUNBUFFERED": unbuffered},
        )
        assert (said.returncode, said.stderr) == (1, "mphdrr: output: No space left on device\n")


def test_terminals_of_ascii_show_every_command(monkeypatch):
    for command in [(*words, "--help") for words in ALL] + SHORT:
        streams = [io.TextIOWrapper(io.BytesIO(), encoding="ascii") for _ in range(2)]
        with monkeypatch.context() as patch:
            patch.setattr(sys, "stdout", streams[0])
            patch.setattr(sys, "stderr", streams[1])
            status = main(command)
        out, err = (stream.buffer.getvalue() for stream in streams)
        assert status in (0, 2) and out and b"Traceback" not in err, command


def test_errors_with_names_beyond_ascii_are_one_line(tmp_path):
    said = run_python(
        "import sys; from mphdrr.addon.cli import main; sys.exit(main(['phantom', 'derenzo', '-o', 'µ/°….txt']))",
        {"PYTHONIOENCODING": "ascii", "LANG": "C", "PYTHONUTF8": "0"},
        cwd=tmp_path,
    )
    assert said.returncode == 1 and said.stderr.startswith("mphdrr: ?/??.txt: expected a name ending in")
    assert said.stderr.count("\n") == 1


WRITING = [
    "geometry set WORKBOOK --modules 1 --diameter 2 -o NAME/a.xlsx",
    "geometry generate ellipse --semi-axes 273 220.5 --z 0 -o NAME/a.xlsx",
    "geometry export WORKBOOK -o NAME/scanner.xml --detector real",
    "geometry export WORKBOOK --format gate9 -o NAME",
    "geometry map WORKBOOK --voxels 4 --modules 1 -o NAME/a.nii.gz",
    "phantom derenzo --voxels 4 -o NAME/a.nii.gz",
    "phantom derenzo -o NAME.toml",
    "volume convert VOLUME -o NAME/a.nrrd",
    "project WORKBOOK --phantom derenzo --voxels 4 --size 2 2 -o NAME/run.h5",
    "project WORKBOOK --phantom derenzo --write-recipe NAME/a.toml",
    "export RUN -o NAME/a.npz",
    "export RUN --mosaic NAME/a.png",
    "reconstruct RUN --method sirt -o NAME/a.nii.gz",
    "backproject RUN -o NAME/a.nii.gz",
    "events new -o NAME/a.toml",
    "events make NAME --recipe RECIPE -n 1",
    "events show SET -o NAME/a.png",
    "events export SET --to npz -o NAME",
    "demo --output NAME --voxels 4 --size 4",
]


@pytest.fixture
def typed(event_set, tmp_path, monkeypatch):
    """Return a function that types a command with this name for `NAME`, in an empty folder."""
    beside = tmp_path / "beside"
    assert main(["phantom", "derenzo", "--voxels", "4", "-o", str(beside / "volume.nii.gz")]) == 0
    words = f"--phantom derenzo --voxels 4 --size 2 2 --modules 1 -o {beside / 'run.h5'}".split()
    assert main(["project", str(WORKBOOK), *words]) == 0
    folder = event_set[0].path.parents[1]
    places = {
        "WORKBOOK": WORKBOOK, "VOLUME": beside / "volume.nii.gz", "RUN": beside / "run.h5", "SET": folder,
        "RECIPE": folder.parent / "small.toml",
    }  # fmt: skip
    here = tmp_path / "here"
    here.mkdir()
    monkeypatch.chdir(here)
    return lambda command, name: [
        str(places.get(word, "" if "NAME" in word and not name else word.replace("NAME", name)))
        for word in command.split()
    ]


@pytest.mark.parametrize(("length", "commands"), [(256, WRITING), (5000, WRITING[::6])], ids=["name", "path"])
def test_names_that_are_too_long_are_one_line_of_every_command_that_writes(typed, capsys, length, commands):
    capsys.readouterr()
    for command in commands:
        assert main(typed(command, "x" * length)) == 1, command
        said = capsys.readouterr().err
        assert said.count("\n") == 1 and said.startswith("mphdrr: ") and "File name too long" in said, (command, said)
        assert not list(Path().iterdir())


def test_a_name_that_is_empty_is_never_the_current_folder(typed, event_set, capsys):
    capsys.readouterr()
    for command in [*WRITING, "events status NAME", "events check NAME --repair", "events show NAME", "export NAME"]:
        status = main(typed(command, ""))
        said = capsys.readouterr().err
        assert status in (1, 2) and said.count("\n") == 1, (command, said)
        assert not list(Path().iterdir())
    for call in (
        lambda: mph.events.make(event_set.recipe, "", 1),
        lambda: mph.events.EventSet(""),
        lambda: mph.events.export_events(event_set, "", "npz"),
        lambda: mph.events.status(""),
    ):
        refused(call, "the name of a folder", "empty")
    assert not list(Path().iterdir())


@pytest.mark.skipif(os.name == "nt", reason="a shell of POSIX closes the streams")
@pytest.mark.parametrize("words", ["--help", f"geometry show {WORKBOOK}", "phantom derenzo --voxels 4 -o a.npz"])
def test_closed_streams_are_an_error_of_one_line_before_work_begins(tmp_path, words):
    program = f"'{sys.executable}' -m mphdrr {words}"
    said = subprocess.run(f"{program} >&-", shell=True, capture_output=True, text=True, cwd=tmp_path)
    assert said.returncode == 1 and said.stderr.startswith("mphdrr: output: it is closed"), said.stderr
    assert said.stderr.count("\n") == 1 and not list(tmp_path.iterdir())
    said = subprocess.run(f"{program} -x 2>&-", shell=True, capture_output=True, text=True, cwd=tmp_path)
    assert said.returncode in (0, 2) and "Traceback" not in said.stdout and "unrecognized" not in said.stdout


def test_outputs_that_are_given_twice_are_refused(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for command, option in (
        ("phantom derenzo --voxels 4 -o a.npz -o b.npz", "-o/--output"),
        ("phantom derenzo --voxels 4 -o a.npz --output a.npz", "-o/--output"),
        ("design pareto front.toml -o a.csv -o a.png", "-o/--output"),
        ("reconstruct run.h5 -o a.npz -o b.npz", "-o/--output"),
    ):
        assert main(command.split()) == 2, command
        said = capsys.readouterr().err
        assert f"argument {option}: it is given twice" in said and said.count("\n") == 1, said
        assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "content",
    [
        '"{}" = 3', '[model]\nkind = "{}"', "[model]\nkind = ['{}']", '"{}" = {{x = 1}}', '[system]\nfile = "{}"',
        '[model]\ntime = "{}"',
    ],
)  # fmt: skip
@pytest.mark.parametrize("text", ["Q" * 300, "Q" * 100_000, "Q Q" * 5000], ids=["long", "longer", "words"])
def test_errors_show_little_of_a_file(tmp_path, capsys, content, text):
    path = tmp_path / "a.toml"
    path.write_text(content.format(text))
    line = refused_command(capsys, "project", path, "-o", tmp_path / "run.h5")
    assert 1 <= line.count("Q") <= 200


def test_control_characters_of_files_are_escaped(tmp_path, capsys):
    path = tmp_path / "a.toml"
    path.write_text(r'"a\u001b[2J\r\nb\u202ec\u0007" = 3')
    line = refused_command(capsys, "project", path, "-o", tmp_path / "run.h5")
    assert r"a\x1b[2J\r\nb\u202ec\x07: expected one of the tables" in line and line.isprintable()


def test_empty_and_foreign_files_are_no_recipes(tmp_path, capsys, typed):
    (tmp_path / "empty.toml").touch()
    (tmp_path / "comment.toml").write_text("# nothing\n")
    (tmp_path / "foreign.toml").write_text("[tool.ruff]\nline-length = 128\n")
    (tmp_path / "bytes.toml").write_bytes(bytes(range(256)))
    for name in ("empty", "comment", "foreign", "bytes"):
        path = tmp_path / f"{name}.toml"
        words = typed(f"reconstruct RUN --method sirt --iterations 1 --recipe {path} -o a.npz", "")
        line = refused_command(capsys, *words)
        assert line.startswith(f"{path}: ") and "expected" in line and not Path("a.npz").exists()
