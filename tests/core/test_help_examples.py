"""Every example of every command's help runs, in a folder with small files of the names that it has."""

from __future__ import annotations

import argparse
import contextlib
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.addon.cli import COMMANDS, main
from mphdrr.core.cli import build_parser
from mphdrr.core.design.recipe import TEMPLATE

from .conftest import WORKBOOK
from .dicom_files import write_series
from .small_events import TEXT
from .small_events import WORKBOOK as SMALL_WORKBOOK
from .small_recipes import JUDGE, TRAINING

THORAX = WORKBOOK.parent / "phantoms" / "thorax.toml"


def examples(parser: argparse.ArgumentParser) -> Iterator[str]:
    for line in (parser.epilog or "").splitlines():
        if line.startswith("example: "):
            yield line.removeprefix("example: ")
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for name in dict.fromkeys(action.choices):
                yield from examples(action.choices[name])


ALL = list(dict.fromkeys(examples(build_parser(COMMANDS))))


def run(folder: Path, command: str) -> None:
    words = shlex.split(command)[1:]
    if words[0] == "scene" or words[:2] in (
        [["figure", kind] for kind in ("cut-away", "light-up", "scanner")]
    ):  # Blender
        pytest.importorskip("bpy")
        done = subprocess.run([sys.executable, "-m", "mphdrr", *words], cwd=folder, capture_output=True, text=True)
        assert done.returncode == 0 and "Traceback" not in done.stderr, f"{command}: {done.stderr}"
    else:
        with contextlib.chdir(folder):
            assert main(words) == 0, command


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write small files of the names in the examples."""
    folder = tmp_path_factory.mktemp("examples")
    shutil.copy(WORKBOOK, folder / "scanner.xlsx")
    shutil.copy(THORAX, folder / "thorax.toml")
    grid = mph.Grid.centered((24, 24, 24), 10.0)
    body = np.where(np.indices(grid.shape).min(axis=0) > 4, 500.0, -1000.0).astype(np.float32)
    ct = mph.Volume(body, grid, "hu")
    mph.write_volume(ct, folder / "ct.nii.gz")
    mph.write_volume(mph.Volume(np.where(body > 0, 0.015, 0.0).astype(np.float32), grid, "mu"), folder / "ct-mu.nii.gz")
    write_series(ct, folder / "dicom_folder")
    mph.write_volume(ct, folder / "ct.dcm")
    (folder / "ct.dcm").rename(folder / "ct")
    mph.write_volume(mph.Volume(np.maximum(body, 0), grid, "activity"), folder / "osem.nii.gz")
    for name, radius in (("body", 60.0), ("heart", 20.0)):
        small = mph.Grid.centered((20, 20, 20), radius / 8)
        ball = mph.Volume((np.hypot(*np.indices(small.shape)[:2] - 9.5) < 6).astype(np.float32), small, "mu")
        mph.write_mesh(mph.volume_to_mesh(ball, 0.5), folder / f"{name}.stl")
    np.save(folder / "counts.npy", np.ones((80, 16, 16)))
    np.save(folder / "flood.npy", np.random.default_rng(1).poisson(400.0, (80, 16, 16)))
    (folder / "study.toml").write_text('[reconstruction]\nmethod = "osem"\niterations = 2\n')
    model = TEXT[TEXT.index("[models.emission]") : TEXT.index("[radon]")]
    text = TEXT.replace(str(SMALL_WORKBOOK), str(WORKBOOK))
    text = text.replace("[radon]", model.replace("models.emission", "models.counts") + "[radon]")
    (folder / "derenzo.toml").write_text(
        text.replace('modules = "1-4,21-24"', "").replace("[6, 8]", "[96]\nrows = 14\ncolumns = 16")
    )
    training = TRAINING.replace('"set"\n', '"set"\nmodel = "counts"\n').replace("steps = 6", "steps = 2")
    (folder / "training.toml").write_text(training.replace('"toy"', '"after-osem"\nchannels = [4, 4, 4]'))
    test = '[[tests]]\nname = "rods"\nevents = "set"\nsplit = "train"\ncount = 1\n'
    (folder / "judge.toml").write_text(JUDGE.replace('"validation"', '"set"\nsplit = "test"') + test)
    design = TEMPLATE.read_text().replace("steps = 15", "steps = 1").replace("starts = 3", "starts = 1")
    (folder / "design.toml").write_text(design)
    (folder / "front.toml").write_text(design + '[pareto]\nentry = "objectives.size"\nvalues = [6, 8]\n')
    run(folder, "mphdrr phantom derenzo --voxels 24 --spacing 4 -o heart.nii.gz")
    heart = "mphdrr project scanner.xlsx --volume heart.nii.gz --emission --time 600 --set model.intrinsic_fwhm=2"
    run(folder, f"{heart} --size 24 24 --write-recipe heart.toml")
    run(folder, "mphdrr project heart.toml -o run.h5")
    run(
        folder,
        "mphdrr project scanner.xlsx --counts flood.npy --frames 1-80 --orientation front+v --time 60 -o flood.h5",
    )
    run(folder, "mphdrr events make set --recipe derenzo.toml -n 13")
    system = mph.read_system(WORKBOOK)
    views, model = system.views((32, 32)), mph.Emission(system, time=60.0)
    for k, place in enumerate(np.diag([30.0, 30.0, 30.0])):
        images = np.random.default_rng(k).poisson(mph.point_images(model, views, [place], activity=1e5)[0])
        counts = mph.counts_run(images[:, ::-1, ::-1], system, "1-80", "back-v", 60.0)
        mph.write_run(counts, folder / f"point{k}.h5")
    xray = mph.xray_ring(12, shape=(16, 24))
    mph.write_system(xray, folder / "both.xlsx", WORKBOOK)
    tissue = mph.read_volume(folder / "ct-mu.nii.gz", "mu")
    mph.write_volume(tissue, folder / "mu70.nii.gz")
    seen = {"system.file": str(folder / "both.xlsx"), "system.kind": "x-ray", "model.kind": "transmission"}
    (radiographs,) = mph.run_recipe(mph.Recipe(seen), volume=tissue)
    mph.write_run(radiographs, folder / "radiographs.h5")
    mph.write_volume(
        mph.Volume(np.where(body > 0, 10.0, 0.0).astype(np.float32), grid, "activity"), folder / "spect.nii.gz"
    )
    (folder / "points.toml").write_text('[runs]\nfiles = ["point0.h5", "point1.h5", "point2.h5"]\n')
    return folder


@pytest.mark.long
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("example", [one for one in ALL if not one.startswith("mphdrr demo")])  # that is `make demo`
def test_every_example_runs(example, inputs, tmp_path):
    here = tmp_path / "here"
    shutil.copytree(inputs, here)
    words = example.split()
    if "model.pt" in words:
        pytest.importorskip("lightning", reason="networks need torch and Lightning, which are not installed here")
    # A few events of many (the fiftieth part of 150 has three), and small pictures, runs and volumes.
    example = example.replace("-n 100000 ", "-n 150 ").replace("-n 1000", "-n 6").replace("1600x900", "320x240")
    if words[1:3] in (["figure", "scanner"], ["figure", "cut-away"]):
        example += " --size 320x240 --samples 1"
    elif words[1:3] == ["figure", "light-up"]:
        example = example.replace("--seconds 8 --size 640x400", "--seconds 1 --fps 2 --size 160x120 --samples 1")
    elif words[1:3] == ["project", "scanner.xlsx"] and "--counts" not in words:
        example += " --size 16 16"
    elif "--method model.pt" in example:  # of a scan by the scanner of its training
        run(here, "mphdrr learn train training.toml -o model.pt")
        mph.write_run(mph.events.EventSet(here / "set")[0].run("counts", noise_seed=1), here / "run.h5")
    elif words[1] == "reconstruct":
        example = example.replace("--iterations 20", "--iterations 2") + " --voxels 16 --spacing 6"
    if words[1:3] == ["events", "make"] and "--recipe" in words:
        shutil.rmtree(here / "set")
    if words[1] == "score":  # of a volume that has what is scored
        kind = " ".join(words[3:]) if not words[3].startswith("--") else "derenzo"
        run(here, f"mphdrr phantom {kind.split(' --euler')[0]} --voxels 96 -o volume.nii.gz")
    for option in ("-o", "--output", "--write-recipe"):
        for i, word in enumerate(words[:-1]):
            if word == option and (here / words[i + 1]).is_file():
                (here / words[i + 1]).unlink()
    run(here, example)
    for i, word in enumerate(words[:-1]):
        if word in ("-o", "--output", "--write-recipe", "--picture", "--mosaic"):
            assert (here / words[i + 1]).exists()


def test_every_command_that_does_something_has_an_example():
    assert len(ALL) > 60
