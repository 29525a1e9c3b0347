"""Efficiencies of pixels: A' = diag(e) A, dead pixels that say nothing, and floods that tell them."""

from __future__ import annotations

import json

import numpy as np
import pytest

import mphdrr.core as mph

from .conftest import BACKENDS, emission, refused, refused_command
from .small_events import TEXT, small_recipe
from .test_counting_times import BOTH, decays


@pytest.fixture
def few(system):
    return system[:5]


@pytest.fixture
def forms(few, rng):
    """Return one number, one for each of five modules, and images of 4 x 6 pixels, some of them dead."""
    images = rng.uniform(0.2, 1.8, (len(few), 4, 6))
    images[:, 1, 2] = 0
    images[3] = 0
    return 0.7, np.where(np.arange(len(few)) == 4, 0, rng.uniform(0.5, 1.5, len(few))), images


def each(values):
    values = np.asarray(values)
    return values[:, None, None] if values.ndim == 1 else values


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("hole", ["auto", "point"])
def test_the_projector_and_its_adjoint_are_weighted(few, forms, rng, backend, hole):
    if backend != "cpu" and hole == "auto":
        pytest.skip("numpy is slow, and torch takes the same kernels")
    grid, views = mph.Grid.centered(6, 60.0), few.views((4, 6), pitch=90.0)
    mu = mph.Volume(np.full((3, 3, 3), 0.01), grid.box([2, 2, 2], (3, 3, 3)), "mu")
    options = {"hole": hole, "mu": mu, "intrinsic_fwhm": 4.0, "pixel_points": 1 if hole == "point" else None}
    x, y = rng.uniform(0, 1, grid.shape), rng.uniform(0, 1, (len(few), 4, 6))
    bare = mph.Projector(grid, views, mph.Emission(few, **options), backend, double=True)
    assert bool(bare._close_parts) == (hole == "auto"), "rays project voxels close to pinholes, by the whole hole"
    for efficiency in forms:
        A = mph.Projector(grid, views, mph.Emission(few, efficiency=efficiency, **options), backend, double=True)
        np.testing.assert_allclose(A(x), each(efficiency) * bare(x), rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(A.T(y), bare.T(each(efficiency) * y), rtol=1e-9, atol=1e-12)
        assert np.vdot(A(x), y) == pytest.approx(np.vdot(x, A.T(y)), rel=1e-6)
        np.testing.assert_array_equal(A.living, np.broadcast_to(each(efficiency) > 0, y.shape))
    which = np.array([4, 0, 3])
    part = mph.Projector(grid, views[which], A.model.of_views(which), backend, double=True)
    np.testing.assert_allclose(part(x), A(x)[which], rtol=1e-6)
    for subset in A.subsets(3):
        np.testing.assert_allclose(subset(x), A(x)[subset.which], rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize("hole", ["auto", "point"])
def test_gradients_are_weighted(few, forms, rng, hole):
    torch = pytest.importorskip("torch")
    grid, views = mph.Grid.centered(7, 52.0), few.views((4, 6), pitch=90.0)
    mu = mph.Volume(np.full(grid.shape, 0.002), grid, "mu")
    options = {"hole": hole, "mu": mu, "intrinsic_fwhm": 4.0, "pixel_points": 1 if hole == "point" else None}
    x, y = (torch.tensor(rng.uniform(0, 1, shape)) for shape in (grid.shape, (len(few), 4, 6)))
    bare = mph.Projector(grid, views, mph.Emission(few, **options), "cpu", double=True)
    assert bool(bare._close_parts) == (hole == "auto")
    efficiency = forms[2]
    A = mph.Projector(grid, views, mph.Emission(few, efficiency=efficiency, **options), "cpu", double=True)

    def gradients(projector, weights):
        own = [x.clone().requires_grad_(), torch.tensor(mu.array, dtype=torch.float64).requires_grad_()]
        (projector(own[0], mu=own[1]) * weights).sum().backward()
        return [each.grad.numpy() for each in own]

    for found, expected in zip(gradients(A, y), gradients(bare, y * torch.tensor(efficiency)), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12 * np.abs(expected).max())
    # By central differences along a random direction, blur and voxels close to pinholes included.
    step = rng.uniform(-1, 1, grid.shape)

    def value(size):
        return float((A(x, mu=torch.tensor(mu.array + size * step)) * y).sum())

    slope = (value(1e-6) - value(-1e-6)) / 2e-6
    assert (gradients(A, y)[1] * step).sum() == pytest.approx(slope, rel=1e-5)


def test_the_geometrys_gradient_and_closed_forms_are_weighted(few, forms, rng):
    """By efficiencies, and by what decays during each module's time."""
    grid, views = mph.Grid.centered(6, 10.0), few.views((4, 6), "real")
    x, y, points = rng.uniform(0, 1, grid.shape), rng.uniform(0, 1, (len(few), 4, 6)), rng.uniform(-20, 20, (2, 3))
    tc = mph.isotope("Tc-99m")
    times = {name: values[:5] for name, values in BOTH.items()}
    cases = [({"efficiency": efficiency}, efficiency) for efficiency in forms]
    for changes, weights in (*cases, (times, decays(tc)[:5] / tc.mean_decay_time(1.0))):
        models = [mph.Emission(few, isotope=tc, intrinsic_fwhm=3.0, **given) for given in ({}, changes)]
        bare, A = (mph.Projector(grid, views, model, double=True) for model in models)
        gradients = mph.geometry_gradient(A, x, y), mph.geometry_gradient(bare, x, each(weights) * y)
        for gradient, expected in zip(*gradients, strict=True):
            np.testing.assert_allclose(gradient, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())
        plain, images = (mph.point_images(model, views, points) for model in models)
        np.testing.assert_allclose(images, each(weights) * plain, rtol=1e-12)


@pytest.fixture
def scan(system, rng):
    """Return grid, views and a volume that all modules see."""
    grid = mph.Grid.centered(6, 12.0)
    return grid, system.views((8, 8), "real"), rng.uniform(10, 50, grid.shape).astype(np.float32)


def test_dead_pixels_have_no_background(system, scan):
    grid, views, _ = scan
    efficiency = np.ones((12, 8, 8))
    efficiency[5], efficiency[:, 2, 2] = 0, 0
    for background in (2.0, np.arange(12.0), np.full((12, 8, 8), 3.0)):
        for value in (efficiency, efficiency.max(axis=(1, 2))):
            A = mph.Projector(grid, views, emission(system, time=600, background=background, efficiency=value))
            expected = np.where(np.broadcast_to(each(value), A.shape_out) > 0, each(background), 0)
            np.testing.assert_array_equal(A.background, expected)
            points = mph.point_images(A.model, views, [[0.0, 0.0, 0.0]], 0.0)
            np.testing.assert_allclose(points[0], expected)


def test_noise_free_mlem_returns_the_same_volume_with_any_efficiency_and_times(system, scan, rng):
    grid, views, truth = scan
    efficiency = rng.uniform(0.3, 1.7, (12, 8, 8))
    efficiency[rng.uniform(size=efficiency.shape) < 0.05] = 0
    for given in ({"efficiency": efficiency}, {"efficiency": rng.uniform(0.3, 1.7, 12)}, {"isotope": "Tc-99m", **BOTH}):
        A = mph.Projector(grid, views, emission(system, background=1.0, **({"time": 600} | given)))
        counts = np.where(A.living, A(truth) + A.background, 1e6)  # dead pixels may say anything
        for method in (mph.mlem, mph.osem, mph.bsrem):
            found = method(A, counts, 2, start=truth).volume.array
            np.testing.assert_allclose(found, truth, rtol=2e-4)
        for method in (mph.sirt, mph.cgls):
            found = method(A, counts, 2, start=truth)
            np.testing.assert_allclose(found.volume.array, truth, rtol=1e-3)
            assert found.objective[-1] < 1e-3
        assert mph.tv(A, counts, 1e-9, 2, start=truth).objective[-1] < 1e-3


def test_a_dead_module_is_one_that_is_not_there(system, scan, rng):
    grid, views, truth = scan
    alive = np.arange(12) != 5
    A = mph.Projector(grid, views, emission(system, time=600, background=1.0, efficiency=alive.astype(float)))
    B = mph.Projector(grid, views[alive], emission(system[alive], time=600, background=1.0))
    counts = mph.sample_counts(mph.Projector(grid, views, emission(system, time=600))(truth), 1)
    for method in (mph.mlem, mph.sirt, mph.cgls):
        found, expected = method(A, counts, 5), method(B, counts[alive], 5)
        np.testing.assert_allclose(found.volume.array, expected.volume.array, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(found.objective, expected.objective, rtol=1e-6)
    found, expected = mph.bsrem(A, counts, 3, 1), mph.bsrem(B, counts[alive], 3, 1)
    np.testing.assert_allclose(found.volume.array, expected.volume.array, rtol=1e-5)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"background": -0.5}, "background: expected 0 or more, got -0.5"),
        ({"background": np.nan}, "background: nan is not a finite number"),
        ({"background": "much"}, "background: expected real numbers, got str 'much'"),
        ({"background": np.ones(5)}, "background: expected one number, 12 numbers .one for .*, or 12 images, got 5"),
        ({"background": np.ones((12, 4))}, "background: .* got 12 x 4"),
        ({"background": np.ones((3, 4, 6))}, "background: .* got 3 x 4 x 6"),
        ({"efficiency": -0.5}, "efficiency: expected 0 or more, got -0.5"),
        ({"efficiency": np.inf}, "efficiency: inf is not a finite number"),
        ({"efficiency": np.ones(5)}, "efficiency: expected one number, 12 numbers"),
        ({"efficiency": np.ones((3, 4, 6))}, "efficiency: .* got 3 x 4 x 6"),
        ({"time": [1.0] * 11}, "time: expected one number, or 12 numbers .one for each view., got 11"),
        ({"time": [1.0] * 11 + [0.0]}, "time: expected more than 0 s, got 0"),
        ({"start": [np.nan] * 12}, "start: nan is not a finite number"),
        ({"start": np.zeros((12, 2))}, "start: expected one number, or 12 numbers .*got 12 x 2"),
    ],
)
def test_what_is_no_background_efficiency_or_time_is_refused(system, given, said):
    refused(lambda: mph.Emission(system, **given), said)


