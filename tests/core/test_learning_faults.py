"""Trainings and judgements that are killed, or whose disk is full: the next call ends as if nothing had been."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("lightning", reason="the extra learning is not installed")

import mphdrr
import mphdrr.core as mph
from mphdrr.core.cli import main
from mphdrr.core.learning.networks import NETWORKS

from .small_events import TEXT, small_recipe
from .small_learning import TOY, same_weights, small_training
from .small_recipes import JUDGE

JUDGED = f"""
{JUDGE.replace("voxels = 12", "voxels = 8").replace("spacing = 8.0", "spacing = 12.0").replace('"validation"', '"set"')}
[models]
net = "m.pt"
[[tests]]
name = "others"
events = "others"
levels = [1.0]
"""


@pytest.fixture(scope="module")
def trained(tmp_path_factory, small_set) -> Path:
    """Make a folder with a set, another one, a training, its model, and a judgement of it."""
    folder = tmp_path_factory.mktemp("trained")
    others = TEXT.replace("seed = 5", "seed = 6").replace("odds = 0.5", "odds = 0")
    mph.events.make(small_recipe(folder / "recipe", others), folder / "others", 2)
    (folder / "judge.toml").write_text(JUDGED, encoding="utf-8")
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(NETWORKS, "toy", TOY)
        mph.learning.train(small_training(folder, small_set), folder / "m.pt")
        assert main(judging(folder)) == 0
    return folder


def training(folder: Path, model: str = "m.pt") -> list[str]:
    return ["learn", "train", str(folder / "training.toml"), "-o", str(folder / model), "--quiet"]


def judging(folder: Path) -> list[str]:
    return ["learn", "judge", str(folder / "judge.toml"), "-o", str(folder / "judgement"), "--quiet"]


def scores(folder: Path) -> list[dict[str, Any]]:
    """Return the rows of a judgement without what differs from run to run: what it cost, and intervals of that."""
    rows = json.loads((folder / "judgement" / "judgement.json").read_text(encoding="utf-8"))["rows"]
    return [{name: row[name] for name in ("test", "method", "level", "nrmse", "fingerprint")} for row in rows]


def half_written(folder: Path) -> list[Path]:
    return [path for path in folder.rglob(".*") if path.name != ".lock"]


def copies(trained: Path, folder: Path, count: int, *without: str) -> list[Path]:
    """Return copies of the folder."""
    ignore = shutil.ignore_patterns("events.out.*", *without)
    return [Path(shutil.copytree(trained, folder / str(i), ignore=ignore)) for i in range(count)]


TRAINED = "m.pt", "m-training", "samples-*", "judgement"
"""What a training and a judgement make."""


def check(folder: Path, trained: Path, command: Any) -> None:
    """Check that a folder holds what a command makes undisturbed, and nothing that is half-written."""
    assert not half_written(folder), half_written(folder)
    if command is training:
        assert same_weights(mph.learning.read_model(folder / "m.pt"), mph.learning.read_model(trained / "m.pt"))
    else:
        assert scores(folder) == scores(trained)


class Killed(BaseException):
    """End of a process that can tidy nothing up."""


def killed_beside_renaming(monkeypatch, moment: int, words: list[str]) -> bool:
    """Run a command as a process that is killed just before (even) or after (odd) the renaming number moment // 2.

    Returns False if it ends before. What it leaves has the number of a process that is no more.
    """
    replace, moments = os.replace, iter(range(0, 1000, 2))

    def killing(source: Any, target: Any) -> None:
        number = next(moments)
        if number != moment:
            replace(source, target)
        elif Path(source).name.startswith("."):  # it is left, by a process of a number that no process has
            name = Path(source).name
            replace(source, Path(source).with_name(f"{name[:5]}{999_999_999:08x}{name[13:]}"))
        if number in (moment, moment - 1):
            raise Killed

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", killing)
        try:
            main(words)
        except Killed:
            return True
    return False


def killed_and_resumed(monkeypatch, trained: Path, folder: Path, moments: Iterable[int], command, *without: str) -> int:
    """Kill a command at each of the moments until it ends before, and resume it; return how often that was."""
    monkeypatch.setitem(NETWORKS, "toy", TOY)
    for count, moment in enumerate(moments):
        (place,) = copies(trained, folder / str(moment), 1, *without)
        if not killed_beside_renaming(monkeypatch, moment, command(place)):
            return count
        assert main(command(place)) == 0
        check(place, trained, command)
        shutil.rmtree(place)
    return count + 1


def test_a_training_killed_beside_a_renaming_goes_on_bit_for_bit(monkeypatch, trained, tmp_path):
    """Between two checkpoints."""
    assert killed_and_resumed(monkeypatch, trained, tmp_path, [36], training, *TRAINED) == 1


@pytest.mark.long
@pytest.mark.parametrize(("command", "moments"), [(training, 8), (judging, 2)])
def test_killed_beside_any_renaming_a_work_goes_on(monkeypatch, trained, tmp_path, command, moments):
    """Beside every ninth of a training's 64 and a judgement's 16."""
    without = TRAINED if command is training else ("judgement",)
    count = killed_and_resumed(monkeypatch, trained, tmp_path, range(0, 200, 9), command, *without)
    assert count == moments


@pytest.mark.long
@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")
@pytest.mark.parametrize("command", [training, judging])
def test_killed_at_random_moments_a_work_goes_on(trained, tmp_path, command):
    """By the system, in processes of their own."""
    first, *places = copies(trained, tmp_path, 5, *(TRAINED if command is training else ["judgement"]))
    steps = [(command(first), None)]
    for place, moment in zip(places, np.random.default_rng(7).uniform(0.1, 1, 4).tolist(), strict=True):
        steps += [(command(place), moment), (command(place), None)]
    environment = {**os.environ, "PYTHONPATH": str(Path(mphdrr.__path__[0]).parent), "OMP_NUM_THREADS": "1"}
    words = [sys.executable, str(Path(__file__).with_name("killing.py")), json.dumps(steps)]
    done = subprocess.run(words, capture_output=True, text=True, env=environment, timeout=1500)
    assert done.returncode == 0 and "Traceback" not in done.stderr, done.stderr
    statuses = json.loads(done.stdout.splitlines()[-1])
    assert {statuses[0], *statuses[2::2]} == {0} and statuses[1::2].count(-9) > 1, statuses
    for place in places:
        check(place, trained, command)


@pytest.fixture
def disk(tmp_path) -> Iterator[Path]:
    """Yield a disk of 1.5 MiB; where there may be none, skip."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=1536k", "tmpfs", str(disk)]
    if sys.platform != "linux" or os.geteuid() or subprocess.run(mount, capture_output=True).returncode:
        pytest.skip("no right to mount a small disk")
    yield disk
    subprocess.run(["umount", str(disk)], check=True)


