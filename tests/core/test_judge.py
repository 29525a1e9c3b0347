"""The judge goes on where it stopped, judges fairly, and refuses what would flatter."""

import json

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.learning.judging.judge import judge
from mphdrr.core.learning.judging.methods import Family, JudgedMethod, smooth, tune
from mphdrr.core.learning.judging.recipe import read_judge_recipe
from mphdrr.core.learning.judging.scoring import Case
from mphdrr.core.learning.judging.sets import (
    SETS,
    events_by_recipe,
    refuse_trained_on,
    set_fingerprint,
    set_text,
    truths_of,
)
from mphdrr.core.phantoms import painting, shapes

from .conftest import WORKBOOK, refused
from .small_events import TEXT, small_recipe, with_phantoms
from .small_recipes import JUDGE

RODS = TEXT[: TEXT.index('[[phantoms]]\nkind = "points"')] + TEXT[TEXT.index("[models.lines]") :]
BELIEVED = """
[models.believed]
kind = "emission"
time = 50
hole = "point"
pixel_points = 1
tolerance = 1e6
background = 0.5

[radon]"""
RODS_TEST = """
[[tests]]
name = "rods"
events = "rods"
scoring = "rods"
levels = [1.0, 0.25]
draws = 2
drawn_events = 1
tuned_on_itself = true
"""
SHORT_TEST = """
[[tests]]
name = "rods"
events = "rods"
count = 1
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Make a folder with a judge's recipe and its sets."""
    path = tmp_path_factory.mktemp("judge")
    for name, seed in (("rods", 5), ("validation", 6)):
        text = RODS.replace("seed = 5", f"seed = {seed}").replace("[radon]", BELIEVED.lstrip())
        recipe = small_recipe(path / "recipes" / name, text)
        mph.events.make(recipe, path / name, 3)
    (path / "judge.toml").write_text(JUDGE + RODS_TEST)
    return path


def short_recipe(folder, text=SHORT_TEST):
    """Return the judge's recipe with other tests."""
    (folder / "short.toml").write_text(JUDGE + text)
    return read_judge_recipe(folder / "short.toml")


def truth(run, factor=1.0):
    """Return the truth of a run, or a share of it."""
    volume = mph.resample(run.volume, mph.Grid.centered((12,) * 3, 8.0), "mean")
    return mph.Volume(factor * volume.array, volume.grid, volume.quantity)


def halved(run):
    return truth(run, 0.5)


METHODS = [JudgedMethod("truth", truth, "truth-1"), JudgedMethod("half", halved, "half-1")]


def recording(runs):
    """Return a method that keeps the runs which it is given, and gives half of the truth."""
    return JudgedMethod("recording", lambda run: runs.append(run) or halved(run), "recording-1")


@pytest.mark.long
def test_the_truth_has_no_error_and_half_of_it_half(folder, tmp_path):
    judgement = judge(read_judge_recipe(folder / "judge.toml"), tmp_path, METHODS)
    rows = {(row["method"], row["level"]): row for row in judgement.rows}
    assert len(judgement.rows) == 2 * 4
    for level in (1.0, 0.25):
        whole, half = rows["truth", level], rows["half", level]
        assert whole["nrmse"] == 0 and whole["ssim"] == 1
        assert half["nrmse"] == half["bias"] == pytest.approx(0.5) and half["deviation"] == 0
        assert half["contrast"] == pytest.approx(whole["contrast"] / 2)
        assert half["deviance"] > whole["deviance"] > 0
        tuned = next(row for row in judgement.rows if row["kind"] == "baseline" and row["level"] == level)
        assert tuned["best_baseline"]["ratio"] == (1, 1, 1) and tuned["best_on_itself"]["ratio"].value >= 1
        assert half["best_baseline"]["ratio"].value == pytest.approx(0.5 / tuned["nrmse"])
    assert "3 events, fewer than 50" in rows["half", 1.0]["notes"][0]
    assert json.loads((tmp_path / "judgement.json").read_text())["tests"]["rods"]["events"] == 3
    table = (tmp_path / "judgement.md").read_text()
    assert table.count("| rods | 0.25 |") == 4 and "by the best tuned on the set" in table
    assert (tmp_path / "judgement.png").stat().st_size > 10_000


