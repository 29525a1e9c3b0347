"""Recipes of trainings, the judge, designs, calibrations and X rays, mutated: refused in one line, or used as a whole."""

from __future__ import annotations

import re
import shutil
import signal
import threading
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.cli import main
from mphdrr.core.errors import Cancelled
from mphdrr.core.files import final_name
from mphdrr.core.recipes.toml import parse_toml

from .mutated_recipes import mutations
from .small_design import BODY, PARTS
from .small_design import TEXT as DESIGN
from .small_recipes import JUDGE, TRAINING

needs_learning = pytest.mark.skipif(find_spec("lightning") is None, reason="the extra learning is not installed")
needs_scipy = pytest.mark.skipif(find_spec("scipy") is None, reason="no scipy")
SECONDS = 60
"""Longest time for a recipe whose work stops where it would begin."""
MORE_DESIGN = """
[constraints]
gap = 0.5
bore = 60
body = [70, 60, 1, 2]
smallest_hole = 1
crystal_area = 9000

[[objectives]]
kind = "regions"
body = ["body.toml"]
parts = "parts.toml"
worst = true

[[objectives]]
kind = "sensitivity"
resolution = 9
points = 5

[pareto]
entry = "objectives.resolution"
values = [8, 9]
x = "resolution"
y = "sensitivity"

[evaluation]
body = "body.toml"
lesion = "parts.toml"
draws = 2
iterations = 1
"""
CALIBRATION = """
[runs]
files = ["point0.h5", "point1.h5", "point2.h5", "point3.h5"]

[system]
file = "scanner.xlsx"

[model]
intrinsic_fwhm = 2.0
crystal_mu = "NaI"
isotope = "Tc-99m"

[sources]
points = [[0, 0, 0], [30, 30, 30], [30, -30, -30], [-30, 30, -30]]
diameter = 0.5

[fit]
collimator_length = true
detector_offset = true

[priors]
position_sd = 3
tilt_sd_degrees = 1.0
distance_sd = 0.1
"""
XRAY = """
[system]
file = "xray.xlsx"
kind = "x-ray"
modules = "1-3"

[volume]
file = "mu.npz"
energy = 60.0

[model]
kind = "spectral"
panel = "counting"
sensor = "CdTe"
sensor_thickness = 1.5
sensor_fwhm = 5.0
intrinsic_fwhm = 0.7
background = 3.0

[detector]
rows = 8
columns = 10

[frames]
bins = [20, 60, 60, 130]

[noise]
seed = 3

[reconstruction]
method = "sirt"
iterations = 1
voxels = 6
spacing = 20.0
"""


class Case(NamedTuple):
    """A kind of recipe, with the commands that use it; the word "R" stands for its file."""

    text: str
    commands: tuple[tuple[str, ...], ...]
    prepare: Callable[[Path], object]
    stop: Callable[[pytest.MonkeyPatch], object]


DISTANCES = "distances = [[1, 2, 51.96], [2, 3, 84.85]]"


def stop_training(patch: pytest.MonkeyPatch) -> None:
    """Let a training stop where it would make its samples, with trainer and network made."""
    from mphdrr.core.learning import recipe, training
    from mphdrr.core.learning.data import Samples
    from mphdrr.core.learning.networks import NETWORKS

    from .small_learning import TOY

    for name in ("toy", "after-osem"):  # the latter is the default, which takes long to make
        patch.setitem(NETWORKS, name, TOY)  # type: ignore[arg-type]
    patch.setattr(recipe, "network_settings", recipe.network_settings.__wrapped__)  # or the toy's outlive this test

    def samples(source: Any, folder: Path, splits: Iterable[str], *_: object) -> list[Any]:
        assert source.size > 0  # refuses what memory cannot hold
        return [Samples(source, folder, source.draws(split)) for split in splits]

    patch.setattr(training, "prepare_samples", samples)
    patch.setattr(training, "_fit", cancelled)


def stop_judge(patch: pytest.MonkeyPatch) -> None:
    from mphdrr.core.learning.judging import judge

    patch.setattr(judge, "tune", cancelled)


