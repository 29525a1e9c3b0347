"""Counts of spectral X rays: sums over energies, views, detectors; decomposition, its noise; beam hardening."""

import itertools
import math

import numpy as np
import pytest

import mphdrr.core as mph

from .conftest import refused

TUBE = mph.tube_spectrum(120)
BINS = ((20, 60), (60, 120))


def arc(n=60, shape=(3, 96), pitch=4.0):
    """Return views of sources on a circle of 600 mm around the origin, detectors 400 mm behind it."""
    a = np.arange(n) * 2 * np.pi / n
    towards, along = np.array([[np.cos(a), np.sin(a), 0 * a], [-np.sin(a), np.cos(a), 0 * a]]).transpose(0, 2, 1)
    return mph.Views(600 * towards, -400 * towards, pitch * along, np.tile([0.0, 0.0, pitch], (n, 1)), shape)


def two_paths(rng, n=50):
    return np.stack([rng.uniform(0, 300, n), rng.uniform(0, 40, n)])


def test_a_ray_through_slabs_is_the_sum_over_energies():
    detector = mph.PhotonCounter("CdTe", thickness=1.6, energy_fwhm=5.0)
    materials, paths, edges = ("water", "bone", "iodine"), (180.0, 25.0, 0.2), (20, 40, 70, 120)
    m = mph.SpectralTransmission(None, TUBE, materials, tuple(itertools.pairwise(edges)), detector)
    sigma, expected = 5.0 / math.sqrt(8 * math.log(2)), np.zeros(3)
    for energy, photons in zip(TUBE.energies, TUBE.photons, strict=True):
        passed = 7.0 * photons * math.exp(-np.dot([mph.attenuation(name, energy) for name in materials], paths))
        stopped = 1 - math.exp(-1.6 * mph.attenuation("CdTe", energy))
        below = [0.5 * (1 + math.erf((edge - energy) / sigma / math.sqrt(2))) for edge in edges]
        expected += passed * stopped * np.diff(below)
    np.testing.assert_allclose(m.expected(paths, 7.0), expected, rtol=1e-12)


def test_bins_sum_to_the_total(rng):
    paths = two_paths(rng)
    whole = mph.SpectralTransmission(None, TUBE, bins=((0, 200),)).expected(paths, 2.0)
    for detector in (mph.PhotonCounter(), mph.PhotonCounter(energy_fwhm=4.0)):
        parts = mph.SpectralTransmission(None, TUBE, bins=((0, 35), (35, 60), (60, 200)), detector=detector)
        np.testing.assert_allclose(parts.expected(paths, 2.0).sum(axis=0), whole[0], rtol=1e-6)
    shared = mph.PhotonCounter(sharing=[[0.9, 0.3], [0.1, 0.7]])  # columns sum to 1
    parts = mph.SpectralTransmission(None, TUBE, bins=((0, 60), (60, 200)), detector=shared)
    np.testing.assert_allclose(parts.expected(paths, 2.0).sum(axis=0), whole[0], rtol=1e-12)


def test_one_energy_is_transmission(rng):
    views, grid = arc(3, (4, 5)), mph.Grid.centered(8, 20.0)
    volume = rng.random(grid.shape)
    A = mph.Projector(grid, views, backend="numpy")
    m = mph.SpectralTransmission(views, mph.Spectrum([70.0], [1e4]), ("water",), ((20, 120),))
    air = m.expected(np.zeros((1, *A.shape_out)), 1.0)
    mu = mph.Volume(volume * mph.attenuation("water", 70.0), grid, "mu")
    np.testing.assert_allclose(m.project([volume], A, 1.0), mph.intensity(np.asarray(A(mu)), 1.0) * air, rtol=1e-6)


def test_pixels_get_the_photons_of_their_solid_angle():
    """A sphere around the source is crossed by all photons: cubes' faces of pixels sum to 4 pi m^2."""
    axes = np.eye(3)
    views = mph.Views(np.zeros((3, 3)), 50 * axes, 2 * axes[[1, 2, 0]], 2 * axes[[2, 0, 1]], (50, 50))
    m = mph.SpectralTransmission(views, mph.Spectrum([70.0], [2.0]), ("water",), ((20, 120),))
    photons = m.expected(np.zeros((1, 3, 50, 50)), 3.0)[0]
    assert 2 * photons.sum() == pytest.approx(4 * np.pi * 1e6 * 2.0 * 3.0, rel=1e-3)
    each = m.expected(np.zeros((1, 3, 50, 50)), [3.0, 6.0, 1.0])[0]
    np.testing.assert_allclose(each / photons, np.broadcast_to(np.array([1, 2, 1 / 3])[:, None, None], photons.shape))


