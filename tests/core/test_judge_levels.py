"""Runs of events at fewer counts: their recipes make their images, and know the same activity."""

import numpy as np
import pytest

import mphdrr.core as mph

from .conftest import refused
from .small_events import TEXT, small_recipe

DECAYING = TEXT.replace("time = 100", 'time = 9000\nisotope = "Tc-99m"')


@pytest.mark.parametrize("text", [TEXT, DECAYING], ids=["stable", "decaying"])
def test_a_quarter_of_the_counts_is_of_the_same_activity(tmp_path, text):
    mph.events.make(small_recipe(tmp_path, text), tmp_path / "set", 1)
    (event,) = mph.events.EventSet(tmp_path / "set")
    whole, part = event.run("emission"), event.run("emission", level=0.25)
    np.testing.assert_allclose(part.projections, 0.25 * whole.projections, rtol=1e-6)
    np.testing.assert_allclose(part.background, 0.25 * np.asarray(whole.background))
    A = mph.projector_of_run(part, event.truth.grid)
    np.testing.assert_allclose(A(event.truth) + A.background, part.projections, rtol=1e-4, atol=1e-6)


def test_noise_at_a_level_is_that_of_its_images(small_set):
    event = mph.events.EventSet(small_set)[0]
    run = event.run("emission", 3, 0.25)
    np.testing.assert_array_equal(run.projections, event.images("emission", 3, 0.25))
    refused(lambda: event.run("lines", level=0.5), "only counts")
    refused(lambda: event.run("emission", level=0), "level")