def stop_design(patch: pytest.MonkeyPatch) -> None:
    """Let a search stop where it would compute its first loss, with objectives, constraints and model made."""
    from mphdrr.core.design.optimising import _Search

    def stop(search: Any, coarse: int, _: float) -> None:
        recipe = search._recipe
        recipe.wanted(coarse), recipe.constraints, recipe.model(search._start)
        cancelled()

    patch.setattr(_Search, "_loss", stop)
    patch.setattr(_Search, "result", lambda _: None)


def stop_calibration(patch: pytest.MonkeyPatch) -> None:
    """Let a calibration keep the first spots that it finds in the images of all modules, and fit in two steps."""
    from mphdrr.core.design import bundle, calibration

    module, solver = bundle.scipy_module, bundle.scipy_module("optimize").least_squares
    few = SimpleNamespace(least_squares=lambda *values, **options: solver(*values, **{**options, "max_nfev": 2}))
    patch.setattr(bundle, "scipy_module", lambda name: few if name == "optimize" else module(name))
    find, kept = calibration._find_spots, {}

    def found(images: Any, model: Any, spots: Any, points: Any, stages: Any) -> Any:
        if images.shape not in kept:
            kept[images.shape] = find(images, model, spots, points, stages)
        spots, start = kept[images.shape]
        return spots, start if points is None else points

    patch.setattr(calibration, "_find_spots", found)
    patch.setattr(calibration, "_ROUNDS", 2)


def stop_phantom(patch: pytest.MonkeyPatch) -> None:
    """Let a run stop where it would make the default phantom in place of a volume, which takes long."""
    from mphdrr.core.runs import run_recipe

    patch.setattr(run_recipe, "_from_phantom", cancelled)


def cancelled(*_: object) -> None:
    raise Cancelled


def write_points(folder: Path) -> None:
    """Write four runs of points, and the scanner of three modules that saw them."""
    system = mph.read_system(Path(__file__).parent / "data" / "eight-modules.xlsx")[::3]
    mph.write_system(system, folder / "scanner.xlsx")
    system = mph.read_system(folder / "scanner.xlsx")
    views, rng = system.views((16, 16)), np.random.default_rng(1)
    points = parse_toml(CALIBRATION, "")["sources"]["points"]
    expected = mph.point_images(mph.Emission(system, intrinsic_fwhm=2.0), views, points)
    recipe = mph.Recipe({"model.kind": "emission"})
    for n, images in enumerate(rng.poisson(5000 * expected / expected.sum((2, 3), keepdims=True))):
        settings = {"recipe": recipe.tables(), "detector": "virtual", "magnification": 1.0}
        run = mph.ProjectionRun(images.astype(np.float32), system, views, None, unit="counts", settings=settings)
        mph.write_run(run, folder / f"point{n}.h5")


def write_xray(folder: Path) -> None:
    system = mph.xray_ring(
        5, kvp=[120, 80, 120, 80, 120], filters="Al 3", shape=(12, 16), panel_size=(300, 240), mas=0.5
    )
    mph.write_system(system, folder / "xray.xlsx")
    water = mph.ShapePhantom([mph.Cylinder(radius=60, height=120, mu=0.02)], mu_energy=60.0)
    mph.write_volume(water.voxelize(mph.Grid.centered(8, 18.0), quantity="mu"), folder / "mu.npz")


def write_phantoms(folder: Path) -> None:
    (folder / "body.toml").write_text(BODY)
    (folder / "parts.toml").write_text(PARTS)