def test_gradients_are_differences_and_adjoints(rng):
    views, grid = arc(3, (4, 5)), mph.Grid.centered(6, 30.0)
    A = mph.Projector(grid, views, backend="numpy")
    m = mph.SpectralTransmission(views, TUBE.coarser(2), detector=mph.PhotonCounter("silicon", energy_fwhm=3.0))
    volumes = rng.random((2, *grid.shape)) * np.array([1.0, 0.2])[:, None, None, None]
    y, step = rng.random((2, *A.shape_out)), rng.random(volumes.shape)
    h = 1e-4
    slope = (m.project(volumes + h * step, A, 0.1) - m.project(volumes - h * step, A, 0.1)) / (2 * h)
    gradient = m.volume_gradient(volumes, y, A, 0.1)
    assert np.vdot(y, slope) == pytest.approx(np.vdot(gradient, step), rel=1e-6)


def test_a_panel_measures_the_energy_absorbed():
    panel = mph.EnergyIntegrator("CsI", 0.5)
    m = mph.SpectralTransmission(None, mph.Spectrum([50, 90], [3.0, 4.0]), ("water",), None, panel)
    stopped = [1 - math.exp(-0.5 * mph.attenuation("CsI", energy)) for energy in (50, 90)]
    assert m.expected([0.0], 1.0)[0] == pytest.approx(3 * 50 * stopped[0] + 4 * 90 * stopped[1])


@pytest.mark.parametrize(("materials", "edges"), [(2, (20, 60, 120)), (2, (20, 40, 60, 120)), (3, (20, 35, 60, 120))])
def test_the_same_model_finds_the_paths(rng, materials, edges):
    paths = np.concatenate([two_paths(rng, 500), rng.uniform(0, 0.3, (1, 500))])[:materials]
    bins = tuple(itertools.pairwise(edges))
    m = mph.SpectralTransmission(None, TUBE, ("water", "bone", "iodine")[:materials], bins)
    np.testing.assert_allclose(mph.decompose(m.expected(paths, 1.0), m, 1.0), paths, rtol=1e-6, atol=1e-6)


def test_coarse_energies_find_the_paths_to_half_a_percent():
    paths = np.stack(np.meshgrid([50.0, 100, 200, 300], [10.0, 20, 40], indexing="ij"))
    fine, coarse = (mph.SpectralTransmission(None, tube) for tube in (TUBE, TUBE.coarser(2)))
    np.testing.assert_allclose(mph.decompose(fine.expected(paths, 1.0), coarse, 1.0), paths, rtol=5e-3)


def test_noise_of_the_paths_is_the_least_there_can_be(rng):
    m = mph.SpectralTransmission(None, TUBE)
    counts = rng.poisson(m.expected([200.0, 20.0], 1.0)[:, None], (2, 4000))
    paths = mph.decompose(counts, m, 1.0)
    bound = np.linalg.inv(m.fisher([200.0, 20.0], 1.0))
    np.testing.assert_allclose(np.cov(paths), bound, rtol=0.1)
    assert paths.mean(axis=1) == pytest.approx([200.0, 20.0], abs=4 * np.sqrt(np.diag(bound) / 4000).max())


def transmission(materials=("water", "bone"), views=None, **options):
    return mph.SpectralTransmission(views, TUBE, materials, **options)


def test_more_materials_than_bins_and_bins_that_overlap_are_refused(rng):
    three, two_images = transmission(("water", "bone", "iodine")), rng.random((2, 3, 4))
    for call, words in (
        (lambda: mph.decompose(np.ones(2), three, 1.0), "decompose: 3 materials from 2 bins: expected at least as"),
        (lambda: mph.decompose_images(two_images, three.materials, (45.0, 80.0)), "as many as materials, 3"),
        (lambda: transmission(bins=((20, 60), (50, 120))), "bins: bins 0 and 1 overlap"),
        (lambda: transmission(bins=((60, 20),)), "bins: bin 0: expected a lower and a higher"),
        (lambda: transmission(bins=((20, 60), (130, 150))), "no photon reaches bin 1"),
        (lambda: transmission(bins=None), "bins: a detector that counts photons needs them"),
        (lambda: transmission(detector=mph.EnergyIntegrator()), "expected None"),
        (lambda: transmission(("water", "water")), "materials: expected one or more, each once"),
        (lambda: transmission(blur=1.0), "blur: expected one number"),
        (lambda: mph.PhotonCounter("cheese").response(np.array([60.0]), BINS), "detector: material 'cheese'"),
        (lambda: transmission(views=TUBE), "views: expected Views, a scanner or None, got Spectrum"),
        (lambda: three.expected([1.0, 2.0], 1.0), "paths: expected a first axis of 3, water, bone, iodine"),
        (lambda: three.expected([1.0, 2.0, 3.0], 0), "mAs: expected more than 0, got 0"),
    ):
        refused(call, words)


def test_rays_without_counts_are_told():
    m = mph.SpectralTransmission(None, TUBE)
    counts = np.stack([m.expected([100.0, 10.0], 1.0), [0.0, 0.0]], axis=1)
    with pytest.warns(mph.InputWarning, match="1 of 2 rays did not converge"):
        paths = mph.decompose(counts, m, 1.0)
    assert paths[:, 0] == pytest.approx([100.0, 10.0]) and np.isfinite(paths).all()