def test_contrast_is_of_the_event_as_it_was_changed(tmp_path):
    contrasts = []
    for name, changes in (("as-it-is", ""), ("changed", "[augmentation]\nactivity = 2.5\nmirror = 1\nsize = 1.02\n")):
        recipe = small_recipe(tmp_path / f"{name}-recipe", RODS + changes)
        mph.events.make(recipe, tmp_path / name, 1)
        (event,) = mph.events.EventSet(tmp_path / name)
        case = Case(event, event.run("emission"), event.truth.grid)
        contrasts.append(case.score(case.truth, "rods")["contrast"])
    assert contrasts[0] > 0.2 and contrasts[1] == pytest.approx(contrasts[0], abs=0.15)


HEARTS = (
    TEXT[: TEXT.index("[[phantoms]]")].replace("voxels = 16\nspacing = 6.0", "voxels = 16\nspacing = 8.0")
    + """
[[phantoms]]
kind = "torso"
liver = { from = 20, to = 60 }
[[phantoms]]
kind = "torso"
name = "defect"
defect_severity = 0.8
defect_width_degrees = 90
defect_angle_degrees = 90
liver = { from = 20, to = 60 }
[phantoms.pose]
position = [{ from = -5, to = 5 }, 0, 0]
"""
    + TEXT[TEXT.index("[models.emission]") : TEXT.index("[radon]")]
)


@pytest.mark.long
def test_the_observer_finds_the_defect_in_the_truth_and_not_in_an_even_volume(tmp_path, monkeypatch):
    for module, name, number in (
        (painting, "_SAMPLES_OF_OVERLAP", 1 << 13), (painting, "_MAX_SAMPLES", 1 << 7),
        (shapes, "_LINES", 64), (shapes, "_FEWER_LINES", 32),
    ):  # fmt: skip
        monkeypatch.setattr(module, name, number)  # totals to some percent are enough
    mph.events.make(small_recipe(tmp_path / "recipe", HEARTS), tmp_path / "hearts", 12)
    text = JUDGE.replace("voxels = 12", "voxels = 16")
    others = small_recipe(tmp_path / "others", HEARTS.replace("seed = 5", "seed = 6"))
    mph.events.make(others, tmp_path / "validation", 1)
    (tmp_path / "judge.toml").write_text(text + '[[tests]]\nname = "hearts"\nevents = "hearts"\nscoring = "defect"\n')

    def even(run):
        noise = np.random.default_rng(run.seed).normal(1, 0.1, run.volume.array.shape)
        return mph.Volume(noise.astype(np.float32), run.volume.grid, "activity")

    methods = [JudgedMethod("true", lambda run: run.volume, "true-1"), JudgedMethod("even", even, "even-1")]
    *_, best, worst = judge(read_judge_recipe(tmp_path / "judge.toml"), tmp_path / "out", methods).rows
    assert best["auc"].value == 1 and best["contrast"] == pytest.approx(1)
    assert worst["auc"].low < 0.5 < worst["auc"].high and abs(worst["contrast"]) < 0.2


def test_interrupted_work_goes_on_where_it_stopped(folder, tmp_path):
    runs, recipe = [], short_recipe(folder, RODS_TEST.replace("tuned_on_itself = true", ""))
    methods = [recording(runs)]

    def stop(done, total):
        if done >= total - 2:
            raise mph.Cancelled

    with pytest.raises(mph.Cancelled):
        judge(recipe, tmp_path, methods, stop)
    first, steps = len(runs), []
    judgement = judge(recipe, tmp_path, methods, lambda *step: steps.append(step))
    assert first > 0 and len(runs) == 6 + 2 * 2 + 1  # each event and level, two draws of one event twice, one picture
    assert steps[-1] == (2 * 6, 2 * 6)
    again = judge(recipe, tmp_path, methods)
    assert len(runs) == 6 + 2 * 2 + 2  # the picture alone
    assert again.rows == judgement.rows and again.tuning == judgement.tuning


