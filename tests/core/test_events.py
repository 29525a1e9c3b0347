"""Event sets: what an event is, the recipe's language, reading."""

from __future__ import annotations

import copy
import json
import math
import pickle
import tomllib
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.addon.cli import main
from mphdrr.core import events
from mphdrr.core.events.draws import Dice

from .conftest import refused
from .small_events import TEXT, WORKBOOK, small_recipe, with_phantoms


@pytest.fixture(scope="module")
def small(tmp_path_factory) -> events.EventSet:
    folder = tmp_path_factory.mktemp("events")
    return events.make(small_recipe(folder), folder / "set", 6)


def test_an_event_is_what_the_projector_makes_of_its_phantom(small):
    recipe = small.recipe
    system = mph.read_system(WORKBOOK)
    views = system.views((14, 16))
    names = set()
    for event in small:
        names.add(event.name)
        phantom = mph.DerenzoPhantom if event.name == "derenzo" else mph.PointGrid
        own = {key.removesuffix("_of_points"): value for key, value in event.settings.items() if key != "kind"}
        own = {key: tuple(value) if isinstance(value, list) else value for key, value in own.items()}
        truth = phantom(**own).voxelize(recipe.grid, event.pose)
        np.testing.assert_allclose(event.truth.array, truth.array, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(event.images("lines"), mph.Projector(truth.grid, views)(truth), rtol=1e-5, atol=1e-4)
        model = mph.Emission(system, time=100, hole="point", pixel_points=1, tolerance=1e6)
        counts = mph.Projector(truth.grid, views, model)(truth)
        np.testing.assert_allclose(event.images("emission"), counts + 0.25, rtol=1e-5)
        for n in (6, 8):
            parallel = mph.parallel_views(np.pi * np.arange(n) / n, (16, 16), 6.0)
            np.testing.assert_allclose(event.radon(n), mph.Projector(truth.grid, parallel)(truth), rtol=1e-5, atol=1e-4)
        phi, theta, psi = np.deg2rad(event.euler_degrees)
        np.testing.assert_allclose(event.pose, mph.euler_pose(phi, theta, psi, event.position), atol=1e-12)
    assert names == {"derenzo", "points"}


def test_an_event_depends_on_recipe_seed_and_number_alone(tmp_path, small):
    recipe = small_recipe(tmp_path)
    alone = events.make(recipe, tmp_path / "alone", 1, first=3)
    assert alone.numbers == [3]
    assert alone[0].path.read_bytes() == small[3].path.read_bytes()
    other = small_recipe(tmp_path / "other", TEXT.replace("seed = 5", "seed = 6"))
    assert other.fingerprint != recipe.fingerprint
    assert events.plan(other, 3).position != events.plan(recipe, 3).position


def test_a_setting_that_is_added_changes_no_other(tmp_path):
    before = small_recipe(tmp_path)
    height = 'kind = "derenzo"\nheight = { from = 20, to = 40 }'
    after = small_recipe(tmp_path, TEXT.replace('kind = "derenzo"', height))
    for number in range(20):
        a, b = events.plan(before, number), events.plan(after, number)
        for name in ("name", "position", "euler_degrees", "noise_seed"):
            assert getattr(a, name) == getattr(b, name)
        assert all(b.settings[key] == value for key, value in a.settings.items())


def reference(recipe: events.EventRecipe) -> list[dict[str, Any]]:
    """Return some numbers of six events: as drawn, and sums of their arrays."""
    maker, found = events.EventMaker(recipe), []
    for number in range(6):
        event = maker.make(number)
        arrays = {"truth": event.truth.array, **event.images, **{str(n): images for n, images in event.radon.items()}}
        sums = {name: array.sum(axis=(1, 2), dtype=np.float64).tolist() for name, array in arrays.items()}
        found.append({"row": event.planned.row(), "pose": event.planned.pose.tolist(), "sums": sums})
    return found


def test_events_are_the_same_under_every_python(tmp_path):
    """Drawn numbers exactly, poses to 1e-12, arrays to 1e-6: as under Python 3.11 with numpy 1.26 (data/events.json)."""
    expected = json.loads((Path(__file__).parent / "data" / "events.json").read_text())
    for found, known in zip(reference(small_recipe(tmp_path)), expected, strict=True):
        assert json.loads(json.dumps(found["row"])) == known["row"]
        np.testing.assert_allclose(found["pose"], known["pose"], rtol=0, atol=1e-12)
        for name, sums in known["sums"].items():
            np.testing.assert_allclose(found["sums"][name], sums, rtol=0, atol=1e-6 * max(sums))


def test_comments_and_the_place_of_files_do_not_change_a_recipe(tmp_path):
    (tmp_path / "scanner.xlsx").write_bytes(WORKBOOK.read_bytes())
    moved = TEXT.replace(repr(str(WORKBOOK)), '"scanner.xlsx"') + "\n# a comment\n"
    assert small_recipe(tmp_path, moved).fingerprint == small_recipe(tmp_path / "a").fingerprint
    (tmp_path / "scanner.xlsx").write_bytes(WORKBOOK.read_bytes() + b" ")
    assert small_recipe(tmp_path, moved).fingerprint != small_recipe(tmp_path / "a").fingerprint


def test_draws_lie_in_their_ranges_and_have_their_odds(tmp_path):
    recipe = small_recipe(tmp_path)
    plans = [events.plan(recipe, number) for number in range(2000)]
    rods = [plan for plan in plans if plan.name == "derenzo"]
    assert abs(len(rods) / len(plans) - 2 / 3) < 4 * math.sqrt(2 / 9 / len(plans))
    for values, low, high in (
        ([plan.settings["radius"] for plan in rods], 30, 36),
        ([plan.settings["rod_diameters"][1] for plan in rods], 8, 9),
        ([plan.position[0] for plan in rods], -8, 8),
        ([plan.euler_degrees[1] for plan in rods], 0, 180),
    ):
        assert low <= min(values) < max(values) <= high
        assert abs(np.mean(values) - (low + high) / 2) < 4 * (high - low) / math.sqrt(12 * len(values))
    counts = [plan.settings["counts"][0] for plan in plans if plan.name == "points"]
    assert set(counts) == {1, 2, 3} and abs(counts.count(2) / len(counts) - 1 / 3) < 0.08
    for length in (10, 100, 2000):  # any stretch has about the shares
        train = sum(plan.split == "train" for plan in plans[:length])
        assert abs(train - 0.8 * length) <= 2
    assert len({plan.noise_seed for plan in plans}) == len(plans)


def test_random_numbers_are_numpys_seed_sequence():
    """Fixed numbers: they must never change."""
    assert Dice(5, 3).bits("phantom") == 3665578617971258139
    assert Dice(0, 0).bits("noise") == 9026780742125465097
    normals = [Dice(1, i).normal("x") for i in range(4000)]
    assert abs(np.mean(normals)) < 0.07 and abs(np.std(normals) - 1) < 0.05


def test_uniform_turns_are_uniform(tmp_path):
    entry = '[[phantoms]]\nkind = "derenzo"\nrod_diameters = [10, 0, 0, 0, 0, 0]\npose.turn = "uniform"\n'
    recipe = small_recipe(tmp_path, with_phantoms(entry))
    poses = np.array([events.plan(recipe, number).pose for number in range(2000)])
    axes = poses[:, :3, 2]  # of the rods: uniform on the sphere, so each part is uniform from -1 to 1
    assert np.abs(axes.mean(axis=0)).max() < 4 / math.sqrt(3 * len(axes))
    assert np.abs((axes**2).mean(axis=0) - 1 / 3).max() < 0.03
    np.testing.assert_allclose(poses[:, :3, :3] @ poses[:, :3, :3].transpose(0, 2, 1) - np.eye(3), 0, atol=1e-12)


def test_noise_is_drawn_when_read(small):
    event = small[0]
    mean = event.images("emission")
    counts = event.images("emission", noise_seed=event.noise_seed)
    np.testing.assert_array_equal(counts, mph.sample_counts(mean, event.noise_seed))
    part = event.images("emission", noise_seed=event.noise_seed, modules=slice(2, 5))
    np.testing.assert_array_equal(counts[2:5], part)
    assert not np.array_equal(counts, event.images("emission", noise_seed=event.noise_seed + 1))
    np.testing.assert_allclose(event.images("emission", level=0.25), mean / 4)
    low = np.mean([event.images("emission", noise_seed=s, level=0.25).sum() for s in range(40)])
    assert abs(low - mean.sum() / 4) < 4 * math.sqrt(mean.sum() / 4 / 40)
    refused(lambda: event.images("lines", noise_seed=1), "lines: only counts and photons have noise")
    refused(lambda: event.images("spect"), "no images of 'spect'; there are emission, lines")
    refused(lambda: event.radon(7), "no radon of '7'; there are 6, 8")
    found = mph.fbp(event.radon(8), event.radon_views(8), event.truth.grid)
    assert found.quantity == event.truth.quantity == "activity"


def test_a_set_is_read_filtered_joined_and_pickled(small, tmp_path):
    assert len(small) == 6 and small.numbers == list(range(6)) and small[-1].number == 5
    rods = small.where(lambda row: row["phantom"] == "derenzo" and row["phantom.activity"] > 60)
    assert 0 < len(rods) < 6 and all(event.settings["activity"] > 60 for event in rods)
    train, test = small.split("train"), small.split("test")
    assert sorted(train.numbers + test.numbers) == small.numbers
    refused(lambda: small.split("tset"), "split 'tset': there are test, train")
    other = events.make(small_recipe(tmp_path, TEXT.replace("seed = 5", "seed = 9")), tmp_path / "set", 2)
    joined = small + other
    assert len(joined) == 8 and joined.numbers[-2:] == [0, 1]
    again = pickle.loads(pickle.dumps(joined))
    np.testing.assert_array_equal(again[7].truth.array, joined[7].truth.array)
    assert [row["noise_seed"] for row in small.index] == [event.noise_seed for event in small]
    refused(lambda: events.EventSet(tmp_path), r"no event set: it holds no recipe\.toml")


def test_the_index_says_what_the_files_hold(small):
    for row, event in zip(small.index, small, strict=True):
        assert (row["event"], row["phantom"], row["split"]) == (event.number, event.name, event.split)
        assert [row["x_mm"], row["y_mm"], row["z_mm"]] == event.position.tolist()
        assert [row[f"{name}_degrees"] for name in ("phi", "theta", "psi")] == event.euler_degrees.tolist()
        for key, value in row.items():
            if key.startswith("phantom.") and value is not None:
                assert np.allclose(event.settings[key.removeprefix("phantom.")], value)


def test_an_event_becomes_a_run(small, tmp_path):
    event = next(event for event in small if event.name == "derenzo")
    run = event.run("emission", noise_seed=4)
    mph.write_run(run, tmp_path / "run.h5")
    again = mph.read_run(tmp_path / "run.h5")
    assert again.seed == 4 and again.unit == "counts"
    np.testing.assert_allclose(again.recipe["phantom.matrix"], event.placement, atol=1e-12)
    np.testing.assert_array_equal(again.projections, event.images("emission", noise_seed=4))
    assert run.background == pytest.approx(0.25)
    assert again.recipe["system.file"] == str(small[0].path.parents[1] / "inputs" / WORKBOOK.name)
    grid, truth = small.recipe.grid, event.planned.phantom
    np.testing.assert_allclose(truth.voxelize(grid, np.array(again.recipe["phantom.matrix"])).array, event.truth.array)
    found = mph.projector_of_run(again, grid)(event.truth) + 0.25
    np.testing.assert_allclose(found, event.images("emission"), rtol=1e-5)


def test_described_phantoms(tmp_path):
    ball = mph.ShapePhantom([mph.Sphere(radius=20, activity=3, mu=0.01, position=(5, 0, 0))])
    mph.write_phantom(ball, tmp_path / "ball.toml")
    entry = '[[phantoms]]\nfile = "ball.toml"\n[phantoms.pose]\nturn = "uniform"\nposition = [3, 2, 1]\n'
    recipe = small_recipe(tmp_path, with_phantoms(entry).replace("time =", 'attenuation = "phantom"\ntime ='))
    event = events.make(recipe, tmp_path / "set", 1)[0]
    np.testing.assert_allclose(event.truth.array, ball.voxelize(recipe.grid, event.pose).array)
    run = event.run("emission")
    np.testing.assert_allclose(mph.projector_of_run(run, recipe.grid)(event.truth) + 0.25, run.projections, rtol=1e-5)
    mph.write_run(run, tmp_path / "run.h5")
    assert mph.read_run(tmp_path / "run.h5").recipe["phantom.file"] == str(tmp_path / "set" / "inputs" / "ball.toml")


def test_augmentation(tmp_path):
    more = "\n[augmentation]\nmirror = 0.5\nsize = { from = 0.8, to = 1.2 }\nactivity = { one_of = [0.5, 2.0] }\n"
    more += "module_gain = 0.1\n"
    recipe = small_recipe(tmp_path, TEXT + more)
    plans = [events.plan(recipe, number) for number in range(400)]
    assert 0.4 < np.mean([plan.mirror for plan in plans]) < 0.6
    assert {plan.activity_factor for plan in plans} == {0.5, 2.0}
    mirrored = next(plan for plan in plans if plan.mirror)
    assert np.linalg.det(mirrored.placement[:3, :3]) == pytest.approx(-(mirrored.size**3))
    np.testing.assert_allclose(np.abs(np.linalg.inv(mirrored.pose) @ mirrored.placement).sum(axis=0)[:3], mirrored.size)
    gains = np.array([plan.gains(8) for plan in plans])
    assert abs(np.log(gains).std() - 0.1) < 0.01 and gains.min() > 0
    maker = events.EventMaker(recipe)
    plain = events.EventMaker(small_recipe(tmp_path / "plain"))
    event, base = maker.make(0), plain.make(0)
    held = event.truth.array.sum() / (event.planned.activity_factor * event.planned.size**3)
    assert held == pytest.approx(base.truth.array.sum(), rel=2e-3)  # the same phantom, larger, brighter
    tops = event.images["emission"] / event.gains[:, None, None].astype(np.float32)
    np.testing.assert_allclose(tops.min(axis=(1, 2)), 0.25, rtol=1e-5)  # the background


def test_volumes_are_placed_like_phantoms(tmp_path):
    """A file's volume of a phantom, turned by the event's pose, is the phantom voxelised in that pose."""
    grid = mph.Grid.centered(48, 2.0)
    heart = mph.ShapePhantom([mph.Ellipsoid(radii=(24, 14, 10), activity=7, mu=0.02, position=(5, 3, -4))])
    mph.write_volume(heart.voxelize(grid), tmp_path / "heart.nii.gz")
    mph.write_volume(heart.voxelize(grid, quantity="mu"), tmp_path / "mu.nii.gz")
    entry = '[[phantoms]]\nname = "heart"\nfile = "heart.nii.gz"\nmu_file = "mu.nii.gz"\n[phantoms.pose]\n'
    entry += "position = [4, 0, 3]\neuler_degrees = [30, 40, { from = 0, to = 360 }]\n"
    text = with_phantoms(entry).replace("pixel_points", 'attenuation = "phantom"\npixel_points')
    recipe = small_recipe(tmp_path, text)
    event = events.make(recipe, tmp_path / "set", 1)[0]
    exact = heart.voxelize(recipe.grid, event.pose)
    assert event.truth.array.sum() == pytest.approx(exact.array.sum(), rel=0.02)
    assert np.abs(event.truth.array - exact.array).mean() < 0.03 * exact.array.mean() + 0.02
    plain = small_recipe(tmp_path, text.replace('attenuation = "phantom"\n', ""))
    bright = events.EventMaker(plain).make(0).images["emission"] - 0.25
    ratio = (event.images("emission") - 0.25).sum() / bright.sum()
    assert 0.6 < ratio < 0.95  # 10 to 24 mm of 0.02 / mm
    moved = np.diag([1.0, 1, 1, 1])
    moved[:3, 3] = (500, 20, -30)  # elsewhere: center = true brings both back together
    for name in ("heart.nii.gz", "mu.nii.gz"):
        volume = mph.read_volume(tmp_path / name)
        volume = mph.Volume(volume.array, mph.Grid(volume.grid.shape, moved @ volume.grid.affine), volume.quantity)
        mph.write_volume(volume, tmp_path / f"far-{name}")
    far = text.replace('file = "heart', 'center = true\nfile = "far-heart').replace('"mu.nii', '"far-mu.nii')
    again = events.EventMaker(small_recipe(tmp_path, far)).make(0)
    np.testing.assert_allclose(again.images["emission"], event.images("emission"), rtol=1e-3)
    (tmp_path / "heart.nii.gz").unlink()
    (tmp_path / "mu.nii.gz").unlink()
    again = list(events.making(events.EventSet(tmp_path / "set").recipe, tmp_path / "set", 2))  # from its own copies
    assert [made.number for made in again] == [1]


@pytest.mark.long
def test_a_beating_torso_is_the_mean_of_its_gates(tmp_path):
    text = with_phantoms('[[phantoms]]\nkind = "torso"\ngates = 2\ndefect_severity = 0.5\n')
    text = text.replace("spacing = 6.0", "spacing = 24.0").replace("voxels = 16", "voxels = 6")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        recipe = small_recipe(tmp_path, text)
        truth = events.EventMaker(recipe).truth(events.plan(recipe, 0)).array
        gates = [mph.CardiacTorso(defect_severity=0.5, phase=i / 2).voxelize(recipe.grid).array for i in range(2)]
    np.testing.assert_allclose(truth, np.mean(gates, axis=0), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("version = 1", "", "version: missing"),
        ("version = 1", "version = 2", "version: expected 1, got 2"),
        ("seed = 5", "seed = -5", "seed: expected a whole number of 0 or more .*, got -5"),
        ("seed = 5", f"seed = {2**64}", "seed: expected a whole number .* at most 1.84467e\\+19, got 18446744073709551616"),
        ("seed = 5", "seed = 1e3", "seed: expected a whole number of 0 or more .*, got 1000.0"),
        ("seed = 5", "sed = 5", "sed: no such entry; expected version, seed"),
        ("spacing = 6.0", "", "truth.spacing: missing"),
        ("[radon]", "[rdon]", "rdon: no such entry"),
        ('kind = "derenzo"', 'kind = "derezno"', "kind: expected one of derenzo, nema, .*, got 'derezno'"),
        ("radius = { from = 30, to = 36 }", "raduis = 3", "derenzo: raduis: no such setting; expected radius"),
        ("{ from = 30, to = 36 }", "{ from = 36, to = 30 }", "radius: expected from 36 to no less, got 30"),
        ("{ from = 30, to = 36 }", "{ form = 30, to = 36 }", "radius: expected { from = …, to = … }"),
        ("{ from = 30, to = 36 }", "{ one_of = [30, 36], odds = [1] }", "radius: expected 2 odds of 0 or more"),
        ("{ from = 1, to = 3 }", "{ from = 1, to = 2.5 }", "counts: from and to: expected a whole number, got 2.5"),
        ("odds = 0.5", "odds = -1", "points: odds: expected a number of 0 or more, got -1"),
        ("odds = 0.5", 'split = "tset"', "points: split: expected one of train, test"),
        ("odds = 0.5", 'name = "derenzo"', "2 are called 'derenzo': give each a name of its own"),
        ("time = 100", "tiem = 100", "models.emission: model.tiem: no such setting"),
        ("time = 100", 'attenuation = "nothing.nii"', "nothing.nii: no such file"),
        ("angles = [6, 8]", "angles = [6, 6]", "radon.angles: expected different numbers of angles"),
        ("levels = [1.0, 0.25]", "levels = [0]", "noise.levels: expected a number above 0, got 0"),
        ("train = 0.8", "train = -1", "splits: expected 2 odds of 0 or more"),
        ("train = 0.8", "train = nan", "splits: expected 2 odds of 0 or more"),
        ("train = 0.8", "train = '0.8'", "splits: expected 2 odds of 0 or more"),
        ("train = 0.8", "train = 8", "splits: expected shares that sum to 1, got 8.2"),
        ("train = 0.8", "train = 0.79999", "splits: expected shares that sum to 1, got 0.99999"),
        ("test = 0.2", "", "splits: expected shares that sum to 1, got 0.8"),
        ("voxels = 16", "voxels = true", "truth.voxels: expected a whole number of 1 or more, got True"),
        ("version = 1", "version = true", "version: expected 1, got True"),
        ("voxels = 16", 'voxels = 16\nstore = "float8"', "truth.store: expected one of float32, .*, got 'float8'"),
        ("voxels = 16", "voxels = 16\nbelow = 0.1", "truth.below needs truth.store = sparse"),
        ("[noise]", "[augmentation]\nmodule_gain = 1\n[noise]", "augmentation.module_gain: expected .* got 1$"),
        ("[noise]", "[augmentation]\nsize = { from = 0, to = '1' }\n[noise]", "from and to: expected a number, got '1'"),
        ("odds = 0.5", "gates = 2", "points: gates: expected kind"),
        ("odds = 0.5", "center = true", "points: center needs file"),
        ("voxels = 16", "voxels = 100000", "an event of .* needs .* of memory"),
        ("[models.lines]", "[models.placement]", "models.placement: a reserved name: expected another"),
        ("modules =", "modles =", "system.modles: no such setting"),
        (f"file = {str(WORKBOOK)!r}", "", "system.file: missing"),
        ("{ from = 30, to = 36 }", "-3", "event 1: derenzo.*radius: expected .* above 0|radius"),
    ],
)  # fmt: skip
def test_what_is_not_understood_is_refused_by_name(tmp_path, old, new, said):
    assert old in TEXT
    refused(lambda: events.make(small_recipe(tmp_path, TEXT.replace(old, new, 1)), tmp_path / "set", 8), said)
    assert not list((tmp_path / "set").glob("events/*"))


