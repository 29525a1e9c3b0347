"""Trainings: what they learn from, that they go on as if they had not stopped, and that processes share them."""

import dataclasses
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("lightning", reason="the extra learning is not installed")
import torch

import mphdrr
import mphdrr.core as mph
from mphdrr.core.cli import main
from mphdrr.core.learning import data
from mphdrr.core.learning.data import Source, prepare_samples
from mphdrr.core.learning.networks import NETWORKS
from mphdrr.core.learning.recipe import parse_recipe, template_text
from mphdrr.core.learning.training import nrmse, training_loss

from .conftest import refused, refused_command
from .small_learning import TOY, same_weights, small_training
from .small_recipes import TRAINING


@pytest.fixture
def recipe(monkeypatch, tmp_path, small_set):
    monkeypatch.setitem(NETWORKS, "toy", TOY)
    return small_training(tmp_path, small_set)


def changed(recipe, before: str, after: str):
    assert before in recipe.text
    return parse_recipe(recipe.text.replace(before, after), "training.toml", recipe.folder)


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        ("steps = 6", "steps = 0", "training.steps: expected a whole number of 1 or more, got 0"),
        ("batch = 2", "batch = 3\ndevices = 2", "training.batch: expected a multiple of the 2 processes, got 3"),
        ("batch = 2", "batches = 2", "training.batches: no such setting; expected steps, batch, rate"),
        ('kind = "toy"', 'kind = "toys"', "network.kind 'toys': expected one of after-osem, "),
        ('kind = "toy"', 'kind = "toy"\ndepth = 3', "network.depth: no such setting; expected kind, permuted, weights_from"),
        ('kind = "toy"', 'kind = ["toy"]', "network.kind: expected a text, got ['toy']"),
        ('kind = "toy"', 'kind = "toy"\nkernels = [3, 0]', "network.kernels: expected a whole number of 1 or more, got 0"),
        ("spacing = 12.0", "", "grid.spacing: missing; give the voxel size in mm"),
        ("after = [1, 2]", "after = [2, 1]", "osem.after: expected rising numbers, got [2, 1]"),
        ("version = 1", "version = 2", "version: expected 1, got 2; a newer mphDRR may read it"),
        ("[training]", "[trainings]", "trainings: no such entry; expected version, data, grid, osem, network, training"),
    ],
)  # fmt: skip
def test_a_recipe_that_cannot_be_used_is_refused_in_a_line(recipe, before, after, words):
    refused(lambda: changed(recipe, before, after), f"training.toml: {words}")


_WRONG = {bool: (0, "x"), int: (0, -1, 1.5, "x"), float: (0, -1.0, float("inf"), "x"), str: (3, False)}
"""What a setting of a type is not."""
_MAY_BE_0 = ("network.features", "network.neighbours", "network.permuted", "training.seed")


@pytest.mark.parametrize("kind", ["after-osem", "cameras", "parallel", "unrolled", "channels"])
def test_nonsense_in_any_setting_of_any_network_is_refused_with_its_table_and_name(recipe, kind):
    settings = {**recipe.given, "network.kind": kind}
    rows = dataclasses.replace(recipe, given=settings).rows
    assert len(rows) > 20
    for key, row in rows.items():
        for wrong in _WRONG[row.kind]:
            if key == "grid.center" or (wrong == 0 and key in _MAY_BE_0):
                continue
            nonsense = {**settings, key: wrong if row.sizes is None else [wrong]}
            refused(lambda given=nonsense: dataclasses.replace(recipe, given=given), f"{key}: expected ")


