"""Model files: sealed, without code, and refused where they do not fit; networks as methods of reconstruction."""

import io
import json
import os
import pickle
import time
import zipfile
from dataclasses import replace
from pathlib import Path

import nibabel
import numpy as np
import pytest

pytest.importorskip("lightning", reason="the extra learning is not installed")
import torch

import mphdrr.core as mph
from mphdrr.core.cli import main
from mphdrr.core.events import EventSet
from mphdrr.core.learning import model_file
from mphdrr.core.learning.judging.sets import events_by_recipe, truths_of
from mphdrr.core.learning.model_file import read_model, write_model
from mphdrr.core.learning.networks import NETWORKS
from mphdrr.core.learning.seals import seal
from mphdrr.core.reconstruction.methods import method_of
from mphdrr.core.reconstruction.snapshots import Snapshots

from .conftest import refused, refused_command, run_python
from .small_events import TEXT, small_recipe
from .small_learning import TOY, small_training
from .small_recipes import JUDGE


@pytest.fixture(scope="module")
def folder(tmp_path_factory, small_set) -> Path:
    """Make a trained model and the events it was trained on."""
    folder = tmp_path_factory.mktemp("learned")
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(NETWORKS, "toy", TOY)
        mph.learning.train(small_training(folder, small_set), folder / "model.pt")
    return folder


@pytest.fixture
def model(folder, monkeypatch):
    monkeypatch.setitem(NETWORKS, "toy", TOY)
    return mph.learning.read_model(folder / "model.pt")


@pytest.fixture
def run(folder) -> mph.ProjectionRun:
    return EventSet(folder / "set")[0].run("emission", noise_seed=3)


def with_fewer_modules(run: mph.ProjectionRun) -> mph.ProjectionRun:
    """Return a run of another scanner: the last two modules are left out."""
    which = np.arange(len(run.system) - 2)
    return replace(run, projections=run.projections[which], system=run.system[which], views=run.views[which])