def test_water_and_bone_attenuate_as_the_ct_says():
    hu = np.array([-1000.0, -600, 0, 60, 700, 1500]).reshape(6, 1, 1)
    ct = mph.Volume(hu, mph.Grid.centered((6, 1, 1), 1.0), "hu")
    volumes = mph.water_and_bone(ct)
    for energy in (60.0, 140.5):
        mu = mph.virtual_monoenergetic(volumes, ("water", "bone"), energy)
        np.testing.assert_allclose(mu, mph.hu_to_mu(ct, energy).array, atol=1.1 * mph.attenuation("air", energy))
    dense = mph.water_and_bone(mph.Volume(np.full((1, 1, 1), 2500.0), mph.Grid.centered(1, 1.0), "hu"))
    assert dense[0] == 0 and dense[1] > 1
    mu = mph.virtual_monoenergetic(dense, ("water", "bone"), 70.0)
    assert mu == pytest.approx(3.5 * mph.attenuation("water", 70.0), rel=1e-5)


def test_images_of_two_energies_are_told_apart(rng):
    volumes = rng.random((2, 3, 4))
    images = [mph.virtual_monoenergetic(volumes, ("water", "bone"), energy) for energy in (45.0, 80.0)]
    np.testing.assert_allclose(mph.decompose_images(images, ("water", "bone"), (45.0, 80.0)), volumes, rtol=1e-9)


def chords(views, radius):
    """Return the lengths of the rays, mm, in a cylinder around z."""
    lengths = []
    for m in range(len(views)):
        starts, ends = views.rays(m)
        d = (ends - starts) / np.linalg.norm(ends - starts, axis=1)[:, None]
        across = np.hypot(d[:, 0], d[:, 1])
        miss = np.abs(starts[:, 0] * d[:, 1] - starts[:, 1] * d[:, 0]) / across  # from the axis
        lengths.append(2 * np.sqrt(np.clip(radius**2 - miss**2, 0, None)) / across)
    return np.reshape(lengths, (1, len(views), *views.shape))


def test_water_has_no_cupping_after_correction():
    views, grid = arc(180, (3, 120), 3.5), mph.Grid.centered((48, 48, 1), 5.0)
    x, y, _ = np.indices(grid.shape) * 5.0 - np.array([117.5, 117.5, 0]).reshape(3, 1, 1, 1)
    r = np.hypot(x, y)
    paths = chords(views, 100.0)
    for detector, bins in ((None, ((20, 120),)), (mph.EnergyIntegrator(), None)):
        m = mph.SpectralTransmission(views, TUBE.coarser(2), ("water",), bins, detector)
        counts = m.expected(paths, 1.0)
        corrected = mph.correct_beam_hardening(counts, m, 1.0)
        np.testing.assert_allclose(corrected, paths[0], atol=1e-3)
        raw = np.log(m.expected(0 * paths, 1.0) / counts)[0]
        cupping = []
        for images in (raw, corrected):
            volume = mph.fdk(images, views, grid).array
            edge, middle = volume[(r > 70) & (r < 88)].mean(), volume[r < 20].mean()
            cupping.append((edge - middle) / edge)
        assert cupping[0] > 0.02 and abs(cupping[1]) < 0.01


def test_blur_keeps_counts_widens_edges_and_has_its_adjoint(rng):
    views, grid = arc(2, (40, 41)), mph.Grid.centered(8, 20.0)
    A = mph.Projector(grid, views, backend="numpy")
    plain = transmission(("water",), views, bins=((20, 120),))
    blur = 4 * np.linalg.norm(views.u_steps, axis=1)
    m = transmission(("water",), views, bins=((20, 120),), blur=blur, background=3.0)
    volume = np.zeros((1, *grid.shape))
    volume[0, 3:5, 3:5, 3:5] = 1.0
    sharp, soft = (model.project(volume, A, 1.0) for model in (plain, m))
    air = plain.project(0 * volume, A, 1.0)
    # A uniform field stays as it is away from the edges, and so does what an object takes from it in all.
    blurred_air = m.project(0 * volume, A, 1.0) - 3.0
    np.testing.assert_allclose(blurred_air[..., 12:-12, 12:-12], air[..., 12:-12, 12:-12], rtol=1e-3)
    np.testing.assert_allclose((blurred_air - soft + 3.0).sum(axis=(2, 3)), (air - sharp).sum(axis=(2, 3)), rtol=2e-3)
    values, step, h = rng.random(soft.shape), rng.random(volume.shape), 1e-4
    slope = (m.project(volume + h * step, A, 1.0) - m.project(volume - h * step, A, 1.0)) / (2 * h)
    assert np.vdot(slope, values) == pytest.approx(np.vdot(step, m.volume_gradient(volume, values, A, 1.0)), rel=1e-6)


def test_a_focal_spot_blurs_by_its_shadow():
    ring = mph.xray_ring(3, source_radius=400, panel_radius=400, z=0.0, focal_spot=1.2)
    width = mph.panel_blur(ring, 0.5)
    np.testing.assert_allclose(width, np.hypot(0.5, 1.2 * 2.3548 / 12**0.5), rtol=1e-3)