RODS = '[[tests]]\nname = "rods"\nevents = "set"\nsplit = "test"\nlevels = [1.0, 0.5]\ncount = 1\ndraws = 2\n'
TEST = JUDGE.replace('events = "validation"', 'events = "set"\nsplit = "train"\ncount = 1') + RODS
CALIBRATE = ("geometry", "calibrate", "R", "-o", "new.xlsx")
BY_DISTANCES = re.sub("points = .*", DISTANCES, CALIBRATION)
CASES = {
    "training": Case(TRAINING, (("learn", "train", "R", "-o", "model.pt"),), Path, stop_training),
    "judge": Case(TEST, (("learn", "judge", "R", "-o", "judgement"),), Path, stop_judge),
    "design": Case(
        DESIGN.replace("voxels = 12", "voxels = 6").replace("spacing = 5", "spacing = 10") + MORE_DESIGN,
        (
            ("design", "optimize", "R", "-o", "new.xlsx", "--quiet"),
            ("design", "pareto", "R", "-o", "front.csv", "front.svg", "--quiet"),
        ),
        write_phantoms,
        stop_design,
    ),
    "calibration": Case(CALIBRATION, (CALIBRATE,), write_points, stop_calibration),
    "calibration by distances": Case(BY_DISTANCES, (CALIBRATE,), write_points, stop_calibration),
    "xray": Case(XRAY, (("project", "R", "-o", "run.npz", "--mosaic", "run.png"),), write_xray, stop_phantom),
}


def files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture
def alarm() -> Iterator[None]:
    """Fail what takes too long, where signals can do it."""

    def fail(*_: object) -> None:
        raise AssertionError(f"takes more than {SECONDS} s")

    if not hasattr(signal, "SIGALRM") or threading.current_thread() is not threading.main_thread():
        yield
        return
    old = signal.signal(signal.SIGALRM, fail)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, old)


@pytest.mark.parametrize("count", [40, pytest.param(300, marks=pytest.mark.long)])
@pytest.mark.parametrize("kind", [
    pytest.param("training", marks=needs_learning), pytest.param("judge", marks=needs_learning),
    pytest.param("design", marks=needs_scipy), pytest.param("calibration", marks=needs_scipy),
    pytest.param("calibration by distances", marks=needs_scipy), "xray",
])  # fmt: skip
def test_a_mutated_recipe_is_refused_in_one_line_or_used(kind, count, tmp_path, monkeypatch, capsys, alarm, small_set):
    count //= 2 if kind.startswith("calibration") else 1  # each by points and by distances
    problems, statuses = run_mutations(CASES[kind], count, 1, tmp_path, monkeypatch, capsys, small_set)
    assert not problems, "\n".join(problems)
    assert statuses[1] > count / 2 and statuses.total() == count + 1 and statuses[1] < count


def run_mutations(case, count, seed, tmp_path, monkeypatch, capsys, small_set) -> tuple[list[str], Counter[int]]:
    """Run the commands of mutated recipes, and return what went wrong, and how many ended with each status."""
    case.prepare(tmp_path)
    shutil.copytree(small_set, tmp_path / "set")
    case.stop(monkeypatch)
    monkeypatch.chdir(tmp_path)
    recipe, before = tmp_path / "recipe.toml", files(tmp_path)
    problems, statuses = [], Counter[int]()
    for n, mutation in enumerate(mutations(parse_toml(case.text, ""), case.text, count, seed)):
        recipe.write_bytes(mutation.text)
        command = ["recipe.toml" if word == "R" else word for word in case.commands[n % len(case.commands)]]
        if hasattr(signal, "alarm"):
            signal.alarm(SECONDS)
        try:
            status = main(command)
        except BaseException as error:
            status, trouble = -1, f"{type(error).__name__}: {error}"
        else:
            trouble = ""
        err = capsys.readouterr().err
        errors = [
            line
            for line in err.replace("\r", "\n").splitlines()
            if line.startswith("mphdrr: ") and "warning:" not in line[:20]
        ]
        statuses[status] += 1
        new = {name: data for name, data in files(tmp_path).items() if before.get(name) != data and name != recipe.name}
        if status == 1:
            if len(errors) != 1 or len(errors[0]) > 700 or not errors[0].isprintable():
                trouble = f"said {errors}"
            elif not set(new) <= {"model-training/.lock", "judgement/.lock", "judgement/tuning.json"}:
                trouble = f"left {sorted(new)}"
        elif mutation.has_unknown_key:
            trouble = trouble or f"the unknown key was ignored: status {status}"
        if half := [name for name in new if final_name(Path(name).name)]:
            trouble = f"left {half}"
        if trouble:
            problems.append(f"{n} {mutation.name}: {trouble}")
        for name in new:
            if name not in before:
                (tmp_path / name).unlink()
    return problems, statuses
