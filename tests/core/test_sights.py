"""Where slices lie, and how bright colours reach."""

from __future__ import annotations

import numpy as np

from mphdrr.core.volumes.sights import bright_value, full_slices


def test_slices_go_through_what_there_is_and_follow_it(rng):
    values = 0.01 * rng.random((20, 16, 12))
    values[15:18, 3, 2] = 5.0
    at = full_slices(values)
    assert 15 <= at[0] <= 17 and at[1:].tolist() == [3, 2]
    assert full_slices(values.transpose(2, 0, 1)).tolist() == at[[2, 0, 1]].tolist()
    assert full_slices(np.ones((9, 8, 7))).tolist() == [4, 4, 3], "the middle where all are alike"
    assert full_slices(np.zeros((4, 4, 4))).tolist() == [2, 2, 2]


def test_a_hot_voxel_does_not_say_how_bright_the_others_are(rng):
    values = np.where(rng.random((30, 30, 30)) < 0.05, 100.0, 0.0)
    assert bright_value(values) == 100.0
    values[4, 5, 6] = 1e3
    assert bright_value(values) == 100.0
    assert bright_value(3 * values) == 300.0
    point = np.zeros((30, 30, 30))
    point[3, 3, 3] = 7.0
    assert bright_value(point) == 7.0 and bright_value(-point) == bright_value(0 * point) == 0.0
