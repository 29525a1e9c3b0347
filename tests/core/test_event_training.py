"""Event sets as torch's `Dataset`: what is in a batch, and that nobody but set, event, epoch and seed decides it."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from mphdrr.core import events

from .conftest import refused

torch = pytest.importorskip("torch", reason="no torch")
from torch.utils.data import DataLoader, Dataset  # noqa: E402


def same(first: dict, second: dict) -> bool:
    return first.keys() == second.keys() and all(torch.equal(first[name], second[name]) for name in first)


def test_items_hold_the_fields_as_float32(event_set):
    fields = ("truth", "affine", "counts", "counts/slots", "radon6", "pose", "position", "euler_degrees")
    dataset = events.torch_dataset(event_set, fields)
    assert isinstance(dataset, Dataset) and len(dataset) == 5
    event, item = event_set[2], dataset[2]
    assert set(item) == {*fields, "number"} and item["number"] == event.number
    assert all(item[name].dtype == torch.float32 for name in fields)
    assert np.array_equal(item["truth"], event.truth.array) and np.array_equal(item["counts"], event.images("counts"))
    assert item["counts/slots"].shape == (16, 12, 12)
    assert np.array_equal(item["counts/slots"][12:16], event.images("counts")[:3:-1, :, ::-1])
    assert np.array_equal(item["radon6"], event.radon(6))
    for name in ("pose", "position", "euler_degrees"):
        assert np.allclose(item[name], getattr(event, name), rtol=1e-6, atol=1e-5)


def test_own_noise_is_that_of_the_set_in_every_epoch(event_set):
    dataset = events.torch_dataset(event_set, ("counts", "rays"), noise="own")
    for epoch in (0, 7):
        dataset.set_epoch(epoch)
        item, event = dataset[1], event_set[1]
        assert np.array_equal(item["counts"], event.images("counts", noise_seed=event.noise_seed))
        assert np.array_equal(item["rays"], event.images("rays")), "only counts have noise"


def test_levels_are_the_recipes_or_drawn_and_scale_the_counts(event_set):
    """With own noise the same in every epoch."""
    assert set(event_set.recipe.levels) == {1.0}
    for noise, levels in (("own", ()), ("own", (1.0, 0.5, 0.25)), ("epoch", (1.0, 0.25))):
        more = {"levels": levels} if levels else {}
        dataset = events.torch_dataset(event_set, ("counts",), noise=noise, **more)
        first, drawn = [dataset[i] for i in range(5)], set()
        for epoch in range(4):
            dataset.set_epoch(epoch)
            items = [dataset[i] for i in range(5)]
            assert noise == "epoch" or all(map(same, first, items))
            drawn |= {float(item["level"]) for item in items}
            for item, event in zip(items, event_set, strict=True):
                expected = float(item["level"]) * event.images("counts").sum(dtype=float)
                assert abs(float(item["counts"].sum(dtype=torch.float64)) - expected) < 6 * np.sqrt(expected)
        assert drawn <= set(levels or (1.0,)) and (noise == "own" or drawn == set(levels))


def test_noise_of_epochs_differs_and_repeats(event_set):
    dataset = events.torch_dataset(event_set, ("counts",), noise="epoch", seed=4)
    seen = []
    for epoch in (0, 1, 0):
        dataset.set_epoch(epoch)
        seen.append(dataset[3]["counts"])
    assert torch.equal(seen[0], seen[2]) and not torch.equal(seen[0], seen[1])
    assert not torch.equal(events.torch_dataset(event_set, ("counts",), noise="epoch", seed=5)[3]["counts"], seen[0])
    # Poisson: epochs have the mean images as their mean, and as much variance.
    mean = event_set[3].images("counts")
    drawn = []
    for epoch in range(40):
        dataset.set_epoch(epoch)
        drawn.append(dataset[3]["counts"].numpy())
    score = (np.sum(drawn) - 40 * mean.sum(dtype=float)) / np.sqrt(40 * mean.sum(dtype=float))
    assert abs(score) < 5
    ratio = np.var(drawn, axis=0, ddof=1).sum(dtype=float) / mean.sum(dtype=float)
    assert 0.9 < ratio < 1.1


def test_crops_are_parts_of_the_fields_at_the_place_that_is_said_or_in_the_middle(event_set):
    crop = {"truth": (4, 5, 3), ("counts/slots", "radon16"): (None, 8, 6)}
    fields = ("truth", "affine", "counts/slots", "radon16")
    dataset, whole = events.torch_dataset(event_set, fields, crop=crop), events.torch_dataset(event_set, fields)
    places = set()
    for epoch in range(3):
        dataset.set_epoch(epoch)
        for i in range(5):
            item, all_of_it = dataset[i], whole[i]
            x, y, z = start = item["truth_start"].tolist()
            assert torch.equal(item["truth"], all_of_it["truth"][x : x + 4, y : y + 5, z : z + 3])
            first = all_of_it["affine"] @ torch.tensor([*start, 1.0])
            assert torch.allclose(item["affine"][:, 3], first, atol=1e-4)
            assert torch.equal(item["affine"][:, :3], all_of_it["affine"][:, :3])
            _, v, u = item["radon16_start"].tolist()
            assert item["radon16_start"].tolist() == item["counts/slots_start"].tolist()
            for name in ("counts/slots", "radon16"):
                assert torch.equal(item[name], all_of_it[name][:, v : v + 8, u : u + 6])
            places.add((*start, v, u))
    assert len(places) > 10, "at random"
    middle = events.torch_dataset(event_set, ("truth",), crop=4, crop_at="center")[0]
    assert middle["truth_start"].tolist() == [3, 2, 2]  # of 10, 9, 8
    assert np.array_equal(middle["truth"], event_set[0].truth.array[3:7, 2:6, 2:6])


def seen_by(dataset: Dataset, epochs: int, **options) -> list[list[dict]]:
    loader = DataLoader(dataset, batch_size=2, **options)
    seen = []
    for epoch in range(epochs):
        dataset.set_epoch(epoch)
        seen.append(list(loader))
    return seen


@pytest.mark.parametrize("start", ["fork", pytest.param("spawn", marks=pytest.mark.long)])
def test_workers_give_what_one_process_gives_and_follow_the_epoch(start, event_set):
    """Workers that are kept have been started before the epoch was set."""
    if start not in torch.multiprocessing.get_all_start_methods():
        pytest.skip(f"no {start} here")
    fields = ("truth", "counts")
    dataset = events.torch_dataset(event_set, fields, noise="epoch", levels=(1.0, 0.5), crop=5)
    alone = seen_by(dataset, 2)
    kept = seen_by(dataset, 2, num_workers=2, persistent_workers=True, multiprocessing_context=start)
    assert [len(batches) for batches in kept] == [3, 3]
    assert kept[0][0]["truth"].shape == (2, 5, 5, 5) and kept[0][0]["counts"].shape == (2, 8, 12, 12)
    for one, other in zip(alone, kept, strict=True):
        assert all(map(same, one, other))
    assert not same(kept[0][0], kept[1][0])


def test_items_do_not_depend_on_the_part_of_the_set_that_is_read_and_survive_pickling(event_set):
    options = {"fields": ("counts", "truth"), "noise": "epoch", "crop": 4, "seed": 9}
    whole, part = events.torch_dataset(event_set, **options), events.torch_dataset(event_set[3:], **options)
    assert same(whole[3], part[0])
    part.set_epoch(3)
    again = pickle.loads(pickle.dumps(part))
    assert again.epoch == 3 and same(again[0], part[0])


@pytest.mark.parametrize(
    ("options", "found"),
    [
        ({"fields": ("heart",)}, "field 'heart': expected one of truth, counts, rays, radon16, radon6"),
        ({"fields": ("truth",), "crop": 9}, "a part of 9 along an axis of 8"),
        ({"fields": ("counts",), "crop": 4}, "crop: 'truth': expected one of the fields"),
        ({"fields": ("counts", "radon6"), "crop": {("counts", "radon6"): 4}}, "expected fields of one shape"),
        ({"fields": ("rays",), "noise": "own"}, "only counts and photons have it"),
        ({"fields": ("counts",), "levels": 0.5}, "levels: need noise"),
        ({"fields": ("counts",), "noise": "each"}, "noise 'each'"),
        ({"fields": ("truth",), "seed": -1}, "seed: expected a whole number"),
    ],
)
def test_what_cannot_be_read_is_said(options, found, event_set):
    refused(lambda: events.torch_dataset(event_set, **options), found)