SMALL = {
    "phantom.text": "[[shape]]\nkind = 'sphere'\nradius = 30\nactivity = 5\n", "phantom.voxels": 8, "model.kind": "emission",
    "model.time": 30.0, "detector.plane": "real", "detector.rows": 4, "detector.columns": 6, "model.background": 1.0,
}  # fmt: skip


def test_recipes_have_it_as_numbers_or_in_files(few, forms, tmp_path):
    (plain,) = mph.run_recipe(mph.Recipe(SMALL | {"model.background": 0.0}), few)
    np.save(tmp_path / "e.npy", forms[2])
    np.savez(tmp_path / "e.npz", efficiency=forms[2], other=np.ones(3))
    np.save(tmp_path / "of_modules.npy", forms[1])
    (tmp_path / "study.toml").write_text('[model]\nkind = "emission"\nefficiency = "e.npy"\n')
    assert mph.read_recipe(tmp_path / "study.toml")["model.efficiency"] == str(tmp_path / "e.npy")
    text = ", ".join(map(str, forms[1]))
    for given, expected in (
        (0.7, forms[0]), (list(forms[1]), forms[1]), (text, forms[1]), (str(tmp_path / "e.npy"), forms[2]),
        (str(tmp_path / "e.npz"), forms[2]), (str(tmp_path / "of_modules.npy"), forms[1]),
    ):  # fmt: skip
        recipe = mph.Recipe(SMALL | {"model.efficiency": given, "noise.seed": 3})
        (noisy,) = mph.run_recipe(recipe, few)
        mean = each(expected) * plain.projections + (each(expected) > 0)
        (run,) = mph.run_recipe(recipe.updated({"noise.seed": None}), few)
        np.testing.assert_allclose(run.projections, mean, rtol=1e-5)
        np.testing.assert_array_equal(noisy.projections, mph.sample_counts(run.projections, 3))
        for suffix in (".h5", ".npz"):
            mph.write_run(run, tmp_path / f"run{suffix}")
            again = mph.read_run(tmp_path / f"run{suffix}")
            np.testing.assert_allclose(again.efficiency, expected, rtol=1e-6)
    (tmp_path / "of_modules.npy").unlink()  # runs have their own
    A = mph.projector_of_run(again, run.volume.grid)
    np.testing.assert_allclose(A(run.volume) + A.background, run.projections, rtol=1e-5)
    refusals = [(bad, "model.efficiency: expected a") for bad in ([], ["a.npy", 1.0], "much", [-1.0, 2.0])]
    refusals += [(str(tmp_path / "of_modules.npy"), "of_modules.npy: no such file")]
    for bad, words in (*refusals, ([1.0] * 4, "efficiency: expected one number, 3 numbers")):
        refused(lambda bad=bad: next(mph.run_recipe(mph.Recipe(SMALL | {"model.efficiency": bad}), few[:3])), words)


