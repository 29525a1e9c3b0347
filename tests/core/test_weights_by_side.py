"""A weight that differs from side to side: photons of one side keep it, by rays and by depth."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import mphdrr.core as mph

from .conftest import WORKBOOK, needs_torch

SYSTEM = mph.read_system(WORKBOOK)[[3, 47]]
_SIDES = [(1, 1), (1, -1), (-1, 1), (-1, -1)]


@dataclasses.dataclass(frozen=True, eq=False)
class Lopsided(mph.Emission):
    """Counts three times as many of the photons that come from the side u > 0 of a module's axis."""

    def pixel_weights(self, m, along_u, along_v, *others):
        return super().pixel_weights(m, along_u, along_v, *others) * (1 + 2 * (along_u > 0))


def one_voxel(m, side_u, side_v):
    """Return a voxel of 2 mm in the plane of the isocentre, 15 mm along u and 20 mm along v beside module m's axis."""
    u, v, k = SYSTEM.frames()[m]
    place = SYSTEM.centers[m] + float(SYSTEM.pinhole_distance[m]) * k + 15 * side_u * u + 20 * side_v * v
    affine = np.diag([2.0, 2.0, 2.0, 1.0])
    affine[:3, 3] = place
    return mph.Volume(np.ones((1, 1, 1), np.float32), mph.Grid((1, 1, 1), affine), "activity")


@pytest.mark.parametrize("backend", ["numpy", "cpu", pytest.param("torch", marks=needs_torch)])
@pytest.mark.parametrize("hole", ["rays", "depth"])
@pytest.mark.parametrize("m", [0, 1])
def test_a_weight_three_times_larger_at_u_above_0_triples_the_photons_from_there(hole, m, backend):
    for side_u, side_v in _SIDES:
        volume = one_voxel(m, side_u, side_v)
        images = [
            mph.Projector(volume.grid, SYSTEM.views((64, 64)), model(SYSTEM, hole=hole), backend)(volume.array)[m]
            for model in (mph.Emission, Lopsided)
        ]
        assert images[0].sum() > 0
        np.testing.assert_allclose(images[1], (3 if side_u > 0 else 1) * images[0], rtol=1e-5, atol=0)
