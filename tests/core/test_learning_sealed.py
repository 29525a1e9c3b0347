"""Trainings: what they keep is sealed, what they learn from is known, and nothing that is not finite becomes a model."""

import io
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("lightning", reason="the extra learning is not installed")
import torch

import mphdrr.core as mph
from mphdrr.core.cli import main
from mphdrr.core.events import EventSet
from mphdrr.core.learning import training
from mphdrr.core.learning.data import Source, prepare_samples
from mphdrr.core.learning.judging.sets import events_by_recipe, set_fingerprint
from mphdrr.core.learning.networks import NETWORKS

from .conftest import refused, refused_command, warned
from .small_learning import TOY, Toy, same_weights, small_training

LAST, EARLIER = "last.ckpt", "last-but-one.ckpt"


@pytest.fixture(autouse=True)
def toy(monkeypatch):
    monkeypatch.setitem(NETWORKS, "toy", TOY)


@pytest.fixture(scope="module")
def trained(tmp_path_factory, small_set) -> Path:
    """Make a folder with a set, its samples, a training of six rounds of one step, and its model."""
    folder = tmp_path_factory.mktemp("trained")
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(NETWORKS, "toy", TOY)
        mph.learning.train(small_training(folder, small_set), folder / "m.pt")
    return folder


@pytest.fixture
def folder(trained, tmp_path) -> Path:
    """Return a copy of the training without its model, to damage it."""
    shutil.copytree(trained, tmp_path / "copy", ignore=shutil.ignore_patterns("m.pt", "events.out.*"))
    return tmp_path / "copy"


def train(folder: Path) -> mph.learning.TrainedNetwork:
    return mph.learning.train(mph.learning.read_recipe(folder / "training.toml"), folder / "m.pt")


def stopped_at(folder: Path, step: int, do: Callable[[], object] = lambda: None) -> None:
    """Train until the end of a step, do something, and stop there."""

    def progress(done: int, total: int) -> None:
        if done == step:
            do()
            raise mph.Cancelled

    recipe = mph.learning.read_recipe(folder / "training.toml")
    with pytest.raises(mph.Cancelled):
        mph.learning.train(recipe, folder / "m.pt", stages=lambda name: progress if name == "training" else None)


def flip(path: Path, place: int) -> None:
    """Flip one bit of a file."""
    data = bytearray(path.read_bytes())
    data[place % len(data)] ^= 1 << place % 8
    path.write_bytes(data)


@pytest.mark.parametrize("place", [70, 3001, -1])
def test_a_damaged_checkpoint_is_replaced_by_the_round_before(folder, trained, place):
    whole = mph.learning.read_model(trained / "m.pt")
    flip(folder / "m-training" / LAST, place)
    (said,) = warned(lambda: train(folder))
    assert re.search(r"last\.ckpt: .*; the training goes on from the round before", said)
    assert same_weights(mph.learning.read_model(folder / "m.pt"), whole)
    assert not warned(lambda: train(folder)), "what was damaged has been replaced"


def test_a_checkpoint_that_is_gone_is_replaced_too_and_so_is_a_sample(folder, trained):
    (folder / "m-training" / LAST).unlink()
    next(iter(folder.glob("samples-*/*.pt"))).unlink()
    (said,) = warned(lambda: train(folder))
    assert said.endswith("last.ckpt: missing; the training goes on from the round before")
    assert same_weights(mph.learning.read_model(folder / "m.pt"), mph.learning.read_model(trained / "m.pt"))


def test_damaged_in_both_rounds_or_of_an_earlier_version_a_training_begins_again(folder, trained):
    whole, kept = mph.learning.read_model(trained / "m.pt"), folder / "m-training"
    earlier_version = io.BytesIO()
    torch.save(torch.load(kept / LAST, weights_only=True), earlier_version)
    flip(kept / LAST, 500)
    flip(kept / EARLIER, 500)
    assert [text.partition("; ")[2] for text in warned(lambda: train(folder))] == ["the training begins again"]
    assert same_weights(mph.learning.read_model(folder / "m.pt"), whole)
    (kept / EARLIER).unlink()
    (kept / LAST).write_bytes(earlier_version.getvalue())
    (said,) = warned(lambda: train(folder))
    assert "last.ckpt: no checkpoint of mphDRR, or cut: its seal is missing; the training begins again" in said
    assert same_weights(mph.learning.read_model(folder / "m.pt"), whole)


def test_no_flipped_bit_of_a_checkpoint_is_gone_on_with(folder):
    kept = folder / "m-training"
    data = (kept / LAST).read_bytes()
    path, content = training.last_checkpoint(kept)
    assert path == kept / LAST and content["global_step"] == 6
    for place in np.random.default_rng(1).integers(0, len(data), 200).tolist():
        flip(kept / LAST, place)
        with pytest.warns(mph.InputWarning, match="from the round before"):
            path, content = training.last_checkpoint(kept)
        assert path == kept / EARLIER and content["global_step"] == 5
        (kept / LAST).write_bytes(data)