def test_line_integrals_of_runs_know_it(few, forms):
    runs = [next(mph.run_recipe(mph.Recipe(SMALL | {"model.efficiency": e}), few)) for e in (1.0, list(forms[1]))]
    plain, found = (mph.run_line_integrals(run) for run in runs)
    np.testing.assert_allclose(found, np.where(each(forms[1]) > 0, plain, 0), rtol=1e-4, atol=1e-4 * plain.max())


MODELS = """[models.plain]
kind = "emission"
[models.counts]
kind = "emission"
isotope = "Tc-99m"
efficiency = "e.npy"
time = [10.0, 20.0, 30.0]
start = [0.0, 100.0, 200.0]
background = 0.5
"""


def test_events_have_it(tmp_path):
    np.save(tmp_path / "e.npy", np.linspace(0, 2, 3))
    text = TEXT[: TEXT.index("[models.lines]")].replace('"1-4,21-24"', '"1-3"') + MODELS
    mph.events.make(small_recipe(tmp_path, text), tmp_path / "set", 1)
    (tmp_path / "e.npy").unlink()
    (event,) = mph.events.EventSet(tmp_path / "set")
    plain, counts = event.images("plain"), event.images("counts")
    assert not counts[0].any() and counts[1:].min() > 0.49
    run = event.run("counts", level=0.25)
    np.testing.assert_allclose(run.efficiency, [0, 1, 2])
    tc = mph.isotope("Tc-99m")
    whole = [tc.mean_decay_time(t) for t in (10, 20, 30)]
    np.testing.assert_allclose([tc.mean_decay_time(t) for t in run.recipe["model.time"]], np.array(whole) / 4)
    A = mph.projector_of_run(run, run.volume.grid)
    np.testing.assert_allclose(A(run.volume) + A.background, counts / 4, rtol=1e-4, atol=1e-6)
    assert plain[0].any()