class Harmful:
    """Object that makes a folder when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


def test_every_changed_byte_is_refused(folder, model, tmp_path):
    data, path = (folder / "model.pt").read_bytes(), tmp_path / "m.pt"
    places = np.random.default_rng(0).integers(0, len(data), 200).tolist()
    said = r"m\.pt: (damaged: its bytes are not those|no model file of mphDRR, or cut)"
    for place in [*places, *range(len(data) - 110, len(data))]:
        path.write_bytes(data[:place] + bytes([data[place] ^ 1 << place % 8]) + data[place + 1 :])
        with pytest.raises(mph.InputError, match=said):
            read_model(path)
    for size in (0, 10, len(data) // 2, len(data) - 1):
        path.write_bytes(data[:size])
        refused(lambda: read_model(path), "m.pt: no model file of mphDRR, or cut: its seal is missing")
    path.write_bytes(data + b" ")
    refused(lambda: read_model(path))


def saved(content: object) -> bytes:
    """Return the bytes of what torch saves."""
    memory = io.BytesIO()
    torch.save(content, memory)
    return memory.getvalue()


def test_a_pickled_object_is_refused_and_not_run(folder, model, tmp_path):
    harm, path = Harmful(tmp_path / "harm"), tmp_path / "m.pt"
    for content in (harm, {**torch.load(folder / "model.pt", weights_only=True), "about": harm}):
        path.write_bytes(saved(content))
        refused(lambda: read_model(path), "its seal is missing")
        path.write_bytes(seal(saved(content)))  # by one who knows how
        refused(lambda: read_model(path), "it holds more than numbers and texts, nothing of which was run")
    path.write_bytes(pickle.dumps(harm))
    refused(lambda: read_model(path))
    assert not (tmp_path / "harm").exists()


def test_other_formats_are_refused_in_a_line(folder, model, tmp_path):
    path = tmp_path / "m.pt"
    for key, value, words in (
        ("version", 2, "format 2; this mphDRR reads 1, a newer one may read it"),
        ("format", "another", "no model file of mphDRR"),
        ("about", "{}", "cannot be read as a model file"),
        ("about", "[1]", "cannot be read as a model file"),
    ):
        path.write_bytes(seal(saved({**torch.load(folder / "model.pt", weights_only=True), key: value})))
        refused(lambda: read_model(path), words)


def test_weights_of_another_network_are_refused(model, tmp_path):
    weights = {**model.contents.weights, "more.weight": torch.zeros(3)}
    write_model(replace(model.contents, weights=weights), tmp_path / "m.pt")
    unusable = read_model(tmp_path / "m.pt")
    refused(lambda: unusable.network, "cannot be read as weights of this version's network")


def test_a_file_holds_what_the_network_was_trained_on_and_is_a_zip_for_torch(folder, model):
    contents, events = model.contents, EventSet(folder / "set")
    used = events.split("train") + events.split("test")
    assert contents.trained_on["events"] == events_by_recipe(used)
    assert {*contents.trained_on["truths"]} == {*truths_of(used)}
    assert contents.trained_on["levels"] == [1.0, 0.5] and contents.trained_on["model"] == "emission"
    assert contents.recipe == (folder / "training.toml").read_text(encoding="utf-8")
    assert contents.curve[-1]["step"] == 6 and {"mphdrr", "torch"} <= contents.versions.keys()
    assert contents.counts[0] < contents.counts[1]
    assert zipfile.ZipFile(folder / "model.pt").comment.startswith(b"mphDRR sha256 ")
    assert torch.load(folder / "model.pt", weights_only=True)["weights"].keys() == contents.weights.keys()


def test_a_judgement_is_kept_without_a_change_of_what_the_network_does(folder, model, tmp_path):
    (tmp_path / "m.pt").write_bytes((folder / "model.pt").read_bytes())
    judged = mph.learning.with_judgement(tmp_path / "m.pt", {"rows": [{"nrmse": 0.5}]})
    assert judged.contents.judgement == {"rows": [{"nrmse": 0.5}]} and model.contents.judgement is None
    assert judged.sha256 != model.sha256 and judged.fingerprint == model.fingerprint
    assert mph.learning.read_model(tmp_path / "m.pt").contents.judgement == judged.contents.judgement


@pytest.mark.long
def test_networks_of_one_setup_share_osems_volumes_and_say_the_seconds_that_it_saved(model, run, tmp_path, monkeypatch):
    monkeypatch.setattr(model_file, "_SETUPS", {})
    weights = {name: 2 * values for name, values in model.contents.weights.items()}
    write_model(replace(model.contents, weights=weights), tmp_path / "double.pt")
    calls, osem = [], Snapshots.__call__
    monkeypatch.setattr(Snapshots, "__call__", lambda *arguments: calls.append(arguments) or osem(*arguments))
    first, second = model.judged("first"), read_model(tmp_path / "double.pt").judged("second")
    begun = time.perf_counter()
    one = first.function(run)
    spent = time.perf_counter() - begun
    assert first.saved() == 0
    other = second.function(run)
    assert len(calls) == 1 and 0 < second.saved() < spent
    second.function(replace(run, projections=2 * run.projections))
    assert len(calls) == 2 and second.saved() == 0
    model_file._SETUPS.clear()  # nothing is shared
    np.testing.assert_array_equal(second.function(run).array, other.array)
    assert len(calls) == 3 and second.saved() == 0 and not np.array_equal(one.array, other.array)


@pytest.mark.filterwarnings("ignore::mphdrr.core.errors.InputWarning")
def test_the_network_is_what_was_trained(folder, model, run):
    volume = model(run)
    assert volume.grid == model.contents.grid == method_of(str(model.path)).grid and volume.quantity == "activity"
    truth = mph.resample(EventSet(folder / "set")[0].truth, volume.grid, "mean")
    assert mph.nrmse(volume, truth) < 1
    # Twice the counts, twice the activity.
    double = replace(run, projections=2 * run.projections, background=2 * run.background)
    assert np.corrcoef(model(double).array.ravel(), volume.array.ravel())[0, 1] > 0.99


def test_another_scanner_grid_or_physics_is_refused_or_allowed_by_name(folder, model, run):
    method = {"reconstruction.method": str(folder / "model.pt")}
    other, other_grid = with_fewer_modules(run), run.recipe.updated({**method, "reconstruction.spacing": 11.0})
    physics = {"model.intrinsic_fwhm": 3.0, "model.time": 50.0, "model.background": 0.5}
    blurred = run.recipe.updated({**method, **physics})
    for call, words in (
        (lambda: model(other), f"{folder / 'model.pt'}: trained for another scanner; --allow scanner takes it anyway"),
        (lambda: mph.reconstruct_run(run, other_grid), "trained for another grid; --allow grid takes it anyway"),
        (lambda: mph.reconstruct_run(run, blurred), "trained for another physics; --allow physics takes it anyway"),
        (lambda: model(run, allow=("time",)), "expected one of scanner, grid, physics, got 'time'"),
    ):
        refused(call, words)
    with pytest.warns(mph.InputWarning, match=r"model\.pt was trained for another scanner, which was allowed"):
        assert model(other, allow=("scanner",)).grid == model.contents.grid
    allowed = other_grid.updated({"reconstruction.allow": ("grid",), "reconstruction.voxels": 10})
    with pytest.warns(mph.InputWarning):
        result = mph.reconstruct_run(run, allowed)
    assert result.volume.array.shape == (10, 10, 10) and result.settings["allow"] == ["grid"]
    assert "model.pt was trained for another grid, which was allowed" in result.settings["flatters"]


def test_another_time_is_no_other_physics_but_far_fewer_counts_are_said(model, run):
    short = run.recipe.updated({"model.time": 10.0, "model.background": 0.025})
    settings = {**run.settings, "recipe": short.tables()}
    few = replace(run, projections=np.floor(run.projections / 10), background=run.background / 10, settings=settings)
    with pytest.warns(mph.InputWarning, match=r"model\.pt was trained on .* counts, this scan has "):
        model(few)


def test_the_command_line_reconstructs_with_a_model_and_says_so(folder, model, run, tmp_path, capsys):
    mph.write_run(run, tmp_path / "run.npz")
    command = [tmp_path / "run.npz", "--method", folder / "model.pt"]
    more = ["-o", tmp_path / "v.nii.gz", "--picture", tmp_path / "p.svg", "--save-state", tmp_path / "s.h5"]
    assert main(["reconstruct", *map(str, [*command, *more])]) == 0
    out = capsys.readouterr()
    assert "Network model.pt (Toy), 8 x 8 x 8 voxels of 12 mm, largest " in out.out
    assert ">Network model.pt (Toy)" in (tmp_path / "p.svg").read_text(encoding="utf-8")
    np.testing.assert_allclose(mph.read_volume(tmp_path / "v.nii.gz").array, model(run).array, rtol=1e-6)
    note = f"Reconstructed by a network model.pt (Toy), sha256 {model.sha256}"
    assert nibabel.load(tmp_path / "v.nii.gz").header.extensions[0].text == model(run).note == note
    settings = mph.read_reconstruction(tmp_path / "s.h5").settings
    assert settings["sha256"] == model.sha256 and settings["network"] == "toy" and settings["allow"] == []
    assert settings["method"] == "Network model.pt (Toy)"
    other_grid = f"{folder / 'model.pt'}: trained for another grid; --allow grid takes it anyway"
    for words, said in (
        ([*command, "--voxels", "12"], other_grid),
        ([*command, "--subsets", "2"], "Network model.pt (Toy) does not take it"),
        ([command[0], "--allow", "grid"], "reconstruction.allow (--allow) needs reconstruction.method = FILE.pt"),
        ([command[0], "--method", "none.pt"], "none.pt: no such file"),
    ):
        assert said in refused_command(capsys, "reconstruct", *words, "-o", tmp_path / "no.nii")
    assert not (tmp_path / "no.nii").exists()


@pytest.mark.filterwarnings("error::mphdrr.core.errors.InputWarning")
def test_a_model_is_judged_under_a_name_without_warnings(model, run):
    method = model.judged("toy")
    assert method.name == "toy" and method.trained_on == model.contents.trained_on["events"]
    assert method.truths == model.contents.trained_on["truths"]
    before = {name: value for name, value in model.contents.trained_on.items() if name != "truths"}
    assert replace(model, contents=replace(model.contents, trained_on=before)).judged("old").truths == ()
    assert method.function(with_fewer_modules(run)).grid == model.contents.grid


def test_other_holes_are_another_scanner(folder, model, run, monkeypatch):
    """They change no view, and no setting of the physics."""
    monkeypatch.setattr(model_file, "_SETUPS", {})
    wider = replace(run, system=run.system.replace(pinhole_diameter=1.5 * run.system.pinhole_diameter))
    refused(lambda: model(wider), "trained for another scanner; --allow scanner takes it anyway")
    with pytest.warns(mph.InputWarning, match="trained for another scanner"):
        _, after = (model(scan, allow=("scanner",)) for scan in (run, wider))
        model_file._SETUPS.clear()
        alone = model(wider, allow=("scanner",))
    np.testing.assert_array_equal(after.array, alone.array)


def test_operators_are_kept_for_the_next_scan_by_the_same_scanner(folder, model, monkeypatch):
    monkeypatch.setattr(model_file, "_SETUPS", {})
    runs = [event.run("emission", noise_seed=1) for event in EventSet(folder / "set")[:3]]
    network = mph.learning.read_model(folder / "model.pt")
    for run in runs:
        network(run)
    assert len(model_file._SETUPS) == 1


def test_permuted_poses_are_those_of_the_training(folder, model, run, tmp_path):
    text = model.contents.recipe.replace('kind = "toy"', 'kind = "toy"\npermuted = 3')
    (tmp_path / "p.toml").write_text(text.replace('"set"', json.dumps(str(folder / "set"))), encoding="utf-8")
    permuted = mph.learning.train(mph.learning.read_recipe(tmp_path / "p.toml"), tmp_path / "p.pt")
    assert permuted.contents.scanner != model.contents.scanner
    assert permuted(run).grid == model.contents.grid


def test_without_torch_a_model_is_refused_in_a_line_and_core_does_not_need_it():
    done = run_python("""
