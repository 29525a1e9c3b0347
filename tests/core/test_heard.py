"""Long work is heard where standard error is no terminal: a line each minute, here each few milliseconds."""

from __future__ import annotations

import re
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from importlib.util import find_spec

import pytest

from mphdrr.core.cli import main, options
from mphdrr.core.progress import tell

from .conftest import FEWER_MODULES
from .small_design import TEXT as DESIGN
from .small_recipes import JUDGE, TRAINING
from .test_calibration import recipe as points  # noqa: F401  # a fixture
from .test_judge import BELIEVED, SHORT_TEST

needs_torch = pytest.mark.skipif(not find_spec("lightning"), reason="the extra learning is not installed")
STEP = r"(no step done|step \d+ of \d+)"
STILL = r"( for \d s)?"
WORDS = "--phantom derenzo --emission --time 60 --voxels 32 --size 32 32"
PROJECT = ["project", str(FEWER_MODULES), *WORDS.split()]


@pytest.fixture
def heard(monkeypatch, capsys) -> Callable[..., list[str]]:
    """Return a function that runs a command with a line each few milliseconds, and returns the lines on standard error."""
    monkeypatch.setattr(options, "INTERVAL", 0.002)

    def run(*words: object) -> list[str]:
        assert main([*map(str, words)]) == 0
        text = capsys.readouterr().err
        assert "\r" not in text and not any(thread.name == "reporting" for thread in threading.enumerate())
        return text.splitlines()

    return run


def has_line(lines: list[str], pattern: str) -> bool:
    return any(re.match(f"mphdrr: {pattern}", line) for line in lines)


@pytest.fixture
def run_file(tmp_path, heard):
    """Write a run of the command `project`, which is heard."""
    assert has_line(heard(*PROJECT, "-o", tmp_path / "run.h5"), f"projecting: {STEP}")
    return tmp_path / "run.h5"


def test_projections_and_reconstructions_say_step_objective_and_time(run_file, tmp_path, heard):
    words = ["reconstruct", run_file, "--voxels", 16, "--spacing", 7, "--iterations", 4, "-o", tmp_path / "v.nii.gz"]
    lines = heard(*words)
    objective = r"log-likelihood -?[\d.e+-]+"
    assert has_line(
        lines, rf"reconstructing: step \d+ of \d+{STILL}, {objective}, [\d.e+]+ (steps/s|s per step), \d+ s left$"
    )
    assert sum(line.startswith("iteration") for line in lines) == 4
    assert heard(*words, "--quiet") == []


def test_events_say_the_size_and_time_left(tmp_path, heard, small_set):
    words = ["events", "make", tmp_path / "set", "--recipe", small_set / "recipe.toml"]
    lines = heard(*words, "-n", 6)
    assert has_line(lines, "making: no step done for 0 s") and has_line(
        lines, rf"making: step \d of 6{STILL}, .*B, \d+ s left$"
    )
    assert heard(*words, "-n", 7, "--quiet") == []


@pytest.mark.long  # other processes take a while to begin
@pytest.mark.parametrize("dask", [[], ["--dask", "local"]], ids=["workers", "dask"])
def test_events_of_other_processes_are_heard(tmp_path, heard, small_set, dask):
    if dask:
        pytest.importorskip("distributed")
    words = ["events", "make", tmp_path / "set", "--recipe", small_set / "recipe.toml", "-n", 4, "--workers", 2]
    assert has_line(heard(*words, *dask), "making: no step done for ")


@needs_torch
def test_a_training_says_step_loss_rate_and_time_left(tmp_path, small_set, heard, monkeypatch):
    from mphdrr.core.learning.networks import NETWORKS

    from .small_learning import TOY, small_training

    monkeypatch.setitem(NETWORKS, "toy", TOY)
    small_training(tmp_path, small_set, TRAINING.replace("steps = 6", "steps = 10"))
    lines = heard("learn", "train", tmp_path / "training.toml", "-o", tmp_path / "m.pt")
    assert has_line(lines, f"preparing: {STEP}")
    assert has_line(lines, rf"training: step \d+ of 10{STILL}, loss [\d.]+, [\d.e+]+ (steps/s|s per step), \d+ s left$")


@needs_torch
def test_the_judge_is_heard(tmp_path, small_set, heard):
    for name, seed in (("rods", 5), ("validation", 6)):
        text = (small_set / "recipe.toml").read_text().replace("seed = 5", f"seed = {seed}")
        (tmp_path / f"{name}.toml").write_text(text.replace("[radon]", BELIEVED.lstrip()))
        options_of_set = ["--recipe", str(tmp_path / f"{name}.toml"), "-n", "2", "--quiet"]
        assert main(["events", "make", str(tmp_path / name), *options_of_set]) == 0
    (tmp_path / "judge.toml").write_text(JUDGE + SHORT_TEST)
    words = ["learn", "judge", tmp_path / "judge.toml", "-o"]
    assert has_line(heard(*words, tmp_path / "judgement"), f"judging: {STEP}")
    assert all(line.startswith("mphdrr: warning: ") for line in heard(*words, tmp_path / "quiet", "--quiet"))