def flood(rng, mean=1000.0, modules=4, n=40, spread=0.04):
    """Return counts of an even source near a corner, on a crystal that sees less at its edges, and the efficiencies."""
    v, u = np.meshgrid(*[np.linspace(-1, 1, n)] * 2, indexing="ij")
    own = np.clip(rng.normal(1, spread, (modules, n, n)), 0.5, 1.5)
    return mean * (1 + 0.15 * u - 0.1 * v) * (1 - 0.2 * (u**2 + v**2)) * own, own


def test_a_flood_tells_efficiencies_and_planted_pixels(rng):
    mean, own = flood(rng)
    dead, hot = rng.choice(mean[:3].size, (2, 15), replace=False).reshape(2, -1)
    mean[:3].flat[dead[:5]], mean[3] = 0, 0
    mean[:3].flat[dead[5:]] *= 0.5 / own[:3].flat[dead[5:]]
    mean[:3].flat[hot] *= np.linspace(2, 100, len(hot))
    found = mph.flood_efficiency(rng.poisson(mean))
    for places, planted in ((found.dead, dead), (found.hot, hot)):
        assert set(np.ravel_multi_index(places.T, mean.shape)) == set(planted.tolist())
        np.testing.assert_array_equal(found.efficiency[tuple(places.T)], 0)
    assert found.dead_modules.tolist() == [3] and not found.efficiency[3].any()
    assert found.spread == pytest.approx(0.04, abs=0.006)
    for m in range(3):
        lives = found.efficiency[m] > 0
        assert found.efficiency[m][lives].mean() == pytest.approx(1.0)
        off = found.efficiency[m][lives] / (own[m][lives] / own[m][lives].mean()) - 1
        assert off.std() < 1.15 / np.sqrt(700) and abs(off.mean()) < 0.005
    assert str(found).startswith("4 modules of 40 x 40 pixels: 15 dead and 15 hot pixels, 1 dead modules; others vary")


