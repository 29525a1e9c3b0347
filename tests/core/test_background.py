"""Scatter and dark counts: in runs and reconstructions, outside the linear projector."""

import numpy as np
import pytest

import mphdrr.core as mph

from .conftest import emission, refused


@pytest.fixture
def forms(system, rng):
    """Return a background as one number, as one for each module, and as images of 4 x 6 pixels."""
    return 2.5, rng.uniform(0, 5, len(system)), rng.uniform(0, 5, (len(system), 4, 6))


def images_of(background, shape):
    values = np.asarray(background)
    return np.broadcast_to(values[:, None, None] if values.ndim == 1 else values, shape)


def test_the_projector_stays_linear_and_knows_its_background(system, forms):
    grid, views = mph.Grid.centered(8, 10.0), system.views((4, 6), pitch=90.0)
    x = np.ones(grid.shape)
    bare = mph.Projector(grid, views, emission(system))
    for background in forms:
        A = mph.Projector(grid, views, emission(system, background=background))
        np.testing.assert_array_equal(A(x), bare(x))
        np.testing.assert_array_equal(A(np.zeros(grid.shape)), 0)
        np.testing.assert_array_equal(A.background, images_of(background, A.shape_out))
    assert not bare.background.any() and bare.background.shape == bare.shape_out
    assert not mph.Projector(grid, views).background.any()


def test_parts_of_the_views_have_their_part(system, forms):
    grid, views = mph.Grid.centered(4, 10.0), system.views((4, 6))
    for background in forms:
        A = mph.Projector(grid, views, emission(system, background=background))
        parts = A.subsets(3)
        assert sum(part.background.sum() for part in parts) == pytest.approx(A.background.sum())
        which = np.array([7, 2])
        part = mph.Projector(grid, views[which], A.model.of_views(which))
        np.testing.assert_array_equal(part.background, A.background[which])
    wrong = r"background: .* 12 images of 8 x 8, got 12 x 4 x 6"
    refused(lambda: mph.Projector(grid, system.views((8, 8)), A.model), wrong)


def test_runs_add_it_before_the_noise_and_keep_it(system, forms, tmp_path):
    volume = mph.Volume(np.full((8, 8, 8), 5.0), mph.Grid.centered(8, 10.0), "activity")
    options = {"shape": (4, 6), "pitch": 5.0}
    bare = mph.project_run(system, volume, model=emission(system, time=60), **options)
    for background in forms:
        model = emission(system, time=60, background=background)
        run = mph.project_run(system, volume, model=model, **options)
        expected = bare.projections + images_of(background, bare.projections.shape)
        np.testing.assert_allclose(run.projections, expected, rtol=1e-6)
        noisy = mph.project_run(system, volume, model=model, noise_seed=3, **options)
        np.testing.assert_array_equal(noisy.projections, mph.sample_counts(run.projections, 3))
        for suffix in (".h5", ".npz"):
            mph.write_run(noisy, tmp_path / f"a{suffix}")
            again = mph.read_run(tmp_path / f"a{suffix}").background
            np.testing.assert_array_equal(again, background)
            assert isinstance(again, float) == isinstance(background, float)
    mph.write_run(bare, tmp_path / "bare.h5")
    assert mph.read_run(tmp_path / "bare.h5").background == 0.0


def test_a_reconstruction_expects_the_models_background(system, rng):
    grid, views = mph.Grid.centered(6, 12.0), system.views((8, 8))
    per_module = np.linspace(0.5, 3.0, len(system))
    bare = mph.Projector(grid, views, emission(system, time=600))
    A = mph.Projector(grid, views, emission(system, time=600, background=per_module))
    truth = rng.uniform(10, 50, grid.shape).astype(np.float32)
    counts = A(truth) + A.background
    np.testing.assert_allclose(mph.mlem(A, counts, 2, start=truth).volume.array, truth, rtol=1e-5)
    by_model, by_argument = mph.osem(A, counts, 2, 3), mph.osem(bare, counts, 2, 3, background=per_module)
    np.testing.assert_allclose(by_model.volume.array, by_argument.volume.array, rtol=1e-5)
    both = mph.mlem(A, counts + 1.0, 2, background=1.0, start=truth)
    np.testing.assert_allclose(both.volume.array, truth, rtol=1e-5)


def test_recipes_have_it(system):
    volume = mph.Volume(np.zeros((4, 4, 4)), mph.Grid.centered(4, 10.0), "activity")
    given = {"model.kind": "emission", "model.background": 1.5, "detector.rows": 3, "detector.columns": 4}
    (run,) = mph.run_recipe(mph.Recipe(given), system, volume)
    assert (run.projections == 1.5).all() and run.background == 1.5 and run.recipe["model.background"] == 1.5
    assert run.settings["background"] == 1.5
    refused(
        lambda: mph.Recipe({"model.background": 1.5}), "model.background (--background-counts) needs model.kind = em"
    )
    with pytest.raises(mph.InputError, match=r"model.background: expected a number of 0 or more"):
        mph.Recipe({"model.kind": "emission", "model.background": -1.5})