def test_numbers_as_earlier_versions_took_them(tmp_path):
    """Recipes of before open, whatever they wrote for a number, and the events are those of the number itself."""
    before = ("counts = [{ from = 1, to = 3 }, 2, 1]", "angles = [6, 8]")
    plain = ("[[2, 2, 1], [3, 2, 1]]", "[6, 8]", "mirror = 1\nsize = { one_of = [1] }")
    other = ("[[2.0, 2, 1], [3.0, 2.0, 1]]", "[6.0, 8]", "mirror = true\nsize = { one_of = [true] }")
    rows = []
    for counts, angles, augmentation in (plain, other):
        text = TEXT.replace(before[0], f"counts = {{ one_of = {counts} }}").replace(before[1], f"angles = {angles}")
        recipe = small_recipe(tmp_path, f"{text}\n[augmentation]\n{augmentation}")
        assert recipe.radon is not None and recipe.radon.counts == (6, 8)
        rows.append([events.plan(recipe, number).row() for number in range(8)])
    assert rows[0] == rows[1] and any(row["phantom"] == "points" for row in rows[0])


def test_shares_may_be_rounded_and_a_set_that_was_begun_with_other_shares_goes_on(tmp_path, monkeypatch):
    """Earlier versions divided the shares by their sum, which rounding still does."""
    text = TEXT.replace("train = 0.8", "train = 0.3333333\nb = 0.3333333").replace("test = 0.2", "test = 0.3333333")
    assert sum(small_recipe(tmp_path, text).splits.values()) == pytest.approx(1, abs=1e-15)
    text = TEXT.replace("train = 0.8", "train = 4").replace("test = 0.2", "test = 1")
    with monkeypatch.context() as earlier:
        earlier.setattr("mphdrr.core.events.recipe.abs", lambda _: 0.0, raising=False)
        before = events.make(small_recipe(tmp_path, text), tmp_path / "set", 2)
    rows = [row["split"] for row in before.index]
    assert events.EventSet(tmp_path / "set").recipe.splits == {"train": 0.8, "test": 0.2}
    assert main(["events", "make", str(tmp_path / "set"), "-n", "4"]) == 0
    after = events.EventSet(tmp_path / "set")
    assert len(after) == 4 and [row["split"] for row in after.index][:2] == rows
    assert not events.check(tmp_path / "set")