def test_a_method_that_was_trained_on_the_test_is_refused(folder, tmp_path):
    events = mph.events.EventSet(folder / "rods")
    (folder / "tuned.toml").write_text((JUDGE + RODS_TEST).replace('"validation"', '"rods"'))
    trained = JudgedMethod("net", halved, "net-1", events_by_recipe(events[1:2]))
    for name, methods, words in (
        ("judge", [trained], "net: it was trained on events of the test rods: 1"),
        ("tuned", [], "baselines: it was trained on events of the test rods: 0, 1, 2"),
    ):
        recipe = read_judge_recipe(folder / f"{name}.toml")
        refused(lambda recipe=recipe, methods=methods: judge(recipe, tmp_path, methods), words)
    assert set_fingerprint(events) != set_fingerprint(events[:2])
    other = JudgedMethod("net", halved, "net-1", events_by_recipe(mph.events.EventSet(folder / "validation")))
    assert judge(short_recipe(folder), tmp_path, [other]).rows


def test_a_method_is_not_judged_on_the_truths_of_its_training_under_another_recipe(folder, tmp_path):
    trained_on = mph.events.EventSet(folder / "rods")
    truths = truths_of(trained_on[1:])
    assert len({*truths_of(trained_on)}) == 3
    for name, old, new, hits in (
        ("time", "time = 100", "time = 99", "1, 2"),
        ("seed", "seed = 5", "seed = 6", None),
        ("scanner", 'modules = "1-4,21-24"', 'modules = "1-3"', "1, 2"),
        ("voxels", "voxels = 16\nspacing = 6.0", "voxels = 12\nspacing = 8.0", "1, 2"),
        ("activity", "[radon]", "[augmentation]\nactivity = 1.5\n[radon]", "1, 2"),
        ("mirrored", "[radon]", "[augmentation]\nmirror = 1\n[radon]", None),
        ("radius", "radius = { from = 30", "radius = { from = 31", None),
        ("place", "from = -8", "from = -9", None),
    ):
        assert old in RODS
        mph.events.make(small_recipe(tmp_path / f"{name}-recipe", RODS.replace(old, new)), tmp_path / name, 3)
        events = mph.events.EventSet(tmp_path / name)
        assert not {*events_by_recipe(events)} & {*events_by_recipe(trained_on)}

        def check(events=events, name=name):
            refuse_trained_on("net", events_by_recipe(trained_on), truths, events, name)

        check() if hits is None else refused(check, f"net: it was trained on events of the test {name}: {hits}; judge")
        refuse_trained_on("old", events_by_recipe(trained_on), (), events, name)  # of models without truths


def test_volumes_are_the_same_truth_by_their_contents_whatever_their_files_are_called(tmp_path):
    truths = []
    for name, value in (("a", 1.0), ("b", 1.0), ("c", 2.0)):
        folder = tmp_path / name
        folder.mkdir()
        volume = mph.Volume(np.full((4, 4, 4), value, np.float32), mph.Grid.centered(4, 10.0), "activity")
        mph.write_volume(volume, folder / f"{name}.h5")
        recipe = small_recipe(folder, with_phantoms(f'[[phantoms]]\nfile = "{name}.h5"\n'))
        mph.events.make(recipe, folder / "set", 1)
        truths += truths_of(mph.events.EventSet(folder / "set"))
    assert truths[0] == truths[1] != truths[2]


