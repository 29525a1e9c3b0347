"""Differences of runs: their numbers and colours, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.runs.comparing import difference, difference_sheet
from mphdrr.core.runs.run import ProjectionRun


@pytest.fixture
def run() -> ProjectionRun:
    angle = np.radians([0.0, 70.0, 150.0])
    centers = 200 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    system = mph.PinholeSystem(centers, 2.3, 50.0, 50.0, 10.0, 70.0)
    volume = mph.Volume(np.zeros((2, 2, 2)), mph.Grid.centered(2, 5.0), "activity")
    images = np.random.default_rng(1).integers(1, 9, (3, 70, 80)).astype(np.float32)
    return ProjectionRun(images, system, system.views((70, 80)), volume, unit="counts")


def test_numbers_of_a_difference_are_those_of_its_pixels(run):
    more = np.zeros(run.projections.shape, np.float32)
    more[1, 20, 30], more[2, 5, 6] = 2.0, -3.5
    found = difference(replace(run, projections=run.projections + more), run)
    np.testing.assert_allclose(found.images, more, atol=1e-6)
    rms = np.sqrt((2.0**2 + 3.5**2) / more.size)
    assert found.maximum == pytest.approx(3.5) and found.rms == pytest.approx(rms)
    assert found.relative == pytest.approx(rms / np.sqrt(np.mean(run.projections.astype(float) ** 2)))
    assert found.text.startswith("maximum 3.5, rms ") and "counts, relative" in found.text


def test_zero_is_white_more_is_red_less_is_blue_and_the_bars_ends_are_the_maximum(run):
    more = np.zeros(run.projections.shape, np.float32)
    more[1, :35], more[2] = 4.0, -1.0
    drawn = difference_sheet(run, difference(replace(run, projections=run.projections + more), run))
    assert drawn.window == (-4.0, 4.0)

    def color(m: int, row: int) -> list[int]:
        top, left = drawn.corners[m]
        larger = drawn.tile[0] // more.shape[1]
        return drawn.picture[top + larger * row, left + larger * 60].astype(int).tolist()

    assert min(color(0, 30)) > 235 and np.ptp(color(0, 30)) < 8
    red, _, blue = color(1, 50)  # v points up in pictures
    assert red > blue + 60
    red, _, blue = color(2, 50)
    assert blue > red + 60


def test_equal_runs_differ_by_nothing(run):
    found = difference(run, run)
    assert (found.maximum, found.rms, found.relative) == (0, 0, 0)
    assert difference_sheet(run, found).picture.any()


def test_runs_of_other_images_are_refused(run):
    others = {
        "unit: counts, and photons": replace(run, unit="photons"),
        "pixels: 80 x 70, and 8 x 7": replace(run, projections=run.projections[:, :7, :8], views=run.system.views((7, 8))),
        "modules: 3 modules, and 2 modules": replace(
            run, projections=run.projections[:2], system=run.system[:2], views=run.system[:2].views((70, 80))
        ),
        "their numbers differ": replace(run, system=replace(run.system, numbers=np.array([1, 2, 4]))),
    }  # fmt: skip
    for said, other in others.items():
        with pytest.raises(mph.InputError, match=f"cannot compare runs of different .*{said}"):
            difference(run, other)