def test_a_sample_that_fails_its_seal_or_is_anothers_is_made_again(folder):
    source = Source(mph.learning.read_recipe(folder / "training.toml"))
    (samples,) = prepare_samples(source, folder, ["train"])
    right, (first, second, *_) = samples[0], sorted(samples.folder.glob("*.pt"))
    data = first.read_bytes()
    for place in np.random.default_rng(2).integers(0, len(data), 20).tolist():
        flip(first, place)
        (said,) = warned(lambda: samples[0])
        assert first.name in said and said.endswith("; it is made again") and first.read_bytes() == data
    shutil.copy(second, first)
    (said,) = warned(lambda: samples[0])
    assert "of another event" in said and all(torch.equal(a, b) for a, b in zip(samples[0], right, strict=True))
    flip(first, 9)
    (said,) = warned(lambda: train(folder))
    assert first.name in said and not warned(lambda: train(folder))


class Failing(Toy):
    """Network that is not finite at some point."""

    where = ""

    def forward(self, setup, sample):
        found = super().forward(setup, sample)
        if self.where == ("loss" if self.training else "validation"):
            return [estimate * float("inf") for estimate in found]
        return found


@pytest.mark.parametrize("where", ["loss", "weights", "validation", "file"])
def test_what_is_not_finite_becomes_no_model(tmp_path, small_set, monkeypatch, capsys, where):
    monkeypatch.setattr(type(TOY), "load", lambda self: Failing)
    small_training(tmp_path, small_set)
    monkeypatch.setattr(Failing, "where", where)
    command = ["learn", "train", tmp_path / "training.toml", "-o", tmp_path / "m.pt", "--quiet"]
    words = {"loss": "step 1: the loss is", "weights": "step 3: the weights are", "file": "step 6: the result is",
             "validation": "step 1: the validation is"}  # fmt: skip
    if where == "weights":  # a gradient overflows where the loss does not
        step, rates = torch.optim.AdamW.step, []

        def overflowing(self, closure=None):
            result = step(self, closure)
            rates.append(self.param_groups[0]["lr"])
            if len(rates) == 3:
                self.param_groups[0]["params"][0].data[0] = float("nan")
            return result

        monkeypatch.setattr(torch.optim.AdamW, "step", overflowing)
    if where == "file":  # of weights that are finite, what they make is not
        train(tmp_path)
        (tmp_path / "m.pt").unlink()
        monkeypatch.setattr(Failing, "where", "validation")
    said = refused_command(capsys, *command)
    assert words[where] in said and "not finite" in said and "training.rate" in said
    assert not (tmp_path / "m.pt").exists() and not list(tmp_path.glob("m-training/.*-*"))


def test_the_printed_nrmse_is_that_of_the_file(folder, capsys):
    """Computed here from the file and the samples, apart from the training."""
    command = ["learn", "train", str(folder / "training.toml"), "-o", str(folder / "m.pt"), "--quiet"]
    source = Source(mph.learning.read_recipe(folder / "training.toml"))
    (samples,) = prepare_samples(source, folder, ["test"])
    for _ in range(2):  # trained to its end, then complete
        assert main(command) == 0
        network, errors = mph.learning.read_model(folder / "m.pt").network, []
        for sample in (samples[i] for i in range(len(samples))):
            with torch.no_grad():
                volume = network(source.setup, type(sample)(*(values[None] for values in sample)))[-1].numpy()
            truth = sample.truth.numpy().astype(float)
            errors.append(np.sqrt(np.mean((volume - truth) ** 2) / np.mean(truth**2)))
        assert f"NRMSE {np.mean(errors):.3f} of the validation" in capsys.readouterr().out
        curve = mph.learning.read_model(folder / "m.pt").contents.curve
        assert curve[-1]["validation"] == pytest.approx(np.mean(errors), rel=1e-5)


def test_a_set_that_grows_meanwhile_is_learned_from_as_it_was(folder, trained):
    """During the training, and between its parts; what was not begun is learned from the set as it is."""
    shutil.rmtree(folder / "m-training")
    events = EventSet(folder / "set")
    used = events.split("train") + events.split("test")
    stopped_at(folder, 3, lambda: mph.events.make(events.recipe, folder / "set", 12))
    grown = EventSet(folder / "set")
    assert len(grown) == 12
    network = train(folder)
    assert network.contents.trained_on["events"] == events_by_recipe(used)
    assert network.contents.trained_on["set"] == set_fingerprint(used)
    assert same_weights(network, mph.learning.read_model(trained / "m.pt"))
    again = mph.learning.train(mph.learning.read_recipe(folder / "training.toml"), folder / "n.pt")
    assert again.contents.trained_on["events"] == events_by_recipe(grown.split("train") + grown.split("test"))


def test_a_set_that_has_lost_events_since_a_training_began_is_refused(folder):
    (folder / "set" / "events" / "000003.h5").unlink()
    refused(lambda: train(folder), "data.events: the training has begun with events that are gone: 3", "another -o")


def test_two_trainings_in_one_folder_are_refused(folder):
    shutil.rmtree(folder / "m-training")
    said = r"m-training: another process trains here; wait for its end, or choose another -o"
    stopped_at(folder, 2, lambda: refused(lambda: train(folder), said))
    train(folder)


def test_what_killed_processes_left_is_removed(folder):
    left = [folder / name for name in (".0123abcd-m.pt", "m-training/.0123abcd-last.ckpt", ".0123abcd-others.pt")]
    for path in left:
        path.write_bytes(b"half")
    train(folder)
    assert [path.exists() for path in left] == [False, False, True], "only what is the training's own"