import sys
sys.modules["torch"] = None
import mphdrr.core as mph
from mphdrr.core.cli import main
try:
    mph.learning.read_model("m.pt")
except mph.InputError as error:
    print(error)
print(main(["learn", "train", "r.toml", "-o", "out/m.pt"]), file=sys.stderr)
""")
    assert done.returncode == 0
    assert done.stdout.splitlines()[0] == 'torch is missing: pip install "mphdrr[learning]"'


OWN_JUDGE = f"""
{JUDGE.replace("voxels = 12", "voxels = 8").replace("spacing = 8.0", "spacing = 12.0")}
[models]
net = "net.pt"
[[tests]]
name = "others"
events = "others"
levels = [1.0, 0.5]
""".replace('"validation"', '"set"\nsplit = "test"')


def test_a_model_is_judged_by_the_command_beside_baselines_and_may_keep_its_rows(folder, model, tmp_path, capsys):
    (tmp_path / "net.pt").write_bytes((folder / "model.pt").read_bytes())
    (tmp_path / "set").symlink_to(folder / "set")
    others = TEXT.replace("seed = 5", "seed = 6").replace(
        "odds = 0.5", "odds = 0"
    )  # the points are the same in all sets
    mph.events.make(small_recipe(tmp_path / "recipe", others), tmp_path / "others", 3)
    (tmp_path / "judge.toml").write_text(OWN_JUDGE, encoding="utf-8")
    command = ["learn", "judge", str(tmp_path / "judge.toml"), "-o", str(tmp_path / "judgement"), "--into-models"]
    assert main(command) == 0
    assert " in judgement.md, .json and .png" in capsys.readouterr().out
    rows = json.loads((tmp_path / "judgement" / "judgement.json").read_text(encoding="utf-8"))["rows"]
    net_rows = [row for row in rows if row["method"] == "net"]
    assert [row["level"] for row in net_rows] == [1.0, 0.5] and all(0 < row["nrmse"] < 1 for row in net_rows)
    assert mph.learning.read_model(tmp_path / "net.pt").contents.judgement["rows"] == net_rows
    on_itself = OWN_JUDGE.replace('"set"\nsplit = "test"', '"others"')
    on_itself = on_itself.replace('"others"\nlevels', '"set"\nsplit = "train"\nlevels')
    (tmp_path / "judge.toml").write_text(on_itself, encoding="utf-8")
    assert main(command) == 1
    assert "net: it was trained on events of the test others" in capsys.readouterr().err
