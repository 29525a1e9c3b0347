"""Absorbed dose: electrons, photons in spheres and in voxels, against closed forms and published voxel S-values."""

import math

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.xray.coefficients import energy_absorption
from mphdrr.core.xray.dose import build_up_factor, convolve, line_kernel, voxel_kernel

from .absorbed_photons import absorbed_within, klein_nishina, scattered_share
from .conftest import refused


def uniform(kbq=1000.0, shape=6, spacing=4.0):
    grid = mph.Grid.centered(shape, spacing)
    return mph.Volume(np.full(grid.shape, kbq), grid)


def test_electrons_of_lutetium_in_water():
    rate = mph.absorbed_dose_rate(uniform(), "Lu-177", photons="none")
    assert rate.quantity == "dose_rate" and rate.unit == "mGy/h"
    np.testing.assert_allclose(rate.array, 85.3, rtol=5e-3)  # 1 MBq/mL, 0.1479 MeV per decay
    denser = mph.absorbed_dose_rate(uniform(), "Lu-177", density=1.5, photons="none")
    np.testing.assert_allclose(denser.array, rate.array / 1.5, rtol=1e-6)


@pytest.mark.parametrize(
    # ICRP 107, table of energies: electrons and photons, MeV per decay.
    ("isotope", "electrons", "photons"),
    [("Tc-99m", 0.0162, 0.1266), ("I-123", 0.0282, 0.1730), ("I-131", 0.1918, 0.3828), ("Lu-177", 0.1479, 0.0351)],
)
def test_decays_set_the_energies_of_icrp_107_free(isotope, electrons, photons):
    nuclide = mph.isotope(isotope)
    assert nuclide.electrons / 1000 == pytest.approx(electrons, rel=3e-3)
    total = nuclide.soft_photons + sum(energy * share for energy, share in nuclide.lines + nuclide.weak_lines)
    assert total / 1000 == pytest.approx(photons, rel=3e-3)


@pytest.mark.parametrize("name", mph.ISOTOPES)
def test_every_isotope_has_a_dose(name):
    """In a large body nearly all energy stays: electrons, soft photons and lines, of 1 kBq in each mm^3 of 1 mg."""
    nuclide = mph.isotope(name)
    energy = nuclide.electrons + nuclide.soft_photons
    energy += sum(energy * photons for energy, photons in nuclide.lines + nuclide.weak_lines)
    rate = mph.absorbed_dose_rate(uniform(shape=24, spacing=80.0), name).array[12, 12, 12]
    assert rate == pytest.approx(1000 * energy * 1.602176634e-16 * 1e3 * 3600 * 1e6, rel=0.05)


def kernel_within(energy, radii, build_up=True, density=1.0):
    """Return the shares of a photon's energy that the point kernel has within radii, mm."""
    r = np.concatenate([[0], np.geomspace(1e-3, 5000, 20000)])
    along = line_kernel(((energy, 1.0),), density, r, build_up) * density / energy
    return np.interp(radii, r[1:], np.cumsum((along[1:] + along[:-1]) / 2 * np.diff(r)))


@pytest.mark.parametrize("energy", [15.0, 30.0, 60.0, 140.5, 208.4, 364.5, 637.0])
def test_a_large_medium_absorbs_the_whole_energy(energy):
    for build_up in (False, True):
        assert kernel_within(energy, 5000, build_up) == pytest.approx(1, rel=1e-3)
    np.testing.assert_allclose(
        kernel_within(energy, [50, 100], density=2.0), kernel_within(energy, [100, 200]), rtol=1e-4
    )


@pytest.mark.parametrize("energy", [60.0, 140.5, 208.4, 364.5])
def test_the_dose_around_a_point_is_that_of_photons_one_by_one(energy):
    radii = np.array([80.0, 120.0, 160.0, 200.0])
    traced = absorbed_within(energy, radii, 60_000)
    np.testing.assert_allclose(kernel_within(energy, radii), traced, rtol=0.02)


@pytest.mark.long
@pytest.mark.parametrize("energy", [30.0, 40.0, 60.0, 80.0, 100.0, 140.5, 159.0, 208.4, 300.0, 364.5, 511.0, 700.0])
def test_the_dose_around_a_point_is_that_of_photons_one_by_one_at_all_energies(energy):
    radii = np.array([20.0, 40.0, 80.0, 120.0, 160.0, 200.0])
    traced = np.mean([absorbed_within(energy, radii, 250_000, seed) for seed in range(4)], axis=0)
    np.testing.assert_allclose(kernel_within(energy, radii), traced, rtol=0.02)


def test_photons_one_by_one_scatter_by_klein_nishina():
    """The traced photons' own laws: cross-section (NIST XCOM, bound electrons, at 100 and 500 keV) and energy after it."""
    assert klein_nishina(np.array([100.0, 500.0])) == pytest.approx([0.1626, 0.09663], rel=0.02)
    rng, energy = np.random.default_rng(1), 140.5
    cosine = np.linspace(-1, 1, 20001)
    share = 1 / (1 + energy / 510.999 * (1 - cosine))
    law = share**2 * (share + 1 / share - 1 + cosine**2)
    mean = np.average(share, weights=law)
    drawn = scattered_share(np.full(200_000, energy), rng)
    assert drawn.mean() == pytest.approx(mean, rel=1e-3)
    assert drawn.std() == pytest.approx(np.sqrt(np.average((share - mean) ** 2, weights=law)), rel=1e-2)


def test_build_up_factors_are_those_of_the_standard():
    """ANSI/ANS-6.4.3, water, exposure, at 1 mean free path: its coefficient b, by definition; it grows from 1."""
    for energy, b in ((60.0, 4.983), (100.0, 4.663), (500.0, 2.500)):
        assert build_up_factor(energy, np.array([0.0, 1.0])) == pytest.approx([1.0, b], rel=1e-3)


