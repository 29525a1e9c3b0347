"""Exported event sets in the programs that read them: `make test-peers` runs these tests with all of them."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from mphdrr.core.events import export_events

torch = pytest.importorskip("torch", reason="no torch")

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture(scope="module")
def unet3d():
    """Return the loaders of pytorch-3dunet."""
    if importlib.util.find_spec("pytorch3dunet") is None:
        pytest.skip("no pytorch-3dunet")
    import pytorch3dunet.datasets.utils

    return pytorch3dunet.datasets.utils


@pytest.fixture(scope="module")
def wds():
    return pytest.importorskip("webdataset", reason="no webdataset")


def phase(folder, patch) -> dict:
    """Return a phase of pytorch-3dunet's configuration, with nothing but conversion to tensors."""
    to_tensor = [{"name": "ToTensor", "expand_dims": True}]
    slices = {"name": "SliceBuilder", "patch_shape": patch, "stride_shape": patch, "skip_shape_check": True}
    return {"file_paths": [str(folder)], "slice_builder": slices, "transformer": {"raw": to_tensor, "label": to_tensor}}


def train_loaders(unet3d, folder, shape, **options) -> dict:
    """Return the loaders of an exported folder for training and validation, as pytorch-3dunet makes them."""
    phases = {"train": phase(folder / "train", shape), "val": phase(folder / "test", shape)}
    return unet3d.get_train_loaders({"loaders": {"num_workers": 0} | options | phases, "device": "cpu"})


@pytest.mark.parametrize("dataset", ["StandardHDF5Dataset", "LazyHDF5Dataset"])
@pytest.mark.parametrize("raw", ["slots", "backprojection"])
def test_pytorch_3dunet_loads_raw_and_label(unet3d, dataset, raw, event_set, tmp_path):
    export_events(event_set, tmp_path, "3dunet", models="counts", noise="own", raw=raw)
    shape = (16, 12, 12) if raw == "slots" else event_set[0].truth.array.shape[::-1]
    made = train_loaders(unet3d, tmp_path, shape, dataset=dataset, batch_size=1)
    labels = {}
    for name, split in (("train", "train"), ("val", "test")):
        events = event_set.split(split)
        batches = list(made[name])
        assert len(batches) == len(events)
        for image, label in batches:
            assert image.shape == label.shape == (1, 1, *shape)
            assert image.dtype == label.dtype == torch.float32 and image.max() > 0
            labels[label.numpy().tobytes()] = image
    # The loaders shuffle: the label says which event it is.
    for event in event_set:
        label = event.radon(16) if raw == "slots" else np.ascontiguousarray(event.truth.array.T)
        image = labels.pop(label.tobytes())[0, 0].numpy()
        if raw == "slots":
            assert np.array_equal(image[:4], event.images("counts", event.noise_seed)[:4])
    assert not labels


def test_pytorch_3dunets_network_learns_from_slots(unet3d, event_set, tmp_path):
    from pytorch3dunet.unet3d.model import UNet3D

    export_events(event_set, tmp_path, "3dunet", models="counts")
    image, label = next(iter(train_loaders(unet3d, tmp_path, (16, 12, 12), batch_size=2)["train"]))
    torch.manual_seed(1)
    network = UNet3D(1, 1, final_sigmoid=False, f_maps=4, num_levels=2, num_groups=2, is_segmentation=False)
    optimizer, losses = torch.optim.Adam(network.parameters(), 0.05), []
    for _ in range(6):
        loss = torch.nn.functional.mse_loss(network(image / image.max()), label / label.max())
        losses.append(loss.item())
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert losses[-1] < losses[0]


def test_pytorch_3dunet_trains_by_our_configuration_and_keeps_the_activity(unet3d, event_set, tmp_path):
    """With its own trainer: `examples/learning/pytorch-3dunet.yml` but for sizes and folders."""
    import yaml
    from pytorch3dunet.unet3d.trainer import create_trainer

    export_events(event_set, tmp_path, "3dunet", models="counts", noise="own", raw="backprojection")
    config = yaml.safe_load((EXAMPLES / "learning/pytorch-3dunet.yml").read_text())
    config["device"] = "cpu"
    config["model"]["f_maps"] = [4, 8]
    config["trainer"]["checkpoint_dir"] = str(tmp_path / "training")
    config["trainer"] |= {"max_num_iterations": 4, "validate_after_iters": 2}
    shape = list(event_set[0].truth.array.shape[::-1])
    for name, folder in (("train", "train"), ("val", "test")):
        part = config["loaders"][name]
        part["file_paths"] = [str(tmp_path / folder)]
        part["slice_builder"] |= {"patch_shape": shape, "stride_shape": shape}
    loaders = unet3d.get_train_loaders(config)
    most = config["loaders"]["train"]["transformer"]["label"][0]["max_value"]
    truths = {round(float(event.truth.array.max()), 3) for event in event_set.split("train")}
    assert {round(float(label.max()) * most, 3) for _, label in loaders["train"]} == truths
    create_trainer(config).fit()
    assert (tmp_path / "training/last_checkpoint.pytorch").exists()


def test_webdataset_loads_shards(wds, event_set, tmp_path):
    export_events(event_set, tmp_path, "webdataset", events_per_shard=2, noise="own")
    shards = sorted(str(path) for path in tmp_path.glob("*.tar"))
    assert len(shards) > 2
    samples = list(wds.WebDataset(shards, shardshuffle=False).decode())
    assert len(samples) == 5
    for sample in samples:
        event = event_set[int(sample["__key__"])]
        assert np.array_equal(sample["truth.npy.gz"], event.truth.array)
        assert np.array_equal(sample["counts.npy.gz"], event.images("counts", event.noise_seed))
        assert np.array_equal(sample["radon16.npy.gz"], event.radon(16))
        assert sample["json"]["number"] == event.number and sample["json"]["split"] == event.split


def test_webdataset_makes_batches_with_workers(wds, event_set, tmp_path):
    export_events(event_set, tmp_path, "webdataset", models="rays", events_per_shard=1)
    last = len(event_set.split("train")) - 1
    pattern = f"{tmp_path}/train-{{000000..{last:06d}}}.tar"
    dataset = wds.WebDataset(pattern, shardshuffle=False).decode().to_tuple("rays.npy.gz", "truth.npy.gz").batched(1)
    loader = wds.WebLoader(dataset, batch_size=None, num_workers=2)
    images = {np.asarray(batch[0]).tobytes() for batch in loader}
    assert images == {event.images("rays")[None].tobytes() for event in event_set.split("train")}