def test_the_judge_refuses_methods_and_baselines_that_know_the_truths_of_a_test(folder, tmp_path):
    mph.events.make(small_recipe(tmp_path / "recipe", RODS.replace("time = 100", "time = 99")), tmp_path / "later", 3)
    for name in ("rods", "validation"):
        (tmp_path / name).symlink_to(folder / name)
    later = (JUDGE + SHORT_TEST).replace('events = "rods"', 'events = "later"')
    net = JudgedMethod("net", halved, "net-1", truths=truths_of(mph.events.EventSet(folder / "rods")))
    for who, text, methods in (("net", later, [net]), ("baselines", later.replace('"validation"', '"rods"'), [])):
        (tmp_path / "judge.toml").write_text(text)
        recipe = read_judge_recipe(tmp_path / "judge.toml")
        refused(
            lambda recipe=recipe, methods=methods: judge(recipe, tmp_path / "out", methods), f"{who}: it was trained on"
        )


def test_a_test_that_names_models_judges_those_only(folder, tmp_path):
    text = SHORT_TEST + 'models = ["half"]\n' + SHORT_TEST.replace('name = "rods"', 'name = "all"')
    rows = judge(short_recipe(folder, text), tmp_path, METHODS).rows
    judged = {name: [row["method"] for row in rows if row["test"] == name][1:] for name in ("rods", "all")}
    assert judged == {"rods": ["half"], "all": ["truth", "half"]}
    recipe = short_recipe(folder, SHORT_TEST + 'models = ["half", "third"]\n')
    refused(lambda: judge(recipe, tmp_path, METHODS), "rods: models 'third': expected one of truth, half")


def test_methods_are_told_the_physics_that_is_believed_and_scores_by_another_are_not_reused(folder, tmp_path):
    (event, *_) = mph.events.EventSet(folder / "rods")
    true, believed = (event.run(name, event.noise_seed) for name in ("emission", "believed"))
    runs, rows = [], []
    for text in ("", 'believed_model = "believed"\n', 'believed_model = "believed"\n'):
        rows.append(judge(short_recipe(folder, SHORT_TEST + text), tmp_path, [recording(runs)]).rows[1])
    # An event and its picture; the third time the picture alone.
    for run, belief in zip(runs, (true, true, believed, believed, believed), strict=True):
        np.testing.assert_array_equal(run.projections, true.projections)
        np.testing.assert_array_equal(run.background, belief.background)
        assert run.recipe.tables() == belief.recipe.tables()
    assert true.recipe.tables() != believed.recipe.tables()
    assert rows[0]["deviance"] != rows[1]["deviance"] and rows[1] == rows[2]


def test_methods_are_told_the_geometry_that_is_believed(folder, tmp_path):
    system = mph.events.EventSet(folder / "rods").system
    moved = mph.write_system(mph.read_system(WORKBOOK)[:24], tmp_path / "believed.xlsx")
    assert moved is not None and len(system) == 8
    recipe = short_recipe(folder, SHORT_TEST + f'believed = "{tmp_path / "believed.xlsx"}"\n')
    runs = []
    judge(recipe, tmp_path / "out", [recording(runs)])
    assert {run.workbook for run in runs} == {"believed.xlsx"}
    assert all(run.recipe["system.file"].endswith("believed.xlsx") and len(run.system) == 8 for run in runs)


def test_one_reconstruction_gives_all_stops_and_filters(folder):
    (event, *_) = mph.events.EventSet(folder / "rods")
    grid = mph.Grid.centered((12,) * 3, 8.0)
    family = Family("osem", grid, 3, 2, ((1, 0.0), (1, 10.0), (3, 0.0), (3, 10.0)))
    run = event.run("emission", 1)
    for choice, volume in zip(family.choices, family.volumes(run), strict=True):
        np.testing.assert_array_equal(family.method(choice).function(run).array, volume.array)
    assert family.method((3, 10.0)).name == "osem 3 x 2, 10 mm"
    assert family.method((3, 10.0)).fingerprint != family.method((1, 10.0)).fingerprint
    blob = np.zeros((12, 12, 12), np.float32)
    blob[6, 6, 6] = 1
    wide = smooth(blob, grid, 20.0)
    assert wide.sum() == pytest.approx(1, abs=0.02) and wide[6, 6, 7] / wide[6, 6, 6] == pytest.approx(0.66, abs=0.05)