@pytest.mark.parametrize(
    ("kind", "setting", "words"),
    [
        ("cameras", "network.camera_channels = [8, 8]", "network.camera_channels: expected three levels or more"),
        ("parallel", "network.neighbours = 97", "network.neighbours: expected at most the 96 angles, got 97"),
        ("after-osem", 'network.weights_from = "no.pt"', "network.weights_from: .*: no such file"),
        ("toy", "training.rate = 2.0", "training.rate: expected a number above 0 and at most 1, got 2"),
        ("toy", 'training.strategy = "words"', "training: Lightning refuses accelerator, .* strategy"),
        ("toy", "osem.subsets = 9", "osem: subsets: expected at most the 8 views, got 9"),
        ("toy", "grid.spacing = 1e300", "grid: "),
        ("toy", 'data.train = ""', "data: split '': there are test, train"),
        ("toy", 'data.model = ""', "data.model: expected one of the set's models of counts, emission"),
    ],
)  # fmt: skip
def test_what_a_scanner_a_set_or_lightning_does_not_take_is_refused_by_the_command(
    recipe, tmp_path, capsys, kind, setting, words
):
    table, _, line = setting.partition(".")
    others = [text for text in recipe.text.splitlines() if text.partition(" ")[0] != line.partition(" ")[0]]
    text = "\n".join(others).replace(f"[{table}]", f"[{table}]\n{line}").replace('kind = "toy"', f'kind = "{kind}"')
    (tmp_path / "wrong.toml").write_text(text, encoding="utf-8")
    command = ["learn", "train", tmp_path / "wrong.toml", "-o", tmp_path / "m.pt", "--quiet"]
    assert re.search(words, refused_command(capsys, *command))


def test_a_network_takes_the_settings_that_its_class_has(recipe):
    special = changed(recipe, 'kind = "toy"', 'kind = "toy"\nchannels = 3\nkernels = [5, 3]\nleaky = false')
    assert special.network == {"channels": 3, "kernels": (5, 3), "leaky": False}
    assert recipe.network == {}
    assert special.fingerprint != recipe.fingerprint == changed(recipe, "threads = 1", "threads = 2").fingerprint