@pytest.mark.parametrize(("energy", "radius"), [(60.0, 60.0), (140.5, 60.0), (364.5, 60.0), (140.5, 100.0)])
def test_a_sphere_absorbs_the_share_of_the_closed_form(energy, radius):
    n, parts = 26, 4
    grid = mph.Grid.centered(n, radius / 11)
    x = ((np.arange(n * parts) + 0.5) / parts - n / 2) * radius / 11
    inside = x[:, None, None] ** 2 + x[None, :, None] ** 2 + x**2 <= radius**2
    share = inside.reshape(n, parts, n, parts, n, parts).mean(axis=(1, 3, 5))
    kernel = voxel_kernel(grid, lambda r: line_kernel(((energy, 1.0),), 1.0, r, False))
    absorbed = (convolve(share, kernel) * share).sum() * grid.voxel_volume / energy / share.sum()
    x = radius * float(energy_absorption("water", np.array([energy]))[0]) / 10
    expected = 1 - 3 / (8 * x**3) * (2 * x**2 - 1 + (1 + 2 * x) * math.exp(-2 * x))
    assert absorbed == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize(
    # N. Lanconelli et al., Physics in Medicine and Biology 57 (2012) 517-533, and medphys.it: soft tissue, mGy/(MBq s).
    # Farther than electrons go, which are absorbed here where they are set free; voxels' sides in mm.
    ("isotope", "side", "published"),
    [
        ("Lu-177", 2.21, {"003": 3.24e-5, "113": 2.65e-5, "222": 2.42e-5, "005": 1.18e-5, "555": 3.98e-6}),
        ("Lu-177", 4.8, {"002": 1.61e-5, "113": 5.93e-6, "222": 5.44e-6, "005": 2.68e-6, "555": 9.50e-7}),
        ("I-131", 3.0, {"003": 2.04e-4, "113": 1.66e-4, "222": 1.51e-4, "005": 7.23e-5, "555": 2.37e-5}),
        ("I-131", 9.28, {"111": 6.78e-5, "002": 4.88e-5, "222": 1.60e-5, "005": 7.57e-6, "555": 2.41e-6}),
    ],
)
def test_photons_give_the_published_voxel_s_values(isotope, side, published):
    grid = mph.Grid.centered(11, side)
    array = np.zeros(grid.shape)
    array[5, 5, 5] = 1e6 / grid.voxel_volume  # 1 MBq in the voxel, as kBq/mL
    per_second = mph.absorbed_dose_rate(mph.Volume(array, grid), isotope, density=1.04).array / 3600
    for steps, value in published.items():
        i, j, k = map(int, steps)
        assert per_second[5 + i, 5 + j, 5 + k] == pytest.approx(value, rel=0.045), steps


def test_dose_does_not_depend_on_how_the_grid_lies(rng):
    """Axes exchanged and mirrored, voxels twice as fine with the same activity."""
    grid = mph.Grid((8, 6, 5), np.diag([4.0, 5.0, 6.0, 1.0]))
    array = rng.random(grid.shape)
    rate = mph.absorbed_dose_rate(mph.Volume(array, grid), "I-131").array
    turned = mph.Grid((5, 8, 6), np.array([[0, -4.0, 0, 0], [0, 0, 5.0, 0], [6.0, 0, 0, 0], [0, 0, 0, 1]]))
    other = mph.absorbed_dose_rate(mph.Volume(array.transpose(2, 0, 1), turned), "I-131").array
    np.testing.assert_allclose(other.transpose(1, 2, 0), rate, rtol=1e-5)
    fine = mph.Grid.centered((16, 12, 10), (2.0, 2.5, 3.0))
    fine_rate = mph.absorbed_dose_rate(mph.Volume(array.repeat(2, 0).repeat(2, 1).repeat(2, 2), fine), "I-131").array
    np.testing.assert_allclose(fine_rate.reshape(8, 2, 6, 2, 5, 2).mean(axis=(1, 3, 5)), rate, rtol=5e-3)


def test_effective_half_lives_add_as_rates():
    rate = mph.Volume(np.full((2, 2, 2), 10.0), mph.Grid.centered(2, 4.0), "dose_rate")
    physical = mph.isotope("I-131").half_life / 3600
    effective = 1 / (1 / physical + 1 / 50)
    whole, half = mph.absorbed_dose(rate, "I-131"), mph.absorbed_dose(rate, "I-131", 50, duration=effective)
    assert whole.quantity == "dose"
    np.testing.assert_allclose(whole.array, 10 * physical / math.log(2), rtol=1e-6)
    np.testing.assert_allclose(half.array, 5 * effective / math.log(2), rtol=1e-6)


def test_what_has_no_dose_is_refused():
    activity = uniform()
    mu = mph.Volume(activity.array, activity.grid, "mu")
    for call, words in (
        (lambda: mph.absorbed_dose_rate(activity, "Co-57"), "isotope"),
        (lambda: mph.absorbed_dose_rate(mu, "Lu-177"), "of activity, got mu"),
        (lambda: mph.absorbed_dose_rate(activity, "Lu-177", density=0), "density: expected more than 0"),
        (lambda: mph.absorbed_dose_rate(activity, "Lu-177", density=np.ones(3)), "density: expected one number or"),
        (lambda: mph.absorbed_dose_rate(activity, "Lu-177", photons="all"), "photons"),
        (lambda: mph.absorbed_dose(activity, "Lu-177"), "expected a volume of dose_rate, got activity"),
    ):
        refused(call, words)