def test_the_largest_seed_is_kept_in_every_file(tmp_path):
    seed = 2**64 - 1
    made = events.make(small_recipe(tmp_path, TEXT.replace("seed = 5", f"seed = {seed}")), tmp_path / "set", 1)
    assert int(made[0].attributes["seed"]) == seed
    run = made[0].run("emission", noise_seed=seed)
    for name in ("run.h5", "run.npz"):
        mph.write_run(run, tmp_path / name)
        assert mph.read_run(tmp_path / name).seed == seed


@pytest.mark.parametrize("seed", [-1, 2**64, 10**400, 1.5, True, "1", None])
def test_other_seeds_are_refused_wherever_they_enter(event_set, scanner, tmp_path, seed):
    volume = mph.Volume(np.ones((2, 2, 2)), mph.Grid.centered((2, 2, 2), 9.0))
    calls = [lambda: mph.sample_counts(np.ones((1, 2, 2)), seed), lambda: mph.random_pose(seed)]
    if seed is not None:  # which stands for no noise
        model = mph.Emission(scanner[:1], hole="point")
        calls += [
            lambda: mph.project_run(scanner[:1], volume, (2, 2), model=model, noise_seed=seed),
            lambda: mph.Recipe({"model.kind": "emission", "noise.seed": seed}),
            lambda: events.export_events(event_set, tmp_path / "export", "npz", noise=seed),
            lambda: event_set[0].images("counts", noise_seed=seed),
        ]
    for call in calls:
        refused(call, "whole number")


