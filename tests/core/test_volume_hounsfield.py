"""CT numbers to attenuation: the fixed points of the bilinear curve, at any energy, and values beyond it."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.physics.materials import WATER_MU, attenuation

from .conftest import refused

GRID = mph.Grid((7, 1, 1), np.eye(4))


def converted(hu, **options) -> np.ndarray:
    grid = mph.Grid((1, 1, len(hu)), np.eye(4))
    return mph.hu_to_mu(mph.Volume(np.reshape(hu, grid.shape), grid, "hu"), **options).array.ravel()


@pytest.mark.parametrize("energy", [30.0, 70.8, 140.5, 159.0, 511.0])
@pytest.mark.parametrize("ct_energy", [60.0, 70.0, 85.0])
def test_air_water_and_bone_keep_their_coefficients(energy, ct_energy):
    water, bone = (attenuation(name, ct_energy) for name in ("water", "bone"))
    bone_hu = 1000 * (bone - water) / water
    mu = converted([-1000, 0, bone_hu], energy=energy, ct_energy=ct_energy)
    assert mu == pytest.approx([attenuation(name, energy) for name in ("air", "water", "bone")], rel=1e-5)


def test_the_curve_bends_once_and_never_falls():
    hu = np.linspace(-1000, 3000, 4001)
    for energy in (30.0, 70.8, 140.5, 511.0):
        slope = np.diff(converted(hu, energy=energy).astype(np.float64))
        assert slope[:999] == pytest.approx(slope[500], rel=1e-2)
        assert slope[1001:] == pytest.approx(slope[2500], rel=1e-2)
        assert slope.min() > 0
    # At the CT's own energy the curve is the definition of CT numbers, to air's coefficient.
    water = attenuation("water", 70.0)
    assert converted(hu, energy=70.0) == pytest.approx(water * (1 + hu / 1000), abs=3e-3 * water)
    assert converted([0])[0] == pytest.approx(WATER_MU, rel=5e-3)


def test_padding_is_air_and_metal_is_said():
    with pytest.warns(mph.InputWarning) as warned:
        mu = converted([-3024, -1024, -1000, 40, 8000])
    assert mu[0] == mu[1] == mu[2] == np.float32(attenuation("air", 140.5))
    assert mu[4] > converted([3000])[0]
    assert [text.message.args[0].split(":")[0] for text in warned] == [
        "20.00% of the voxels are below -1024 HU",
        "20.00% of the voxels are above 3071 HU, as of metal",
    ]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        converted([-1024, 3071])


def test_only_ct_numbers_at_sensible_energies_are_converted():
    zeros = np.zeros(GRID.shape)
    refused(lambda: mph.hu_to_mu(mph.Volume(zeros, GRID, "mu")), "expected a volume of hu, got mu")
    for energy in (0.5, 2000, -1, np.nan, "Tc"):
        refused(lambda energy=energy: mph.hu_to_mu(mph.Volume(zeros, GRID, "hu"), energy), "energy")


def test_density_of_diffdrr():
    hu = np.array([-1000, -900, -700, 0, 300, 1000], np.float32)
    density = mph.diffdrr_density(hu, 2.0)
    assert density == pytest.approx((np.array([-700, -700, -700, 0, 300, 2000]) + 700) / 2700)
    volume = mph.Volume(hu.reshape(6, 1, 1), mph.Grid((6, 1, 1), np.eye(4)), "hu")
    assert np.array_equal(mph.diffdrr_density(volume, 2.0).ravel(), density)
    assert np.array_equal(mph.diffdrr_density(np.full(3, 40.0)), np.zeros(3))
    for given, factor, message in (
        (None, 1.0, "CT numbers"),
        ([np.nan], 1.0, "CT numbers"),
        ([[1], [1, 2]], 1.0, "CT numbers: expected real numbers"),
        ([], 1.0, "CT numbers: expected at least one"),
        (hu, "x", "bone_attenuation"),
    ):
        refused(lambda given=given, factor=factor: mph.diffdrr_density(given, factor), message)


def test_density_is_the_same_for_tensors(rng):
    torch = pytest.importorskip("torch", reason="torch is not installed")
    from mphdrr.core.exchange.diffdrr import hu_to_density

    hu = rng.uniform(-1000, 3000, (3, 4, 5)).astype(np.float32)
    assert np.allclose(hu_to_density(torch.tensor(hu), 3.0).numpy(), mph.diffdrr_density(hu, 3.0), atol=1e-6)


@pytest.mark.parametrize("outside", [-1000.0, -1024.0, -3024.0])
def test_ct_numbers_that_are_projected_are_warned_of(system, outside):
    grid = mph.Grid.centered((20, 30, 9), 5.0)
    numbers = np.full(grid.shape, outside)
    numbers[4:16, 6:24] = 40.0
    A = mph.Projector(grid, system[:2].views(shape=(2, 2)))
    for project in (A, lambda x: A(x[None]), lambda x: A(mph.Volume(x, grid, "mu"))):
        with pytest.warns(mph.InputWarning, match="those of air in CT numbers; convert its CT numbers first") as said:
            project(numbers)
        assert said[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        A(np.random.default_rng(0).normal(0, 1000, grid.shape))
        A(-numbers)
        A(np.zeros((0, *grid.shape)))