def test_designs_are_heard(tmp_path, heard):
    path = tmp_path / "design.toml"
    path.write_text(DESIGN.replace("coarse_steps = 4", "coarse_steps = 1").replace("starts = 2", "starts = 1"))
    assert has_line(heard("design", "optimize", path, "-o", tmp_path / "new.xlsx"), f"designing: {STEP}")


def test_a_calibration_is_heard(points, tmp_path, heard):  # noqa: F811
    lines = heard("geometry", "calibrate", points[0], "-o", tmp_path / "new.xlsx")
    assert has_line(lines, f"finding spots: {STEP}") and has_line(lines, "finding modules: no step done for 0 s")


def test_a_step_without_an_end_in_sight_is_heard_and_so_is_work_without_steps(monkeypatch, capsys):
    monkeypatch.setattr(options, "INTERVAL", 0.05)
    with options.reporting():
        time.sleep(0.12)
        bar = options.progress_bar("training")
        time.sleep(0.12)
        tell(bar, 3, 10, lambda: "loss 0.5")
        time.sleep(0.12)
        tell(bar, 10, 10)
        time.sleep(0.12)
    lines = capsys.readouterr().err.splitlines()
    expected = [
        "at work for 0 s",
        "training: no step done for 0 s",
        "training: step 3 of 10 for 0 s, loss 0.5",
        "at work for 0 s",
    ]
    assert [line for line in dict.fromkeys(lines) if "step 3 of 10, " not in line] == [
        f"mphdrr: {x}" for x in expected[:3]
    ]
    assert lines[-1] == "mphdrr: at work for 0 s" and 7 <= len(lines) <= 9


def test_of_the_processes_of_a_training_the_first_is_heard(monkeypatch, capsys):
    monkeypatch.setattr(options, "INTERVAL", 0.005)
    for rank in "01":
        monkeypatch.setenv("LOCAL_RANK", rank)
        with options.reporting():
            time.sleep(0.05)
        assert bool(capsys.readouterr().err) == (rank == "0")


def test_rate_and_time_left_are_those_of_the_steps_of_this_call(monkeypatch):
    """A resumed training begins with a step far from the first, and a first step compiles."""
    now = [0.0]
    monkeypatch.setattr(options.time, "monotonic", lambda: now[0])
    bar = options.progress_bar("training")
    for seconds, step in ((500.0, 2001), (510.0, 2021)):
        now[0] = seconds
        tell(bar, step, 4000, lambda: "loss 0.412")
    assert bar.state() == "training: step 2021 of 4000, loss 0.412, 2.0 steps/s, 16 min left"
    now[0] = 750.0
    assert bar.state() == "training: step 2021 of 4000 for 4 min, loss 0.412, 2.0 steps/s, 12 min left"
    slow = options.progress_bar("judging")
    for seconds, step in ((1000.0, 0), (1100.0, 4), (1300.0, 8)):
        now[0] = seconds
        slow(step, 12)
    assert slow.state() == "judging: step 8 of 12, 37.5 s per step, 2 min left"
    slow(1, 12)  # another round
    assert slow.state() == "judging: step 1 of 12"


def test_a_pipe_hears_the_lines_before_the_end(tmp_path):
    """A batch job's log grows while it runs, and ends with its work: no thread keeps the process."""
    code = (
        "import sys; from mphdrr.core.cli import main, options; options.INTERVAL = 0.01; sys.exit(main(sys.argv[1:]))"
    )
    words = [sys.executable, "-c", code, *PROJECT, "-o", str(tmp_path / "run.h5")]
    with subprocess.Popen(words, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True) as job:
        first = job.stderr.readline()
        was_running, rest = job.poll() is None, job.stderr.read()
    assert job.returncode == 0 and was_running and first.startswith("mphdrr: at work for"), first + rest


def test_a_terminal_has_bars_and_no_lines(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(options, "INTERVAL", 0.002)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    assert main([*PROJECT, "-o", str(tmp_path / "run.h5")]) == 0
    text = capsys.readouterr().err
    assert "\rprojecting [###" in text and "at work" not in text and "projecting: step" not in text


def test_a_closed_standard_error_stops_no_work(tmp_path, monkeypatch):
    monkeypatch.setattr(options, "INTERVAL", 0.002)
    with (tmp_path / "err").open("w") as stream:
        monkeypatch.setattr(sys, "stderr", stream)
        with options.reporting():
            stream.close()
            time.sleep(0.02)