def test_another_recipe_in_the_folder_is_refused(tmp_path, small):
    folder = small[0].path.parents[1]
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    other = small_recipe(tmp_path, TEXT.replace("seed = 5", "seed = 6"))
    refused(lambda: events.make(other, folder, 8), "recipe.toml: another recipe: choose another folder")
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*")} == before
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("mine")
    words = "holds thesis.txt and no recipe.toml: choose a new folder"
    refused(lambda: events.make(small_recipe(tmp_path), tmp_path / "mine", 1), words)


def test_a_set_grows_and_keeps_what_it_has(tmp_path):
    recipe = small_recipe(tmp_path)
    events.make(recipe, tmp_path / "set", 2)
    kept = (tmp_path / "set" / "events" / "000001.h5").stat().st_mtime_ns
    assert [made.number for made in events.making(recipe, tmp_path / "set", 3)] == [2]
    assert (tmp_path / "set" / "events" / "000001.h5").stat().st_mtime_ns == kept
    (tmp_path / "set" / "events" / "000000.h5").unlink()
    assert [made.number for made in events.making(events.EventSet(tmp_path / "set").recipe, tmp_path / "set")] == [0]
    assert json.loads((tmp_path / "set" / "inputs" / "inputs.json").read_text())[str(WORKBOOK)]["what"] == "copy"


