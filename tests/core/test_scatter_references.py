"""Scattered photons beside numbers of other programs: SIMIND's benchmark, and photons that leave a slab by Goupil.

SIMIND (M. Ljungberg, Lund University): the result file of its test case, version 8.0,
https://github.com/gabriela-alessandra-villacorta-garcia/simind/blob/ccae11b2c1ff56f3cd8a4ad93518f4585470ad0b/.github/workflows/simind.res

Goupil 1.3.3 (V. Niess, https://pypi.org/project/goupil): 21 million photons of 140 keV from a point 20 mm beneath the
middle of a slab of water of 200 mm, by its forward mode and its own cross-sections; those that leave the slab within
acos(0.96) of its normal.
"""

import dataclasses

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.physics.isotopes import Isotope

KEV, FAR = 140.0, 20_000.0  # mm: rays are nearly parallel
MU = mph.attenuation("water", KEV)
EMITTED = 21e6 * (1 - 0.96) / 2  # of Goupil's photons towards the modules of either side
EDGES = np.array([60.0, 80.0, 100.0, 110.0, 120.0, 126.0, 130.0, 135.0, 140.5])
GOUPIL = {  # photons between these edges, as shares of those that are emitted within the same angle
    12.0: (0.24282, 0.18887, 0.07719, 0.07729, 0.04855, 0.03279, 0.04132, 0.19608),
    8.0: (0.31522, 0.26893, 0.11150, 0.10891, 0.06583, 0.04255, 0.05204, 0.33986),
}


def far(directions, **options):
    """Return views and a model of modules that look at the origin from these directions, from 20 m."""
    system = mph.PinholeSystem(FAR * directions, 10.0, 2000.0, 200.0, 9.53, 75.0)
    isotope = Isotope("140 keV", 1e9, ((KEV, 1.0),))
    model = mph.Emission(system, isotope=isotope, window=(126.0, 154.0), energy_fwhm=0.088, **options)
    return system.views((24, 24), "real"), model


def point(z=0.0):
    pose = np.diag([0.2, 0.2, 0.2, 1.0])
    pose[2, 3] = z
    return mph.Volume(np.full((1, 1, 1), 125.0, np.float32), mph.Grid((1, 1, 1), pose), "activity")


def cylinder(radius=110.0, half_length=83.2, voxel=4.0, fine=8):
    """Return a cylinder of water along x, each voxel with its share of water."""
    shape = tuple(int(np.ceil(2 * half / voxel)) for half in (half_length, radius, radius))
    x, y, z = (((np.arange(n * fine) + 0.5) / fine - n / 2) * voxel for n in shape)
    disc = (y[:, None] ** 2 + z**2 < radius**2).reshape(shape[1], fine, shape[2], fine).mean(axis=(1, 3))
    along = (np.abs(x) < half_length).reshape(-1, fine).mean(axis=1)
    return mph.Volume(np.float32(MU * along[:, None, None] * disc), mph.Grid.centered(shape, voxel), "mu")


@pytest.mark.long
@pytest.mark.parametrize("crystal, tolerance", [(None, 0.01), ("NaI", 0.02)])
def test_the_scatter_fraction_of_simind_s_test_case(crystal, tolerance):
    """A point in a cylinder of water of 220 mm, 140 keV, 126 to 154 keV, 8.8 %: SIMIND's fraction has an SD of 0.2 %."""
    turn = 0.2 + np.arange(8) * np.pi / 4
    views, model = far(np.stack([0 * turn, np.cos(turn), np.sin(turn)], axis=1), crystal_mu=crystal)
    body = cylinder()
    primary = mph.Projector(point().grid, views, dataclasses.replace(model, mu=body))(point()).sum()
    scatter = mph.scatter_images(point(), body, views, model, precision=0.003).images.sum()
    assert scatter / (scatter + primary) == pytest.approx(0.39337, rel=tolerance)


@pytest.mark.long
def test_spectra_of_photons_that_leave_a_slab_are_those_of_goupil():
    cosine = np.array([0.965, 0.975, 0.985, 0.995] * 2) * np.repeat([1, -1], 4)
    sine, turn = np.sqrt(1 - cosine**2), 1.1 * np.arange(8)
    views, model = far(np.stack([sine * np.cos(turn), sine * np.sin(turn), cosine], axis=1))
    grid, activity = mph.Grid.centered((100, 100, 20), 10.0), point(-20.0)
    water = mph.Volume(np.full(grid.shape, MU, np.float32), grid, "mu")
    found = mph.scatter_images(activity, water, views, model, windows=[(30, 154)], precision=0.002, spectra=True)
    emitted = mph.Projector(activity.grid, views, model)(activity).sum(axis=(1, 2))
    step = found.energies[1] - found.energies[0]
    ends = np.append(found.energies - step / 2, found.energies[-1] + step / 2)
    for (depth, expected), modules in zip(GOUPIL.items(), (slice(4), slice(4, 8)), strict=True):
        spectrum = (found.spectra[modules] / emitted[modules, None]).mean(axis=0)
        counts = np.diff(np.interp(EDGES, ends, np.append(0, np.cumsum(spectrum))))
        counts[-1] += np.exp(-10 * depth * MU / np.abs(cosine[modules])).mean()
        chance = 2 / np.sqrt(EMITTED * np.array(expected))  # two standard deviations of Goupil's counts
        assert (abs(counts / expected - 1)[2:] < 0.015 + chance[2:]).all()
        assert (abs(counts / expected - 1)[:2] < 0.025 + chance[:2]).all()
        assert counts[5:].sum() == pytest.approx(sum(expected[5:]), rel=0.01)  # between 126 and 140.5 keV