@pytest.mark.parametrize("mean", [100.0, 3000.0])
def test_an_even_flood_has_no_dead_pixels(rng, mean):
    found = mph.flood_efficiency(rng.poisson(mean, (25, 64, 64)))
    assert not len(found.dead) and not len(found.hot) and not len(found.dead_modules)


def test_what_is_no_flood_is_refused_and_too_few_counts_are_said(rng):
    refused(lambda: mph.flood_efficiency(-np.ones((1, 4, 4))), "flood: expected counts, 0 or more, got -1")
    refused(lambda: mph.flood_efficiency(np.ones((4, 4))), "flood: expected shape any x any x any")
    refused(lambda: mph.flood_efficiency(np.ones((1, 4, 4)), -1), "smooth_order")
    with pytest.warns(mph.InputWarning, match="too few to tell dead pixels"):
        mph.flood_efficiency(np.full((1, 8, 8), 3))
    assert mph.flood_efficiency(np.zeros((2, 4, 4))).dead_modules.tolist() == [0, 1]


def test_the_command_writes_what_recipes_read(workbook, rng, tmp_path, command):
    mean, _ = flood(rng, modules=3, n=16)
    mean[1, 3, 4], mean[2, 5, 6] = 0, 1e5
    np.save(tmp_path / "flood.npy", rng.poisson(mean).astype(np.int32))
    said = ["--modules", "2-4", "--frames", "4,3,2", "--orientation", "back-v", "--time", "60"]
    run = tmp_path / "flood.h5"
    command("project", workbook, "--counts", tmp_path / "flood.npy", *said, "-o", run)
    printed = command("counts", "flood", run, "-o", tmp_path / "e.npy").out
    assert "dead: 3/4/5\n" in printed and "hot: 2/6/7\n" in printed
    answer = command("counts", "flood", run, "-o", tmp_path / "again.npy", "--json").out
    assert json.loads(answer)["dead"] == [[3, 4, 5]]
    options = ["--modules", "2-4", "--emission", "--size", "16", "16", "--voxels", "8", "--detector", "real"]
    command("project", workbook, *options, "--efficiency", tmp_path / "e.npy", "-o", tmp_path / "run.h5")
    found = mph.read_run(tmp_path / "run.h5")
    assert found.efficiency[1, 3, 4] == found.efficiency[0, 5, 6] == 0 and found.projections[1, 3, 4] == 0


def test_floods_whose_modules_and_orientation_nobody_said_are_refused(tmp_path, capsys):
    """Another program's frames: a flood must be imported first."""
    (tmp_path / "flood.dcm").write_bytes(b"")
    said = refused_command(capsys, "counts", "flood", tmp_path / "flood.dcm", "-o", tmp_path / "e.npy")
    assert "expected a name ending in .h5" in said