def test_the_recipe_to_begin_with_is_one_for_each_network(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(NETWORKS, "toy", TOY)
    assert parse_recipe(template_text("toy"))["network.kind"] == "toy"
    path = tmp_path / "new.toml"
    assert main(["learn", "new", "--like", "unrolled", "-o", str(path)]) == 0
    assert 'kind = "unrolled"' in path.read_text(encoding="utf-8")
    capsys.readouterr()
    said = "it exists; choose another name, or remove it first"
    assert refused_command(capsys, "learn", "new", "-o", path).endswith(said)


def test_samples_are_counts_osem_and_the_truth_at_their_level(recipe, tmp_path):
    source = Source(recipe)
    (samples,) = prepare_samples(source, tmp_path, ["train"])
    numbers = source.events.split("train").numbers
    assert samples.draws == [(number, draw) for number in numbers for draw in (0, 1)]
    levels = []
    for i, (number, draw) in enumerate(samples.draws):
        sample, event, level = samples[i], source._by_number[number], (1.0, 0.5)[(number + draw) % 2]
        means = level * event.images("emission")
        assert abs(float(sample.counts.sum()) - means.sum()) < 6 * np.sqrt(means.sum())
        np.testing.assert_allclose(sample.background, 0.25 * level)  # counts that the recipe has in each pixel
        truth = mph.resample(event.truth, recipe.grid, "mean").array
        np.testing.assert_allclose(sample.truth * sample.scale, level * truth, rtol=1e-5, atol=1e-4)
        assert sample.osem.shape == (2, 8, 8, 8)
        assert float(sample.osem[1].square().mean()) == pytest.approx(1, rel=1e-5)
        levels.append(level)
    assert {*levels} == {0.5, 1.0}
    event = source._by_number[numbers[0]]  # whose first draw has the noise of its own seed
    np.testing.assert_array_equal(samples[0].counts, event.images("emission", event.noise_seed, levels[0]))
    assert not torch.equal(samples[0].counts, samples[1].counts)


def test_samples_are_made_once_and_go_on_where_they_were_stopped(recipe, tmp_path, monkeypatch):
    draws, sample = [], Source.sample
    monkeypatch.setattr(Source, "sample", lambda self, draw: draws.append(draw) or sample(self, draw))

    def stop(done: int, total: int) -> None:
        if done == 3:
            raise mph.Cancelled

    with pytest.raises(mph.Cancelled):
        prepare_samples(Source(recipe), tmp_path, ["train"], progress=stop)
    first = len(draws)
    (samples,) = prepare_samples(Source(recipe), tmp_path, ["train"])
    assert first < len(samples) and sorted(draws) == samples.draws
    (again,) = prepare_samples(Source(recipe), tmp_path, ["train"])
    (other,) = prepare_samples(Source(changed(recipe, "after = [1, 2]", "after = [1, 3]")), tmp_path, ["train"])
    assert again.folder == samples.folder != other.folder
    assert len(draws) == 2 * len(samples)
    assert not list(samples.folder.glob(".*"))


def test_events_that_cannot_be_learned_from_and_a_full_disk_are_refused(recipe, tmp_path, monkeypatch):
    for before, after, words in (
        ('events = "set"', 'events = "sets"', "sets"),
        ('train = "train"', 'train = "training"', "split 'training': there are "),
        ('events = "set"', 'events = "set"\nmodel = "lines"', "data.model: expected one of the set's models of counts"),
    ):
        wrong = changed(recipe, before, after)
        refused(lambda wrong=wrong: mph.learning.train(wrong, tmp_path / "m.pt"), words)
    usage = data.shutil.disk_usage(tmp_path)
    monkeypatch.setattr(data.shutil, "disk_usage", lambda _: usage._replace(free=10_000))
    refused(lambda: prepare_samples(Source(recipe), tmp_path, ["train"]), "the samples take ", " KiB, 10 KiB are free")


def test_truth_from_coarse_voxels_is_doubted(recipe, tmp_path):
    recipe = changed(recipe, "spacing = 12.0", "spacing = 8.0")
    with pytest.warns(mph.InputWarning, match="scores look better"):
        prepare_samples(Source(recipe), tmp_path, ["test"])


def test_the_loss_is_the_nrmse_and_a_share_of_those_on_the_way():
    truth = torch.tensor([[[[1.0, 2.0]]], [[[0.0, 1.0]]]])
    assert float(nrmse(truth, truth)) < 1e-5
    assert float(nrmse(torch.zeros_like(truth), truth)) == pytest.approx(1)
    zero, double = torch.zeros(2, 1, 1, 1, 2), 2 * truth[:, None]
    assert float(training_loss([zero, double, truth[:, None]], truth)) == pytest.approx(0.6, abs=1e-5)
    estimate = truth[:, None].clone().requires_grad_()
    training_loss([estimate], truth).backward()
    assert torch.isfinite(estimate.grad).all()


@pytest.mark.long
def test_a_stopped_and_resumed_training_gives_the_same_weights_bit_for_bit(recipe, tmp_path):
    recipe, steps = changed(recipe, "steps = 6", "steps = 60"), []  # three steps a round, a mean of more than one
    stages = lambda words: lambda *done: steps.append((words, done))  # noqa: E731
    whole = mph.learning.train(recipe, tmp_path / "whole.pt", stages=stages)
    assert steps[-1] == ("training", (60, 60))

    def stop_at(step: int):
        def progress(done: int, total: int) -> None:
            if done == step:
                raise mph.Cancelled

        return lambda words: progress if words == "training" else None

    path = tmp_path / "parts.pt"
    for step in (4, 31):
        with pytest.raises(mph.Cancelled):
            mph.learning.train(recipe, path, stages=stop_at(step))
        assert not path.exists()
    parts = mph.learning.train(recipe, path)
    assert same_weights(whole, parts)
    assert same_weights(whole, mph.learning.train(recipe, path))  # there is nothing left to do
    curve, same = ([{**row, "seconds": 0} for row in network.contents.curve] for network in (whole, parts))
    assert curve == same
    assert [(row["step"], row["events"]) for row in curve] == [(n, 2 * n) for n in range(3, 61, 3)]
    assert json.loads((tmp_path / "parts-training" / "curve.json").read_text(encoding="utf-8")) == parts.contents.curve
    assert curve[-1]["train"] < curve[0]["train"]
    other = changed(recipe, "batch = 2", "batch = 2\nseed = 1")
    assert not same_weights(whole, mph.learning.train(other, tmp_path / "seed.pt"))


@pytest.mark.long
def test_a_folder_of_another_training_is_not_gone_on_with(recipe, tmp_path):
    path, other = tmp_path / "m.pt", changed(recipe, "batch = 2", "batch = 1")
    unusable = changed(recipe, "batch = 2", 'batch = 2\nstrategy = "words"')
    with pytest.raises(mph.InputError, match="Lightning refuses"):
        mph.learning.train(unusable, path)
    mph.learning.train(recipe, path)  # nothing was trained there by the other
    words = "last.ckpt: of a training by another recipe: remove its folder"
    refused(lambda: mph.learning.train(other, path), words)


@pytest.mark.long
def test_a_warm_start_takes_the_weights_of_equal_names_and_shapes(recipe, tmp_path):
    first = mph.learning.train(recipe, tmp_path / "first.pt")
    slow = 'kind = "toy"\nweights_from = "first.pt"'
    recipe = changed(changed(recipe, 'kind = "toy"', slow), "batch = 2", "batch = 2\nrate = 1e-9")
    wider = changed(recipe, 'weights_from = "first.pt"', 'weights_from = "first.pt"\nchannels = 5')
    # Of a wider network the last bias alone is of the same shape.
    for second, names in ((recipe, [*first.contents.weights]), (wider, ["last.bias"])):
        begun = mph.learning.train(second, tmp_path / f"{len(names)}.pt")
        for name in names:
            expected = first.contents.weights[name]
            torch.testing.assert_close(begun.contents.weights[name], expected, rtol=0, atol=1e-6)


SCRIPT = """
import sys
from mphdrr.tests.core.small_learning import add_toy

if __name__ == "__main__":
    add_toy()
    from mphdrr.core.cli import main
    raise SystemExit(main(sys.argv[1:]))
"""


def start_training(folder: Path, *changes: str) -> subprocess.Popen:
    """Start a training of the toy, with one text of its recipe changed, as a program that Lightning can start again."""
    (folder / "command.py").write_text(SCRIPT, encoding="utf-8")
    (folder / "changed.toml").write_text(TRAINING.replace(*changes), encoding="utf-8")
    words = ["command.py", "learn", "train", str(folder / "changed.toml"), "-o", str(folder / "m.pt"), "--quiet"]
    environment = {**os.environ, "PYTHONPATH": str(Path(mphdrr.__path__[0]).parent)}
    return subprocess.Popen([sys.executable, *words], cwd=folder, env=environment, stderr=subprocess.PIPE, text=True)


@pytest.mark.long  # each process imports torch
def test_two_processes_have_the_loss_of_one_with_the_same_batch(recipe, tmp_path):
    one = mph.learning.train(recipe, tmp_path / "one.pt")
    running = start_training(tmp_path, "batch = 2", 'batch = 2\ndevices = 2\nstrategy = "ddp"')
    said = running.communicate(timeout=300)[1]
    assert running.returncode == 0, said
    two = mph.learning.read_model(tmp_path / "m.pt")
    for ours, theirs in zip(one.contents.curve, two.contents.curve, strict=True):
        for loss in ("train", "validation"):
            assert ours[loss] == pytest.approx(theirs[loss], abs=1e-4)


@pytest.mark.long  # each process imports torch
@pytest.mark.skipif(os.name == "nt", reason="Windows has no SIGINT for one process")
def test_ctrl_c_keeps_a_checkpoint_and_the_same_command_goes_on(recipe, tmp_path):
    last, before = tmp_path / "m-training" / "last.ckpt", 0
    for _ in range(2):
        running = start_training(tmp_path, "steps = 6", "steps = 4000")
        for _ in range(1200):
            if (last.exists() and last.stat().st_mtime_ns > before) or running.poll() is not None:
                break
            time.sleep(0.1)
        running.send_signal(signal.SIGINT)
        said = running.communicate(timeout=600)[1].splitlines()
        assert running.returncode == 130
        lines = [f"{tmp_path / 'm.pt'}: samples and the last checkpoint are kept; the same command goes on",
                 "cancelled; no file is left half-written"]  # fmt: skip
        assert said == [f"mphdrr: {line}" for line in lines]
        before = last.stat().st_mtime_ns
    assert not (tmp_path / "m.pt").exists()
    steps = [row["step"] for row in json.loads((last.parent / "curve.json").read_text(encoding="utf-8"))]
    assert len(steps) > 1 and steps == list(range(200, 200 * len(steps) + 1, 200))