def leave(disk: Path, room: int) -> Path:
    """Fill a disk but for some bytes, and return the file that does so."""
    ballast = disk / "ballast"
    ballast.unlink(missing_ok=True)
    with ballast.open("wb") as file:
        file.write(bytes(shutil.disk_usage(disk).free - room))
    return ballast


def refusal(disk: Path, room: int, words: list[str], capfd: pytest.CaptureFixture[str]) -> str:
    """Run a command on a disk with so much room, bytes; return its refusal, or nothing if it ends well."""
    ballast = leave(disk, room)
    capfd.readouterr()
    status = main(words)
    ballast.unlink()
    if not status:
        return ""
    (line,) = [text for text in capfd.readouterr().err.splitlines() if "warning" not in text]
    assert status == 1 and not half_written(disk), (line, half_written(disk))
    return line.replace(str(disk), "")


@pytest.mark.filterwarnings("error::pytest.PytestUnhandledThreadExceptionWarning")
@pytest.mark.parametrize(
    ("command", "kept"),
    [(training, "samples-*"), (training, "nothing"), pytest.param(judging, "nothing", marks=pytest.mark.long)],
    ids=["steps", "samples", "judging"],
)
def test_a_full_disk_is_one_line_and_the_next_call_goes_on(trained, disk, monkeypatch, capfd, command, kept):
    """With ever more room, until there is enough."""
    monkeypatch.setitem(NETWORKS, "toy", TOY)
    for path in trained.iterdir():
        if path.is_file() or path.name in ("set", "others", "recipe"):
            (disk.parent / path.name).symlink_to(path)
    for path in trained.glob(kept):
        shutil.copytree(path, disk / path.name)
    words = command(disk.parent)
    words[words.index("-o") + 1] = str(disk / ("m.pt" if command is training else "judgement"))
    refusals = []
    while said := refusal(disk, 4096 * len(refusals) * (1 if kept != "nothing" else 8), words, capfd):
        assert "(No space left on device)" in said or "are free" in said, said
        refusals.append(said)
    assert len(refusals) > 1
    check(disk, trained, command)