WRONG: list[Any] = [
    *(-1, 0, 1e300, math.nan, math.inf, 10**30, "x", "", [], {}, True, [1], ["a"], [[1, 2], [3]], {"from": 1}),
    *({"from": "a", "to": "b"}, {"from": 1, "to": math.inf}, {"one_of": []}, {"one_of": [1, "a"]}),
    {"one_of": [{"from": 1, "to": 2}, [1]]},
]


def places(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the places of values in a recipe."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inner in items:
        yield (*path, key)
        yield from places(inner, (*path, key))


@pytest.mark.long
@pytest.mark.filterwarnings("ignore")
def test_a_wrong_value_anywhere_is_refused_in_one_line(monkeypatch):
    more = '[augmentation]\nmirror = 0.5\nsize = 1.1\nmodule_gain = 0.1\n[[phantoms]]\nkind = "torso"\ngates = 2\n'
    right = tomllib.loads(TEXT + more)
    refusals = 0
    for path in places(right):
        for wrong in WRONG:
            values = copy.deepcopy(right)
            table = values
            for key in path[:-1]:
                table = table[key]
            table[path[-1]] = wrong
            monkeypatch.setattr("mphdrr.core.events.recipe.parse_toml", lambda text, name, values=values: values)
            try:
                recipe = events.EventRecipe("")
                for number in range(3):
                    _ = events.plan(recipe, number).phantom
            except mph.InputError as error:
                assert "\n" not in str(error)
                refusals += 1
    assert refusals > 1000