@pytest.mark.parametrize(("old", "new", "message"), [
    ("version = 1", "version = 2", "version"),
    ('scoring = "rods"', 'scoring = "words"', "scoring: expected one of volumes"),
    ('events = "rods"', "", "events: missing"),
    ("spacing = 8.0", "", "grid.spacing: missing"),
    ("subsets = 2", "subset = 2", "baselines.subset: no such setting"),
    ('families = ["osem"]', 'families = ["fbp"]', "families: expected one of osem, bsrem"),
])  # fmt: skip
def test_entries_that_cannot_be_understood_are_named(folder, old, new, message):
    (folder / "wrong.toml").write_text((JUDGE + RODS_TEST).replace(old, new))
    refused(lambda: read_judge_recipe(folder / "wrong.toml"), message)


@pytest.mark.parametrize("name", SETS)
def test_every_set_reads_plans_and_stays_in_its_volume(name, tmp_path):
    (tmp_path / "set.toml").write_text(set_text(name, WORKBOOK), encoding="utf-8")
    recipe = mph.events.read_recipe(tmp_path / "set.toml")
    half = recipe.grid.spacing * recipe.grid.shape / 2
    for number in range(20):
        event = mph.events.plan(recipe, number)
        if name != "cardiac":  # the torso is larger than any volume of the heart
            points = np.concatenate([shape.position + np.zeros((1, 3)) for shape in event.phantom.shapes])
            assert np.all(np.linalg.norm(points, axis=1) < half.max())


def test_no_set_has_the_seed_of_another():
    assert len({mph.events.EventRecipe(set_text(name)).seed for name in SETS}) == len(SETS)


def test_every_event_of_the_pairs_has_one_altered_rod_and_one_left_out_had_neighbours():
    recipe = mph.events.EventRecipe(set_text("pairs"))
    drawn = set()
    for number in range(400):
        phantom = mph.events.plan(recipe, number).phantom
        site, rods = phantom.altered_site(), phantom.rods()
        apart = np.linalg.norm((rods[:, 1:3] - site[1:3])[rods[:, 0] == site[0]], axis=1) / site[3]
        assert (np.abs(apart - 2) < 1e-9).sum() == 2 if phantom.altered > 0 else apart.min() == 0
        drawn.add(phantom.altered)
    assert drawn == {*range(-6, 0), *range(1, 7)}


@pytest.mark.parametrize("name", ["osem", "bsrem"])
def test_the_best_choice_is_found_where_few_are_tried_on_all_events(name):
    grid, tried = mph.Grid.centered(4, 1.0), []
    truth = mph.Volume(np.ones(grid.shape, np.float32), grid, "activity")
    errors = np.random.default_rng(1).normal([3.0, 2.0, 1.1, 1.0, 2.0, 3.0], 0.1, (25, 6))

    class Known(Family):
        def volumes(self, run, threads=None):
            for choice in self.choices:
                tried.append(choice)
                yield mph.Volume(truth.array * (1 + errors[run, int(choice[0])]), grid, "activity")

    cases = [Case(None, run, grid, 0, {}) for run in range(25)]
    for case in cases:
        object.__setattr__(case, "truth", truth)
    best, means = tune(Known(name, grid, 1, 1, tuple((float(i),) for i in range(6))), cases), errors.mean(0)
    assert best["choice"] == [means.argmin()] and best["events"] == 25
    assert best["nrmse"] == pytest.approx(means.min(), rel=1e-5)
    assert len(tried) == (25 * 6 if name == "osem" else 10 * 6 + 15 * 3)
